"""Invalid input to the library and to the command line: each error message says what is wrong and what to do."""

import os
import runpy
import subprocess
import sys

import numpy as np
import pytest
import scipy.io

from jeit import electrodes as el
from jeit import layout as ly
from jeit import protocol as pr
from jeit.data import read
from jeit.data.round_skin import RoundSkin, simulate_press
from jeit.forward import ForwardModel
from jeit.image import Raster, find_inclusions
from jeit.imaging import ImagingSettings, StreamSettings, compare_on_data, image_difference, prepare_imager
from jeit.inverse import Gaussian, Noser, back_projection, calibrate, one_step, posterior, reconstruct, stream
from jeit.mesh import Disk, Mesh, Polygon, Rectangle, Refine, box, disk
from jeit.plot import plot_image
from jeit.plot.imaging.image import plot_raster
from jeit.plot.imaging.judgement import plot_voltages

SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
CELLS = np.array([[0, 1, 2], [0, 2, 3]])


@pytest.fixture(scope="module")
def mesh():
    return disk(0.1, num_points=150)


@pytest.fixture(scope="module")
def model(mesh):
    return ForwardModel(mesh, arcs(), pr.adjacent(8))


def arcs(number=8, radius=0.1, width=0.01, contact_impedance=0.01):
    return el.BoundaryElectrodes(ly.ring(radius, number), width, contact_impedance)


GEOMETRY = {
    "negative radius": (lambda: disk(-0.1), "radius: expected a positive length"),
    "radius is text": (lambda: Disk("10 cm"), "expected a positive length in metres"),  # pyright: ignore[reportArgumentType]
    "flat rectangle": (lambda: Rectangle(0.1, 0.0), "height: expected a positive length"),
    "centre of three": (lambda: Disk(0.1, (0, 0, 0)), "two finite coordinates"),
    "too few vertices": (lambda: Polygon(SQUARE[:2]), "vertices: "),
    "outline crosses itself": (lambda: Polygon(SQUARE[[0, 2, 1, 3]]), "cross"),
    "hole outside": (lambda: Polygon(SQUARE, [SQUARE + 3]), "strictly inside the outline"),
    "points transposed": (lambda: Mesh.create(SQUARE.T, CELLS), "Transpose"),
    "NaN node": (lambda: Mesh.create(np.where(SQUARE == 0, np.nan, SQUARE), CELLS), "NaN"),
    "cell of unknown node": (lambda: Mesh.create(SQUARE, CELLS + 1), "They look one-based"),
    "duplicated cell": (lambda: Mesh.create(SQUARE, CELLS[[0, 1, 0]]), "are duplicated"),
    "flat cell": (
        lambda: Mesh.create(SQUARE * [1, 0] + [[0, 0], [1, 0], [3, 0], [0.5, 0]], CELLS),
        "flat|degenerate|area",
    ),
    "node twice": (lambda: Mesh.create(SQUARE[[0, 1, 2, 2]], CELLS), "coincide with another"),
    "unused node": (lambda: Mesh.create(SQUARE, CELLS[:1]), "belong to no cell"),
    "unknown tag": (lambda: Mesh.create(SQUARE, CELLS, tags={"side": [9]}), "'side' holds facet indices"),
    "no cell size": (lambda: disk(0.1, num_points=2), "num_points"),
    "both sizes": (lambda: disk(0.1, num_points=100, cell_size=0.01), "cell_size"),
    "cells without end": (lambda: disk(0.1, cell_size=1e-6), "cell_size"),
    "refine by nothing": (lambda: Refine([[0, 0]]), "exactly one of cell_size"),
    "refine too steep": (lambda: Refine([[0, 0]], factor=2, growth=3), "growth"),
    "box without height": (lambda: box(0.1, 0.1, -0.1), "height: expected a positive length"),
    "raster without extent": (lambda: Raster.create(disk(0.1, num_points=60), extent=(0, 0, 0, 1)), "extent"),
}

