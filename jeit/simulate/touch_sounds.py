"""Touches on a simulated acoustic skin: taps, pats, tickles, strokes, with the truth beside the samples.

A touch of soft rubber is random noise in a band, in bursts or steadily. White noise is shaped in time first and in
frequency after, so that a touch of envelope e(t) at one place is received, on average over keys, with the energy Σ e²
times `expected_power`, but for what rings on beyond the recording's ends.
Every function takes an explicit key: the same key, the same samples.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.fft import next_fast_len

from jeit.simulate.sounding_skin import (
    SoundingSkin,
    band_filter,
    check_inside,
    check_positive,
    noise_power,
    source_density,
    transfer,
)

# A moving source stands still for one Hann block of two hops; the blocks overlap by half and sum to one. In 10 ms a
# brisk stroke of 0.5 m/s moves by 5 mm, well under the distances over which loudness changes.
HOP = 0.01
# The source's filter has no phase: it rings before and after a burst, for about the inverse of its lowest frequency.
RINGING = 0.05
# Friction turns force times speed into heat and sound: a stroke's power goes as its speed, its amplitude as the root.
NOMINAL_SPEED = 0.1
# When the first burst begins, seconds: time for its ringing.
ONSET = 0.02
# How many values of a calibration are made at once: 32 MB.
PIECE = 2**22


class SimulatedSound(eqx.Module):
    """What the channels of a skin read during a touch, and the truth about it.

    **Fields**: `samples` (M, S), in units of the skin's sources; `rate`, samples per second; `position` (N, 2) metres,
    where the source is (or was last, or will be first) at `position_times` (N,), seconds; N is 0 for `quiet`. `active`
    (S,): the source's root mean square at `times`, when it leaves the source. `noisy`: whether noise was added.
    """

    samples: Float[np.ndarray, "M S"]
    rate: float
    position: Float[np.ndarray, "N 2"]
    position_times: Float[np.ndarray, " N"]
    active: Float[np.ndarray, " S"]
    noisy: bool = eqx.field(static=True)

    @property
    def times(self) -> np.ndarray:
        """When the first channel is sampled, (S,) seconds from the start; the others follow by `skin.stagger`."""
        return np.arange(self.samples.shape[1]) / self.rate


class CalibrationTaps(eqx.Module):
    """Taps at known places: `samples` (T, M, S), `rate`, `positions` (T, 2) metres, `strengths` (T,)."""

    samples: Float[np.ndarray, "T M S"]
    rate: float
    positions: Float[np.ndarray, "T 2"]
    strengths: Float[np.ndarray, " T"]


def tap(
    skin: SoundingSkin,
    key: Array,
    position,
    *,
    strength: float = 1.0,
    repeats: int = 1,
    frequency: float = 10.0,
    length: float = 0.06,
    duration: float = 0.15,
    noise: bool = True,
) -> SimulatedSound:
    """Bursts at one `position` (2,), metres, as of a vibrator with a rubber tip: `repeats` of them at `frequency`, Hz.

    Each rises fast and dies away within `length` seconds, over which its root mean square is `strength`. `duration` of
    the recording in seconds, made longer where the bursts need it. `noise`: whether to add the microphones' own.
    Raises `ValueError`.
    """
    check_positive("frequency", frequency)
    if repeats < 1:
        raise ValueError(f"repeats: give at least one tap, not {repeats}.")
    _check_burst(strength, length, duration)
    onsets = ONSET + np.arange(repeats) / frequency
    times = _times(skin, max(duration, onsets[-1] + length + 0.03))
    envelope = _bursts(times, onsets, length, np.full(repeats, strength))
    return _record(skin, key, _one(skin, position), envelope, noise)


def pat(
    skin: SoundingSkin,
    key: Array,
    position,
    *,
    taps: int = 3,
    interval: float = 0.3,
    strength: float = 2.0,
    length: float = 0.08,
    duration: float = 1.0,
    noise: bool = True,
) -> SimulatedSound:
    """A few firm taps of a hand at one `position` (2,), metres, `interval` seconds apart; see `tap`."""
    check_positive("interval", interval)
    return tap(
        skin,
        key,
        position,
        strength=strength,
        repeats=taps,
        frequency=1 / interval,
        length=length,
        duration=duration,
        noise=noise,
    )


def tickle(
    skin: SoundingSkin,
    key: Array,
    position,
    *,
    radius: float = 0.01,
    taps_per_second: float = 15.0,
    strength: float = 0.7,
    length: float = 0.04,
    duration: float = 1.0,
    noise: bool = True,
) -> SimulatedSound:
    """Many light taps that wander round `position` (2,), metres, of random strength and rhythm.

    Each lands within `radius` metres of `position` (at the edge, on the skin), half way between a new place there and
    the place before it. Strengths are log-normal about `strength` with standard deviation 0.3 in the logarithm, the
    times random by a quarter of the interval. Raises `ValueError`.
    """
    middle = _one(skin, position)[0]
    check_positive("radius", radius)
    check_positive("taps_per_second", taps_per_second)
    _check_burst(strength, length, duration)
    times = _times(skin, duration)
    count = max(1, int((duration - ONSET - length) * taps_per_second))
    where, jitter, loudness, rest = jax.random.split(key, 4)
    onsets = ONSET + (np.arange(count) + 0.25 * np.asarray(jax.random.uniform(jitter, (count,)))) / taps_per_second
    strengths = strength * np.exp(0.3 * np.asarray(jax.random.normal(loudness, (count,))))
    distance, angle = np.asarray(jax.random.uniform(where, (2, count)))
    # The root spreads places evenly over the disc.
    offsets = (radius * np.sqrt(distance) * [np.cos(2 * np.pi * angle), np.sin(2 * np.pi * angle)]).T
    for index in range(1, count):
        offsets[index] = (offsets[index - 1] + offsets[index]) / 2
    half = np.array([skin.width, skin.height]) / 2
    places = np.clip(middle + offsets, -half, half)
    # From its onset on, the source is where that tap is.
    blocks = np.maximum(np.searchsorted(onsets, _block_times(skin, len(times)) + HOP, side="right") - 1, 0)
    return _record(skin, rest, places[blocks], _bursts(times, onsets, length, strengths), noise)


def stroke(
    skin: SoundingSkin,
    key: Array,
    path,
    *,
    strength: float = 1.0,
    duration: float = 1.0,
    noise: bool = True,
) -> SimulatedSound:
    """A finger that rubs along `path`, all through `duration` seconds.

    `path`: corners (K, 2) of a line, metres, run along at even speed, or a function of times (N,) in seconds that gives
    positions (N, 2). `strength`: root mean square at 0.1 m/s; it goes as the square root of the speed. Raises
    `ValueError` for paths that leave the skin, or stand still.
    """
    check_positive("strength", strength)
    check_positive("duration", duration)
    times = _times(skin, duration)
    follow = path if callable(path) else _polyline(skin, path, duration)
    track = check_inside("path", follow(times), skin.width, skin.height)
    if len(track) != len(times):
        raise ValueError(f"path: the function gave {len(track)} positions for {len(times)} times; give one for each.")
    speed = np.linalg.norm(np.gradient(track, times, axis=0), axis=1)
    if not speed.any():
        raise ValueError("path: the finger stands still, which makes no sound. Give a path with some length, or a tap.")
    # Fingers do not begin or end in a microsecond.
    ends = np.sin(np.pi / 2 * np.clip(np.minimum(times, duration - times) / 0.02, 0, 1))
    centres = _block_times(skin, len(times))
    places = np.stack([np.interp(centres, times, axis) for axis in track.T], axis=-1)
    return _record(skin, key, places, strength * np.sqrt(speed / NOMINAL_SPEED) * ends, noise)


def quiet(skin: SoundingSkin, key: Array, *, duration: float = 1.0) -> SimulatedSound:
    """The microphones' own noise and nothing else, for `duration` seconds."""
    check_positive("duration", duration)
    times = _times(skin, duration)
    samples = _noise(skin, key, len(times))
    return SimulatedSound(samples, skin.rate, np.zeros((0, 2)), np.zeros(0), np.zeros(len(times)), True)


