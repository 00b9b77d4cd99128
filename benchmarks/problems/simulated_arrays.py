"""Random arrays of microphones and the sound that they receive, computed in NumPy without jeit's decay models.

Microphones beneath a rectangular layer receive the sound of a source on the layer. Sound travels along the straight
path and along the paths from mirror images of the source in the edges, each edge with its own reflection. Along a path
of length ρ, the amplitude falls as a power of ρ, or as in a three-dimensional body nearby and as in a sheet at a
distance, and as exp(−α(f) ρ), where α grows with the frequency f. Paths add with their phases. Effects that do not
depend on distance are added: coupling that differs from place to place, leaks between channels, gains, noise, taps that
are slightly displaced from their stated places, and dead microphones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

RATE, SAMPLES = 2500.0, 500
# Start and length of a burst in seconds, within an interval of 0.2 s. The rest of the interval is silence.
ONSET, BURST = 0.06, 0.06
SILENT = 5
_LOW, _HIGH, _NOMINAL = 60.0, 900.0, 200.0


@dataclass(frozen=True)
class Ranges:
    """Intervals of the random parameters.

    Parameters are drawn uniformly, or uniformly in the logarithm if both ends are positive and far apart (`side`,
    `attenuation`, `speed`). Units are metres, hertz and decibels.
    """

    side: tuple[float, float] = (0.08, 0.4)
    aspect: tuple[float, float] = (0.4, 1.0)
    microphones: tuple[int, int] = (6, 36)
    depth: tuple[float, float] = (0.001, 0.012)
    # Length at which the intensity decays by a factor e at 200 Hz, probability that it does not decay, power of the
    # distance with which the intensity falls by spreading, and probability that it instead spreads as in a
    # three-dimensional body nearby and as in a sheet at a distance.
    attenuation: tuple[float, float] = (0.02, 0.3)
    lossless: float = 0.15
    frequency_exponent: tuple[float, float] = (0.0, 1.5)
    spreading: tuple[float, float] = (0.5, 3.0)
    guided: float = 0.3
    speed: tuple[float, float] = (8.0, 80.0)
    reflection: tuple[float, float] = (-0.8, 0.8)
    slope: tuple[float, float] = (0.0, 2.0)
    gain_db: tuple[float, float] = (0.0, 6.0)
    uneven: tuple[float, float] = (0.0, 0.25)
    leak: tuple[float, float] = (0.0, 0.1)
    signal_to_noise: tuple[float, float] = (10.0, 45.0)
    strength: tuple[float, float] = (0.1, 0.8)
    tap_side: tuple[int, int] = (6, 13)
    repeats: tuple[int, int] = (1, 3)
    misplaced: tuple[float, float] = (0.0, 0.003)
    dead: float = 0.15


# The ranges for the choice of jeit's defaults, and the ranges for the single evaluation of the defaults, with other
# intervals.
DEVELOPMENT = Ranges(
    side=(0.12, 0.3),
    aspect=(0.6, 1.0),
    microphones=(9, 30),
    depth=(0.003, 0.01),
    attenuation=(0.03, 0.15),
    lossless=0.25,
    frequency_exponent=(0.5, 1.2),
    spreading=(1.0, 2.5),
    speed=(10.0, 50.0),
    reflection=(-0.5, 0.7),
    slope=(0.5, 1.5),
    gain_db=(0.0, 4.0),
    uneven=(0.05, 0.2),
    leak=(0.0, 0.05),
    signal_to_noise=(15.0, 40.0),
    strength=(0.2, 0.6),
    tap_side=(7, 12),
    misplaced=(0.0, 0.002),
    dead=0.1,
)
REPORTED = Ranges()


@dataclass(frozen=True)
class SimulatedArray:
    """The description of an array of microphones, and the sound that it receives.

    For M microphones, T taps, N touches and S samples per interval, in metres: positions `microphones` (M, 2), corners
    `outline` (4, 2), stated positions `places` (T, 2) of the taps, sound `taps` (T, M, S) of the taps, true positions
    `touches` (N, 2) of the touches, and their `sound` one after the other, followed by `SILENT` silent intervals of the
    same length, (M, (N + SILENT) S), sampled at `RATE`. `sampled`: whether the data are samples or the `intensity` of
    each burst above the floor. `law`: decay of sound, as text.
    """

    microphones: Float[np.ndarray, "M 2"]
    outline: Float[np.ndarray, "4 2"]
    places: Float[np.ndarray, "T 2"]
    taps: Float[np.ndarray, "T M S"]
    touches: Float[np.ndarray, "N 2"]
    sound: Float[np.ndarray, "M L"]
    sampled: bool
    law: str

    def intensity(self, sound: Float[np.ndarray, "N M S"]) -> tuple[Float[np.ndarray, "N M"], Float[np.ndarray, " M"]]:
        """Mean square of each burst above the noise floor, and the noise floor, which is estimated from the silence
        before the taps."""
        quiet, loud = round(ONSET * RATE), round((ONSET + BURST) * RATE)
        floor = (self.taps[:, :, : quiet - 10] ** 2).mean(axis=(0, 2))
        return (sound[:, :, quiet:loud] ** 2).mean(axis=2) - floor, floor

    @property
    def stretches(self) -> Float[np.ndarray, "L M S"]:
        """The sound of each touch and of each silent interval."""
        return self.sound.reshape(len(self.microphones), -1, SAMPLES).swapaxes(0, 1)


def draw_array(ranges: Ranges, seed: int, *, touches: int = 40) -> SimulatedArray:
    """Draw an array from `ranges`, reproducible from `seed`."""
    rng = np.random.default_rng(seed)
    layer = _Layer.drawn(ranges, rng)
    count = len(layer.microphones)
    rows = int(rng.integers(ranges.tap_side[0], ranges.tap_side[1] + 1))
    columns = max(5, round(rows * layer.size[1] / layer.size[0]))
    if rng.random() < 0.6:
        axes = [0.46 * side * np.linspace(-1, 1, num) for side, num in zip(layer.size, (rows, columns), strict=True)]
        places = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    else:
        places = 0.96 * layer.size * (rng.random((rows * columns, 2)) - 0.5)
    places = places.repeat(int(rng.integers(ranges.repeats[0], ranges.repeats[1] + 1)), axis=0)
    off = rng.uniform(*ranges.misplaced) * rng.normal(size=places.shape)
    edge = 0.499 * layer.size
    spread = rng.uniform(*ranges.strength)
    tap_sound = layer.listen(np.clip(places + off, -edge, edge), np.exp(spread * rng.normal(size=len(places))), rng)
    where = 0.9 * layer.size * (rng.random((touches, 2)) - 0.5)
    touched = layer.listen(where, np.exp(spread * rng.normal(size=touches)), rng)
    touched = np.concatenate([touched, np.zeros((SILENT, *touched.shape[1:]))])
    # Mean square of the mean tap at the microphone that receives it best, from which the noise follows.
    loudest = (tap_sound[:, :, round(ONSET * RATE) :] ** 2).mean(axis=2).max(axis=1).mean() * (SAMPLES / RATE) / BURST
    level = loudest * 10 ** (-rng.uniform(*ranges.signal_to_noise) / 10)
    noise = np.sqrt(level * 10 ** (0.1 * rng.normal(size=count)))
    dead = np.flatnonzero(rng.random(count) < (ranges.dead / 3 if rng.random() < 3 * ranges.dead else 0.0))[: count - 5]
    for sound in (tap_sound, touched):
        sound += noise[:, None] * rng.normal(size=sound.shape)
        sound[:, dead] = 0.0
    corners = 0.5 * layer.size * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    sampled = bool(rng.random() < 0.5)
    joined = touched.swapaxes(0, 1).reshape(count, -1)
    return SimulatedArray(layer.microphones, corners, places, tap_sound, where, joined, sampled, layer.law)


def steep_array(length: float, seed: int = 0, **changed: Any) -> SimulatedArray:
    """An array of 25 microphones under 200 × 200 mm, in which intensity falls as exp(−r / `length`) in addition to
    spreading, with reflecting edges.

    The decay model a / (r² + b) alone does not describe this array.
    """
    steep = {"side": (0.2, 0.2), "aspect": (1.0, 1.0), "microphones": (25, 25), "attenuation": (length, length)}
    plain = {
        "lossless": 0.0,
        "frequency_exponent": (0.0, 0.0),
        "spreading": (2.0, 2.0),
        "guided": 0.0,
        "depth": (0.008, 0.008),
    }
    quiet = {"signal_to_noise": (35.0, 35.0), "uneven": (0.02, 0.02), "misplaced": (0.0, 0.0), "dead": 0.0}
    reflecting = {"reflection": (0.4, 0.6), "leak": (0.0, 0.0), "tap_side": (9, 9), "gain_db": (2.0, 2.0)}
    return draw_array(replace(DEVELOPMENT, **(steep | plain | quiet | reflecting | changed)), seed)


@dataclass(frozen=True)
class _Layer:
    """A layer `size` (2,) in metres about the origin, and the microphones beneath it."""

    size: np.ndarray
    microphones: np.ndarray
    depth: np.ndarray
    gain: np.ndarray
    leak: np.ndarray
    loss: np.ndarray  # (F,) nepers of amplitude per metre
    power: float  # of the distance; NaN: a body's nearby, a sheet's at a distance
    thickness: float
    speed: float
    reflection: np.ndarray  # (2, 2): of the lower and upper edge along each axis
    frequencies: np.ndarray
    colour: np.ndarray  # (F,) amplitude of the source
    waves: np.ndarray  # (W, M, 3): wave numbers and phase of the variation between places
    uneven: float
    law: str

    @classmethod
    def drawn(cls, ranges: Ranges, rng: np.random.Generator) -> _Layer:
        side = np.exp(rng.uniform(*np.log(ranges.side)))
        size = side * np.array([1.0, rng.uniform(*ranges.aspect)])
        microphones = _arranged(size, int(rng.integers(ranges.microphones[0], ranges.microphones[1] + 1)), rng)
        count = len(microphones)
        frequencies = np.fft.rfftfreq(SAMPLES, 1 / RATE)
        band = (frequencies >= _LOW) & (frequencies <= _HIGH)
        colour = np.where(band, np.maximum(frequencies, 1.0) ** (-0.5 * rng.uniform(*ranges.slope)), 0.0)
        length = np.inf if rng.random() < ranges.lossless else np.exp(rng.uniform(*np.log(ranges.attenuation)))
        exponent = rng.uniform(*ranges.frequency_exponent)
        loss = 0.5 / length * (np.maximum(frequencies, 1.0) / _NOMINAL) ** exponent
        power = rng.uniform(*ranges.spreading) if rng.random() < 1 - ranges.guided else np.nan
        leak = np.eye(count) + np.diag(np.full(count - 1, rng.uniform(*ranges.leak)), 1)
        depth = rng.uniform(*ranges.depth) * np.exp(0.1 * rng.normal(size=count))
        gain = 10 ** (rng.uniform(*ranges.gain_db) * rng.normal(size=count) / 20)
        direction, wave = rng.uniform(0, 2 * np.pi, (2, 6, count)), rng.uniform(0.03, 0.15, (6, count))
        turns = 2 * np.pi / wave * np.stack([np.cos(direction[0]), np.sin(direction[0])])
        waves = np.stack([*turns, direction[1]], axis=-1)
        falls = "guided" if np.isnan(power) else f"r^-{power:.1f}"
        law = f"{falls}, {1e3 * length:.0f} mm at 200 Hz, f^{exponent:.1f}"
        thickness, speed = rng.uniform(0.005, 0.02), np.exp(rng.uniform(*np.log(ranges.speed)))
        reflection, uneven = rng.uniform(*ranges.reflection, (2, 2)), rng.uniform(*ranges.uneven)
        drawn_values = (loss, power, thickness, speed, reflection, frequencies[band], colour[band], waves, uneven, law)
        return cls(size, microphones, depth, gain, leak, loss[band], *drawn_values[1:])

    def listen(self, places: np.ndarray, strengths: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Sound (N, M, SAMPLES) at M microphones of bursts at `places` (N, 2), without noise."""
        result = np.empty((len(places), len(self.microphones), SAMPLES))
        times = np.arange(SAMPLES) / RATE - ONSET
        envelope = np.where((times >= 0) & (times <= BURST), np.sin(np.pi * np.clip(times / BURST, 0, 1)), 0.0)
        bins = np.rint(self.frequencies * SAMPLES / RATE).astype(int)
        for k, (place, strength) in enumerate(zip(places, strengths, strict=True)):
            spectrum = np.zeros((len(self.microphones), SAMPLES // 2 + 1), complex)
            source = np.fft.rfft(strength * envelope * rng.normal(size=SAMPLES))[bins] * self.colour
            spectrum[:, bins] = self.leak @ (self._transfer(place) * source)
            result[k] = np.fft.irfft(spectrum, SAMPLES)
        return result

    def _transfer(self, place: np.ndarray) -> np.ndarray:
        """Transfer function (microphones, frequencies) from `place` to the microphones: the sum of all paths with their
        phases, times coupling and gain."""
        images, echoes = zip(*(self._images(axis, place[axis]) for axis in range(2)), strict=True)
        x, y = np.meshgrid(*images, indexing="ij")
        echo = np.outer(*echoes).ravel()
        kept = np.abs(echo) > 1e-3
        offset = np.stack([x.ravel(), y.ravel()], axis=-1)[kept] - self.microphones[:, None]
        length = np.sqrt((offset**2).sum(axis=-1) + self.depth[:, None] ** 2)
        phase = 2j * np.pi * self.frequencies / self.speed + self.loss
        paths = echo[kept] * self._spread(length)
        total = np.einsum("mp,mpf->mf", paths, np.exp(-phase * length[..., None]))
        turned = self.waves[..., 0] * place[0] + self.waves[..., 1] * place[1] + self.waves[..., 2]
        coupling = np.exp(self.uneven * np.sqrt(2 / len(self.waves)) * np.cos(turned).sum(axis=0) / 2)
        return (self.gain * coupling)[:, None] * total

    def _images(self, axis: int, coordinate: float) -> tuple[np.ndarray, np.ndarray]:
        """Mirror images of a coordinate in the two edges of an axis, up to the second order, and the reflected fraction
        of the amplitude for each image."""
        side, (low, high) = self.size[axis], self.reflection[axis]
        images = [coordinate, -side - coordinate, side - coordinate, coordinate - 2 * side, coordinate + 2 * side]
        return np.array(images), np.array([1.0, low, high, low * high, low * high])

    def _spread(self, length: np.ndarray) -> np.ndarray:
        if np.isnan(self.power):
            return np.sqrt(1 + length / self.thickness) * self.thickness / length
        return (length / self.thickness) ** (-0.5 * self.power)


def _arranged(size: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Positions of microphones in a regular grid, in an irregular grid, at random with a least distance, or along the
    edge and inside."""
    way = rng.integers(4)
    if way < 2:
        columns = max(2, round(np.sqrt(count * size[0] / size[1])))
        rows = max(2, round(count / columns))
        axes = [
            0.8 * side * (np.arange(num) - (num - 1) / 2) / num for side, num in zip(size, (columns, rows), strict=True)
        ]
        spots = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        return spots + way * 0.12 * size / np.array([columns, rows]) * rng.uniform(-1, 1, spots.shape)
    if way == 2:
        tried = 0.85 * size * (rng.random((100 * count, 2)) - 0.5)
        apart, kept = 0.6 * np.sqrt(np.prod(size) / count), [tried[0]]
        for spot in tried[1:]:
            if np.linalg.norm(spot - np.array(kept), axis=1).min() > apart and len(kept) < count:
                kept.append(spot)
        return np.array(kept)
    inner = max(1, count // 4)
    angle = 2 * np.pi * (np.arange(count - inner) + rng.random()) / (count - inner)
    turned = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rim = 0.43 * size * turned / np.abs(turned).max(axis=1, keepdims=True)
    around = 2 * np.pi * np.arange(inner) / inner + 0.3
    return np.concatenate([rim, 0.18 * size * np.stack([np.cos(around), np.sin(around)], axis=-1)])
