"""Cuts in a skin, and their repair."""

from __future__ import annotations

import dataclasses
import itertools

import jax
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jeit.arguments import check_key, check_kind, check_metres, describe, is_number, real_array
from jeit.forward.system import check_conductivity
from jeit.mesh import Domain, Mesh, Refine, centroids, check_flat, measures
from jeit.touch.simulate.contact import Material
from jeit_solvers.module import Module

# Maximum number of random cuts that are tried; minimum and maximum angle of the bend in a cut, in radians.
_MAX_TRIED_CUTS, _MIN_BEND_ANGLE, _MAX_BEND_ANGLE = 400, 0.35, 1.2


class Cut(Module):
    """A cut in a skin along a polyline.

    **Fields**: `path`: (k, 2) vertices of the cut in metres; `depth`: depth of the cut as a share of the skin's
    thickness, 1 for a cut through the skin; `residual`: factor by which the conductivity of the cut cells is
    multiplied.

    **Example:**

    ```python
    cut = Cut([(-0.01, 0.0), (0.01, 0.005)], depth=1.0)
    conductivity = cut.conductivity(model.mesh, skin.conductivity)
    ```
    """

    path: Float[np.ndarray, "k 2"]
    depth: float
    residual: float

    def __init__(self, path: ArrayLike, depth: float = 1.0, residual: float = 1e-6):
        """Create a cut. Raises `ValueError` for a path with fewer than two vertices or with a segment of zero length,
        and for a depth or residual out of range."""
        path = real_array("path", path, "places (k, 2), metres, two or more")
        if path.ndim != 2 or path.shape[1] != 2 or len(path) < 2 or not np.isfinite(path).all():
            raise ValueError(f"path must be finite places (k, 2), metres, two or more; it has shape {path.shape}.")
        if not np.linalg.norm(np.diff(path, axis=0), axis=1).min() > 0:
            raise ValueError("path: two consecutive vertices coincide; give different places.")
        if not (is_number(depth) and 0 < depth <= 1):
            raise ValueError(f"depth must be a share of the thickness, above 0 and up to 1; it is {describe(depth)}.")
        if not (is_number(residual) and 0 < residual < 1):
            raise ValueError(f"residual must be between 0 and 1; it is {describe(residual)}.")
        self.path, self.depth, self.residual = path, float(depth), float(residual)

    @property
    def length(self) -> float:
        """Length of the cut, metres."""
        return float(np.linalg.norm(np.diff(self.path, axis=0), axis=1).sum())

    def refine(self, cell_size: float = 1e-3) -> Refine:
        """Return the refinement of a mesh along the cut: `Rectangle(…).mesh(num_points=n, refine=cut.refine())`.

        `cell_size`: size of the cells along the cut, metres. Raises `ValueError` for a size that is not positive.
        """
        check_metres("cell_size", cell_size)
        return Refine(self.along(cell_size), cell_size=cell_size)

    def along(self, step: float) -> Float[np.ndarray, "n 2"]:
        """Return points (n, 2) on the cut, metres, at most `step` metres apart. Raises `ValueError` for a step that is
        not positive."""
        check_metres("step", step)
        points_of_segments = [
            np.linspace(
                segment_start, segment_end, max(2, int(np.ceil(np.linalg.norm(segment_end - segment_start) / step)) + 1)
            )
            for segment_start, segment_end in itertools.pairwise(self.path)
        ]
        return np.concatenate([segment_points[:-1] for segment_points in points_of_segments] + [self.path[-1:]])

    def cells(self, mesh: Mesh) -> Int[np.ndarray, " c"]:
        """Return the numbers of the cells of a mesh that the cut crosses; in a layer, only cells whose centroid is
        above the bottom of the cut.

        A cell is crossed if the path crosses one of its edges, as seen from above. Raises `ValueError` for an argument
        that is not a flat mesh, and for a cut that crosses no cell.
        """
        check_kind("mesh", mesh, Mesh, "a Mesh, that of the skin")
        check_flat(mesh, "cuts")
        mesh_points, mesh_cells = np.asarray(mesh.points), np.asarray(mesh.cells)
        is_crossed_cell = np.zeros(len(mesh_cells), bool)
        for segment_start, segment_end in itertools.pairwise(self.path):
            for first_corner, second_corner in itertools.combinations(range(mesh_cells.shape[1]), 2):
                is_crossed_cell |= _segments_cross(
                    segment_start,
                    segment_end,
                    mesh_points[mesh_cells[:, first_corner], :2],
                    mesh_points[mesh_cells[:, second_corner], :2],
                )
        if mesh.dimension == 3:
            top_height = mesh_points[:, 2].max()
            is_crossed_cell &= np.asarray(centroids(mesh))[:, 2] > top_height - self.depth * (
                top_height - mesh_points[:, 2].min()
            )
        if not is_crossed_cell.any():
            raise ValueError("cut: it crosses no cell of the mesh; are both in metres, with the same origin?")
        return np.flatnonzero(is_crossed_cell)

    def conductivity(
        self, mesh: Mesh, conductivity: ArrayLike, thickness: float | None = None
    ) -> Float[np.ndarray, " m"]:
        """Compute the conductivity (m,) of the cut skin, S/m (2-D: S), from the `conductivity` of the intact skin.

        The conductivities of the cells that the cut crosses are multiplied by `residual_fraction`. In a sheet of
        `thickness` h metres that is partly cut, with a remaining thickness r, the resistance across the cut is that of
        a sheet longer by (4h/π) ln csc(πr/2h), as for a diaphragm in a channel (Lamb, Hydrodynamics, 6th edition,
        §306). Raises `ValueError` for an invalid conductivity, and for a partial cut of a sheet without its thickness.
        """
        cell_conductivities = np.asarray(check_conductivity(mesh, conductivity))
        if (
            cell_conductivities.ndim > 1
            or np.iscomplexobj(cell_conductivities)
            or cell_conductivities.size not in (1, mesh.num_cells)
        ):
            raise ValueError("conductivity must be real, one number or one for each cell.")
        cell_conductivities = np.broadcast_to(cell_conductivities, mesh.num_cells).astype(float)
        cut_cells, residual_fraction = self.cells(mesh), self.residual
        if mesh.dimension == 2 and self.depth < 1:
            if thickness is None:
                raise ValueError(
                    "thickness: give that of the sheet, metres; the resistance across a partial cut depends on it."
                )
            check_metres("thickness", thickness)
            crossed_width = float(np.asarray(measures(mesh))[cut_cells].sum()) / self.length
            additional_length = -4 * thickness / np.pi * np.log(np.sin(np.pi * (1 - self.depth) / 2))
            residual_fraction = max(residual_fraction, crossed_width / (crossed_width + additional_length))
        cell_conductivities[cut_cells] *= residual_fraction
        return cell_conductivities


