"""Tracks: positions of consecutive frames smoothed in time, and onset and offset of each touch.

A touch moves with a velocity that changes at random: white acceleration of spectral density q (m²/s³). Positions are
filtered forwards by a Kalman filter and smoothed backwards after Rauch, Tung and Striebel. Frames without a position
are skipped, and a position too far from the predicted one is rejected. q is the most likely of a range.
"""

from __future__ import annotations

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import chdtri

from jeit.acoustic.localisation.locations import FEW_FRAMES, Locations
from jeit.arguments import check_kind
from jeit_solvers.engines import at_once, namespace, scan

# Candidate densities: from a finger at rest to one that moves violently (m²/s³).
_DENSITIES = np.geomspace(1e-5, 10.0, 13)
_BELIEVED = 1e-4
# Standard deviation of the initial speed of a touch (m/s).
_FIRST_SPEED = 0.5


class Touch(eqx.Module):
    """One touch: `onset` and `offset` in seconds (middles of its first and last frame), its frames [first, last], and
    the `length` of its path in metres."""

    onset: float
    offset: float
    first: int
    last: int
    length: float


class Track(eqx.Module):
    """Smoothed `position` (F, d) in metres with `covariance` (F, d, d), `velocity` (F, d) in m/s, NaN outside touches;
    the `touches`; and which frames were `rejected` (F,), too far off to belong to their touch."""

    times: Float[np.ndarray, " F"]
    position: Float[np.ndarray, "F d"]
    covariance: Float[np.ndarray, "F d d"]
    velocity: Float[np.ndarray, "F d"]
    touches: tuple[Touch, ...]
    rejected: Bool[np.ndarray, " F"]


def track(locations: Locations, *, gap: float = 0.15, acceleration: float | None = None) -> Track:
    """Smooth the positions of a recording, touch by touch.

    `gap`: seconds without a place after which a touch has ended. `acceleration`: spectral density q of the random
    acceleration (m²/s³), the most likely of a range unless given. Errors of windows that share a sample are correlated:
    covariances are multiplied by `locations.overlap`. Raises `ValueError` for what is not positive, and for what is no
    `Locations`.
    """
    check_kind("locations", locations, Locations, "Locations, as of locate(recording, calibration)")
    if not (np.isfinite(gap) and gap > 0):
        raise ValueError(f"gap must be positive, in seconds; it is {gap}.")
    if acceleration is not None and not (np.isfinite(acceleration) and acceleration > 0):
        raise ValueError(f"acceleration must be positive, in m²/s³; it is {acceleration}.")
    frames, d = locations.position.shape
    times, located = locations.times, locations.located
    position, velocity = np.full((frames, d), np.nan), np.full((frames, d), np.nan)
    covariance, rejected = np.full((frames, d, d), np.nan), np.zeros(frames, bool)
    runs = _runs(times, located, gap)
    densities = _DENSITIES if acceleration is None else np.array([acceleration])
    touches = []
    for first, last in runs:
        part = slice(first, last + 1)
        measured = np.where(located[part, None], locations.position[part], 0.0)
        spread = np.where(located[part, None, None], locations.covariance[part], np.eye(d)) * locations.overlap
        # A covariance may be singular on a curved surface; the least standard deviation is a tenth of a micrometre.
        spread = spread + 1e-14 * np.eye(d)
        step = np.diff(times[part], prepend=times[first])
        state, error, believed = _smoothed(step, measured, spread, located[part], densities)
        position[part], velocity[part] = state[:, :d], state[:, d:]
        covariance[part] = error[:, :d, :d]
        rejected[part] = located[part] & ~believed
        length = float(np.linalg.norm(np.diff(position[part], axis=0), axis=1).sum())
        touches.append(Touch(float(times[first]), float(times[last]), int(first), int(last), length))
    return Track(np.asarray(times), position, covariance, velocity, tuple(touches), rejected)


def _runs(times, located, gap: float) -> list[tuple[int, int]]:
    """First and last located frame of each touch."""
    index = np.flatnonzero(located)
    if not index.size:
        return []
    breaks = np.flatnonzero(np.diff(times[index]) > gap)
    firsts, lasts = np.concatenate([[0], breaks + 1]), np.concatenate([breaks, [index.size - 1]])
    return [(int(index[a]), int(index[b])) for a, b in zip(firsts, lasts, strict=True)]


