"""Intensity: calibrated on sines and noise, its scatter given by the degrees of freedom, above a stable noise floor."""

import equinox as eqx
import numpy as np
import pytest

from jeit.acoustic.signal import intensity
from jeit.acoustic.signal.intensity import (
    IntensitySettings,
    degrees_of_freedom,
    intensities,
    noise_floor,
    tap_intensities,
)
from jeit.acoustic.signal.recording import Intensities, Recording, Taps

RATE = 20e3
OUTLINE = [[0, 0], [0.2, 0], [0.2, 0.2], [0, 0.2]]
# Odd lengths, edges between bins, the whole spectrum, a band from 0, and a band up to half the rate.
SETTINGS = [
    IntensitySettings(),
    IntensitySettings(low=33.3, high=871.0, window=0.0301, hop=0.01),
    IntensitySettings(low=300.0, high=RATE / 2, window=0.011, hop=0.003),
    IntensitySettings(low=0.0, high=700.0, window=0.04, hop=0.02),
]
TITLES = ["default", "odd", "to half the rate", "from zero"]


def white(shape, seed=0, deviation=1.0):
    return deviation * np.random.default_rng(seed).normal(size=shape)


@pytest.mark.parametrize("settings", SETTINGS, ids=TITLES)
@pytest.mark.parametrize("frequency", [520.0, 571.3])
def test_sine(settings, frequency):
    """A²/2 at any phase and any offset. From more than 2 bins within the band a Hann window leaks less than 1e-3."""
    time = np.arange(8000) / RATE
    amplitude = np.array([1e-3, 1.0, 30.0])
    samples = amplitude[:, None] * np.sin(2 * np.pi * frequency * time + np.arange(3)[:, None]) + [[0.5], [-1], [1000]]
    found = intensities(Recording(samples, RATE), settings, floor=np.zeros(3))
    np.testing.assert_allclose(found.power, np.broadcast_to(amplitude**2 / 2, found.power.shape), rtol=1e-3)
    np.testing.assert_array_equal(found.floor, 0)
    assert found.usable.all()
    assert found.faults == ("", "", "")
    assert found.overlap == round(settings.window * RATE) / round(settings.hop * RATE) > 1


@pytest.mark.parametrize("low", [0.0, 20.0])
def test_constants_have_no_intensity(low):
    """The mean of each window is subtracted: a microphone whose offset changes, and a band that begins at 0."""
    time = np.arange(8000) / RATE
    samples = np.sin(2 * np.pi * 520 * time) + np.where(time < 0.2, 50, -70)
    found = intensities(Recording(samples[None], RATE), IntensitySettings(low=low, hop=0.01), floor=np.zeros(1))
    steady = np.abs(found.times - 0.2) > 0.026
    np.testing.assert_allclose(found.power[steady], 0.5, rtol=1e-3)


def test_sine_outside_the_band():
    time = np.arange(8000) / RATE
    samples = np.stack([np.sin(2 * np.pi * f * time) for f in (2.0, 1300.0, 9000.0)])
    assert (intensities(Recording(samples, RATE), floor=np.zeros(3)).power < [[1e-3, 1e-6, 1e-9]]).all()


@pytest.mark.parametrize("settings", SETTINGS[:3], ids=TITLES[:3])
def test_white_noise(settings):
    """σ² · bandwidth / Nyquist, to three standard errors of the mean over some thousand independent windows."""
    found = intensities(Recording(white((20, 200_000), deviation=0.3), RATE), settings, floor=np.zeros(20))
    expected = 0.09 * (settings.high - settings.low) / (RATE / 2)
    error = np.sqrt(2 / found.freedom / (20 * 10 / settings.window))
    assert abs(found.power.mean() / expected - 1) < 3 * error
    assert error < 0.01


@pytest.mark.parametrize("settings", SETTINGS[:3], ids=TITLES[:3])
def test_freedom_of_white_noise(settings):
    """The exact sum against the matrix A itself, and against the scatter of many windows."""
    assert intensities(Recording(white((1, 4000)), RATE), settings).freedom == degrees_of_freedom(settings, RATE)
    length = round(settings.window * RATE)
    windows = white((3000, length), seed=1)
    power = intensities(Recording(windows.ravel()[None], RATE), eqx.tree_at(lambda s: s.hop, settings, settings.window))
    raw = power.power + power.floor
    measured = 2 * raw.mean() ** 2 / raw.var()
    # A variance from n windows is determined to √(2/n), 2.6 %.
    assert measured == pytest.approx(power.freedom, rel=0.1)


