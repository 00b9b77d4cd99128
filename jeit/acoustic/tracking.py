"""Tracks: places of one frame after another, smoothed in time, and when each touch begins and ends.

A touch moves with a velocity that changes at random: white acceleration of spectral density q (m²/s³). Places are
filtered forwards by Kalman's filter and smoothed backwards after Rauch, Tung and Striebel; frames without a place are
passed over, and one too far from where the touch can be is not believed. q is the likeliest of a range.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import chdtri

from jeit.acoustic.localisation.locations import Locations
from jeit.arguments import check_kind
from jeit_solvers import solve_small

# Densities tried: from a finger that rests to one that is flung about (m²/s³).
_DENSITIES = np.geomspace(1e-5, 10.0, 13)
_BELIEVED = 1e-4
# Speed (m/s) that a touch may begin with, one standard deviation.
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
    """Smooth the places of a recording, touch by touch.

    `gap`: seconds without a place after which a touch has ended. `acceleration`: spectral density q of the random
    acceleration (m²/s³), the likeliest of a range unless given. Errors of windows that share a sample are alike:
    covariances are taken `locations.overlap` times as wide. Raises `ValueError` for what is not positive, and for what
    are no locations.
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
        # A covariance may be singular, on a curved surface; nothing is known better than a tenth of a micrometre.
        spread = spread + 1e-14 * np.eye(d)
        size = 1 << int(last - first).bit_length()
        pad = size - (last + 1 - first)
        step = np.diff(times[part], prepend=times[first])
        arrays = (
            np.pad(step, (0, pad)),
            np.pad(measured, ((0, pad), (0, 0))),
            np.concatenate([spread, np.broadcast_to(np.eye(d), (pad, d, d))]),
            np.pad(located[part], (0, pad)),
        )
        state, error, believed = _smooth(*(jnp.asarray(array) for array in arrays), jnp.asarray(densities))
        kept = last + 1 - first
        position[part], velocity[part] = np.asarray(state)[:kept, :d], np.asarray(state)[:kept, d:]
        covariance[part] = np.asarray(error)[:kept, :d, :d]
        rejected[part] = located[part] & ~np.asarray(believed)[:kept]
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


@jax.jit
def _smooth(step, measured, spread, located, densities):
    """States (n, 2 d), their covariances, and which places were believed, at the likeliest of the densities."""
    filtered = jax.vmap(lambda density: _filter(step, measured, spread, located, density))(densities)
    best = jnp.argmax(filtered[0])
    mean, error, predicted_mean, predicted_error, believed = jax.tree.map(lambda array: array[best], filtered[1])
    d = measured.shape[1]

    def back(later, now):
        later_mean, later_error = later
        mean, error, next_mean, next_error, next_step = now
        move = _move(next_step, d)
        gain = _solve(next_error, move @ error).T
        mean = mean + gain @ (later_mean - next_mean)
        error = error + gain @ (later_error - next_error) @ gain.T
        return (mean, error), (mean, error)

    last = (mean[-1], error[-1])
    rest = (mean[:-1], error[:-1], predicted_mean[1:], predicted_error[1:], step[1:])
    _, (means, errors) = jax.lax.scan(back, last, rest, reverse=True)
    return jnp.concatenate([means, mean[-1:]]), jnp.concatenate([errors, error[-1:]]), believed


def _filter(step, measured, spread, located, density):
    """Log-likelihood, and for every frame mean, covariance, their predictions, and whether its place was believed."""
    d = measured.shape[1]
    limit = float(chdtri(d, _BELIEVED))

    def forward(state, now):
        mean, error = state
        step, place, spread, there = now
        move = _move(step, d)
        mean, error = move @ mean, move @ error @ move.T + density * _noise(step, d)
        off, inner = place - mean[:d], error[:d, :d] + spread
        gain = _solve(inner, error[:d]).T
        square = off @ _solve(inner, off[:, None])[:, 0]
        believed = there & (square < limit)
        logarithm = jnp.log(jnp.linalg.det(inner))
        # A place not believed still counts against a density, as much as one at the limit.
        score = jnp.where(there, -0.5 * (jnp.minimum(square, limit) + logarithm), 0.0)
        new_mean = jnp.where(believed, mean + gain @ off, mean)
        # Joseph's form, and symmetric: the difference of the textbook's is lost in rounding where places are exact.
        keep = jnp.eye(2 * d).at[:, :d].add(-gain)
        updated = keep @ error @ keep.T + gain @ spread @ gain.T
        new_error = jnp.where(believed, (updated + updated.T) / 2, error)
        return (new_mean, new_error), (score, new_mean, new_error, mean, error, believed)

    begin = jnp.concatenate([measured[0], jnp.zeros(d)])
    wide = jnp.concatenate([1e4 * jnp.trace(spread[0]) * jnp.ones(d), jnp.full(d, _FIRST_SPEED**2)])
    _, (score, *rest) = jax.lax.scan(forward, (begin, jnp.diag(wide)), (step, measured, spread, located))
    return jnp.sum(score), tuple(rest)


def _move(step, d: int) -> Float[Array, "s s"]:
    return jnp.eye(2 * d).at[:d, d:].set(step * jnp.eye(d))


def _noise(step, d: int) -> Float[Array, "s s"]:
    block = jnp.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
    return jnp.kron(block, jnp.eye(d))


def _solve(matrix: Float[Array, "n n"], right: Float[Array, "n m"]) -> Float[Array, "n m"]:
    return solve_small(matrix[:, :, None] * jnp.ones(right.shape[1]), right)
