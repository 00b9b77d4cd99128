"""Changes of the microphones' gains since the calibration, estimated from the touches of a recording.

A change h_i of the logarithm of gain i adds s_i h_i to the level of microphone i in every frame, where s_i = S_i / (S_i
+ N_i) for the received power S_i and the noise floor N_i. The changes have a normal prior of mean 0 and are the same
throughout a recording. They and the unknowns of all frames are estimated together, by maximum a posteriori. With
residuals r, weights W = 1 / v, derivatives J of the levels with respect to the unknowns of a frame, and S = diag(s),
the normal equations of the changes, from which the unknowns of the frames are eliminated, have the matrix

    A + 1 / deviation²,    A = Σ_f S (W − W J (Jᵀ W J)⁻¹ Jᵀ W) S.

Its inverse is the covariance of the changes given the recording. A single touch reduces it little; touches all over the
skin determine the changes. The changes are applied only if they are significant: if, with the right-hand side b, the
statistic bᵀ A⁺ b is larger than is due to the errors of the decay models.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtrc

from jeit.acoustic.localisation.likelihood import Likelihood
from jeit.acoustic.localisation.localiser import SourceEstimate
from jeit.acoustic.microphones import MicrophoneArray
from jeit.acoustic.surface import longer_side, to_space
from jeit_solvers import inverse_small
from jeit_solvers.engines import as_array, host, on_device, on_host, slopes

# Factors on the standard deviation that are tried in turn. The first is accepted if one source explains half of the
# frames, the others if it explains nearly all of them: one source explains some pairs of touches too if the gains may
# have changed much.
_FACTORS, _HALF, _NEARLY_ALL = (1.0, 2.0, 4.0), 0.5, 0.9
# Maximum number of iterations; change of the logarithms below which the iteration ends.
_ROUNDS, _SETTLED = 4, 0.05
# Side of the square cells in which all frames together have the weight of one, as a fraction of the skin's size: the
# errors of a decay model are alike at neighbouring positions.
_CELL = 0.3
# Probability that changes are significant if the gains have not changed; relative tolerance of the rank of A.
_FALSE_CHANGE, _RANK = 0.01, 1e-8
# Share of its trace that is added to the Fisher matrix of a frame, which is singular where few microphones respond.
_RIDGE = 1e-12


class GainChanges(NamedTuple):
    """Estimated changes of the gains of M microphones.

    **Fields**: `logarithm`: logarithm (M,) of the factor by which the intensities of each microphone have changed, with
    the mean 0; `covariance`: its covariance (M, M).
    """

    logarithm: Float[np.ndarray, " M"]
    covariance: Float[np.ndarray, "M M"]

    def apply(self, microphone_array: MicrophoneArray) -> MicrophoneArray:
        """Return the array with the changed gains, and with the variances of the changes added to its noise."""
        logarithms = on_host(microphone_array.decay).logarithms()
        # The first parameter of a decay model is a factor of the response.
        changed = host.concatenate([logarithms[:1] + self.logarithm, logarithms[1:]])
        relative = np.sqrt(np.asarray(microphone_array.noise.relative) ** 2 + np.diag(self.covariance))
        return eqx.tree_at(
            lambda array: (array.decay, array.noise.relative),
            microphone_array,
            (on_device(type(microphone_array.decay).from_logarithms(changed)), as_array(relative)),
        )


def estimate_gain_changes(
    microphone_array: MicrophoneArray,
    power: Float[np.ndarray, "F M"],
    use: Bool[np.ndarray, "F M"],
    deviation: float,
    locate_frames: Callable[[MicrophoneArray], tuple[SourceEstimate, np.ndarray]],
) -> tuple[GainChanges, ...]:
    """Estimate the changes of the gains since the calibration from the frames that one source explains.

    `power` (F, M): intensities minus the floor of frames with a touch; `use` (F, M): mask of the usable intensities.
    `deviation`: standard deviation of the logarithms of the changes before the recording is considered; it is doubled,
    at most twice, if one source explains too few frames. `locate_frames`: function that locates the source of each
    frame by maximum likelihood with a given array, and also returns the mask (F,) of the frames that one source
    explains.

    Returns the estimate. If one source explains too few frames for an estimate, it returns two possibilities, the
    second of which is the last resort: no changes, and unknown changes with the given standard deviation.
    """
    used = use.any(axis=0).astype(float)
    # A factor common to all gains cannot be distinguished from the strengths of the touches.
    centred = np.diag(used) - np.outer(used, used) / max(used.sum(), 1.0)
    none = GainChanges(np.zeros(len(used)), np.zeros_like(centred))
    if deviation == 0:
        return (none,)
    for factor in _FACTORS:
        changes, explained = _estimate(microphone_array, power, use, factor * deviation * centred, locate_frames)
        if explained >= (_HALF if factor == 1 else _NEARLY_ALL):
            return (changes,)
    return none, none._replace(covariance=deviation**2 * centred)


def _estimate(microphone_array: MicrophoneArray, power, use, scale, locate_frames) -> tuple[GainChanges, float]:
    """Changes of the gains for one standard deviation, and the fraction of the frames that one source explains. `scale`
    (M, M): projection onto changes with the mean 0, times the standard deviation."""
    deviation = np.linalg.norm(scale, 2)
    centred = scale / deviation
    changes, explained = GainChanges(np.zeros(len(scale)), deviation * scale), 0.0
    significant = False
    for _ in range(_ROUNDS):
        found, touch = locate_frames(changes.apply(microphone_array))
        explained = float(np.mean(touch))
        if not touch.any():
            break
        array = _with_known_gains(microphone_array, changes)
        matrix, right = _normal_equations(array, power[touch], use[touch], _unknowns_of_sources(array, found, touch))
        right = right + matrix @ changes.logarithm
        significant = _are_significant(matrix, right)
        covariance = np.linalg.inv(matrix + np.eye(len(scale)) / deviation**2)
        before = changes.logarithm
        changes = GainChanges(centred @ covariance @ right, centred @ covariance @ centred)
        if np.abs(changes.logarithm - before).max() < _SETTLED:
            break
    if not significant:
        # The mean square of the changes about 0, instead of about their estimate.
        logarithm = changes.logarithm
        changes = GainChanges(np.zeros_like(logarithm), changes.covariance + np.outer(logarithm, logarithm))
    return changes, explained


def _are_significant(matrix: np.ndarray, right_hand_side: np.ndarray) -> bool:
    """Whether the changes are larger than is due to the noise and the errors of the decay models."""
    values, vectors = np.linalg.eigh(matrix)
    kept = values > _RANK * values[-1]
    square = (vectors[:, kept].T @ right_hand_side) ** 2 / values[kept]
    return bool(chdtrc(kept.sum(), square.sum()) < _FALSE_CHANGE)


def covariance_with_gains(
    microphone_array: MicrophoneArray,
    power: Float[np.ndarray, "F M"],
    use: Bool[np.ndarray, "F M"],
    found: SourceEstimate,
    changes: GainChanges,
) -> Float[np.ndarray, "F d d"]:
    """Covariance (F, d, d) in m² of the positions of `found`, including the errors of the gains. NaN for frames without
    a position.

    `microphone_array`: the array before `GainChanges.apply`. With the Fisher matrix F of a frame for known gains, the
    derivative of its unknowns with respect to the changes is B = F⁻¹ Jᵀ W S, and their covariance in the joint estimate
    is F⁻¹ + B C Bᵀ for the covariance C of the changes.
    """
    array, unknowns = (
        _with_known_gains(microphone_array, changes),
        _unknowns_of_sources(microphone_array, found, slice(None)),
    )
    known = np.isfinite(unknowns).all(axis=0)
    unknowns = host.where(known, unknowns, 0.0)
    likelihood, jacobian, share, weight = _linearise(array, power, use, unknowns)
    inverse = _inverse_fisher(likelihood.expand(unknowns)[2])
    slope = np.einsum("klf,lmf->kmf", inverse[:2], weight * share * jacobian)
    total = inverse[:2, :2] + host.einsum("kmf,mn,lnf->klf", slope, changes.covariance, slope, optimize=True)
    return np.where(known[:, None, None], to_space(array.surface, unknowns[:2], total)[1], np.nan)


def _with_known_gains(microphone_array: MicrophoneArray, changes: GainChanges) -> MicrophoneArray:
    """The array with the changed gains, in NumPy, and without the variances of the changes."""
    return on_host(changes._replace(covariance=np.zeros_like(changes.covariance)).apply(microphone_array))


def _unknowns_of_sources(
    microphone_array: MicrophoneArray, sources: SourceEstimate, frames
) -> Float[np.ndarray, "3 F"]:
    """Chart coordinates and logarithm of the strength of the sources `sources` in the frames `frames`."""
    chart = on_host(microphone_array.surface).project(np.asarray(sources.position)[frames].T)
    return np.concatenate([chart, np.log(np.asarray(sources.strength))[None, frames]])


def _linearise(array: MicrophoneArray, power, use, unknowns) -> tuple[Likelihood, np.ndarray, np.ndarray, np.ndarray]:
    """Likelihood of the frames, derivatives J (3, M, F) of the levels, shares s (M, F), and weights W (M, F)."""
    use = use.T & (power.T + array.noise.floor[:, None] > 0)
    likelihood = Likelihood.create(power.T, use, array)
    (mean, variance), along = slopes(array.expected, unknowns)
    share = 1 - array.noise.floor[:, None] * np.exp(-mean)
    return likelihood, np.stack([dm for dm, _ in along]), share, np.where(use, 1 / variance, 0.0)


def _normal_equations(array: MicrophoneArray, power, use, unknowns) -> tuple[np.ndarray, np.ndarray]:
    """Matrix (M, M) and right-hand side (M,) of the changes of the gains, without the prior."""
    likelihood, jacobian, share, weight = _linearise(array, power, use, unknowns)
    size = _CELL * float(longer_side(array.surface))
    _, cell, count = np.unique(np.floor(unknowns[:2] / size), axis=1, return_inverse=True, return_counts=True)
    weight = weight / count[cell.ravel()]
    off = likelihood.level - array.expected(unknowns)[0]
    weighted = weight * share
    coupling = weighted * jacobian
    inverse = _inverse_fisher(np.einsum("kmf,lmf->klf", weight * jacobian, jacobian))
    eliminated = np.einsum("klf,lmf->kmf", inverse, coupling)
    matrix = np.diag((weighted * share).sum(axis=1)) - np.einsum("kmf,knf->mn", coupling, eliminated)
    right = (weighted * off).sum(axis=1) - np.einsum("kmf,kf->m", eliminated, (weight * jacobian * off).sum(axis=1))
    return matrix, right


def _inverse_fisher(fisher) -> np.ndarray:
    """Inverses of Fisher matrices (3, 3, F), also of singular ones: their ridge makes them definite."""
    definite = fisher + _RIDGE * np.maximum(np.trace(fisher), 1.0) * np.eye(len(fisher))[:, :, None]
    return np.asarray(inverse_small(definite))
