"""Every kind of file that jeit reads: a small valid file, and the function that reads it. Those of the applications are
in `application_readers.py`."""

import sys
from pathlib import Path

import meshio
import numpy as np
import scipy.io
import scipy.io.wavfile

sys.path += [
    str(Path(__file__).parents[1] / room) for room in ("", "acoustic", "data", "touch/gestures", "touch/listening")
]

import application_readers  # noqa: F401, it registers them
from instrument_files import write_carefusion, write_draeger, write_get, write_sciospec, write_swisstom
from reader import READERS, Reader, reader  # noqa: F401, tests import them from here

from jeit import data
from jeit.data import load_description, write_table
from jeit.data.gesture_set import read_frame_recording
from jeit.electrodes import FaceDiscs
from jeit.image import Inclusion
from jeit.layout import named_layout, read_layout, write_layout
from jeit.mesh import Disk, Rectangle, box
from jeit.mesh import read as read_mesh
from jeit.mesh import write as write_mesh
from jeit.report import read_image
from jeit.report.saved_image import saved_extras

BODY = """title = "a tank"
[geometry]
shape = "disk"
radius = 0.1
centre = [0.0, 0.0]
[electrodes]
kind = "boundary"
layout = "ring"
number = 8
start_angle_degrees = 90
clockwise = true
width = 0.005
contact_impedance = 0.01
[protocol]
kind = "adjacent"
current = 1e-3
[data]
delimiter = ","
unit = "mV"
gain = 2.0
saturation = 900.0
frame_names = ["a", "b"]
[notes]
text = ["of Friday"]
"""
SOLID = """[geometry]
shape = "polygon"
vertices = [[0, 0], [0.2, 0], [0.2, 0.1], [0, 0.1]]
holes = [[[0.05, 0.04], [0.07, 0.04], [0.06, 0.06]]]
thickness = 0.02
[electrodes]
kind = "patch"
positions = [[0.0, 0.05, 0.01], [0.2, 0.05, 0.01], [0.1, 0.0, 0.01], [0.1, 0.1, 0.01]]
width = 0.01
height = 0.01
contact_impedance = [0.01, 0.02, 0.01, 0.02]
[protocol]
kind = "bipolar"
driven_electrodes = true
drive_pairs = [[0, 1], [2, 3]]
measurement_pairs = [[0, 2], [1, 3]]
current_unit = "mA"
current = 1
"""


def _described(path: Path):
    description = load_description(path)
    return description.protocol("x.csv"), description.layout


@reader("description", "a.toml", _described)
def _description(folder):
    (folder / "a.toml").write_text(BODY)


@reader("description of a solid", "a.toml", _described)
def _solid(folder):
    (folder / "a.toml").write_text(SOLID)


def _table(folder):
    frame = ",".join(str(k + 1.0) for k in range(40))
    (folder / "a.csv").write_text(f"# measured\n{frame}\n{frame}\n")
    (folder / "a.toml").write_text(BODY)


reader("table, csv", "a.csv", data.read)(_table)


@reader("table, npy", "a.npy", data.read)
def _npy(folder):
    np.save(folder / "a.npy", np.random.default_rng(0).random((2, 40)))
    (folder / "a.toml").write_text(BODY)


@reader("table, npz", "a.npz", data.read)
def _npz(folder):
    _table(folder)
    measured = data.read(folder / "a.csv")
    write_table(measured, folder / "a.npz")
    (folder / "a.csv").unlink()


@reader("kit4", "a.mat", data.read)
def _kit4(folder):
    rng = np.random.default_rng(0)
    current = np.eye(16)[:, :5] - np.eye(16)[:, 1:6]
    measured = np.eye(16) - np.roll(np.eye(16), 1, axis=0)
    uel = rng.random((16, 5))
    scipy.io.savemat(
        folder / "a.mat", {"Uel": uel, "CurrentPattern": current, "MeasPattern": measured}, do_compression=True
    )


@reader("ktc2023", "a.mat", data.read)
def _ktc(folder):
    current = np.eye(8)[:, :5] - np.eye(8)[:, 1:6]
    measured = (np.eye(8) - np.roll(np.eye(8), 1, axis=0))[:, :7]
    uel = np.random.default_rng(0).random(35)
    held = {"Inj": current, "Uel": uel, "Mpat": measured, "Extra": {"a": [1, "b"]}}
    scipy.io.savemat(folder / "a.mat", held, do_compression=True)


@reader("eidors", "a.mat", data.read)
def _eidors(folder):
    rng = np.random.default_rng(0)
    stim, meas = np.eye(8)[:, :4] - np.eye(8)[:, 1:5], np.eye(8)[:6] - np.eye(8)[1:7]
    held = {
        "stim": stim,
        "meas": meas,
        "meas_stim": np.array([1, 1, 2, 2, 3, 4]),
        "vh": rng.random(6),
        "vi": rng.random(6),
    }
    scipy.io.savemat(folder / "a.mat", held)


@reader("measured patterns", "a.mat", data.read)
def _patterns(folder):
    rng = np.random.default_rng(0)
    current, voltages = 1e-3 * rng.normal(size=(8, 7)), rng.normal(size=(8, 7, 3))
    current -= current.mean(axis=0)
    held = {"current_patterns": current, "frame_voltage": voltages - voltages.mean(axis=0)}
    scipy.io.savemat(folder / "a.mat", held, do_compression=True)
    driven = BODY.replace('kind = "adjacent"\ncurrent = 1e-3', 'kind = "measured"')
    description = driven.replace('frame_names = ["a", "b"]', 'keys = ["frame_voltage"]\nframe_rate = 5.0')
    (folder / "a.toml").write_text(description)


