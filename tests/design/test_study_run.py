"""Studies run: against one map at a time, and against kill -9, full disks, damaged files and lost workers."""

import errno
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from jeit.design import (
    Bell,
    TouchPrior,
    feel,
    find_taxels,
    layout_scores,
    nearest_pairs,
    sensitivity_map,
    sheet_touches,
    touch_grid,
)
from jeit.design.study import batch, open_results, read_study, run_study, study_progress
from jeit.design.study import run as run_module
from jeit.design.study import store as store_module
from jeit.design.study.store import Store
from jeit.electrodes import FaceDiscs, SheetDiscs
from jeit.forward import ForwardModel
from jeit.mesh import Rectangle, layer, rectangle
from jeit.protocol import adjacent, two_terminal

xarray = pytest.importorskip("xarray")
pytest.importorskip("zarr")

TEXT = """
chunk_points = 2
[skin]
width_mm = 100
height_mm = 80
thickness_mm = [5, 8]
conductivity_S_per_m = 0.5
[electrodes]
layouts = ["grid-4x2", "perimeter-8", "inner-8"]
diameter_mm = 10
[measurement]
noise_V = 1e-3
[touch]
columns = 6
rows = 5
[mesh]
cell_mm = 8
[scores]
wanted = ["minimum", "mean", "uniformity", "blind_spot", "taxels", "information", "mean_variance", "largest_variance",
    "localisation_error"]
num_taxels = 5
correlation_mm = 20
"""
# Chunks of two of the six points, all of one shape; arrays of each.
CHUNKS, ARRAYS = 3, 15
MESH, GRID = rectangle(0.1, 0.08, cell_size=8e-3), touch_grid(Rectangle(0.1, 0.08), 6, 5)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("study") / "study.toml"
    path.write_text(TEXT, "utf-8")
    return path


@pytest.fixture(scope="module")
def study(file):
    return read_study(file)


@pytest.fixture(scope="module")
def whole(study, file):
    """The store of a run that nothing disturbed."""
    run_study(study, file.parent / "whole.zarr")
    return file.parent / "whole.zarr"


@pytest.fixture
def path(tmp_path):
    return tmp_path / "study.zarr"


def contents(store: Path) -> dict[str, bytes]:
    return {str(file.relative_to(store)): file.read_bytes() for file in store.rglob("*") if file.is_file()}


def counted(monkeypatch) -> list[int]:
    """The chunks that are solved from now on."""
    solved, solve = [], run_module.solve_chunk
    monkeypatch.setattr(
        run_module, "solve_chunk", lambda study, number, *rest: solved.append(number) or solve(study, number, *rest)
    )
    return solved


def test_results_are_those_of_one_map_at_a_time(study, whole):
    data = open_results(study, whole)
    prior = TouchPrior.create(GRID.places, correlation=20e-3)
    for number, point in enumerate(study.points):
        electrodes = SheetDiscs(point.layout.centres, 5e-3, 1e-3)
        model = ForwardModel(MESH, electrodes, adjacent(8, current=1e-3))
        found = sensitivity_map(model, 0.5 * point.thickness, GRID, thickness=point.thickness, linear=True)
        taxels = find_taxels(found.changes, GRID.places, GRID.cell_area, num_taxels=5, key=jax.random.key(0))
        touches = sheet_touches(MESH, Bell(), GRID.places, thickness=point.thickness)
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


def changed(text: str, **lines) -> str:
    """A study of two layouts and one score, with other lines at the beginnings of sections."""
    text = text.replace('"grid-4x2", "perimeter-8", "inner-8"', '"grid-4x2", "perimeter-8"')
    text = text[: text.index("[scores]")]
    for section, more in lines.items():
        text = text.replace(f"[{section}]\n", f"[{section}]\n{more}\n")
    return text


@pytest.fixture
def results(tmp_path):
    """The points of a changed study, each with its sensitivities."""

    def call(**lines):
        (tmp_path / "other.toml").write_text(changed(TEXT, **lines), "utf-8")
        study = read_study(tmp_path / "other.toml")
        return list(zip(study.points, run_study(study, tmp_path / "other.zarr").sensitivity.values, strict=True))

    return call


