"""Tracks: positions of consecutive frames smoothed in time, and onset and offset of each touch.

The motion of a touch is modelled by a random acceleration: white noise of spectral density q in m²/s³. A Kalman filter
runs forwards over the positions, and a Rauch-Tung-Striebel smoother runs backwards. Frames without a position are
skipped, and positions too far from the prediction are rejected. The value of q with the highest likelihood is selected
from a range.
"""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import chdtri

from jeit.acoustic.localisation.locations import FEW_FRAMES, Locations
from jeit.arguments import check_kind
from jeit_solvers.engines import at_once, namespace, scan
from jeit_solvers.module import Module

# Candidate spectral densities of acceleration in m²/s³, from a finger at rest to one that moves violently.
_DENSITIES = np.geomspace(1e-5, 10.0, 13)
# Probability that a correct position is rejected as too far from its prediction.
_FALSE_REJECTION = 1e-4
# Standard deviation of each component of the initial velocity of a touch, in m/s.
_FIRST_SPEED = 0.5


class Touch(Module):
    """A touch in a track.

    **Fields**: `onset`, `offset`: times in seconds of the middles of its first and last frame; `first`, `last`: indices
    of these frames, both part of the touch; `length`: length of its path in metres.
    """

    onset: float
    offset: float
    first: int
    last: int
    length: float


class Track(Module):
    """Smoothed positions of a recording with F frames.

    **Fields**: `times`: (F,) in seconds; `position`: (F, d) in metres; `covariance`: (F, d, d) in m²; `velocity`:
    (F, d) in m/s; `touches`: the touches in order of time; `rejected`: mask (F,) of frames whose position is too far
    from the track of its touch. Position, covariance and velocity are NaN outside touches.
    """

    times: Float[np.ndarray, " F"]
    position: Float[np.ndarray, "F d"]
    covariance: Float[np.ndarray, "F d d"]
    velocity: Float[np.ndarray, "F d"]
    touches: tuple[Touch, ...]
    rejected: Bool[np.ndarray, " F"]


