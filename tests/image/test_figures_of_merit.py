"""Figures of merit of synthetic images with known values, and of another toolkit's images with its values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.io

from jeit.image import figures_of_merit
from jeit.image.rasters import FiguresOfMerit

BODY = 0.1
EXTENT = (-BODY, BODY, -BODY, BODY)
PIXELS = 400
PIXEL = 2 * BODY / PIXELS
AXIS = -BODY + (np.arange(PIXELS) + 0.5) * PIXEL
X, Y = np.meshgrid(AXIS, -AXIS)
RADIUS = 0.02
AREA = np.pi * RADIUS**2
FIELDS = ("amplitude_response", "position_error", "resolution", "shape_deformation", "ringing")
# Areas are sums of pixels: a staircase round a disc of forty pixels' radius is accurate to a few parts in a thousand.
STAIRCASE = 5e-3


def within(radius, x=0.0, y=0.0):
    return (X - x) ** 2 + (Y - y) ** 2 <= radius**2


def image(values):
    return np.where(within(BODY), values, np.nan)


def disc(x=0.0, y=0.0, radius=RADIUS):
    return image(1.0 * within(radius, x, y))


def merit(raster, position=(0.0, 0.0), area=None, **options):
    return figures_of_merit(raster, EXTENT, jnp.asarray(position), area=AREA if area is None else area, **options)


def test_a_perfect_image_anywhere():
    position = np.array([[0, 0], [0.03, 0.01], [-0.02, 0.055], [0.05, -0.05]])
    found = merit(np.stack([disc(*place) for place in position]), position)
    np.testing.assert_allclose(found.amplitude_response, 1, rtol=STAIRCASE)
    np.testing.assert_allclose(found.position_error, 0, atol=0.1 * PIXEL)
    np.testing.assert_allclose(found.resolution, RADIUS / BODY, rtol=STAIRCASE)
    np.testing.assert_allclose(found.shape_deformation, 0, atol=STAIRCASE)
    np.testing.assert_array_equal(found.ringing, 0)
    np.testing.assert_allclose(found.distance, np.linalg.norm(position, axis=1), atol=1e-6)
    np.testing.assert_allclose(found.body_radius, BODY, rtol=1e-3)


def test_position_error_is_positive_for_images_too_near_to_the_centre():
    inwards, outwards = merit(disc(0.03, 0.04), (0.036, 0.048)), merit(disc(0.03, 0.04), (0.024, 0.032))
    assert float(inwards.position_error) == pytest.approx(0.01, abs=0.1 * PIXEL)
    assert float(outwards.position_error) == pytest.approx(-0.01, abs=0.1 * PIXEL)
    assert f"position error {1e3 * float(inwards.position_error):.3g} mm," in repr(inwards)
    around = merit(disc(0.03, 0.04), (0.05, 0.0))
    assert float(around.position_error) == pytest.approx(0, abs=0.1 * PIXEL)


@pytest.mark.parametrize(("halo", "radius"), [(0.2, 1), (0.3, 2)])
def test_the_region_above_a_quarter_of_the_maximum(halo, radius):
    found = merit(disc() + halo * (disc(radius=2 * RADIUS) - disc()))
    assert float(found.resolution) == pytest.approx(radius * RADIUS / BODY, rel=STAIRCASE)
    assert float(found.amplitude_response) == pytest.approx(1 + 3 * halo, rel=STAIRCASE)


@pytest.mark.parametrize("ratio", [2.0, 4.0])
def test_shape_deformation_of_an_ellipse(ratio):
    """In polar coordinates the ellipse lies outside the circle of its area where tan²θ < 1 / ratio.

    There ½∫(r² - ab) dθ gives the fraction (2/π)(atan √ratio - atan √(1/ratio)).
    """
    long, short = RADIUS * np.sqrt(ratio), RADIUS / np.sqrt(ratio)
    found = merit(image(1.0 * ((X / long) ** 2 + (Y / short) ** 2 <= 1)))
    expected = 2 / np.pi * (np.arctan(np.sqrt(ratio)) - np.arctan(np.sqrt(1 / ratio)))
    assert float(found.shape_deformation) == pytest.approx(expected, rel=0.02)
    assert float(found.resolution) == pytest.approx(RADIUS / BODY, rel=STAIRCASE)


def test_ringing_by_a_ring_of_the_opposite_sign():
    ring = disc(radius=2 * RADIUS) - disc(radius=1.5 * RADIUS)
    found = merit(disc() - 0.1 * ring)
    assert float(found.ringing) == pytest.approx(0.1 * (4 - 2.25), rel=STAIRCASE)
    assert float(found.amplitude_response) == pytest.approx(1 - 0.175, rel=STAIRCASE)
    # Excess of the same sign that stays below the threshold is not ringing.
    assert float(merit(disc() + 0.1 * ring).ringing) == 0


def test_a_hole_deforms_but_does_not_ring():
    """A quarter of the disc is missing in its middle: the circle C has √¾ of the radius, and a third of the region lies
    outside."""
    found = merit(disc() - 1.1 * disc(radius=RADIUS / 2))
    assert float(found.shape_deformation) == pytest.approx(1 / 3, rel=0.02)
    assert float(found.ringing) == 0


def test_resistive_and_conductive_targets_are_equivalent():
    raster = disc(0.03, 0.0) - 0.1 * (disc(0.03, 0.0, 2 * RADIUS) - disc(0.03, 0.0))
    one, other = merit(raster, (0.03, 0.0)), merit(-0.5 * raster, (0.03, 0.0), change=-0.5)
    for field in FIELDS:
        np.testing.assert_allclose(getattr(other, field), getattr(one, field), rtol=1e-12)


def test_positions_are_relative_to_the_centre_of_the_outline():
    """A rectangle of 0.2 by 0.1 m, off the middle of a raster of oblong pixels that is itself away from the origin."""
    x, y = np.meshgrid(1 + (np.arange(150) + 0.5) * 2e-3, 2 + 0.2 - (np.arange(200) + 0.5) * 1e-3)
    inside = (np.abs(x - 1.14) < 0.1) & (np.abs(y - 2.12) < 0.05)
    shown = (x - 1.14 - 0.048) ** 2 + (y - 2.12 - 0.014) ** 2 < RADIUS**2
    position = jnp.array([1.14, 2.12]) + 1.2 * jnp.array([0.048, 0.014])
    raster = jnp.asarray(np.where(inside, 1.0 * shown, np.nan))
    found = figures_of_merit(raster, (1.0, 1.3, 2.0, 2.2), position, area=AREA)
    assert float(found.distance) == pytest.approx(0.06)
    assert float(found.position_error) == pytest.approx(0.01, abs=1e-4)
    assert float(found.body_radius) == pytest.approx(np.sqrt(0.02 / np.pi))
    assert float(found.resolution) == pytest.approx(RADIUS / np.sqrt(0.02 / np.pi), rel=0.01)
    assert float(found.amplitude_response) == pytest.approx(1, rel=0.01)


def test_images_without_a_target():
    between = disc(-0.06) + disc(0.06) - 0.5 * disc()
    found = merit(np.stack([disc(), image(0.0), -disc(), between]), np.zeros((4, 2)))
    for field in FIELDS[1:]:
        np.testing.assert_array_equal(np.isnan(getattr(found, field)), [False, True, True, False])
    np.testing.assert_allclose(found.amplitude_response, [1, 0, -1, 1.5], atol=STAIRCASE)
    assert np.isinf(found.ringing[3])


def test_vmap_and_jit_equal_a_loop():
    position = np.array([[0.0, 0.02], [0.03, 0.01], [-0.02, 0.055]])
    area, change = AREA * np.array([1.0, 2.0, 0.5]), np.array([1.0, 0.3, 2.0])
    raster = np.stack([disc(*place) - 0.1 * disc(*-place) for place in position])
    together = merit(raster, position, area, change=change)
    mapped = jax.jit(jax.vmap(lambda *each: figures_of_merit(each[0], EXTENT, each[1], area=each[2], change=each[3])))(
        raster, position, area, change
    )
    for k in range(3):
        alone = merit(raster[k], position[k], area[k], change=change[k])
        for field in FIELDS:
            np.testing.assert_allclose(getattr(together, field)[k], getattr(alone, field), rtol=1e-12, atol=1e-15)
            np.testing.assert_allclose(getattr(mapped, field)[k], getattr(alone, field), rtol=1e-12, atol=1e-15)


def test_the_text_states_the_position_error_in_millimetres_and_medians_of_several_targets():
    one = FiguresOfMerit(*map(np.asarray, (0.9, -2.5e-3, 0.25, 0.125, 0.5, 0.04, 0.1)))
    assert repr(one) == (
        "FiguresOfMerit(amplitude response 0.9, position error -2.5 mm,\n  resolution 0.25, shape deformation 0.125, "
        "ringing 0.5)"
    )
    three = FiguresOfMerit(*(np.array([0.0, 1.0, 5.0]) * value for value in (0.9, -2.5e-3, 0.25, 0.125, 0.5, 0.04, 1)))
    assert repr(three) == repr(one).replace("(amplitude", "(medians of 3 targets: amplitude")


def test_images_of_another_toolkit(reference_folder):
    """Its pixels' centres span the extent, those here lie half a pixel inside it; its ringing is about Q instead of
    C."""
    numbers = scipy.io.loadmat(reference_folder / "greit.mat", spmatrix=False)
    expected = dict(zip(FIELDS, numbers["figures_of_merit"], strict=False))
    edge = 32 / 31
    raster, position = jnp.moveaxis(jnp.asarray(numbers["images32"]), -1, 0), jnp.asarray(numbers["xyzr"][:2].T)
    found = figures_of_merit(raster, (-edge, edge, -edge, edge), position, area=1.0)
    response = found.amplitude_response / found.amplitude_response[0]
    np.testing.assert_allclose(response, expected["amplitude_response"], rtol=1e-9)
    # Its position is relative to the origin; the centroid of the body's pixels is near it.
    np.testing.assert_allclose(found.position_error, expected["position_error"], atol=1e-3)
    np.testing.assert_allclose(found.resolution, expected["resolution"], rtol=1e-9)
    np.testing.assert_allclose(found.ringing, expected["ringing"], atol=0.02)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"raster": np.ones(5)}, "raster has shape"),
        ({"raster": disc() * 1j}, "real"),
        ({"raster": image(np.nan)}, "no finite pixel"),
        ({"raster": np.stack([disc(), np.where(X > 0.05, np.nan, disc())]), "position": np.zeros((2, 2))}, "different"),
        ({"position": np.zeros((2, 2))}, "position has shape"),
        ({"position": np.array([30.0, 0.0])}, "both in metres"),
        ({"area": 0.0}, "area"),
        ({"area": np.ones(3)}, "area has shape"),
        ({"change": 0.0}, "change"),
        ({"change": np.nan}, "change"),
        ({"extent": (0.1, -0.1, -0.1, 0.1)}, "extent"),
    ],
)
def test_bad_input(changed, message):
    arguments = {"raster": disc(), "extent": EXTENT, "position": np.zeros(2), "area": AREA, **changed}
    with pytest.raises(ValueError, match=message):
        figures_of_merit(**arguments)