def model_of(point, *, number=None) -> ForwardModel:
    """Of a skin as a sheet, or a layer, and its nearest `number` pairs."""
    centres = point.layout.centres
    protocol = adjacent(8) if number is None else two_terminal(8).subset(np.sort(nearest_pairs(centres, number)))
    if not point.layers:
        return ForwardModel(MESH, SheetDiscs(centres, 5e-3, 1e-3), protocol)
    bottom = np.column_stack([centres, np.zeros(8)])
    return ForwardModel(layer(MESH, point.thickness, point.layers), FaceDiscs(bottom, 5e-3, 1e-3), protocol)


def test_the_nearest_pairs_of_each_layout_are_measured(results):
    found = results(measurement='protocol = "two-terminal"\npairs = [10, 28]')
    assert len(found) == 8
    for point, values in found:
        model = model_of(point, number=point.pairs)
        theta = sensitivity_map(model, 0.5 * point.thickness, GRID, thickness=point.thickness, linear=True)
        np.testing.assert_allclose(values, theta.values, rtol=1e-9)


@pytest.mark.slow
def test_a_layer_is_touched_on_its_top(results):
    found = results(skin='model = "layer"', mesh="layers = 3")
    for point, values in found:
        theta = sensitivity_map(model_of(point), 0.5, GRID, linear=True)
        np.testing.assert_allclose(values, theta.values, rtol=1e-9)


@pytest.mark.slow
def test_exact_maps_of_layers_are_those_of_a_comparison(results):
    lines = {"skin": 'model = "layer"', "mesh": "layers = 3", "touch": "exact = true"}
    for point, values in results(measurement='protocol = "two-terminal"\npairs = 10', **lines):
        felt = feel(
            point.layout,
            GRID,
            key=jax.random.key(0),
            thickness=point.thickness,
            conductivity=0.5,
            cell_size=8e-3,
            num_layers=3,
            num_pairs=10,
            num_taxels=3,
        )
        np.testing.assert_allclose(values, felt.sensitivity.values, rtol=1e-8)


@pytest.mark.parametrize("exact", [True, False])
def test_conducting_touches_of_a_sheet(results, exact):
    for point, values in results(touch=f"contrast = 5\nexact = {str(exact).lower()}"):
        conductance, thickness = 0.5 * point.thickness, point.thickness
        options = {"thickness": thickness, "contrast": 5.0, "linear": not exact}
        theta = sensitivity_map(model_of(point), conductance, GRID, **options)
        np.testing.assert_allclose(values, theta.values, rtol=1e-8)


def test_exact_maps_are_told_one_by_one_and_resumed_to_the_same_store(tmp_path, path, monkeypatch):
    text = changed(TEXT, touch="exact = true") + '[scores]\nwanted = ["mean", "taxels", "information"]\nnum_taxels = 5'
    (tmp_path / "exact.toml").write_text(text, "utf-8")
    study, told = read_study(tmp_path / "exact.toml"), []
    run_study(study, path, progress=told.append)
    assert [(now.points, now.chunks) for now in told] == [(0, 0), (1, 0), (2, 1), (3, 1), (4, 2)]

    def stop(now):
        if now.points == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(study, tmp_path / "stopped.zarr", progress=stop)
    assert study_progress(study, tmp_path / "stopped.zarr").points == 2
    solved = counted(monkeypatch)
    run_study(study, tmp_path / "stopped.zarr")
    assert solved == [1]
    assert contents(tmp_path / "stopped.zarr") == contents(path)


def test_a_place_that_cannot_be_told_is_infinite_and_counted(tmp_path, path):
    lines = {"measurement": 'protocol = "two-terminal"\npairs = 2'}  # two voltages for a place and an amplitude
    (tmp_path / "two.toml").write_text(changed(TEXT, **lines) + '[scores]\nwanted = "localisation_error"', "utf-8")
    data = run_study(read_study(tmp_path / "two.toml"), path)
    assert np.isposinf(data.localisation_error_mean).all()
    assert np.isposinf(data.localisation_error_max).all()
    assert (data.localisation_lost == 1).all()


def test_a_batch_factorises_once_and_calls_no_library(study):
    shared, skin = batch._shared(study, study.points[0].shape), batch._skin(study.points[0], study.current)
    skins, options = batch._stacked([skin] * 2), {"num_taxels": 5, "threshold": 0.7, "num_devices": 1}

    def compiled(*scores):
        return batch._batch.lower(shared, skins, scores=scores, **options).compile().as_text() or ""

    maps, both = compiled("taxels"), compiled("taxels", "information")
    assert "lapack" not in both
    assert maps.count(" while(") < both.count(" while(") < 2 * maps.count(" while(")


