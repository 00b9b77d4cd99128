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

    **Fields**: `model`: the forward model; `touched_cells`: the touched cells on a skin of `thickness` metres;
    `sheet_touches`: the same touches with derivatives with respect to the position; `touch_prior`: prior of the
    touches' amplitudes (`sheet_touches` and `touch_prior` are None unless a score needs them); `grid`: the touched
    positions; `random_key`: random key for k-means.
    """

    model: ForwardModel
    touched_cells: TouchedCells
    sheet_touches: SheetTouches | None
    touch_prior: TouchPrior | None
    grid: TouchGrid
    thickness: float
    random_key: Array


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
        point_key = (id(point.layout), point.shape)
        if point_key in checked_keys:
            continue
        checked_keys.add(point_key)
        layers_text = f" and mesh.layers = {point.layers}" if point.layers else ""
        mesh_location = f"mesh.cell_mm = {1e3 * point.cell_size:g}{layers_text}"
        if isinstance(point.layout, SurfaceLayout):
            try:
                _first_skin(study, point.shape)
            except ValueError as error:
                raise ValueError(f"skin.thickness_mm = {1e3 * point.thickness:g}, {mesh_location}: {error}") from None
        try:
            _first_skin(study, point.shape).with_layout(point.layout)
        except ValueError:
            min_diameter = 1e3 * smallest_diameter(point.layout)
            raise ValueError(
                f"{mesh_location}: too coarse for electrodes of {point.layout.name!r}, {min_diameter:.3g} mm across; "
                "make cells smaller."
            ) from None
        try:
            _shared_data(study, point.shape)
        except ValueError as error:
            raise ValueError(f"{mesh_location}: {error}") from None


def solve_chunk(study: Study, number: int, solved: Callable[[int], None] | None = None) -> dict[str, np.ndarray]:
    """Compute the results of chunk `number` of a study for its k points: "sensitivity" (k, n) at n positions in volts,
    and the scores (k,).

    Linearised sensitivity maps are computed in one compiled batch, which has the same size for every chunk of a shape
    and is divided among the devices of JAX. Exact maps are computed one after the other; after each map but the last,
    `solved` is called with the number of finished maps.
    """
    points = [study.points[point_index] for point_index in study.chunks[number]]
    shared_data = _shared_data(study, points[0].shape)
    score_options = {"scores": study.scores, "num_taxels": study.num_taxels, "threshold": study.threshold}
    if study.exact:
        results = _stack_trees(
            _solve_exactly(shared_data, [_point_data(point, study.current) for point in points], score_options, solved)
        )
    else:
        devices = jax.devices()
        num_equal_shapes = sum(point.shape == points[0].shape for point in study.points)
        batch_size = -(-min(study.chunk_points, num_equal_shapes) // len(devices)) * len(devices)
        point_data = [_point_data(point, study.current) for point in points]
        results = _solve_batch(
            shared_data,
            _stack_trees(point_data + point_data[-1:] * (batch_size - len(point_data))),
            **score_options,
            num_devices=len(devices),
        )
    return {result_name: np.asarray(result_values)[: len(points)] for result_name, result_values in results.items()}


def study_grid(study: Study) -> TouchGrid:
    """Grid of touched positions of a study. On curved layers, the positions are on the surface with the electrodes, and
    the opposite face is touched above or below these positions."""
    return touch_grid(study.outline, study.columns, study.rows)


@lru_cache(maxsize=4)
def _first_skin(study: Study, point_shape: PointShape) -> Skin:
    """Skin of the first point of a study that has the given `point_shape`; all points of a shape have the same mesh."""
    point = next(point for point in study.points if point.shape == point_shape)
    return Skin.create(
        point.layout,
        thickness=point.thickness,
        conductivity=point.conductivity,
        num_layers=point.layers,
        cell_size=point.cell_size if isinstance(point.layout, Layout) else None,
        protocol=point.measurement_protocol(study.current),
    )


@lru_cache(maxsize=4)
def _shared_data(study: Study, point_shape: PointShape) -> _SharedData:
    skin, grid, sheet_touches, touch_prior, geodesic_lengths = (
        _first_skin(study, point_shape),
        study_grid(study),
        None,
        None,
        None,
    )
    if isinstance(grid, SurfaceGrid) and isinstance(skin.layout, SurfaceLayout):
        face_surface = touched_surface(skin.model.mesh, skin.touched_face)
        if not eqx.tree_equal(face_surface, study.outline):
            grid = grid.on(Triangles.of(skin.layout.surface), face_surface)
    if set(SHEET_ONLY_SCORES) & set(study.scores):
        sheet_touches = skin.sheet_touches(grid.places, study.indentation, contrast=study.contrast)
        touched_cells = sheet_touches.touched
        if isinstance(skin.layout, SurfaceLayout):
            geodesic_lengths = Geodesics.create(skin.layout.surface).between(grid.places)
        touch_prior = TouchPrior.create(grid.places, correlation=study.correlation, lengths=geodesic_lengths)
    else:
        touched_cells = skin.touched_cells(grid.places, study.indentation, contrast=study.contrast)
    return _SharedData(
        skin.model, touched_cells, sheet_touches, touch_prior, grid, skin.thickness, jax.random.key(study.seed)
    )


def _point_data(point: StudyPoint, drive_current: float) -> _PointData:
    return _PointData(
        electrodes=point.electrodes,
        protocol=point.measurement_protocol(drive_current),
        thickness=jnp.asarray(point.thickness),
        conductivity=jnp.asarray(model_conductivity(point.conductivity, point.thickness, point.layers)),
        noise=jnp.asarray(point.noise),
    )


def _stack_trees(data_trees):
    """Stack trees of arrays along a new leading axis."""
    return jax.tree.map(lambda *leaf_arrays: jnp.stack(leaf_arrays), *data_trees)


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
        model, touched_cells = _model_and_touched_cells(shared_data, point_data)
        voltage_changes = touch_changes(model, point_data.conductivity, touched_cells, linear=True)
        return _compute_results(
            shared_data, point_data, voltage_changes, scores=scores, num_taxels=num_taxels, threshold=threshold
        )

    solve_points = jax.vmap(solve_point, in_axes=(None, 0))
    if num_devices == 1:
        return solve_points(shared_data, point_data)
    devices = Devices(np.array(jax.devices()), ("point",))
    point_sharding = PartitionSpec("point")
    return jax.shard_map(
        solve_points,
        mesh=devices,
        in_specs=(PartitionSpec(), point_sharding),
        out_specs=point_sharding,
        check_vma=False,
    )(shared_data, point_data)


def _solve_exactly(
    shared_data: _SharedData,
    all_point_data: list[_PointData],
    score_options: dict,
    report_num_solved: Callable[[int], None] | None,
) -> Iterator[dict[str, Array]]:
    """Yield the results of each skin, with exact sensitivity maps. The callback `report_num_solved` is called as in
    `solve_chunk`."""
    for num_solved, point_data in enumerate(all_point_data, 1):
        model, touched_cells = _model_and_touched_cells(shared_data, point_data)
        yield _compute_results(
            shared_data, point_data, touch_changes(model, point_data.conductivity, touched_cells), **score_options
        )
        if report_num_solved is not None and num_solved < len(all_point_data):
            report_num_solved(num_solved)


def _model_and_touched_cells(shared_data: _SharedData, point_data: _PointData) -> tuple[ForwardModel, TouchedCells]:
    """Return the forward model of a point's skin, and the cells that the touches change."""
    model = shared_data.model.with_electrodes(point_data.electrodes).with_protocol(point_data.protocol)
    touched_cells = eqx.tree_at(
        # The relative change of a sheet's conductivity is proportional to depth / thickness; layers of one shape have
        # the same thickness.
        lambda cells_to_change: cells_to_change.change,
        shared_data.touched_cells,
        replace_fn=lambda cell_changes: cell_changes * (shared_data.thickness / point_data.thickness),
    )
    return model, touched_cells