ELECTRODES = {
    "off the boundary": (
        lambda mesh: arcs(radius=0.05).check(mesh),
        r"electrode 1 lies 0\.04\d+ m from the boundary of the mesh",
    ),
    "in millimetres": (lambda mesh: arcs(radius=100.0).check(mesh), "metres"),
    "overlapping": (lambda mesh: arcs(width=0.09).check(mesh), "Electrodes 1 and 2 overlap"),
    "wider than the edge": (lambda mesh: arcs(number=1 + 1, width=2.0).check(mesh), "electrode 1 is 2 m wide"),
    "zero width": (lambda mesh: arcs(width=0.0), "width must be positive"),
    "negative contact impedance": (lambda mesh: arcs(contact_impedance=-1), "contact_impedance must be positive"),
    "NaN position": (lambda mesh: el.PointElectrodes([[np.nan, 0.0]]), "NaN"),
    "widths of another number": (lambda mesh: arcs(width=np.full(3, 0.01)), "one for each of the"),
    "positions in one row": (lambda mesh: el.PointElectrodes([0.1, 0.0]), "one row per electrode"),
    "disc off the sheet": (lambda mesh: el.SheetDiscs([[0.5, 0]], 0.01, 0.01).check(mesh), "off the mesh"),
    "discs overlap": (lambda mesh: el.SheetDiscs([[0, 0], [0.01, 0]], 0.03, 0.01).check(mesh), "overlap by"),
    "point outside": (lambda mesh: el.PointElectrodes([[0.2, 0], [0, 0]]).check(mesh), "outside the mesh"),
    "ring of one": (lambda mesh: ly.ring(0.1, 1), "2"),
    "faces on a plane mesh": (lambda mesh: el.FaceDiscs([[0, 0, 0]], 0.01, 0.01).check(mesh), "3-D mesh"),
    "number against protocol": (lambda mesh: ForwardModel(mesh, arcs(), pr.adjacent(16)), "8 electrodes"),
    "positions as electrodes": (
        lambda mesh: ForwardModel(mesh, ly.ring(0.1, 8), pr.adjacent(8)),  # pyright: ignore[reportArgumentType]
        "become electrodes",
    ),
    "protocol by name": (lambda mesh: ForwardModel(mesh, arcs(), "adjacent"), "jeit.protocol"),  # pyright: ignore[reportArgumentType]
}

PATTERNS = {
    "three electrodes": (lambda: pr.adjacent(3), "at least 4"),
    "half an electrode": (lambda: pr.adjacent(8.5), "integer"),  # pyright: ignore[reportArgumentType]
    "five amperes": (lambda: pr.adjacent(8, current=5.0), "if you meant 5 mA"),
    "no current": (lambda: pr.adjacent(8, current=0.0), "positive"),
    "opposite of odd": (lambda: pr.opposite(7), "no opposite pairs"),
    "skip too many": (lambda: pr.skip(8, 9), "skip"),
    "common electrode missing": (lambda: pr.all_against_one(8, common=8), "0 to 7"),
    "pair with itself": (lambda: pr.two_terminal(8, [[1, 1]]), "with itself"),
    "current is lost": (lambda: pr.from_matrices([[1e-3, 0]], [[1, -1]]), "sums to"),
    "pattern of zeros": (lambda: pr.from_matrices([[0, 0]], [[1, -1]]), "all zero"),
    "patterns of other sizes": (lambda: pr.from_matrices([[1e-3, -1e-3]], [[1, -1, 0]]), "electrodes"),
    "NaN in a pattern": (lambda: pr.from_matrices([[np.nan, 0]], [[1, -1]]), "NaN"),
    "nothing left to measure": (lambda: pr.adjacent(8).subset(np.zeros(40, bool)), "no channel is left"),
}

