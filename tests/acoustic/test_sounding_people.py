"""Wind, the sound of a room, and people on a simulated skin with microphones: powers, coherence, spreads and keys."""

import jax
import numpy as np
import pytest

from jeit.acoustic.simulate import (
    SoundingPerson,
    SoundingSkin,
    microphone_grid,
    simulate_room_sound,
    simulate_sound_clips,
    simulate_stroke,
    simulate_wind,
    wind_sound,
)
from jeit.acoustic.simulate.people import MODALITIES, SOUND_MANNERS
from jeit.acoustic.simulate.propagation import expected_power, noise_power

KEY = jax.random.key(3)
WHERE = (0.02, -0.01)


@pytest.fixture(scope="module")
def skin() -> SoundingSkin:
    return SoundingSkin(jax.random.key(0), microphone_grid(2))


def coherence(samples: np.ndarray) -> float:
    """Largest fraction of the power of two microphones that is common to both, at any delay between them."""
    spectrum = np.fft.rfft(samples[:, : samples.shape[1] // 200 * 200].reshape(len(samples), -1, 200))[..., 2:18]
    cross = np.einsum("mbf,nbf->mnf", spectrum, spectrum.conj())
    power = np.abs(np.diagonal(cross).T)
    shared = (np.abs(cross) ** 2 / power[:, None] / power[None]).mean(axis=-1)
    return float((shared - np.eye(len(samples))).max())


@pytest.mark.slow
def test_wind_has_the_power_of_its_sources(skin):
    """All at one place, with the skin's own spectrum: the power received from a steady source of that strength."""
    blown = simulate_wind(skin, KEY, WHERE, strength=2.0, radius=1e-9, gusts=0.0, slope=1.0, duration=8.0, noise=False)
    expected = 4 * expected_power(skin, [WHERE])[0]
    # 8 s of noise of 800 Hz: 1 % each, and edge echoes between the computed frequencies.
    np.testing.assert_allclose((blown.samples**2).mean(axis=1), expected, rtol=0.06)


def test_wind_is_incoherent_and_a_stroke_is_not(skin):
    blown = simulate_wind(skin, KEY, (0.0, 0.0), duration=8.0, noise=False)
    rubbed = simulate_stroke(skin, KEY, [(-0.01, 0.0), (0.01, 0.0)], duration=0.6, noise=False)  # as long as the clips
    assert coherence(blown.samples) < 0.05
    assert coherence(rubbed.samples) > 0.5
    assert blown.position.shape == (len(blown.position_times), 2)


def test_eddies_are_spread_by_the_radius_and_stay_on_the_skin(skin, monkeypatch):
    """64 of them determine their standard deviation to 6 %."""
    seen = []

    def received_power(skin, positions, frequencies):
        seen.append(np.asarray(positions))
        return found(skin, positions, frequencies)

    found = wind_sound._received_power
    monkeypatch.setattr(wind_sound, "_received_power", received_power)
    simulate_wind(skin, KEY, WHERE, radius=0.01, duration=8.0, noise=False)
    simulate_wind(skin, KEY, (0.1, -0.1), radius=0.01, duration=8.0, noise=False)
    inside, corner = seen
    np.testing.assert_allclose(inside.mean(axis=0), WHERE, atol=4e-3)
    np.testing.assert_allclose(inside.std(axis=0), 0.01, rtol=0.25)
    assert np.abs(corner).max() == pytest.approx(0.1)


def test_wind_falls_with_frequency_by_its_exponent(skin):
    """At twice the exponent the ratio of a low to a high band grows by that power of their distance."""
    ratios = []
    for slope in (0.0, 2.0):
        spectrum = (
            np.abs(np.fft.rfft(simulate_wind(skin, KEY, WHERE, slope=slope, duration=8.0, noise=False).samples)) ** 2
        )
        low, high = (spectrum[:, 8 * f - 160 : 8 * f + 160].sum(axis=1) for f in (150, 600))
        ratios.append(low / high)
    np.testing.assert_allclose(np.log(ratios[1] / ratios[0]), 2 * np.log(4), rtol=0.1)


def test_gusts_vary_and_keep_the_power(skin):
    still, gusty = (simulate_wind(skin, KEY, WHERE, gusts=gusts, duration=60.0, noise=False) for gusts in (0.0, 0.3))
    assert np.std(np.log(gusty.active)) == pytest.approx(0.3, rel=0.15)
    assert (gusty.active**2).mean() == pytest.approx((still.active**2).mean(), rel=0.15)


def test_all_microphones_receive_the_same_room_sound(skin):
    room = simulate_room_sound(skin, KEY, level_db=-3.0, duration=8.0).samples / np.asarray(skin.gain)[:, None]
    np.testing.assert_allclose(room, room[:1].repeat(4, axis=0), atol=1e-12)
    nominal = np.median(noise_power(skin) / np.asarray(skin.noise_factor))
    assert (room[0] ** 2).mean() == pytest.approx(nominal * 10**-0.3, rel=0.1)


def test_people_vary_as_documented():
    """Median and spread of the logarithms of traits of many people. Two people have different traits."""
    people = [SoundingPerson.draw(key) for key in jax.random.split(KEY, 300)]
    for modality, traits in SOUND_MANNERS.items():
        for name, usual in traits.items():
            values = np.array([one.medians[modality][name] for one in people])
            logs, middle = (values, usual.median) if name == "slope" else (np.log(values), np.log(usual.median))
            assert logs.mean() == pytest.approx(middle, abs=4 * usual.spread / np.sqrt(300))
            assert logs.std() == pytest.approx(usual.spread, rel=0.2)


def test_clips_are_determined_by_their_key_alone(skin):
    people = [SoundingPerson.draw(key) for key in jax.random.split(KEY, 2)]
    clips = list(simulate_sound_clips(KEY, skin, people, 1, duration=0.6))
    assert [(one.person, one.modality) for one in clips] == [(who, what) for who in range(2) for what in MODALITIES]
    again = list(simulate_sound_clips(KEY, skin, people, 1, duration=0.6))
    for one, other in zip(clips, again, strict=True):
        np.testing.assert_array_equal(one.samples, other.samples)
        assert one.samples.shape == (4, 6000)
        assert np.isfinite(one.samples).all()
        loudness = (one.touch.samples**2).mean()
        assert (loudness > 0) == (one.modality != "none")
        np.testing.assert_allclose(one.with_louder_noise(20.0) - one.touch.samples, 10 * one.noise)
    assert not np.allclose(clips[0].samples, clips[5].samples)


def test_a_stroke_stays_on_the_skin_and_turns(skin):
    person = SoundingPerson.draw(KEY)
    made = person.touch(KEY, "stroke", skin, duration=2.9)
    assert np.abs(made.position).max() <= 0.1
    steps = np.diff(made.position, axis=0)
    assert (np.sum(steps[1:] * steps[:-1], axis=1) < 0).any()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda skin: simulate_wind(skin, KEY, (0.5, 0.0)), "off the skin"),
        (lambda skin: simulate_wind(skin, KEY, WHERE, strength=0.0), "strength must be a positive"),
        (lambda skin: simulate_wind(skin, KEY, WHERE, gusts=-1.0), "gusts must be zero or positive"),
        (lambda skin: simulate_room_sound(skin, KEY, level_db=np.inf), "level_db must be finite"),
        (lambda skin: simulate_sound_clips(KEY, skin, [], 1), "people: give one"),
        (lambda skin: simulate_sound_clips(KEY, skin, [SoundingPerson.draw(KEY)], 0), "each must be"),
        (lambda skin: simulate_sound_clips(KEY, skin, [SoundingPerson.draw(KEY)], 1, modalities=["slap"]), "slap"),
        (lambda skin: SoundingPerson.draw(KEY).touch(KEY, "hit", skin), "modality"),
        (lambda skin: SoundingPerson({"pat": {}}), r"medians\['pat'\] must have strength"),
    ],
)
def test_bad_input_is_explained(call, message, skin):
    with pytest.raises(ValueError, match=message):
        call(skin)
