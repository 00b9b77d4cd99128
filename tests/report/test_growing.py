"""Results of streams of any length: complete lines, rows written to disk one by one, and constant memory."""

import csv
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.inverse.streaming.stream import FrameImage, FrameStatus
from jeit.layout import ring
from jeit.mesh import Disk, centroids
from jeit.protocol import adjacent
from jeit.report import write_stream
from jeit.report.stream import (
    _TABLE_COLUMNS,
    GrowingRows,
    GrowingTable,
    SeriesSample,
    _StreamPictures,
    _StreamSummary,
    _table_row,
)


@pytest.fixture(scope="module")
def calibrated():
    """The parts of a calibration that `write_stream` uses: a model, and its conductivity, 1 S."""
    model = ForwardModel(Disk(0.05).mesh(num_points=200), BoundaryElectrodes(ring(0.05, 8), 0.01, 0.1), adjacent(8))
    return SimpleNamespace(model=model, conductivity=np.asarray(1.0))


def images(calibration, number, imaged=lambda one: True):
    """Images of a spot that grows stronger; the others are refused."""
    cells, usable = calibration.model.mesh.num_cells, np.ones(40, bool)
    for one in range(number):
        if imaged(one):
            change = np.where(np.arange(cells) == one % cells, 1e-3 * (one + 1) / number, 0.0)
            yield FrameImage(one, 1 + change, FrameStatus.IMAGED, "", usable, 1.0, 2, 1e-3 * one)
        else:
            yield FrameImage(one, None, FrameStatus.REFUSED, "no good", usable, np.nan, 0, 1e-3)


def test_a_stream_is_written_as_it_was_imaged(calibrated, tmp_path):
    progress = []
    written = write_stream(
        images(calibrated, 40, lambda one: one % 3 != 1), calibrated, tmp_path, film=None, drawing=progress.append
    )
    with np.load(tmp_path / "images.npz") as held:
        assert sorted(held.files) == ["background", "cells", "conductivity", "points"]
        assert held["conductivity"].shape == (40, calibrated.model.mesh.num_cells)
        assert held["conductivity"].dtype == np.float32
        assert np.isnan(held["conductivity"][1::3]).all()
        np.testing.assert_allclose(held["conductivity"][39].max(), 1 + 1e-3, rtol=1e-6)
        np.testing.assert_array_equal(held["cells"], calibrated.model.mesh.cells)
    assert (written.number, written.counts) == (40, {"imaged": 27, "refused": 13})
    np.testing.assert_allclose(written.latency, 1e-3 * np.array([one for one in range(40) if one % 3 != 1]))
    assert progress == ["images", "contact sheet"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frames.csv", "frames.png", "images.npz"]
    with (tmp_path / "frames.csv").open(encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    assert [int(line["frame"]) for line in lines] == list(range(40))
    assert {line["channels"] for line in lines} == {"40"}
    refused = {**dict.fromkeys(lines[1], ""), "status": "refused", "latency_ms": "1.000", "reason": "no good"}
    assert lines[1] == {**refused, "frame": "1", "channels": "40", "iterations": "0"}
    pressed = lines[33]
    assert (pressed["status"], pressed["misfit"], pressed["iterations"]) == ("imaged", "1", "2")
    assert float(pressed["latency_ms"]) == pytest.approx(33)
    place = np.asarray(centroids(calibrated.model.mesh))[33]
    np.testing.assert_allclose([float(pressed["x_m"]), float(pressed["y_m"])], place, atol=1e-5)
    assert float(pressed["peak"]) == pytest.approx(1e-3 * 34 / 40, rel=1e-4)


@pytest.mark.parametrize(("rate", "titles"), [(None, ["frame 0", "frame 7"]), (5.0, ["0.00 s", "1.40 s"])])
def test_frames_are_called_by_their_times_if_the_rate_is_known(rate, titles, tmp_path):
    assert _StreamPictures(tmp_path, None, rate, print)._frame_titles([0, 7]) == titles


def test_the_line_of_a_solid_has_the_horizontal_place():
    def strongest(change):
        return np.array([0.01, -0.02, 0.03]), float(change[0])

    pressed = FrameImage(3, np.full(5, 1.2), FrameStatus.IMAGED, "", np.ones(40, bool), np.nan, 2, 2e-3)
    line = _table_row(pressed, strongest, 1.0)  # pyright: ignore[reportArgumentType]
    stated = dict(zip(_TABLE_COLUMNS, line, strict=True))
    assert (stated["x_m"], stated["y_m"], stated["peak"]) == ("0.01000", "-0.02000", "0.2")
    assert (stated["misfit"], stated["latency_ms"]) == ("", "2.000")


def test_an_unchanged_frame_has_no_peak(calibrated, tmp_path):
    flat = np.ones(calibrated.model.mesh.num_cells)
    unchanged = FrameImage(0, flat, FrameStatus.UNCHANGED, "no change", np.ones(40, bool), 0.5, 0, 1e-3)
    write_stream([unchanged, *images(calibrated, 1)], calibrated, tmp_path, film=None)
    with (tmp_path / "frames.csv").open(encoding="utf-8") as file:
        still, pressed = list(csv.DictReader(file))
    assert still["status"] == "unchanged"
    assert still["misfit"] == "0.5"
    peaks = {name for name in still if name.startswith(("x", "y", "peak"))}
    assert peaks
    assert all(still[name] == "" and pressed[name] != "" for name in peaks)


def test_the_colour_scale_does_not_amplify_noise(calibrated):
    """If no frame has changed, the scale ends at 1 % of the background; otherwise at the largest change."""
    noise = 1 + np.full(calibrated.model.mesh.num_cells, 1e-6)
    unchanged = FrameImage(0, noise, FrameStatus.UNCHANGED, "no change", np.ones(40, bool), 0.5, 0, 1e-3)
    seen = _StreamSummary(calibrated)
    seen.add_frame(unchanged)
    assert seen.colour_limit == pytest.approx(0.01)
    for one in images(calibrated, 1):
        seen.add_frame(one)
    assert seen.colour_limit == pytest.approx(1e-3, rel=1e-3)


def test_the_only_imaged_frame_is_drawn(calibrated, tmp_path, monkeypatch):
    """Even if it is not among the frames that are drawn by default."""
    monkeypatch.setattr("jeit.report.stream.FILM_FRAMES", 4)
    written = write_stream(images(calibrated, 100, lambda one: one == 3), calibrated, tmp_path, film="film.gif")
    assert written.counts == {"refused": 99, "imaged": 1}
    assert (tmp_path / "frames.png").stat().st_size > 10_000
    assert (tmp_path / "film.gif").stat().st_size > 10_000


def no_pictures(what):
    if what == "contact sheet":
        raise InterruptedError


@pytest.mark.slow
def test_memory_does_not_grow_with_a_stream(calibrated, tmp_path):
    def peak(number):
        tracemalloc.start()
        with pytest.raises(InterruptedError):
            write_stream(images(calibrated, number), calibrated, tmp_path, drawing=no_pictures)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    peak(10)
    first, second = peak(1000), peak(4000)
    assert second - first < 5e5  # the images take 5 MB
    with np.load(tmp_path / "images.npz") as held:
        assert held["conductivity"].nbytes > 5e6


def test_results_without_drawings_are_complete(calibrated, tmp_path):
    with pytest.raises(InterruptedError):
        write_stream(images(calibrated, 5), calibrated, tmp_path, drawing=no_pictures)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frames.csv", "images.npz"]


def limited(size):
    """A context in which no file may be larger than this number of bytes."""
    resource = pytest.importorskip("resource")

    class Limited:
        def __enter__(self):
            self.earlier = resource.getrlimit(resource.RLIMIT_FSIZE)
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, self.earlier[1]))

        def __exit__(self, *_):
            resource.setrlimit(resource.RLIMIT_FSIZE, self.earlier)

    return Limited()