COMPUTING = {
    "negative conductivity": (lambda m: m.voltages(-1.0), "must be positive"),
    "conductivity of another mesh": (lambda m: m.voltages(np.ones(7)), "one value per cell"),
    "conductivity NaN": (lambda m: m.voltages(np.nan), "NaN"),
    "unknown solver": (lambda m: ForwardModel(m.mesh, m.electrodes, m.protocol, solver="magic"), "magic"),
    "reference of another length": (lambda m: calibrate(m, np.ones(3)), "shape"),
    "reference of zeros": (lambda m: calibrate(m, np.zeros(40)), "no finite, non-zero"),
    "unknown contact": (lambda m: calibrate(m, np.ones(40), contact="good"), "one of common, each, fixed"),
    "mask of nothing": (lambda m: one_step(m, 1.0, mask=np.zeros(40, bool)), "at least one True"),
    "unknown rule": (lambda m: one_step(m, 1.0, hyperparameter="luck"), "or a number; it is 'luck'"),
    "rule without data": (lambda m: one_step(m, 1.0, hyperparameter="gcv"), "give difference"),
    "negative hyperparameter": (lambda m: one_step(m, 1.0, hyperparameter=-1.0), "must be positive"),
    "noise of zero": (lambda m: one_step(m, 1.0, noise=0.0), "noise must be positive"),
    "prior of zero length": (lambda m: Gaussian(0.0), "length must be positive"),
    "back-projection of waves": (
        lambda m: back_projection(m.with_protocol(pr.trigonometric(8, measurement="mean")), 1.0),
        "two electrodes each",
    ),
    "image of another mesh": (lambda m: find_inclusions(m.mesh, np.ones(3)), "one value for each"),
    "image of NaN": (lambda m: find_inclusions(m.mesh, np.full(m.mesh.num_cells, np.nan)), "NaN"),
    "picture of another mesh": (lambda m: plot_image(m.mesh, np.ones(3)), "one for each of the"),
    "picture of NaN": (lambda m: plot_image(m.mesh, np.full(m.mesh.num_cells, np.nan)), "finite"),
    "raster of nothing": (lambda m: plot_raster(np.full((3, 3), np.nan), (0, 1, 0, 1)), "at least one finite"),
    "voltages of two lengths": (lambda m: plot_voltages(np.ones(3), np.ones(4)), "one frame"),
    "image of complex values": (lambda m: find_inclusions(m.mesh, 1j * np.ones(m.mesh.num_cells)), "complex"),
    "level of two": (lambda m: find_inclusions(m.mesh, np.ones(m.mesh.num_cells), level=2.0), "between 0 and 1"),
    "prior by name": (lambda m: one_step(m, 1.0, prior="noser"), r"jeit.inverse: Noser\(\), .* it is 'noser'"),  # pyright: ignore[reportArgumentType]
    "frame with NaN": (lambda m: back_projection(m, 1.0).image(np.full(40, np.nan)), "zeros in masked channels"),
    "reference turned round": (lambda m: calibrate(m, -m.voltages(1.0)), "opposite sign"),
    "prior of a number": (lambda m: ImagingSettings(prior=3), "tikhonov, laplace"),  # pyright: ignore[reportArgumentType]
    "hyperparameter of truth": (lambda m: ImagingSettings(hyperparameter=True), "positive number"),
    "press beyond the edge": (lambda m: simulate_press(RoundSkin(), None, (20.0, 0.0)), "beyond the skin"),  # pyright: ignore[reportArgumentType]
    "press of zero size": (lambda m: simulate_press(RoundSkin(), None, (0, 0), radius=0), "positive size"),  # pyright: ignore[reportArgumentType]
    "unknown method": (lambda m: ImagingSettings(method="two-step"), "one-step, back-projection"),
    "nearly a format": (lambda m: read(__file__, "kit"), "format must be one of .* \\(did you mean 'kit4'"),
    "nearly a choice": (lambda m: pr.opposite(8, drives="distnct"), "got 'distnct' \\(did you mean 'distinct'"),
    "nearly a method": (lambda m: ImagingSettings(method="gaus-newton"), "did you mean 'gauss-newton'"),
    "nearly a prior": (lambda m: ImagingSettings(prior="laplas"), "did you mean 'laplace'"),
    "nearly a rule": (lambda m: ImagingSettings(hyperparameter="gvc"), "did you mean 'gcv'"),
    "nearly a contact": (lambda m: ImagingSettings(contact="comon"), "did you mean 'common'"),
    "several hyperparameters": (lambda m: ImagingSettings(hyperparameter=[1.0]), "it is a list"),  # pyright: ignore[reportArgumentType]
    "nodes in words": (lambda m: ImagingSettings(num_points="many"), "100,000 nodes .* it is 'many'"),  # pyright: ignore[reportArgumentType]
    "a path for a measurement": (
        lambda m: image_difference("a.mat"),
        r"measurement must be .*read\(path\); it is 'a.mat'",
    ),  # pyright: ignore[reportArgumentType]
    "settings of a stream": (
        lambda m: image_difference(m, m, StreamSettings()),
        "settings must be ImagingSettings, such",
    ),  # pyright: ignore[reportArgumentType]
    "a method for settings": (lambda m: compare_on_data(m, m, "one-step"), "must be ImagingSettings.* 'one-step'"),  # pyright: ignore[reportArgumentType]
    "a path for a reference": (lambda m: prepare_imager("a.csv"), "^reference must be a Measurement.* 'a.csv'"),  # pyright: ignore[reportArgumentType]
    "settings of an image": (lambda m: prepare_imager(m, ImagingSettings()), "StreamSettings.* is an ImagingSettings"),  # pyright: ignore[reportArgumentType]
    "memory in words": (lambda m: StreamSettings(memory="long"), "number of frames.* it is 'long'"),  # pyright: ignore[reportArgumentType]
    "result of prepare_imager": (lambda m: stream((m, m), []), r"imager must be an Imager, .*\[0\]; it is a tuple"),  # pyright: ignore[reportArgumentType]
    "a model by name": (lambda m: one_step("tank", 1.0), "model must be a ForwardModel.* it is 'tank'"),  # pyright: ignore[reportArgumentType]
    "a mesh to calibrate": (lambda m: calibrate(m.mesh, np.ones(40)), "model must be a ForwardModel.* it is a Mesh"),  # pyright: ignore[reportArgumentType]
    "prior as a class": (lambda m: one_step(m, 1.0, prior=Noser), "prior must be .* it is the class Noser itself"),  # pyright: ignore[reportArgumentType]
    "prior of reconstruct": (
        lambda m: reconstruct(m, np.ones(40), 1.0, prior="gaussian"),  # pyright: ignore[reportArgumentType]
        r"Gaussian\(length in metres\), .* it is 'gaussian'",
    ),
    "posterior of a model": (lambda m: posterior(m), "reconstruction must be .* it is a ForwardModel"),  # pyright: ignore[reportArgumentType]
    "mesh of three nodes": (lambda m: ImagingSettings(num_points=3), "50 to 100,000"),
}


