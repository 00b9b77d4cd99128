"""Faults of microphones: each kind is detected where it is, and nothing else is taken for a fault."""

import numpy as np
import pytest

from jeit.acoustic.signal.faults import (
    CLIPPING,
    NOT_FINITE,
    STUCK,
    describe_faults,
    intensity_faults,
    sample_faults,
    window_faults,
)

RATE = 40e3
TIME = np.arange(40_000) / RATE
STEP = 2.0**-15  # of a 16-bit converter with a full scale of 1


def noise(deviation=0.01, seed=0):
    return deviation * np.random.default_rng(seed).normal(size=TIME.size)


def touched(peak=0.5, frequency=200.0, seed=0):
    """Noise and a decaying touch that starts from `peak` at 0.3 s."""
    after = np.maximum(TIME - 0.3, 0)
    rise = np.minimum(after / 0.005, 1)
    return noise(0.003, seed) + peak * rise * np.exp(-after / 0.03) * np.sin(2 * np.pi * frequency * after)


def quantised(samples, step=STEP):
    return np.round(samples / step) * step


def changed(samples, where, value):
    samples = samples.copy()
    samples[where] = value
    return samples


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        (np.zeros(4000), "dead: every sample is 0"),
        (np.full(4000, 0.25), "dead: every sample is 0.25"),
        (np.full(4000, np.nan), "dead: every sample is NaN or infinite"),
        (changed(np.zeros(4000), slice(7), np.inf), "dead: every finite sample is 0"),
    ],
)
def test_dead(samples, message):
    kind, dead = sample_faults(samples, RATE)
    assert dead == message
    usable, reason = window_faults(kind, dead, 2000, 500)
    assert usable.shape == (5,)
    assert not usable.any()
    assert reason == message


@pytest.mark.parametrize("level", [0.0, 0.004, -1.0])
@pytest.mark.parametrize("where", [slice(20_000, 21_500), slice(20_000, None), slice(0, 12_000)])
@pytest.mark.parametrize("converter", [STEP, 1e-3, None])
def test_stuck(level, where, converter):
    """Stuck at zero, in the range and at its end, for some time, until the end, and from the start, at noise of 3 steps
    too.
    """
    samples = changed(touched(), where, level)
    if converter:
        samples = quantised(samples, converter)
    kind, dead = sample_faults(samples, RATE)
    assert dead == ""
    assert (kind[where] == STUCK).all()
    # An adjacent sample may have the same value by chance.
    assert (kind == STUCK).sum() <= kind[where].size + 2
    assert (kind != CLIPPING).all()


@pytest.mark.parametrize("full_scale", [None, 0.25])
@pytest.mark.parametrize("frequency", [60.0, 200.0, 900.0])
@pytest.mark.parametrize("hold", [1, 4])
@pytest.mark.parametrize("ends", [(-0.25, 0.25), (-9, 0.25), (-0.25, 9)])
def test_clipping(full_scale, frequency, hold, ends):
    """Clipped exactly where a touch exceeds the range, for peaks of any length, at either end or both."""
    samples = quantised(np.repeat(touched(0.8, frequency)[::hold], hold).clip(*ends))
    kind, dead = sample_faults(samples, RATE, full_scale)
    assert dead == ""
    # The end is the last 3e-4 of the range and one step. If full scale is known, it is also the last thousandth of
    # that.
    tolerance = max(3e-4 * np.ptp(samples), 1e-3 * (full_scale or 0)) + 1.001 * STEP
    over = ((samples >= 0.25 - tolerance) & (ends[1] == 0.25)) | ((samples <= tolerance - 0.25) & (ends[0] == -0.25))
    assert over.sum() > 20
    np.testing.assert_array_equal(kind == CLIPPING, over)
    usable, reason = window_faults(kind, dead, 2000, 500)
    assert reason == f"clipping in {(~usable).sum()} of {usable.size} windows"
    # The touch begins at 0.3 s and is half as loud as the limit 0.08 s later. Windows are 0.05 s long.
    middle = np.arange(usable.size) * 0.0125 + 0.025
    assert usable[(middle < 0.27) | (middle > 0.41)].all()
    assert not usable[(middle > 0.31) & (middle < 0.33)].any()


