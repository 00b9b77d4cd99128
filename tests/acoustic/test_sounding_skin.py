"""The simulated acoustic skin: its powers against closed forms and drawn touches, its timing and its true places."""

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy.optimize import least_squares

from jeit.acoustic.simulate import (
    Burst,
    SoundingSkin,
    microphone_grid,
    simulate_calibration_taps,
    simulate_pat,
    simulate_silence,
    simulate_stroke,
    simulate_tap,
    simulate_tickle,
)
from jeit.acoustic.simulate.propagation import expected_power, noise_power, nominal_power, transfer
from jeit.acoustic.simulate.sound import superpose
from jeit.acoustic.simulate.sounding_skin import Elastomer, ElastomerLayer, MicrophoneModel, Readout
from jeit.data import RoundSkin, simulate_press

KEY = jax.random.key(0)
# No variation between microphones and no coupling: the rest has closed forms.
SPREADS = {"gain_spread_db": 0.0, "depth_spread": 0.0, "noise_spread_db": 0.0}
ALIKE = {"microphone_model": MicrophoneModel(**SPREADS), "readout": Readout(coupling_db=-np.inf)}
UNBOUNDED = ElastomerLayer(reflection=0.0)
CENTRE = [(0.0, 0.0)]


@pytest.fixture(scope="module")
def skin() -> SoundingSkin:
    return SoundingSkin(KEY)


@pytest.fixture(scope="module")
def small() -> SoundingSkin:
    return SoundingSkin(KEY, microphone_grid(2))


def test_microphones_lie_on_a_grid_of_40_mm(skin):
    place = np.asarray(skin.microphones)
    assert place.shape == (25, 2)
    np.testing.assert_allclose(np.unique(place.round(12)), [-0.08, -0.04, 0, 0.04, 0.08])
    np.testing.assert_allclose(place[1] - place[0], [0.04, 0], atol=1e-15)
    assert skin.layer.material.wave_speed == pytest.approx(10)
    # 2 dB of spread in power. The standard deviation of 25 draws scatters by 14 %.
    assert 20 * np.std(np.log10(np.asarray(skin.gain))) == pytest.approx(2, rel=0.45)
    # The three draws of a microphone are independent: correlations of 25 scatter by 0.2.
    logs = np.log([skin.gain, skin.microphone_depth, skin.noise_factor])
    np.testing.assert_allclose(np.corrcoef(logs), np.eye(3), atol=0.6)
    other = SoundingSkin(KEY, microphone_model=MicrophoneModel(depth=0.02, depth_spread=0.3, noise_spread_db=4.0))
    depth, factor = np.log(np.asarray(other.microphone_depth) / 0.02), np.log10(np.asarray(other.noise_factor))
    assert (np.std(depth), 10 * np.std(factor)) == (pytest.approx(0.3, rel=0.45), pytest.approx(4, rel=0.45))
    assert (abs(depth.mean()), 10 * abs(factor.mean())) < (0.18, 2.4)


def test_without_loss_and_echoes_power_is_the_spreading():
    layer = ElastomerLayer(material=Elastomer(attenuation=0.0), reflection=0.0)
    lossless = SoundingSkin(KEY, CENTRE, layer=layer, **ALIKE)
    distance = np.array([0.0, 0.01, 0.03, 0.09])
    length, thickness = np.hypot(distance, 0.01), 0.01
    expected = (0.01 / length) ** 2 * (1 + length / thickness) / 2
    power = expected_power(lossless, np.stack([distance, 0 * distance], axis=-1))[:, 0]
    # The remaining error is of the quadrature over the source's density.
    np.testing.assert_allclose(power, expected, rtol=5e-5)
    np.testing.assert_allclose(nominal_power(lossless, distance), expected, rtol=5e-5)


def test_edges_and_corners_reflect_as_images_of_the_source():
    # A microphone on an edge is as far from the image as from the source: amplitude 1 + reflection. In a corner there
    # are three images, (1 + reflection)². The other edges are a metre and more away, where little power arrives.
    edges = np.array([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)])
    corners = np.array([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)])
    for reflection in (1.0, 0.5, -1.0):
        walled = ElastomerLayer(2.0, 2.0, material=Elastomer(attenuation=20.0), reflection=reflection)
        large = SoundingSkin(KEY, np.concatenate([edges, corners]), layer=walled, **ALIKE)
        power = np.diagonal(expected_power(large, 0.97 * np.concatenate([edges, corners])))
        direct = nominal_power(large, np.repeat([0.03, 0.03 * np.sqrt(2)], 4))
        expected = direct * np.repeat([(1 + reflection) ** 2, (1 + reflection) ** 4], 4)
        np.testing.assert_allclose(power, expected, rtol=1e-3, atol=1e-9)


