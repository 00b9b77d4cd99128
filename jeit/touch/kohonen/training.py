"""Kohonen's learning rule in two phases, compiled: a map learns the order of its inputs, then their detail.

For each frame x the winner c is the neuron whose weights are nearest; every neuron n moves by

    w_n ← w_n + ε h_cn (x − w_n),    h_cn = exp(−|r_c − r_n|² / 2ρ²)

with r_n its place on the grid (Kohonen, Self-Organizing Maps, 2001, chapter 3). In the ordering phase ρ shrinks; in the
tuning phase, where ρ is next to nothing, the winner alone moves. ε falls throughout.

All is done about the frames' mean, whose differences are small. A weight that moves to x by the share s = ε h comes

    |w′ − y|² = (1 − s) |w − y|² + s |x − y|² − s (1 − s) |w − x|²

far from y, whichever that is (Stewart's theorem). So weights are multiplied with some frames at once, and moved once
after them: in between, distances alone change, in the tuning phase those of the winner alone.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jeit.arguments import describe, is_number, real_array

# The number of frames after which weights are moved, in either phase.
_ORDERED, _TUNED = 16, 64
# Of neurons that exist: an index that may lie outside costs a copy of all.
_THERE = "promise_in_bounds"


class Schedule(eqx.Module):
    """How a map learns.

    **Fields**: `ordering` and `tuning`, frames shown in each phase; `rate`, ε at the first frame and at the last, which
    falls exponentially between; `radius`, ρ at the first frame of the ordering phase and at its last, grid steps, the
    same; None: half the map's longer side to 1.
    """

    ordering: int = 20_000
    tuning: int = 20_000
    rate: tuple[float, float] = (0.3, 0.02)
    radius: tuple[float, float] | None = None

    def __check_init__(self):
        """Raises `ValueError` for numbers of frames, rates and radii that cannot be."""
        for name in ("ordering", "tuning"):
            value = getattr(self, name)
            if not (is_number(value) and int(value) == value and value >= 0):
                raise ValueError(f"{name} must be a whole number of frames, zero or more; it is {describe(value)}.")
        if not self.ordering + self.tuning:
            raise ValueError("ordering and tuning are both zero: nothing would be learnt.")
        _check_falling("rate", self.rate, 1.0, "shares of the way to a frame, at most 1, such as (0.3, 0.02)")
        if self.radius is not None:
            _check_falling("radius", self.radius, np.inf, "steps of the grid, such as (16.0, 1.0)")

    @property
    def steps(self) -> int:
        """Frames shown in all."""
        return self.ordering + self.tuning

    def rates(self) -> Float[np.ndarray, " T"]:
        """ε at every frame shown."""
        return np.geomspace(*self.rate, self.steps)

    def radii(self, shape: tuple[int, int]) -> Float[np.ndarray, " O"]:
        """ρ at every frame of the ordering phase, shown to a map of this `shape`, grid steps."""
        first, last = (max(max(shape) / 2, 1.0), 1.0) if self.radius is None else self.radius
        return np.geomspace(first, last, self.ordering)


@jax.jit
def train(
    weights: Float[Array, "R C M"],
    frames: Float[Array, "N M"],
    order: Int[Array, " T"],
    rates: Float[Array, " T"],
    radii: Float[Array, " O"],
) -> tuple[Float[Array, "R C M"], Float[Array, " T"]]:
    """Weights (R, C, M) after those of the frames (N, M) were shown that `order` (T,) numbers, with these rates (T,),
    the first O in the ordering phase, with these radii (O,), grid steps, those after them in the tuning phase; and the
    mean of all weights after each (T,). Under `jax.vmap` too, over starts, orders, rates and radii."""
    shape, middle, ordering = weights.shape[:2], frames.mean(axis=0), len(radii)

    def show_all(phase, flat, at_once, order, rates, *radii):
        more = -len(order) % at_once
        # Frames at a rate of 0 change nothing.
        order_rates = [jnp.pad(one, (0, more)) for one in (order, rates)]
        filled = *order_rates, *(jnp.pad(one, (0, more), "edge") for one in radii)

        def show_some(flat, now):
            some, *how = now
            return phase(shape, flat, frames[some] - middle, *how)

        flat, curve = jax.lax.scan(show_some, flat, tuple(one.reshape(-1, at_once) for one in filled))
        return flat, curve.reshape(-1)[: len(order)]

    flat, curves = (weights - middle).reshape(-1, weights.shape[2]), []
    if ordering:
        flat, curve = show_all(_ordered, flat, _ORDERED, order[:ordering], rates[:ordering], radii)
        curves.append(curve)
    if len(order) > ordering:
        flat, curve = show_all(_tuned, flat, _TUNED, order[ordering:], rates[ordering:])
        curves.append(curve)
    return flat.reshape(weights.shape) + middle, jnp.concatenate(curves) + middle.mean()


def _ordered(shape, flat, shown, rates, radii):
    """Weights (k, M) of a map of this shape after frames (n, M), and their means after each (n,): all neurons move."""
    row, column = jnp.arange(shape[0])[:, None], jnp.arange(shape[1])

    def show(state, now):
        distances, level = state
        one, rate, radius, to_others, mean = now
        own = distances[one]
        best_row, best_column = _winner(own, shape)
        share = rate * jnp.exp(-((row - best_row) ** 2 + (column - best_column) ** 2) / (2 * radius**2)).reshape(-1)
        distances = (1 - share) * distances + share * (to_others[:, None] - (1 - share) * own)
        level = level + share * (mean - level)
        return (distances, level), (share, level.mean())

    start, apart = (_squared(shown, flat), flat.mean(axis=1)), _squared(shown, shown)
    each = jnp.arange(len(shown)), rates, radii, apart, shown.mean(axis=1)
    _, (shares, curve) = jax.lax.scan(show, start, each)
    return _moved(flat, shares, shown), curve


def _tuned(shape, flat, shown, rates):
    """As `_ordered`: the winners alone move."""

    def show(state, now):
        distances, level, (winner, moved) = state
        one, rate, to_others, mean = now
        # Of the frame before: written before anything is read, which spares a copy of all distances.
        distances = distances.at[:, winner].set(moved, mode=_THERE)
        row, column = _winner(distances[one], shape)
        winner = row * shape[1] + column
        moved = distances.at[:, winner].get(mode=_THERE)
        moved = (1 - rate) * moved + rate * (to_others - (1 - rate) * moved[one])
        level = level.at[winner].add(rate * (mean - level[winner]), mode=_THERE)
        return (distances, level, (winner, moved)), (winner, level.mean())

    distances, apart = _squared(shown, flat), _squared(shown, shown)
    start = distances, flat.mean(axis=1), (jnp.zeros((), int), distances[:, 0])
    each = jnp.arange(len(shown)), rates, apart, shown.mean(axis=1)
    _, (winners, curve) = jax.lax.scan(show, start, each)
    shares = jnp.where(winners[:, None] == winners, rates[:, None], 0.0)
    return flat.at[winners].set(_moved(flat[winners], shares, shown)), curve


def _squared(shown, flat):
    """Squared distances (n, k) of frames (n, M) from weights (k, M)."""
    return jnp.sum(shown**2, axis=1)[:, None] + jnp.sum(flat**2, axis=1) - 2 * shown @ flat.T


def _winner(distances, shape):
    """Row and column of the least of distances (k,): of each column's least first, which are found many at once."""
    grid = distances.reshape(shape)
    column = jnp.argmin(grid.min(axis=0))
    return jnp.argmin(grid[:, column]), column


def _moved(weights, shares, shown):
    """Weights (k, M) that were moved to frames (n, M), one after another, by `shares` (n, k) of the way."""

    def left(after, share):
        return after * (1 - share), after * share

    # From the last to the first: what there is of a frame in the end is what those after it have left.
    kept, moved = jax.lax.scan(left, jnp.ones(len(weights)), shares, reverse=True)
    return kept[:, None] * weights + moved.T @ shown


def _check_falling(name: str, value, most: float, wanted: str) -> None:
    span = real_array(name, value, f"the first and the last: {wanted}")
    if span.shape != (2,) or not 0 < span[1] <= span[0] <= most or not np.isfinite(span).all():
        raise ValueError(f"{name} must be the first and the last, positive and not rising: {wanted}; it is {value!r}.")
