"""GREIT: a reconstruction matrix trained on small targets, so that each is imaged as a smooth disc of the same size.

Adler et al., "GREIT: a unified approach to 2D linear EIT reconstruction of lung images", Physiol. Meas. 30 (2009)
S35-S55. The paper treats a disk; here bodies of any outline are allowed, and targets in a solid body are balls.
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

# Half width of the edge of a desired image, relative to its radius.
_EDGE_HALF_WIDTH = 0.25
# Sampling points along the radius of a target, by dimension: about 50 points in a disc, about 60 in a ball.
_SAMPLES_PER_RADIUS = {2: 4.0, 3: 2.5}
# Number of sampling points processed at a time; search distance around the centre of a ball, in radii, slightly above 1
# so that rounding excludes no point of the ball.
_SAMPLES_AT_ONCE, _SEARCH_RADII = 500_000, 1 + 1e-9
# Minimum fraction of a training target that must lie in the body.
_MIN_INSIDE_FRACTION = 0.9
# Approximate number of cells over which means for the noise figure are taken.
_NUM_MEAN_CELLS = 10_000
# Minimum target radius: smaller targets give the same result in a linear model but need more sampling points.
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

    The training targets are small discs (3-D: balls) on a hexagonal (3-D: cubic) grid over the body. Y holds their
    responses to a unit change of conductivity (S/m; 2-D: S), computed **from the Jacobian**. They are exact for small
    changes; as in any linear image, the contrast of large changes is underestimated. X holds the desired images: discs
    of one radius with a smooth edge, cut off at the body's outline, each with the same integral as its target. X and Y
    are divided by √(number of targets).

    **Arguments:**

    - `model`: the forward model.
    - `conductivity`: the background, S/m (2-D: S).
    - `radius`, `target_radius`: radii of the desired images and of the targets, as fractions of the body's radius,
      which is that of the disc of equal area (3-D: ball of equal volume). Default `radius` 1/√L, 0.25 for 16
      electrodes; a smaller radius improves resolution but increases ringing and noise.
    - `hyperparameter`: λ, or "noise-figure" for the λ at which the signal-to-noise ratio of the data is `noise_figure`
      times that of the image, for a target in the middle of the body.
    - `noise_figure`: the default 0.5 is the value agreed on by GREIT's authors. The signal is the mean absolute value,
      over channels in units of their noise or over the body; the noise is the root mean square standard deviation.
    - `noise`: standard deviation of the channels, W = noise⁻²; one number or (M,), in volts (or relative to each
      other).
    - `mask` (M,): True for the channels to use.
    - `num_targets`: number of targets, approximately.

    Raises `ValueError` for arguments that do not fit together, and for a noise figure that no λ reaches.

    **Example:**

    ```python
    image = greit(model, 1.0, num_targets=200).image(change)
    ```
    """
    check_model(model)
    instead = (
        "work it out once outside: its image() is what JAX transforms; or take one_step, which can be differentiated"
    )
    check_has_values("model, conductivity or noise", (model, conductivity, noise), "GREIT is trained on", instead)
    mesh = model.mesh
    check_flat(mesh, "GREIT's targets")
    radius = float(model.electrodes.num_electrodes**-0.5) if radius is None else radius
    _check_options(radius, target_radius, num_targets, hyperparameter, noise_figure)
    channels, root_weight = used_channels(model, noise, mask)
    if jnp.iscomplexobj(conductivity):
        raise ValueError("conductivity is complex; linear images are of real ones: give its real part.")
    if np.shape(conductivity) not in ((), (mesh.num_cells,)):
        raise ValueError("conductivity: give one number, or one value per cell: the image has a value per cell.")
    measure, centre = np.asarray(measures(mesh)), np.asarray(centroids(mesh))
    body_radius, middle = _ball_radius(float(measure.sum()), mesh.dimension), measure @ centre / measure.sum()
    position, covered = _place_targets(mesh, middle, target_radius * body_radius, num_targets)
    desired = _desired_images(mesh, position, covered.T @ measure, radius * body_radius)
    # Responses are computed for the directions in which a body can change the data; they are fewer than the channels.
    directions = data_directions(model.protocol, channels, root_weight)
    weighted = directions.T * np.asarray(root_weight)  # (r, K)
    response, shares = np.zeros((len(weighted), len(position))), covered.tocsr()
    for cells, block in combined_blocks(model, conductivity, channels, weighted):
        response += (shares[cells].T @ block.T).T / np.sqrt(len(position))
    eigenvalues, vectors = np.linalg.eigh(response @ response.T)
    eigenvalues = np.maximum(eigenvalues, 0)
    painted = desired @ (response.T @ vectors) / np.sqrt(len(position))
    if isinstance(hyperparameter, str):
        central = response[:, np.argmin(np.linalg.norm(position - middle, axis=1))]
        level = float(np.abs(directions @ central).mean())
        some = slice(None, None, max(1, len(measure) // _NUM_MEAN_CELLS))
        signal = vectors.T @ central
        chosen = greit_noise_figure(noise_figure, eigenvalues, signal, level, painted[some], measure[some])
    else:
        chosen = float(hyperparameter)
    weights = np.zeros((len(eigenvalues), model.protocol.num_measurements))
    weights[:, channels] = (vectors / (eigenvalues + chosen**2)).T @ directions.T * root_weight
    rule = "noise-figure" if isinstance(hyperparameter, str) else "given"
    return LinearReconstruction.of_factors(model, (painted, weights), chosen, rule, "GREIT")


def _ball_radius(measure: float, dimension: int) -> float:
    """Radius of the disc of a given area or the ball of a given volume."""
    return float(np.sqrt(measure / np.pi) if dimension == 2 else np.cbrt(3 * measure / (4 * np.pi)))


def _ball_measure(radius: float, dimension: int) -> float:
    """Area of a disc or volume of a ball."""
    return np.pi * radius**2 if dimension == 2 else 4 / 3 * np.pi * radius**3


def _place_targets(mesh: Mesh, middle, radius: float, num_targets: int) -> tuple[np.ndarray, scipy.sparse.csc_array]:
    """Centres (K, d) of the targets that lie in the body, and the fraction (m, K) of every cell that each covers."""
    measure, points = np.asarray(measures(mesh)), np.asarray(mesh.points)
    low, high = points.min(axis=0), points.max(axis=0)
    if mesh.dimension == 2:
        spacing = np.sqrt(2 / np.sqrt(3) * measure.sum() / num_targets)
        grid = _hexagonal_lattice(low, high, middle, spacing)
    else:
        spacing = np.cbrt(measure.sum() / num_targets)
        grid = _cubic_lattice(low, high, middle, spacing)
    tree, parts = KDTree(grid), []
    for samples, cell, share in _sample_points(mesh, radius / _SAMPLES_PER_RADIUS[mesh.dimension]):
        if mesh.dimension == 3:
            place = (samples - middle) / spacing
            place -= np.rint(place)  # offset from the nearest centre; only part of the points lie within a ball
            near = np.flatnonzero(np.einsum("qi,qi->q", place, place) < (_SEARCH_RADII * radius / spacing) ** 2)
            samples, cell, share = samples[near], cell[near], share[near]
        pairs = tree.sparse_distance_matrix(KDTree(samples), radius, output_type="ndarray")
        parts.append((share[pairs["j"]], cell[pairs["j"]], pairs["i"]))
    shares, cells, targets = (np.concatenate(part) for part in zip(*parts, strict=True))
    covered = scipy.sparse.coo_array((shares, (cells, targets)), shape=(mesh.num_cells, len(grid))).tocsc()
    inside = np.flatnonzero(covered.T @ measure > _MIN_INSIDE_FRACTION * _ball_measure(radius, mesh.dimension))
    if inside.size == 0:
        raise ValueError(
            f"target_radius: no {'disc' if mesh.dimension == 2 else 'ball'} of {1e3 * radius:.3g} mm radius fits into "
            "this body; give a smaller one, or more targets."
        )
    return grid[inside], covered[:, inside]


def _hexagonal_lattice(low, high, middle, spacing: float) -> np.ndarray:
    """Points (k, 2) of a hexagonal grid with a point at `middle` that covers the box from `low` to `high`."""
    step = spacing * np.array([1, np.sqrt(0.75)])
    (first, bottom), (last, top) = np.floor((low - middle) / step) - 1, np.ceil((high - middle) / step) + 1
    row, column = np.meshgrid(np.arange(bottom, top + 1), np.arange(first, last + 1), indexing="ij")
    return middle + step * np.stack([column + row % 2 / 2, row], axis=-1).reshape(-1, 2)


def _cubic_lattice(low, high, middle, spacing: float) -> np.ndarray:
    """Points (k, 3) of a cubic grid with a point at `middle` that covers the box from `low` to `high`."""
    first, last = np.floor((low - middle) / spacing) - 1, np.ceil((high - middle) / spacing) + 1
    steps = [np.arange(a, b + 1) for a, b in zip(first, last, strict=True)]
    return middle + spacing * np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)


def _sample_points(mesh: Mesh, spacing: float) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Iterate over groups of cells, and yield sampling points (q, d) spread evenly over each cell, their cells, and the
    fraction of the cell that each point represents.

    Points are about `spacing` apart. Each side of a triangle is divided into n parts, and the points are the centres
    of the upright small triangles, with barycentric coordinates (i + 1/3, j + 1/3, k + 1/3) / n, i + j + k = n - 1.
    Tetrahedra are treated likewise.
    """
    corners = np.asarray(mesh.points)[np.asarray(mesh.cells)]
    count = corners.shape[1]
    longest = np.max(
        [np.linalg.norm(corners[:, i] - corners[:, j], axis=1) for i, j in combinations(range(count), 2)], 0
    )
    cuts = np.maximum(np.ceil(longest / spacing), 1).astype(int)
    for number in np.unique(cuts):
        steps = np.stack(np.meshgrid(*[np.arange(number)] * (count - 1)), axis=-1).reshape(-1, count - 1)
        steps = steps[steps.sum(axis=1) < number]
        barycentric = (np.column_stack([steps, number - 1 - steps.sum(axis=1)]) + 1 / count) / number
        alike = np.flatnonzero(cuts == number)
        for cells in np.array_split(alike, -(-alike.size * len(steps) // _SAMPLES_AT_ONCE)):
            samples = (barycentric @ corners[cells]).reshape(-1, corners.shape[2])
            yield samples, np.repeat(cells, len(steps)), np.full(len(samples), 1 / len(steps))


def _desired_images(mesh: Mesh, position, area, radius: float) -> scipy.sparse.csc_array:
    """Desired images X (m, K): a disc around each position, with half its height at `radius` and the integral `area`
    (K,) over the body."""
    measure, centre = np.asarray(measures(mesh)), np.asarray(centroids(mesh))
    pairs = KDTree(centre).sparse_distance_matrix(
        KDTree(position), (1 + _EDGE_HALF_WIDTH) * radius, output_type="ndarray"
    )
    ramp = np.clip((pairs["v"] / radius - 1) / _EDGE_HALF_WIDTH, -1, 1)
    height = (1 - np.sin(0.5 * np.pi * ramp)) / 2
    disc = scipy.sparse.coo_array((height, (pairs["i"], pairs["j"])), shape=(len(centre), len(position))).tocsc()
    total = disc.T @ measure
    if not (total > 0.01 * _ball_measure(radius, mesh.dimension)).all():
        raise ValueError(
            f"radius: a desired image of {1e3 * radius:.3g} mm radius is lost between the cells of this mesh; give a "
            "larger radius, or a finer mesh."
        )
    return disc @ scipy.sparse.diags_array(area / total)


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
