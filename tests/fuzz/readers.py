"""Every kind of file that jeit reads: a small valid file, and the function that reads it."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import jax
import meshio
import numpy as np
import scipy.io
import scipy.io.wavfile

sys.path += [
    str(Path(__file__).parents[1] / room) for room in ("", "acoustic", "data", "touch/gestures", "touch/listening")
]

from instrument_files import write_carefusion, write_draeger, write_get, write_sciospec, write_swisstom
from made_clips import MATERIALS, struck
from made_skins import record
from made_touches import touches
from microphone_arrays import array
from small_networks import SKIN
from studies import SMALL
from test_calibration_file import calibration, curved
from thread_limits import libraries_found_once

from jeit import data
from jeit.acoustic import Calibration, IntensitySettings, Taps, read_recording, read_taps
from jeit.acoustic.signal.recording import write_taps
from jeit.data import GestureSet, load_description, write_table
from jeit.data.gesture_set import read_frame_recording
from jeit.design import Skin
from jeit.design.skin.skin_file import read_described_skin
from jeit.design.study import read_study, run_study, study_progress
from jeit.electrodes import FaceDiscs
from jeit.image import Inclusion
from jeit.layout import named_layout, read_layout, write_layout
from jeit.mesh import Disk, Rectangle, box, tube
from jeit.mesh import read as read_mesh
from jeit.mesh import write as write_mesh
from jeit.report import read_image
from jeit.report.saved_image import saved_extras
from jeit.touch import LearntSkin, PlacedMap, Presses, SelfOrganisingMap, read_presses, read_skin, write_skin
from jeit.touch.gestures import GestureModel
from jeit.touch.kohonen import read_map, write_map
from jeit.touch.learnt.recorded_presses import read_frames
from jeit.touch.listening import LabelledClips, Listener
from jeit.touch.networks import ImageNetwork, read_network, write_network
from jeit.touch.networks.image_network import describe_skin
from jeit.touch.networks.unrolled_network import Unrolled


@dataclass(frozen=True)
class Reader:
    """How one kind of file is written and read; `main` is its file in the folder that `make` fills."""

    name: str
    main: str
    make: Callable[[Path], None]
    use: Callable[[Path], object]

    @property
    def files(self) -> dict[str, bytes]:
        """A valid file of the kind and the files beside it, by their names in a folder."""
        return _files(self.name)


READERS: dict[str, Reader] = {}
_ARM = tube(0.02, 0.05, num_points=60)


@cache
def _files(name: str) -> dict[str, bytes]:
    import tempfile

    with tempfile.TemporaryDirectory() as folder, libraries_found_once():
        READERS[name].make(Path(folder))
        found = sorted(one for one in Path(folder).rglob("*") if one.is_file())
        return {str(one.relative_to(folder)): one.read_bytes() for one in found}


def _reader(name: str, main: str, use: Callable[[Path], object]):
    def register(make: Callable[[Path], None]) -> Callable[[Path], None]:
        READERS[name] = Reader(name, main, make, lambda folder: use(folder / main))
        return make

    return register


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


@_reader("description", "a.toml", _described)
def _description(folder):
    (folder / "a.toml").write_text(BODY)


@_reader("description of a solid", "a.toml", _described)
def _solid(folder):
    (folder / "a.toml").write_text(SOLID)


def _table(folder):
    frame = ",".join(str(k + 1.0) for k in range(40))
    (folder / "a.csv").write_text(f"# measured\n{frame}\n{frame}\n")
    (folder / "a.toml").write_text(BODY)


_reader("table, csv", "a.csv", data.read)(_table)


@_reader("table, npy", "a.npy", data.read)
def _npy(folder):
    np.save(folder / "a.npy", np.random.default_rng(0).random((2, 40)))
    (folder / "a.toml").write_text(BODY)


@_reader("table, npz", "a.npz", data.read)
def _npz(folder):
    _table(folder)
    measured = data.read(folder / "a.csv")
    write_table(measured, folder / "a.npz")
    (folder / "a.csv").unlink()


@_reader("kit4", "a.mat", data.read)
def _kit4(folder):
    rng = np.random.default_rng(0)
    current = np.eye(16)[:, :5] - np.eye(16)[:, 1:6]
    measured = np.eye(16) - np.roll(np.eye(16), 1, axis=0)
    uel = rng.random((16, 5))
    scipy.io.savemat(
        folder / "a.mat", {"Uel": uel, "CurrentPattern": current, "MeasPattern": measured}, do_compression=True
    )


@_reader("ktc2023", "a.mat", data.read)
def _ktc(folder):
    current = np.eye(8)[:, :5] - np.eye(8)[:, 1:6]
    measured = (np.eye(8) - np.roll(np.eye(8), 1, axis=0))[:, :7]
    uel = np.random.default_rng(0).random(35)
    held = {"Inj": current, "Uel": uel, "Mpat": measured, "Extra": {"a": [1, "b"]}}
    scipy.io.savemat(folder / "a.mat", held, do_compression=True)


@_reader("eidors", "a.mat", data.read)
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


@_reader("measured patterns", "a.mat", data.read)
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

    _reader(name, f"a{suffix}", data.read)(made)


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


@_reader("image", "a.npz", read_image)
def _image(folder):
    tank = box(0.1, 0.08, 0.06, num_points=30)
    found = (Inclusion(1, (0.0, 0.0, 0.03), 1e-6, 1e-3),)
    extras = saved_extras(tank, FaceDiscs([[0.05, 0.0, 0.03], [-0.05, 0.0, 0.03]], 0.01, 1e-3), found)
    values = np.linspace(-1, 1, tank.num_cells)
    np.savez(folder / "a.npz", conductivity=values, background=0.3, points=tank.points, cells=tank.cells, **extras)


@_reader("frames", "a.npz", read_frame_recording)
def _frames(folder):
    rng = np.random.default_rng(0)
    np.savez(folder / "a.npz", frames=rng.random((6, 40)), reference=rng.random(40), seconds=np.arange(6.0))


@_reader("gestures", "a.npz", GestureSet.read)
def _gestures(folder):
    rng = np.random.default_rng(0)
    start, names, person = np.array([0, 4, 9]), np.array(["tap", "push"]), np.array([0, 1])
    made = GestureSet(names, person, start, np.arange(9.0), rng.random((9, 12)), rng.random(12), rng.random((3, 12)))
    made.write(folder / "a.npz")


def _layout(suffix):
    def make(folder):
        write_layout(named_layout("grid-4x2", Rectangle(0.1, 0.08), diameter=6e-3), folder / f"a{suffix}")

    return make


for _suffix in (".csv", ".svg", ".dxf"):
    _reader(f"layout, {_suffix[1:]}", f"a{_suffix}", read_layout)(_layout(_suffix))


@_reader("study", "a.toml", read_study)
def _study(folder):
    (folder / "a.toml").write_text(SMALL)


@_reader("skin", "a.toml", read_described_skin)
def _skin(folder):
    (folder / "a.toml").write_text(SKIN)


CURVED = """[skin]
thickness_mm = 5
[surface]
kind = "forearm"
length_mm = 80
wrist_mm = [20, 15]
elbow_mm = 30
outward = true
[electrodes]
layout = "inner-8"
diameter_mm = 6
[mesh]
cell_mm = 12
"""
SCANNED = """[surface]
file = "arm.obj"
unit = "mm"
outward = false
[electrodes]
layout = "inner-6"
diameter_mm = 6
"""


BENT = """[surface]
kind = "bent sheet"
width_mm = 100
height_mm = 80
radius_mm = 60
axis = "x"
"""


@_reader("skin, curved", "a.toml", read_described_skin)
def _curved_skin(folder):
    (folder / "a.toml").write_text(CURVED)


@_reader("skin, scanned", "a.toml", read_described_skin)
def _scanned_skin(folder):
    (folder / "a.toml").write_text(SCANNED)
    points, cells = (np.asarray(one) for one in (_ARM.points, _ARM.cells))
    corners = [f"v {x:.6g} {y:.6g} {z:.6g}" for x, y, z in 1e3 * points]
    (folder / "arm.obj").write_text("\n".join([*corners, *(f"f {a} {b} {c}" for a, b, c in 1 + cells)]))


@_reader("study, curved", "a.toml", read_study)
def _curved_study(folder):
    (folder / "a.toml").write_text(
        SMALL.replace("width_mm = 100\nheight_mm = 80\n", "").replace('grid-4x2", "perimeter-8', "inner-8") + BENT
    )


@_reader("store of a study", "a.zarr", lambda path: study_progress(read_study(path.parent / "a.toml"), path))
def _store(folder):
    # One point, because each of its files is changed in turn.
    (folder / "a.toml").write_text(SMALL.replace(', "perimeter-8"', ""))
    run_study(read_study(folder / "a.toml"), folder / "a.zarr")


@_reader("sound, wav", "a.wav", read_recording)
def _wav(folder):
    scipy.io.wavfile.write(folder / "a.wav", 8000, np.random.default_rng(0).random((400, 2)).astype("f4"))


@_reader("sound, flac", "a.flac", read_recording)
def _flac(folder):
    import soundfile

    soundfile.write(folder / "a.flac", 0.1 * np.random.default_rng(0).normal(size=(2000, 2)), 8000)


@_reader("sound, npz", "a.npz", read_recording)
def _recording(folder):
    np.savez(folder / "a.npz", samples=np.random.default_rng(0).random((2, 400)), rate=8000.0, full_scale=1.0)


@_reader("taps", "a.npz", read_taps)
def _taps(folder):
    rng = np.random.default_rng(0)
    square = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1]])
    write_taps(folder / "a.npz", Taps(square, square, 0.1 * rng.random((9, 2)), power=rng.random((9, 4))))


@_reader("calibration", "a.json", Calibration.load)
def _calibration(folder):
    calibration(array(9, floor=1e-9, freedom=7.0), IntensitySettings(high=900.0)).save(folder / "a.json")


@_reader("calibration, curved", "a.json", Calibration.load)
def _curved(folder):
    calibration(curved()).save(folder / "a.json")


@_reader("presses", "a.npz", lambda path: (read_presses(path), read_frames(path)))
def _presses(folder):
    np.savez(folder / "a.npz", **record(20))


@cache
def _recorded():
    return record(60)


@_reader("learnt skin", "a.skops", lambda path: read_skin(path).predict(**_asked()))
def _learnt(folder):
    write_skin(LearntSkin.fit(Presses.create(**_recorded()), method="neighbours"), folder / "a.skops")


def _asked():
    return {"frames": _recorded()["frames"][:3], "reference": _recorded()["reference"][0]}


@_reader("map", "a.npz", read_map)
def _map(folder):
    frames, places = _recorded()["frames"], _recorded()["positions"]
    learnt = SelfOrganisingMap(frames[:16].reshape(4, 4, -1), 1.0)
    write_map(PlacedMap.learn(learnt, frames, places), folder / "a.npz")


@_reader("gesture model", "a.skops", GestureModel.read)
def _gesture_model(folder):
    made, labels, people = touches(people=3, each=4)
    GestureModel.fit(made, labels, people=people, method="nearest", form="seven").write(folder / "a.skops")


@_reader("listener", "a.jeit", Listener.read)
def _listener(folder):
    random = np.random.default_rng(0)
    labels = [name for name in MATERIALS for _ in range(5)]
    clips = LabelledClips.from_recordings([struck(random, name) for name in labels], labels)
    Listener.fit(clips, method="linear").write(folder / "a.jeit")


@_reader("network", "a.jeit", read_network)
def _network(folder):
    layout = named_layout("grid-4x4", Rectangle(0.1, 0.1))
    skin = Skin.create(layout, num_layers=0, cell_size=9e-3)
    extent = tuple(map(float, skin.outline.extent))
    made_for = describe_skin(skin.model.protocol, layout.centres, extent)
    shapes = jax.eval_shape(lambda: Unrolled(made_for["channels"], (12, 12), 2, key=jax.random.key(0)))
    network = jax.tree.map(lambda one: np.ones(one.shape, one.dtype), shapes)
    write_network(ImageNetwork(network, "unrolled", 5e-3, (12, 12), extent, 1e-4, made_for), folder / "a.jeit")


def _mesh():
    return Disk(0.1).mesh(num_points=60)


@_reader("mesh, msh", "a.msh", read_mesh)
def _msh(folder):
    write_mesh(_mesh(), folder / "a.msh")


def _tetrahedron() -> tuple[np.ndarray, np.ndarray]:
    return np.eye(4)[:, :3] * 0.1, np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]])


@_reader("mesh, stl", "a.stl", read_mesh)
def _stl(folder: Path) -> None:
    points, cells = _tetrahedron()
    records = [bytes(12) + one.astype("<f4").tobytes() + bytes(2) for one in points[cells]]
    (folder / "a.stl").write_bytes(bytes(80) + len(records).to_bytes(4, "little") + b"".join(records))


@_reader("mesh, stl text", "a.stl", read_mesh)
def _stl_text(folder: Path) -> None:
    points, cells = _tetrahedron()
    lines = [f"vertex {x} {y} {z}" for x, y, z in points[cells].reshape(-1, 3)]
    (folder / "a.stl").write_text("\n".join(["solid a", *lines, "endsolid a"]))


@_reader("mesh, obj", "a.obj", read_mesh)
def _obj(folder: Path) -> None:
    points, cells = _tetrahedron()
    lines = [f"v {x} {y} {z}" for x, y, z in points] + [f"f {a}//1 {b}//1 {c}//1" for a, b, c in cells + 1]
    (folder / "a.obj").write_text("\n".join(lines))


@_reader("mesh, vtu", "a.vtu", read_mesh)
def _vtu(folder):
    mesh = _mesh()
    meshio.Mesh(np.asarray(mesh.points), [("triangle", np.asarray(mesh.cells))]).write(folder / "a.vtu")


@_reader("mesh, vtk", "a.vtk", read_mesh)
def _vtk(folder):
    mesh = _mesh()
    points = np.column_stack([np.asarray(mesh.points), np.zeros(len(mesh.points))])
    meshio.Mesh(points, [("triangle", np.asarray(mesh.cells))]).write(folder / "a.vtk")
