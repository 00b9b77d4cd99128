"""Training of a self-organising map by Kohonen's rule, compiled, in two phases: ordering of the neurons, then fine
tuning.

For each frame x, the winner c is the neuron whose weights are nearest to x, and the weights w_n of every neuron n move
by

    w_n ← w_n + ε h_cn (x − w_n),    h_cn = exp(−|r_c − r_n|² / 2ρ²)

where r_n is the neuron's place on the grid (Kohonen, Self-Organizing Maps, 2001, chapter 3). In the ordering phase, the
neighbourhood radius ρ decreases; in the tuning phase, ρ is almost zero, so only the winner moves. The learning rate ε
decreases throughout.

The mean of the frames is subtracted first, since frames differ little from their mean. When weights w move by the share
s = ε h of the way to x, the squared distance of the new weights w′ from any frame y is

    |w′ − y|² = (1 − s) |w − y|² + s |x − y|² − s (1 − s) |w − x|²

(Stewart's theorem). So the products of the weights with several frames are computed at once, and the weights are moved
once after these frames. In between, only squared distances are updated; in the tuning phase, only those of the winner.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jeit.arguments import describe, is_number, real_array
from jeit_solvers.module import Module

# Number of frames after which the weights of a map are moved, in the ordering and in the tuning phase.
_ORDERING_FRAMES, _TUNING_FRAMES = 16, 64
# Mode of indexing arrays in JAX: all indices are within bounds, since they are indices of neurons. In other modes, JAX
# copies all distances.
_INDEXING_MODE = "promise_in_bounds"


class MapSchedule(Module):
    """Schedule of a self-organising map's training: number of frames, learning rate and neighbourhood radius.

    **Fields**: `ordering` and `tuning`: number of frames shown in each phase; `rate`: learning rate at the first and
    the last frame, with exponential decay between them; `radius`: neighbourhood radius at the first and the last frame
    of the ordering phase, in grid steps, also with exponential decay; if None, from half the map's longer side to 1.

    **Example:**

    ```python
    schedule = MapSchedule(ordering=500, tuning=500)
    learnt_map = SelfOrganisingMap.fit(map_frames, key, shape=(6, 6), schedule=schedule)
    ```
    """

    ordering: int = 20_000
    tuning: int = 20_000
    rate: tuple[float, float] = (0.3, 0.02)
    radius: tuple[float, float] | None = None

    def __check_init__(self):
        """Check the fields. Raises `ValueError` for invalid numbers of frames, learning rates and radii."""
        for field_name in ("ordering", "tuning"):
            field_value = getattr(self, field_name)
            if not (is_number(field_value) and int(field_value) == field_value and field_value >= 0):
                raise ValueError(
                    f"{field_name} must be a whole number of frames, zero or more; it is {describe(field_value)}."
                )
        if not self.ordering + self.tuning:
            raise ValueError("ordering and tuning are both zero: nothing would be learnt.")
        _check_decreasing("rate", self.rate, 1.0, "shares of the way to a frame, at most 1, such as (0.3, 0.02)")
        if self.radius is not None:
            _check_decreasing("radius", self.radius, np.inf, "steps of the grid, such as (16.0, 1.0)")

    @property
    def steps(self) -> int:
        """Total number of frames shown in the training of a map."""
        return self.ordering + self.tuning

    def rates(self) -> Float[np.ndarray, " T"]:
        """Compute the learning rate for every frame shown in training."""
        return np.geomspace(*self.rate, self.steps)

    def radii(self, shape: tuple[int, int]) -> Float[np.ndarray, " O"]:
        """Compute the neighbourhood radius for every frame of the ordering phase, in grid steps, for a map of this
        `shape`."""
        first_radius, last_radius = (max(max(shape) / 2, 1.0), 1.0) if self.radius is None else self.radius
        return np.geomspace(first_radius, last_radius, self.ordering)


@jax.jit
def train(
    weights: Float[Array, "R C M"],
    frames: Float[Array, "N M"],
    frame_order: Int[Array, " T"],
    rates: Float[Array, " T"],
    radii: Float[Array, " O"],
) -> tuple[Float[Array, "R C M"], Float[Array, " T"]]:
    """Train a map; returns its weights (rows, columns, channels), and the mean of all weights after each frame shown.

    `weights`: initial weights; `frame_order`: indices of the `frames` (frames, channels) in the order in which they are
    shown; `rates`: learning rate for each frame shown; `radii`: neighbourhood radius for each frame of the ordering
    phase, in grid steps. The frames after these are shown in the tuning phase. The function may be mapped by `jax.vmap`
    over weights, orders, rates and radii.
    """
    grid_shape, mean_frame, num_ordering = weights.shape[:2], frames.mean(axis=0), len(radii)

    def train_phase(training_phase, weight_rows, block_size, frame_order, learning_rates, *radii):
        num_padding = -len(frame_order) % block_size
        # Frames are appended to fill the last block; their learning rate is 0, so they change no weights.
        order_rates = [
            jnp.pad(frame_parameters, (0, num_padding)) for frame_parameters in (frame_order, learning_rates)
        ]
        frame_blocks = (
            *order_rates,
            *(jnp.pad(frame_parameters, (0, num_padding), "edge") for frame_parameters in radii),
        )

        def train_block(weight_rows, frame_block):
            frame_indices, *phase_parameters = frame_block
            return training_phase(grid_shape, weight_rows, frames[frame_indices] - mean_frame, *phase_parameters)

        weight_rows, mean_weight_curve = jax.lax.scan(
            train_block,
            weight_rows,
            tuple(frame_parameters.reshape(-1, block_size) for frame_parameters in frame_blocks),
        )
        return weight_rows, mean_weight_curve.reshape(-1)[: len(frame_order)]

    weight_rows, mean_weight_curves = (weights - mean_frame).reshape(-1, weights.shape[2]), []
    if num_ordering:
        weight_rows, mean_weight_curve = train_phase(
            _ordering_phase, weight_rows, _ORDERING_FRAMES, frame_order[:num_ordering], rates[:num_ordering], radii
        )
        mean_weight_curves.append(mean_weight_curve)
    if len(frame_order) > num_ordering:
        weight_rows, mean_weight_curve = train_phase(
            _tuning_phase, weight_rows, _TUNING_FRAMES, frame_order[num_ordering:], rates[num_ordering:]
        )
        mean_weight_curves.append(mean_weight_curve)
    return weight_rows.reshape(weights.shape) + mean_frame, jnp.concatenate(mean_weight_curves) + mean_frame.mean()


def _ordering_phase(grid_shape, weights, frames, learning_rates, radii):
    """Show frames (frames, channels) to a map in the ordering phase, in which all neurons move.

    Returns the weights (neurons, channels) after these frames, and the mean of all weights after each frame.
    """
    grid_rows, grid_columns = jnp.arange(grid_shape[0])[:, None], jnp.arange(grid_shape[1])

    def show_frame(state, frame_step):
        neuron_distances, weight_means = state
        frame_index, learning_rate, radius, frame_distances, frame_mean = frame_step
        own_distances = neuron_distances[frame_index]
        best_row, best_column = _find_winner(own_distances, grid_shape)
        move_fractions = learning_rate * jnp.exp(
            -((grid_rows - best_row) ** 2 + (grid_columns - best_column) ** 2) / (2 * radius**2)
        ).reshape(-1)
        neuron_distances = (1 - move_fractions) * neuron_distances + move_fractions * (
            frame_distances[:, None] - (1 - move_fractions) * own_distances
        )
        weight_means = weight_means + move_fractions * (frame_mean - weight_means)
        return (neuron_distances, weight_means), (move_fractions, weight_means.mean())

    initial_state, frame_distances = (
        (_squared_distances(frames, weights), weights.mean(axis=1)),
        _squared_distances(frames, frames),
    )
    frame_steps = jnp.arange(len(frames)), learning_rates, radii, frame_distances, frames.mean(axis=1)
    _, (move_fractions, mean_weight_curve) = jax.lax.scan(show_frame, initial_state, frame_steps)
    return _move_weights(weights, move_fractions, frames), mean_weight_curve


def _tuning_phase(grid_shape, weights, frames, learning_rates):
    """Show frames (frames, channels) to a map in the tuning phase, in which only the winner moves.

    Returns the weights (neurons, channels) after these frames, and the mean of all weights after each frame."""

    def show_frame(state, frame_step):
        neuron_distances, weight_means, (winning_neuron, winning_distances) = state
        frame_index, learning_rate, frame_distances, frame_mean = frame_step
        # The distances of the previous frame's winner are written before any distances are read, which avoids a copy of
        # the array.
        neuron_distances = neuron_distances.at[:, winning_neuron].set(winning_distances, mode=_INDEXING_MODE)
        winner_row, winner_column = _find_winner(neuron_distances[frame_index], grid_shape)
        winning_neuron = winner_row * grid_shape[1] + winner_column
        distances_before_move = neuron_distances.at[:, winning_neuron].get(mode=_INDEXING_MODE)
        winning_distances = (1 - learning_rate) * distances_before_move + learning_rate * (
            frame_distances - (1 - learning_rate) * distances_before_move[frame_index]
        )
        weight_means = weight_means.at[winning_neuron].add(
            learning_rate * (frame_mean - weight_means[winning_neuron]), mode=_INDEXING_MODE
        )
        return (neuron_distances, weight_means, (winning_neuron, winning_distances)), (
            winning_neuron,
            weight_means.mean(),
        )

    neuron_distances, frame_distances = _squared_distances(frames, weights), _squared_distances(frames, frames)
    initial_state = neuron_distances, weights.mean(axis=1), (jnp.zeros((), int), neuron_distances[:, 0])
    frame_steps = jnp.arange(len(frames)), learning_rates, frame_distances, frames.mean(axis=1)
    _, (winners, mean_weight_curve) = jax.lax.scan(show_frame, initial_state, frame_steps)
    move_fractions = jnp.where(winners[:, None] == winners, learning_rates[:, None], 0.0)
    return weights.at[winners].set(_move_weights(weights[winners], move_fractions, frames)), mean_weight_curve


def _squared_distances(frames, weights):
    """Compute the squared Euclidean distances (frames, neurons) of frames from the weights of neurons."""
    return jnp.sum(frames**2, axis=1)[:, None] + jnp.sum(weights**2, axis=1) - 2 * frames @ weights.T


def _find_winner(neuron_distances, grid_shape):
    """Find the row and the column of the neuron with the smallest of the `neuron_distances` (neurons,).

    The minimum of each column of the grid is found first, for many columns at once.
    """
    distances_on_grid = neuron_distances.reshape(grid_shape)
    winner_column = jnp.argmin(distances_on_grid.min(axis=0))
    return jnp.argmin(distances_on_grid[:, winner_column]), winner_column


def _move_weights(weights, move_fractions, frames):
    """Move the weights of neurons towards frames, one frame after another, by `move_fractions` (frames, neurons) of the
    remaining way."""

    def split_remaining_weight(remaining_weight, move_fraction):
        return remaining_weight * (1 - move_fraction), remaining_weight * move_fraction

    # From the last frame to the first: later frames reduce the contribution of a frame by their own shares.
    weight_shares, frame_shares = jax.lax.scan(
        split_remaining_weight, jnp.ones(len(weights)), move_fractions, reverse=True
    )
    return weight_shares[:, None] * weights + frame_shares.T @ frames


def _check_decreasing(option_name: str, option_value, max_value: float, requirement_text: str) -> None:
    first_and_last = real_array(option_name, option_value, f"the first and the last: {requirement_text}")
    if (
        first_and_last.shape != (2,)
        or not 0 < first_and_last[1] <= first_and_last[0] <= max_value
        or not np.isfinite(first_and_last).all()
    ):
        raise ValueError(
            f"{option_name} must be the first and the last, positive and not rising: {requirement_text}; it is "
            f"{option_value!r}."
        )
