"""What a skin of one layout feels: insulating and conductive touches, and everything checked before any is made."""

import jax
import numpy as np
import pytest

from jeit.design import TouchedSkin, comparison, feel, sensitivity_map, touches_away_from_the_edge
from jeit.layout import Layout, grid
from jeit.mesh import Rectangle

SKIN = Rectangle(0.06, 0.05)
LAYOUT = Layout(grid(0.04, 0.03, 3, 2), 8e-3, outline=SKIN, name="six")
GRID = touches_away_from_the_edge(SKIN, 5e-3, 10, 10)
OPTIONS = {"num_pairs": 6, "num_taxels": 8, "num_layers": 4, "cell_size": 6e-3}


@pytest.mark.parametrize("contrast", [0.0, 5.0])
def test_touches_insulate_or_conduct(contrast):
    felt = feel(LAYOUT, GRID, key=jax.random.key(0), contrast=contrast, **OPTIONS)
    model = TouchedSkin.create(LAYOUT, GRID, contrast=contrast, **OPTIONS).model
    alone = sensitivity_map(model, 1.0, GRID, contrast=contrast)
    np.testing.assert_allclose(felt.sensitivity.values, alone.values, rtol=1e-10)  # the solves' rounding


def test_a_comparison_with_itself_has_no_blind_spot():
    felt = feel(LAYOUT, GRID, key=jax.random.key(0), **OPTIONS)
    one, other = comparison(felt, felt)
    assert one == other
    assert one["blind_spot_fraction"] == 0
    theta = np.asarray(felt.sensitivity.values)
    assert one["sensitivity_uniformity"] == pytest.approx(theta.mean() / np.sqrt((theta**2).mean()))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"contrast": 1.0}, "contrast must be a factor"),
        ({"cell_size": 1e-5}, r"cell_size is 0\.01 mm, which makes about 1\.8e\+08 nodes; give 0\.14 mm or more"),
        ({"cell_size": 0.1}, "cell_size is 100 mm; give no more than 12 mm"),
        ({"thickness": 2e-3}, "thickness is 2 mm; give more than the 2.5 mm"),
        ({"conductivity": -1.0}, "conductivity"),
        ({"num_pairs": 16}, "num_pairs is 16; 'six' has 6 electrodes, and they make 15 pairs"),
        ({"num_taxels": 200}, "num_taxels is 200"),
    ],
)
def test_what_cannot_be_felt_is_refused_before_it_is_touched(options, said):
    with pytest.raises(ValueError, match=said):
        TouchedSkin.create(LAYOUT, GRID, **{**OPTIONS, **options})
