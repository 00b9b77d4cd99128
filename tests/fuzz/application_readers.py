"""Files of the applications: a small valid file of each kind, and the function that reads it."""

import sys
from functools import cache
from pathlib import Path

import jax
import numpy as np
import scipy.io
import scipy.io.wavfile

sys.path += [
    str(Path(__file__).parents[1] / room) for room in ("", "acoustic", "data", "touch/gestures", "touch/listening")
]

from made_clips import MATERIALS, struck
from made_skins import record
from made_touches import touches
from microphone_arrays import array
from reader import reader
from small_networks import SKIN
from studies import SMALL
from test_calibration_file import calibration, curved

from jeit.acoustic import Calibration, IntensitySettings, Taps, read_recording, read_taps
from jeit.acoustic.signal.recording import write_taps
from jeit.data import GestureSet
from jeit.design import Skin
from jeit.design.skin.skin_file import read_described_skin
from jeit.design.study import read_study, run_study, study_progress
from jeit.layout import named_layout
from jeit.mesh import Rectangle, tube
from jeit.touch import LearntSkin, PlacedMap, Presses, SelfOrganisingMap, read_presses, read_skin, write_skin
from jeit.touch.gestures import GestureModel
from jeit.touch.kohonen import read_map, write_map
from jeit.touch.learnt.recorded_presses import read_frames
from jeit.touch.listening import LabelledClips, Listener
from jeit.touch.networks import ImageNetwork, read_network, write_network
from jeit.touch.networks.image_network import describe_skin
from jeit.touch.networks.unrolled_network import Unrolled

_ARM = tube(0.02, 0.05, num_points=60)


@reader("gestures", "a.npz", GestureSet.read)
def _gestures(folder):
    rng = np.random.default_rng(0)
    start, names, person = np.array([0, 4, 9]), np.array(["tap", "push"]), np.array([0, 1])
    made = GestureSet(names, person, start, np.arange(9.0), rng.random((9, 12)), rng.random(12), rng.random((3, 12)))
    made.write(folder / "a.npz")


@reader("study", "a.toml", read_study)
def _study(folder):
    (folder / "a.toml").write_text(SMALL)


@reader("skin", "a.toml", read_described_skin)
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


@reader("skin, curved", "a.toml", read_described_skin)
def _curved_skin(folder):
    (folder / "a.toml").write_text(CURVED)


@reader("skin, scanned", "a.toml", read_described_skin)
def _scanned_skin(folder):
    (folder / "a.toml").write_text(SCANNED)
    points, cells = (np.asarray(one) for one in (_ARM.points, _ARM.cells))
    corners = [f"v {x:.6g} {y:.6g} {z:.6g}" for x, y, z in 1e3 * points]
    (folder / "arm.obj").write_text("\n".join([*corners, *(f"f {a} {b} {c}" for a, b, c in 1 + cells)]))


@reader("study, curved", "a.toml", read_study)
def _curved_study(folder):
    (folder / "a.toml").write_text(
        SMALL.replace("width_mm = 100\nheight_mm = 80\n", "").replace('grid-4x2", "perimeter-8', "inner-8") + BENT
    )


@reader("store of a study", "a.zarr", lambda path: study_progress(read_study(path.parent / "a.toml"), path))
def _store(folder):
    # One point, because each of its files is changed in turn.
    (folder / "a.toml").write_text(SMALL.replace(', "perimeter-8"', ""))
    run_study(read_study(folder / "a.toml"), folder / "a.zarr")


@reader("sound, wav", "a.wav", read_recording)
def _wav(folder):
    scipy.io.wavfile.write(folder / "a.wav", 8000, np.random.default_rng(0).random((400, 2)).astype("f4"))


@reader("sound, flac", "a.flac", read_recording)
def _flac(folder):
    import soundfile

    soundfile.write(folder / "a.flac", 0.1 * np.random.default_rng(0).normal(size=(2000, 2)), 8000)


@reader("sound, npz", "a.npz", read_recording)
def _recording(folder):
    np.savez(folder / "a.npz", samples=np.random.default_rng(0).random((2, 400)), rate=8000.0, full_scale=1.0)


@reader("taps", "a.npz", read_taps)
def _taps(folder):
    rng = np.random.default_rng(0)
    square = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1]])
    write_taps(folder / "a.npz", Taps(square, square, 0.1 * rng.random((9, 2)), power=rng.random((9, 4))))


@reader("calibration", "a.json", Calibration.load)
def _calibration(folder):
    calibration(array(9, floor=1e-9, freedom=7.0), IntensitySettings(high=900.0)).save(folder / "a.json")


@reader("calibration, curved", "a.json", Calibration.load)
def _curved(folder):
    calibration(curved()).save(folder / "a.json")


@reader("presses", "a.npz", lambda path: (read_presses(path), read_frames(path)))
def _presses(folder):
    np.savez(folder / "a.npz", **record(20))


@cache
def _recorded():
    return record(60)


@reader("learnt skin", "a.skops", lambda path: read_skin(path).predict(**_asked()))
def _learnt(folder):
    write_skin(LearntSkin.fit(Presses.create(**_recorded()), method="neighbours"), folder / "a.skops")


def _asked():
    return {"frames": _recorded()["frames"][:3], "reference": _recorded()["reference"][0]}


@reader("map", "a.npz", read_map)
def _map(folder):
    frames, places = _recorded()["frames"], _recorded()["positions"]
    learnt = SelfOrganisingMap(frames[:16].reshape(4, 4, -1), 1.0)
    write_map(PlacedMap.learn(learnt, frames, places), folder / "a.npz")


@reader("gesture model", "a.skops", GestureModel.read)
def _gesture_model(folder):
    made, labels, people = touches(people=3, each=4)
    GestureModel.fit(made, labels, people=people, method="nearest", form="seven").write(folder / "a.skops")


@reader("listener", "a.jeit", Listener.read)
def _listener(folder):
    random = np.random.default_rng(0)
    labels = [name for name in MATERIALS for _ in range(5)]
    clips = LabelledClips.from_recordings([struck(random, name) for name in labels], labels)
    Listener.fit(clips, method="linear").write(folder / "a.jeit")


@reader("network", "a.jeit", read_network)
def _network(folder):
    layout = named_layout("grid-4x4", Rectangle(0.1, 0.1))
    skin = Skin.create(layout, num_layers=0, cell_size=9e-3)
    extent = tuple(map(float, skin.outline.extent))
    made_for = describe_skin(skin.model.protocol, layout.centres, extent)
    shapes = jax.eval_shape(lambda: Unrolled(made_for["channels"], (12, 12), 2, key=jax.random.key(0)))
    network = jax.tree.map(lambda one: np.ones(one.shape, one.dtype), shapes)
    write_network(ImageNetwork(network, "unrolled", 5e-3, (12, 12), extent, 1e-4, made_for), folder / "a.jeit")