@pytest.mark.parametrize(("high", "length"), [(1333.0, 48), (4000.0, 48), (4000.0, 49)])
def test_freedom_is_the_trace(high, length):
    """(tr A)² / tr A², with A from the responses to unit samples: xᵀAx for e_i + e_j and e_i - e_j gives A_ij."""
    rate, hop = 8000.0, 16
    settings = IntensitySettings(low=260.0, high=high, window=length / rate, hop=hop / rate)
    grid = intensity.window_grid(settings, rate, None, "")

    one, other = np.eye(length)[:, None], np.eye(length)
    plus = intensity.band_power((one + other).reshape(-1, length), grid)
    minus = intensity.band_power((one - other).reshape(-1, length), grid)
    form = ((plus - minus) / 4).reshape(length, length)
    assert np.trace(form) ** 2 / (form**2).sum() == pytest.approx(degrees_of_freedom(settings, rate), rel=1e-9)
    # The same for windows that overlap: their correlation is tr(A B) / tr(A²), with B the form shifted by the hop.
    moved = np.zeros((2, length + hop, length + hop))
    moved[0, :length, :length] = moved[1, hop:, hop:] = form
    correlation = (moved[0] * moved[1]).sum() / (form**2).sum()
    shared = intensity.noise_correlation(grid, 5)
    assert shared[0, 1] == shared[3, 2] == pytest.approx(correlation, rel=1e-9)
    assert 0.2 < correlation < 0.9
    assert shared[0, 4] == shared[4, 0] == 0


def test_times_are_the_middles_of_windows():
    """A click is loudest in the window at whose middle it is."""
    settings = IntensitySettings(window=0.05, hop=0.005)
    samples = white((1, 20_000), deviation=1e-3)
    samples[0, 7300] = 1.0
    found = intensities(Recording(samples, RATE), settings)
    assert found.times[0] == pytest.approx(0.025)
    assert np.diff(found.times) == pytest.approx(0.005)
    assert len(found.times) == 1 + (20_000 - 1000) // 100
    assert found.times[found.power[:, 0].argmax()] == pytest.approx(7300 / RATE)
    assert (found.power[np.abs(found.times - 7300 / RATE) < 0.01, 0] > 10 * found.floor[0]).all()


def test_chunks_do_not_matter(monkeypatch):
    recording = Recording(white((3, 30_000)), RATE)
    whole = intensities(recording)
    monkeypatch.setattr(intensity, "_MAX_CHUNK_SAMPLES", 20_000)
    np.testing.assert_allclose(intensities(recording).power, whole.power, rtol=1e-12)
    single = intensities(Recording(recording.samples.astype(np.float32), RATE))
    np.testing.assert_allclose(single.power, whole.power, atol=1e-6 * whole.power.max())


def touches(seed, quiet):
    """12 channels of noise, each as loud as its number, with touches in all windows but a fraction `quiet` of them."""
    random = np.random.default_rng(seed)
    samples = white((12, 60_000), seed) * np.arange(1, 13)[:, None]
    # Three decaying touches. The end of each second is quiet.
    length = int((1 - quiet) * RATE)
    time = np.arange(length) / RATE
    for k in range(3):
        fade = np.exp(-3 * time / (1.001 - quiet)) * np.sin(2 * np.pi * random.uniform(150, 700) * time)
        loudness = 10 ** random.uniform(0.2, 2, size=(12, 1)) * np.arange(1, 13)[:, None]
        samples[:, k * 20_000 : k * 20_000 + length] += loudness * fade
    return samples


@pytest.mark.parametrize(("quiet", "bias"), [(1.0, 0.02), (0.5, 0.03), (0.3, 0.06)])
def test_floor_below_touches(quiet, bias):
    """To a few per cent in the mean over seeds and channels, and for most channels to a tenth."""
    true = np.arange(1, 13) ** 2 * 950 / (RATE / 2)
    error = np.array([intensities(Recording(touches(seed, quiet), RATE)).floor / true - 1 for seed in range(6)])
    assert abs(error.mean()) < bias
    assert np.quantile(np.abs(error), 0.8) < 0.1


