"""`Body`: the body that is measured, an outline of a sheet or a solid; the interface for readers and images."""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from jeit.mesh.generate.refine import Refinement
from jeit.mesh.mesh import Mesh


class Body(eqx.Module):
    """Base of all bodies: plane outlines (`Domain`), solids above one (`Solid`), and meshes of your own (`OwnMesh`)."""

    @property
    @abc.abstractmethod
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box seen from above, (x_min, x_max, y_min, y_max) in metres."""

    @abc.abstractmethod
    def loops(self, num_chords: int = 120) -> tuple[Float[Array, "k 2"], ...]:
        """Vertices (k, 2) in metres of the edges of a plane body, the outer one first; none of a solid."""

    @abc.abstractmethod
    def describe(self) -> dict[str, Any]:
        """The name of the "shape" and its sizes, lengths in metres, in words that JSON and TOML have."""

    @abc.abstractmethod
    def mesh(self, num_points: int | None = None, cell_size: float | None = None, refine: Refinement = None) -> Mesh:
        """A mesh of it with `num_points` nodes or of `cell_size` metres, finer where `refine` asks, seen from above.

        Raises `ValueError` on bad or contradicting arguments.
        """