def refused(call, lesson):
    with pytest.raises(ValueError, match=lesson) as caught:
        call()
    message = str(caught.value)
    assert len(message) > 25
    assert message.endswith((".", ")", "?", "'")), message


@pytest.mark.parametrize("name", GEOMETRY)
def test_geometry(name):
    refused(*GEOMETRY[name])


@pytest.mark.parametrize("name", ELECTRODES)
def test_electrodes(name, mesh):
    call, lesson = ELECTRODES[name]
    refused(lambda: call(mesh), lesson)


@pytest.mark.parametrize("name", PATTERNS)
def test_patterns(name):
    refused(*PATTERNS[name])


@pytest.mark.parametrize("name", COMPUTING)
def test_computing(name, model):
    call, lesson = COMPUTING[name]
    refused(lambda: call(model), lesson)


def test_messages_of_one_table_differ():
    """Each fault has its own message, because one message for two faults does not help the user."""
    messages = []
    for call, _ in (*GEOMETRY.values(), *PATTERNS.values()):
        with pytest.raises(ValueError, match=" ") as caught:
            call()
        messages.append(str(caught.value))
    assert len(set(messages)) == len(messages)


# On the command line: DATA, REFERENCE and options of a valid tank with one fault.


def good(tank, *options):
    return ["reconstruct", tank.folder / "touched.csv", "--reference", tank.folder / "rest.csv", *options]


