"""Tracks of the touches in a recording, and one call that computes intensities, positions and tracks from a recording.
A track consists of the positions of consecutive frames, smoothed in time, and the onset and offset of each touch.

The motion of a touch is modelled by a random acceleration: white noise of spectral density q in m²/s³. A Kalman filter
runs forwards over the positions, and a Rauch-Tung-Striebel smoother runs backwards. Frames without a position are
skipped, and positions too far from the filter's prediction are rejected. The value of q with the highest likelihood is
selected from a range.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import chdtri

from jeit.acoustic.calibration.calibration import Calibration, calibrated_intensities
from jeit.acoustic.localisation.locate import GAIN_DRIFT_DEVIATION, locate
from jeit.acoustic.localisation.locations import MAX_NUMPY_FRAMES, Locations
from jeit.acoustic.signal.intensity import IntensitySettings
from jeit.acoustic.signal.recording import Intensities, Recording
from jeit.arguments import check_kind
from jeit_solvers.engines import evaluate_in_numpy, namespace, scan
from jeit_solvers.module import Module

# Candidate spectral densities of acceleration in m²/s³, from a finger at rest to a finger that moves violently.
_ACCELERATION_SPECTRAL_DENSITIES = np.geomspace(1e-5, 10.0, 13)
# Probability that a correct position is rejected as too far from the filter's prediction.
_FALSE_REJECTION_PROBABILITY = 1e-4
# Standard deviation of each component of the initial velocity of a touch, in m/s.
_INITIAL_SPEED_DEVIATION = 0.5
# Rows and columns of the map on which the consistency loss is minimised, as in Park 2022.
_MAP_SHAPE = (200, 200)


class Touch(Module):
    """One touch in a track: its times, its frames and the length of its path.

    **Fields**: `onset`, `offset`: times in seconds of the middles of the touch's first and last frame; `first`, `last`:
    indices of these frames, both part of the touch; `length`: length of the touch's path in metres.
    """

    onset: float
    offset: float
    first: int
    last: int
    length: float


class Track(Module):
    """Smoothed positions of the touches in a recording with F frames.

    **Fields**: `times`: (F,) times of the frames in seconds; `position`: (F, d) smoothed positions in metres;
    `covariance`: (F, d, d) covariances of the positions in m²; `velocity`: (F, d) velocities in m/s; `touches`: the
    touches in order of time; `rejected`: mask (F,) of frames whose position is too far from the filter's prediction.
    Position, covariance and velocity are NaN outside touches.
    """

    times: Float[np.ndarray, " F"]
    position: Float[np.ndarray, "F d"]
    covariance: Float[np.ndarray, "F d d"]
    velocity: Float[np.ndarray, "F d"]
    touches: tuple[Touch, ...]
    rejected: Bool[np.ndarray, " F"]


def track(locations: Locations, *, gap: float = 0.15, acceleration: float | None = None) -> Track:
    """Smooth the positions of each touch in a recording.

    Covariances of measured positions are multiplied by `locations.overlap`, since the errors of overlapping windows are
    correlated.

    **Arguments:**

    - `locations`: positions of the frames, as returned by `locate`.
    - `gap`: time without a position after which a touch has ended, seconds.
    - `acceleration`: spectral density q of the random acceleration, m²/s³; by default the most likely value in a range.

    Raises `ValueError` if `gap` or `acceleration` is not positive, and if `locations` is not a `Locations`.

    **Example:**

    ```python
    smoothed = track(locations)
    print([(touch.onset, touch.length) for touch in smoothed.touches])
    ```
    """
    check_kind("locations", locations, Locations, "Locations, as of locate(recording, calibration)")
    if not (np.isfinite(gap) and gap > 0):
        raise ValueError(f"gap must be positive, in seconds; it is {gap}.")
    if acceleration is not None and not (np.isfinite(acceleration) and acceleration > 0):
        raise ValueError(f"acceleration must be positive, in m²/s³; it is {acceleration}.")
    num_frames, dimension = locations.position.shape
    times, has_position = locations.times, locations.has_position
    position, velocity = np.full((num_frames, dimension), np.nan), np.full((num_frames, dimension), np.nan)
    covariance, is_rejected_position = np.full((num_frames, dimension, dimension), np.nan), np.zeros(num_frames, bool)
    touch_intervals = _touch_intervals(times, has_position, gap)
    spectral_densities = _ACCELERATION_SPECTRAL_DENSITIES if acceleration is None else np.array([acceleration])
    touches = []
    for first_frame, last_frame in touch_intervals:
        touch_frames = slice(first_frame, last_frame + 1)
        measured_positions = np.where(has_position[touch_frames, None], locations.position[touch_frames], 0.0)
        measured_covariance = (
            np.where(has_position[touch_frames, None, None], locations.covariance[touch_frames], np.eye(dimension))
            * locations.overlap
        )
        # A minimum variance, the square of a tenth of a micrometre, is added, since covariances on a curved surface are
        # singular.
        measured_covariance = measured_covariance + 1e-14 * np.eye(dimension)
        time_steps = np.diff(times[touch_frames], prepend=times[first_frame])
        smoothed_states, state_covariances, is_accepted_position = _smooth_touch(
            time_steps, measured_positions, measured_covariance, has_position[touch_frames], spectral_densities
        )
        position[touch_frames], velocity[touch_frames] = smoothed_states[:, :dimension], smoothed_states[:, dimension:]
        covariance[touch_frames] = state_covariances[:, :dimension, :dimension]
        is_rejected_position[touch_frames] = has_position[touch_frames] & ~is_accepted_position
        path_length = float(np.linalg.norm(np.diff(position[touch_frames], axis=0), axis=1).sum())
        touches.append(
            Touch(float(times[first_frame]), float(times[last_frame]), int(first_frame), int(last_frame), path_length)
        )
    return Track(np.asarray(times), position, covariance, velocity, tuple(touches), is_rejected_position)


def _touch_intervals(times, has_position, max_gap: float) -> list[tuple[int, int]]:
    """Indices of the first and last frame with a position of each touch; touches are separated by more than `max_gap`
    seconds."""
    located_indices = np.flatnonzero(has_position)
    if not located_indices.size:
        return []
    gap_indices = np.flatnonzero(np.diff(times[located_indices]) > max_gap)
    start_indices, end_indices = (
        np.concatenate([[0], gap_indices + 1]),
        np.concatenate([gap_indices, [located_indices.size - 1]]),
    )
    return [
        (int(located_indices[start_index]), int(located_indices[end_index]))
        for start_index, end_index in zip(start_indices, end_indices, strict=True)
    ]


def _smooth_touch(
    time_steps, measured_positions, measured_covariances, has_position, spectral_densities
) -> tuple[np.ndarray, ...]:
    """Call `_smooth_positions` with NumPy for a touch with few frames. Otherwise compile the function, with the number
    of frames padded to a power of two."""
    num_frames, dimension = measured_positions.shape
    if num_frames <= MAX_NUMPY_FRAMES:
        return evaluate_in_numpy(
            _smooth_positions, time_steps, measured_positions, measured_covariances, has_position, spectral_densities
        )
    num_padding_frames = (1 << (num_frames - 1).bit_length()) - num_frames
    padded_arrays = (
        np.pad(time_steps, (0, num_padding_frames)),
        np.pad(measured_positions, ((0, num_padding_frames), (0, 0))),
        np.concatenate(
            [measured_covariances, np.broadcast_to(np.eye(dimension), (num_padding_frames, dimension, dimension))]
        ),
        np.pad(has_position, (0, num_padding_frames)),
    )
    return tuple(
        np.asarray(smoothed_array)[:num_frames]
        for smoothed_array in jax.jit(_smooth_positions)(*padded_arrays, spectral_densities)
    )


def _smooth_positions(time_steps, measured_positions, measured_covariance, has_position, spectral_densities):
    """Smooth the positions of one touch with n frames, for the most likely of the `spectral_densities` of acceleration.

    Returns the states (n, 2 d), position and velocity; the covariances of the states (n, 2 d, 2 d); and the mask (n,)
    of accepted positions.
    """
    xp, dimension = namespace(measured_positions), measured_positions.shape[1]
    log_likelihoods, filtered_arrays = _kalman_filter(
        time_steps, measured_positions, measured_covariance, has_position, spectral_densities
    )
    best_density_index = xp.argmax(log_likelihoods)
    state_mean, state_covariance, predicted_mean, predicted_covariance, is_accepted_position = (
        filtered_array[:, best_density_index] for filtered_array in filtered_arrays
    )

    def smooth_step(next_state, frame_data):
        smoothed_mean, smoothed_covariance = next_state
        state_mean, state_covariance, next_mean, next_covariance, next_step = frame_data
        transition_matrix = _transition_matrix(next_step, dimension)
        smoother_gain = xp.linalg.solve(next_covariance, transition_matrix @ state_covariance).T
        state_mean = state_mean + smoother_gain @ (smoothed_mean - next_mean)
        state_covariance = state_covariance + smoother_gain @ (smoothed_covariance - next_covariance) @ smoother_gain.T
        return (state_mean, state_covariance), (state_mean, state_covariance)

    # The smoother's recursion starts after the last frame with a state equal to its prediction, so that the state of
    # the last frame is unchanged.
    last_prediction = predicted_mean[-1], predicted_covariance[-1]
    next_arrays = (
        xp.concatenate([filtered_array[1:], filtered_array[-1:]])
        for filtered_array in (predicted_mean, predicted_covariance, time_steps)
    )
    _, (smoothed_means, smoothed_covariances) = scan(
        smooth_step, last_prediction, (state_mean, state_covariance, *next_arrays), reverse=True
    )
    return smoothed_means, smoothed_covariances, is_accepted_position


def _kalman_filter(time_step, measured_positions, measured_covariance, has_position, spectral_densities):
    """Run the Kalman filter over the positions of one touch for Q spectral densities of acceleration at once.

    Returns the log-likelihood (Q,) of each density; and for every frame and density the filtered mean and covariance of
    the state (position and velocity), the predicted mean and covariance, and whether the position was accepted.
    """
    xp, dimension = namespace(measured_positions), measured_positions.shape[1]
    max_squared_distance = float(chdtri(dimension, _FALSE_REJECTION_PROBABILITY))

    def filter_step(filter_state, frame_data):
        state_mean, state_covariance = filter_state
        time_step, measured_position, measured_covariance, is_measured = frame_data
        transition_matrix = _transition_matrix(time_step, dimension)
        state_mean, state_covariance = (
            state_mean @ transition_matrix.T,
            transition_matrix @ state_covariance @ transition_matrix.T
            + spectral_densities[:, None, None] * _process_noise(time_step, dimension),
        )
        innovation, innovation_covariance = (
            measured_position - state_mean[:, :dimension],
            state_covariance[:, :dimension, :dimension] + measured_covariance,
        )
        kalman_gain = xp.swapaxes(xp.linalg.solve(innovation_covariance, state_covariance[:, :dimension]), 1, 2)
        squared_distance = xp.sum(
            innovation * xp.linalg.solve(innovation_covariance, innovation[:, :, None])[:, :, 0], axis=1
        )
        is_accepted_position = is_measured & (squared_distance < max_squared_distance)
        log_determinant = xp.log(xp.linalg.det(innovation_covariance))
        # A rejected position lowers the likelihood of a density as much as a position at the limit of acceptance.
        log_likelihood = xp.where(
            is_measured, -0.5 * (xp.minimum(squared_distance, max_squared_distance) + log_determinant), 0.0
        )
        new_mean = xp.where(
            is_accepted_position[:, None], state_mean + xp.einsum("qij,qj->qi", kalman_gain, innovation), state_mean
        )
        # The Joseph form of the covariance update is accurate even for nearly exact positions, for which the difference
        # in the usual form is lost to rounding.
        update_matrix = xp.eye(2 * dimension) - xp.concatenate([kalman_gain, xp.zeros_like(kalman_gain)], axis=2)
        updated_covariance = update_matrix @ state_covariance @ xp.swapaxes(
            update_matrix, 1, 2
        ) + kalman_gain @ measured_covariance @ xp.swapaxes(kalman_gain, 1, 2)
        new_covariance = xp.where(
            is_accepted_position[:, None, None],
            (updated_covariance + xp.swapaxes(updated_covariance, 1, 2)) / 2,
            state_covariance,
        )
        return (new_mean, new_covariance), (
            log_likelihood,
            new_mean,
            new_covariance,
            state_mean,
            state_covariance,
            is_accepted_position,
        )

    initial_mean = xp.concatenate([measured_positions[0], xp.zeros(dimension)])
    initial_variances = xp.concatenate(
        [1e4 * xp.trace(measured_covariance[0]) * xp.ones(dimension), xp.full(dimension, _INITIAL_SPEED_DEVIATION**2)]
    )
    num_densities = len(spectral_densities)
    initial_state = (
        xp.tile(initial_mean, (num_densities, 1)),
        xp.tile(xp.diag(initial_variances), (num_densities, 1, 1)),
    )
    _, (log_likelihoods, *filtered_arrays) = scan(
        filter_step, initial_state, (time_step, measured_positions, measured_covariance, has_position)
    )
    return xp.sum(log_likelihoods, axis=0), filtered_arrays


def _transition_matrix(time_step, dimension: int) -> Float[Array, "s s"]:
    """Transition matrix (2 d, 2 d) of position and velocity for a time step of `time_step` seconds."""
    xp = namespace(time_step)
    return xp.kron(xp.eye(2) + time_step * xp.eye(2, k=1), xp.eye(dimension))


def _process_noise(time_step, dimension: int) -> Float[Array, "s s"]:
    """Covariance (2 d, 2 d) of position and velocity after a time step of `time_step` seconds with white acceleration
    of spectral density 1."""
    xp = namespace(time_step)
    return xp.kron(
        xp.stack([time_step**3 / 3, time_step**2 / 2, time_step**2 / 2, time_step]).reshape(2, 2), xp.eye(dimension)
    )


class LocatedTouches(Module):
    """Touches located in a recording.

    **Fields**: `intensities`: intensities of the recording; `locations`: position and status of each frame; `track`:
    smoothed positions of the touches; `calibration`, `method`: the calibration and method used.

    **Example:**

    ```python
    located = locate_touches(recording, calibration)
    print([(touch.onset, touch.offset) for touch in located.track.touches])
    ```
    """

    intensities: Intensities
    locations: Locations
    track: Track
    calibration: Calibration
    method: str = eqx.field(static=True)


def locate_touches(
    recording: Recording | Intensities,
    calibration: Calibration,
    *,
    method: str = "likelihood",
    gap: float = 0.15,
    intensity: IntensitySettings | None = None,
    silence: Recording | None = None,
    gain_drift: float = GAIN_DRIFT_DEVIATION,
    progress: Callable[[str], None] | None = None,
) -> LocatedTouches:
    """Locate every touch in a recording of microphones, as the command `jeit locate` does.

    **Arguments:**

    - `recording`: samples or intensities of the calibrated microphones.
    - `calibration`: the calibrated array.
    - `method`: "likelihood" (maximum likelihood), or "consistency" for the loss of Park 2022, minimised on a map of 200
      × 200 pixels and then refined.
    - `gap`: time without a position after which a touch has ended, seconds.
    - `intensity`: frequency band and windows, for recordings of samples; by default as in the calibration.
    - `silence`: recording of the untouched array, from which the noise floor is estimated; required if touches never
      pause.
    - `gain_drift`: standard deviation of the changes of the microphones' gains since the calibration, as a fraction of
      the intensities; see `locate`.
    - `progress`: function called with the name of each step of the computation when the step begins.

    Raises `ValueError` if the recording and the calibration have different numbers of microphones, if fewer than three
    microphones are usable, and if frames are farther apart than `gap`. Also raises `ValueError` for `intensity` or
    `silence` with a recording of intensities, and for values out of range.

    **Example:**

    ```python
    located = locate_touches(recording, calibration)
    write_track(located, "out")
    ```
    """
    report_step = progress or (lambda step_name: None)
    if intensity is not None and isinstance(recording, Intensities):
        raise ValueError("intensity: band and window are for samples; this recording holds intensities.")
    if not (np.isfinite(gap) and gap > 0):
        raise ValueError(f"gap must be positive, in seconds; it is {gap}.")
    report_step("measure intensities")
    recording_intensities = calibrated_intensities(recording, calibration, intensity, silence=silence)
    if len(recording_intensities.times) > 1 and np.median(np.diff(recording_intensities.times)) > gap:
        raise ValueError(
            f"gap: frames are {np.median(np.diff(recording_intensities.times)):g} s apart, more than the {gap:g} s "
            "that end a touch: give times in seconds, or a longer gap."
        )
    report_step("locate")
    map_shape = _MAP_SHAPE if method == "consistency" else None
    locations = locate(recording_intensities, calibration, method=method, map_shape=map_shape, gain_drift=gain_drift)
    report_step("track")
    return LocatedTouches(recording_intensities, locations, track(locations, gap=gap), calibration, method)
