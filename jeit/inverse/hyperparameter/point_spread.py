"""Point spread: how wide the image of a single cell is, and the hyperparameter that makes it narrowest."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import KDTree
from scipy.special import ndtr

from jeit.inverse.hyperparameter.choice import Choice
from jeit.inverse.spectrum import Spectrum
from jeit.mesh import Mesh, centroids, measures
from jeit_solvers.engines import adjoint


def best_resolution(
    spectrum: Spectrum,
    data: ArrayLike | None,
    mesh: Mesh | None,
    *,
    signal_to_noise: float = 1.0,
    num_targets: int = 30,
) -> Choice:
    """λ whose point spread functions have the least blur radius, averaged over targets spread through the body.

    Without noise the least λ would always be sharpest, so the images of the targets are noisy: each target is strong
    enough to make the root mean square of its data `signal_to_noise` times the noise. No data are used, so that λ
    depends on the system and not on the frame: what Graham and Adler, Physiol. Meas. 27 (2006) S65-S79, find by
    calibration on a small target in a tank. Criterion: the mean of `blur_radius` over the targets, relative to the size
    of the body. Raises `ValueError` without a mesh, and for settings that are not positive.
    """
    if mesh is None:
        raise ValueError("The rule 'best-resolution' measures areas: give the mesh that the spectrum belongs to.")
    if not signal_to_noise > 0 or num_targets < 1:
        raise ValueError(
            "signal_to_noise and num_targets must be positive, and there must be at least one target; they are "
            f"{signal_to_noise} and {num_targets}."
        )
    candidates = spectrum.candidates()[::4]
    radius = blur_radius(spectrum, mesh, spread_cells(mesh, num_targets), candidates, signal_to_noise=signal_to_noise)
    mean = radius.mean(axis=1)
    return Choice.among(
        "best-resolution", candidates, int(np.argmin(mean)), mean, spectrum.curves(data, candidates), target=None
    )


def blur_radius(
    spectrum: Spectrum,
    mesh: Mesh,
    targets: Int[np.ndarray, " T"],
    candidates: Float[np.ndarray, " K"],
    *,
    signal_to_noise: float = 1.0,
) -> Float[np.ndarray, "K T"]:
    """Blur radius of the noisy image of every target cell for every candidate λ, relative to the size of the body.

    √(A/A₀) (3-D: the cube root), A₀ the area (volume) of the body and A that of the half-amplitude set: the cells where
    the image reaches half of what it has *at the target*. (Half of the image's own peak, as in Adler and Guardo, IEEE
    Trans. Med. Imaging 15 (1996) 170-179, would call an image sharp that has a narrow peak elsewhere.) A is the
    expected one over white noise of variance one in the data: with target image p = R_λJ_t of strength s, and noise of
    variance (RRᵀ)_ii, cell i belongs to the set with probability Φ(s (p_i - p_t/2) / √(RRᵀ)_ii).
    """
    area = np.asarray(measures(mesh))
    eigenvalues, modes = np.asarray(spectrum.eigenvalues), np.asarray(spectrum.modes())
    signals = np.asarray(spectrum.directions) @ np.asarray(spectrum.reduced)[:, targets]
    size = np.linalg.norm(signals, axis=0)
    strength = signal_to_noise * np.sqrt(len(signals)) / np.maximum(size, np.finfo(float).tiny)
    components = adjoint(np.asarray(spectrum.basis)) @ signals
    # Data in the range of the null space are imaged whatever λ is.
    free = np.asarray(spectrum.null_space) @ np.linalg.pinv(np.asarray(spectrum.seen))
    fixed, fixed_variance = free @ signals, np.sum(abs(free) ** 2, axis=1)
    damping = 1 / (eigenvalues + np.asarray(candidates)[:, None] ** 2)
    variance = damping**2 @ (abs(modes) ** 2).T + fixed_variance
    covered = np.empty((len(candidates), len(targets)))
    for k in range(len(candidates)):
        image = np.real(modes @ (damping[k][:, None] * components) + fixed)
        above = image - image[targets, np.arange(len(targets))] / 2
        covered[k] = area @ ndtr(strength * above / np.sqrt(variance[k])[:, None])
    return (covered / area.sum()) ** (1 / mesh.dimension)


def spread_cells(mesh: Mesh, number: int) -> Int[np.ndarray, " T"]:
    """About `number` cells, spread evenly through the body: those nearest to the points of a regular lattice in it."""
    centre, size = np.asarray(centroids(mesh)), np.asarray(measures(mesh))
    low, high = np.asarray(mesh.points).min(axis=0), np.asarray(mesh.points).max(axis=0)
    spacing = (size.sum() / number) ** (1 / mesh.dimension)
    counts = np.maximum(np.round((high - low) / spacing).astype(int), 1)
    steps = [a + (np.arange(n) + 0.5) * (b - a) / n for a, b, n in zip(low, high, counts, strict=True)]
    lattice = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, mesh.space_dimension)
    distance, nearest = (np.asarray(found) for found in KDTree(centre).query(lattice))
    # A surface in space passes between the points of a lattice.
    inside = distance <= (spacing / 2 if mesh.is_surface else size[nearest] ** (1 / mesh.dimension))
    return np.unique(nearest[inside] if inside.any() else nearest)
