"""Kohonen's learning rule in two phases, compiled: a map learns the order of its inputs, then their detail.

For each frame x the winner c is the neuron whose weights are nearest; every neuron n moves by

    w_n ← w_n + ε h_cn (x − w_n),    h_cn = exp(−|r_c − r_n|² / 2ρ²)

with r_n its place on the grid (Kohonen, Self-Organizing Maps, 2001, chapter 3). In the ordering phase ρ shrinks; in the
tuning phase, where ρ is next to nothing, the winner alone moves. ε falls throughout.

Distances from w and from w − m to x and x − m are the same: all is done about the frames' mean m, whose differences
are small. The winner of |w|² − 2 w·x needs squares and products alone, and these follow from those before the step:

    w′·y = (1 − ε h) w·y + ε h x·y,    |w′|² = (1 − ε h)² |w|² + 2 ε h (1 − ε h) w·x + (ε h)² |x|²

so that weights are multiplied with some frames at once, and moved once after them.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jeit.arguments import is_number, real_array, told

# Frames after which weights are moved.
_AT_ONCE = 16
# A radius, grid steps, within which there is the winner alone: of its neighbours exp(−1/2ρ²) is no number.
_ALONE = 0.01


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
                raise ValueError(f"{name} must be a whole number of frames, zero or more; it is {told(value)}.")
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

    def radii(self, shape: tuple[int, int]) -> Float[np.ndarray, " T"]:
        """ρ at every frame shown to a map of this `shape`, grid steps."""
        first, last = (max(max(shape) / 2, 1.0), 1.0) if self.radius is None else self.radius
        return np.concatenate([np.geomspace(first, last, self.ordering), np.full(self.tuning, _ALONE)])


@jax.jit
def train(
    weights: Float[Array, "R C M"],
    frames: Float[Array, "N M"],
    order: Int[Array, " T"],
    rates: Float[Array, " T"],
    radii: Float[Array, " T"],
) -> tuple[Float[Array, "R C M"], Float[Array, " T"]]:
    """Weights (R, C, M) after those of the frames (N, M) were shown that `order` (T,) numbers, with these rates and
    radii (T,), grid steps; and the mean of all weights after each (T,). Under `jax.vmap` too, over starts, orders and
    rates."""
    rows, columns, channels = weights.shape
    middle = frames.mean(axis=0)
    frames = frames - middle
    row, column = jnp.arange(rows)[:, None], jnp.arange(columns)[None, :]

    def share_of(winner, rate, radius):
        best_row, best_column = jnp.divmod(winner, columns)
        return rate * jnp.exp(-((row - best_row) ** 2 + (column - best_column) ** 2) / (2 * radius**2)).reshape(-1)

    def show_some(state, now):
        # In the end weights are `kept` w + Σ `moved` x.
        flat, squares, level = state
        some, *how = now
        shown = frames[some]
        among, levels = shown @ shown.T, shown.mean(axis=1)

        def show(state, now):
            inner, kept, moved, squares, level = state
            one, rate, radius = now
            share = share_of(jnp.argmin(squares - 2 * inner[one]), rate, radius)
            rest = 1 - share
            squares = rest**2 * squares + 2 * share * rest * inner[one] + share**2 * among[one, one]
            inner = rest * inner + share * among[one][:, None]
            moved = (rest * moved).at[one].set(share)
            level = rest * level + share * levels[one]
            return (inner, rest * kept, moved, squares, level), level.mean()

        before = shown @ flat.T, jnp.ones_like(squares), jnp.zeros((len(some), len(flat))), squares, level
        (_, kept, moved, squares, level), curve = jax.lax.scan(show, before, (jnp.arange(len(some)), *how))
        return (kept[:, None] * flat + moved.T @ shown, squares, level), curve

    flat = (weights - middle).reshape(-1, channels)
    state = flat, jnp.sum(flat**2, axis=1), flat.mean(axis=1)
    more = -order.size % _AT_ONCE
    order, rates = jnp.pad(order, (0, more)), jnp.pad(rates, (0, more))  # frames at a rate of 0 change nothing
    radii = jnp.pad(radii, (0, more), constant_values=1.0)
    (flat, _, _), curve = jax.lax.scan(
        show_some, state, tuple(one.reshape(-1, _AT_ONCE) for one in (order, rates, radii))
    )
    return flat.reshape(weights.shape) + middle, curve.reshape(-1)[: curve.size - more] + middle.mean()


def _check_falling(name: str, value, most: float, wanted: str) -> None:
    span = real_array(name, value, f"the first and the last: {wanted}")
    if span.shape != (2,) or not 0 < span[1] <= span[0] <= most or not np.isfinite(span).all():
        raise ValueError(f"{name} must be the first and the last, positive and not rising: {wanted}; it is {value!r}.")