def faulty(tank, old, new):
    """The arguments for the valid tank, with one replacement in the description of both files."""
    assert old in tank.description
    description = tank.description.replace(old, new)
    tank.write("rest", tank.rest, description)
    tank.write("touched", tank.touched, description)
    return good(tank)


def with_data(tank, values, **options):
    return ["reconstruct", tank.write("other", values, **options), "--reference", tank.folder / "rest.csv"]


def raw(tank, name, content):
    (tank.folder / name).write_bytes(content)
    return ["reconstruct", tank.folder / name, "--reference", tank.folder / "rest.csv"]


def matlab(tank, **content):
    scipy.io.savemat(tank.folder / "a.mat", content)
    return ["reconstruct", tank.folder / "a.mat", "--reference", tank.folder / "rest.csv"]


COMMANDS = {
    "no such data": (lambda t: ["reconstruct", "absent.mat"], "jeit: DATA: there is no file absent.mat"),
    "no such reference": (
        lambda t: [*good(t)[:2], "--reference", "absent.csv"],
        "jeit: --reference: there is no file absent.csv. Check",
    ),
    "data is a folder": (lambda t: ["reconstruct", t.folder], "is a folder"),
    "empty file": (lambda t: raw(t, "a.csv", b""), "is empty"),
    "a spreadsheet": (lambda t: raw(t, "a.xlsx", b"PK\x03\x04"), "no known format"),
    "not text": (lambda t: faulty(t, "V", "V") and raw(t, "rest.csv", b"\xff\xfe\x00"), "not a text file"),
    "damaged mat": (lambda t: raw(t, "a.mat", b"MATLAB 5.0" + b"\0" * 200), "not a readable .mat"),
    "mat of another kind": (lambda t: matlab(t, x=1.0), "there are x (1 × 1). Name the array"),
    "unknown format": (lambda t: good(t, "--format", "xls"), "it is 'xls'"),
    "another format": (lambda t: good(t, "--format", "kit4"), "not a readable .mat"),
    "no such description": (lambda t: good(t, "--description", "absent.toml"), "--description absent.toml: there is"),
    "unknown rule to choose": (
        lambda t: ["choose", *good(t)[1:], "--rule", "luck", "--output", t.folder / "out"],
        "--rule must be one of gcv, l-curve",
    ),
    "no description": (lambda t: with_data(t, t.touched, description=None)[:2], "nothing says what they mean"),
    "description is not TOML": (lambda t: faulty(t, "[geometry]", "[geometry"), "is no TOML file"),
    "unknown key": (lambda t: faulty(t, "radius", "diameter"), "geometry.diameter is no key of a disk"),
    "negative radius": (lambda t: faulty(t, "radius = 0.1", "radius = -0.1"), "geometry.radius is -0.1, and must be"),
    "no geometry": (
        lambda t: faulty(
            t, t.description.split("[protocol]")[0], f"[electrodes]\nkind = 'point'\npositions = {POINTS}\n"
        ),
        "[geometry] (a TOML file beside the data, or --description)",
    ),
    "five amperes": (lambda t: faulty(t, "current = 1e-3", "current = 5"), "if you meant 5 mA"),
    "unknown protocol": (lambda t: faulty(t, '"adjacent"', '"nextdoor"'), "adjacent, skip, opposite"),
    "another protocol": (lambda t: faulty(t, '"adjacent"', '"opposite"'), "channels"),
    "electrodes overlap": (lambda t: faulty(t, "width = 0.005", "width = 0.09"), "overlap"),
    "electrodes off the edge": (
        lambda t: faulty(t, 'layout = "ring"\nnumber = 8\nclockwise = true', "positions = " + POINTS),
        "from the boundary",
    ),
    "unknown unit": (lambda t: faulty(t, 'unit = "V"', 'unit = "dB"'), "unit must be one of V"),
    "words between numbers": (lambda t: with_data(t, "1,2\na,b\n1,2"), "line 2"),
    "ragged rows": (lambda t: with_data(t, "1,2,3\n1,2\n1,2,3"), "row 2 has length 2"),
    "too few channels": (lambda t: with_data(t, t.touched[:-1]), "40 channels"),
    "all zero": (lambda t: with_data(t, 0 * t.touched), "every usable voltage is zero"),
    "all missing": (lambda t: with_data(t, np.nan * t.touched), "zero, NaN or missing"),
    "too few left": (lambda t: with_data(t, np.where(np.arange(40) < 5, t.touched, np.nan)), "5 channels usable"),
    "same file twice": (lambda t: [*good(t)[:2], "--reference", t.folder / "touched.csv"], "same file"),
    "no reference": (lambda t: good(t)[:2], "no reference frame of its own"),
    "millivolts against volts": (lambda t: with_data(t, 1e3 * t.touched), "different units"),
    "another current": (
        lambda t: with_data(t, t.touched, description=t.description.replace("1e-3", "2e-3")),
        "2 times the current",
    ),
    "another body": (lambda t: with_data(t, "1," * 207 + "2", description=SIXTEEN), "16 electrodes and the reference"),
    "nothing but noise": (lambda t: with_data(t, np.random.default_rng(0).normal(size=40)), "too noisy"),
    "complex": (
        lambda t: [
            *with_both(t, 'unit = "V"', 'complex_pairs = true\ncomponent = "complex"'),
            "--method",
            "gauss-newton",
        ],
        "take one-step",
    ),
    "unknown prior": (
        lambda t: good(t, "--prior", "flat"),
        "laplace, noser, gaussian, matern; it is 'flat'",
    ),
    "unknown method": (lambda t: good(t, "--method", "guess"), "one-step, back-projection"),
    "unknown rule": (lambda t: good(t, "--hyperparameter", "luck"), "gcv, l-curve"),
    "negative hyperparameter": (lambda t: good(t, "--hyperparameter", "-1"), "positive number or a rule"),
    "hyperparameter NaN": (lambda t: good(t, "--hyperparameter", "nan"), "positive number or a rule"),
    "rule for back-projection": (
        lambda t: good(t, "--method", "filtered-back-projection", "--hyperparameter", "gcv"),
        "takes a number",
    ),
    "prior for back-projection": (
        lambda t: good(t, "--method", "back-projection", "--prior", "noser"),
        "does not go with",
    ),
    "hyperparameter for back-projection": (
        lambda t: good(t, "--method", "back-projection", "--hyperparameter", "5"),
        "back-projection has none",
    ),
    "hyperparameter without end": (lambda t: good(t, "--hyperparameter", "1e300"), "the image is empty"),
    "unknown contact": (
        lambda t: good(t, "--contact", "firm"),
        "each, common, fixed; it is 'firm'",
    ),
    "mesh of three nodes": (lambda t: good(t, "--num-points", "3"), "--num-points: give 50 to 100,000"),
    "mesh of a word": (lambda t: good(t, "--num-points", "many"), "Invalid value for '--num-points'"),
    "no such frame": (lambda t: good(t, "--frame", "7"), "no frame 7"),
    "no such named frame": (lambda t: good(t, "--frame", "press"), "no frame named 'press'"),
    "unknown option": (lambda t: good(t, "--colour", "red"), "--colour"),
    "no data named": (lambda t: ["reconstruct"], "Missing argument"),
    "unknown command": (lambda t: ["image"], "No such command 'image'"),
    "press beyond the edge": (lambda t: ["demo", "--x", "20"], "--x and --y: a press at (20"),
    "no such layout": (
        lambda t: ["layout", "compare", "park", "park-inner", "--output", t.folder],
        "layout: there is no",
    ),
    "not a layout file": (
        lambda t: ["layout", "optimise", "a.csv", "--output", t.folder],
        "layout: there is no file",
    ),
    "layouts of two skins": (
        lambda t: ["layout", "compare", "park-inner", "grid-3x3", "--width-mm", "90", "--output", t.folder],
        "does not say its skin is read with --width-mm and --height-mm",
    ),
    "no file of a study": (lambda t: ["study", "status", "a.toml"], "study: there is no file"),
    "seed too large": (lambda t: ["demo", "--seed", str(10**23)], "--seed must be at least 0 and less than 2³²"),
    "noise below zero": (lambda t: ["demo", "--noise", "-1"], "zero or positive"),
    "info on nothing": (lambda t: ["info", "absent.csv"], "jeit: DATA: there is no file"),
    "info on a folder": (lambda t: ["info", t.folder], "is a folder"),
}
POINTS = "[" + ", ".join(f"[{x}, {y}]" for x, y in ly.ring(0.05, 8).tolist()) + "]"
SIXTEEN = """
[geometry]
shape = "disk"
radius = 0.1
[electrodes]
layout = "ring"
number = 16
width = 0.005
contact_impedance = 0.01
[protocol]
kind = "adjacent"
current = 1e-3
"""


