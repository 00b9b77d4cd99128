"""Pressure under indenters: Hertz, the flat punch, Winkler's closed forms, and conditions for every contact."""

import numpy as np
import pytest

from jeit.touch.simulate.contact import (
    BarIndenter,
    DepthMapIndenter,
    DiscIndenter,
    Foundation,
    HalfSpace,
    JoinedIndenters,
    PlacedIndenter,
    PrismIndenter,
    RingIndenter,
    ball_indenter,
)
from jeit.touch.simulate.contact.half_space import displacement_function
from jeit.touch.simulate.contact.indenters import AbstractIndenter
from jeit.touch.simulate.contact.press import raster

RADIUS, LOAD = 0.01, 0.05
MIDDLE = np.zeros((1, 2))
RUBBER = HalfSpace(1e6, 0.5)
LAYER = Foundation(1e6, 3e-3)
TWO = JoinedIndenters(
    PlacedIndenter(DiscIndenter(0.01), (0.01, 0.0)), PlacedIndenter(ball_indenter(0.02), (-0.01, 0.002))
)
ROUGH = DepthMapIndenter(1e-4 * np.random.default_rng(0).normal(size=(24, 24)), 5e-4)
SHAPES = {
    "disc": DiscIndenter(0.02),
    "ring": RingIndenter(0.02, 0.012),
    "bar": BarIndenter(0.03, 0.004),
    "prism": PrismIndenter(0.03, 0.02, 0.01),
    "ball": ball_indenter(0.02),
    "two": TWO,
}


class Paraboloid(AbstractIndenter):
    """r² / 2R, Hertz's approximation of a ball."""

    def gap(self, points):
        return np.sum(np.asarray(points) ** 2, axis=-1) / (2 * RADIUS)

    @property
    def reach(self) -> float:
        return RADIUS


def hertz(support):
    """Contact radius, maximum pressure and approach: Johnson, Contact Mechanics, 1985, equations 4.22 to 4.24."""
    radius = (3 * LOAD * RADIUS / (4 * support.plane_modulus)) ** (1 / 3)
    return radius, 3 * LOAD / (2 * np.pi * radius**2), radius**2 / RADIUS


def test_a_ball_on_a_half_space_is_hertz():
    errors, radii = [], []
    for pixels in (24, 48, 96):
        support = HalfSpace(1e6, 0.3, pixels)
        radius, peak, approach = hertz(support)
        found = support.pressure(Paraboloid(), LOAD)
        points, _ = raster(pixels / 2 * found.pixel, pixels)
        exact = peak * np.sqrt(np.maximum(1 - np.sum(points**2, axis=-1) / radius**2, 0))
        errors.append(np.linalg.norm(found.values - exact) / np.linalg.norm(exact))
        radii.append(abs(np.sqrt((found.values > 0).sum() * found.pixel.prod() / np.pi) / radius - 1))
        assert found.values.max() == pytest.approx(peak, rel=0.01)
    assert found.approach == pytest.approx(approach, rel=1e-4)
    assert found.values.max() == pytest.approx(peak, rel=1e-3)
    assert errors[-1] < 5e-3
    assert radii[-1] < 5e-3
    # The root at the contact's edge causes an error of order h^1.5, and the edge's position on the pixels varies it.
    assert np.log2(errors[0] / errors[-1]) / 2 > 0.9


def test_a_flat_punch_on_a_half_space():
    """F = 2 a E* δ, with p = F / (2π a √(a² − r²)): the error is that of a disc of pixels, and falls with them."""
    errors = []
    for pixels in (32, 64, 128):
        support = HalfSpace(1e6, 0.5, pixels)
        found = support.pressure(DiscIndenter(2 * RADIUS), LOAD)
        errors.append(abs(2 * RADIUS * support.plane_modulus * found.approach / LOAD - 1))
        assert found.at(MIDDLE) == pytest.approx(LOAD / (2 * np.pi * RADIUS**2), rel=0.03)
    assert errors[-1] < 4e-3
    assert errors[-1] < errors[0] / 2