def draw_cut(
    key: Array,
    outline: Domain,
    *,
    length: tuple[float, float] = (0.02, 0.06),
    depth: float = 1.0,
    bent: float = 0.5,
    margin: float = 5e-3,
) -> Cut:
    """Draw a random cut inside an outline.

    **Arguments:**

    - `key`: random key.
    - `outline`: outline of the skin.
    - `length`: minimum and maximum of the length, metres, which is uniformly distributed.
    - `depth`: depth of the cut as a share of the skin's thickness, 1 for a cut through the skin.
    - `bent`: probability that the cut has one bend of 20 to 70 degrees.
    - `margin`: minimum distance of the cut from the edge of the skin, metres.

    Raises `ValueError` for invalid arguments, and if the skin is too small for the cut.

    **Example:**

    ```python
    cut = draw_cut(key, outline, length=(0.02, 0.03))
    conductivity = cut.conductivity(model.mesh, skin.conductivity)
    ```
    """
    check_key(key)
    check_kind("outline", outline, Domain, "an outline, such as Disk(0.05)")
    length_range = real_array("length", length, "the least and the greatest, metres")
    if length_range.shape != (2,) or not 0 < length_range[0] <= length_range[1] < np.inf:
        raise ValueError(f"length must be the least and the greatest, metres, such as (0.02, 0.06); it is {length!r}.")
    if not (is_number(bent) and 0 <= bent <= 1):
        raise ValueError(f"bent must be a probability, from 0 to 1; it is {describe(bent)}.")
    if not (is_number(margin) and margin >= 0):
        raise ValueError(f"margin must be metres, zero or more; it is {describe(margin)}.")
    random_generator = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    low_x, high_x, low_y, high_y = map(float, outline.extent)
    cut_length, is_bent = random_generator.uniform(*length_range), random_generator.random() < bent
    for _ in range(_MAX_TRIED_CUTS):
        cut_start, cut_angle = (
            random_generator.uniform((low_x, low_y), (high_x, high_y)),
            random_generator.uniform(-np.pi, np.pi),
        )
        length_fraction, bend_angle = (
            random_generator.uniform(0.3, 0.7),
            random_generator.choice((-1, 1)) * random_generator.uniform(_MIN_BEND_ANGLE, _MAX_BEND_ANGLE),
        )
        cut_segments = (
            [(length_fraction, cut_angle), (1 - length_fraction, cut_angle + bend_angle)]
            if is_bent
            else [(1.0, cut_angle)]
        )
        segment_vectors = [
            segment_fraction * cut_length * np.array([np.cos(segment_angle), np.sin(segment_angle)])
            for segment_fraction, segment_angle in cut_segments
        ]
        candidate_cut = Cut(np.cumsum([cut_start, *segment_vectors], axis=0), depth)
        if (np.asarray(outline.signed_distance(candidate_cut.along(cut_length / 20))) > margin).all():
            return candidate_cut
    raise ValueError(
        f"length: no cut of {1e3 * cut_length:.3g} mm was found that lies within the skin; give a shorter length."
    )


