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
from jeit.acoustic.surface import box, chart_grid, in_space, sides, size
from jeit_solvers import Minimum, definite_few, hessian_few, inverse_few, minimise_few, solve_few

METHODS = {"likelihood": Likelihood, "consistency": Consistency}
# Places screened: in the outline's box, and along the outline.
_COARSE, _EDGE = 400, 240
# Frames worked on together: all their arrays stay in the cache.
_CHUNK, _CHUNK_OF_MAPS = 1024, 32
# Two valleys closer than this part of the skin's size are one; another is worth a descent if, screened, it is not worse
# than so many times the best and so much more; on rasters of more pixels only the best is descended.
_SAME_VALLEY, _WORTH, _WORTH_MORE, _FINE = 0.05, 1.5, 8.0, 2000
# Relative error of the decay models with which frames are screened, at least.
_SCREENED_AT = 0.2
# Steps into a second valley before it is compared with the first, and by how much its cost may then be greater.
_TRIAL_STEPS, _PROMISING, _MOST_STEPS = 8, 8.0, 30
# What a step must promise, relative to the cost; an exact Newton step follows.
_TOLERANCE = 1e-12


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
    """A raster over the outline's box: chart coordinates (2, P), which are `inside` (P,), rows and columns, and
    whether all are inside (`full`)."""

    chart: Float[Array, "2 P"]
    inside: Bool[Array, " P"]
    shape: tuple[int, int] = eqx.field(static=True)
    full: bool = eqx.field(static=True)

    @classmethod
    def create(cls, surface, columns: int, rows: int) -> "Pixels":
        """Of so many pixels; bottom row first."""
        grid, within = chart_grid(surface, columns, rows)
        if not within.any():
            raise ValueError(f"shape: none of {columns} × {rows} pixels has its middle inside the outline; take more.")
        return cls(jnp.asarray(grid.reshape(2, -1)), jnp.asarray(within.ravel()), (rows, columns), bool(within.all()))


class Localiser(eqx.Module):
    """Finds sources from intensities; make one with `Localiser.create` and call it."""

    listeners: Listeners
    coarse: Pixels
    pixels: Pixels | None
    features: Float[Array, "N P"] | None
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
        return cls(listeners, coarse, pixels, METHODS[method].features(listeners, pixels.chart), method)

    def __call__(self, power: ArrayLike, use: ArrayLike | None = None) -> Estimate:
        """Locate the source of each frame. `power` (F, M): intensities above the floor; `use`: which to look at, all
        that are finite unless given. Frames with fewer than three usable microphones give NaN."""
        return _locate(self, *self._checked(power, use))

    def maps(self, power: ArrayLike, use: ArrayLike | None = None) -> Float[Array, "F rows columns"]:
        """The map of each frame: the paper's loss, relative to the square of the loudest intensity, or minus the
        log-likelihood at the best strength; bottom row first, NaN outside the outline. Raises `ValueError` where the
        localiser was made without `map_shape`."""
        if self.pixels is None:
            raise ValueError("maps were not asked for: make the Localiser with map_shape=(rows, columns).")
        return _maps(self, *self._checked(power, use))

    def with_maps(
        self, power: ArrayLike, use: ArrayLike | None = None
    ) -> tuple[Estimate, Float[Array, "F rows columns"]]:
        """Both: what is found of each frame, and its map."""
        return self(power, use), self.maps(power, use)

    def _checked(self, power, use) -> tuple[Array, Array]:
        """Intensities as an array, and which are to be looked at."""
        power = jnp.asarray(power, float)
        finite = jnp.isfinite(power)
        use = finite if use is None else finite & jnp.asarray(use, bool)
        if power.ndim != 2 or power.shape != use.shape or power.shape[1] != len(self.listeners.microphones):
            raise ValueError(
                f"power has shape {power.shape} and use {use.shape}; give (frames, microphones) with "
                f"{len(self.listeners.microphones)} microphones."
            )
        return power, use


