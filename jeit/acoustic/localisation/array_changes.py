"""Changes of the microphones since the calibration, estimated from the touches of a recording: changed gains, exchanged
microphones, and microphones whose response has changed.

A change h_i of the logarithm of gain i adds s_i h_i to the level of microphone i in every frame, where s_i = S_i / (S_i
+ N_i) for the received power S_i and the noise floor N_i. The changes have a normal prior of mean 0 and standard
deviation `deviation`, and are the same throughout a recording. The changes and the unknowns of all frames f are
estimated together, by maximum a posteriori. Let J be the derivatives of the levels with respect to the unknowns of a
frame, W = 1 / v the weights of levels with the variances v, and S = diag(s). After elimination of the unknowns of the
frames, the normal equations of the changes have the matrix

    A + 1 / deviation²,    A = Σ_f S (W − W J (Jᵀ W J)⁻¹ Jᵀ W) S.

The inverse of this matrix is the covariance of the changes given the recording. A single touch reduces the covariance
little; touches all over the skin determine the changes. The changes are applied only if they are significant: for the
right-hand side b of the equations, bᵀ A⁺ b must exceed the value that errors of the decay models alone explain.

The search for exchanged and altered microphones compares the misfits of located touches.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtrc

from jeit.acoustic.localisation.likelihood import Likelihood
from jeit.acoustic.localisation.localiser import Localiser, SourceEstimate
from jeit.acoustic.microphones import MicrophoneArray
from jeit.acoustic.surface import longer_side, to_three_dimensions
from jeit_solvers import inverse_small
from jeit_solvers.engines import as_array, host, on_device, on_host, slopes

# Factors on the prior standard deviation of the changes, which are tried in turn. The first factor is accepted if one
# source explains half of the frames. The other factors are accepted only if one source explains nearly all frames,
# since large changes of the gains let one source explain some pairs of touches too.
_PRIOR_DEVIATION_FACTORS, _MIN_EXPLAINED_BY_FIRST_FACTOR, _MIN_EXPLAINED_BY_LATER_FACTORS = (1.0, 2.0, 4.0), 0.5, 0.9
# Maximum number of iterations of the estimate.
_MAX_GAIN_ITERATIONS = 4
# Change of the estimated logarithms below which the iteration ends.
_CONVERGENCE_TOLERANCE = 0.05
# Side of square cells of the skin, as a fraction of the skin's size. All frames with positions in one cell together
# have the weight of one frame, since the errors of a decay model are similar at neighbouring positions.
_RELATIVE_CELL_SIZE = 0.3
# Probability that estimated changes are significant although the gains have not changed.
_FALSE_ALARM_PROBABILITY = 0.01
# Relative tolerance of the rank of A.
_RANK_TOLERANCE = 1e-8
# Fraction of the trace of a frame's Fisher matrix that is added to the diagonal of this matrix, which is singular where
# few microphones respond.
_RELATIVE_REGULARISATION = 1e-12
# Number of the loudest frames, in which changes of the setup are searched for.
_NUM_SEARCHED_FRAMES = 24
# Misfit per degree of freedom above which the search begins.
_SEARCH_MISFIT = 3.0
# Value at which the misfit per degree of freedom is clipped.
_CLIPPING_MISFIT = 100.0
# Maximum ratio of the misfits after and before an accepted change.
_MAX_MISFIT_RATIO = 0.7
# Maximum number of changes of the setup that are searched for.
_MAX_SETUP_CHANGES = 4
# Leaving out one microphone is a candidate change only if more than this number of microphones are in no accepted
# change.
_MIN_UNCHANGED_MICROPHONES = 5


class GainChanges(NamedTuple):
    """Estimated changes of the gains of M microphones.

    **Fields**: `logarithm`: logarithm (M,) of the factor by which the intensities of each microphone have changed, with
    the mean 0; `covariance`: covariance (M, M) of `logarithm`.
    """

    logarithm: Float[np.ndarray, " M"]
    covariance: Float[np.ndarray, "M M"]

    def apply(self, microphone_array: MicrophoneArray) -> MicrophoneArray:
        """Return the array with the changed gains, and with the variances of the changes added to its squared relative
        errors."""
        decay_logarithms = on_host(microphone_array.decay).logarithms()
        # The first parameter of a decay model is a factor of the response.
        changed_logarithms = host.concatenate([decay_logarithms[:1] + self.logarithm, decay_logarithms[1:]])
        relative_error = np.sqrt(np.asarray(microphone_array.noise.relative) ** 2 + np.diag(self.covariance))
        return eqx.tree_at(
            lambda array_to_change: (array_to_change.decay, array_to_change.noise.relative),
            microphone_array,
            (on_device(type(microphone_array.decay).from_logarithms(changed_logarithms)), as_array(relative_error)),
        )


def estimate_gain_changes(
    microphone_array: MicrophoneArray,
    power: Float[np.ndarray, "F M"],
    use: Bool[np.ndarray, "F M"],
    deviation: float,
    locate_frames: Callable[[MicrophoneArray], tuple[SourceEstimate, np.ndarray]],
) -> tuple[GainChanges, ...]:
    """Estimate the changes of the microphones' gains since the calibration from the frames that one source explains.

    `power` (F, M): intensities minus the floor of frames with a touch; `use` (F, M): mask of the usable intensities.
    `deviation`: prior standard deviation of the logarithms of the changes, which is doubled, at most twice, if one
    source explains too few frames. `locate_frames`: function that locates the source of each frame by maximum
    likelihood with a given microphone array, and also returns the mask (F,) of the frames that one source explains.

    Returns a tuple with the estimated changes. If one source explains too few frames for an estimate, the tuple has two
    alternatives, to be tried in turn: no changes, and unknown changes with the standard deviation `deviation`.
    """
    used_mask = use.any(axis=0).astype(float)
    # A factor common to all gains cannot be distinguished from the strengths of the touches.
    centring_matrix = np.diag(used_mask) - np.outer(used_mask, used_mask) / max(used_mask.sum(), 1.0)
    zero_changes = GainChanges(np.zeros(len(used_mask)), np.zeros_like(centring_matrix))
    if deviation == 0:
        return (zero_changes,)
    for prior_deviation_factor in _PRIOR_DEVIATION_FACTORS:
        gain_changes, explained_share = _estimate_gain_changes(
            microphone_array, power, use, prior_deviation_factor * deviation * centring_matrix, locate_frames
        )
        if explained_share >= (
            _MIN_EXPLAINED_BY_FIRST_FACTOR if prior_deviation_factor == 1 else _MIN_EXPLAINED_BY_LATER_FACTORS
        ):
            return (gain_changes,)
    return zero_changes, zero_changes._replace(covariance=deviation**2 * centring_matrix)


def _estimate_gain_changes(
    microphone_array: MicrophoneArray, power, is_used_reading, prior_scale, locate_frames
) -> tuple[GainChanges, float]:
    """Estimate the changes of the gains for one prior standard deviation, and the fraction of the frames that one
    source explains. `prior_scale` (M, M): projection onto changes with the mean 0, times the prior standard
    deviation."""
    prior_deviation = np.linalg.norm(prior_scale, 2)
    centring_matrix = prior_scale / prior_deviation
    gain_changes, explained_share = GainChanges(np.zeros(len(prior_scale)), prior_deviation * prior_scale), 0.0
    are_changes_significant = False
    for _ in range(_MAX_GAIN_ITERATIONS):
        source_estimates, is_explained_frame = locate_frames(gain_changes.apply(microphone_array))
        explained_share = float(np.mean(is_explained_frame))
        if not is_explained_frame.any():
            break
        array_with_changes = _set_gains_without_uncertainty(microphone_array, gain_changes)
        normal_matrix, right_hand_side = _normal_equations(
            array_with_changes,
            power[is_explained_frame],
            is_used_reading[is_explained_frame],
            _unknowns_of_sources(array_with_changes, source_estimates, is_explained_frame),
        )
        right_hand_side = right_hand_side + normal_matrix @ gain_changes.logarithm
        are_changes_significant = _are_significant(normal_matrix, right_hand_side)
        gain_covariance = np.linalg.inv(normal_matrix + np.eye(len(prior_scale)) / prior_deviation**2)
        previous_logarithm = gain_changes.logarithm
        gain_changes = GainChanges(
            centring_matrix @ gain_covariance @ right_hand_side, centring_matrix @ gain_covariance @ centring_matrix
        )
        if np.abs(gain_changes.logarithm - previous_logarithm).max() < _CONVERGENCE_TOLERANCE:
            break
    if not are_changes_significant:
        # The covariance becomes the mean square of the changes about 0, instead of about their estimate.
        log_gain_change = gain_changes.logarithm
        gain_changes = GainChanges(
            np.zeros_like(log_gain_change), gain_changes.covariance + np.outer(log_gain_change, log_gain_change)
        )
    return gain_changes, explained_share


def _are_significant(normal_matrix: np.ndarray, right_hand_side: np.ndarray) -> bool:
    """Test whether the changes of the gains are larger than noise and errors of the decay models alone explain."""
    eigenvalues, eigenvectors = np.linalg.eigh(normal_matrix)
    is_determined_component = eigenvalues > _RANK_TOLERANCE * eigenvalues[-1]
    squared_components = (eigenvectors[:, is_determined_component].T @ right_hand_side) ** 2 / eigenvalues[
        is_determined_component
    ]
    return bool(chdtrc(is_determined_component.sum(), squared_components.sum()) < _FALSE_ALARM_PROBABILITY)


def covariance_with_gains(
    microphone_array: MicrophoneArray,
    power: Float[np.ndarray, "F M"],
    use: Bool[np.ndarray, "F M"],
    sources: SourceEstimate,
    changes: GainChanges,
) -> Float[np.ndarray, "F d d"]:
    """Covariance (F, d, d) in m² of the positions of `sources`, including the effect of errors of the gains; NaN for
    frames without a position.

    `microphone_array`: the array before `GainChanges.apply`. Let F be the Fisher matrix of a frame for known gains, and
    C the covariance of the changes. The derivative of the frame's unknowns with respect to the gain changes is B = F⁻¹
    Jᵀ W S, and the covariance of the unknowns is F⁻¹ + B C Bᵀ.
    """
    array_with_changes, source_unknowns = (
        _set_gains_without_uncertainty(microphone_array, changes),
        _unknowns_of_sources(microphone_array, sources, slice(None)),
    )
    has_position = np.isfinite(source_unknowns).all(axis=0)
    source_unknowns = host.where(has_position, source_unknowns, 0.0)
    likelihood, jacobian, signal_share, level_weights = _linearise_levels(
        array_with_changes, power, use, source_unknowns
    )
    inverse_fisher = _inverse_fisher(likelihood.expand(source_unknowns)[2])
    gain_derivatives = np.einsum("klf,lmf->kmf", inverse_fisher[:2], level_weights * signal_share * jacobian)
    total_covariance = inverse_fisher[:2, :2] + host.einsum(
        "kmf,mn,lnf->klf", gain_derivatives, changes.covariance, gain_derivatives, optimize=True
    )
    return np.where(
        has_position[:, None, None],
        to_three_dimensions(array_with_changes.surface, source_unknowns[:2], total_covariance)[1],
        np.nan,
    )


def _set_gains_without_uncertainty(microphone_array: MicrophoneArray, gain_changes: GainChanges) -> MicrophoneArray:
    """Return the microphone array in NumPy arrays, with the changed gains but without the variances of the changes in
    its noise."""
    return on_host(gain_changes._replace(covariance=np.zeros_like(gain_changes.covariance)).apply(microphone_array))


def _unknowns_of_sources(
    microphone_array: MicrophoneArray, source_estimates: SourceEstimate, frame_indices
) -> Float[np.ndarray, "3 F"]:
    """Chart coordinates and logarithmic strengths of `source_estimates` in the frames with the indices or mask
    `frame_indices`."""
    chart_positions = on_host(microphone_array.surface).project(np.asarray(source_estimates.position)[frame_indices].T)
    return np.concatenate([chart_positions, np.log(np.asarray(source_estimates.strength))[None, frame_indices]])


def _linearise_levels(
    microphone_array: MicrophoneArray, power, is_used_reading, source_unknowns
) -> tuple[Likelihood, np.ndarray, np.ndarray, np.ndarray]:
    """Compute the likelihood of the frames, the derivatives J (3, M, F) of the levels with respect to the unknowns, the
    shares s = S / (S + N) (M, F) of the source in the power, and the weights W (M, F)."""
    is_used_reading = is_used_reading.T & (power.T + microphone_array.noise.floor[:, None] > 0)
    likelihood = Likelihood.create(power.T, is_used_reading, microphone_array)
    (expected_levels, level_variance), level_derivatives = slopes(microphone_array.expected, source_unknowns)
    signal_share = 1 - microphone_array.noise.floor[:, None] * np.exp(-expected_levels)
    return (
        likelihood,
        np.stack([dm for dm, _ in level_derivatives]),
        signal_share,
        np.where(is_used_reading, 1 / level_variance, 0.0),
    )


def _normal_equations(
    microphone_array: MicrophoneArray, power, is_used_reading, source_unknowns
) -> tuple[np.ndarray, np.ndarray]:
    """Matrix A (M, M) and right-hand side b (M,) of the normal equations of the gain changes, without the prior."""
    likelihood, jacobian, signal_share, level_weights = _linearise_levels(
        microphone_array, power, is_used_reading, source_unknowns
    )
    cell_size = _RELATIVE_CELL_SIZE * float(longer_side(microphone_array.surface))
    _, cell_indices, frames_per_cell = np.unique(
        np.floor(source_unknowns[:2] / cell_size), axis=1, return_inverse=True, return_counts=True
    )
    level_weights = level_weights / frames_per_cell[cell_indices.ravel()]
    level_residual = likelihood.level - microphone_array.expected(source_unknowns)[0]
    signal_weights = level_weights * signal_share
    source_coupling = signal_weights * jacobian
    inverse_fisher = _inverse_fisher(np.einsum("kmf,lmf->klf", level_weights * jacobian, jacobian))
    source_response = np.einsum("klf,lmf->kmf", inverse_fisher, source_coupling)
    normal_matrix = np.diag((signal_weights * signal_share).sum(axis=1)) - np.einsum(
        "kmf,knf->mn", source_coupling, source_response
    )
    right_hand_side = (signal_weights * level_residual).sum(axis=1) - np.einsum(
        "kmf,kf->m", source_response, (level_weights * jacobian * level_residual).sum(axis=1)
    )
    return normal_matrix, right_hand_side


def _inverse_fisher(fisher) -> np.ndarray:
    """Inverses (3, 3, F) of the Fisher matrices of F frames. A ridge makes singular matrices definite."""
    regularised_fisher = (
        fisher + _RELATIVE_REGULARISATION * np.maximum(np.trace(fisher), 1.0) * np.eye(len(fisher))[:, :, None]
    )
    return np.asarray(inverse_small(regularised_fisher))


class SetupChanges(NamedTuple):
    """Changes of the setup since the calibration.

    **Fields**: `exchanged_pairs`: pairs of indices of exchanged microphones; `altered_microphones`: indices of
    microphones whose response has changed.
    """

    exchanged_pairs: list[tuple[int, int]]
    altered_microphones: list[int]


def find_setup_changes(
    microphone_array: MicrophoneArray, power: Float[np.ndarray, "F M"], use: Bool[np.ndarray, "F M"]
) -> SetupChanges:
    """Find changes of the setup that explain the misfit of touches: with the microphones exchanged back, or left out,
    one source explains the frames.

    `power` (F, M): intensities minus the noise floor of frames with a touch; `use` (F, M): mask of the usable
    intensities. Only the loudest frames are used. The search is greedy: it repeatedly accepts the change that lowers
    the misfit most, so it finds several changes only if each change alone lowers the misfit. No changes are returned
    for fewer than three frames, if one source explains the frames without a change, or if no change explains the
    misfit.
    """
    loudest_frames = np.argsort(-np.where(use, power, 0.0).sum(axis=1))[:_NUM_SEARCHED_FRAMES]
    setup_changes = SetupChanges([], [])
    if len(loudest_frames) < 3:
        return setup_changes
    loudest_frames = loudest_frames[np.arange(_NUM_SEARCHED_FRAMES) % len(loudest_frames)]
    power, use = np.where(use, power, 0.0)[loudest_frames], use[loudest_frames]
    localiser = Localiser.create(microphone_array)

    def mean_misfit(channel_states: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """Mean misfit per degree of freedom for each candidate change, given by the order and the mask of the
        channels."""
        source_estimates = localiser(
            np.concatenate([power[:, channel_order] for channel_order, _ in channel_states]),
            np.concatenate(
                [use[:, channel_order] & is_channel_used for channel_order, is_channel_used in channel_states]
            ),
        )
        misfit_ratios = np.asarray(source_estimates.misfit) / np.maximum(np.asarray(source_estimates.freedom), 1)
        return (
            np.minimum(np.nan_to_num(misfit_ratios, nan=_CLIPPING_MISFIT), _CLIPPING_MISFIT)
            .reshape(len(channel_states), -1)
            .mean(axis=1)
        )

    channel_state = np.arange(power.shape[1]), np.ones(power.shape[1], bool)
    current_misfit = float(mean_misfit([channel_state])[0])
    remaining_channels = np.flatnonzero(use.any(axis=0))
    while (
        current_misfit > _SEARCH_MISFIT
        and len(setup_changes.exchanged_pairs) + len(setup_changes.altered_microphones) < _MAX_SETUP_CHANGES
        and remaining_channels.size
    ):
        # Altered microphones come first among the candidate changes, since exchanging an altered microphone may lower
        # the misfit too.
        single_channel_candidates = [
            (int(k),) for k in remaining_channels if remaining_channels.size > _MIN_UNCHANGED_MICROPHONES
        ]
        candidate_changes = single_channel_candidates + [
            (int(k), int(m)) for k, m in combinations(remaining_channels, 2)
        ]
        candidate_states = [_apply_change(channel_state, changed_channels) for changed_channels in candidate_changes]
        candidate_misfits = mean_misfit(candidate_states)
        best_candidate = int(candidate_misfits.argmin())
        if not candidate_misfits[best_candidate] < _MAX_MISFIT_RATIO * current_misfit:
            break
        current_misfit, channel_state = float(candidate_misfits[best_candidate]), candidate_states[best_candidate]
        changed_channels = candidate_changes[best_candidate]
        if len(changed_channels) == 2:
            setup_changes.exchanged_pairs.append((changed_channels[0], changed_channels[1]))
        else:
            setup_changes.altered_microphones.append(changed_channels[0])
        remaining_channels = remaining_channels[~np.isin(remaining_channels, changed_channels)]
    return setup_changes if current_misfit <= _SEARCH_MISFIT else SetupChanges([], [])


def _apply_change(
    channel_state: tuple[np.ndarray, np.ndarray], changed_channels: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the order and the mask of the microphones' channels after exchanging two channels, or leaving out one
    channel."""
    channel_order, is_channel_used = (state_array.copy() for state_array in channel_state)
    if len(changed_channels) == 2:
        channel_order[list(changed_channels)] = channel_order[list(changed_channels[::-1])]
    else:
        is_channel_used[changed_channels[0]] = False
    return channel_order, is_channel_used
