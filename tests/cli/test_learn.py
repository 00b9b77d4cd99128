"""`jeit learn image`: from a description to a network; the quick preset, whose figure an untrained one misses."""

import numpy as np
import pytest

from jeit.design import read_described_skin

SKIN = """
[skin]
width_mm = 100
height_mm = 100
[electrodes]
layout = "grid-4x4"
[mesh]
cell_mm = 6
"""


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[electrodes]\nlayout = 'grid-4x4'\n[skin]\nthick = 3", "skin.thick is no key of a skin"),
        ("[skin]\nwidth_mm = 100", "electrodes.layout is missing"),
        ("[electrode]\nlayout = 'grid-4x4'", "electrode is no table of a skin"),
        ("[electrodes]\nlayout = 'spiral'", "spiral"),
        ("not toml", "is no TOML file"),
    ],
)
def test_descriptions_that_are_wrong(run, tmp_path, text, said):
    (tmp_path / "skin.toml").write_text(text)
    status, _, error = run("learn", "image", tmp_path / "skin.toml", "--output", tmp_path / "model")
    assert status == 1
    assert said in error


def test_a_described_skin(tmp_path):
    (tmp_path / "skin.toml").write_text(
        SKIN.replace("cell_mm = 6", "cell_mm = 6\nlayers = 3\n[measurement]\npairs = 20")
    )
    skin = read_described_skin(tmp_path / "skin.toml")
    assert (skin.num_layers, skin.model.mesh.dimension) == (0, 2)
    assert skin.model.protocol.num_measurements == 20
    assert np.allclose(skin.outline.extent, (-0.05, 0.05, -0.05, 0.05))
    text = SKIN.replace("[skin]", "[skin]\nmodel = 'layer'").replace("cell_mm = 6", "cell_mm = 8\nlayers = 3")
    (tmp_path / "layer.toml").write_text(text)
    assert read_described_skin(tmp_path / "layer.toml").num_layers == 3


def test_no_such_preset(run, tmp_path):
    (tmp_path / "skin.toml").write_text(SKIN)
    status, _, error = run("learn", "image", tmp_path / "skin.toml", "--output", tmp_path / "m", "--preset", "slow")
    assert status == 1
    assert "--preset must be one of quick, full" in error