def test_xarray_opens_the_store(study, whole):
    with xarray.open_zarr(whole) as data:
        assert dict(data.sizes) == {"point": 6, "place": 30}
        assert data.layout.values.tolist() == [point.layout.name for point in study.points]
        assert data.thickness_mm.values.tolist() == [5, 8] * 3
        np.testing.assert_allclose(data.x_mm[:2], [-50 + 100 / 12, -25])
        assert data.sensitivity.units == "V"
        assert {"protocol", "diameter_mm", "electrodes", "y_mm"} <= set(data.coords)
        assert np.isfinite(data.sensitivity).all()
        assert data.attrs["study"] == TEXT


def test_a_finished_study_is_not_run_again(study, whole, monkeypatch):
    before, solved = contents(whole), counted(monkeypatch)
    told = []
    run_study(study, whole, progress=told.append)
    assert solved == []
    assert contents(whole) == before
    assert [(now.points, now.chunks) for now in told] == [(6, CHUNKS)]


def test_progress_counts_up_and_says_the_time_left(study, path):
    told = []
    run_study(study, path, progress=told.append)
    assert [now.points for now in told] == [0, 2, 4, 6]
    assert [now.chunks for now in told] == [0, 1, 2, 3]
    assert {(now.all_points, now.all_chunks) for now in told} == {(6, CHUNKS)}
    assert told[0].seconds_left is None
    assert told[1].seconds_left > 0
    assert told[-1].seconds_left == 0
    assert study_progress(study, path)[:4] == told[-1][:4]


KILLED = """
import os, signal, sys
from jeit.design.study import read_study, run_study
from jeit.design.study.store import Store

write, calls = Store.write_array, []

def dying(self, name, points, values):
    calls.append(name)
    if len(calls) == {calls}:
        write(self, name, points[:1], values[:1])
        os.kill(os.getpid(), signal.SIGKILL)
    write(self, name, points, values)

Store.write_array = dying
run_study(read_study(sys.argv[1]), sys.argv[2])
"""


def child(code: str, *arguments, **environment) -> subprocess.CompletedProcess:
    variables = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir)} | environment
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], env=variables, capture_output=True, text=True, timeout=120
    )


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_killed_in_the_middle_of_a_chunk_and_resumed_the_store_is_the_same(study, file, whole, path, monkeypatch):
    # The second chunk, half of its last array.
    ended = child(KILLED.format(calls=2 * ARRAYS), file, path)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    assert study_progress(study, path).chunks == 1
    torn = contents(path)
    assert len([name for name in torn if name.startswith("sensitivity/c/")]) > 2
    data = open_results(study, path)
    assert data.finished.values.sum() == 2
    assert np.isnan(data.sensitivity.values[~data.finished.values]).all()  # what is torn is not read
    solved = counted(monkeypatch)
    run_study(study, path)
    assert solved == [1, 2]
    assert contents(path) == contents(whole)