def with_both(tank, old, new):
    description = tank.description.replace(old, new)
    for name, values in (("rest", tank.rest), ("touched", tank.touched)):
        tank.write(name, np.stack([values, 0.1 * values]), description)
    return good(tank)


@pytest.mark.parametrize("name", COMMANDS)
def test_command_line(name, tank, run):
    arguments, lesson = COMMANDS[name]
    arguments = list(arguments(tank))
    if arguments[0] in ("reconstruct", "demo"):
        arguments += ["--output", tank.folder / "out"]
    if arguments[0] == "reconstruct" and "--num-points" not in arguments:
        arguments += ["--num-points", 250]
    status, _, error = run(*arguments)
    assert status in (1, 2)
    assert lesson in error
    assert error.startswith("jeit: ")
    assert error.count("\n") == 1
    assert "Traceback" not in error
    assert "should not have happened" not in error


def test_output_that_is_an_existing_file(tank, run):
    status, _, error = run(*good(tank, "--output", tank.folder / "rest.csv"))
    assert status == 1
    assert "is a file; give a folder" in error


def test_output_that_cannot_be_written(tank, run, tmp_path):
    status, _, error = run(*good(tank, "--output", tank.folder / "rest.csv" / "deeper"))
    assert status == 1
    assert "cannot be written" in error
    (tmp_path / "image.png").mkdir()
    status, _, error = run(*good(tank, "--output", tmp_path))
    assert status == 1
    assert "folder named image.png" in error


