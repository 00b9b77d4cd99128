"""Changes since the calibration: detected and named, and not reported where there are none."""

import functools

import numpy as np
import pytest
from microphone_arrays import array, inside, noisy, received_power

from jeit.acoustic import Localiser
from jeit.acoustic.localisation import array_changes
from jeit.acoustic.localisation.array_changes import find_setup_changes

# test_locate has an exchange in the quick suite, with the compiled program.
pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def in_numpy(monkeypatch):
    """As many frames as trial changes: each number needs a large program, with the same results as NumPy."""
    monkeypatch.setattr(array_changes.Localiser, "create", functools.partial(Localiser.create, compiled=False))


def frames(number=24, noise=0.05, seed=0):
    microphone_array = array(9, relative=noise)
    rng = np.random.default_rng(seed)
    power = received_power(microphone_array, inside(number, seed=seed), np.exp(rng.normal(size=number)))
    return microphone_array, noisy(microphone_array.noise, power, rng)


def swapped(power, *pairs):
    order = np.arange(power.shape[1])
    for one, other in pairs:
        order[[one, other]] = order[[other, one]]
    return power[:, order]


def found(microphone_array, power):
    """Exchanged pairs, where nothing else is changed."""
    exchanged, altered = find_setup_changes(microphone_array, power, np.isfinite(power))
    assert altered == []
    return exchanged


@pytest.mark.parametrize("factor", [0.02, 30.0])
def test_a_changed_gain_is_not_reported_as_an_exchange(factor):
    """A microphone that is insensitive or too loud is named as such."""
    microphone_array, power = frames()
    power[:, 4] *= factor
    assert find_setup_changes(microphone_array, power, np.isfinite(power)) == ([], [4])


def test_of_five_microphones_none_is_left_out():
    """Four explain any data: leaving one out proves nothing."""
    microphone_array, power = frames()
    power[:, 5:] = np.nan
    power[:, 4] *= 0.02
    assert find_setup_changes(microphone_array, power, np.isfinite(power)).altered_microphones == []


@pytest.mark.parametrize("pair", [(0, 8), (3, 4), (1, 2)])
def test_one_exchange(pair):
    microphone_array, power = frames()
    assert found(microphone_array, swapped(power, pair)) == [pair]


def test_no_exchange():
    """Neither in good data, nor in few frames, nor where microphones are missing."""
    microphone_array, power = frames()
    assert found(microphone_array, power) == []
    power[3:9, 5] = np.nan
    assert found(microphone_array, power) == []


def test_another_array_is_not_reported_as_an_exchange():
    """Where nothing fits, no exchange makes it fit."""
    microphone_array, power = frames()
    rubbish = np.exp(np.random.default_rng(1).normal(size=power.shape))
    assert found(microphone_array, rubbish) == []


def test_three_frames_are_needed():
    microphone_array, power = frames()
    exchanged = swapped(power, (0, 8))
    assert found(microphone_array, exchanged[:2]) == []
    assert found(microphone_array, exchanged[:3]) == [(0, 8)]


def test_the_loudest_frames_are_used():
    """Two dozen of many: silence, which fits anything or nothing, does not hide the exchange."""
    microphone_array, power = frames()
    silence = 1e-6 * np.abs(np.random.default_rng(2).normal(size=(200, 9)))
    mixed = np.concatenate([silence, swapped(power, (2, 6))])
    assert found(microphone_array, mixed) == [(2, 6)]


def test_a_dead_microphone_is_not_named():
    microphone_array, power = frames()
    exchanged = swapped(power, (0, 8))
    exchanged[:, 4] = np.nan
    assert found(microphone_array, exchanged) == [(0, 8)]


def test_two_exchanges():
    """The one that explains most is first."""
    microphone_array, power = frames()
    assert set(found(microphone_array, swapped(power, (0, 8), (1, 3)))) == {(0, 8), (1, 3)}


def test_any_exchange_of_nine_microphones(monkeypatch):
    """All 36 pairs are found, and no other is named, nor any without an exchange (of every third array)."""
    monkeypatch.undo()  # one program for all
    for seed, pair in enumerate([(a, b) for a in range(9) for b in range(a + 1, 9)]):
        microphone_array, power = frames(12, seed=seed)
        assert found(microphone_array, swapped(power, pair)) == [pair]
        if seed % 3 == 0:
            assert found(microphone_array, power) == []
