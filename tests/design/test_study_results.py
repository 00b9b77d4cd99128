"""A study's results equal maps and scores computed one at a time, in batches, on layers, and on two devices."""

import os

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies import EVERY_SCORE, SWEEP, changed, in_another_process, linear_changes

from jeit.design import (
    Bell,
    Skin,
    TouchPrior,
    find_taxels,
    layout_scores,
    sensitivity_map,
    skin_response,
    touch_grid,
)
from jeit.design.measurements import nearest_pairs
from jeit.design.sensitivity import SensitivityMap
from jeit.design.skin.names import skin_protocol
from jeit.design.skin.sheet_touches import sheet_touches
from jeit.design.skin.touched_cells import touched_cells
from jeit.design.skin.voltage_changes import touch_changes
from jeit.design.study import batch, open_results, read_study, run_study
from jeit.design.study.spec import StudyPoint
from jeit.electrodes import FaceDiscs, SheetDiscs
from jeit.forward import ForwardModel
from jeit.mesh import Rectangle, layer, rectangle
from jeit.protocol import two_terminal

pytest.importorskip("xarray")
pytest.importorskip("zarr")

MESH, GRID = rectangle(0.1, 0.08, cell_size=8e-3), touch_grid(Rectangle(0.1, 0.08), 6, 5)


@pytest.fixture(scope="module")
def full_study(tmp_path_factory):
    """The sweep with every score."""
    path = tmp_path_factory.mktemp("full") / "study.toml"
    path.write_text(EVERY_SCORE, "utf-8")
    return read_study(path)


@pytest.mark.slow
def test_results_equal_those_of_one_map_at_a_time(full_study, store_path):
    """For the nearest pairs of each layout."""
    study, data = full_study, run_study(full_study, store_path)
    prior = TouchPrior.create(GRID.places, correlation=20e-3)
    for number, point in enumerate(study.points):
        model = model_of(point)
        touches = sheet_touches(MESH, Bell(), GRID.places, thickness=point.thickness)
        found = SensitivityMap(GRID, linear_changes(model, 0.5 * point.thickness, touches.touched))
        taxels = find_taxels(found.changes, GRID.places, GRID.cell_area, num_taxels=5, key=jax.random.key(0))
        scores = layout_scores(model, 0.5 * point.thickness, touches, prior=prior, noise=1e-3)
        expected = {
            "sensitivity": found.values,
            "minimum": found.minimum,
            "mean": found.mean,
            "uniformity": found.uniformity,
            "blind_spot": found.blind_spot(1e-3 * np.sqrt(found.changes.shape[1])),
            "taxel_count": np.sum(taxels.areas > 0),
            "taxel_area_mean": 1e4 * taxels.mean_area,
            "taxel_area_std": 1e4 * taxels.std_area,
            "taxel_area_max": 1e4 * taxels.max_area,
            "information": scores.log_information,
            "mean_variance": scores.mean_variance,
            "largest_variance": scores.largest_variance,
            "localisation_error_mean": 1e3 * scores.localisation_error.mean(),
            "localisation_error_max": 1e3 * scores.localisation_error.max(),
            "localisation_lost": 0.0,
        }
        assert set(data.data_vars) == set(expected)
        for name, value in expected.items():
            np.testing.assert_allclose(data[name][number], value, rtol=1e-8, err_msg=name)  # the solves' rounding


@pytest.fixture
def results(tmp_path):
    """The points of a changed study, each with its sensitivities."""

    def call(**lines):
        (tmp_path / "other.toml").write_text(changed(**lines), "utf-8")
        study = read_study(tmp_path / "other.toml")
        return list(zip(study.points, run_study(study, tmp_path / "other.zarr").sensitivity.values, strict=True))

    return call


def model_of(point) -> ForwardModel:
    """Model of a skin as a sheet or a layer, and its ten nearest pairs."""
    centres = point.layout.centres
    protocol = two_terminal(8).subset(np.sort(nearest_pairs(centres, 10)))
    if not point.layers:
        return ForwardModel(MESH, SheetDiscs(centres, 5e-3, 1e-3), protocol)
    bottom = np.column_stack([centres, np.zeros(8)])
    return ForwardModel(layer(MESH, point.thickness, point.layers), FaceDiscs(bottom, 5e-3, 1e-3), protocol)