def test_a_full_disk_leaves_complete_lines(tmp_path):
    with GrowingTable(tmp_path / "a.csv", ("one", "two")) as table, limited(40):
        table.write((1, "first"))
        with pytest.raises(OSError, match="File too large"):
            table.write((2, "more than there is room for, in two pieces"))
    assert (tmp_path / "a.csv").read_bytes() == b"one,two\r\n1,first\r\n"


def test_the_error_of_a_full_disk_names_the_results_written(calibrated, tmp_path):
    with (
        limited(20_000),
        pytest.raises(OSError, match=r"File too large: what came .* frames\.csv has the \d+ frames until then"),
    ):
        write_stream(images(calibrated, 100), calibrated, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["frames.csv"]
    with open(tmp_path / "frames.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) >= 10
    assert all(None not in row.values() for row in rows)


def test_a_link_is_not_followed(tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    (tmp_path / "a.csv").symlink_to(tmp_path / "letter.txt")
    with GrowingTable(tmp_path / "a.csv", ("one",)):
        pass
    assert (tmp_path / "letter.txt").read_text() == "dear"
    assert (tmp_path / "a.csv").read_text() == "one\n"


def test_single_rows_are_read_from_the_file(tmp_path):
    with GrowingRows(tmp_path, (2, 3)) as rows:
        for one in range(5000):
            rows.append(np.full((2, 3), one))
        assert rows.read([0, 4999, 17])[:, 1, 2].tolist() == [0, 4999, 17]
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("number", "expected"), [(2, []), (8, ["96 %", "100 %"])])
def test_the_progress_of_large_files_is_reported(number, expected, tmp_path, monkeypatch):
    monkeypatch.setattr("jeit.report.stream._BLOCK_BYTES", 92)
    reported = []
    with GrowingRows(tmp_path, (2, 3)) as rows:
        for one in range(number):
            rows.append(np.full((2, 3), one))
        for progress in (reported.append, None):
            rows.write_npz(tmp_path / "a.npz", "rows", {"other": np.arange(3)}, progress)
            with np.load(tmp_path / "a.npz") as held:
                np.testing.assert_array_equal(held["rows"], np.arange(number)[:, None, None] + np.zeros((2, 3)))
                np.testing.assert_array_equal(held["other"], np.arange(3))
    assert reported == expected


def test_a_sample_of_rows_is_evenly_spaced_and_limited():
    sample = SeriesSample()
    for one in range(1000):
        sample.append(one)
    assert sample.values().tolist() == list(range(1000))
    for one in range(1000, 1_000_000):
        sample.append(one)
    values = sample.values()
    assert 30_000 < len(values) <= 2**16
    assert set(np.diff(values)) == {16}
    assert values[-1] > 999_980