def _in_chunks(function, most: int, *arrays):
    """`function` of a few frames at a time: `arrays` (F, M) are cut, padded, turned to (M, F); results lead with F."""
    number = arrays[0].shape[0]
    size_of_chunk = min(most, max(number, 1))
    chunks = -(-number // size_of_chunk)
    pad = ((0, chunks * size_of_chunk - number), (0, 0))

    def cut(array):
        return jnp.pad(array, pad).reshape(chunks, size_of_chunk, -1).transpose(0, 2, 1)

    found = jax.lax.map(lambda chunk: function(*chunk), tuple(cut(array) for array in arrays))
    return jax.tree.map(lambda array: array.reshape(-1, *array.shape[2:])[:number], found)


def _raster(localiser: Localiser, listeners: Listeners) -> tuple[Pixels, Array]:
    """The paper's raster where maps were asked for, the coarse one otherwise, and the features of its pixels."""
    if localiser.pixels is not None and localiser.features is not None:
        return localiser.pixels, localiser.features
    return localiser.coarse, METHODS[localiser.method].features(listeners, localiser.coarse.chart)


@eqx.filter_jit
def _maps(localiser: Localiser, power, use) -> Array:
    """Of all frames at once: one product, with nothing to copy."""
    pixels, features = _raster(localiser, localiser.listeners)
    use = _usable(localiser, power, use)
    maps = METHODS[localiser.method].create(power.T, use.T, localiser.listeners).screen(features)
    return (maps if pixels.full else jnp.where(pixels.inside, maps, jnp.nan)).reshape(-1, *pixels.shape)


def _starts(localiser: Localiser, power, use):
    """Where the descents of each frame start: first (F, 2), second (F, 2), and whether that is worth it (F,)."""
    still = jax.lax.stop_gradient(localiser.listeners)
    pixels, features = _raster(localiser, still)
    # Valleys of a model known to be exact are narrower than pixels are apart: screened as if it were not.
    still = eqx.tree_at(lambda one: one.noise.relative, still, jnp.maximum(still.noise.relative, _SCREENED_AT))

    def screen(power, use):
        maps = METHODS[localiser.method].create(power, use, still).screen(features)
        first, second, worth = _valleys(maps, pixels)
        return first.T, second.T, worth

    most = _CHUNK if localiser.pixels is None else _CHUNK_OF_MAPS
    return _in_chunks(screen, most, jax.lax.stop_gradient(power), use)


def _usable(localiser: Localiser, power, use):
    """Without a floor, what is not positive has no logarithm: nothing is known of such a reading."""
    return use & (power + localiser.listeners.noise.floor > 0)


@eqx.filter_jit
def _locate(localiser: Localiser, power, use) -> Estimate:
    use = _usable(localiser, power, use)
    first, second, worth = _starts(localiser, power, use)

    def refine(power, use, first, second, worth):
        return _refine(localiser, power, use, first, second, worth[0])

    return _in_chunks(refine, _CHUNK, power, use, first, second, worth[:, None])


def _refine(localiser: Localiser, power, use, first, second, worth) -> Estimate:
    """From the starts (2, F) of each frame; `power` and `use` (M, F)."""
    listeners = localiser.listeners
    fixed = jax.lax.stop_gradient(listeners)
    still = METHODS[localiser.method].create(jax.lax.stop_gradient(power), use, fixed)
    # Where one pixel of many was the start there is no second valley to try.
    unknowns, excess, rival, converged, side = _descend(
        still, first, second, worth if localiser.pixels is None else None
    )
    likelihood = Likelihood.create(power, use, listeners)
    objective = likelihood if localiser.method == "likelihood" else Consistency.create(power, use, listeners)
    unknowns = _differentiable(objective, unknowns, side, size(fixed.surface))
    return _describe(objective, likelihood, unknowns, excess, rival, converged)


def _valleys(maps, pixels: Pixels):
    """Chart coordinates (2, F) of each map's least pixel, and of the least local minimum elsewhere, with which frames
    have one worth a descent (F,)."""
    rows, columns = pixels.shape
    inside = pixels.inside.reshape(rows, columns)

    def known(values, inside):
        fair = ~jnp.isnan(values) if pixels.full else inside & ~jnp.isnan(values)
        return jnp.where(fair, values, jnp.inf)

    # The least row first, then the least pixel in it, which is quicker than to look for the pixel at once.
    square = maps.reshape(-1, rows, columns)
    row = jnp.argmin(jnp.min(known(square, inside), axis=2), axis=1)
    in_row = known(jnp.take_along_axis(square, row[:, None, None], axis=1)[:, 0], inside[row])
    best = row * columns + jnp.argmin(in_row, axis=1)
    first = pixels.chart[:, best]
    if rows * columns > _FINE:  # where pixels are that fine, noise makes valleys of its own
        return first, first, jnp.zeros(best.shape, bool)
    square = known(square, inside)
    values = square.reshape(len(best), -1)
    wide = jnp.pad(square, ((0, 0), (1, 1), (1, 1)), constant_values=jnp.inf)
    around = [wide[:, i : i + rows, j : j + columns] for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    lowest = jnp.isfinite(square)
    for neighbour in around:
        lowest &= square <= neighbour
    lowest = lowest.reshape(values.shape).at[jnp.arange(len(best)), best].set(False)
    rivals = jnp.where(lowest, values, jnp.inf)
    other = jnp.argmin(rivals, axis=1)
    least, second = jnp.min(values, axis=1), jnp.min(rivals, axis=1)
    return first, pixels.chart[:, other], second < _WORTH * least + _WORTH_MORE


def _descend(objective, first, second, worth):
    """From both starts (2, F), the second only where that is worth it: unknowns (n, F), by how much the outline costs
    more than what lies beyond, by how much the rival valley does, whether converged, and the (start, end) of the side
    of the outline on which frames were held, NaN for those inside."""
    surface = objective.listeners.surface
    found = _minimise(objective, objective.start(first), None)
    unknowns, converged = found.x, found.converged
    value = jnp.where(jnp.isfinite(found.value), found.value, jnp.inf)
    within = surface.outline.contains(unknowns[:2].T)
    rival, least = jnp.full(value.shape, jnp.inf), value
    if worth is not None:
        # A few steps show whether that valley is any good; only then is its bottom sought.
        tried = _minimise(objective, objective.start(second), ~worth, max_steps=_TRIAL_STEPS)
        worth = worth & (tried.value < value + _PROMISING)
        other = _minimise(objective, tried.x, ~worth)
        other_value = jnp.where(worth & jnp.isfinite(other.value), other.value, jnp.inf)
        other_within = surface.outline.contains(other.x[:2].T)
        apart = jnp.linalg.norm(other.x[:2] - unknowns[:2], axis=0) > _SAME_VALLEY * size(surface)
        rival = jnp.where(apart & worth & within & other_within, jnp.abs(other_value - value), jnp.inf)
        least = jnp.minimum(value, other_value)
        # Of two valleys of which one lies beyond the outline, the other is taken; the outline itself may yet be better.
        better = jnp.where(other_within == within, other_value < value, other_within & jnp.isfinite(other_value))
        unknowns = jnp.where(better, other.x, unknowns)
        converged = jnp.where(better, other.converged, converged)
        value, within = jnp.where(better, other_value, value), jnp.where(better, other_within, within)
    # Places beyond the outline give way to the best on it; so do valleys inside that are worse than one beyond.
    beyond = jnp.isfinite(value) & (~within | (least < value))
    nowhere = jnp.full((2, 2, value.size), jnp.nan)

    def hold(_):
        held, side = _on_edge(objective, ~beyond)
        moved = beyond & (~within | (held.value < value))
        return (
            jnp.where(moved, held.x, unknowns),
            jnp.where(beyond, jnp.where(moved, held.value, value) - least, 0.0),
            jnp.where(moved, held.converged, converged),
            jnp.where(moved, side, nowhere),
        )

    def leave(_):
        return unknowns, jnp.zeros_like(value), converged, nowhere

    unknowns, excess, converged, side = jax.lax.cond(jnp.any(beyond), hold, leave, None)
    return unknowns, excess, rival, converged, side


def _minimise(objective, start, skip, *, max_steps: int | None = None) -> Minimum:
    """Within three times the outline's box; steps of at most a quarter of the skin, and a factor of ten in strength.

    The last of many steps are taken with exact Hessians; the first `max_steps`, where so many are asked for, are not.
    """
    surface = objective.listeners.surface
    low, high = box(surface)
    rest = jnp.full(start.shape[0] - 2, jnp.inf)
    reach = size(surface)

    def of(frames):
        return type(objective)(*frames, objective.listeners)

    return minimise_few(
        lambda x, frames: of(frames).expand(x),
        start,
        objective.frames,
        finish=None if max_steps is not None else lambda x, frames: _exactly(of(frames), x),
        max_steps=max_steps or _MOST_STEPS,
        lower=jnp.concatenate([low - reach, -rest])[:, None],
        upper=jnp.concatenate([high + reach, rest])[:, None],
        largest_step=jnp.concatenate([jnp.full(2, reach / 4), jnp.full_like(rest, 2.3)])[:, None],
        tolerance=_TOLERANCE,
        skip=skip,
    )


def _exactly(objective, x) -> tuple[Array, Array, Array]:
    """The objective's expansion with the exact Hessian, where that is positive definite: near a minimum the last steps
    are few then, however badly the minimum fits."""
    value, gradient, model = objective.expand(x)
    hessian = hessian_few(objective.cost, x)
    return value, gradient, jnp.where(definite_few(hessian), hessian, model)


def _on_edge(objective, skip) -> tuple[Minimum, Array]:
    """The best place on the outline: the best of many, refined along its side. Also the side, (2, 2, F).

    Not of the frames to `skip` (F,).
    """
    start, end = sides(objective.listeners.surface)
    length = jnp.linalg.norm(end - start, axis=0)
    # Places at equal steps along the whole outline, as (side, share of the side).
    stops = jnp.concatenate([jnp.zeros(1), jnp.cumsum(length)])
    walked = stops[-1] * (jnp.arange(_EDGE) + 0.5) / _EDGE
    which = jnp.clip(jnp.searchsorted(stops, walked, side="right") - 1, 0, length.size - 1)
    share = (walked - stops[which]) / length[which]
    chart = start[:, which] + share * (end - start)[:, which]
    maps = objective.screen(type(objective).features(objective.listeners, chart))
    best = jnp.argmin(jnp.where(jnp.isnan(maps), jnp.inf, maps), axis=1)
    origin, along = start[:, which[best]], (end - start)[:, which[best]]
    first = objective.start(chart[:, best])[2:]

    def unknowns_of(z, origin, along):
        return jnp.concatenate([origin + z[0] * along, z[1:]])

    def expand(z, data):
        origin, along, frames = data
        some = type(objective)(*frames, objective.listeners)
        value, gradient, matrix = some.expand(unknowns_of(z, origin, along))
        turned = jnp.concatenate([jnp.sum(along * gradient[:2], axis=0)[None], gradient[2:]])
        rows = jnp.concatenate([jnp.einsum("kf,klf->lf", along, matrix[:2])[None], matrix[2:]])
        columns = jnp.concatenate([jnp.einsum("klf,lf->kf", rows[:, :2], along)[:, None], rows[:, 2:]], axis=1)
        return value, turned, columns

    rest = first.shape[0]
    found = minimise_few(
        expand,
        jnp.concatenate([share[best][None], first]),
        (origin, along, objective.frames),
        lower=jnp.array([0.0] + rest * [-jnp.inf])[:, None],
        upper=jnp.array([1.0] + rest * [jnp.inf])[:, None],
        largest_step=jnp.array([0.5] + rest * [2.3])[:, None],
        tolerance=_TOLERANCE,
        skip=skip,
    )
    end_of = origin + along
    corner = (found.x[0] <= 0) | (found.x[0] >= 1)
    # Held in a corner, a frame moves nowhere: its side has no length.
    side = jnp.stack([origin, jnp.where(corner, origin, end_of)])
    return Minimum(unknowns_of(found.x, origin, along), found.value, found.converged, found.steps), side


def _differentiable(objective, unknowns, side, reach):
    """The minimum as a function of everything in `objective`: one Newton step from it, x − H⁻¹ ∇cost, is zero in value
    and, H and x being constants, −H⁻¹ ∂∇cost in derivative, as the implicit function theorem has it."""
    at = jax.lax.stop_gradient(unknowns)

    def finite_cost(at):
        cost = objective.cost(at)
        return jnp.where(jnp.isfinite(cost), cost, 0.0)

    matrix = hessian_few(jax.lax.stop_gradient(objective).cost, at)
    gradient = jax.grad(lambda at: jnp.sum(finite_cost(at)))(at)
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
        strength = likelihood.strength(likelihood.listeners.response(chart))
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
