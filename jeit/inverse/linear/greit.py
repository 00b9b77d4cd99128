"""GREIT: a reconstruction matrix trained on small targets, so that each target is imaged as a smooth disc of the same
size.

Adler et al., "GREIT: a unified approach to 2D linear EIT reconstruction of lung images", Physiol. Meas. 30 (2009)
S35-S55. The paper considers a disk. Here, bodies may have any outline, and targets in a solid body are balls.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jeit.arguments import check_has_values
from jeit.forward import ForwardModel
from jeit.forward.model import check_model
from jeit.inverse.hyperparameter.rules import greit_noise_figure
from jeit.inverse.linear.one_step import LinearReconstruction
from jeit.inverse.linearisation import combined_blocks, data_directions, used_channels
from jeit.mesh import Mesh, centroids, check_flat, measures

# Half width of the smooth edge of a desired image, relative to the image's radius.
_EDGE_HALF_WIDTH = 0.25
# Sampling points along the radius of a target, by dimension: about 50 points in a disc, about 60 in a ball.
_SAMPLES_PER_RADIUS = {2: 4.0, 3: 2.5}
# Number of sampling points processed at a time.
_SAMPLES_AT_ONCE = 500_000
# Search distance around the centre of a ball, in radii, slightly above 1 so that rounding excludes no point of the
# ball.
_SEARCH_RADII = 1 + 1e-9
# Minimum fraction of a training target that must lie in the body.
_MIN_INSIDE_FRACTION = 0.9
# Approximate number of cells over which the signal and noise in the noise figure are averaged.
_NUM_MEAN_CELLS = 10_000
# Minimum radius of a target: smaller targets give the same result in a linear model but need more sampling points.
_MIN_TARGET_RADIUS = 0.01


def greit(
    model: ForwardModel,
    conductivity: ArrayLike,
    *,
    radius: float | None = None,
    hyperparameter: float | str = "noise-figure",
    noise_figure: float = 0.5,
    noise: Float[Array, " M"] | float = 1.0,
    mask: Bool[Array, " M"] | None = None,
    target_radius: float = 0.05,
    num_targets: int = 1000,
) -> LinearReconstruction:
    """GREIT reconstruction matrix R = XYᵀ(YYᵀ + λ²W⁻¹)⁻¹ for a body of any shape, at a background conductivity.

    The training targets are small discs (3-D: balls) on a hexagonal (3-D: cubic) grid over the body. The columns of Y
    are the voltage responses to a unit change of conductivity (S/m; 2-D: S) in each target, computed **from the
    Jacobian**. These responses are exact for small changes; as in any linear image, the contrast of large changes is
    underestimated. The columns of X are the desired images: discs of one radius with a smooth edge, cut off at the
    body's outline, each with the same integral as its target. X and Y are divided by √(number of targets).

    **Arguments:**

    - `model`: the forward model.
    - `conductivity`: the background, S/m (2-D: S).
    - `radius`, `target_radius`: radii of the desired images and of the targets, as fractions of the body's radius, i.e.
      the radius of the disc of equal area (3-D: ball of equal volume). Default `radius` 1/√L, 0.25 for 16 electrodes; a
      smaller radius improves resolution but increases ringing and noise.
    - `hyperparameter`: λ, or "noise-figure" for the λ at which the signal-to-noise ratio of the data is `noise_figure`
      times that of the image, for a target in the middle of the body.
    - `noise_figure`: the default 0.5 is the value agreed on by GREIT's authors. The signal of data or image is the mean
      absolute value, over channels in units of their noise or over the body. The noise is the root mean square standard
      deviation.
    - `noise`: standard deviation of the channels, W = noise⁻²; one number or (M,), in volts, or up to a common factor.
    - `mask` (M,): True for the channels to use.
    - `num_targets`: number of targets, approximately.

    Raises `ValueError` for invalid or inconsistent arguments, and for a noise figure that no λ reaches.

    **Example:**

    ```python
    image = greit(model, 1.0, num_targets=200).image(change)
    ```
    """
    check_model(model)
    advice_to_user = (
        "work it out once outside: its image() is what JAX transforms; or take one_step, which can be differentiated"
    )
    check_has_values(
        "model, conductivity or noise", (model, conductivity, noise), "GREIT is trained on", advice_to_user
    )
    mesh = model.mesh
    check_flat(mesh, "GREIT's targets")
    radius = float(model.electrodes.num_electrodes**-0.5) if radius is None else radius
    _check_options(radius, target_radius, num_targets, hyperparameter, noise_figure)
    channel_indices, inverse_noise = used_channels(model, noise, mask)
    if jnp.iscomplexobj(conductivity):
        raise ValueError("conductivity is complex; linear images are of real ones: give its real part.")
    if np.shape(conductivity) not in ((), (mesh.num_cells,)):
        raise ValueError("conductivity: give one number, or one value per cell: the image has a value per cell.")
    cell_measures, cell_centres = np.asarray(measures(mesh)), np.asarray(centroids(mesh))
    body_radius, body_centre = (
        _ball_radius(float(cell_measures.sum()), mesh.dimension),
        cell_measures @ cell_centres / cell_measures.sum(),
    )
    positions, target_coverage = _place_targets(mesh, body_centre, target_radius * body_radius, num_targets)
    desired_images = _desired_images(mesh, positions, target_coverage.T @ cell_measures, radius * body_radius)
    # Responses are computed only for those combinations of channels that a body can change, which are fewer than the
    # channels.
    data_basis = data_directions(model.protocol, channel_indices, inverse_noise)
    weighted_directions = data_basis.T * np.asarray(inverse_noise)  # (r, K)
    target_responses, cell_coverage = np.zeros((len(weighted_directions), len(positions))), target_coverage.tocsr()
    for cells, jacobian_block in combined_blocks(model, conductivity, channel_indices, weighted_directions):
        target_responses += (cell_coverage[cells].T @ jacobian_block.T).T / np.sqrt(len(positions))
    eigenvalues, eigenvectors = np.linalg.eigh(target_responses @ target_responses.T)
    eigenvalues = np.maximum(eigenvalues, 0)
    image_modes = desired_images @ (target_responses.T @ eigenvectors) / np.sqrt(len(positions))
    if isinstance(hyperparameter, str):
        central_response = target_responses[:, np.argmin(np.linalg.norm(positions - body_centre, axis=1))]
        data_signal_to_noise = float(np.abs(data_basis @ central_response).mean())
        sampled_cells = slice(None, None, max(1, len(cell_measures) // _NUM_MEAN_CELLS))
        signal_components = eigenvectors.T @ central_response
        chosen_hyperparameter = greit_noise_figure(
            noise_figure,
            eigenvalues,
            signal_components,
            data_signal_to_noise,
            image_modes[sampled_cells],
            cell_measures[sampled_cells],
        )
    else:
        chosen_hyperparameter = float(hyperparameter)
    channel_weights = np.zeros((len(eigenvalues), model.protocol.num_measurements))
    channel_weights[:, channel_indices] = (
        (eigenvectors / (eigenvalues + chosen_hyperparameter**2)).T @ data_basis.T * inverse_noise
    )
    name_of_rule = "noise-figure" if isinstance(hyperparameter, str) else "given"
    return LinearReconstruction.of_factors(
        model, (image_modes, channel_weights), chosen_hyperparameter, name_of_rule, "GREIT"
    )


def _ball_radius(measure: float, dimension: int) -> float:
    """Radius of the disc of a given area or the ball of a given volume."""
    return float(np.sqrt(measure / np.pi) if dimension == 2 else np.cbrt(3 * measure / (4 * np.pi)))


def _ball_measure(radius: float, dimension: int) -> float:
    """Area of a disc or volume of a ball."""
    return np.pi * radius**2 if dimension == 2 else 4 / 3 * np.pi * radius**3


def _place_targets(mesh: Mesh, centre, radius: float, num_targets: int) -> tuple[np.ndarray, scipy.sparse.csc_array]:
    """Centres (K, d) of the K training targets that lie in the body, and the fraction (m, K) of every cell that each
    target covers."""
    cell_measures, mesh_points = np.asarray(measures(mesh)), np.asarray(mesh.points)
    lower_corner, upper_corner = mesh_points.min(axis=0), mesh_points.max(axis=0)
    if mesh.dimension == 2:
        lattice_spacing = np.sqrt(2 / np.sqrt(3) * cell_measures.sum() / num_targets)
        target_lattice = _hexagonal_lattice(lower_corner, upper_corner, centre, lattice_spacing)
    else:
        lattice_spacing = np.cbrt(cell_measures.sum() / num_targets)
        target_lattice = _cubic_lattice(lower_corner, upper_corner, centre, lattice_spacing)
    lattice_tree, entry_groups = KDTree(target_lattice), []
    for sample_points, sample_cells, fractions_of_samples in _sample_points(
        mesh, radius / _SAMPLES_PER_RADIUS[mesh.dimension]
    ):
        if mesh.dimension == 3:
            relative_sample_positions = (sample_points - centre) / lattice_spacing
            # Offset from the nearest centre; not all points lie within a target.
            relative_sample_positions -= np.rint(relative_sample_positions)
            sample_indices_inside = np.flatnonzero(
                np.einsum("qi,qi->q", relative_sample_positions, relative_sample_positions)
                < (_SEARCH_RADII * radius / lattice_spacing) ** 2
            )
            sample_points, sample_cells, fractions_of_samples = (
                sample_points[sample_indices_inside],
                sample_cells[sample_indices_inside],
                fractions_of_samples[sample_indices_inside],
            )
        target_sample_pairs = lattice_tree.sparse_distance_matrix(KDTree(sample_points), radius, output_type="ndarray")
        entry_groups.append(
            (
                fractions_of_samples[target_sample_pairs["j"]],
                sample_cells[target_sample_pairs["j"]],
                target_sample_pairs["i"],
            )
        )
    overlap_fractions, cells, targets = (
        np.concatenate(group_arrays) for group_arrays in zip(*entry_groups, strict=True)
    )
    coverage_matrix = scipy.sparse.coo_array(
        (overlap_fractions, (cells, targets)), shape=(mesh.num_cells, len(target_lattice))
    ).tocsc()
    targets_inside = np.flatnonzero(
        coverage_matrix.T @ cell_measures > _MIN_INSIDE_FRACTION * _ball_measure(radius, mesh.dimension)
    )
    if targets_inside.size == 0:
        raise ValueError(
            f"target_radius: no {'disc' if mesh.dimension == 2 else 'ball'} of {1e3 * radius:.3g} mm radius fits into "
            "this body; give a smaller one, or more targets."
        )
    return target_lattice[targets_inside], coverage_matrix[:, targets_inside]


def _hexagonal_lattice(lower_corner, upper_corner, centre, spacing: float) -> np.ndarray:
    """Points (k, 2) of a hexagonal grid with a point at `centre` that covers the box from `lower_corner` to
    `upper_corner`."""
    lattice_steps = spacing * np.array([1, np.sqrt(0.75)])
    (first_column, first_row), (last_column, last_row) = (
        np.floor((lower_corner - centre) / lattice_steps) - 1,
        np.ceil((upper_corner - centre) / lattice_steps) + 1,
    )
    row, column = np.meshgrid(
        np.arange(first_row, last_row + 1), np.arange(first_column, last_column + 1), indexing="ij"
    )
    return centre + lattice_steps * np.stack([column + row % 2 / 2, row], axis=-1).reshape(-1, 2)


def _cubic_lattice(lower_corner, upper_corner, centre, spacing: float) -> np.ndarray:
    """Points (k, 3) of a cubic grid with a point at `centre` that covers the box from `lower_corner` to
    `upper_corner`."""
    first_indices, last_indices = (
        np.floor((lower_corner - centre) / spacing) - 1,
        np.ceil((upper_corner - centre) / spacing) + 1,
    )
    axis_indices = [np.arange(a, b + 1) for a, b in zip(first_indices, last_indices, strict=True)]
    return centre + spacing * np.stack(np.meshgrid(*axis_indices, indexing="ij"), axis=-1).reshape(-1, 3)


def _sample_points(mesh: Mesh, spacing: float) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Iterate over groups of cells. Yields q sampling points (q, d) spread evenly over each cell, the cells of the
    points, and the fraction of the cell that each point represents.

    Points are about `spacing` apart. Each side of a triangle is divided into n parts, and the points are the centres
    of the upright small triangles, with barycentric coordinates (i + 1/3, j + 1/3, k + 1/3) / n, i + j + k = n - 1.
    Tetrahedra are treated likewise.
    """
    corners = np.asarray(mesh.points)[np.asarray(mesh.cells)]
    num_corners = corners.shape[1]
    longest_sides = np.max(
        [np.linalg.norm(corners[:, i] - corners[:, j], axis=1) for i, j in combinations(range(num_corners), 2)], 0
    )
    num_parts = np.maximum(np.ceil(longest_sides / spacing), 1).astype(int)
    for parts_per_side in np.unique(num_parts):
        simplex_indices = np.stack(np.meshgrid(*[np.arange(parts_per_side)] * (num_corners - 1)), axis=-1).reshape(
            -1, num_corners - 1
        )
        simplex_indices = simplex_indices[simplex_indices.sum(axis=1) < parts_per_side]
        barycentric_coordinates = (
            np.column_stack([simplex_indices, parts_per_side - 1 - simplex_indices.sum(axis=1)]) + 1 / num_corners
        ) / parts_per_side
        cell_indices = np.flatnonzero(num_parts == parts_per_side)
        for cells in np.array_split(cell_indices, -(-cell_indices.size * len(simplex_indices) // _SAMPLES_AT_ONCE)):
            sample_points = (barycentric_coordinates @ corners[cells]).reshape(-1, corners.shape[2])
            yield (
                sample_points,
                np.repeat(cells, len(simplex_indices)),
                np.full(len(sample_points), 1 / len(simplex_indices)),
            )


def _desired_images(mesh: Mesh, positions, integrals, radius: float) -> scipy.sparse.csc_array:
    """Desired images X (m, K) of K targets: a smooth disc around each position, which falls to half its height at
    `radius`, with the integral `integrals` (K,) over the body."""
    cell_measures, cell_centres = np.asarray(measures(mesh)), np.asarray(centroids(mesh))
    cell_target_pairs = KDTree(cell_centres).sparse_distance_matrix(
        KDTree(positions), (1 + _EDGE_HALF_WIDTH) * radius, output_type="ndarray"
    )
    edge_positions = np.clip((cell_target_pairs["v"] / radius - 1) / _EDGE_HALF_WIDTH, -1, 1)
    smoothed_heights = (1 - np.sin(0.5 * np.pi * edge_positions)) / 2
    discs = scipy.sparse.coo_array(
        (smoothed_heights, (cell_target_pairs["i"], cell_target_pairs["j"])), shape=(len(cell_centres), len(positions))
    ).tocsc()
    disc_integrals = discs.T @ cell_measures
    if not (disc_integrals > 0.01 * _ball_measure(radius, mesh.dimension)).all():
        raise ValueError(
            f"radius: a desired image of {1e3 * radius:.3g} mm radius is lost between the cells of this mesh; give a "
            "larger radius, or a finer mesh."
        )
    return discs @ scipy.sparse.diags_array(integrals / disc_integrals)


def _check_options(radius, target_radius, num_targets, hyperparameter, noise_figure) -> None:
    if not _MIN_TARGET_RADIUS <= target_radius <= radius < 1:
        raise ValueError(
            "radius and target_radius are fractions of the body's radius, and targets no larger than their images: "
            f"give {_MIN_TARGET_RADIUS} ≤ target_radius ≤ radius < 1; they are {target_radius} and {radius}."
        )
    if int(num_targets) != num_targets or num_targets < 1:
        raise ValueError(f"num_targets: give a whole number of training targets, such as 1000; it is {num_targets}.")
    if isinstance(hyperparameter, str):
        if hyperparameter != "noise-figure":
            raise ValueError(f"hyperparameter: GREIT takes a number or 'noise-figure', not '{hyperparameter}'.")
        if not (np.isfinite(noise_figure) and noise_figure > 0):
            raise ValueError(f"noise_figure must be positive and finite; it is {noise_figure}.")
    elif not (np.isfinite(hyperparameter) and hyperparameter > 0):
        raise ValueError(f"hyperparameter must be positive and finite; it is {hyperparameter}.")
