"""What is said of patches that lie off a body's surface, at one place, or are larger than the body (NumPy)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jeit.arguments import IN_MILLIMETRES
from jeit.electrodes.electrodes import AbstractPlacedElectrodes
from jeit.mesh import Mesh
from jeit.mesh.geodesic import Triangles

# Of an electrode's smaller size: as far apart as this are two that were meant to be one.
_SAME = 1e-3

Distance = Callable[[Float[np.ndarray, "L 3"]], Float[np.ndarray, " L"]]


def check_on_surface(position: Float[np.ndarray, "L 3"], allowed: Float[np.ndarray, " L"], off: Distance) -> None:
    """Raise `ValueError` for the first of electrodes that is more than `allowed` metres `off` a body's surface."""
    far = off(position)
    for number in np.flatnonzero(far > allowed)[:1]:
        hint = "give a place on it."
        if _all_on(position / 1000, allowed, off):
            hint = IN_MILLIMETRES
        elif _all_on(position * 1000, 1000 * allowed, off):
            hint = "is the mesh in millimetres? Read it with scale = 1e-3."
        raise ValueError(
            f"position: electrode {number + 1} at {np.round(position[number], 6).tolist()} m lies "
            f"{_told(float(far[number]))} off the body's surface; {hint}"
        )


def _all_on(position, allowed, off: Distance) -> bool:
    """Whether all lie on the surface, and not all in one place of it, as wherever the origin is."""
    return bool((np.ptp(position, axis=0).max() > allowed).all() and (off(position) <= allowed).all())


def check_apart(position: Float[np.ndarray, "L 3"], size: Float[np.ndarray, " L"]) -> None:
    """Raise `ValueError` for the first two electrodes at the same place; `size`: the smaller of each one's, metres."""
    apart = np.linalg.norm(position[:, None] - position, axis=-1)
    same = np.argwhere(np.triu(apart < _SAME * np.minimum(size[:, None], size), 1))
    for first, second in same[:1]:
        raise ValueError(
            f"position: electrodes {first + 1} and {second + 1} are at the same place, "
            f"{np.round(position[first], 6).tolist()} m; give each its own."
        )


def check_size(name: str, sizes: Float[np.ndarray, " L"], most: float, of: str) -> None:
    """Raise `ValueError`, about the argument `name`, for the first electrode of more than `most` metres, the length
    `of` what it lies on."""
    for number in np.flatnonzero(sizes > (1 + _SAME) * most)[:1]:
        size = float(sizes[number])
        hint = IN_MILLIMETRES if 10 * most < size <= 1000 * most else "give the size of what lies on it."
        raise ValueError(f"{name}: electrode {number + 1}'s is {_told(size)}, larger than {of}, {_told(most)}; {hint}")


def check_placed(electrodes: AbstractPlacedElectrodes, mesh: Mesh) -> None:
    """Raise `ValueError` for patches of which a mesh has little: off its surface, or larger than it."""
    sizes = {name: np.asarray(one) for name, one in electrodes.geometry().items() if name in ("width", "height")}
    points = np.asarray(mesh.points)
    surface = Triangles(points, np.asarray(mesh.facets))
    half = np.maximum(*sizes.values()) / 2
    check_on_surface(np.asarray(electrodes.position), half, lambda places: surface.nearest(places).away)
    across = float(np.linalg.norm(np.ptp(points, axis=0)))
    for name, one in sizes.items():
        check_size(name, one, across, "the body")


def _told(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm" if metres < 1 else f"{metres:.3g} m"
