"""Errors for arguments of another kind, raised before any computation."""

import numpy as np
import pytest
from microphone_arrays import array, models

from jeit.acoustic import (
    Calibration,
    Intensities,
    Localiser,
    Recording,
    calibrate_microphones,
    cramer_rao,
    intensities,
    locate,
    locate_touches,
    tap_intensities,
    track,
)
from jeit.acoustic.surface import make_surface

INTENSITIES = Intensities([0.0], np.ones((1, 9)))
SOUND = Recording(np.ones((9, 400)), 1e3)


@pytest.fixture(scope="module")
def known():
    return Calibration(array(9), np.ones(9, bool), ("",) * 9, np.zeros((2, 9)), None, "array")


@pytest.mark.parametrize("find", [locate, locate_touches])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"recording": "touches.wav"}, r"^recording must be a Recording or Intensities, .*; it is 'touches\.wav'"),
        ({"recording": np.ones((9, 400))}, "^recording must be .*; it is an array of float64"),
        ({"recording": None}, "^recording must be .*; it is None"),
        ({"recording": "touches.wav", "intensity": 50.0}, "^recording must be"),
        ({"calibration": "skin.json"}, r"^calibration must be a Calibration, as of .*; it is 'skin\.json'"),
        ({"calibration": models}, "^calibration must be"),
        ({"silence": "hush.wav"}, r"^silence must be a Recording or .*; it is 'hush\.wav'"),
        ({"intensity": 50.0}, r"^intensity must be IntensitySettings, such as .*; it is 50\.0"),
        ({"method": "liklihood"}, r"^method must be one of .*; it is 'liklihood' \(did you mean 'likelihood'\?\)"),
    ],
)
def test_bad_arguments_of_locate(known, find, change, message):
    sound = INTENSITIES if "method" in change else SOUND
    with pytest.raises(ValueError, match=message):
        find(**({"recording": sound, "calibration": known} | change))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: calibrate_microphones("taps.npz"), r"^taps must be Taps, as of read_taps\(path\); it is 'taps\.npz'"),
        (lambda: calibrate_microphones(SOUND), "^taps must be Taps, .*; it is a Recording"),
        (lambda: intensities("a.wav"), r"^recording must be a Recording of samples, .*; it is 'a\.wav'"),
        (lambda: intensities(SOUND, 50.0), "^settings must be IntensitySettings"),
        (lambda: tap_intensities("taps.npz"), "^taps must be Taps"),
        (lambda: track(INTENSITIES), "^locations must be Locations, .*; it is an Intensities"),
        (lambda: Localiser.create("skin.json"), r"^microphone_array must be a MicrophoneArray, .*; it is 'skin\.json'"),
        (lambda: cramer_rao(np.ones((9, 2)), [[0.0, 0.0]]), "^microphone_array must be a MicrophoneArray"),
        (lambda: make_surface("square"), "^outline must be an outline, such as .*; it is 'square'"),
    ],
)
def test_bad_arguments_of_other_functions(make, message):
    with pytest.raises(ValueError, match=message):
        make()
