"""From intensities to places and statuses: each status where it applies, and faults that are reported and handled."""

from types import SimpleNamespace

import equinox as eqx
import numpy as np
import pytest
from microphone_arrays import array, inside, noisy, received_power

from jeit.acoustic import Calibration, Intensities, Localiser, cramer_rao, locate
from jeit.acoustic.localisation.locations import Locations, LocationStatus

FRAMES, PAIRS = 64, 24
FLOOR, FREEDOM = 0.01, 50.0


def calibration(microphone_array, usable=None, reasons=None):
    count = len(microphone_array.microphones)
    good = np.ones(count, bool) if usable is None else usable
    return Calibration(microphone_array, good, reasons or ("",) * count, np.zeros((2, count)), None, "array")


@pytest.fixture(scope="module")
def microphone_array():
    return array(9, relative=0.05, floor=FLOOR, freedom=FREEDOM)


@pytest.fixture(scope="module")
def known(microphone_array):
    return calibration(microphone_array)


@pytest.fixture
def in_numpy(monkeypatch):
    """Exchanges are searched in NumPy, in a third of the frames: programs for all of them take seconds to compile."""
    monkeypatch.setattr("jeit.acoustic.localisation.array_changes._NUM_SEARCHED_FRAMES", 8)
    create = Localiser.create
    fixed = SimpleNamespace(create=lambda array: create(array, compiled=False))
    monkeypatch.setattr("jeit.acoustic.localisation.array_changes.Localiser", fixed)


def intensities_of(power, *, floor=FLOOR, freedom=FREEDOM, **options):
    count = power.shape[1]
    times = 0.05 * np.arange(len(power))
    if floor == 0:
        return Intensities(times, power, **options)
    return Intensities(times, power, floor=np.full(count, floor), freedom=freedom, **options)


def silence(number, count=9, seed=0):
    """Windows of noise alone, with the floor subtracted: chi-square."""
    draws = np.random.default_rng(seed).chisquare(FREEDOM, (number, count))
    return FLOOR * (draws / FREEDOM - 1)


@pytest.fixture(scope="module")
def touches(microphone_array):
    """64 touches all over the skin, with strengths over a factor of ten."""
    places = inside(FRAMES, reach=0.7)
    rng = np.random.default_rng(1)
    return places, noisy(
        microphone_array.noise, received_power(microphone_array, places, np.exp(rng.uniform(0, 2.3, FRAMES))), rng
    )


@pytest.fixture(scope="module")
def located(known, touches):
    """The results for the touches."""
    return locate(intensities_of(touches[1], name="desk", overlap=4.0), known)


@pytest.fixture(scope="module")
def located_with_fixed_gains(known, touches):
    return locate(intensities_of(touches[1]), known, gain_drift=0)


def coverage(found, places, frames=slice(None)):
    error = (found.position - places)[frames]
    square = np.einsum("fi,fij,fj->f", error, np.linalg.inv(found.covariance[frames]), error)
    return np.mean(square < 5.991)


