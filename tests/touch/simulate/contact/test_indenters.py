"""Indenters: their gaps from geometry, moved, rotated and combined."""

import numpy as np
import pytest

from jeit.design import Bell
from jeit.touch.simulate.contact import (
    BarIndenter,
    DepthMapIndenter,
    DiscIndenter,
    JoinedIndenters,
    PlacedIndenter,
    PrismIndenter,
    RevolvedIndenter,
    RingIndenter,
    ball_indenter,
)

MIDDLE = np.zeros(2)


@pytest.mark.parametrize(
    ("indenter", "point", "gap"),
    [
        (DiscIndenter(0.02), (0.006, 0.008), 0.0),
        (DiscIndenter(0.02), (0.006, 0.0081), np.inf),
        (RingIndenter(0.02, 0.01), (0.004, 0.0), np.inf),
        (RingIndenter(0.02, 0.01), (0.0, -0.007), 0.0),
        (BarIndenter(0.1, 0.002), (0.049, 0.0009), 0.0),
        (BarIndenter(0.1, 0.002), (0.0009, 0.049), np.inf),
        (PrismIndenter(0.04, 0.02, 0.01), (0.015, -0.005), 0.005),
        (ball_indenter(0.02), (0.006, 0.0), 0.002),
        (ball_indenter(0.02), (0.0, 0.0101), np.inf),
        (RevolvedIndenter(Bell(2e-3, 5e-3)), (0.005, 0.0), 2e-3 * (1 - np.exp(-0.5))),
        (PlacedIndenter(DiscIndenter(0.02), (0.03, 0.0)), (0.039, 0.0), 0.0),
        (PlacedIndenter(BarIndenter(0.1, 0.002), (0.01, 0.0), np.pi / 2), (0.01, 0.04), 0.0),
        (
            PlacedIndenter(PrismIndenter(0.04, 0.02, 0.01), (0.01, 0.02), np.pi / 6),
            (0.01 - 0.0025, 0.02 + 0.0025 * 3**0.5),
            0.005,
        ),
        (JoinedIndenters(PlacedIndenter(DiscIndenter(0.01), (0.02, 0)), ball_indenter(0.01)), (0.02, 0.003), 0.0),
        (JoinedIndenters(PlacedIndenter(DiscIndenter(0.01), (0.02, 0)), ball_indenter(0.01)), (0.003, 0.0), 0.001),
    ],
)
def test_gap(indenter, point, gap):
    assert float(indenter.gap(np.array(point))) == pytest.approx(gap, rel=1e-9, abs=1e-17)


@pytest.mark.parametrize(
    "indenter",
    [
        DiscIndenter(0.02),
        RingIndenter(0.02, 0.01),
        BarIndenter(0.1, 0.002),
        PrismIndenter(0.04, 0.02, 0.01),
        ball_indenter(0.01),
        JoinedIndenters(DiscIndenter(0.01), ball_indenter(0.02)),
    ],
)
def test_gap_is_infinite_beyond_reach_and_zero_somewhere(indenter):
    points = np.random.default_rng(0).uniform(-1, 1, (40_000, 2)) * 1.2 * indenter.reach
    gap = indenter.gap(points)
    assert np.isinf(gap[np.linalg.norm(points, axis=1) > indenter.reach * (1 + 1e-12)]).all()
    assert 0 <= gap.min() < 0.02 * indenter.reach


def test_a_depth_map_is_linear_between_its_pixels():
    height = np.array([[0.0, 1.0, 2.0], [0.0, 1.0, 2.0], [np.nan, 1.0, 3.0]])
    indenter = DepthMapIndenter(height, 1.0)
    gap = indenter.gap(np.array([[0.0, 0.0], [0.5, -0.5], [1.0, 1.0], [-0.5, 0.5], [1.5, 0.0]]))
    np.testing.assert_allclose(gap, [2.0, 1.5, 0.0, np.inf, np.inf])
    assert indenter.gap(np.array([0.5, -0.5])) == pytest.approx(1.5)


@pytest.mark.parametrize(
    "make",
    [
        lambda: DiscIndenter(15),
        lambda: RingIndenter(15, 10),
        lambda: BarIndenter(15, 0.01),
        lambda: PrismIndenter(0.01, 15, 0.01),
        lambda: ball_indenter(15),
    ],
)
def test_sizes_in_millimetres_are_noticed(make):
    with pytest.warns(UserWarning, match="If the lengths are millimetres"):
        make()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DiscIndenter(0.0), "diameter must be a positive length"),
        (lambda: RingIndenter(0.01, 0.02), "inner_diameter is 20 mm, more than the outer"),
        (lambda: RingIndenter(0.01, 0.01), "the outer one, 10 mm: nothing is left"),
        (lambda: BarIndenter(0.01, np.nan), "width must be"),
        (lambda: PrismIndenter(0.01, 0.01, -1.0), "height must be"),
        (lambda: RevolvedIndenter(0.01), "indentation must be"),
        (lambda: DepthMapIndenter(np.zeros(4), 1e-3), "height must be an image"),
        (lambda: DepthMapIndenter(np.full((4, 4), np.nan), 1e-3), "0 pixels of it finite"),
        (lambda: PlacedIndenter(0.01), "indenter must be an indenter"),
        (lambda: PlacedIndenter(DiscIndenter(0.01), (0.0, np.nan)), r"position: give \(x, y\)"),
        (lambda: PlacedIndenter(DiscIndenter(0.01), (0.0, 0.0), np.inf), "angle: give radians"),
        (lambda: PlacedIndenter(DiscIndenter(0.01), "ab"), r"position must be \(x, y\) in metres, real numbers"),
        (lambda: PlacedIndenter(DiscIndenter(0.01), (0.0, 0.0), "a"), "angle: give radians"),
        (lambda: DepthMapIndenter([[0.0, 1.0], [2.0]], 1e-3), "height must be an image"),
        (JoinedIndenters, "parts: give one"),
        (lambda: JoinedIndenters(DiscIndenter(0.01), "ball"), "part 1 must be an indenter"),
    ],
)
def test_impossible_indenters_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