def test_no_output(tank, run):
    status, _, error = run(*good(tank))
    assert status == 2
    assert "--output" in error


def test_python_error_for_a_frame_that_is_too_noisy(tank):
    noise = tank.write("noise", np.random.default_rng(1).normal(size=40))
    with pytest.raises(ValueError, match="too noisy"):
        image_difference(read(noise), read(tank.folder / "rest.csv"), ImagingSettings(num_points=250))


def test_module_prints_one_line_and_returns_a_status(tmp_path, monkeypatch, capsys):
    """Call what `python -m jeit` runs; the slow tests run it in a process of its own."""
    monkeypatch.setattr("sys.argv", ["jeit", "reconstruct", "absent.mat", "--output", str(tmp_path / "out")])
    monkeypatch.delitem(sys.modules, "jeit.__main__", raising=False)  # another test may have imported it
    with pytest.raises(SystemExit) as left:
        runpy.run_module("jeit", run_name="__main__")
    assert left.value.code == 1
    expected = "jeit: DATA: there is no file absent.mat. Check the name and the working directory.\n"
    assert capsys.readouterr().err == expected


@pytest.mark.slow
def test_process_prints_one_line_and_returns_a_status(tmp_path):
    command = [sys.executable, "-m", "jeit", "reconstruct", "absent.mat", "--output", "out"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=os.environ, check=False)
    assert done.returncode == 1
    assert done.stderr == "jeit: DATA: there is no file absent.mat. Check the name and the working directory.\n"
