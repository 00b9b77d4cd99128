"""The localiser: intensities of many frames to positions, by maximum likelihood or by intensity consistency.

Each frame is screened on a coarse grid, its best two valleys are descended, and a minimum beyond the outline gives way
to the best place on the outline. All of it is one compiled program, differentiable by the implicit function theorem in
the intensities, the microphones' positions and the decay models.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jeit.acoustic.consistency import Consistency
from jeit.acoustic.likelihood import Likelihood, Listeners
from jeit.acoustic.surface import AbstractSurface, box, chart_grid, in_space, sides, size
from jeit_solvers import Minimum, inverse_few, minimise_few, solve_few

METHODS = {"likelihood": Likelihood, "consistency": Consistency}
# Places screened: in the outline's box, and along the outline.
_COARSE, _EDGE = 400, 240
# Frames worked on together: all their arrays stay in the cache.
_CHUNK = 1024
# Two valleys closer than this part of the skin's size are one.
_SAME_VALLEY = 0.05


class Estimate(eqx.Module):
    """What is found of F frames.

    `position` (F, d) in metres, on the surface and inside its outline; its `covariance` (F, d, d) in m²; `strength`
    (F,), in units of intensity; `misfit` (F,), chi-square of what one source at this place does not explain, with
    `freedom` (F,) degrees; `excess` (F,), by how much a place beyond the outline would lower −2 log-likelihood (0 for
    places inside); `rival` (F,), by how much the second best valley is worse (∞ if there is none); `converged` (F,).
    """

    position: Float[Array, "F d"]
    covariance: Float[Array, "F d d"]
    strength: Float[Array, " F"]
    misfit: Float[Array, " F"]
    freedom: Int[Array, " F"]
    excess: Float[Array, " F"]
    rival: Float[Array, " F"]
    converged: Bool[Array, " F"]


class Pixels(eqx.Module):
    """A raster over the outline's box: chart coordinates (2, P), which are `inside` (P,), rows and columns."""

    chart: Float[Array, "2 P"]
    inside: Bool[Array, " P"]
    shape: tuple[int, int] = eqx.field(static=True)

    @classmethod
    def create(cls, surface, columns: int, rows: int) -> "Pixels":
        """Of so many pixels; bottom row first."""
        grid, within = chart_grid(surface, columns, rows)
        if not within.any():
            raise ValueError(f"shape: none of {columns} × {rows} pixels has its middle inside the outline; take more.")
        return cls(jnp.asarray(grid.reshape(2, -1)), jnp.asarray(within.ravel()), (rows, columns))


class Localiser(eqx.Module):
    """Finds sources from intensities; make one with `Localiser.create` and call it."""

    listeners: Listeners
    coarse: Pixels
    pixels: Pixels | None
    responses: Float[Array, "M P"] | None
    method: str = eqx.field(static=True)

    @classmethod
    def create(
        cls,
        listeners: Listeners,
        *,
        method: str = "likelihood",
        map_shape: tuple[int, int] | None = None,
    ) -> "Localiser":
        """`method`: "likelihood", or "consistency" for the paper's loss. `map_shape`: (rows, columns) of the raster on
        which every frame's whole map is worked out and where the descent starts, (200, 200) in the paper; a coarse grid
        of 400 places and no maps unless given. Raises `ValueError` for another method, or a shape that makes no sense.
        """
        if method not in METHODS:
            raise ValueError(f"method must be one of {', '.join(METHODS)}; it is {method!r}.")
        low, high = box(listeners.surface)
        sides_of_box = np.asarray(high - low)
        spacing = np.sqrt(np.prod(sides_of_box) / _COARSE)
        counts = [max(3, round(side / spacing)) for side in sides_of_box]
        coarse = Pixels.create(listeners.surface, *counts)
        if map_shape is None:
            return cls(listeners, coarse, None, None, method)
        if len(map_shape) != 2 or min(map_shape) < 2:
            raise ValueError(f"map_shape must be (rows, columns) of at least two each; it is {map_shape!r}.")
        pixels = Pixels.create(listeners.surface, int(map_shape[1]), int(map_shape[0]))
        responses = jnp.exp(listeners.log_response(pixels.chart))
        return cls(listeners, coarse, pixels, responses, method)

    def __call__(self, power: ArrayLike, use: ArrayLike | None = None) -> Estimate:
        """Locate the source of each frame. `power` (F, M): intensities above the floor; `use`: which to look at, all
        that are finite unless given. Frames with fewer than three usable microphones give NaN."""
        return self._run(power, use, False)[0]

    def with_maps(
        self, power: ArrayLike, use: ArrayLike | None = None
    ) -> tuple[Estimate, Float[Array, "F rows columns"]]:
        """The same, and the map of each frame: the paper's loss, relative to the square of the loudest intensity, or
        minus the log-likelihood; bottom row first, NaN outside the outline. Raises `ValueError` without `map_shape`."""
        if self.pixels is None:
            raise ValueError("maps were not asked for: make the Localiser with map_shape=(rows, columns).")
        return self._run(power, use, True)

    def _run(self, power, use, with_maps):
        power = jnp.asarray(power, float)
        finite = jnp.isfinite(power)
        use = finite if use is None else finite & jnp.asarray(use, bool)
        if power.ndim != 2 or power.shape != use.shape or power.shape[1] != len(self.listeners.microphones):
            raise ValueError(
                f"power has shape {power.shape} and use {use.shape}; give (frames, microphones) with "
                f"{len(self.listeners.microphones)} microphones."
            )
        return _locate(self, power, use, with_maps)


