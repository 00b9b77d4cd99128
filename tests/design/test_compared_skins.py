"""Layouts are compared on the same skin only."""

import numpy as np
import pytest

from jeit.design.comparison import check_same_outline
from jeit.layout import Layout, SurfaceLayout, grid
from jeit.mesh import Rectangle, tube


def on_a_tube(radius: float) -> SurfaceLayout:
    centres = np.array([[radius, 0.0, 0.02], [-radius, 0.0, 0.04]])
    return SurfaceLayout(centres, 4e-3, tube(radius, 0.06, num_around=24), contact_impedance=1e-4)


def test_curved_skins_are_compared_by_their_areas():
    check_same_outline(on_a_tube(0.03), on_a_tube(0.03))
    with pytest.raises(ValueError, match=r"on different skins, .* of 112\.9 and .* of 150\.5 cm²"):
        check_same_outline(on_a_tube(0.03), on_a_tube(0.04))
    flat = Layout(grid(0.1, 0.03, 2, 2), 4e-3, outline=Rectangle(0.2, 0.06))
    with pytest.raises(ValueError, match="compare layouts on the same surface"):
        check_same_outline(on_a_tube(0.03), flat)