@pytest.mark.slow
def test_a_layer_is_touched_at_its_top(results):
    found = results(skin='model = "layer"', mesh="layers = 2")
    for point, values in found:
        theta = sensitivity_map(model_of(point), 0.5, GRID, linear=True)
        np.testing.assert_allclose(values, theta.values, rtol=1e-9)


@pytest.mark.slow
def test_exact_maps_of_layers_equal_those_of_a_comparison(results):
    lines = {"skin": 'model = "layer"', "mesh": "layers = 3", "touch": "exact = true"}
    for point, values in results(**lines):
        skin = Skin.create(
            point.layout,
            thickness=point.thickness,
            conductivity=0.5,
            cell_size=8e-3,
            num_layers=3,
            protocol=skin_protocol(point.layout, num_pairs=10),
        )
        response = skin_response(skin, GRID, key=jax.random.key(0), num_taxels=3)
        np.testing.assert_allclose(values, response.sensitivity.values, rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("exact", [True, False])
def test_conducting_touches_of_a_sheet(results, exact):
    for point, values in results(touch=f"contrast = 5\nexact = {str(exact).lower()}"):
        touched = touched_cells(MESH, Bell(), GRID.places, thickness=point.thickness, contrast=5.0)
        changes = touch_changes if exact else linear_changes
        found = changes(model_of(point), 0.5 * point.thickness, touched)
        np.testing.assert_allclose(values, np.linalg.norm(found, axis=1), rtol=1e-8)


def test_the_error_at_a_place_that_is_not_determined_is_infinite_and_counted(tmp_path, store_path, monkeypatch):
    """Two voltages, measured repeatedly, for a place and an amplitude."""
    (tmp_path / "study.toml").write_text(SWEEP.replace('"blind_spot"', '"localisation_error"'), "utf-8")
    study = read_study(tmp_path / "study.toml")
    measured = StudyPoint.measurement_protocol

    def two(point, current):
        protocol = measured(point, current)
        rows = np.arange(protocol.num_measurements) % 2
        parts = protocol.drive_index[rows], protocol.measurement_index[rows]
        return eqx.tree_at(lambda one: (one.drive_index, one.measurement_index), protocol, parts)

    monkeypatch.setattr(StudyPoint, "measurement_protocol", two)
    data = run_study(study, store_path)
    assert np.isposinf(data.localisation_error_mean).all()
    assert np.isposinf(data.localisation_error_max).all()
    assert (data.localisation_lost == 1).all()


def lowered(study, *scores):
    """The program for two points of a study, with its own scores or others, before it is compiled."""
    shared, skin = batch._shared_data(study, study.points[0].shape), batch._point_data(study.points[0], study.current)
    options = {"num_taxels": study.num_taxels, "threshold": study.threshold, "num_devices": 1}
    return batch._solve_batch.lower(shared, batch._stack_trees([skin] * 2), scores=scores or study.scores, **options)


def test_a_batch_calls_no_library(full_study):
    assert "lapack" in jax.jit(jnp.linalg.cholesky).lower(np.eye(2)).as_text()
    assert "lapack" not in lowered(full_study).as_text()


@pytest.mark.slow
def test_a_batch_factorises_once(full_study):
    wanted = ("taxels",), ("taxels", "information")
    maps, both = (lowered(full_study, *scores).compile().as_text() or "" for scores in wanted)
    assert maps.count(" while(") < both.count(" while(") < 2 * maps.count(" while(")


TWO_DEVICES = """
import sys, jax
from jeit.design.study import read_study, run_study
assert len(jax.devices()) == 2
run_study(read_study(sys.argv[1]), sys.argv[2])
"""


@pytest.mark.slow
def test_two_devices_give_the_same_results(full_study, tmp_path, store_path):
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    (tmp_path / "study.toml").write_text(EVERY_SCORE, "utf-8")
    ended = in_another_process(TWO_DEVICES, tmp_path / "study.toml", store_path, XLA_FLAGS=flags, JAX_PLATFORMS="cpu")
    assert ended.returncode == 0, ended.stderr
    here, there = run_study(full_study, tmp_path / "here.zarr"), open_results(full_study, store_path)
    for name in here.data_vars:
        np.testing.assert_allclose(there[name], here[name], rtol=1e-9, err_msg=name)
