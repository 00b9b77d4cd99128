"""Joint model of the measurement channels of a skin: detects dead channels, predicts their readings, and rates how
unlike the training set a frame is.

The voltage changes d of a skin's channels are modelled as d = s (V z + n), with the scale s of each channel, a few
patterns V (principal directions of the channels), the scores z of the patterns, and noise n; z and n are normally
distributed. The scores of a frame with missing channels are estimated by their most likely values. A channel is dead if
its residual, the deviation from the prediction by the other channels, exceeds a multiple of the residuals of training
presses. The reading of a dead channel is predicted from the covariance of all channels, which represents relations that
the patterns omit: for example, reciprocal channels have the same reading.

The novelty of a frame includes its distance from the nearest press of the training set: the frame of two simultaneous
touches, or of a touch of the opposite sign, consists of the same patterns as the recorded presses, but is unlike every
press.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

# Number of channel patterns whose scores are compared; maximum number of presses stored. Distances are divided by the
# norm of the frame's scores plus this fraction of the presses' median norm.
_NUM_SCORES, _MAX_STORED_PRESSES, _NORM_OFFSET_FRACTION = 8, 4000, 0.5
_USUAL_NOVELTY_QUANTILE = 0.99


@dataclass(frozen=True)
class Neighbourhood:
    """Distances of frames from the nearest press of the training set, computed from the scores of the leading channel
    patterns.

    `scores` (presses, patterns): scores of the presses for the leading patterns; `size`: median norm of these scores;
    `usual`: the 99 % quantile of the distance of a press from the nearest other press. Distances are divided by the
    norm of the frame's scores plus a fraction of `size`.
    """

    scores: Float[np.ndarray, "N k"]
    size: float
    usual: float

    @classmethod
    def learn(cls, scores: Float[np.ndarray, "N K"]) -> "Neighbourhood":
        """Determine the median norm and the usual distance of the scores (presses, patterns) of training presses."""
        stored_scores = scores[:: -(-len(scores) // _MAX_STORED_PRESSES), :_NUM_SCORES]
        median_norm = float(np.median(np.linalg.norm(stored_scores, axis=1))) or 1.0
        unscaled_neighbourhood = cls(stored_scores, median_norm, 1.0)
        distances = unscaled_neighbourhood._relative_distances(stored_scores, excludes_nearest=True)
        return cls(stored_scores, median_norm, max(float(np.quantile(distances, _USUAL_NOVELTY_QUANTILE)), 1e-6))

    def __call__(self, scores: Float[np.ndarray, "n K"]) -> Float[np.ndarray, " n"]:
        """Compute the distance of each frame from the nearest training press, from pattern scores (frames, patterns),
        relative to the usual distance between presses."""
        return self._relative_distances(scores[:, :_NUM_SCORES]) / self.usual

    def _relative_distances(self, scores: np.ndarray, *, excludes_nearest: bool = False) -> np.ndarray:
        nearest_distances = np.asarray(self._search_tree.query(scores, 2)[0])[:, int(excludes_nearest)]
        return nearest_distances / (np.linalg.norm(scores, axis=1) + _NORM_OFFSET_FRACTION * self.size)

    @cached_property
    def _search_tree(self) -> KDTree:
        return KDTree(self.scores)


# Fraction of the variance of the channels that patterns leave to noise.
_NOISE_VARIANCE_FRACTION = 1e-3
# Maximum number of patterns.
_MAX_PATTERNS = 60
# Number of presses required for each pattern.
_PRESSES_PER_PATTERN = 4
# A channel is dead if its residual exceeds this factor times this quantile of the residuals of training presses.
_RESIDUAL_FACTOR, _RESIDUAL_QUANTILE = 2.0, 0.999
# Maximum distance of a working channel's reading from the range of its training readings, relative to the width of the
# range. If more than this fraction of channels exceed the maximum, the frame counts as unusual and the channels as
# alive.
_MAX_RANGE_EXCESS, _MAX_EXCEEDING_FRACTION = 2.0, 0.1
# Variation of a channel below this fraction of the largest change counts as rounding error.
_ROUNDING_ERROR = 1e-13
# Candidate values added to the diagonal of the covariance of channels, which are scaled to variance 1.
_CANDIDATE_DIAGONAL_TERMS = np.logspace(-6, 0, 13)
# Fraction of dead channels in a frame at which the search for further dead channels stops.
_MAX_DEAD_FRACTION = 0.34
# Number of consecutive frames with a unique set of dead channels after which frames are processed one by one.
_MAX_UNIQUE_FRAMES = 8
# A frame has excess errors if the mean square of its residuals exceeds 1 by this number of standard deviations of the
# mean square of normally distributed residuals.
_EXCESS_STANDARD_DEVIATIONS = 2.0
# Novelty of a frame whose distance from the nearest press is the usual distance between presses.
_NOVELTY_AT_USUAL_DISTANCE = 2 / 1.75


@dataclass(frozen=True)
class Channels:
    """Joint model of the readings of a skin's measurement channels.

    `used`: whether a channel has readings that are not constant; all other fields are for the used channels. `scale`:
    standard deviation of the changes of each channel, the unit of the next four fields. `range` (2, channels): limits
    of the readings of a working channel; `patterns` (channels, patterns): correlated changes of the channels; `spread`:
    standard deviation of the score of each pattern; `noise`: standard deviation of the part of each channel that the
    patterns do not explain. `farthest`: maximum residual of a working channel, relative to its noise. `directions`
    (channels, directions): principal directions of the changes; `weight`: variance along each direction, divided by the
    same variance plus a constant; `unpredicted`: mean squared error of the prediction of each channel by the others,
    times one minus the channel's weight in its own prediction. `usual`: 99 % quantile of the novelty of the presses;
    `neighbourhood`: distances of frames from presses.
    """

    used: Bool[np.ndarray, " M"]
    scale: Float[np.ndarray, " m"]
    range: Float[np.ndarray, "2 m"]
    patterns: Float[np.ndarray, "m k"]
    spread: Float[np.ndarray, " k"]
    noise: Float[np.ndarray, " m"]
    farthest: Float[np.ndarray, " m"]
    directions: Float[np.ndarray, "m r"]
    weight: Float[np.ndarray, " r"]
    unpredicted: Float[np.ndarray, " m"]
    usual: float
    neighbourhood: Neighbourhood

    @classmethod
    def learn(cls, changes: Float[np.ndarray, "N M"]) -> "Channels":
        """Fit the channel model to voltage changes (presses, channels), NaN where a reading is missing.

        Raises `ValueError` if all channels have constant readings.
        """
        is_missing = np.isnan(changes)
        is_used = is_missing.mean(axis=0) < 0.5
        deviations = np.zeros(changes.shape[1])
        deviations[is_used] = np.nanstd(changes[:, is_used], axis=0)
        max_change = np.nanmax(np.abs(changes[:, is_used]), initial=0.0)
        is_used &= deviations > max(1e-9 * deviations.max(initial=0.0), _ROUNDING_ERROR * max_change)
        if not is_used.any():
            raise ValueError("frames: no channel changes; are these frames, and the skin connected?")
        scale = deviations[is_used]
        scaled = np.where(is_missing[:, is_used], 0.0, changes[:, is_used]) / scale
        has_reading, index_of_half = ~is_missing[:, is_used], len(scaled) // 2
        # Residuals are larger for frames outside the training set than in it, so each half of the frames is evaluated
        # with the patterns that were fitted to the other half.
        residuals, novelties, leave_one_out_errors = (
            [],
            [],
            np.zeros((2, len(_CANDIDATE_DIAGONAL_TERMS), int(is_used.sum()))),
        )
        for training_rows, test_rows in (
            (slice(None, index_of_half), slice(index_of_half, None)),
            (slice(index_of_half, None), slice(None, index_of_half)),
        ):
            variance, directions = _principal_variances(scaled[training_rows])
            leave_one_out_errors += _leave_one_out_errors(scaled[test_rows], variance, directions)
            pattern_model = _fit_patterns(scaled[training_rows], variance, directions)
            scores, residual = _most_likely_scores(scaled[test_rows], has_reading[test_rows], *pattern_model)
            residuals.append(np.where(has_reading[test_rows], np.abs(residual), np.nan))
            novelties.append(_frame_novelty(scores, residual, has_reading[test_rows], pattern_model[1]))
        residuals, novelties = np.concatenate(residuals), np.concatenate(novelties)
        max_residuals = _RESIDUAL_FACTOR * np.nanquantile(residuals, _RESIDUAL_QUANTILE, axis=0)
        max_residuals = np.maximum(max_residuals, max(6.0, float(np.nanquantile(residuals, 0.99))))
        variance, directions = _principal_variances(scaled)
        best_diagonal = int(leave_one_out_errors[0].sum(axis=1).argmin())
        weight, leave_one_out_variance = (
            variance / (variance + _CANDIDATE_DIAGONAL_TERMS[best_diagonal]),
            leave_one_out_errors[1, best_diagonal] / 2,
        )
        patterns, score_deviation, noise = _fit_patterns(scaled, variance, directions)
        scores, _ = _most_likely_scores(scaled, has_reading, patterns, score_deviation, noise)
        usual_novelty = float(np.quantile(novelties, 0.99))
        lowest, highest = np.nanmin(changes[:, is_used], axis=0) / scale, np.nanmax(changes[:, is_used], axis=0) / scale
        reading_limits = np.stack(
            [lowest - _MAX_RANGE_EXCESS * (highest - lowest), highest + _MAX_RANGE_EXCESS * (highest - lowest)]
        )
        neighbourhood = Neighbourhood.learn(scores)
        return cls(
            is_used,
            scale,
            reading_limits,
            patterns,
            score_deviation,
            noise,
            max_residuals,
            directions,
            weight,
            leave_one_out_variance,
            usual_novelty,
            neighbourhood,
        )

    def complete(self, changes: Float[np.ndarray, "n M"]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Replace the voltage changes of dead or missing channels by their prediction from the other channels.

        Returns the completed changes (frames, channels) of the used channels; whether each channel is alive in each
        frame (frames, channels); the novelty of each frame, about 1 for the farthest training presses; and the standard
        deviation of the reading errors (frames, channels) in excess of those of the training set, in the unit of the
        changes.
        """
        completed_changes = changes[:, self.used] / self.scale
        has_reading, out_of_range = (
            ~np.isnan(completed_changes),
            (completed_changes < self.range[0]) | (completed_changes > self.range[1]),
        )
        # If many channels are out of range, the frame is unusual, and the channels are not dead.
        has_reading &= ~out_of_range | (
            out_of_range.sum(axis=1, keepdims=True) > max(1, _MAX_EXCEEDING_FRACTION * completed_changes.shape[1])
        )
        completed_changes, is_alive = np.where(has_reading, completed_changes, 0.0), has_reading.copy()
        scores, residual = self._scores_and_residuals(completed_changes)
        remaining_frames, num_unique_frames = (
            np.flatnonzero((np.abs(residual) > self.farthest).any(axis=1) | ~has_reading.all(axis=1)),
            0,
        )
        while remaining_frames.size:
            # Most frames have the same dead channels, so the dead channels found for one frame are tried on all
            # remaining frames.
            is_working = self._working_channels(
                completed_changes[remaining_frames[0]], has_reading[remaining_frames[0]]
            )
            tried_frames = remaining_frames if num_unique_frames < _MAX_UNIQUE_FRAMES else remaining_frames[:1]
            relative_deviations, tried_scores, tried_residual = self._deviations(
                completed_changes[tried_frames], has_reading[tried_frames], is_working
            )
            is_consistent_with_pattern = (relative_deviations <= 1) == is_working
            is_completed = is_consistent_with_pattern.all(axis=1)
            is_completed[0] = True
            num_unique_frames = num_unique_frames + 1 if is_completed.sum() == 1 else 0
            done_frames = tried_frames[is_completed]
            is_alive[done_frames], scores[done_frames] = is_working, tried_scores[is_completed]
            residual[done_frames] = np.where(is_working, tried_residual[is_completed], 0.0)
            completed_changes[np.ix_(done_frames, ~is_working)] = self._predict_others(
                completed_changes[np.ix_(done_frames, is_working)], is_working
            )
            remaining_frames = np.setdiff1d(remaining_frames, done_frames, assume_unique=True)
        frame_novelty = _frame_novelty(scores, residual, is_alive, self.spread) / self.usual
        frame_novelty = np.maximum(frame_novelty, _NOVELTY_AT_USUAL_DISTANCE * self.neighbourhood(scores))
        return completed_changes * self.scale, is_alive, frame_novelty, self._excess_deviations(residual, is_alive)

    def _working_channels(self, frame: np.ndarray, has_reading: np.ndarray) -> np.ndarray:
        """Determine which channels of a frame agree with the prediction from the other channels.

        The channels with the largest deviations are removed repeatedly; then removed channels that agree with the
        remaining channels are restored.
        """
        is_alive, min_alive, is_restored = has_reading.copy(), (1 - _MAX_DEAD_FRACTION) * len(frame), False
        while is_alive.sum() > min_alive:
            (relative_deviations,) = self._deviations(frame[None], has_reading[None], is_alive)[0]
            max_deviation = np.max(relative_deviations, where=is_alive, initial=0.0)
            if max_deviation <= 1 and is_restored:
                break
            if max_deviation <= 1:
                is_alive, is_restored = relative_deviations <= 1, True
            else:
                is_alive &= relative_deviations < (max_deviation if is_restored else max(1.0, max_deviation / 2))
        return is_alive

    def _deviations(self, changes, has_reading, alive) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute the deviations (frames, channels) of readings from their prediction by the channels that are `alive`.

        Deviations are divided by the maximum deviation of a working channel, and infinite for readings that are missing
        (not `has_reading`). Also returns the pattern scores of the frames (frames, patterns) and their residuals
        (frames, channels).
        """
        weighted_patterns = self.patterns * (alive / self.noise**2)[:, None]
        gain = weighted_patterns @ np.linalg.inv(weighted_patterns.T @ self.patterns + np.diag(1 / self.spread**2))
        scores = changes @ gain
        residual = (changes - scores @ self.patterns.T) / self.noise
        variance_factor = 1 - np.einsum(
            "ij,ij->i", self.patterns, gain
        )  # variance of a residual relative to the noise, reduced by the channel's weight in its own prediction
        relative_deviations = np.where(
            has_reading, np.abs(residual) / np.sqrt(np.maximum(variance_factor, 1e-6)) / self.farthest, np.inf
        )
        return relative_deviations, scores, residual

    def _predict_others(
        self, alive_readings: Float[np.ndarray, "n a"], is_alive: np.ndarray
    ) -> Float[np.ndarray, "n m-a"]:
        """Predict the most likely readings of the dead channels from those of the alive channels, `is_alive`."""
        dead_directions = self.directions[~is_alive] * self.weight
        right_hand_sides = dead_directions @ (alive_readings @ self.directions[is_alive]).T
        return np.linalg.solve(
            np.eye(len(dead_directions)) - dead_directions @ self.directions[~is_alive].T, right_hand_sides
        ).T

    def prediction_errors(self, alive: Bool[np.ndarray, "n m"], max_errors: int) -> Float[np.ndarray, "q n m"]:
        """Compute the errors of the readings that are predicted for the dead channels of frames.

        `alive` (frames, channels): the channels that are not dead. Returns the largest independent components of the
        errors (components, frames, channels), at most `max_errors`, each of one standard deviation, in the unit of the
        changes.
        """
        errors = np.zeros((min(max_errors, int((~alive).sum(axis=1).max(initial=0))), *alive.shape))
        alive_patterns, pattern_indices = np.unique(alive, axis=0, return_inverse=True)
        for pattern_index, is_alive in enumerate(alive_patterns):
            dead_directions, deviations = self.directions[~is_alive], np.sqrt(self.unpredicted[~is_alive])
            inverse = np.linalg.inv(np.eye(len(dead_directions)) - (dead_directions * self.weight) @ dead_directions.T)
            error_variances, eigenvectors = np.linalg.eigh(deviations[:, None] * inverse * deviations)
            error_columns = eigenvectors[:, ::-1] * np.sqrt(np.maximum(error_variances[::-1], 0.0))
            frame_indices, dead_channels = (
                np.flatnonzero(pattern_indices.ravel() == pattern_index),
                np.flatnonzero(~is_alive),
            )
            for error_index in range(min(len(errors), len(dead_channels))):
                errors[np.ix_(np.array([error_index]), frame_indices, dead_channels)] = (
                    error_columns[:, error_index] * self.scale[dead_channels]
                )
        return errors

    def _excess_deviations(self, residual: np.ndarray, is_alive: np.ndarray) -> Float[np.ndarray, "n m"]:
        """Estimate the standard deviation of reading errors (frames, channels) in excess of the errors of the training
        presses.

        The mean square of a frame's residuals, relative to the noise, is about 1 for the training presses. A
        significant excess over 1, for example after a drift, is attributed to independent errors of all alive
        channels, `is_alive`. Of such errors, k patterns of m channels explain a fraction k/m.
        """
        num_alive = np.maximum(is_alive.sum(axis=1), 1)
        degrees_of_freedom = np.maximum(num_alive - self.patterns.shape[1], 1)
        max_mean_square = 1 + _EXCESS_STANDARD_DEVIATIONS * np.sqrt(2 / degrees_of_freedom)
        excess_mean_square = np.maximum(
            np.sum(np.where(is_alive, residual, 0.0) ** 2, axis=1) / num_alive - max_mean_square, 0.0
        )
        return np.sqrt(excess_mean_square * num_alive / degrees_of_freedom)[:, None] * np.where(
            is_alive, self.noise * self.scale, 0.0
        )

    def _scores_and_residuals(self, changes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the pattern scores of frames whose channels are all alive, and the residuals relative to the
        noise."""
        scores = changes @ self._score_matrix
        return scores, (changes - scores @ self.patterns.T) / self.noise

    @cached_property
    def _score_matrix(self) -> Float[np.ndarray, "m k"]:
        """Matrix (channels, patterns) that maps readings to pattern scores if all channels are alive."""
        weighted_patterns = self.patterns / self.noise[:, None] ** 2
        return np.linalg.solve(weighted_patterns.T @ self.patterns + np.diag(1 / self.spread**2), weighted_patterns.T).T


