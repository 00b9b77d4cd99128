"""`jeit learn image`: from a description to a network. The quick preset must exceed the score of an untrained
network."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from small_networks import SKIN

from jeit.design import read_described_skin
from jeit.touch.networks import read_network
from jeit.touch.networks.learn import evaluate_network
from jeit.touch.networks.linear_channels import LinearChannels
from jeit.touch.networks.simulated_touches import TouchExamples
from jeit.touch.networks.three_stage_network import ThreeStages
from jeit.touch.networks.unrolled_network import Unrolled
from jeit.touch.simulate.contact.indent_sets import image_places


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[electrodes]\nlayout = 'grid-4x4'\n[skin]\nthick = 3", "skin.thick is no key of a skin"),
        ("[skin]\nwidth_mm = 100", "electrodes.layout is missing"),
        ("[electrode]\nlayout = 'grid-4x4'", "electrode is no key of a skin"),
        ("[electrodes]\nlayout = 'spiral'", "spiral"),
        ("not toml", "is no TOML file"),
    ],
)
def test_invalid_descriptions(run, tmp_path, text, message):
    (tmp_path / "skin.toml").write_text(text)
    status, _, error = run("learn", "image", tmp_path / "skin.toml", "--output", tmp_path / "model")
    assert status == 1
    assert message in error


def test_a_described_skin(tmp_path):
    text = SKIN.replace("cell_mm = 8", "cell_mm = 8\nlayers = 3\n[measurement]\npairs = 20")
    (tmp_path / "skin.toml").write_text(text)
    skin = read_described_skin(tmp_path / "skin.toml")
    assert (skin.num_layers, skin.model.mesh.dimension) == (0, 2)
    assert skin.model.protocol.num_measurements == 20
    assert np.allclose(skin.outline.extent, (-0.05, 0.05, -0.05, 0.05))
    text = SKIN.replace("[skin]", "[skin]\nmodel = 'layer'").replace("cell_mm = 8", "cell_mm = 8\nlayers = 3")
    (tmp_path / "layer.toml").write_text(text)
    assert read_described_skin(tmp_path / "layer.toml").num_layers == 3


def test_curved_skins_are_refused_before_a_folder_is_made(run, tmp_path):
    surface = "[surface]\nkind = 'tube'\nradius_mm = 30\nheight_mm = 80\n"
    (tmp_path / "arm.toml").write_text(
        f"{surface}[electrodes]\nlayout = 'inner-8'\ndiameter_mm = 8\n[mesh]\ncell_mm = 12"
    )
    status, _, error = run("learn", "image", tmp_path / "arm.toml", "--output", tmp_path / "model")
    assert status == 1
    assert "networks image flat skins" in error
    assert "in place of the table [surface]" in error
    assert not (tmp_path / "model").exists()


def test_unknown_preset(run, tmp_path):
    (tmp_path / "skin.toml").write_text(SKIN)
    status, _, error = run("learn", "image", tmp_path / "skin.toml", "--output", tmp_path / "m", "--preset", "slow")
    assert status == 1
    assert "--preset must be one of quick, full" in error


@pytest.mark.slow(first=True)
def test_the_quick_preset(run, tmp_path):
    """The network explains 0.64 of the squared depth. A network trained on the maps of other touches explains 0.12;
    linear images, and an untrained network of this design, 0.44; an untrained one of the other design is worse than
    empty maps."""
    import xarray

    (tmp_path / "skin.toml").write_text(SKIN)
    model = tmp_path / "model"
    status, output, error = run("learn", "image", tmp_path / "skin.toml", "--output", model, "--preset", "quick")
    assert (status, error) == (0, "")
    assert "of squared depth explained" in output
    report = json.loads((model / "report.json").read_text())
    assert report["share_of_squared_depth_explained"] > 0.6
    assert report["error_of_a_ball_m"]["mean"] < 2e-3
    assert (model / "learning.png").stat().st_size > 10_000
    skin, network = read_described_skin(tmp_path / "skin.toml"), read_network(model)
    opened = [xarray.open_zarr(model / "work" / f"{name}.zarr") for name in ("learnt", "standing")]
    learnt, judged = (TouchExamples(one["change"].to_numpy(), one["depth"].to_numpy()) for one in opened)

    def explained(other):
        return evaluate_network(dataclasses.replace(network, network=other), skin, judged).explained

    channels, sensed = learnt.change.shape[1], LinearChannels.from_skin(skin)
    fresh = Unrolled(channels, (48, 48), key=jax.random.key(3))
    fresh = fresh.adapted_to_skin(sensed, image_places(skin, 48, 48), skin.layout.centres, network.noise)
    other = ThreeStages(channels, (48, 48), key=jax.random.key(3))
    assert explained(fresh) < 0.55
    assert explained(other) < 0.1
