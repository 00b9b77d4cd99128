"""Skins of several layouts share a mesh where they can, and each gives the results that it gives alone."""

from itertools import pairwise

import numpy as np
import pytest

from jeit.design import Skin
from jeit.design.skin.names import skin_protocol
from jeit.design.skin.skin import create_skins
from jeit.layout import SurfaceLayout, named_layout
from jeit.mesh import Rectangle, tube

FIELD = Rectangle(0.1, 0.08)
OPTIONS = {"num_layers": 0, "cell_size": 8e-3}


def skins(*layouts):
    return create_skins(layouts, [skin_protocol(one) for one in layouts], **OPTIONS)


def test_layouts_of_equal_size_on_one_outline_share_a_mesh():
    first, second = (named_layout(name, FIELD) for name in ("grid-3x2", "perimeter-6"))
    made, alone = skins(first, second), Skin.create(second, **OPTIONS)
    assert made[1].model.mesh.points is made[0].model.mesh.points
    assert made[1].layout.name == "perimeter-6"
    assert made[1].model.protocol == skin_protocol(second)
    voltages = made[1].model.voltages(made[1].model_conductivity)
    np.testing.assert_allclose(voltages, alone.model.voltages(alone.model_conductivity), rtol=1e-10)


@pytest.mark.parametrize(
    "other",
    [named_layout("grid-3x2", Rectangle(0.1, 0.1)), named_layout("grid-3x3", FIELD)],
    ids=["another outline", "more electrodes"],
)
def test_other_layouts_have_their_own_mesh(other):
    made = skins(named_layout("grid-3x2", FIELD), other)
    assert made[1].model.mesh.points is not made[0].model.mesh.points
    assert made[1].outline.area == pytest.approx(other.known_outline.area)
    alone = Skin.create(other, **OPTIONS)
    voltages = made[1].model.voltages(made[1].model_conductivity)
    np.testing.assert_allclose(voltages, alone.model.voltages(alone.model_conductivity), rtol=1e-10)


def test_a_shared_mesh_is_checked_for_the_electrodes_of_every_layout():
    small = named_layout("grid-3x2", FIELD, diameter=1e-3)
    with pytest.raises(ValueError, match=r"cell_size is 8 mm; give no more than 1.5 mm"):
        skins(named_layout("grid-3x2", FIELD), small)


def test_curved_layouts_share_a_mesh_on_the_same_side_of_the_same_surface():
    surface, longer = tube(0.03, 0.1, num_points=100), tube(0.03, 0.11, num_points=100)
    first = SurfaceLayout.spread(surface, 6, 9e-3)
    inward = SurfaceLayout(first.centres, 9e-3, longer, outward=False)
    layouts = [
        first,
        SurfaceLayout(first.centres * np.array([1, -1, 1]), 9e-3, surface),
        SurfaceLayout(first.centres, 9e-3, longer),
        inward,
        named_layout("grid-3x2", FIELD),
        inward,
        SurfaceLayout(first.centres[:5], 9e-3, longer, outward=False),
    ]
    made = create_skins(layouts, [skin_protocol(one) for one in layouts], thickness=4e-3, num_layers=1)
    shared = [one.model.mesh.points is other.model.mesh.points for one, other in pairwise(made)]
    assert shared == [True, False, False, False, False, False]
    for skin, layout in zip(made, layouts, strict=True):
        np.testing.assert_allclose(np.asarray(skin.model.electrodes.position)[:, :2], layout.centres[:, :2])
        assert skin.model.protocol == skin_protocol(layout)
    for skin, height in zip(made[:4], (4e-3, 4e-3, 4e-3, 0.0), strict=True):
        radii = np.hypot(*np.asarray(skin.model.mesh.points)[:, :2].T)
        assert radii.max() == pytest.approx(0.03 + height, abs=1e-4)
