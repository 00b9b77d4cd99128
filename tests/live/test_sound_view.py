"""The view of microphones against `locate` and `Localiser.maps` on the same intensities."""

import numpy as np
import pytest

from jeit.acoustic import Calibration, Intensities, Localiser, MicrophoneArray, locate
from jeit.acoustic.decay import InverseSquare
from jeit.acoustic.microphones import IntensityNoise
from jeit.acoustic.surface import make_surface
from jeit.layout import grid
from jeit.live import LiveFrame
from jeit.live.views.sound import SoundView

MICROPHONES, FLOOR, FREEDOM = grid(0.14, 0.14, 3, 3), np.full(9, 0.01), 50.0
OUTLINE = np.array([[-0.12, -0.1], [0.12, -0.1], [0.12, 0.1], [-0.12, 0.1]])
PLACES = np.array([[0.03, 0.05], [-0.06, 0.01], [0.0, -0.04]])


@pytest.fixture(scope="module")
def calibration():
    noise = IntensityNoise.create(9, relative=0.05, floor=FLOOR, freedom=FREEDOM)
    decay = InverseSquare(np.full(9, 1e-3), np.full(9, 1e-3))
    array = MicrophoneArray(MICROPHONES, make_surface(OUTLINE), decay, noise)
    return Calibration(array, np.ones(9, bool), ("",) * 9, np.zeros((2, 9)), None, "array")


@pytest.fixture(scope="module")
def power():
    """Three touches, silence, and two at once, with noise."""
    squared = ((PLACES[:, None] - MICROPHONES) ** 2).sum(axis=-1)
    each = 5e-3 / (squared + 1e-3) * np.exp(0.05 * np.random.default_rng(0).normal(size=squared.shape))
    return np.concatenate([each, np.zeros((1, 9)), each[1:2] + each[:1]])


@pytest.mark.parametrize("method", ["likelihood", "consistency"])
def test_places_equal_those_of_locate(calibration, power, method):
    """One frame at a time against all at once. Pixels against the maps, which are lowest near the place."""
    view = SoundView(calibration, method=method, floor=FLOOR, freedom=FREEDOM)
    intensities = Intensities(0.05 * np.arange(5), power, floor=FLOOR, freedom=FREEDOM)
    found = locate(intensities, calibration, method=method, gain_drift=0.0, compiled=False)
    shape = view.scene.extent[3] / view.scene.extent[1]
    for number, values in enumerate(power):
        picture = view.picture(LiveFrame(number, 0.05 * number, 0.0, values))
        if found.status[number] == "no touch":
            assert (picture.status, picture.pixels) == ("unchanged", None)
            continue
        places = [one[number] for one in (found.position, found.second) if np.isfinite(one[number]).all()]
        np.testing.assert_allclose([(one.x, one.y) for one in picture.markers], places, rtol=1e-6, atol=1e-9)
        assert bool(picture.reason) == (found.status[number] != "touch")
        rows, columns = picture.pixels.shape
        assert rows / columns == pytest.approx(shape, abs=0.02)
        (loss,) = Localiser.create(
            calibration.microphone_array, method=method, map_shape=(rows, columns), compiled=False
        ).maps(values[None])
        loss = np.asarray(loss)[::-1]
        expected = np.sqrt(2 * (loss - loss.min())) if method == "likelihood" else loss
        np.testing.assert_allclose(picture.pixels, expected, rtol=1e-4, atol=1e-3 * expected.max())
        if number < 3:
            row, column = np.unravel_index(np.argmin(picture.pixels), picture.pixels.shape)
            x, y = -0.12 + 0.24 * (column + 0.5) / columns, 0.1 - 0.2 * (row + 0.5) / rows
            assert np.hypot(x - PLACES[number, 0], y - PLACES[number, 1]) < 0.01
    assert sorted(set(found.status)) == ["no touch", "touch", "two touches"]


def test_faulty_frames_are_refused_and_missing_microphones_are_left_out(calibration, power):
    view = SoundView(calibration, floor=FLOOR, freedom=FREEDOM)
    lost = np.where(np.arange(9) < 2, np.nan, power[0])
    for values, reason in (("text", "text"), (power[0, :8], "8 numbers"), (np.full(9, np.nan), "three")):
        picture = view.picture(LiveFrame(0, 0.0, 0.0, values))
        assert (picture.status, reason in picture.reason) == ("refused", True)
    (marker,) = view.picture(LiveFrame(1, 0.1, 0.0, lost)).markers
    assert np.hypot(marker.x - 0.03, marker.y - 0.05) < 0.01


def test_silence_is_subtracted(calibration, power):
    view = SoundView(calibration, floor=FLOOR, freedom=FREEDOM)
    clean = view.picture(LiveFrame(0, 0.0, 0.0, power[0]))
    view.set_reference(np.full((5, 9), 0.3))
    raised = view.picture(LiveFrame(0, 0.0, 0.0, power[0] + 0.3))
    np.testing.assert_allclose(raised.markers[0].x, clean.markers[0].x, rtol=1e-6)
    with pytest.raises(ValueError, match="all 9 microphones"):
        view.set_reference(np.ones((5, 8)))