def test_sound_is_delayed_as_its_loss_requires():
    # For a loss ∝ f, α = α0 f / f0, the Kramers-Kronig relations give the slowness 1 / speed - α0 ln(f / f0) / (π² f0).
    layer = ElastomerLayer(material=Elastomer(attenuation_exponent=1.0), reflection=0.0)
    readout = Readout(coupling_db=-np.inf, multiplexed=False)
    dispersive = SoundingSkin(KEY, CENTRE, layer=layer, microphone_model=ALIKE["microphone_model"], readout=readout)
    frequencies, length = np.linspace(1, 900, 900), np.hypot(0.04, 0.01)
    phase = np.unwrap(np.angle(transfer(dispersive, frequencies, np.array([0.04, 0.0]))[0]))
    slowness = 1 / 10 - 4 * np.log(frequencies / 100) / (np.pi**2 * 100)
    np.testing.assert_allclose(-phase / length / (2 * np.pi * frequencies), slowness, rtol=1e-4)


def test_a_microphone_receives_up_to_its_reach():
    alike = SoundingSkin(KEY, CENTRE, **ALIKE)
    snr = expected_power(alike, [(0.055, 0.0), (0.0, -0.055)])[:, 0] / noise_power(alike)
    # 0 dB, but for the edges' echoes, which are weak at this distance.
    np.testing.assert_allclose(10 * np.log10(snr), 0, atol=0.4)
    louder = SoundingSkin(KEY, CENTRE, **ALIKE | {"microphone_model": MicrophoneModel(snr_db=10.0, **SPREADS)})
    np.testing.assert_allclose(noise_power(alike) / noise_power(louder), 10, rtol=1e-12)


@pytest.mark.slow
def test_power_falls_with_distance():
    alike = SoundingSkin(KEY, CENTRE, layer=UNBOUNDED, **ALIKE)
    power = expected_power(alike, np.stack([np.linspace(0, 0.1, 40), np.zeros(40)], axis=-1))[:, 0]
    assert (np.diff(power) < 0).all()
    assert power[-1] < power[0] / 30
    np.testing.assert_allclose(power, nominal_power(alike, np.linspace(0, 0.1, 40)), rtol=1e-4)


@pytest.mark.slow
def test_the_librarys_decay_model_does_not_fit_exactly(skin):
    places = microphone_grid(13)
    power = expected_power(skin, places)
    scatter = []
    for place, received in zip(np.asarray(skin.microphones), power.T, strict=True):
        squared = ((places - place) ** 2).sum(axis=1)

        def misfit(parameters, squared=squared, received=received):
            return np.log(received) - parameters[0] + np.log(squared + np.exp(parameters[1]))

        scatter.append(np.std(least_squares(misfit, np.log([1e-4, 1e-4])).fun))
    assert min(scatter) > 0.05
    assert 0.1 < np.mean(scatter) < 0.3
    assert max(scatter) < 0.4