def superpose(skin: SoundingSkin, key: Array | None, *recordings: SimulatedSound) -> Float[np.ndarray, "M S"]:
    """Samples (M, S) of several touches at once, the microphones' noise added once; with key None, none is.

    The recordings must be of one skin and length and made with `noise=False`, or noise would count twice: `ValueError`.
    """
    if not recordings:
        raise ValueError("recordings: give at least one.")
    if any(recording.noisy for recording in recordings):
        raise ValueError("recordings: make them with noise=False; noise is added once, here.")
    shapes = {(recording.samples.shape, recording.rate) for recording in recordings}
    if len(shapes) > 1 or recordings[0].samples.shape[0] != skin.num_microphones or recordings[0].rate != skin.rate:
        raise ValueError(
            f"recordings: all must come from this skin and last equally long; shapes and rates are {shapes}."
        )
    together = np.sum([recording.samples for recording in recordings], axis=0)
    return together if key is None else together + _noise(skin, key, together.shape[1])


def calibration_taps(
    skin: SoundingSkin,
    key: Array,
    positions,
    *,
    repeats: int = 3,
    strength: float = 1.0,
    strength_spread: float = 0.3,
    length: float = 0.06,
    duration: float = 0.15,
    noise: bool = True,
) -> CalibrationTaps:
    """`repeats` taps at each of `positions` (P, 2), metres: T = P · repeats recordings, those of one place together.

    Strengths are log-normal about `strength` with standard deviation `strength_spread` in the logarithm, as a hand's
    or a vibrator's are: whoever calibrates does not know them. Otherwise as `tap`. Raises `ValueError`.
    """
    places = check_inside("positions", positions, skin.width, skin.height)
    if repeats < 1:
        raise ValueError(f"repeats: give at least one tap for each position, not {repeats}.")
    if not (np.isfinite(strength_spread) and strength_spread >= 0):
        raise ValueError(f"strength_spread must be zero or positive; it is {strength_spread}.")
    _check_burst(strength, length, duration)
    times = _times(skin, duration)
    loudness, rest = jax.random.split(key)
    strengths = strength * np.exp(strength_spread * np.asarray(jax.random.normal(loudness, (len(places), repeats))))
    envelope = _bursts(times, np.array([ONSET]), length, np.array([1.0]))
    size = _transform_size(len(times), skin.longest_delay + RINGING, skin.rate)
    samples = np.empty((len(places), repeats, skin.num_microphones, len(times)))
    level = noise_power(skin) if noise else None
    keys = jax.random.split(rest, len(places))
    # In pieces of one size, so that next to the result little else takes memory, and one program serves them all.
    pieces = min(len(places), -(-samples.size // PIECE))
    for part in np.array_split(np.arange(-(-len(places) // pieces) * pieces), pieces):
        part = np.minimum(part, len(places) - 1)
        samples[part] = _still(
            skin, keys[part], places[part], strengths[part], envelope, level, size, _bins(skin, size)
        )
    return CalibrationTaps(
        samples.reshape(-1, *samples.shape[2:]), skin.rate, np.repeat(places, repeats, axis=0), strengths.ravel()
    )


def _record(skin: SoundingSkin, key: Array, places: np.ndarray, envelope: np.ndarray, noise: bool) -> SimulatedSound:
    """What is read of a source of root mean square `envelope` (S,), in the blocks at `places` (B, 2), or (1, 2)."""
    source, own = jax.random.split(key)
    count, centres = len(envelope), _block_times(skin, len(envelope))
    places = np.broadcast_to(places, (len(centres), 2))
    whole = _transform_size(count, RINGING, skin.rate)
    block = _transform_size(2 * round(HOP * skin.rate), skin.longest_delay, skin.rate)
    samples = np.asarray(_moving(skin, source, places, envelope, whole, block, _bins(skin, block, blur=4 / HOP)))
    if noise:
        samples = samples + _noise(skin, own, count)
    kept = centres <= count / skin.rate
    return SimulatedSound(samples, skin.rate, np.array(places[kept]), centres[kept], envelope, noise)


def _frequencies(skin: SoundingSkin, size: int, bins: int) -> Array:
    return jnp.arange(bins) * (skin.rate / size)


def _bins(skin: SoundingSkin, size: int, *, blur: float = 0.0) -> int:
    """How many bins of a real transform of `size` samples are not empty: half an octave over the band, and `blur`."""
    return min(int((np.sqrt(2) * skin.band[1] + blur) * size / skin.rate) + 1, size // 2)


def _transform_size(count: int, padding: float, rate: float) -> int:
    """A length of transform that is quick, for `count` samples and `padding` seconds of zeros or more."""
    needed = count + int(np.ceil(padding * rate))
    return 2 * int(np.asarray(next_fast_len((needed + 1) // 2)))


def _source(skin: SoundingSkin, key: Array, envelope: Array, size: int, bins: int) -> Array:
    """Transform (bins,) of white noise under `envelope`, filtered to the source's density.

    Real noise of variance 1 has the density 2 / rate over its positive frequencies.
    """
    white = jnp.fft.rfft(jax.random.normal(key, envelope.shape) * envelope, size)[:bins]
    return white * jnp.sqrt(source_density(skin, _frequencies(skin, size, bins)) * skin.rate / 2)


@partial(jax.jit, static_argnums=(4, 5, 6))
def _moving(skin, key, places, envelope, whole, block, bins):
    count, hop = envelope.shape[0], round(HOP * skin.rate)
    sound = jnp.fft.irfft(_source(skin, key, envelope, whole, whole // 2 + 1), whole)[:count]
    sound = jnp.pad(sound, (hop, places.shape[0] * hop + hop - count))
    window = jnp.sin(jnp.pi * jnp.arange(2 * hop) / (2 * hop)) ** 2
    frequencies = _frequencies(skin, block, bins)

    def step(output, item):
        index, place = item
        piece = jax.lax.dynamic_slice(sound, (index * hop,), (2 * hop,)) * window
        spectrum = jnp.fft.rfft(piece, block)[:bins] * transfer(skin, frequencies, place)
        here = jax.lax.dynamic_slice(output, (0, index * hop), (output.shape[0], block))
        return jax.lax.dynamic_update_slice(output, here + jnp.fft.irfft(spectrum, block), (0, index * hop)), None

    output = jnp.zeros((skin.num_microphones, places.shape[0] * hop + block))
    output, _ = jax.lax.scan(step, output, (jnp.arange(places.shape[0]), places))
    return output[:, hop : hop + count]


@partial(jax.jit, static_argnums=(6, 7))
def _still(skin, keys, places, strengths, envelope, level, size, bins):
    frequencies = _frequencies(skin, size, bins)

    def at(item):
        key, place, loudness = item
        sources, own = jax.random.split(key)
        channels = transfer(skin, frequencies, place)

        def once(key, own, strength):
            spectrum = strength * _source(skin, key, envelope, size, bins) * channels
            if level is not None:
                spectrum += _noise_spectrum(skin, own, level, size, bins)
            return jnp.fft.irfft(spectrum, size)[:, : len(envelope)]

        repeats = len(loudness)
        return jax.vmap(once)(jax.random.split(sources, repeats), jax.random.split(own, repeats), loudness)

    return jax.lax.map(at, (keys, places, strengths))


def _noise_spectrum(skin: SoundingSkin, key: Array, level: Array, size: int, bins: int) -> Array:
    """Transform (M, bins) of noise of mean square `level` (M,), flat in the band.

    Of a real signal of `size` samples, bin k > 0 with variance v_k adds 2 v_k / size² to the mean square.
    """
    shape = band_filter(skin, _frequencies(skin, size, bins))
    variance = level[:, None] * shape / jnp.sum(shape) * size**2 / 2
    draws = jax.random.normal(key, (2, *variance.shape))
    return jnp.sqrt(variance / 2) * (draws[0] + 1j * draws[1])


@partial(jax.jit, static_argnums=(3, 4, 5))
def _noise_samples(skin, key, level, count, size, bins):
    return jnp.fft.irfft(_noise_spectrum(skin, key, level, size, bins), size)[:, :count]


def _noise(skin: SoundingSkin, key: Array, count: int) -> np.ndarray:
    # Noise made from a spectrum repeats after `size` samples; a tail that is cut off parts its end from its beginning.
    size = _transform_size(count, RINGING, skin.rate)
    return np.asarray(_noise_samples(skin, key, noise_power(skin), count, size, _bins(skin, size)))


def _times(skin: SoundingSkin, duration: float) -> np.ndarray:
    return np.arange(max(2, round(duration * skin.rate))) / skin.rate


def _check_burst(strength: float, length: float, duration: float) -> None:
    check_positive("strength", strength)
    check_positive("length", length)
    check_positive("duration", duration)
    if duration < ONSET + length:
        raise ValueError(
            f"duration: a burst of {length:g} s that begins at {ONSET:g} s does not fit in {duration:g} s. Give at "
            f"least {ONSET + length:g} s, or a shorter length."
        )


def _block_times(skin: SoundingSkin, count: int) -> np.ndarray:
    """The middles of the blocks that cover `count` samples, seconds: 0, one hop, two hops, ..."""
    return HOP * np.arange(int(np.ceil(count / round(HOP * skin.rate))) + 1)


def _bursts(times: np.ndarray, onsets: np.ndarray, length: float, strengths: np.ndarray) -> np.ndarray:
    """Envelope (S,) of bursts t e^(-t / a), a = length / 6: risen in a sixth of `length`, at its end down to 4 %.

    Its square, t² e^(-2t / a), integrates to a³ / 4: divided by `length`, that is the mean square to scale by.
    """
    rise = length / 6
    after = np.maximum(times - onsets[:, None], 0)
    shape = after * np.exp(-after / rise) / np.sqrt(rise**3 / 4 / length)
    # Bursts that overlap are independent noises: their powers add.
    return np.sqrt(((strengths[:, None] * shape) ** 2).sum(axis=0))


def _polyline(skin: SoundingSkin, corners, duration: float) -> Callable[[np.ndarray], np.ndarray]:
    place = check_inside("path", corners, skin.width, skin.height)
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
    return lambda times: np.stack([np.interp(times / duration * along[-1], along, axis) for axis in place.T], axis=-1)


def _one(skin: SoundingSkin, position) -> np.ndarray:
    return check_inside("position", np.asarray(position, float)[None], skin.width, skin.height)
