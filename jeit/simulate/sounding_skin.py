"""A simulated acoustic skin: what microphones under an elastomer layer receive from a touch on its surface.

No openly licensed recording of a skin with microphones exists; this stands in where one is needed. Sound is propagated
frequency by frequency, with spreading, viscoelastic loss, delays and echoes of the edges, so that localisation is
*not* tested on the decay model a/(r² + b) that it fits. The setup is that of Park et al., Science Robotics 7,
eabm7187 (2022); `jeit.simulate.touch_sounds` makes the touches.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

# Text S3: eight 4:1 multiplexers step together every 25 µs, so each microphone is sampled every 100 µs.
STEP = 25e-6
SLOTS = 4


class SoundingSkin(eqx.Module):
    """A rectangular elastomer layer, centred at the origin, with microphones under its surface.

    A source of strength 1 is one whose sound, received by a nominal microphone right below it with no loss and no
    echoes, would have a mean square of 1; this is the (arbitrary) unit of all samples.

    **Fields**

    - `microphones` (M, 2), metres; `microphone_depth` (M,) metres under the surface; `gain` (M,), in amplitude;
      `noise_factor` (M,), power of each microphone's own noise relative to the nominal one.
    - `width`, `height`, `thickness`, `depth` (nominal depth of the microphones): metres.
    - `shear_modulus` in pascals and `density` in kg/m³: what a touch radiates in so soft a layer are mostly shear
      waves, of speed √(modulus / density). About 100 kPa, a soft silicone, gives 10 m/s (at `attenuation_frequency`).
    - `attenuation` in nepers per metre at `attenuation_frequency` (Hz), growing as frequency to the
      `attenuation_exponent`. With loss tangent d it is π f d / speed; 4 /m at 100 Hz is d = 0.13, as of soft rubber.
    - `reflection`: amplitude of the echo of an edge. -1 for a clamped edge, +1 for a free one; a layer that ends in a
      soft seal or frame lies near zero, between about -0.3 and 0.3.
    - `band` (low, high), Hz, where the source and the analogue filters have half their power; `spectral_slope`: the
      power density of a touch falls as frequency to minus this (1: 3 dB per octave).
    - `coupling`: amplitude of what is left, in a multiplexer, of the microphone read 25 µs earlier. -35 dB is 0.018.
    - `reach`, metres, and `snr_db`: a steady source of strength 1 at horizontal distance `reach` from a nominal
      microphone, no edge near, is received with this signal-to-noise ratio in the band. The paper's microphones sense
      from "about 5.5 cm" (Fig. S15), read here as 0 dB.
    - `multiplexed`: samples at 10 kHz, microphone i later than the first by (i mod 4) · 25 µs; or all microphones at
      once at 40 kHz, with no coupling. The paper's device has 8 inputs; here there are as many as M needs.
    """

    microphones: Float[Array, "M 2"]
    microphone_depth: Float[Array, " M"]
    gain: Float[Array, " M"]
    noise_factor: Float[Array, " M"]
    width: float
    height: float
    thickness: float
    depth: float
    shear_modulus: float
    density: float
    attenuation: float
    attenuation_frequency: float
    attenuation_exponent: float
    reflection: float
    band: tuple[float, float]
    spectral_slope: float
    coupling: float
    reach: float
    snr_db: float
    multiplexed: bool = eqx.field(static=True)

    def __init__(
        self,
        key: Array,
        microphones=None,
        *,
        width: float = 0.2,
        height: float = 0.2,
        thickness: float = 0.01,
        depth: float = 0.01,
        shear_modulus: float = 1e5,
        density: float = 1e3,
        attenuation: float = 4.0,
        attenuation_frequency: float = 100.0,
        attenuation_exponent: float = 1.2,
        reflection: float = 0.2,
        band: tuple[float, float] = (60.0, 900.0),
        spectral_slope: float = 1.0,
        coupling_db: float = -35.0,
        reach: float = 0.055,
        snr_db: float = 0.0,
        gain_spread_db: float = 2.0,
        depth_spread: float = 0.1,
        noise_spread_db: float = 1.0,
        multiplexed: bool = True,
    ):
        """`key` draws the microphones' spreads, all log-normal, as standard deviations: `gain_spread_db` and
        `noise_spread_db` in decibels of power, `depth_spread` relative. The same key gives the same microphones,
        whatever the other arguments. `microphones`: (M, 2) metres; `microphone_grid(5)` if not given. The default
        spreads and loss are this library's choices, not the paper's. Raises `ValueError`.
        """
        positive = {
            "width": width,
            "height": height,
            "thickness": thickness,
            "depth": depth,
            "shear_modulus": shear_modulus,
            "density": density,
            "attenuation_frequency": attenuation_frequency,
            "reach": reach,
        }
        not_negative = {
            "attenuation": attenuation,
            "gain_spread_db": gain_spread_db,
            "depth_spread": depth_spread,
            "noise_spread_db": noise_spread_db,
        }
        for name, value in positive.items():
            check_positive(name, value)
        for name, value in not_negative.items():
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"{name} must be zero or positive; it is {value}.")
        if not np.isfinite([snr_db, spectral_slope]).all():
            raise ValueError(f"snr_db and spectral_slope must be finite; they are {snr_db} and {spectral_slope}.")
        if not 0 <= attenuation_exponent <= 2:
            raise ValueError(
                f"attenuation_exponent must be from 0 to 2, in rubber 1 to 1.5; it is {attenuation_exponent}."
            )
        if not -1 <= reflection <= 1:
            raise ValueError(f"reflection: an edge returns at most what reaches it, -1 to 1; it is {reflection}.")
        if not coupling_db < 0:
            raise ValueError(f"coupling_db: a neighbour leaks in weakened, below 0 dB; it is {coupling_db}.")
        rate = 1 / (SLOTS * STEP) if multiplexed else 1 / STEP
        if len(band) != 2 or not 0 < band[0] < band[1] < rate / 2 / np.sqrt(2):
            raise ValueError(
                f"band: give (low, high) in Hz, rising, with high below {rate / 2 / np.sqrt(2):.0f} Hz so that nothing "
                f"is left at half the sampling rate; it is {band}."
            )
        place = microphone_grid(5, width=width, height=height) if microphones is None else microphones
        place = check_inside("microphones", place, width, height)
        draws = np.asarray(jax.random.normal(key, (3, len(place))))
        self.microphones = jnp.asarray(place)
        self.microphone_depth = jnp.asarray(depth * np.exp(depth_spread * draws[0]))
        self.gain = jnp.asarray(10 ** (gain_spread_db * draws[1] / 20))
        self.noise_factor = jnp.asarray(10 ** (noise_spread_db * draws[2] / 10))
        self.width, self.height, self.thickness, self.depth = width, height, thickness, depth
        self.shear_modulus, self.density = shear_modulus, density
        self.attenuation, self.attenuation_frequency = attenuation, attenuation_frequency
        self.attenuation_exponent, self.reflection = attenuation_exponent, reflection
        self.band, self.spectral_slope = (float(band[0]), float(band[1])), spectral_slope
        self.coupling = 10 ** (coupling_db / 20)
        self.reach, self.snr_db = reach, snr_db
        self.multiplexed = multiplexed

    @property
    def num_microphones(self) -> int:
        """M."""
        return self.microphones.shape[0]

    @property
    def rate(self) -> float:
        """Samples of each microphone per second."""
        return 1 / (SLOTS * STEP) if self.multiplexed else 1 / STEP

    @property
    def stagger(self) -> np.ndarray:
        """How much later than the first each microphone is sampled, (M,) seconds."""
        return STEP * (np.arange(self.num_microphones) % SLOTS) * self.multiplexed

    @property
    def wave_speed(self):
        """Speed of shear waves, metres per second."""
        return (self.shear_modulus / self.density) ** 0.5

    @property
    def longest_delay(self) -> float:
        """The time sound takes over the longest path that is simulated, seconds."""
        return 2 * float(np.hypot(self.width, self.height)) / self.wave_speed


def microphone_grid(number: int, *, width: float = 0.2, height: float = 0.2) -> np.ndarray:
    """The centres (number², 2), metres, of number x number equal cells of the skin, row by row from the lower left."""
    if number < 1:
        raise ValueError(f"number: give how many points a row has, at least 1; it is {number}.")
    along = (np.arange(number) + 0.5) / number - 0.5
    y, x = np.meshgrid(along * height, along * width, indexing="ij")
    return np.stack([x.ravel(), y.ravel()], axis=-1)


def band_filter(skin: SoundingSkin, frequencies: Float[Array, " F"]) -> Float[Array, " F"]:
    """Power response (F,) of the filters: 1 in the band, 1/2 at its ends, nothing from half an octave outside."""
    octaves = jnp.log2(jnp.maximum(frequencies, 1e-9))
    low, high = jnp.log2(skin.band[0]), jnp.log2(skin.band[1])
    rising, falling = jnp.clip(octaves - low + 0.5, 0, 1), jnp.clip(high - octaves + 0.5, 0, 1)
    return (jnp.sin(jnp.pi / 2 * rising) * jnp.sin(jnp.pi / 2 * falling)) ** 2


def source_density(skin: SoundingSkin, frequencies: Float[Array, " F"]) -> Float[Array, " F"]:
    """Power density (F,), per hertz, of a source of strength 1: it integrates to 1 over the positive frequencies."""

    def shape(f):
        return band_filter(skin, f) * (jnp.maximum(f, 1e-9) / skin.band[0]) ** -skin.spectral_slope

    # Even in log-frequency, where the filter's two skirts are equally wide: ∫ S df = ∫ S f d(ln f).
    grid = skin.band[0] * jnp.exp(jnp.linspace(-0.35, jnp.log(skin.band[1] / skin.band[0]) + 0.35, 2001))
    return shape(frequencies) / jnp.trapezoid(shape(grid) * grid, jnp.log(grid))


def _loss(skin: SoundingSkin, frequencies: Float[Array, " F"]) -> Float[Array, " F"]:
    return skin.attenuation * (frequencies / skin.attenuation_frequency) ** skin.attenuation_exponent


def _wavenumber(skin: SoundingSkin, frequencies: Float[Array, " F"]) -> Float[Array, " F"]:
    """Phase (F,) per metre, 2πf / speed, with the dispersion that a loss ∝ f^n has if no sound is to come too early.

    Kramers and Kronig's relation for a power law gives loss(f0) tan(πn/2) (x^n - x), x = f / f0, as in Szabo, J.
    Acoust. Soc. Am. 96 (1994) 491: with the default loss, speed grows by an eighth over the band.
    """
    # At n = 1 it tends to a logarithm, to which this close an n is near enough.
    exponent = jnp.where(jnp.abs(skin.attenuation_exponent - 1) < 1e-6, 1 + 1e-6, skin.attenuation_exponent)
    relative = frequencies / skin.attenuation_frequency
    dispersion = skin.attenuation * jnp.tan(jnp.pi / 2 * exponent) * (relative**exponent - relative)
    return 2 * jnp.pi * frequencies / skin.wave_speed + dispersion


def _spreading(skin: SoundingSkin, length: Array) -> Array:
    # Near its source a wave spreads as in a body (amplitude 1/ρ). Beyond a thickness or so it is guided by the layer
    # and spreads as in a sheet (1/√ρ). √(1 + ρ/thickness) / ρ has both limits.
    return jnp.sqrt((1 + length / skin.thickness) / (1 + skin.depth / skin.thickness)) * skin.depth / length


@jax.jit
def transfer(skin: SoundingSkin, frequencies: Float[Array, " F"], position: Float[Array, "2"]) -> Complex[Array, "M F"]:
    """Transfer functions (M, F) from a source at `position` to each channel: paths, gain, coupling and stagger.

    A path of length ρ, ρ² = (horizontal distance)² + (microphone's depth)², contributes spreading(ρ) times
    exp(-(loss(f) + i wavenumber(f)) ρ). Paths are the straight one, the echoes of the four edges (images of the source
    behind each, times `reflection`) and of the four corners (times its square). The faces' echoes are in the spreading.
    """
    x, y = position
    weight = jnp.array([1.0, skin.reflection, skin.reflection])
    across, along = jnp.array([x, skin.width - x, -skin.width - x]), jnp.array([y, skin.height - y, -skin.height - y])
    squared = (across[:, None] - skin.microphones[:, 0, None, None]) ** 2
    squared += (along - skin.microphones[:, 1, None, None]) ** 2
    length = jnp.sqrt(squared + skin.microphone_depth[:, None, None] ** 2).reshape(-1, 9)
    amplitude = jnp.outer(weight, weight).reshape(9) * _spreading(skin, length) * skin.gain[:, None]
    decay = _loss(skin, frequencies) + 1j * _wavenumber(skin, frequencies)
    received = jnp.sum(amplitude[..., None] * jnp.exp(-length[..., None] * decay), axis=1)
    if not skin.multiplexed:
        return received
    # Microphone i is slot i mod 4 of multiplexer i div 4. What it follows there, 25 µs earlier, may be an open slot.
    index = np.arange(skin.num_microphones)
    before = index - index % SLOTS + (index - 1) % SLOTS
    connected = before < skin.num_microphones
    leak = jnp.where(connected[:, None], received[np.where(connected, before, 0)], 0)
    received += skin.coupling * leak * jnp.exp(-2j * jnp.pi * frequencies * STEP)
    return received * jnp.exp(2j * jnp.pi * frequencies * skin.stagger[:, None])


def expected_power(skin: SoundingSkin, positions) -> Float[np.ndarray, "P M"]:
    """Mean square (P, M) of each channel, noise apart, for a steady source of strength 1 at each of `positions` (P, 2).

    The integral over frequency of the source's density times |transfer|², no random numbers in it; a source of
    strength s gives s² of it. Raises `ValueError` for positions off the skin.
    """
    points = check_inside("positions", positions, skin.width, skin.height)
    # |transfer|² beats between two echoes at most once per 1 / delay; four points a beat make the sum exact, nearly.
    step = min(1 / (4 * skin.longest_delay), skin.band[0] / 10)
    frequencies = np.arange(1, np.ceil(np.sqrt(2) * skin.band[1] / step)) * step
    return np.asarray(_expected_power(skin, jnp.asarray(points), jnp.asarray(frequencies), step))


@jax.jit
def _expected_power(skin, points, frequencies, step):
    density = source_density(skin, frequencies) * step
    return jax.lax.map(lambda point: jnp.abs(transfer(skin, frequencies, point)) ** 2 @ density, points)


def nominal_power(skin: SoundingSkin, distances) -> Float[np.ndarray, " K"]:
    """Mean square (K,) that a nominal microphone receives from horizontal `distances` (K,), metres, no edge near."""
    return np.asarray(_nominal_power(skin, jnp.hypot(jnp.asarray(distances, float), skin.depth)))


@jax.jit
def _nominal_power(skin, length):
    frequencies = jnp.linspace(skin.band[0] / 1.5, skin.band[1] * 1.5, 2001)
    decay = jnp.exp(-2 * _loss(skin, frequencies) * length[..., None])
    return _spreading(skin, length) ** 2 * jnp.trapezoid(source_density(skin, frequencies) * decay, frequencies)


def noise_power(skin: SoundingSkin) -> Float[np.ndarray, " M"]:
    """Mean square (M,) of each channel's own noise, all of it in the band; see `reach` and `snr_db` of the skin."""
    nominal = nominal_power(skin, skin.reach) * 10 ** (-skin.snr_db / 10)
    return nominal * np.asarray(skin.noise_factor)


def check_positive(name: str, value: float) -> None:
    """Raises `ValueError` for what is not a finite number above zero."""
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"{name} must be a positive number in SI units; it is {value}.")


def check_inside(name: str, points, width: float, height: float) -> Float[np.ndarray, "P 2"]:
    """`points` (P, 2) as an array of floats; raises `ValueError` unless all are finite and on the skin."""
    place = np.asarray(points, float)
    if place.ndim != 2 or place.shape[1] != 2 or len(place) == 0:
        raise ValueError(f"{name}: give (x, y) in metres for each, shape (P, 2), not {place.shape}.")
    if not np.isfinite(place).all():
        raise ValueError(f"{name}: row {np.argmin(np.isfinite(place).all(axis=1))} is not finite.")
    half = np.array([width, height]) / 2 * (1 + 1e-9)
    outside = (np.abs(place) > half).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        in_millimetres = (np.abs(place) > 10 * half).any() and (np.abs(place) <= 1000 * half).all()
        hint = " Are they in millimetres? Divide by 1000." if in_millimetres else ""
        raise ValueError(
            f"{name}: row {row}, ({place[row, 0]:g}, {place[row, 1]:g}) m, lies off the skin, which is {width:g} m by "
            f"{height:g} m about the origin. Positions are in metres from its middle.{hint}"
        )
    return place