def _instrument(name, suffix, number, make):
    def made(folder):
        make(folder / f"a{suffix}")
        (folder / "a.toml").write_text(BODY.partition("[protocol]")[0].replace("number = 8", f"number = {number}"))

    reader(name, f"a{suffix}", data.read)(made)


_ADJACENT = 1.0 + np.random.default_rng(0).random((2, 208))
_instrument("draeger", ".eit", 16, lambda path: write_draeger(path, _ADJACENT))
_instrument("goettingen", ".get", 16, lambda path: write_get(path, _ADJACENT, text=True))
_instrument("carefusion", ".eit", 16, lambda path: write_carefusion(path, _ADJACENT))
_instrument(
    "swisstom", ".eit", 32, lambda path: write_swisstom(path, np.random.default_rng(0).random((2, 32, 32)), [0, 20_000])
)
_instrument(
    "openeit",
    ".txt",
    8,
    lambda path: path.write_text(2 * ("magnitudes: " + ", ".join(f"{one}.5" for one in range(1, 33)) + "\n")),
)
_instrument(
    "cn0565",
    ".log",
    8,
    lambda path: path.write_text(2 * ("!V " + ",".join(f"{2**32 - 999 * one:X}" for one in range(1, 81)) + "\n")),
)
_instrument(
    "quadrupoles",
    ".csv",
    8,
    lambda path: path.write_text(
        "frame,a,b,m,n,u/mV\n" + "".join(f"{one % 2},1,{3 + one // 2},5,{6 + one % 2},{one}.5\n" for one in range(1, 9))
    ),
)
_instrument("sciospec", ".eit", 8, lambda path: write_sciospec(path, np.array([np.eye(8)] * 2), [(1, 3), (2, 4)]))


@reader("image", "a.npz", read_image)
def _image(folder):
    tank = box(0.1, 0.08, 0.06, num_points=30)
    found = (Inclusion(1, (0.0, 0.0, 0.03), 1e-6, 1e-3),)
    extras = saved_extras(tank, FaceDiscs([[0.05, 0.0, 0.03], [-0.05, 0.0, 0.03]], 0.01, 1e-3), found)
    values = np.linspace(-1, 1, tank.num_cells)
    np.savez(folder / "a.npz", conductivity=values, background=0.3, points=tank.points, cells=tank.cells, **extras)


@reader("frames", "a.npz", read_frame_recording)
def _frames(folder):
    rng = np.random.default_rng(0)
    np.savez(folder / "a.npz", frames=rng.random((6, 40)), reference=rng.random(40), seconds=np.arange(6.0))


def _layout(suffix):
    def make(folder):
        write_layout(named_layout("grid-4x2", Rectangle(0.1, 0.08), diameter=6e-3), folder / f"a{suffix}")

    return make


for _suffix in (".csv", ".svg", ".dxf"):
    reader(f"layout, {_suffix[1:]}", f"a{_suffix}", read_layout)(_layout(_suffix))


def _mesh():
    return Disk(0.1).mesh(num_points=60)


@reader("mesh, msh", "a.msh", read_mesh)
def _msh(folder):
    write_mesh(_mesh(), folder / "a.msh")


def _tetrahedron() -> tuple[np.ndarray, np.ndarray]:
    return np.eye(4)[:, :3] * 0.1, np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]])


@reader("mesh, stl", "a.stl", read_mesh)
def _stl(folder: Path) -> None:
    points, cells = _tetrahedron()
    records = [bytes(12) + one.astype("<f4").tobytes() + bytes(2) for one in points[cells]]
    (folder / "a.stl").write_bytes(bytes(80) + len(records).to_bytes(4, "little") + b"".join(records))


@reader("mesh, stl text", "a.stl", read_mesh)
def _stl_text(folder: Path) -> None:
    points, cells = _tetrahedron()
    lines = [f"vertex {x} {y} {z}" for x, y, z in points[cells].reshape(-1, 3)]
    (folder / "a.stl").write_text("\n".join(["solid a", *lines, "endsolid a"]))


@reader("mesh, obj", "a.obj", read_mesh)
def _obj(folder: Path) -> None:
    points, cells = _tetrahedron()
    lines = [f"v {x} {y} {z}" for x, y, z in points] + [f"f {a}//1 {b}//1 {c}//1" for a, b, c in cells + 1]
    (folder / "a.obj").write_text("\n".join(lines))


@reader("mesh, vtu", "a.vtu", read_mesh)
def _vtu(folder):
    mesh = _mesh()
    meshio.Mesh(np.asarray(mesh.points), [("triangle", np.asarray(mesh.cells))]).write(folder / "a.vtu")


@reader("mesh, vtk", "a.vtk", read_mesh)
def _vtk(folder):
    mesh = _mesh()
    points = np.column_stack([np.asarray(mesh.points), np.zeros(len(mesh.points))])
    meshio.Mesh(points, [("triangle", np.asarray(mesh.cells))]).write(folder / "a.vtk")