@pytest.mark.slow
def test_drawn_bursts_have_the_expected_power(small):
    places, options = np.array([[0.01, 0.02], [0.06, -0.03], [0.095, 0.09]]), {"duration": 0.14, "noise": False}
    taps = simulate_calibration_taps(small, KEY, places, repeats=200, strength_spread=0.0, **options)
    assert taps.samples.shape == (600, 4, 1400)
    np.testing.assert_array_equal(taps.positions[[0, 199, 200]], places[[0, 0, 1]])
    # A strength of 1 over 60 ms is the energy of 600 samples at 10 kHz.
    ratio = (taps.samples**2).sum(axis=-1).reshape(3, 200, 4) / 600 / expected_power(small, places)[:, None]
    error = ratio.std(axis=1) / np.sqrt(200)
    # A burst has two to ten independent values, fewer where only low tones arrive: 200 determine the mean to 2 to 5 %.
    assert error.max() < 0.06
    assert (np.abs(ratio.mean(axis=1) - 1) < 3.5 * error).all()
    # The mean over places is determined to 2.5 %.
    assert ratio.mean() == pytest.approx(1, abs=0.06)
    np.testing.assert_array_equal(taps.strengths, 1)
    # Strengths only scale the taps. 600 draws determine their standard deviation to 3 %.
    spread = simulate_calibration_taps(small, KEY, places, repeats=200, strength_spread=0.5, **options)
    assert np.std(np.log(spread.strengths)) == pytest.approx(0.5, rel=0.12)
    np.testing.assert_allclose(spread.samples, taps.samples * spread.strengths[:, None, None], rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_the_chunks_of_a_calibration_do_not_matter(small, monkeypatch):
    places = [(0.0, 0.01), (0.03, 0.02), (-0.08, 0.0)]
    whole = simulate_calibration_taps(small, KEY, places, repeats=2, duration=0.1)
    monkeypatch.setattr("jeit.acoustic.simulate.touch_sounds.MAX_CHUNK_SAMPLES", 12_000)
    # Two chunks of two places, the last one twice.
    parts = simulate_calibration_taps(small, KEY, places, repeats=2, duration=0.1)
    np.testing.assert_allclose(parts.samples, whole.samples, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("multiplexed", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_blocks_add_up_to_the_transfer_function(multiplexed):
    # For any spectrum of the source, two channels differ by the ratio of their transfer functions.
    made = SoundingSkin(KEY, microphone_grid(2), readout=Readout(multiplexed=multiplexed))
    place = (0.03, -0.06)
    recording = simulate_tap(made, KEY, place, repeats=2, duration=1.0, noise=False)
    spectrum = np.fft.rfft(recording.samples)
    frequencies = np.fft.rfftfreq(recording.samples.shape[1], 1 / recording.rate)
    inside = (frequencies > 80) & (frequencies < 900)
    ratio = np.asarray(transfer(made, frequencies[inside], np.asarray(place)))
    left, right = spectrum[0, inside] * ratio[1], spectrum[1, inside] * ratio[0]
    assert np.linalg.norm(left) > 0
    # The filter's response before the recording begins is cut off: -50 dB.
    assert np.linalg.norm(left - right) < 3e-3 * np.linalg.norm(left)


def test_a_row_of_taps_has_the_expected_loudness_and_delay():
    near = SoundingSkin(KEY, CENTRE)
    recording = simulate_tap(near, KEY, (0.01, 0.0), repeats=100, frequency=10.0, noise=False)
    near_power, made = (
        (row[:100_000] ** 2).reshape(100, 1000).mean(axis=0) for row in (recording.samples[0], recording.active)
    )
    # The energy of each burst scatters by a third, its middle by 10 ms: 100 determine them to 4 % and 1 ms.
    assert near_power.sum() / made.sum() == pytest.approx(expected_power(near, [(0.01, 0.0)])[0, 0], rel=0.12)
    middles = [np.average(np.arange(1000) / recording.rate, weights=row) for row in (near_power, made)]
    # The distance is 14 mm, 1.4 ms.
    assert middles[0] - middles[1] == pytest.approx(0.0014, abs=0.003)


@pytest.mark.parametrize(("multiplexed", "step", "rate"), [(True, 25e-6, 10e3), (False, 0.0, 40e3)])
def test_the_multiplexer_samples_one_after_another(multiplexed, step, rate):
    # Six microphones in one place receive the same sound. Later samples are earlier sound.
    readout = Readout(coupling_db=-np.inf, multiplexed=multiplexed)
    together = SoundingSkin(KEY, [(0.0, 0.02)] * 6, microphone_model=ALIKE["microphone_model"], readout=readout)
    recording = simulate_tap(together, KEY, (0.01, 0.0), noise=False)
    assert recording.rate == pytest.approx(rate)
    spectrum = np.fft.rfft(recording.samples)
    frequencies = np.fft.rfftfreq(recording.samples.shape[1], 1 / recording.rate)
    cross = spectrum * spectrum[0].conj()
    inside = (frequencies > 100) & (frequencies < 800)
    delay = [
        np.sum(np.angle(c) * f * np.abs(c)) / np.sum(f**2 * np.abs(c)) / 2 / np.pi
        for c, f in ((row[inside], frequencies[inside]) for row in cross)
    ]
    np.testing.assert_allclose(delay, step * np.array([0, 1, 2, 3, 0, 1]), atol=1e-7)
    np.testing.assert_allclose(together.stagger, step * np.array([0, 1, 2, 3, 0, 1]), atol=1e-12)


def test_coupling_comes_from_the_preceding_slot():
    frequencies, place = np.array([100.0, 700.0]), np.array([0.05, 0.03])
    grid = microphone_grid(3)[:6]
    alone, coupled = (
        np.asarray(transfer(SoundingSkin(KEY, grid, readout=Readout(coupling_db=db)), frequencies, place))
        for db in (-np.inf, -20.0)
    )
    # The second multiplexer has microphones 4 and 5 and two open slots, the last of which precedes 4.
    before = np.array([3, 0, 1, 2, 4, 4])
    expected = 0.1 * alone[before]
    # The slot before the first is the last of the cycle before, 100 µs ago.
    expected[0] *= np.exp(-2j * np.pi * frequencies * 100e-6)
    expected[4] = 0
    np.testing.assert_allclose(coupled - alone, expected, rtol=1e-9, atol=1e-15)


def test_noise_has_its_power_in_its_band(small):
    recording = simulate_silence(small, KEY, duration=8.0)
    # 860 Hz for 8 s are some 14,000 independent values: 1.2 %.
    np.testing.assert_allclose((recording.samples**2).mean(axis=1), noise_power(small), rtol=0.05)
    power = np.abs(np.fft.rfft(recording.samples * np.hanning(recording.samples.shape[1]))) ** 2
    frequencies = np.fft.rfftfreq(recording.samples.shape[1], 1 / recording.rate)
    assert power[:, frequencies > 1300].sum() < 1e-6 * power.sum()
    low, high = (power[:, (frequencies > f) & (frequencies < f + 200)].mean() for f in (200, 400))
    assert low == pytest.approx(high, rel=0.1)
    assert recording.position.shape == (0, 2)
    assert not recording.active.any()


@pytest.mark.slow
def test_keys_determine_everything(small):
    line = [(-0.05, 0.0), (0.05, 0.0)]
    for made in (
        lambda key: simulate_pat(small, key, (0.01, 0.0)).samples,
        lambda key: simulate_tickle(small, key, (0.01, 0.0)).samples,
        lambda key: simulate_stroke(small, key, line).samples,
        lambda key: simulate_silence(small, key).samples,
        lambda key: SoundingSkin(key).gain,
    ):
        np.testing.assert_array_equal(made(KEY), made(KEY))
        assert np.abs(made(KEY) - made(jax.random.key(1))).max() > 0
    # A draw does not depend on the rest of the skin.
    other = SoundingSkin(KEY, layer=UNBOUNDED, microphone_model=MicrophoneModel(snr_db=20.0))
    np.testing.assert_array_equal(SoundingSkin(KEY).gain, other.gain)


def test_touches_are_summed_and_noise_is_added_once(small):
    one, two = (
        simulate_pat(small, jax.random.key(k), at, noise=False) for k, at in ((1, (0.05, 0.05)), (2, (-0.06, 0.0)))
    )
    together = superpose(small, None, one, two)
    np.testing.assert_allclose(together, one.samples + two.samples, rtol=1e-12)
    noise = superpose(small, KEY, one, two) - together
    # 860 Hz for a second: 2.4 %.
    np.testing.assert_allclose((noise**2).mean(axis=1), noise_power(small), rtol=0.12)
    louder = simulate_pat(small, jax.random.key(1), (0.05, 0.05), burst=Burst(4.0, 0.08), noise=False)
    np.testing.assert_allclose(louder.samples, 2 * one.samples, rtol=1e-9, atol=1e-12)
    noisy = simulate_pat(small, jax.random.key(1), (0.05, 0.05))
    assert np.corrcoef((noisy.samples - one.samples)[0], one.samples[0])[0, 1] < 0.1
    with pytest.raises(ValueError, match="noise=False"):
        superpose(small, KEY, one, noisy)
    with pytest.raises(ValueError, match="equally long"):
        superpose(small, KEY, one, eqx.tree_at(lambda shorter: shorter.samples, two, two.samples[:, :4100]))


@pytest.mark.slow
def test_the_loudest_microphone_follows_a_stroke():
    clear = SoundingSkin(KEY, **ALIKE | {"microphone_model": MicrophoneModel(snr_db=20.0, **SPREADS)})
    recording = simulate_stroke(clear, KEY, [(-0.09, -0.04), (0.0, -0.04), (0.0, 0.09)])
    place, right = np.asarray(clear.microphones), 0
    starts = np.arange(500, 9000, 500)
    for start in starts:
        loudest = place[np.argmax((recording.samples[:, start : start + 500] ** 2).mean(axis=1))]
        middle = (start + 250) / recording.rate - 0.003  # sound takes 3 ms to a nearby microphone
        truth = [np.interp(middle, recording.position_times, axis) for axis in recording.position.T]
        nearest = place[np.argmin(((place - truth) ** 2).sum(axis=1))]
        right += np.allclose(loudest, nearest)
    # Half way between two microphones the loudest is random.
    assert right >= 0.8 * len(starts)


def test_a_stroke_follows_its_path_and_is_louder_if_faster(small):
    line = simulate_stroke(small, KEY, [(-0.05, 0.0), (0.05, 0.0)], noise=False)
    np.testing.assert_allclose(line.position[:, 0], -0.05 + 0.1 * line.position_times, atol=2e-5)
    # 0.1 m in a second: the nominal speed, except at the ends.
    np.testing.assert_allclose(line.active[300:-300], 1, rtol=1e-9)
    faster = simulate_stroke(small, KEY, lambda t: np.stack([-0.05 + 0.1 * t**2, 0 * t], axis=-1), noise=False)
    np.testing.assert_allclose(faster.active[[2000, 8000]], np.sqrt([0.4, 1.6]), rtol=1e-3)
    np.testing.assert_allclose(faster.position[50], [-0.025, 0], atol=1e-9)


def test_pats_and_tickles_have_their_places_and_times(small):
    patted = simulate_pat(small, KEY, (0.02, -0.01), taps=3, interval=0.3)
    rises = np.flatnonzero(np.diff((patted.active > 1).astype(int)) == 1) / patted.rate
    np.testing.assert_allclose(np.diff(rises), 0.3, atol=1e-9)
    assert len(rises) == 3
    np.testing.assert_array_equal(np.unique(patted.position, axis=0), [[0.02, -0.01]])
    tickled = simulate_tickle(small, KEY, (0.095, 0.0), radius=0.01)
    assert 8 <= len(np.unique(tickled.position, axis=0)) <= 15
    assert (np.linalg.norm(tickled.position - [0.095, 0], axis=1) <= 0.01).all()
    assert (tickled.position[:, 0] <= 0.1).all()
    assert len(tickled.times) == tickled.samples.shape[1] == len(tickled.active) == 10_000
    # Four taps take the second of the other recordings: one program simulates all.
    lasting = simulate_tap(small, KEY, (0, 0), repeats=4, frequency=3 / 0.89, duration=0.5, noise=False)
    assert lasting.samples.shape[1] == pytest.approx(10_000, abs=1)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ElastomerLayer(width=-0.2), "width must be a positive"),
        (lambda: MicrophoneModel(depth=0.0), "depth must be a positive"),
        (lambda: MicrophoneModel(reach=np.nan), "reach must be a positive"),
        (lambda: Elastomer(attenuation=-1.0), "attenuation must be zero or positive"),
        (lambda: ElastomerLayer(reflection=1.5), "reflection: the amplitude"),
        (lambda: Readout(coupling_db=3.0), "coupling_db"),
        (lambda: MicrophoneModel(snr_db=np.inf), "snr_db"),
        (lambda: SoundingSkin(KEY, spectral_slope=np.nan), "spectral_slope must be finite"),
        (lambda: Elastomer(attenuation_exponent=3.0), "attenuation_exponent must be"),
        (lambda: MicrophoneModel(gain_spread_db=-1.0), "gain_spread_db must be zero or positive"),
        (lambda: Readout(band=(900.0, 60.0)), "band: give"),
        (lambda: Readout(band=(60.0, 4000.0)), "below 3536 Hz"),
        (lambda: SoundingSkin(KEY, [(40.0, 0.0)]), "microphones: row 0.*millimetres"),
        (
            lambda: ElastomerLayer(200, 200, 10),
            "width is 200000 mm, more than the longest.*millimetres given for metres",
        ),
        (lambda: ElastomerLayer(0.2, 0.1, 10), "thickness is 10000 mm, more than the layer is wide, 200 mm.*millim"),
        (lambda: MicrophoneModel(depth=10), "depth is 10000 mm.*millimetres given for metres"),
        (lambda: ElastomerLayer(width="200"), "width must be a positive length in metres; it is '200'"),
        (lambda: Elastomer(density=None), "density must be a positive number in SI units; it is None"),
        (lambda: ElastomerLayer(material="rubber"), r"material must be an Elastomer, such as .*; it is 'rubber'"),
        (
            lambda: SoundingSkin(KEY, layer=(0.2, 0.2, 0.01)),
            "layer must be an ElastomerLayer, such as .*; it is a tuple",
        ),
        (lambda: SoundingSkin(KEY, microphone_model="mems"), "microphone_model must be a MicrophoneModel.* is 'mems'"),
        (lambda: SoundingSkin(KEY, readout=1e4), r"readout must be a Readout.* is 10000\.0"),
        (lambda: SoundingSkin(7), r"key must be one random key, such as jax\.random\.key\(7\)"),
        (lambda: SoundingSkin(None), r"key must be one random key, such as jax\.random\.key\(0\); it is None"),
        (lambda: SoundingSkin(KEY, np.zeros((3, 3))), r"microphones: give \(x, y\)"),
    ],
)
def test_impossible_skins_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda skin: simulate_tap(skin, KEY, (0.11, 0.0)), "position: row 0.*off the skin"),
        (lambda skin: simulate_tap(skin, KEY, (np.nan, 0.0)), "position: row 0 is not finite"),
        (lambda skin: simulate_tap(skin, KEY, (0.0, 0.0, 0.0)), "position: give"),
        (lambda skin: simulate_tap(skin, KEY, (0.0, 0.0), burst=Burst(strength=0.0)), "strength must be"),
        (lambda skin: simulate_tap(skin, KEY, (0.0, 0.0), repeats=0), "repeats"),
        (lambda skin: simulate_tap(skin, KEY, (0.0, 0.0), burst=Burst(length=0.2)), "does not fit"),
        (lambda skin: simulate_pat(skin, KEY, (0.0, 0.0), interval=-1.0), "interval must be"),
        (lambda skin: simulate_tickle(skin, KEY, (0.0, 0.0), radius=0.0), "radius must be"),
        (lambda skin: simulate_stroke(skin, KEY, [(0.0, 0.0), (0.2, 0.0)]), "path: row 1"),
        (lambda skin: simulate_stroke(skin, KEY, [(0.0, 0.0)]), "its length is zero"),
        (lambda skin: simulate_stroke(skin, KEY, lambda t: np.zeros((3, 2))), "one for each"),
        (lambda skin: simulate_silence(skin, KEY, duration=0.0), "duration must be"),
        (lambda skin: simulate_calibration_taps(skin, KEY, [(0.0, 0.0)], repeats=0), "repeats"),
        (lambda skin: simulate_calibration_taps(skin, KEY, [(0.0, 0.0)], strength_spread=-1.0), "strength_spread"),
        (lambda skin: simulate_calibration_taps(skin, KEY, np.zeros((0, 2))), "positions: give"),
        (lambda skin: expected_power(skin, [(0.0, np.inf)]), "positions: row 0 is not finite"),
        (lambda skin: microphone_grid(0), "number"),
        (lambda skin: superpose(skin, KEY), "at least one"),
        (lambda skin: simulate_tap(skin, KEY, "middle"), r"position: give \(x, y\) in metres"),
        (
            lambda skin: simulate_tap(KEY, skin, (0.0, 0.0)),
            "skin must be a SoundingSkin, .*; it is an array of key<fry>",
        ),
        (lambda skin: simulate_tap(skin, KEY, (0.0, 0.0), burst=2.0), "burst must be a Burst"),
        (lambda skin: simulate_pat(skin, 1, (0.0, 0.0)), "key must be"),
        (lambda skin: simulate_tickle(skin, None, (0.0, 0.0)), "key must be"),
        (lambda skin: simulate_tickle(skin, KEY, (0.0, 0.0), burst="light"), "burst must be a Burst"),
        (lambda skin: simulate_stroke(skin, "a", [(0.0, 0.0), (0.1, 0.0)]), "key must be"),
        (lambda skin: simulate_silence(skin, 3), "key must be"),
        (lambda skin: superpose(None, KEY), "skin must be a SoundingSkin"),
        (lambda skin: simulate_calibration_taps(skin, 0, [(0.0, 0.0)]), "key must be"),
        (lambda skin: simulate_press(RoundSkin(), 0, (0.0, 0.0)), r"key must be .*jax\.random\.key\(0\)"),
        (lambda skin: simulate_press(skin, KEY, (0.0, 0.0)), "skin must be a RoundSkin, .*; it is a SoundingSkin"),
    ],
)
def test_impossible_touches_are_refused(skin, make, message):
    with pytest.raises(ValueError, match=message):
        make(skin)