@pytest.mark.parametrize("where", ["before the mark", "in the mark"])
def test_stopped_about_the_mark(study, whole, path, monkeypatch, where):
    """Interrupted between a chunk's arrays and its mark, or before the mark takes the place of the old one."""

    def stop(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        if where == "before the mark":
            patch.setattr(Store, "_mark", stop)
        else:
            patch.setattr(store_module.os, "fsync", stop)
        with pytest.raises(KeyboardInterrupt):
            run_study(study, path)
    assert not [name for name in os.listdir(path.parent) if name.endswith(".tmp")]
    if path.exists():
        assert study_progress(study, path).chunks == 0
    run_study(study, path)
    assert contents(path) == contents(whole)


def test_a_full_disk_keeps_finished_chunks(study, whole, path, monkeypatch):
    write = Store.write_array

    def full(self, name, points, values):
        if 2 in points and name == "mean":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(self, name, points, values)

    with monkeypatch.context() as patch:
        patch.setattr(Store, "write_array", full)
        with pytest.raises(OSError, match="No space left on device: a chunk could not be written; 1 of 3 chunks are"):
            run_study(study, path)
    assert study_progress(study, path).chunks == 1
    solved = counted(monkeypatch)
    run_study(study, path)
    assert solved == [1, 2]
    assert contents(path) == contents(whole)


@pytest.mark.parametrize("damage", ["cut short", "changed", "lost"])
def test_a_damaged_chunk_is_solved_again(study, whole, path, monkeypatch, damage):
    shutil.copytree(whole, path)
    victim, other = path / "sensitivity/c/3/0", path / "sensitivity/c/0/0"
    if damage == "cut short":
        victim.write_bytes(victim.read_bytes()[:10])
    elif damage == "changed":
        victim.write_bytes(other.read_bytes())
    else:
        victim.unlink()
    assert open_results(study, path).finished.values.tolist() == [True, True, False, False, True, True]
    assert study_progress(study, path).points == 4
    solved = counted(monkeypatch)
    run_study(study, path)
    assert solved == [1]
    assert contents(path) == contents(whole)


def test_other_stores_are_refused_and_left_alone(study, whole, path, file):
    (file.parent / "other.toml").write_text(TEXT.replace("[5, 8]", "[5, 9]"), "utf-8")
    before = contents(whole)
    with pytest.raises(ValueError, match="holds the results of another study"):
        run_study(read_study(file.parent / "other.toml"), whole)
    assert contents(whole) == before
    path.mkdir()
    (path / "letter.txt").write_text("dear")
    with pytest.raises(ValueError, match="holds the results of another study"):
        run_study(study, path)
    assert contents(path) == {"letter.txt": b"dear"}
    with pytest.raises(FileNotFoundError, match="no study at"):
        open_results(study, path / "none")


@pytest.mark.parametrize("damage", ["cut short", "empty", "no text"])
def test_a_damaged_store_is_not_called_another_study(study, whole, path, damage):
    shutil.copytree(whole, path)
    file = path / "zarr.json"
    file.write_bytes({"cut short": file.read_bytes()[:500], "empty": b"", "no text": b"\xff\xfe"}[damage])
    for use in (run_study, open_results, study_progress):
        with pytest.raises(ValueError, match=r"zarr\.json cannot be read .*the store is damaged"):
            use(study, path)


def test_an_unwritable_store_is_said_before_anything_runs(study, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    solved = counted(monkeypatch)
    with pytest.raises(OSError, match="the study's store cannot be made"):
        run_study(study, tmp_path / "file" / "study.zarr")
    assert solved == []


def test_electrodes_too_small_for_their_mesh_are_refused_before_anything_runs(path, file):
    text = TEXT.replace("diameter_mm = 10", "diameter_mm = 2.1")
    (file.parent / "small.toml").write_text(text, "utf-8")
    with pytest.raises(ValueError, match=r"mesh\.cell_mm = 8 with layout '.*': .*mesh"):
        run_study(read_study(file.parent / "small.toml"), path)
    assert not path.exists()


def test_a_layer_too_coarse_for_its_touches_is_refused_before_anything_runs(path, file):
    text = changed(TEXT, skin='model = "layer"', touch="depth_mm = 0.5", mesh="layers = 1")
    (file.parent / "coarse.toml").write_text(text, "utf-8")
    with pytest.raises(ValueError, match=r"mesh\.cell_mm = 8 and mesh\.layers = 1 .*touches change no cell"):
        run_study(read_study(file.parent / "coarse.toml"), path)
    assert not path.exists()


def test_a_missing_package_names_the_extra(study, path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(ImportError, match=r"pip install 'jeit\[cluster\]'"):
        run_study(study, path)


TWO_DEVICES = """
import sys, jax
from jeit.design.study import read_study, run_study
assert len(jax.devices()) == 2
run_study(read_study(sys.argv[1]), sys.argv[2])
"""


@pytest.mark.slow
def test_two_devices_give_the_same(study, file, whole, path):
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    ended = child(TWO_DEVICES, file, path, XLA_FLAGS=flags, JAX_PLATFORMS="cpu")
    assert ended.returncode == 0, ended.stderr
    here, there = open_results(study, whole), open_results(study, path)
    for name in here.data_vars:
        np.testing.assert_allclose(there[name], here[name], rtol=1e-9, err_msg=name)


@pytest.mark.slow
def test_a_lost_worker_loses_nothing(study, whole, path):
    distributed = pytest.importorskip("distributed")
    told = []
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):

        def kill_one(now):
            told.append(now.chunks)
            if now.chunks == 1:
                busy = max(client.processing().items(), key=lambda item: len(item[1]))[0]
                pids = client.run(os.getpid, workers=[busy])
                os.kill(pids[busy], signal.SIGKILL)

        data = run_study(study, path, client=client, progress=kill_one)
    assert told == [0, 1, 2, 3]
    assert data.finished.all()
    assert contents(path) == contents(whole)