def track(locations: Locations, *, gap: float = 0.15, acceleration: float | None = None) -> Track:
    """Smooth the positions of each touch in a recording.

    Covariances are multiplied by `locations.overlap`, since the errors of overlapping windows are correlated.

    **Arguments:**

    - `locations`: positions of the frames, as from `locate`.
    - `gap`: time without a position after which a touch has ended, seconds.
    - `acceleration`: spectral density q of the random acceleration, m²/s³; by default the most likely value in a range.

    Raises `ValueError` for values that are not positive, and if `locations` is not a `Locations`.

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
    frames, d = locations.position.shape
    times, located = locations.times, locations.has_position
    position, velocity = np.full((frames, d), np.nan), np.full((frames, d), np.nan)
    covariance, rejected = np.full((frames, d, d), np.nan), np.zeros(frames, bool)
    runs = _touch_intervals(times, located, gap)
    densities = _DENSITIES if acceleration is None else np.array([acceleration])
    touches = []
    for first, last in runs:
        part = slice(first, last + 1)
        measured = np.where(located[part, None], locations.position[part], 0.0)
        spread = np.where(located[part, None, None], locations.covariance[part], np.eye(d)) * locations.overlap
        # A minimum standard deviation of a tenth of a micrometre is added, since covariances on a curved surface are
        # singular.
        spread = spread + 1e-14 * np.eye(d)
        step = np.diff(times[part], prepend=times[first])
        state, error, believed = _smooth_touch(step, measured, spread, located[part], densities)
        position[part], velocity[part] = state[:, :d], state[:, d:]
        covariance[part] = error[:, :d, :d]
        rejected[part] = located[part] & ~believed
        length = float(np.linalg.norm(np.diff(position[part], axis=0), axis=1).sum())
        touches.append(Touch(float(times[first]), float(times[last]), int(first), int(last), length))
    return Track(np.asarray(times), position, covariance, velocity, tuple(touches), rejected)


def _touch_intervals(times, located, gap: float) -> list[tuple[int, int]]:
    """Indices of the first and last located frame of each touch."""
    index = np.flatnonzero(located)
    if not index.size:
        return []
    breaks = np.flatnonzero(np.diff(times[index]) > gap)
    firsts, lasts = np.concatenate([[0], breaks + 1]), np.concatenate([breaks, [index.size - 1]])
    return [(int(index[a]), int(index[b])) for a, b in zip(firsts, lasts, strict=True)]


def _smooth_touch(step, measured, spread, located, densities) -> tuple[np.ndarray, ...]:
    """Call `_smooth`: with NumPy for a touch with few frames; otherwise compiled, with frames padded to a power of
    two."""
    frames, d = measured.shape
    if frames <= FEW_FRAMES:
        return at_once(_smooth, step, measured, spread, located, densities)
    pad = (1 << (frames - 1).bit_length()) - frames
    arrays = (
        np.pad(step, (0, pad)),
        np.pad(measured, ((0, pad), (0, 0))),
        np.concatenate([spread, np.broadcast_to(np.eye(d), (pad, d, d))]),
        np.pad(located, (0, pad)),
    )
    return tuple(np.asarray(array)[:frames] for array in jax.jit(_smooth)(*arrays, densities))


def _smooth(step, measured, spread, located, densities):
    """Smooth the positions of one touch with n frames, for the most likely of the densities.

    Returns the states (n, 2 d), position and velocity; their covariances (n, 2 d, 2 d); and the mask (n,) of accepted
    positions.
    """
    xp, d = namespace(measured), measured.shape[1]
    score, filtered = _filter(step, measured, spread, located, densities)
    best = xp.argmax(score)
    mean, error, predicted_mean, predicted_error, believed = (array[:, best] for array in filtered)

    def smooth_step(later, now):
        later_mean, later_error = later
        mean, error, next_mean, next_error, next_step = now
        move = _transition_matrix(next_step, d)
        gain = xp.linalg.solve(next_error, move @ error).T
        mean = mean + gain @ (later_mean - next_mean)
        error = error + gain @ (later_error - next_error) @ gain.T
        return (mean, error), (mean, error)

    # The recursion starts behind the last frame with a state equal to its prediction, so that the last frame is
    # unchanged.
    beyond = predicted_mean[-1], predicted_error[-1]
    later = (xp.concatenate([array[1:], array[-1:]]) for array in (predicted_mean, predicted_error, step))
    _, (means, errors) = scan(smooth_step, beyond, (mean, error, *later), reverse=True)
    return means, errors, believed


def _filter(step, measured, spread, located, densities):
    """Run the Kalman filter for Q spectral densities at once.

    Returns the log-likelihood (Q,) of each density; and for every frame and density the filtered mean and covariance of
    the state, the predicted mean and covariance, and whether the position was accepted.
    """
    xp, d = namespace(measured), measured.shape[1]
    limit = float(chdtri(d, _FALSE_REJECTION))

    def filter_step(state, now):
        mean, error = state
        step, place, spread, there = now
        move = _transition_matrix(step, d)
        mean, error = mean @ move.T, move @ error @ move.T + densities[:, None, None] * _process_noise(step, d)
        off, inner = place - mean[:, :d], error[:, :d, :d] + spread
        gain = xp.swapaxes(xp.linalg.solve(inner, error[:, :d]), 1, 2)
        square = xp.sum(off * xp.linalg.solve(inner, off[:, :, None])[:, :, 0], axis=1)
        believed = there & (square < limit)
        logarithm = xp.log(xp.linalg.det(inner))
        # A rejected position lowers the likelihood of a density as much as a position at the limit of acceptance.
        score = xp.where(there, -0.5 * (xp.minimum(square, limit) + logarithm), 0.0)
        new_mean = xp.where(believed[:, None], mean + xp.einsum("qij,qj->qi", gain, off), mean)
        # The Joseph form of the update is accurate also for nearly exact positions, where the difference in the usual
        # form is lost to rounding.
        keep = xp.eye(2 * d) - xp.concatenate([gain, xp.zeros_like(gain)], axis=2)
        updated = keep @ error @ xp.swapaxes(keep, 1, 2) + gain @ spread @ xp.swapaxes(gain, 1, 2)
        new_error = xp.where(believed[:, None, None], (updated + xp.swapaxes(updated, 1, 2)) / 2, error)
        return (new_mean, new_error), (score, new_mean, new_error, mean, error, believed)

    begin = xp.concatenate([measured[0], xp.zeros(d)])
    wide = xp.concatenate([1e4 * xp.trace(spread[0]) * xp.ones(d), xp.full(d, _FIRST_SPEED**2)])
    many = len(densities)
    first = xp.tile(begin, (many, 1)), xp.tile(xp.diag(wide), (many, 1, 1))
    _, (score, *rest) = scan(filter_step, first, (step, measured, spread, located))
    return xp.sum(score, axis=0), rest


def _transition_matrix(step, dimension: int) -> Float[Array, "s s"]:
    """Transition matrix (2 d, 2 d) of position and velocity for a time step in seconds."""
    xp = namespace(step)
    return xp.kron(xp.eye(2) + step * xp.eye(2, k=1), xp.eye(dimension))


def _process_noise(step, dimension: int) -> Float[Array, "s s"]:
    """Covariance (2 d, 2 d) of position and velocity after a time step with white acceleration of spectral density
    1."""
    xp = namespace(step)
    return xp.kron(xp.stack([step**3 / 3, step**2 / 2, step**2 / 2, step]).reshape(2, 2), xp.eye(dimension))