def test_clipping_of_noise():
    """No peak is slow, and few peaks are long."""
    kind, _ = sample_faults(noise(1.0).clip(-1.3, 1.3), RATE)
    # 3e-4 of the range, 2.6, still counts as its end.
    np.testing.assert_array_equal(kind == CLIPPING, np.abs(noise(1.0)) >= 1.3 - 3e-4 * 2.6 - 1e-9)


def test_limits_that_fluctuate():
    """The ends of the range are not one value each but span a few steps."""
    samples = touched(0.8)
    samples = quantised(samples.clip(-0.25, 0.25) + 1.5 * STEP * noise(1.0, 3).clip(-1, 1))
    kind, _ = sample_faults(samples, RATE)
    assert (kind[np.abs(touched(0.8)) > 0.25] == CLIPPING).mean() > 0.95


def test_one_bad_sample_affects_only_its_windows():
    for value in (np.nan, np.inf, -np.inf):
        kind, dead = sample_faults(changed(noise(), [20_499, 20_600], value), RATE)
        assert set(np.flatnonzero(kind)) == {20_499, 20_600}
        assert (kind[[20_499, 20_600]] == NOT_FINITE).all()
        usable, reason = window_faults(kind, dead, 2000, 500)
        # From the window whose last sample is the first of them to the last window that begins before the second.
        assert set(np.flatnonzero(~usable)) == {37, 38, 39, 40, 41}
        assert reason == "NaN or infinite in 5 of 77 windows"


def test_several_faults_are_all_reported():
    # Stuck far below its remaining range, at whose lower end it clips.
    samples = changed(touched(0.8).clip(-0.25, 9), slice(30_000, 32_000), -1.0)
    kind, dead = sample_faults(changed(samples, 3, np.nan), RATE)
    usable, reason = window_faults(kind, dead, 2000, 500)
    assert [part.split(" in ")[0] for part in reason.split("; ")] == ["NaN or infinite", "stuck", "clipping"]
    counts = [int(part.split(" in ")[1].split()[0]) for part in reason.split("; ")]
    assert counts[:2] == [1, 7]
    assert (~usable).sum() == sum(counts)


def test_windows_of_a_batch_are_those_of_each_recording():
    kind = (
        np.random.default_rng(1).choice([0, 1, 2, 3], p=[0.997, 0.001, 0.001, 0.001], size=(3, 4000)).astype(np.uint8)
    )
    usable, reason = window_faults(kind, "", 300, 100)
    np.testing.assert_array_equal(usable, np.stack([window_faults(one, "", 300, 100)[0] for one in kind]))
    direct = [[not one[start : start + 300].any() for start in range(0, 3701, 100)] for one in kind]
    np.testing.assert_array_equal(usable, direct)
    assert "of 114 windows" in reason
    assert window_faults(np.full(400, STUCK, np.uint8), "", 200, 100)[1] == "stuck in all 3 windows"


