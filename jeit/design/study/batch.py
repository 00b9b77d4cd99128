"""Computation of the sensitivity maps and scores of the points (skins) of a chunk of a study, in one compiled batch or
one by one."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from functools import lru_cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh as Devices
from jax.sharding import PartitionSpec
from jaxtyping import Array, Float

from jeit.design.defaults import SHEET_ONLY_SCORES
from jeit.design.scores import TouchPrior, layout_scores
from jeit.design.sensitivity import SensitivityMap
from jeit.design.skin.sheet_touches import SheetTouches
from jeit.design.skin.skin import Skin, model_conductivity, smallest_diameter
from jeit.design.skin.touch_shapes import SurfaceGrid, TouchGrid, touch_grid
from jeit.design.skin.touched_cells import TouchedCells, touched_surface
from jeit.design.skin.voltage_changes import touch_changes
from jeit.design.study.spec import PointShape, Study, StudyPoint
from jeit.design.taxels import find_taxels
from jeit.electrodes import FaceDiscs, SheetDiscs, SurfaceDiscs
from jeit.forward import ForwardModel
from jeit.layout import Layout, SurfaceLayout
from jeit.mesh.geodesic import Geodesics, Triangles
from jeit.protocol import Protocol
from jeit_solvers.module import Module


class _SharedData(Module):
    """Data shared by all points of a study that have the same shape.

    **Fields**: `model`: the forward model; `touched`: the touched cells on a skin of `thickness` metres; `touches`: the
    same touches with derivatives with respect to the position; `prior`: prior of the touches' amplitudes (`touches` and
    `prior` are None unless a score needs them); `grid`: the touched positions; `key`: random key for k-means.
    """

    model: ForwardModel
    touched: TouchedCells
    touches: SheetTouches | None
    prior: TouchPrior | None
    grid: TouchGrid
    thickness: float
    key: Array


class _PointData(Module):
    """Data that differ between points of the same shape. `conductivity` is the conductivity of the forward model, S/m
    (2-D: S), and `noise` is in volts. In a batch of k points, every array has a leading axis of length k."""

    electrodes: SheetDiscs | SurfaceDiscs | FaceDiscs
    protocol: Protocol
    thickness: Float[Array, ""]
    conductivity: Float[Array, ""]
    noise: Float[Array, ""]


def check_points(study: Study) -> None:
    """Check all points of a study by creating their skins, touches and electrodes. Raises `ValueError` for a mesh that
    is too coarse."""
    checked_keys = set()
    for point_index in itertools.chain.from_iterable(study.chunks):  # points grouped by shape
        point = study.points[point_index]
        key = (id(point.layout), point.shape)
        if key in checked_keys:
            continue
        checked_keys.add(key)
        layers = f" and mesh.layers = {point.layers}" if point.layers else ""
        location = f"mesh.cell_mm = {1e3 * point.cell_size:g}{layers}"
        if isinstance(point.layout, SurfaceLayout):
            try:
                _first_skin(study, point.shape)
            except ValueError as error:
                raise ValueError(f"skin.thickness_mm = {1e3 * point.thickness:g}, {location}: {error}") from None
        try:
            _first_skin(study, point.shape).with_layout(point.layout)
        except ValueError:
            min_diameter = 1e3 * smallest_diameter(point.layout)
            raise ValueError(
                f"{location}: too coarse for electrodes of {point.layout.name!r}, {min_diameter:.3g} mm across; make "
                "cells smaller."
            ) from None
        try:
            _shared_data(study, point.shape)
        except ValueError as error:
            raise ValueError(f"{location}: {error}") from None


def solve_chunk(study: Study, number: int, solved: Callable[[int], None] | None = None) -> dict[str, np.ndarray]:
    """Compute the results of chunk `number` of a study for its k points: "sensitivity" (k, n) at n positions in volts,
    and the scores (k,).

    Linearised sensitivity maps are computed in one compiled batch, which has the same size for every chunk of a shape
    and is divided among the devices of JAX. Exact maps are computed one after the other; after each map but the last,
    `solved` is called with the number of finished maps.
    """
    points = [study.points[point_index] for point_index in study.chunks[number]]
    shared = _shared_data(study, points[0].shape)
    options = {"scores": study.scores, "num_taxels": study.num_taxels, "threshold": study.threshold}
    if study.exact:
        results = _stack_trees(
            _solve_exactly(shared, [_point_data(point, study.current) for point in points], options, solved)
        )
    else:
        devices = jax.devices()
        num_equal_shapes = sum(point.shape == points[0].shape for point in study.points)
        size = -(-min(study.chunk_points, num_equal_shapes) // len(devices)) * len(devices)
        point_data = [_point_data(point, study.current) for point in points]
        results = _solve_batch(
            shared,
            _stack_trees(point_data + point_data[-1:] * (size - len(point_data))),
            **options,
            num_devices=len(devices),
        )
    return {name: np.asarray(values)[: len(points)] for name, values in results.items()}


def study_grid(study: Study) -> TouchGrid:
    """Grid of touched positions of a study. On curved layers, the positions are on the surface with the electrodes, and
    the opposite face is touched above or below these positions."""
    return touch_grid(study.outline, study.columns, study.rows)


@lru_cache(maxsize=4)
def _first_skin(study: Study, shape: PointShape) -> Skin:
    """Skin of the first point of a study that has the given `shape`; all points of a shape have the same mesh."""
    point = next(point for point in study.points if point.shape == shape)
    return Skin.create(
        point.layout,
        thickness=point.thickness,
        conductivity=point.conductivity,
        num_layers=point.layers,
        cell_size=point.cell_size if isinstance(point.layout, Layout) else None,
        protocol=point.measurement_protocol(study.current),
    )


@lru_cache(maxsize=4)
def _shared_data(study: Study, shape: PointShape) -> _SharedData:
    skin, grid, touches, prior, lengths = _first_skin(study, shape), study_grid(study), None, None, None
    if isinstance(grid, SurfaceGrid) and isinstance(skin.layout, SurfaceLayout):
        face_surface = touched_surface(skin.model.mesh, skin.touched_face)
        if not eqx.tree_equal(face_surface, study.outline):
            grid = grid.on(Triangles.of(skin.layout.surface), face_surface)
    if set(SHEET_ONLY_SCORES) & set(study.scores):
        touches = skin.sheet_touches(grid.places, study.indentation, contrast=study.contrast)
        touched = touches.touched
        if isinstance(skin.layout, SurfaceLayout):
            lengths = Geodesics.create(skin.layout.surface).between(grid.places)
        prior = TouchPrior.create(grid.places, correlation=study.correlation, lengths=lengths)
    else:
        touched = skin.touched_cells(grid.places, study.indentation, contrast=study.contrast)
    return _SharedData(skin.model, touched, touches, prior, grid, skin.thickness, jax.random.key(study.seed))


def _point_data(point: StudyPoint, current: float) -> _PointData:
    return _PointData(
        electrodes=point.electrodes,
        protocol=point.measurement_protocol(current),
        thickness=jnp.asarray(point.thickness),
        conductivity=jnp.asarray(model_conductivity(point.conductivity, point.thickness, point.layers)),
        noise=jnp.asarray(point.noise),
    )


def _stack_trees(trees):
    """Stack trees of arrays along a new leading axis."""
    return jax.tree.map(lambda *arrays: jnp.stack(arrays), *trees)


@partial(jax.jit, static_argnames=("scores", "num_taxels", "threshold", "num_devices"))
def _solve_batch(
    shared_data: _SharedData,
    point_data: _PointData,
    *,
    scores: tuple[str, ...],
    num_taxels: int,
    threshold: float,
    num_devices: int,
) -> dict[str, Array]:
    def solve_point(shared_data: _SharedData, point_data: _PointData) -> dict[str, Array]:
        model, touched = _model_and_touched_cells(shared_data, point_data)
        changes = touch_changes(model, point_data.conductivity, touched, linear=True)
        return _compute_results(
            shared_data, point_data, changes, scores=scores, num_taxels=num_taxels, threshold=threshold
        )

    batch = jax.vmap(solve_point, in_axes=(None, 0))
    if num_devices == 1:
        return batch(shared_data, point_data)
    devices = Devices(np.array(jax.devices()), ("point",))
    point_sharding = PartitionSpec("point")
    return jax.shard_map(
        batch, mesh=devices, in_specs=(PartitionSpec(), point_sharding), out_specs=point_sharding, check_vma=False
    )(shared_data, point_data)


def _solve_exactly(
    shared_data: _SharedData, all_point_data: list[_PointData], options: dict, solved: Callable[[int], None] | None
) -> Iterator[dict[str, Array]]:
    """Yield the results of each skin, with exact sensitivity maps. The callback `solved` is called as in
    `solve_chunk`."""
    for num_solved, point_data in enumerate(all_point_data, 1):
        model, touched = _model_and_touched_cells(shared_data, point_data)
        yield _compute_results(
            shared_data, point_data, touch_changes(model, point_data.conductivity, touched), **options
        )
        if solved is not None and num_solved < len(all_point_data):
            solved(num_solved)


def _model_and_touched_cells(shared_data: _SharedData, point_data: _PointData) -> tuple[ForwardModel, TouchedCells]:
    """Return the forward model of a point's skin, and the cells that the touches change."""
    model = shared_data.model.with_electrodes(point_data.electrodes).with_protocol(point_data.protocol)
    touched = eqx.tree_at(
        # The relative change of a sheet's conductivity is proportional to depth / thickness; layers of one shape have
        # the same thickness.
        lambda cells_to_change: cells_to_change.change,
        shared_data.touched,
        replace_fn=lambda change: change * (shared_data.thickness / point_data.thickness),
    )
    return model, touched


