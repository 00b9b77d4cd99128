"""A simulated acoustic skin: what microphones under an elastomer layer receive from a touch on its surface.

No openly licensed recording of a skin with microphones exists; this stands in where one is needed. Sound is propagated
frequency by frequency, with spreading, viscoelastic loss, delays and echoes of the edges, so that localisation is
*not* tested on the decay model a/(r² + b) that it fits. The setup is that of Park et al., Science Robotics 7,
eabm7187 (2022). The physics is in `jeit.simulate.acoustic.propagation`, touches in `jeit.simulate.acoustic.touches`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.simulate.acoustic.checks import check_inside, check_positive
from jeit.simulate.acoustic.microphones import microphone_grid

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