def test_touches(located, touches):
    places, found = touches[0], located
    # One in ten thousand is reported as a misfit, and places near the edge may be reported as outside.
    assert np.mean(found.status == "touch") > 0.95
    assert found.counts()["touch"] == (found.status == "touch").sum()
    assert found.has_position.all()
    # From 64 draws: 0.95 to about 0.08, and slightly less near the edge.
    assert coverage(found, places) > 0.85
    assert np.median(np.linalg.norm(found.position - places, axis=1)) < 0.003
    assert found.used.all()
    assert (found.freedom == 6).all()
    assert found.faults == ("",) * 9
    assert found.notes == ()
    assert found.name == "desk"
    np.testing.assert_array_equal(found.times, 0.05 * np.arange(FRAMES))
    assert found.overlap == 4  # that of the measurement
    assert np.isnan(found.second).all()
    assert np.isnan(found.second_strength).all()


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_any_unit(scale, known, touches, located):
    """Intensities and their floor in another unit give the same places."""
    plain, other = located, locate(intensities_of(scale * touches[1], floor=scale * FLOOR), known)
    np.testing.assert_allclose(other.position, plain.position, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(other.strength, scale * plain.strength, rtol=1e-6)
    np.testing.assert_array_equal(other.status, plain.status)


def test_silence_is_no_touch(known):
    """A thousand windows of silence, and silence between touches."""
    found = locate(intensities_of(silence(1000)), known)
    assert found.counts() == {"no touch": 1000}
    assert not found.has_position.any()
    for values in (found.position, found.covariance, found.strength, found.misfit):
        assert np.isnan(values).all()
    assert found.notes == ()


def test_silence_between_touches(known, touches):
    power = touches[1].copy()
    quiet = np.arange(FRAMES) % 3 == 0
    power[quiet] = silence(quiet.sum())
    found = locate(intensities_of(power), known)
    assert (found.status[quiet] == "no touch").all()
    assert (found.status[~quiet] != "no touch").all()
    np.testing.assert_array_equal(found.has_position, ~quiet)


def test_frames_of_zeros_are_no_touch(known, touches):
    """Intensities of unknown floor."""
    power = touches[1].copy()
    power[10:20] = 0
    power[20:25] *= 1e-9
    found = locate(intensities_of(power, floor=0), calibration(array(9, relative=0.05)))
    assert (found.status[10:25] == "no touch").all()
    assert found.has_position.sum() == FRAMES - 15


def test_all_zeros(known):
    """Every channel is then reported as dead."""
    with pytest.raises(
        ValueError, match=r"0 of 9 microphones can be used.*\. microphones 0-8: dead: every intensity is 0\.$"
    ):
        locate(intensities_of(np.zeros((10, 9)), floor=0), known)


def test_outside(known, microphone_array, in_numpy, monkeypatch):
    """Two to five centimetres outside: flagged, and located on the near side of the outline."""
    monkeypatch.setattr("jeit.acoustic.localisation.array_changes._NUM_SEARCHED_FRAMES", 24)
    along = np.linspace(-0.08, 0.08, 16)
    beyond = np.concatenate(
        [np.stack([along, np.full(16, sign * 0.14)], axis=1)[:, ::step] for sign in (1, -1) for step in (1, -1)]
    )
    power = noisy(microphone_array.noise, received_power(microphone_array, beyond, 10.0), np.random.default_rng(2))
    found = locate(intensities_of(power), known)
    assert np.mean(found.status == "outside") > 0.95
    assert np.mean(np.abs(np.abs(found.position).max(axis=1) - 0.1) < 1e-9) > 0.95
    nearest = np.clip(beyond, -0.1, 0.1)
    # The place is not the nearest one: a source 2 cm outside the corner microphones is located somewhat to the side.
    assert np.median(np.linalg.norm(found.position - nearest, axis=1)) < 0.015
    # With so many touches outside the outline the search for exchanged microphones runs. None is exchanged.
    assert found.notes == ()


def pair_of_places():
    """On either side of the centre, some 10 cm apart."""
    aside = np.array([0.04, 0.03])
    return inside(PAIRS, seed=4, reach=0.3) - aside, inside(PAIRS, seed=5, reach=0.3) + aside


def test_two_touches(known, microphone_array, in_numpy):
    """Both are located within millimetres, the stronger first."""
    rng = np.random.default_rng(3)
    first, second = pair_of_places()
    power = received_power(microphone_array, first, 8.0) + received_power(microphone_array, second, 5.0)
    found = locate(intensities_of(noisy(microphone_array.noise, power, rng)), known)
    both = found.status == "two touches"
    assert both.sum() > 0.7 * PAIRS
    error = np.stack([found.position - first, found.second - second], axis=1)[both]
    crossed = np.stack([found.position - second, found.second - first], axis=1)[both]
    best = np.minimum(np.linalg.norm(error, axis=-1).max(axis=1), np.linalg.norm(crossed, axis=-1).max(axis=1))
    assert np.median(best) < 0.005
    assert (found.strength[both] >= found.second_strength[both]).all()
    assert (found.freedom[both] == 3).all()
    assert np.isnan(found.second[~both]).all()


def test_exact_two_touches(known, in_numpy):
    """Without noise: to a micrometre."""
    microphone_array = array(9, relative=0.01)
    first, second = pair_of_places()
    power = received_power(microphone_array, first, 8.0) + received_power(microphone_array, second, 5.0)
    found = locate(intensities_of(power, floor=0), calibration(microphone_array), gain_drift=0)
    both = found.status == "two touches"
    # One in ten looks, to a single source, as if from outside the outline, and is reported as such.
    assert both.mean() > 0.8
    assert set(found.status) <= {"two touches", "outside"}
    error = np.linalg.norm(found.position - first, axis=1) + np.linalg.norm(found.second - second, axis=1)
    assert np.mean(error[both] < 1e-6) > 0.95


def test_ambiguous():
    """Four microphones on a line do not distinguish its two sides: one of the mirror images is found, reported as
    ambiguous.
    """
    line = np.array([[-0.07, 0.0], [-0.02, 0.0], [0.03, 0.0], [0.08, 0.0]])
    microphone_array = array(4, microphones=line, relative=0.05, floor=FLOOR, freedom=FREEDOM)
    places = inside(FRAMES, seed=6, reach=0.7)
    places = places[np.abs(places[:, 1]) > 0.025]
    power = noisy(microphone_array.noise, received_power(microphone_array, places, 10.0), np.random.default_rng(7))
    found = locate(intensities_of(power), calibration(microphone_array))
    inside_ones = found.status != "outside"
    assert np.mean(found.status[inside_ones] == "ambiguous") > 0.9
    folded = np.stack([found.position[:, 0], np.abs(found.position[:, 1])], axis=1)
    error = np.linalg.norm(folded - np.stack([places[:, 0], np.abs(places[:, 1])], axis=1), axis=1)
    assert np.median(error) < 0.01


def test_misfit(known, in_numpy):
    """Random intensities fit no source: this is reported, and the covariance is widened accordingly."""
    power = np.exp(np.random.default_rng(8).normal(size=(PAIRS, 9)))
    found = locate(intensities_of(power), known, gain_drift=0)
    assert np.isin(found.status, ["misfit", "outside", "two touches"]).all()
    wrong = found.status == "misfit"
    assert wrong.mean() > 0.5
    bound = cramer_rao(known.microphone_array, found.position[wrong], found.strength[wrong])
    wider = np.trace(found.covariance[wrong], axis1=1, axis2=2) / np.trace(bound, axis1=1, axis2=2)
    np.testing.assert_allclose(wider, found.misfit[wrong] / found.freedom[wrong], rtol=1e-6)
    assert (wider > 4).all()  # chi-square of 6 degrees of freedom exceeds 27.9 with a probability of 1e-4
    assert any("is this the calibration of this array" in note for note in found.notes)


def test_unusable_frames(known, touches, located_with_fixed_gains):
    """Two readings are not enough. Three are."""
    power = touches[1].copy()
    power[5, 2:] = np.nan
    power[6] = np.nan
    power[7, 3:] = np.nan
    found = locate(intensities_of(power), known, gain_drift=0)
    assert (found.status[[5, 6]] == "unusable").all()
    assert found.status[7] != "unusable"
    assert not found.has_position[[5, 6]].any()
    assert found.has_position.sum() == FRAMES - 2
    np.testing.assert_array_equal(found.used[5], np.arange(9) < 2)
    others = np.setdiff1d(np.arange(FRAMES), [5, 6, 7])
    whole = located_with_fixed_gains
    np.testing.assert_allclose(found.position[others], whole.position[others], rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(found.status[others], whole.status[others])
    assert "NaN or infinite in 3 of 64 windows" in found.faults[8]


def test_too_few_microphones(known, touches):
    power = touches[1].copy()
    power[:, 3:] = np.nan
    power[:, 2] = 0
    with pytest.raises(ValueError, match=r"'intensities': 2 of 9 microphones can be used.*microphone 2: dead"):
        locate(intensities_of(power), known)


def test_another_number_of_microphones(known):
    with pytest.raises(ValueError, match=r"'intensities' has 8 microphones and the calibration 'array' 9"):
        locate(intensities_of(np.ones((4, 8))), known)


@pytest.mark.parametrize("dead", [2, 4, *(pytest.param(number, marks=pytest.mark.slow) for number in (1, 3, 5))])
def test_dead_microphones(dead, microphone_array):
    """Exact data stay exact, noisy ones have errors near the bound for the rest, and the faults are reported."""
    places = inside(FRAMES, seed=9, reach=0.6)
    gone = np.array([4, 0, 7, 2, 5])[:dead]
    exact = array(9)
    power = received_power(exact, places)
    power[:, gone[::2]] = 0
    power[:, gone[1::2]] = np.nan
    found = locate(intensities_of(power, floor=0), calibration(exact))
    error = np.linalg.norm(found.position - places, axis=1)
    clear = ~np.isin(found.status, ["ambiguous"])
    assert error[clear].max() < 1e-6
    assert clear.mean() > 0.9
    np.testing.assert_array_equal(found.used, np.broadcast_to(~np.isin(np.arange(9), gone), (FRAMES, 9)))
    for k in range(9):
        expected = "" if k not in gone else "dead: every intensity is " + ("0" if k in gone[::2] else "NaN or infinite")
        assert found.faults[k] == expected

    received = received_power(microphone_array, places, 10.0)
    received[:, gone] = np.nan
    found = locate(
        intensities_of(noisy(microphone_array.noise, received, np.random.default_rng(10))),
        calibration(microphone_array),
    )
    error = np.linalg.norm(found.position - places, axis=1)
    bound = cramer_rao(microphone_array, places, 10.0, use=~np.isin(np.arange(9), gone))
    typical = np.median(error / np.sqrt(np.trace(bound, axis1=1, axis2=2)))
    # The median length of a plane normal error is 0.83 of its root mean square if isotropic, 0.67 if on a line.
    assert 0.5 < typical < 1.1
    assert np.median(error) < 0.01


def test_an_uncalibrated_microphone_is_not_used(microphone_array, touches):
    usable = np.arange(9) != 3
    reasons = tuple("" if good else "its intensity does not fall with distance" for good in usable)
    power = touches[1].copy()
    power[:, 3] = 1e6
    power[0, 3] = np.nan
    found = locate(intensities_of(power), calibration(microphone_array, usable, reasons))
    assert not found.used[:, 3].any()
    assert found.used[:, usable].all()
    assert found.faults[3] == (
        "NaN or infinite in 1 of 64 windows; not calibrated: its intensity does not fall with distance"
    )
    assert np.median(np.linalg.norm(found.position - touches[0], axis=1)) < 0.003
    assert coverage(found, touches[0]) > 0.85


def test_exchanged_microphones_are_named(known, touches, in_numpy):
    order = np.arange(9)
    order[[2, 6]] = [6, 2]
    found = locate(intensities_of(touches[1][:24, order]), known)
    assert len(found.notes) == 1
    assert found.notes[0].startswith("microphones 2 and 6 look exchanged")
    assert np.isin(found.status, ["misfit", "outside", "two touches"]).mean() > 0.3


@pytest.mark.parametrize("method", ["likelihood", "consistency"])
def test_exact_data(method):
    """Both methods are exact all over the skin, with the same statuses."""
    microphone_array, places = array(9), inside(FRAMES, seed=11)
    found = locate(
        intensities_of(received_power(microphone_array, places), floor=0), calibration(microphone_array), method=method
    )
    np.testing.assert_allclose(found.position, places, atol=1e-6)
    np.testing.assert_allclose(found.strength, 1.0, rtol=1e-6)
    assert (found.status == "touch").all()
    assert found.misfit.max() < 1e-6


def test_results_of_the_papers_loss_are_judged_by_the_likelihood(known, touches, located):
    """The same misfits and statuses, at other places."""
    mine, papers = located, locate(intensities_of(touches[1]), known, method="consistency")
    np.testing.assert_array_equal(papers.status, mine.status)
    np.testing.assert_allclose(papers.misfit, mine.misfit)
    apart = np.linalg.norm(papers.position - mine.position, axis=1)
    assert 1e-5 < np.median(apart) < 0.01
    assert np.median(np.linalg.norm(papers.position - touches[0], axis=1)) < 0.01


@pytest.mark.slow
def test_a_fine_raster_gives_the_same_places(known, touches, located):
    """The paper's 200 × 200."""
    fine = locate(intensities_of(touches[1]), known, map_shape=(200, 200))
    apart = np.linalg.norm(fine.position - located.position, axis=1)
    assert np.mean(apart < 1e-6) > 0.95


def test_noise_is_estimated_from_negative_intensities():
    """No floor is given, and silence scatters about zero: it is still no touch, and touches are located."""
    microphone_array = array(9, relative=0.05)
    places = inside(32, seed=12, reach=0.7)
    rng = np.random.default_rng(13)
    power = np.concatenate([received_power(microphone_array, places), np.zeros((32, 9))]) + 0.01 * rng.normal(
        size=(64, 9)
    )
    found = locate(intensities_of(power, floor=0), calibration(microphone_array))
    assert (found.status[32:] == "no touch").all()
    assert found.has_position[:32].all()
    assert np.median(np.linalg.norm(found.position[:32] - places, axis=1)) < 0.004
    assert coverage(found, np.concatenate([places, places]), slice(0, 32)) > 0.8


def test_frames_do_not_depend_on_each_other(known, touches, located_with_fixed_gains):
    """Apart from notes and gains, which concern all frames: part of the frames gives the same results as the whole."""
    whole = located_with_fixed_gains
    for part in (slice(0, 33), slice(31, 64)):
        some = locate(intensities_of(touches[1][part]), known, gain_drift=0)
        np.testing.assert_allclose(some.position, whole.position[part], rtol=1e-6, atol=1e-9)
        np.testing.assert_array_equal(some.status, whole.status[part])


def test_every_status_is_documented():
    for status in LocationStatus:
        assert f'"{status}"' in Locations.__doc__


@pytest.mark.parametrize(
    ("options", "message"), [({"method": "magic"}, "consistency"), ({"map_shape": (1, 1)}, "rows")]
)
def test_bad_options(options, message, known, touches):
    with pytest.raises(ValueError, match=message):
        locate(intensities_of(touches[1][:2]), known, **options)


def test_a_place_that_is_not_determined_is_ambiguous():
    """Covariances wider than the skin, or undefined, are bounded, and such places are not reported as touches."""
    from jeit.acoustic.localisation.locate import _limit_uncertainty

    status = np.array(["touch", "touch", "touch", "outside"], object)
    covariance = np.stack([1e-6 * np.eye(2), np.full((2, 2), np.nan), 4e10 * np.ones((2, 2)), np.full((2, 2), np.nan)])
    result = {"position": np.zeros((4, 2)), "covariance": covariance}
    _limit_uncertainty(status, result, 0.2)
    assert list(status) == ["touch", "ambiguous", "ambiguous", "outside"]
    np.testing.assert_allclose(result["covariance"][1:], np.broadcast_to(0.01 * np.eye(2), (3, 2, 2)))
    np.testing.assert_allclose(result["covariance"][0], 1e-6 * np.eye(2))


@pytest.mark.parametrize(
    ("scale", "beginning"),
    [(1e-9, "touches are 1e-08 times"), (1e9, "touches are 1e+08 times"), (1e-3, ""), (1e3, "")],
)
def test_another_unit_is_noted(scale, beginning, known, touches, located):
    """Beyond 40 dB from the taps. A smaller difference may be a light touch or a blow."""
    typical = float(np.median(located.strength))
    known_strengths = eqx.tree_at(
        lambda one: one.strengths, known, (0.1 * typical, 10 * typical), is_leaf=lambda one: one is None
    )
    scaled = intensities_of(scale * touches[1], floor=scale * FLOOR)
    notes = locate(scaled, known_strengths, gain_drift=0).notes
    assert [note.startswith(beginning) and note.endswith("same gain and unit?") for note in notes] == [True] * bool(
        beginning
    )
    assert locate(scaled, known, gain_drift=0).notes == ()


def test_another_unit_is_noted_even_if_all_frames_are_below_the_noise():
    """Intensities of unknown floor, a billionth of the calibration's: less than its silence."""
    microphone_array = array(9, relative=0.05, deviation=0.01)
    rng = np.random.default_rng(14)
    power = received_power(microphone_array, inside(32, seed=12)) + 0.01 * rng.normal(size=(32, 9))
    found = locate(intensities_of(1e-9 * power, floor=0), calibration(microphone_array))
    assert found.counts() == {"no touch": 32}
    assert "times as loud as the calibration's noise: do the recording" in found.notes[0]
    silent = locate(intensities_of(0.01 * rng.normal(size=(32, 9)), floor=0), calibration(microphone_array))
    assert silent.counts() == {"no touch": 32}
    assert silent.notes == ()