def test_power_is_above_the_floor():
    found = intensities(Recording(touches(0, 0.5), RATE))
    given = intensities(Recording(touches(0, 0.5), RATE), floor=2 * found.floor)
    np.testing.assert_allclose(given.power, found.power - found.floor, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(given.floor, 2 * found.floor)
    quiet = (found.times % 1 > 0.55) & (found.times % 1 < 0.95)
    # The mean of some 80 overlapping windows.
    assert np.abs(found.power[quiet].mean(axis=0) / found.floor).max() < 0.15


def test_floor_of_distributions():
    """χ² itself, to its scatter, and with half of the windows unusable, at any value they may have."""
    random = np.random.default_rng(2)
    power = random.chisquare(30, size=(4000, 4)) / 30 * [1, 2, 0.1, 5]
    np.testing.assert_allclose(noise_floor(power, np.ones_like(power, bool), 30), [1, 2, 0.1, 5], rtol=0.02)
    usable = np.ones(power.shape, bool)
    usable[::2], usable[:, 3] = False, False
    power[::2] = np.nan
    np.testing.assert_allclose(noise_floor(power, usable, 30), [1, 2, 0.1, 0], rtol=0.02)
    assert noise_floor(np.full((9, 1), 3.0), np.ones((9, 1), bool), np.inf) == 3.0
    assert noise_floor(np.zeros((9, 1)), np.ones((9, 1), bool), 30.0) == 0.0


def test_faults_are_assigned_to_windows():
    samples = white((4, 40_000))
    samples[1] = 0
    samples[2, 20_000] = np.nan
    samples[3] = samples[3].clip(-1, 1)
    found = intensities(Recording(samples, RATE))
    assert [fault.split(" in ")[0] for fault in found.faults] == [
        "",
        "dead: every sample is 0",
        "NaN or infinite",
        "clipping",
    ]
    np.testing.assert_array_equal(found.usable.sum(axis=0), [157, 0, 153, 0])
    np.testing.assert_allclose(found.floor, [0.095, 0, 0.095, 0], rtol=0.1)
    assert np.isfinite(found.power).all()
    assert not intensities(Recording(np.zeros((3, 4000)), RATE)).usable.any()


def taps(seed=0, noise=1.0):
    """30 taps of 0.4 s at 5 microphones, which receive them from 0.15 s on, of random loudness."""
    random = np.random.default_rng(seed)
    time = np.arange(8000) / RATE
    tap = np.where(time > 0.15, np.exp(-(time - 0.15) / 0.03), 0) * np.sin(2 * np.pi * 300 * time)
    loudness = 10 ** random.uniform(0, 1.5, size=(30, 5))
    samples = loudness[..., None] * tap + noise * random.normal(size=(30, 5, 8000))
    places = random.uniform(0.02, 0.18, size=(30, 2))
    return Taps(random.uniform(0, 0.2, (5, 2)), OUTLINE, places, samples=samples, rate=RATE), loudness


def test_taps():
    """Intensity is proportional to the square of loudness, by one factor for all: each tap has the same active
    windows.
    """
    measured, loudness = taps()
    found = tap_intensities(measured)
    assert found.power.shape == found.usable.shape == (30, 5)
    assert found.usable.all()
    assert found.faults == ("",) * 5
    np.testing.assert_allclose(found.floor, 0.095, rtol=0.05)
    ratio = found.power / loudness**2
    clear = found.power > 100 * found.floor
    assert clear.sum() > 30
    quiet_free = tap_intensities(taps(noise=0.0)[0])
    np.testing.assert_allclose(quiet_free.floor, 0, atol=1e-12)
    factor = quiet_free.power / taps(noise=0.0)[1] ** 2
    np.testing.assert_allclose(factor, factor[0, 0], rtol=1e-9)
    np.testing.assert_allclose(ratio[clear], factor[0, 0], rtol=0.3)


def test_a_noisy_channel_does_not_choose_the_windows():
    """One microphone with a thousandfold gain receives only its own noise. The others receive the taps as before."""
    measured, _ = taps()
    assert measured.samples is not None
    samples = np.insert(measured.samples, 5, white((30, 8000), 9, 1000.0), axis=1)
    more = Taps(
        np.insert(measured.microphones, 5, 0.1, axis=0), OUTLINE, measured.positions, samples=samples, rate=RATE
    )
    np.testing.assert_allclose(
        tap_intensities(more).power[:, :5], tap_intensities(measured).power, rtol=0.05, atol=0.02
    )


def test_freedom_of_taps():
    """Against the scatter of silent microphones beside one with a signal: noise of chosen windows that overlap."""
    random = np.random.default_rng(3)
    time = np.arange(6000) / RATE
    tap = 100 * np.exp(-((time - 0.15) ** 2) / 2 / 0.03**2) * np.sin(2 * np.pi * 300 * time)
    samples = random.normal(size=(40, 30, 6000))
    samples[:, 0] += tap
    places = random.uniform(0.02, 0.18, size=(40, 2))
    found = tap_intensities(Taps(random.uniform(0, 0.2, (30, 2)), OUTLINE, places, samples=samples, rate=RATE))
    silent = found.power[:, 1:]
    # 1,160 means of noise, above a floor that is determined to one per cent.
    assert abs(silent.mean() / 0.095) < 0.02
    measured = 2 * (950 / (RATE / 2)) ** 2 / silent.var(axis=0).mean()
    assert measured == pytest.approx(found.freedom.mean(), rel=0.15)
    single = degrees_of_freedom(IntensitySettings(), RATE)
    # Some 4 windows of 0.05 s, at a hop of a quarter of their length.
    assert 1.2 * single < found.freedom.min() <= found.freedom.max() < 3 * single


def test_faults_of_taps():
    measured, _ = taps()
    assert measured.samples is not None
    samples = measured.samples.copy()
    samples[:, 1] = 0
    samples[4, 2, 200] = np.nan  # before the tap arrives
    samples[5, 2, 3200] = np.nan  # during the tap
    samples[6:, 3] = 0.125
    found = tap_intensities(eqx.tree_at(lambda t: t.samples, measured, samples))
    expected = np.ones((30, 5), bool)
    expected[:, 1] = expected[5, 2] = expected[6:, 3] = False
    np.testing.assert_array_equal(found.usable, expected)
    assert [fault.split(" in ")[0] for fault in found.faults] == [
        "",
        "dead: every sample is 0",
        "NaN or infinite",
        "stuck",
        "",
    ]
    assert np.isfinite(found.power).all()
    clean = tap_intensities(measured)
    np.testing.assert_allclose(found.power[4, [0, 2, 4]], clean.power[4, [0, 2, 4]], rtol=0.3)


def test_intensities_are_returned_unchanged():
    power = np.abs(white((6, 3)))
    power[2, 1] = np.nan
    found = tap_intensities(Taps(0.02 + white((3, 2)) * 0.01, OUTLINE, 0.1 + white((6, 2)) * 0.01, power=power))
    np.testing.assert_array_equal(found.power, power)
    np.testing.assert_array_equal(found.usable, np.isfinite(power))
    assert found.faults == ("", "NaN or infinite in 1 of 6 windows", "")
    assert np.isinf(found.freedom).all()
    assert not found.floor.any()


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"low": -1.0}, "low"),
        ({"low": 500.0, "high": 400.0}, "low < high"),
        ({"high": np.nan}, "high must be a finite number"),
        ({"low": "50"}, "low must be a finite number"),
        ({"window": 0.0, "hop": 0.0}, "window must be positive"),
        ({"hop": -0.01}, "hop must be positive"),
        ({"hop": 0.1}, "no longer than a window"),
        ({"window": 50.0, "hop": 12.5}, "seconds"),
    ],
)
def test_bad_settings(change, word):
    with pytest.raises(ValueError, match=word):
        IntensitySettings(**change)


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda: intensities(Recording(white((2, 800)), RATE)), "800 samples at 20000 Hz last 0.04 s"),
        (lambda: intensities(Recording(white((2, 800)), 1500.0)), "set high to 750 Hz or less"),
        (
            lambda: intensities(Recording(white((2, 800)), RATE), IntensitySettings(90, 100)),
            "Set window to 0.4 s or more",
        ),
        (
            lambda: intensities(Recording(white((2, 8000)), RATE), floor=np.zeros(3)),
            "one for each of the 2 microphones",
        ),
        (lambda: intensities(Recording(white((2, 8000)), RATE), floor=-np.ones(2)), "not negative"),
        (lambda: intensities(Intensities([0.0], [[1.0]])), "must be a Recording"),
        (lambda: tap_intensities(Recording(white((2, 8000)), RATE)), "must be Taps"),
        (lambda: noise_floor(np.ones((4, 2)), np.ones(4, bool), 9.0), "usable"),
        (lambda: noise_floor(np.ones((4, 2)), np.ones((4, 2), bool), 0.0), "freedom"),
        (lambda: noise_floor(np.ones((4, 2)), np.ones((4, 2), bool), 9.0, share=20), "share"),
        (lambda: noise_floor(np.full((4, 2), np.nan), np.ones((4, 2), bool), 9.0), "NaN"),
    ],
)
def test_bad_input(call, word):
    with pytest.raises(ValueError, match=word):
        call()
