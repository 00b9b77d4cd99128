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
    """One touch in a track: its times, frames and length.

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
    covariance, is_rejected = np.full((num_frames, dimension, dimension), np.nan), np.zeros(num_frames, bool)
    intervals = _touch_intervals(times, has_position, gap)
    spectral_densities = _ACCELERATION_SPECTRAL_DENSITIES if acceleration is None else np.array([acceleration])
    touches = []
    for first_frame, last_frame in intervals:
        touch_frames = slice(first_frame, last_frame + 1)
        measured = np.where(has_position[touch_frames, None], locations.position[touch_frames], 0.0)
        measured_covariance = (
            np.where(has_position[touch_frames, None, None], locations.covariance[touch_frames], np.eye(dimension))
            * locations.overlap
        )
        # A minimum variance, the square of a tenth of a micrometre, is added, since covariances on a curved surface are
        # singular.
        measured_covariance = measured_covariance + 1e-14 * np.eye(dimension)
        time_steps = np.diff(times[touch_frames], prepend=times[first_frame])
        states, errors, is_accepted = _smooth_touch(
            time_steps, measured, measured_covariance, has_position[touch_frames], spectral_densities
        )
        position[touch_frames], velocity[touch_frames] = states[:, :dimension], states[:, dimension:]
        covariance[touch_frames] = errors[:, :dimension, :dimension]
        is_rejected[touch_frames] = has_position[touch_frames] & ~is_accepted
        length = float(np.linalg.norm(np.diff(position[touch_frames], axis=0), axis=1).sum())
        touches.append(
            Touch(float(times[first_frame]), float(times[last_frame]), int(first_frame), int(last_frame), length)
        )
    return Track(np.asarray(times), position, covariance, velocity, tuple(touches), is_rejected)


def _touch_intervals(times, has_position, gap: float) -> list[tuple[int, int]]:
    """Indices of the first and last frame with a position of each touch; touches are separated by more than `gap`
    seconds."""
    located_indices = np.flatnonzero(has_position)
    if not located_indices.size:
        return []
    gap_indices = np.flatnonzero(np.diff(times[located_indices]) > gap)
    start_indices, end_indices = (
        np.concatenate([[0], gap_indices + 1]),
        np.concatenate([gap_indices, [located_indices.size - 1]]),
    )
    return [
        (int(located_indices[start]), int(located_indices[end]))
        for start, end in zip(start_indices, end_indices, strict=True)
    ]


def _smooth_touch(time_steps, measured, covariances, has_position, spectral_densities) -> tuple[np.ndarray, ...]:
    """Call `_smooth_positions` with NumPy for a touch with few frames. Otherwise compile the function, with the number
    of frames padded to a power of two."""
    num_frames, dimension = measured.shape
    if num_frames <= MAX_NUMPY_FRAMES:
        return evaluate_in_numpy(_smooth_positions, time_steps, measured, covariances, has_position, spectral_densities)
    padding = (1 << (num_frames - 1).bit_length()) - num_frames
    arrays = (
        np.pad(time_steps, (0, padding)),
        np.pad(measured, ((0, padding), (0, 0))),
        np.concatenate([covariances, np.broadcast_to(np.eye(dimension), (padding, dimension, dimension))]),
        np.pad(has_position, (0, padding)),
    )
    return tuple(np.asarray(array)[:num_frames] for array in jax.jit(_smooth_positions)(*arrays, spectral_densities))


def _smooth_positions(time_steps, measured, measured_covariance, has_position, spectral_densities):
    """Smooth the positions of one touch with n frames, for the most likely of the `spectral_densities` of acceleration.

    Returns the states (n, 2 d), position and velocity; the covariances of the states (n, 2 d, 2 d); and the mask (n,)
    of accepted positions.
    """
    xp, dimension = namespace(measured), measured.shape[1]
    log_likelihoods, filtered = _kalman_filter(
        time_steps, measured, measured_covariance, has_position, spectral_densities
    )
    best_index = xp.argmax(log_likelihoods)
    mean, covariance, predicted_mean, predicted_covariance, is_accepted = (array[:, best_index] for array in filtered)

    def smooth_step(next_state, frame_data):
        smoothed_mean, smoothed_covariance = next_state
        mean, covariance, next_mean, next_covariance, next_step = frame_data
        transition = _transition_matrix(next_step, dimension)
        gain = xp.linalg.solve(next_covariance, transition @ covariance).T
        mean = mean + gain @ (smoothed_mean - next_mean)
        covariance = covariance + gain @ (smoothed_covariance - next_covariance) @ gain.T
        return (mean, covariance), (mean, covariance)

    # The smoother's recursion starts after the last frame with a state equal to its prediction, so that the state of
    # the last frame is unchanged.
    last_prediction = predicted_mean[-1], predicted_covariance[-1]
    next_arrays = (
        xp.concatenate([array[1:], array[-1:]]) for array in (predicted_mean, predicted_covariance, time_steps)
    )
    _, (means, covariances) = scan(smooth_step, last_prediction, (mean, covariance, *next_arrays), reverse=True)
    return means, covariances, is_accepted


def _kalman_filter(time_step, measured, measured_covariance, has_position, spectral_densities):
    """Run the Kalman filter over the positions of one touch for Q spectral densities of acceleration at once.

    Returns the log-likelihood (Q,) of each density; and for every frame and density the filtered mean and covariance of
    the state (position and velocity), the predicted mean and covariance, and whether the position was accepted.
    """
    xp, dimension = namespace(measured), measured.shape[1]
    max_distance = float(chdtri(dimension, _FALSE_REJECTION_PROBABILITY))

    def filter_step(state, frame_data):
        mean, covariance = state
        time_step, position, measured_covariance, is_measured = frame_data
        transition = _transition_matrix(time_step, dimension)
        mean, covariance = (
            mean @ transition.T,
            transition @ covariance @ transition.T
            + spectral_densities[:, None, None] * _process_noise(time_step, dimension),
        )
        innovation, innovation_covariance = (
            position - mean[:, :dimension],
            covariance[:, :dimension, :dimension] + measured_covariance,
        )
        gain = xp.swapaxes(xp.linalg.solve(innovation_covariance, covariance[:, :dimension]), 1, 2)
        squared_distance = xp.sum(
            innovation * xp.linalg.solve(innovation_covariance, innovation[:, :, None])[:, :, 0], axis=1
        )
        is_accepted = is_measured & (squared_distance < max_distance)
        log_determinant = xp.log(xp.linalg.det(innovation_covariance))
        # A rejected position lowers the likelihood of a density as much as a position at the limit of acceptance.
        log_likelihood = xp.where(
            is_measured, -0.5 * (xp.minimum(squared_distance, max_distance) + log_determinant), 0.0
        )
        new_mean = xp.where(is_accepted[:, None], mean + xp.einsum("qij,qj->qi", gain, innovation), mean)
        # The Joseph form of the covariance update is accurate even for nearly exact positions, for which the difference
        # in the usual form is lost to rounding.
        update_matrix = xp.eye(2 * dimension) - xp.concatenate([gain, xp.zeros_like(gain)], axis=2)
        updated_covariance = update_matrix @ covariance @ xp.swapaxes(
            update_matrix, 1, 2
        ) + gain @ measured_covariance @ xp.swapaxes(gain, 1, 2)
        new_covariance = xp.where(
            is_accepted[:, None, None], (updated_covariance + xp.swapaxes(updated_covariance, 1, 2)) / 2, covariance
        )
        return (new_mean, new_covariance), (log_likelihood, new_mean, new_covariance, mean, covariance, is_accepted)

    initial_mean = xp.concatenate([measured[0], xp.zeros(dimension)])
    initial_variances = xp.concatenate(
        [1e4 * xp.trace(measured_covariance[0]) * xp.ones(dimension), xp.full(dimension, _INITIAL_SPEED_DEVIATION**2)]
    )
    num_densities = len(spectral_densities)
    initial_state = (
        xp.tile(initial_mean, (num_densities, 1)),
        xp.tile(xp.diag(initial_variances), (num_densities, 1, 1)),
    )
    _, (log_likelihoods, *filtered) = scan(
        filter_step, initial_state, (time_step, measured, measured_covariance, has_position)
    )
    return xp.sum(log_likelihoods, axis=0), filtered


def _transition_matrix(time_step, dimension: int) -> Float[Array, "s s"]:
    """Transition matrix (2 d, 2 d) of position and velocity for a time step of `time_step` seconds."""
    xp = namespace(time_step)
    return xp.kron(xp.eye(2) + time_step * xp.eye(2, k=1), xp.eye(dimension))


def _process_noise(step, dimension: int) -> Float[Array, "s s"]:
    """Covariance (2 d, 2 d) of position and velocity after a time step of `step` seconds with white acceleration of
    spectral density 1."""
    xp = namespace(step)
    return xp.kron(xp.stack([step**3 / 3, step**2 / 2, step**2 / 2, step]).reshape(2, 2), xp.eye(dimension))


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
    report_step = progress or (lambda step: None)
    if intensity is not None and isinstance(recording, Intensities):
        raise ValueError("intensity: band and window are for samples; this recording holds intensities.")
    if not (np.isfinite(gap) and gap > 0):
        raise ValueError(f"gap must be positive, in seconds; it is {gap}.")
    report_step("measure intensities")
    result = calibrated_intensities(recording, calibration, intensity, silence=silence)
    if len(result.times) > 1 and np.median(np.diff(result.times)) > gap:
        raise ValueError(
            f"gap: frames are {np.median(np.diff(result.times)):g} s apart, more than the {gap:g} s that end a touch: "
            "give times in seconds, or a longer gap."
        )
    report_step("locate")
    map_shape = _MAP_SHAPE if method == "consistency" else None
    locations = locate(result, calibration, method=method, map_shape=map_shape, gain_drift=gain_drift)
    report_step("track")
    return LocatedTouches(result, locations, track(locations, gap=gap), calibration, method)