@partial(jax.jit, static_argnames=("scores", "num_taxels", "threshold"))
def _compute_results(
    shared: _SharedData,
    point_data: _PointData,
    changes: Float[Array, "n M"],
    *,
    scores,
    num_taxels: int,
    threshold: float,
) -> dict[str, Array]:
    """Compute the results of one skin from the voltage changes due to its touches, volts."""
    sensitivity = SensitivityMap(shared.grid, changes)
    results = {"sensitivity": sensitivity.values}
    for name in ("minimum", "mean", "uniformity"):
        if name in scores:
            results[name] = getattr(sensitivity, name)
    if "blind_spot" in scores:
        results["blind_spot"] = sensitivity.blind_spot(point_data.noise * jnp.sqrt(1.0 * sensitivity.changes.shape[-1]))
    if "taxels" in scores:
        taxels = find_taxels(
            sensitivity.changes,
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
    if shared.touches is not None and shared.prior is not None:
        results |= _optimality_scores(shared, point_data, shared.touches, shared.prior, scores)
    return results


def _optimality_scores(
    shared: _SharedData, point_data: _PointData, touches: SheetTouches, prior: TouchPrior, scores: tuple[str, ...]
) -> dict[str, Array]:
    """Compute the optimality scores from linearised voltage changes. In a batch, the Jacobian has been computed
    already, and XLA reuses the Jacobian."""
    model, _ = _model_and_touched_cells(shared, point_data)
    touches = touches.with_thickness(point_data.thickness)
    layout_score_values = layout_scores(model, point_data.conductivity, touches, prior=prior, noise=point_data.noise)
    results = {}
    if "information" in scores:
        results["information"] = layout_score_values.log_information
    for name in ("mean_variance", "largest_variance"):
        if name in scores:
            results[name] = getattr(layout_score_values, name)
    if "localisation_error" in scores:
        # Mean and maximum are infinite if the position of any touch cannot be determined; `localisation_lost` is the
        # fraction of the area where touches cannot be located.
        results["localisation_error_mean"] = 1e3 * jnp.mean(layout_score_values.localisation_error)
        results["localisation_error_max"] = 1e3 * jnp.max(layout_score_values.localisation_error)
        results["localisation_lost"] = jnp.mean(jnp.isinf(layout_score_values.localisation_error))
    return results