SILENT = np.where((TIME % 0.25) < 0.15, np.sin(2 * np.pi * 200 * TIME) * np.exp(-(TIME % 0.25) / 0.014), 0)
SOUND = {
    "noise": noise(),
    "touch": touched(),
    "touch of 16 bits": quantised(touched()),
    "touch of 8 bits": quantised(touched(), 1 / 128),
    "held for 4 samples": np.repeat(touched()[::4], 4),
    "held for 4 samples, 16 bits": quantised(np.repeat(touched()[::4], 4)),
    "loudest held for 4 samples": changed(np.repeat(noise()[::4], 4), slice(800, 804), 1.0),
    "one loud sample": changed(noise(), 800, 1.0),
    "loud samples at both ends": changed(changed(noise(), [800, 9000], 1.0), 20_000, -1.0),
    "a knock at full scale": touched(1.0) / np.abs(touched(1.0)).max(),
    "a slow knock at full scale": touched(1.0, 20.0) / np.abs(touched(1.0, 20.0)).max(),
    "quiet, 0.6 steps of noise": quantised(noise(0.6 * STEP)),
    "quiet, 2 steps of noise": quantised(noise(2 * STEP)),
    "quiet and held": quantised(np.repeat(noise(0.6 * STEP)[::4], 4)),
    "quiet with a touch": quantised(touched() * 0.4 * STEP / 0.003),
    "hum of few steps": quantised(3.4 * STEP * np.sin(2 * np.pi * 50 * TIME) + noise(0.1 * STEP)),
    "hum of 300 steps": quantised(300 * STEP * np.sin(2 * np.pi * 50 * TIME) + noise(0.3 * STEP)),
    "a tone": np.sin(2 * np.pi * 500 * TIME),
    "a tone of 16 bits at full scale": quantised(np.sin(2 * np.pi * 50 * TIME)).clip(-1, 1 - STEP),
    "a tone of 8 bits": quantised(0.7 * np.sin(2 * np.pi * 50 * TIME), 1 / 128),
    "on an offset": noise(1e-4) + 0.7,
    "silence between touches, 16 bits": quantised(SILENT),
    "silence between touches, 8 bits": quantised(SILENT, 1 / 128),
    "silence between touches, no noise": SILENT,
    "begins at its peak": noise() + np.where(TIME < 0.3, 0, np.cos(2 * np.pi * 20 * (TIME - 0.3))),
    "begins at its slow peak": noise(1e-5) + np.where(TIME < 0.3, 0, np.cos(10 * np.pi * (TIME - 0.3))),
    "silence, then a touch": np.where(TIME < 0.3, 0, touched() - noise(0.003)),
}


@pytest.mark.parametrize("full_scale", [None, 1.0])
@pytest.mark.parametrize("which", SOUND)
def test_no_false_alarm(which, full_scale):
    kind, dead = sample_faults(SOUND[which], RATE, full_scale)
    assert dead == ""
    assert not kind.any(), {word: int((kind == word).sum()) for word in (NOT_FINITE, STUCK, CLIPPING)}


@pytest.mark.parametrize("seed", range(20))
def test_no_false_alarm_of_coloured_noise(seed):
    """Noise of a random band and level, on a converter of random resolution, with or without held samples."""
    random = np.random.default_rng(seed)
    spectrum = np.fft.rfft(noise(1.0, seed))
    frequency = np.fft.rfftfreq(TIME.size, 1 / RATE)
    spectrum[frequency > 10 ** random.uniform(1.5, 4.3)] = 0
    samples = np.fft.irfft(spectrum)
    samples = np.repeat(samples[::4], 4) if seed % 2 else samples
    samples = quantised(samples / np.abs(samples).max(), 2.0 ** -random.integers(2, 16))
    for rate in (1e3, RATE):
        kind, dead = sample_faults(samples, rate, 1.0)
        assert dead == ""
        assert not kind.any()


def test_intensities_without_samples():
    power = np.random.default_rng(0).normal(size=(6, 5)) ** 2
    power[:, 1] = np.nan
    power[:, 2] = 0
    power[2, 3] = np.inf
    power[:4, 4], power[4:, 4] = 0, np.nan
    usable, faults = intensity_faults(power)
    assert faults == (
        "",
        "dead: every intensity is NaN or infinite",
        "dead: every intensity is 0",
        "NaN or infinite in 1 of 6 windows",
        "dead: every finite intensity is 0",
    )
    expected = np.zeros((6, 5), bool)
    expected[:, [0, 3]] = True
    expected[2, 3] = False
    np.testing.assert_array_equal(usable, expected)


@pytest.mark.parametrize(
    ("reasons", "message"),
    [
        ((), ""),
        (("", ""), ""),
        (("", "dead"), "microphone 1: dead"),
        (("dead",) * 25, "microphones 0-24: dead"),
        (
            ("dead", "", "dead", "dead", "stuck", "dead", "", "stuck"),
            "microphones 0, 2-3, 5: dead; microphones 4, 7: stuck",
        ),
    ],
)
def test_one_reason_is_reported_once(reasons, message):
    assert describe_faults(reasons) == message
