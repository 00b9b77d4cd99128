"""Networks that image a skin: their training, its continuation after interruption, and their files.

Against depth maps of new touches, and bit by bit against uninterrupted training.
"""

import copy
import dataclasses
import os
import pickle
import signal
import subprocess
import sys
from pathlib import Path

import cloudpickle
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_networks import PRESET, SHAPE, bits

from jeit.data import Measurement
from jeit.design import Skin
from jeit.design.skin.names import skin_protocol
from jeit.layout import named_layout
from jeit.mesh import Rectangle
from jeit.protocol import adjacent
from jeit.touch.networks import NetworkPreset, learn_images, read_network, write_network
from jeit.touch.networks.depth_maps import check_measured
from jeit.touch.networks.learn import evaluate_network
from jeit.touch.networks.simulated_touches import TouchExamples
from jeit.touch.simulate import DiscIndenter, Indent, relative_changes
from jeit.touch.training import TrainingPlan


def cloudpickle_copy(one):
    return cloudpickle.loads(cloudpickle.dumps(one))


def voltages(skin, touches, resting):
    rest = np.asarray(skin.model.voltages(skin.model_conductivity))
    return rest * (1 + relative_changes(skin, touches, resting)), rest


@pytest.mark.parametrize("change", [lambda one: pickle.loads(pickle.dumps(one)), cloudpickle_copy, copy.deepcopy])
def test_a_used_network_is_pickled_and_copied(learnt, change):
    """Its compiled programs are left out."""
    network = learnt[1].network
    frames = 0.01 * np.random.default_rng(0).normal(size=(2, network.made_for["channels"]))
    expected = network.share(frames)
    other = change(network)
    np.testing.assert_array_equal(other.share(frames), expected)
    assert other.floor == network.floor
    assert other.doubts(frames, expected) == network.doubts(frames, expected)


def test_training_explains_depth(learnt):
    """A hundred touches in five epochs explain part of the depth. An untrained network explains nothing."""
    _, found = learnt
    assert found.standing.explained > 0.3
    assert found.standing.place["mean"] < 0.02
    losses = found.courses["unrolled"].course.validation
    assert losses[-1] < losses[0]


class Silent(eqx.Module):
    """A network that predicts no touch."""

    def __call__(self, changes):
        return jnp.zeros((len(changes), *SHAPE), changes.dtype)


def test_a_network_that_predicts_no_touch_explains_nothing(small_skin, learnt):
    _, found = learnt
    right = found.standing.right
    examples = TouchExamples(np.zeros((len(right), found.network.made_for["channels"])), right)
    standing = evaluate_network(dataclasses.replace(found.network, network=Silent()), small_skin, examples)
    assert (standing.explained, standing.deepest) == (0, 0)


def test_frames(small_skin, learnt, resting):
    _, found = learnt
    given, rest = voltages(
        small_skin, [[Indent(DiscIndenter(0.02), 5e-3, (0.01, -0.02))], [Indent(DiscIndenter(0.02), 5e-3)]], resting
    )
    depth = found.network.depth(given, rest)
    assert depth.shape == (2, *SHAPE)
    assert np.allclose(found.network.depth(given[1], rest), depth[1], atol=1e-6)
    assert np.allclose(found.network.depth(3 * given, 3 * rest), depth, atol=1e-6)
    assert found.network.depth(np.zeros((0, len(rest))), rest).shape == (0, *SHAPE)
    assert np.abs(found.network.depth(rest, rest)).max() < np.abs(depth).max()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda frame, rest: (frame[:-1], rest), "voltages has shape"),
        (lambda frame, rest: (frame, rest[:-1]), "reference has shape"),
        (lambda frame, rest: (np.where(np.arange(94) > 40, np.nan, frame), rest), "no reading of 53 of 94"),
        (lambda frame, rest: (frame, np.stack([rest, rest])), "reference has shape"),
    ],
)
def test_frames_of_other_shapes(small_skin, learnt, resting, change, message):
    given, rest = voltages(small_skin, [[Indent(DiscIndenter(0.02), 5e-3)]], resting)
    with pytest.raises(ValueError, match=message):
        learnt[1].network.depth(*change(given[0], rest))


def test_measurements_of_another_skin_are_refused(small_skin, learnt):
    """A network states the skin that it was trained for in millimetres."""
    network, model = learnt[1].network, small_skin.model
    places = np.asarray(model.electrodes.position)
    np.testing.assert_allclose(network.made_for["electrodes_mm"], 1e3 * places[:, :2], atol=6e-4)
    np.testing.assert_allclose(network.made_for["skin_mm"], [-50, 50, -50, 50])

    def measured(electrodes=model.electrodes, domain=small_skin.outline, factor=1.0):
        given = np.full((1, 94), factor), np.ones((1, 94), bool), model.protocol
        return Measurement(*given, electrodes=electrodes, domain=domain, name="tank")

    check_measured(network, measured())
    moved = eqx.tree_at(
        lambda one: one.position, model.electrodes, places + (np.arange(16) == 4)[:, None] * [3e-3, 4e-3]
    )
    with pytest.raises(ValueError, match="'tank': electrode 5 is 5 mm from where the network's is"):
        check_measured(network, measured(moved))
    with pytest.raises(ValueError, match="its skin is 120 × 100 mm, and the network's 100 × 100 mm; train one"):
        check_measured(network, measured(domain=Rectangle(0.12, 0.1)))
    with pytest.raises(ValueError, match="'tank' is complex"):
        check_measured(network, measured(factor=1.0j))


