"""The points of a chunk in one jitted batch: linear sensitivity maps, and the scores made of them."""

import itertools
from functools import lru_cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float

from jeit.design.changes import touch_changes
from jeit.design.press import Presses, press
from jeit.design.sensitivity import SensitivityMap, TouchGrid, touch_grid
from jeit.design.study.spec import Point, Study
from jeit.design.taxels import find_taxels
from jeit.electrodes import SheetDiscs
from jeit.forward import ForwardModel
from jeit.mesh import rectangle
from jeit.protocol import Protocol, adjacent, opposite, two_terminal


class _Shared(eqx.Module):
    """What points of one shape have in common; `presses` on a skin of `thickness` metres."""

    model: ForwardModel
    presses: Presses
    grid: TouchGrid
    thickness: float
    key: Array


class _Skins(eqx.Module):
    """Where points of one shape differ, along a leading axis; `conductance` of the sheet in siemens, noise in volts."""

    position: Float[Array, "k L 2"]
    radius: Float[Array, "k L"]
    contact_impedance: Float[Array, "k L"]
    thickness: Float[Array, " k"]
    conductance: Float[Array, " k"]
    noise: Float[Array, " k"]


def check_points(study: Study) -> None:
    """Make every mesh and place every electrode. Raises `ValueError` for electrodes too small for their mesh."""
    seen = set()
    for index in itertools.chain.from_iterable(study.chunks):  # one shape after the other
        point = study.points[index]
        key = (id(point.layout), point.cell_size)
        if key in seen:
            continue
        seen.add(key)
        try:
            point.layout.sheet_discs().check(_shared(study, point.shape).model.mesh)
        except ValueError as error:
            where = f"mesh.cell_mm = {1e3 * point.cell_size:g} with layout {point.layout.name!r}"
            raise ValueError(f"{where}: {error}") from None


def solve_chunk(study: Study, number: int) -> dict[str, np.ndarray]:
    """Results of chunk `number` for each of its k points: "sensitivity" (k, n) in volts, and scores (k,).

    In one compiled batch, as large for every chunk of a shape, and parted between the devices that JAX sees.
    """
    points = [study.points[index] for index in study.chunks[number]]
    shared = _shared(study, points[0].shape)
    devices = jax.devices()
    same = sum(point.shape == points[0].shape for point in study.points)
    size = -(-min(study.chunk_points, same) // len(devices)) * len(devices)
    skins = _skins([*points, *[points[-1]] * (size - len(points))])
    results = _solve(shared, skins, study.scores, study.num_taxels, study.threshold, len(devices))
    return {name: np.asarray(values)[: len(points)] for name, values in results.items()}


def study_grid(study: Study) -> TouchGrid:
    """Where the skins are touched."""
    return touch_grid(study.skin, study.columns, study.rows)


@lru_cache(maxsize=4)
def _shared(study: Study, shape: tuple[int, str, float]) -> _Shared:
    number, protocol, cell_size = shape
    points = [point for point in study.points if point.shape == shape]
    mesh = rectangle(study.skin.width, study.skin.height, cell_size=cell_size)
    model = ForwardModel(mesh, points[0].layout.sheet_discs(), _protocol(protocol, number, study.current))
    grid, thickness = study_grid(study), points[0].thickness
    presses = press(mesh, study.indentation, grid.places, thickness=thickness)
    return _Shared(model, presses, grid, thickness, jax.random.key(study.seed))


def _protocol(name: str, number: int, current: float) -> Protocol:
    return {"adjacent": adjacent, "opposite": opposite, "two-terminal": two_terminal}[name](number, current=current)


def _skins(points: list[Point]) -> _Skins:
    thickness = jnp.array([point.thickness for point in points])
    return _Skins(
        position=jnp.stack([point.layout.centres for point in points]),
        radius=jnp.stack([point.layout.diameters / 2 for point in points]),
        contact_impedance=jnp.stack([point.layout.sheet_discs().contact_impedance for point in points]),
        thickness=thickness,
        conductance=thickness * jnp.array([point.conductivity for point in points]),
        noise=jnp.array([point.noise for point in points]),
    )


@partial(jax.jit, static_argnames=("scores", "num_taxels", "threshold", "num_devices"))
def _solve(
    shared: _Shared, skins: _Skins, scores: tuple[str, ...], num_taxels: int, threshold: float, num_devices: int
) -> dict[str, Array]:
    one = partial(_one, scores=scores, num_taxels=num_taxels, threshold=threshold)
    batch = jax.vmap(one, in_axes=(None, 0))
    if num_devices == 1:
        return batch(shared, skins)
    devices = Mesh(np.array(jax.devices()), ("point",))
    split = PartitionSpec("point")
    return jax.shard_map(batch, mesh=devices, in_specs=(PartitionSpec(), split), out_specs=split, check_vma=False)(
        shared, skins
    )


def _one(shared: _Shared, skin: _Skins, *, scores, num_taxels: int, threshold: float) -> dict[str, Array]:
    model = shared.model.with_electrodes(SheetDiscs(skin.position, skin.radius, skin.contact_impedance))
    # A touch takes depth / thickness of the current's way.
    presses = eqx.tree_at(
        lambda all: all.change, shared.presses, replace_fn=lambda c: c * (shared.thickness / skin.thickness)
    )
    found = SensitivityMap(shared.grid, touch_changes(model, skin.conductance, presses, linear=True))
    results = {"sensitivity": found.values}
    for name in ("minimum", "mean", "uniformity"):
        if name in scores:
            results[name] = getattr(found, name)
    if "blind_spot" in scores:
        results["blind_spot"] = found.blind_spot(skin.noise * jnp.sqrt(1.0 * found.changes.shape[-1]))
    if "taxels" in scores:
        taxels = find_taxels(
            found.changes,
            shared.grid.places,
            shared.grid.cell_area,
            num_taxels=num_taxels,
            threshold=threshold,
            key=shared.key,
        )
        results["taxel_count"] = jnp.sum(taxels.areas > 0).astype(float)
        results["taxel_area_mean"] = 1e4 * taxels.mean_area
        results["taxel_area_std"] = 1e4 * taxels.std_area
        results["taxel_area_max"] = 1e4 * taxels.max_area
    return results
