"""A separate recording of silence for a recording without pauses, on the simulated skin."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from microphone_arrays import MICROPHONES, OUTLINE

from jeit.acoustic import Calibration, IntensitySettings, MicrophoneArray, Recording, intensities, locate
from jeit.acoustic.calibration.calibration import calibrated_intensities
from jeit.acoustic.decay import InverseSquare
from jeit.acoustic.microphones import IntensityNoise
from jeit.acoustic.simulate import SoundingSkin, simulate_silence
from jeit.acoustic.simulate.propagation import expected_power, transfer
from jeit.acoustic.surface import make_surface
from jeit.layout import grid

PLACE = np.array([0.02, -0.03])


def recorded(skin, samples, name="recording"):
    return Recording(samples, skin.rate, name=name)


@pytest.fixture(scope="module")
def skin():
    return SoundingSkin(jax.random.key(0), MICROPHONES[9])


@pytest.fixture(scope="module")
def calibrated_before(skin):
    """A calibration of the simulated skin: 1 / f = (r² + b) / a by linear least squares, and the floor of silence."""
    places = grid(0.18, 0.18, 7, 7)
    power = expected_power(skin, places)
    squared = ((places[:, None] - MICROPHONES[9]) ** 2).sum(axis=-1)
    models = []
    for f, r2 in zip(power.T, squared.T, strict=True):
        slope, constant = np.linalg.lstsq(np.stack([r2 * f, f], axis=1), np.ones(len(f)), rcond=None)[0]
        models.append((1 / slope, constant / slope))
    a, b = np.transpose(models)
    silent = intensities(recorded(skin, simulate_silence(skin, jax.random.key(1)).samples))
    noise = IntensityNoise.create(9, floor=silent.floor, freedom=silent.freedom, relative=0.3)
    microphone_array = MicrophoneArray(
        jnp.asarray(MICROPHONES[9]), make_surface(OUTLINE), InverseSquare(jnp.asarray(a), jnp.asarray(b)), noise
    )
    return eqx.tree_at(
        lambda one: one.intensity,
        Calibration(microphone_array, np.ones(9, bool), ("",) * 9, np.zeros((2, 9)), None, "array"),
        IntensitySettings(),
        is_leaf=lambda one: one is None,
    )


@pytest.fixture(scope="module")
def vibration(skin):
    """A motor that shakes the skin at `PLACE` all the time: tones every 20 Hz, so that all windows are alike."""
    times, tones = np.arange(10_000) / skin.rate, np.arange(80.0, 800.0, 20.0)
    phases = np.exp(2j * np.pi * np.random.default_rng(1).random(len(tones)))
    waves = np.exp(2j * np.pi * tones[:, None] * times)
    calibrated_tones = np.real(np.asarray(transfer(skin, jnp.asarray(tones), jnp.asarray(PLACE))) * phases @ waves)
    return recorded(skin, calibrated_tones + simulate_silence(skin, jax.random.key(2)).samples)


@pytest.fixture(scope="module")
def silent(skin):
    return recorded(skin, simulate_silence(skin, jax.random.key(3)).samples, "hush")


def test_a_touch_without_pauses(vibration, silent, calibrated_before):
    """It is taken for silence, and a note says so and what to do. With the recording of silence it is located all the
    time.
    """
    lost = locate(vibration, calibrated_before)
    assert lost.counts() == {"no touch": len(lost.times)}
    (note,) = lost.notes
    assert note.startswith("microphones ")
    assert "times the calibration's. If the recording never pauses" in note
    assert "silence=" in note
    found = locate(vibration, calibrated_before, silence=silent)
    assert found.notes == ()
    assert found.has_position.all()
    assert np.isin(found.status, ["touch", "ambiguous"]).all()
    # Nine microphones 7 cm apart, and a model without echoes.
    assert np.median(np.linalg.norm(found.position - PLACE, axis=1)) < 0.012
    np.testing.assert_allclose(
        calibrated_intensities(vibration, calibrated_before, silence=silent).floor, intensities(silent).floor
    )


def test_a_floor_is_compared_with_a_floor_of_the_same_kind(skin, vibration, silent, calibrated_before):
    """No note for silence as in the calibration, nor for taps as intensities. Another band is reported."""
    assert locate(silent, calibrated_before).notes == ()
    (note,) = locate(vibration, calibrated_before, intensity=IntensitySettings(high=900.0)).notes
    assert note.startswith("band or window are not the calibration's")
    of_intensities = eqx.tree_at(lambda one: one.intensity, calibrated_before, None)
    assert locate(vibration, of_intensities).notes == ()


def test_a_microphone_without_silence_is_not_used(skin, vibration, silent, calibrated_before):
    samples = silent.samples.copy()
    samples[4] = 0
    found = locate(vibration, calibrated_before, silence=recorded(skin, samples))
    assert found.faults[4] == "in the silence: dead: every sample is 0"
    assert not found.used[:, 4].any()
    assert found.used[:, :4].all()
    assert found.has_position.all()


def test_bad_silence(skin, vibration, silent, calibrated_before):
    with pytest.raises(ValueError, match=r"silence 'recording' is .* times as loud as the quietest windows of 'hush'"):
        locate(silent, calibrated_before, silence=recorded(skin, 3 * silent.samples))
    with pytest.raises(ValueError, match="'hush' has 8 microphones"):
        locate(vibration, calibrated_before, silence=recorded(skin, silent.samples[:8], "hush"))
    for pair in ((intensities(vibration), silent), (vibration, intensities(silent))):
        with pytest.raises(ValueError, match="silence applies to a recording of samples"):
            locate(pair[0], calibrated_before, silence=pair[1])