def _segments_cross(segment_start, segment_end, other_starts: np.ndarray, other_ends: np.ndarray) -> np.ndarray:
    """Return whether the segments from `other_starts` to `other_ends` (m, 2) cross the segment from `segment_start` to
    `segment_end`."""
    segment_direction, other_directions = segment_end - segment_start, other_ends - other_starts
    first_orientation, second_orientation = (
        _cross_products(segment_direction, other_starts - segment_start),
        _cross_products(segment_direction, other_ends - segment_start),
    )
    return (first_orientation * second_orientation <= 0) & (
        _cross_products(other_directions, segment_start - other_starts)
        * _cross_products(other_directions, segment_end - other_starts)
        <= 0
    )


def _cross_products(first_vectors, second_vectors) -> np.ndarray:
    return first_vectors[..., 0] * second_vectors[..., 1] - first_vectors[..., 1] * second_vectors[..., 0]


# Factor by which a repair multiplies the hysteresis of a material. Park et al. (2022), figure S13, show an increase
# without a number; 1.5 is an assumption.
_HYSTERESIS_FACTOR = 1.5


def mend_cut(
    mesh: Mesh, conductivity: ArrayLike, cut: Cut, material: Material, share: float = 1.0
) -> tuple[Float[np.ndarray, " m"], Material]:
    """Compute the conductivity (m,), S/m (2-D: S), and the material of a skin whose cut was repaired.

    The hysteresis of the material is multiplied by 1.5, up to at most 0.9.

    **Arguments:**

    - `mesh`: mesh of the skin.
    - `conductivity`: conductivity of the skin before the cut, S/m (2-D: S).
    - `cut`: the cut.
    - `material`: material of the skin.
    - `share`: factor by which the conductivity of the repaired cells is multiplied, about 0.9 to 1.1.

    Raises `ValueError` for invalid arguments, and as `Cut.cells` does.

    **Example:**

    ```python
    cut = Cut([(-0.01, 0.0), (0.01, 0.005)])
    conductivity, glued = mend_cut(model.mesh, skin.conductivity, cut, skin.material, 0.95)
    ```
    """
    check_kind("cut", cut, Cut, "the Cut that was mended")
    check_kind("material", material, Material, 'a Material, such as material("hydrogel")')
    if not (is_number(share) and share > 0):
        raise ValueError(f"share must be positive, about 0.9 to 1.1; it is {describe(share)}.")
    mended_conductivities = np.array(
        np.broadcast_to(np.asarray(check_conductivity(mesh, conductivity)), mesh.num_cells), float
    )
    mended_conductivities[cut.cells(mesh)] *= share
    return mended_conductivities, dataclasses.replace(
        material, hysteresis=min(0.9, _HYSTERESIS_FACTOR * material.hysteresis)
    )
