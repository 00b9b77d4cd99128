"""Running studies: into a store that xarray opens, with progress, and with errors before anything runs."""

import sys

import numpy as np
import pytest
from studies import CHUNKS, SWEEP, changed, contents

from jeit.design import Bell, touch_grid
from jeit.design.skin.touched_cells import touched_cells
from jeit.design.skin.voltage_changes import touch_changes
from jeit.design.study import open_results, read_study, run_study, study_progress
from jeit.design.study import run as study_run
from jeit.electrodes import SheetDiscs
from jeit.forward import ForwardModel
from jeit.mesh import Rectangle, rectangle

xarray = pytest.importorskip("xarray")
pytest.importorskip("zarr")


def test_xarray_opens_the_store(study, whole_store):
    with xarray.open_zarr(whole_store) as data:
        assert dict(data.sizes) == {"point": 6, "place": 30}
        assert data.layout.values.tolist() == [point.layout.name for point in study.points]
        assert data.thickness_mm.values.tolist() == [5, 8] * 3
        np.testing.assert_allclose(data.x_mm[:2], [-50 + 100 / 12, -25])
        assert data.sensitivity.units == "V"
        assert {"protocol", "diameter_mm", "electrodes", "y_mm"} <= set(data.coords)
        assert np.isfinite(data.sensitivity).all()
        assert data.attrs["study"] == SWEEP


def test_a_finished_study_is_not_run_again(study, whole_store, watch_chunks):
    before, solved = contents(whole_store), watch_chunks()
    reports = []
    run_study(study, whole_store, progress=reports.append)
    assert solved == []
    assert contents(whole_store) == before
    assert [(now.points, now.chunks) for now in reports] == [(6, CHUNKS)]


def test_progress_counts_up_and_estimates_the_remaining_time(study, store_path):
    reports = []
    run_study(study, store_path, progress=reports.append)
    assert [now.points for now in reports] == [0, 2, 4, 6]
    assert [now.chunks for now in reports] == [0, 1, 2, 3]
    assert {(now.all_points, now.all_chunks) for now in reports} == {(6, CHUNKS)}
    assert reports[0].seconds_left is None
    assert reports[1].seconds_left > 0
    assert reports[-1].seconds_left == 0
    assert study_progress(study, store_path)[:4] == reports[-1][:4]


@pytest.mark.slow
def test_exact_maps_are_reported_one_by_one_and_resumed_to_the_same_store(tmp_path, store_path, watch_chunks):
    """Of conducting touches. One map against a model of its own."""
    text = changed(touch="exact = true\ncontrast = 5") + '[scores]\nwanted = "mean"'
    (tmp_path / "exact.toml").write_text(text, "utf-8")
    study, reports = read_study(tmp_path / "exact.toml"), []
    found = run_study(study, store_path, progress=reports.append)
    point, plane = study.points[1], rectangle(0.1, 0.08, cell_size=8e-3)
    model = ForwardModel(plane, SheetDiscs(point.layout.centres, 5e-3, 1e-3), point.measurement_protocol(study.current))
    places = touch_grid(Rectangle(0.1, 0.08), 6, 5).places
    touched = touched_cells(plane, Bell(), places, thickness=point.thickness, contrast=5.0)
    exact = touch_changes(model, 0.5 * point.thickness, touched)
    np.testing.assert_allclose(found.sensitivity[1], np.linalg.norm(exact, axis=1), rtol=1e-8)
    assert [(now.points, now.chunks) for now in reports] == [(0, 0), (1, 0), (2, 1), (3, 1), (4, 2)]

    def stop(now):
        if now.points == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(study, tmp_path / "stopped.zarr", progress=stop)
    assert study_progress(study, tmp_path / "stopped.zarr").points == 2
    solved = watch_chunks()
    run_study(study, tmp_path / "stopped.zarr")
    assert solved == [1]
    assert contents(tmp_path / "stopped.zarr") == contents(store_path)


def test_other_stores_are_refused_and_unchanged(study, whole_store, store_path, study_file):
    (study_file.parent / "other.toml").write_text(SWEEP.replace("[5, 8]", "[5, 9]"), "utf-8")
    before = contents(whole_store)
    with pytest.raises(ValueError, match="holds the results of another study"):
        run_study(read_study(study_file.parent / "other.toml"), whole_store)
    assert contents(whole_store) == before
    store_path.mkdir()
    (store_path / "letter.txt").write_text("dear")
    with pytest.raises(ValueError, match="holds no study: name the store that 'jeit study run' wrote"):
        run_study(study, store_path)
    assert contents(store_path) == {"letter.txt": b"dear"}
    with pytest.raises(FileNotFoundError, match="no study at"):
        open_results(study, store_path / "none")


def test_an_unwritable_store_is_reported_before_anything_runs(study, tmp_path, watch_chunks):
    (tmp_path / "file").write_text("in the way")
    solved = watch_chunks()
    with pytest.raises(OSError, match="the study's store cannot be made"):
        run_study(study, tmp_path / "file" / "study.zarr")
    assert solved == []


def test_electrodes_too_small_for_their_mesh_are_refused_on_reading(study_file):
    """With the limit that skins have: a study that can be read can be run."""
    text = SWEEP.replace("diameter_mm = 10", "diameter_mm = 2.1")
    (study_file.parent / "small.toml").write_text(text, "utf-8")
    with pytest.raises(
        ValueError, match=r"mesh\.cell_mm is 8 mm; give no more than 3\.15 mm, as electrodes of '.*' are 2"
    ):
        read_study(study_file.parent / "small.toml")


def test_a_layer_too_coarse_for_its_touches_is_refused_before_anything_runs(store_path, study_file):
    text = changed(skin='model = "layer"', touch="depth_mm = 0.5", mesh="layers = 1")
    (study_file.parent / "coarse.toml").write_text(text, "utf-8")
    with pytest.raises(
        ValueError, match=r"mesh\.cell_mm = 8 and mesh\.layers = 1: .*touches change no cell, the first at \(.*\) mm"
    ):
        run_study(read_study(study_file.parent / "coarse.toml"), store_path)
    assert not store_path.exists()


def test_a_missing_package_names_the_extra(study, store_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(ImportError, match=r"pip install 'jeit\[cluster\]'"):
        run_study(study, store_path)


def test_the_remaining_time_is_that_of_the_points_finished_in_this_run(monkeypatch):
    """Points of earlier runs count as finished, but not for the time of a point."""
    now = iter([100.0, 106.0, 110.0])
    monkeypatch.setattr(study_run.time, "monotonic", lambda: next(now))
    reports = []
    reporter = study_run.ProgressReporter([(0, 1), (2, 3, 4), (5, 6, 7, 8, 9)], {0}, reports.append)
    reporter.report_finished_chunk(1)
    reporter.report_points(2)
    assert reports[0] == (2, 10, 1, 3, None)
    assert reports[1] == (5, 10, 2, 3, pytest.approx(5 * 6 / 3))
    assert reports[2] == (7, 10, 2, 3, pytest.approx(3 * 10 / 5))