@eqx.filter_jit
def _locate(localiser: Localiser, power, use, with_maps):
    number = power.shape[0]
    size_of_chunk = min(_CHUNK if localiser.pixels is None else 32, max(number, 1))
    chunks = -(-number // size_of_chunk)
    pad = ((0, chunks * size_of_chunk - number), (0, 0))

    def cut(array):
        return jnp.pad(array, pad).reshape(chunks, size_of_chunk, -1).transpose(0, 2, 1)

    def work(chunk):
        return _locate_chunk(localiser, chunk[0], chunk[1], with_maps)

    found = jax.lax.map(work, (cut(power), cut(use)))
    return jax.tree.map(lambda array: array.reshape(-1, *array.shape[2:])[:number], found)


def _locate_chunk(localiser: Localiser, power, use, with_maps) -> tuple[Estimate, Array | None]:
    """`power` and `use` (M, F)."""
    listeners = localiser.listeners
    # Without a floor, what is not positive has no logarithm: nothing is known of such a reading.
    use = use & (power + listeners.noise.floor[:, None] > 0)
    fixed = jax.lax.stop_gradient(listeners)
    frozen = jax.lax.stop_gradient(power)
    still = METHODS[localiser.method].create(frozen, use, fixed)
    # The paper's map is searched where maps are made; the coarse grid otherwise.
    if localiser.pixels is None:
        pixels, response = localiser.coarse, jnp.exp(fixed.log_response(localiser.coarse.chart))
    else:
        pixels, response = localiser.pixels, localiser.responses
    maps = still.screen(response)
    starts = jnp.concatenate(_valleys(maps, pixels), axis=1)
    twice = METHODS[localiser.method].create(jnp.tile(frozen, 2), jnp.tile(use, 2), fixed)
    reach = size(fixed.surface)
    unknowns, excess, rival, converged, side = _descend(still, twice, starts)
    likelihood = Likelihood.create(power, use, listeners)
    objective = likelihood if localiser.method == "likelihood" else Consistency.create(power, use, listeners)
    unknowns = _differentiable(objective, unknowns, side, reach)
    estimate = _describe(objective, likelihood, unknowns, excess, rival, converged)
    if not with_maps:
        return estimate, None
    shown = jnp.where(pixels.inside, maps, jnp.nan)
    return estimate, shown.reshape(-1, *pixels.shape)


def _valleys(maps, pixels: Pixels):
    """Chart coordinates (2, F) of each map's least pixel, and of the least local minimum elsewhere (the same again if
    there is none)."""
    values = jnp.where(pixels.inside, maps, jnp.inf)
    values = jnp.where(jnp.isnan(values), jnp.inf, values)
    best = jnp.argmin(values, axis=1)
    first = pixels.chart[:, best]
    if pixels.shape[0] * pixels.shape[1] > 2000:  # a fine map: valleys are found by the descent's own grid
        return first, first
    square = values.reshape(-1, *pixels.shape)
    wide = jnp.pad(square, ((0, 0), (1, 1), (1, 1)), constant_values=jnp.inf)
    rows, columns = pixels.shape
    least = square
    for i in range(3):
        for j in range(3):
            least = jnp.minimum(least, wide[:, i : i + rows, j : j + columns])
    lowest = (square <= least).reshape(values.shape) & jnp.isfinite(values)
    lowest = lowest.at[jnp.arange(len(best)), best].set(False)
    other = jnp.argmin(jnp.where(lowest, values, jnp.inf), axis=1)
    return first, jnp.where(jnp.any(lowest, axis=1), pixels.chart[:, other], first)


def _descend(objective, twice, starts):
    """From both starts, (2, 2 F), of the objective's frames: unknowns (n, F), by how much the outline costs more than
    what lies beyond, by how much the rival valley does, whether converged, and the (start, end) of the side of the
    outline on which frames were held, NaN for those inside."""
    surface = objective.listeners.surface
    found = _minimise(twice.expand, twice.start(starts), surface)
    half = starts.shape[1] // 2
    value = jnp.where(jnp.isfinite(found.value), found.value, jnp.inf)
    one, other = value[:half], value[half:]
    swap = other < one
    unknowns = jnp.where(swap, found.x[:, half:], found.x[:, :half])
    apart = jnp.linalg.norm(found.x[:2, :half] - found.x[:2, half:], axis=0) > _SAME_VALLEY * size(surface)
    rival = jnp.where(apart, jnp.abs(one - other), jnp.inf)
    converged = jnp.where(swap, found.converged[half:], found.converged[:half])
    value = jnp.minimum(one, other)
    outside = ~surface.outline.contains(unknowns[:2].T) & jnp.isfinite(value)
    nowhere = jnp.full((2, 2, half), jnp.nan)

    def hold(_):
        held, side = _on_edge(objective)
        return (
            jnp.where(outside, held.x, unknowns),
            jnp.where(outside, held.value - value, 0.0),
            jnp.where(outside, held.converged, converged),
            jnp.where(outside, side, nowhere),
        )

    def leave(_):
        return unknowns, jnp.zeros_like(value), converged, nowhere

    unknowns, excess, converged, side = jax.lax.cond(jnp.any(outside), hold, leave, None)
    return unknowns, excess, rival, converged, side


def _minimise(expand, start, surface: AbstractSurface) -> Minimum:
    """Within three times the outline's box; steps of at most a quarter of the skin, and a factor of ten in strength."""
    low, high = box(surface)
    rest = jnp.full(start.shape[0] - 2, jnp.inf)
    reach = size(surface)
    return minimise_few(
        expand,
        start,
        lower=jnp.concatenate([low - reach, -rest])[:, None],
        upper=jnp.concatenate([high + reach, rest])[:, None],
        largest_step=jnp.concatenate([jnp.full(2, reach / 4), jnp.full_like(rest, 2.3)])[:, None],
        tolerance=1e-12,
    )


def _on_edge(objective) -> tuple[Minimum, Array]:
    """The best place on the outline: the best of many, refined along its side. Also the side, (2, 2, F)."""
    start, end = sides(objective.listeners.surface)
    length = jnp.linalg.norm(end - start, axis=0)
    # Places at equal steps along the whole outline, as (side, share of the side).
    stops = jnp.concatenate([jnp.zeros(1), jnp.cumsum(length)])
    walked = stops[-1] * (jnp.arange(_EDGE) + 0.5) / _EDGE
    which = jnp.clip(jnp.searchsorted(stops, walked, side="right") - 1, 0, length.size - 1)
    share = (walked - stops[which]) / length[which]
    chart = start[:, which] + share * (end - start)[:, which]
    maps = objective.screen(jnp.exp(objective.listeners.log_response(chart)))
    best = jnp.argmin(jnp.where(jnp.isnan(maps), jnp.inf, maps), axis=1)
    origin, along = start[:, which[best]], (end - start)[:, which[best]]
    first = objective.start(chart[:, best])[2:]

    def unknowns_of(z):
        return jnp.concatenate([origin + z[0] * along, z[1:]])

    def expand(z):
        value, gradient, matrix = objective.expand(unknowns_of(z))
        turned = jnp.concatenate([jnp.sum(along * gradient[:2], axis=0)[None], gradient[2:]])
        rows = jnp.concatenate([jnp.einsum("kf,klf->lf", along, matrix[:2])[None], matrix[2:]])
        columns = jnp.concatenate([jnp.einsum("klf,lf->kf", rows[:, :2], along)[:, None], rows[:, 2:]], axis=1)
        return value, turned, columns

    rest = first.shape[0]
    found = minimise_few(
        expand,
        jnp.concatenate([share[best][None], first]),
        lower=jnp.array([0.0] + rest * [-jnp.inf])[:, None],
        upper=jnp.array([1.0] + rest * [jnp.inf])[:, None],
        largest_step=jnp.array([0.5] + rest * [2.3])[:, None],
        tolerance=1e-12,
    )
    end_of = origin + along
    corner = (found.x[0] <= 0) | (found.x[0] >= 1)
    # Held in a corner, a frame moves nowhere: its side has no length.
    side = jnp.stack([origin, jnp.where(corner, origin, end_of)])
    return Minimum(unknowns_of(found.x), found.value, found.converged, found.steps), side


def _differentiable(objective, unknowns, side, reach):
    """The minimum as a function of everything in `objective`: one Newton step from it, x − H⁻¹ ∇cost, is zero in value
    and, H and x being constants, −H⁻¹ ∂∇cost in derivative, as the implicit function theorem has it."""
    at = jax.lax.stop_gradient(unknowns)

    def slope(x, function):
        return jax.grad(lambda y: jnp.sum(jnp.where(jnp.isfinite(cost := function(y)), cost, 0.0)))(x)

    constant = jax.lax.stop_gradient(objective)
    columns = [
        jax.jvp(lambda x: slope(x, constant.cost), (at,), (direction,))[1]
        for direction in jnp.eye(len(at))[:, :, None] * jnp.ones_like(at)
    ]
    matrix = jnp.stack(columns)
    gradient = slope(at, objective.cost)
    # Frames held on the outline move along their side only: the rest of the step is projected out.
    held = ~jnp.isnan(side[0, 0])
    along = jnp.where(held, side[1] - side[0], 0.0)
    length = jnp.linalg.norm(jnp.where(along == 0, 1e-300, along), axis=0)
    along = jnp.where(length > 1e-12 * reach, along / length, 0.0)
    plane = jnp.where(held, along[:, None] * along[None], jnp.eye(2)[:, :, None])
    keep = jnp.zeros_like(matrix) + jnp.eye(len(at))[:, :, None]
    keep = keep.at[:2, :2].set(plane)
    gradient = jnp.einsum("klf,lf->kf", keep, gradient)
    inner = jnp.einsum("klf,lmf,mnf->knf", keep, matrix, keep)
    trace = jnp.maximum(jnp.einsum("kkf->f", inner), 1e-300)
    matrix = inner + (jnp.eye(len(at))[:, :, None] - keep) * trace
    step = solve_few(matrix, gradient)
    usable = jnp.all(jnp.isfinite(step), axis=0) & (jnp.max(jnp.abs(step[:2]), axis=0) < 1e-3 * reach)
    return at - jnp.where(usable, step, 0.0)


def _describe(objective, likelihood: Likelihood, unknowns, excess, rival, converged) -> Estimate:
    surface, chart = likelihood.listeners.surface, unknowns[:2]
    if isinstance(objective, Likelihood):
        strength = jnp.exp(unknowns[2])
        spread = inverse_few(likelihood.expand(unknowns)[2])[:2, :2]
    else:
        strength = likelihood.strength(jnp.exp(likelihood.listeners.log_response(chart)))
        spread = objective.covariance(chart, strength)
    misfit = likelihood.misfit(jnp.concatenate([chart, jnp.log(strength)[None]]))
    place, covariance = in_space(surface, chart, spread)
    number = jnp.sum(likelihood.use, axis=0)
    known = (number >= 3) & jnp.all(jnp.isfinite(unknowns), axis=0)
    return Estimate(
        position=jnp.where(known[:, None], place, jnp.nan),
        covariance=jnp.where(known[:, None, None], covariance, jnp.nan),
        strength=jnp.where(known, strength, jnp.nan),
        misfit=jnp.where(known, misfit, jnp.nan),
        freedom=jnp.maximum(number - 3, 0),
        excess=jnp.where(known, 2 * excess, jnp.nan),
        rival=jnp.where(known, 2 * rival, jnp.nan),
        converged=converged & known,
    )