def _smoothed(step, measured, spread, located, densities) -> tuple[np.ndarray, ...]:
    """Result of `_smooth`: in NumPy for a touch of few frames; compiled for more, padded to a power of two."""
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
    """States (n, 2 d), their covariances, and the mask of accepted positions, at the most likely of the densities."""
    xp, d = namespace(measured), measured.shape[1]
    score, filtered = _filter(step, measured, spread, located, densities)
    best = xp.argmax(score)
    mean, error, predicted_mean, predicted_error, believed = (array[:, best] for array in filtered)

    def back(later, now):
        later_mean, later_error = later
        mean, error, next_mean, next_error, next_step = now
        move = _move(next_step, d)
        gain = xp.linalg.solve(next_error, move @ error).T
        mean = mean + gain @ (later_mean - next_mean)
        error = error + gain @ (later_error - next_error) @ gain.T
        return (mean, error), (mean, error)

    # After the last frame there are only predictions: there the smoother changes nothing.
    beyond = predicted_mean[-1], predicted_error[-1]
    later = (xp.concatenate([array[1:], array[-1:]]) for array in (predicted_mean, predicted_error, step))
    _, (means, errors) = scan(back, beyond, (mean, error, *later), reverse=True)
    return means, errors, believed


def _filter(step, measured, spread, located, densities):
    """Log-likelihood (Q,) of each density, and for every frame and density mean, covariance, their predictions, and
    whether its position was accepted."""
    xp, d = namespace(measured), measured.shape[1]
    limit = float(chdtri(d, _BELIEVED))

    def forward(state, now):
        mean, error = state
        step, place, spread, there = now
        move = _move(step, d)
        mean, error = mean @ move.T, move @ error @ move.T + densities[:, None, None] * _noise(step, d)
        off, inner = place - mean[:, :d], error[:, :d, :d] + spread
        gain = xp.swapaxes(xp.linalg.solve(inner, error[:, :d]), 1, 2)
        square = xp.sum(off * xp.linalg.solve(inner, off[:, :, None])[:, :, 0], axis=1)
        believed = there & (square < limit)
        logarithm = xp.log(xp.linalg.det(inner))
        # A rejected position still lowers the likelihood of a density, as much as one at the limit.
        score = xp.where(there, -0.5 * (xp.minimum(square, limit) + logarithm), 0.0)
        new_mean = xp.where(believed[:, None], mean + xp.einsum("qij,qj->qi", gain, off), mean)
        # Joseph's form, which is symmetric: the textbook difference is lost in rounding where positions are exact.
        keep = xp.eye(2 * d) - xp.concatenate([gain, xp.zeros_like(gain)], axis=2)
        updated = keep @ error @ xp.swapaxes(keep, 1, 2) + gain @ spread @ xp.swapaxes(gain, 1, 2)
        new_error = xp.where(believed[:, None, None], (updated + xp.swapaxes(updated, 1, 2)) / 2, error)
        return (new_mean, new_error), (score, new_mean, new_error, mean, error, believed)

    begin = xp.concatenate([measured[0], xp.zeros(d)])
    wide = xp.concatenate([1e4 * xp.trace(spread[0]) * xp.ones(d), xp.full(d, _FIRST_SPEED**2)])
    many = len(densities)
    first = xp.tile(begin, (many, 1)), xp.tile(xp.diag(wide), (many, 1, 1))
    _, (score, *rest) = scan(forward, first, (step, measured, spread, located))
    return xp.sum(score, axis=0), rest


def _move(step, d: int) -> Float[Array, "s s"]:
    """Transition matrix of position and velocity for a time step."""
    xp = namespace(step)
    return xp.kron(xp.eye(2) + step * xp.eye(2, k=1), xp.eye(d))


def _noise(step, d: int) -> Float[Array, "s s"]:
    """Covariance of position and velocity after a step of white acceleration of density 1."""
    xp = namespace(step)
    return xp.kron(xp.stack([step**3 / 3, step**2 / 2, step**2 / 2, step]).reshape(2, 2), xp.eye(d))