def test_finished_work_is_not_repeated(small_skin, learnt):
    folder, found = learnt
    again = learn_images(small_skin, folder, preset=PRESET)
    assert again.seconds["training"] < found.seconds["training"]
    assert bits(again.network.network) == bits(found.network.network)


SCRIPT = """
import sys
from jeit.data import Measurement
from jeit.design import Skin
from jeit.layout import named_layout
from jeit.mesh import Rectangle
from jeit.touch.networks import learn_images
from small_networks import PRESET, small_maps

skin = Skin.create(named_layout("grid-4x4", Rectangle(0.1, 0.1)), num_layers=0, cell_size=8e-3)
with small_maps():
    learn_images(skin, sys.argv[1], preset=PRESET, progress=lambda report: print(report, flush=True))
"""


@pytest.mark.slow
@pytest.mark.parametrize("last_word", ["touches learnt: 100 of 100", "unrolled, epoch 3 "])
def test_killed_at_any_moment(small_skin, learnt, tmp_path, last_word):
    """By kill -9, during the simulation of touches or training. The result is that of an uninterrupted run."""
    path = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert process.stdout is not None
    assert any(line.startswith(last_word) for line in process.stdout)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert not (tmp_path / "network.jeit").exists()
    again = learn_images(small_skin, tmp_path, preset=PRESET)
    assert bits(again.network.network) == bits(learnt[1].network.network)


def test_a_network_is_saved_and_read(small_skin, learnt, tmp_path):
    folder, found = learnt
    again = read_network(folder, skin=small_skin)
    assert jax.tree.structure(again.network) == jax.tree.structure(found.network.network)
    assert bits(again.network) == bits(found.network.network)
    assert again.made_for == found.network.made_for
    assert (again.design, again.extent, again.noise) == ("unrolled", found.network.extent, found.network.noise)
    write_network(again, tmp_path / "copy.jeit")
    assert (tmp_path / "copy.jeit").read_bytes() == (folder / "network.jeit").read_bytes()


def test_another_skin_is_refused(small_skin, learnt):
    folder, found = learnt
    pairs = skin_protocol(small_skin.layout)
    layout = named_layout("grid-4x4", Rectangle(0.12, 0.1))
    other = Skin.create(layout, num_layers=0, cell_size=8e-3, protocol=pairs)
    with pytest.raises(ValueError, match=r"its skin_mm is \[-50.0, 50.0"):
        read_network(folder, skin=other)
    with pytest.raises(ValueError, match="its channels is 94, and here it is 208"):
        found.network.check_protocol(adjacent(16), "frames.csv")
    found.network.check_protocol(small_skin.model.protocol)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"preset": "fast"}, "preset must be"),
        ({"design": "u"}, "design must"),
        ({"touches": 0}, "touches must be a whole number, 1 or more; it is 0"),
    ],
)
def test_bad_arguments(small_skin, tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        learn_images(small_skin, tmp_path, **change)


def test_work_of_another_set_is_refused(small_skin, learnt):
    with pytest.raises(ValueError, match="another"):
        learn_images(small_skin, learnt[0], preset=NetworkPreset(201, 50, TrainingPlan()))


@pytest.mark.parametrize("package", ["xarray", "zarr"])
def test_without_the_extra(small_skin, tmp_path, monkeypatch, package):
    """The message is raised before anything is simulated."""
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=rf"touches needs {package}: pip install 'jeit\[cluster\]'"):
        learn_images(small_skin, tmp_path)
    assert not any(tmp_path.iterdir())


class Stopped(Exception):
    pass


def test_the_number_of_touches(small_skin, tmp_path, monkeypatch):
    """It replaces that of the preset. A larger number in the same folder is another set."""
    import zarr

    monkeypatch.setattr("jeit.touch.networks.learn.detection_noise", lambda skin: 1e-3)

    def stop(message):
        if message.startswith("touches held-out"):
            raise Stopped

    with pytest.raises(Stopped):
        learn_images(small_skin, tmp_path, preset=PRESET, touches=40, progress=stop)
    assert zarr.open_group(str(tmp_path / "work" / "learnt.zarr"), mode="r")["change"].shape[0] == 40  # pyright: ignore
    with pytest.raises(ValueError, match="another"):
        learn_images(small_skin, tmp_path, preset=PRESET, touches=50)