@partial(jax.jit, static_argnames=("scores", "num_taxels", "threshold"))
def _compute_results(
    shared_data: _SharedData,
    point_data: _PointData,
    voltage_changes: Float[Array, "n M"],
    *,
    scores,
    num_taxels: int,
    threshold: float,
) -> dict[str, Array]:
    """Compute the results of one skin from the voltage changes due to its touches, volts."""
    sensitivity = SensitivityMap(shared_data.grid, voltage_changes)
    results = {"sensitivity": sensitivity.values}
    for score_name in ("minimum", "mean", "uniformity"):
        if score_name in scores:
            results[score_name] = getattr(sensitivity, score_name)
    if "blind_spot" in scores:
        results["blind_spot"] = sensitivity.blind_spot(point_data.noise * jnp.sqrt(1.0 * sensitivity.changes.shape[-1]))
    if "taxels" in scores:
        taxels = find_taxels(
            sensitivity.changes,
            shared_data.grid.places,
            shared_data.grid.cell_area,
            num_taxels=num_taxels,
            threshold=threshold,
            key=shared_data.random_key,
        )
        results["taxel_count"] = jnp.sum(taxels.areas > 0).astype(float)
        results["taxel_area_mean"] = 1e4 * taxels.mean_area
        results["taxel_area_std"] = 1e4 * taxels.std_area
        results["taxel_area_max"] = 1e4 * taxels.max_area
    if shared_data.sheet_touches is not None and shared_data.touch_prior is not None:
        results |= _optimality_scores(
            shared_data, point_data, shared_data.sheet_touches, shared_data.touch_prior, scores
        )
    return results


def _optimality_scores(
    shared_data: _SharedData,
    point_data: _PointData,
    sheet_touches: SheetTouches,
    touch_prior: TouchPrior,
    score_names: tuple[str, ...],
) -> dict[str, Array]:
    """Compute the optimality scores from linearised voltage changes. In a batch, the Jacobian has been computed
    already, and XLA reuses the Jacobian."""
    model, _ = _model_and_touched_cells(shared_data, point_data)
    sheet_touches = sheet_touches.with_thickness(point_data.thickness)
    layout_score = layout_scores(
        model, point_data.conductivity, sheet_touches, prior=touch_prior, noise=point_data.noise
    )
    results = {}
    if "information" in score_names:
        results["information"] = layout_score.log_information
    for score_name in ("mean_variance", "largest_variance"):
        if score_name in score_names:
            results[score_name] = getattr(layout_score, score_name)
    if "localisation_error" in score_names:
        # Mean and maximum are infinite if the position of any touch cannot be determined; `localisation_lost` is the
        # fraction of the area where touches cannot be located.
        results["localisation_error_mean"] = 1e3 * jnp.mean(layout_score.localisation_error)
        results["localisation_error_max"] = 1e3 * jnp.max(layout_score.localisation_error)
        results["localisation_lost"] = jnp.mean(jnp.isinf(layout_score.localisation_error))
    return results