def test_the_surface_sinks_under_a_square():
    """At the centre of a square of side 2a by 8 a p log(1 + √2) / (π E*), and at a large distance r by F / (π E* r) and
    a² / 6r² more.
    """
    side, number = 0.01, 120
    points, pixel = raster((3 * side, 3 * side), number)
    pressure = np.where(np.abs(points).max(axis=-1) < side / 2, 1000.0, 0.0)
    found = displacement_function(number, pixel, 2e6)(pressure)
    middle = found[number // 2 - 1 : number // 2 + 1, number // 2 - 1 : number // 2 + 1].mean()
    assert middle == pytest.approx(4 * side * 1000 * np.log(1 + 2**0.5) / (np.pi * 2e6), rel=2e-3)
    far = np.linalg.norm(points[0, 0])
    assert found[0, 0] == pytest.approx(1000 * side**2 / (np.pi * 2e6 * far), rel=5e-3)


@pytest.mark.parametrize("load", [1e-3, 1.0, 8.0])
def test_a_ball_on_a_foundation(load):
    """The cap's volume: F = k π δ² (R − δ/3), and k π R δ² where δ ≪ R."""
    found = LAYER.pressure(ball_indenter(2 * RADIUS), load)
    depth = found.approach
    assert LAYER.stiffness * np.pi * depth**2 * (RADIUS - depth / 3) == pytest.approx(load, rel=2e-4)
    assert found.reach == pytest.approx(np.sqrt(depth * (2 * RADIUS - depth)), rel=0.05)
    assert float(found.at(MIDDLE)[0]) == pytest.approx(LAYER.stiffness * depth)


def test_a_flat_punch_on_a_foundation():
    """Uniform pressure F / A. A hole in the punch raises it."""
    area = np.pi * RADIUS**2
    assert float(LAYER.pressure(DiscIndenter(2 * RADIUS), 20.0).at(MIDDLE)[0]) == pytest.approx(20 / area, rel=5e-3)
    ring = LAYER.pressure(RingIndenter(2 * RADIUS, RADIUS), 20.0)
    assert float(ring.at(MIDDLE)[0]) == 0
    assert float(ring.at(np.array([0.0, 0.8 * RADIUS]))) == pytest.approx(20 / (0.75 * area), rel=5e-3)


@pytest.mark.parametrize("support", [RUBBER, LAYER], ids=["half-space", "foundation"])
@pytest.mark.parametrize("shape", SHAPES)
def test_load_is_carried_where_bodies_touch(support, shape):
    load = 0.4
    found = support.pressure(SHAPES[shape], load)
    own = support is RUBBER
    window = (1 + RUBBER.pixels) / 2 * found.pixel if own else np.full(2, 1.02 * found.reach)
    points, pixel = raster(window, 801)
    pressure = found.at(points)
    assert pressure.min() >= 0
    # Cells of the sum are cut by edges: a fraction pixel / width of the load.
    assert pressure.sum() * pixel.prod() == pytest.approx(load, rel=0.05)
    assert (pressure[np.linalg.norm(points, axis=-1) > found.reach] == 0).all()
    assert found.at(points[400, 400]) == pressure[400, 400]
    if own:
        assert found.values.sum() * found.pixel.prod() == pytest.approx(load, rel=1e-12)


@pytest.mark.parametrize("shape", ["ball", "two", "prism", "rough"])
def test_bodies_do_not_overlap(shape):
    """Signorini conditions: the distance is zero under pressure and nowhere negative, also where pixels leave the
    contact and return.
    """
    indenter = ROUGH if shape == "rough" else SHAPES[shape]
    support = HalfSpace(1e6, 0.5, 48)
    found = support.pressure(indenter, 3.0)
    points, pixel = raster(found.pixel * support.pixels / 2, support.pixels)
    distance = displacement_function(support.pixels, pixel, support.plane_modulus)(found.values) + indenter.gap(points)
    distance -= found.approach
    assert np.abs(distance[found.values > 0]).max() < 1e-6 * found.approach
    assert distance.min() > -1e-6 * found.approach


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LAYER.pressure(ball_indenter(0.01), 0.0), "load must be positive, in newtons"),
        (lambda: RUBBER.pressure(ball_indenter(0.01), np.nan), "load must be positive"),
        (lambda: LAYER.pressure(DiscIndenter(0.01), 100.0), "presses the indenter 3.8. mm into a layer 3 mm thick"),
        (lambda: LAYER.pressure(BarIndenter(0.04, 1e-5), 1.0), r"thinner than a pixel, 0\.42 mm"),
        (
            lambda: RUBBER.pressure(PlacedIndenter(DiscIndenter(1e-5), (0.02, 0.0)), 1.0),
            r"thinner than a pixel, 0\.6. mm",
        ),
        (lambda: Foundation(-1.0, 1e-3), "modulus must be positive"),
        (lambda: Foundation(1e6, 0.0), "thickness must be"),
        (lambda: HalfSpace(1e6, 0.6), "poisson must be"),
        (lambda: HalfSpace(1e6, pixels=4), "pixels must be"),
    ],
)
def test_impossible_contacts_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