def _principal_variances(
    scaled_changes: Float[np.ndarray, "N m"],
) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "m r"]]:
    """Compute the principal directions of frames, and the variance along each direction, in decreasing order."""
    num_frames, num_channels = scaled_changes.shape
    if num_channels <= num_frames:
        eigenvalues, directions = np.linalg.eigh(scaled_changes.T @ scaled_changes)
    else:  # the Gram matrix of frames is smaller than that of channels
        eigenvalues, eigenvectors = np.linalg.eigh(scaled_changes @ scaled_changes.T)
        directions = scaled_changes.T @ eigenvectors / np.sqrt(np.maximum(eigenvalues, 1e-300))
    significant_indices = np.flatnonzero(eigenvalues > _ROUNDING_ERROR * eigenvalues[-1])[::-1]
    return eigenvalues[significant_indices] / num_frames, directions[:, significant_indices]


def _fit_patterns(scaled_changes, direction_variances, directions) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the patterns of channels (channels, patterns), and the standard deviations of each pattern's score and of
    each channel's noise.

    The noise is the part of each channel's readings that the patterns do not explain.
    """
    explained_fractions = np.cumsum(direction_variances) / np.sum(direction_variances)
    num_patterns = min(
        int(np.searchsorted(explained_fractions, 1 - _NOISE_VARIANCE_FRACTION)) + 1,
        _MAX_PATTERNS,
        max(1, len(scaled_changes) // _PRESSES_PER_PATTERN),
    )
    num_patterns = min(num_patterns, max(1, scaled_changes.shape[1] // 2))
    patterns = directions[:, :num_patterns]
    residuals = scaled_changes - scaled_changes @ patterns @ patterns.T
    noise = np.sqrt(np.mean(residuals**2, axis=0) * len(scaled_changes) / max(1, len(scaled_changes) - num_patterns))
    return patterns, np.sqrt(direction_variances[:num_patterns]), np.maximum(noise, 1e-6)


def _leave_one_out_errors(scaled_changes, variance, directions) -> Float[np.ndarray, "2 D m"]:
    """Compute mean squared prediction errors of channels for each candidate value that is added to the diagonal of
    their covariance.

    Returns two arrays (diagonal values, channels): the error of the prediction of each channel by the others, and this
    error times `residual_factor`, one minus the weight of the channel in its own prediction; `prediction_errors` uses
    the second array.
    """
    scores, squared_errors = scaled_changes @ directions, []
    for diagonal_term in _CANDIDATE_DIAGONAL_TERMS:
        direction_weights = variance / (variance + diagonal_term)
        residual_factor = 1 - np.sum(directions**2 * direction_weights, axis=1)
        mean_squares = np.mean((scaled_changes - (scores * direction_weights) @ directions.T) ** 2, axis=0)
        squared_errors.append((mean_squares / residual_factor**2, mean_squares / residual_factor))
    return np.swapaxes(np.array(squared_errors), 0, 1)


def _most_likely_scores(changes, is_alive, patterns, score_deviation, noise) -> tuple[np.ndarray, np.ndarray]:
    """Compute the most likely pattern scores of frames (frames, patterns), and the residuals of their readings divided
    by the noise.

    Residuals are 0 for readings that are not alive; `is_alive` (frames, channels).
    """
    weighted_patterns = patterns / noise[:, None] ** 2
    prior_precision = np.diag(1 / score_deviation**2)
    scores = np.linalg.solve(weighted_patterns.T @ patterns + prior_precision, weighted_patterns.T @ changes.T).T
    for frame_index in np.flatnonzero(~is_alive.all(axis=1)):
        alive_patterns = weighted_patterns * is_alive[frame_index, :, None]
        scores[frame_index] = np.linalg.solve(
            alive_patterns.T @ patterns + prior_precision, alive_patterns.T @ changes[frame_index]
        )
    return scores, np.where(is_alive, (changes - scores @ patterns.T) / noise, 0.0)


def _frame_novelty(scores, residual, is_alive, score_deviation) -> np.ndarray:
    """Compute the novelty of each frame: the larger of the root mean squares of its residuals, relative to the noise,
    and of its pattern scores, relative to their standard deviations.
    """
    residual_size = np.sqrt(np.sum(residual**2, axis=1) / np.maximum(is_alive.sum(axis=1), 1))
    return np.maximum(residual_size, np.sqrt(np.mean((scores / score_deviation) ** 2, axis=1)))


def choose_channels(
    scaled: Float[np.ndarray, "N m"], targets: Float[np.ndarray, "N q"], num_channels: int
) -> Int[np.ndarray, " n"]:
    """Select channels by simultaneous orthogonal matching pursuit (Tropp et al. 2006), in decreasing order of
    information.

    Each step selects the channel that explains most, by least squares, of the part of the `targets` that the previously
    selected channels leave unexplained. Products of targets count as further targets, since places are not linear
    functions of voltages.
    """
    target_products = [targets[:, i] * targets[:, j] for i in range(targets.shape[1]) for j in range(i + 1)]
    unexplained_targets = np.column_stack(
        [targets, *(target_product - target_product.mean() for target_product in target_products[:20])]
    )
    unexplained_targets = unexplained_targets - unexplained_targets.mean(axis=0)
    candidate_changes = scaled - scaled.mean(axis=0)
    initial_norms = np.sum(candidate_changes**2, axis=0)
    selected_channels: list[int] = []
    for _ in range(min(num_channels, scaled.shape[1])):
        squared_norms = np.sum(candidate_changes**2, axis=0)
        explained_energy = np.sum((candidate_changes.T @ unexplained_targets) ** 2, axis=1) / np.where(
            squared_norms > 1e-8 * initial_norms, squared_norms, np.inf
        )
        explained_energy[selected_channels] = -1
        best_channel = int(explained_energy.argmax())
        selected_channels.append(best_channel)
        if squared_norms[best_channel] > 1e-8 * initial_norms[best_channel]:
            channel_direction = candidate_changes[:, best_channel] / np.sqrt(squared_norms[best_channel])
            unexplained_targets = unexplained_targets - np.outer(
                channel_direction, channel_direction @ unexplained_targets
            )
            candidate_changes = candidate_changes - np.outer(channel_direction, channel_direction @ candidate_changes)
    return np.array(selected_channels)
