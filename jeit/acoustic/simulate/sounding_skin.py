"""Simulated acoustic skin: an elastic layer with microphones, and the positions, properties and readout of these
microphones.

Simulated recordings replace measurements, since no openly licensed recording of a skin with microphones exists. Sound
is propagated in the frequency domain with spreading, viscoelastic loss, delays and edge echoes. The simulation thus
differs from the decay model a/(r² + b) that the calibration fits, and is a meaningful test of this model. The setup
follows Park et al., Science Robotics 7, eabm7187 (2022). See `jeit.acoustic.simulate.propagation` for the physics, and
`jeit.acoustic.simulate.touch_sounds` for touches.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.arguments import check_key, check_kind, check_metres
from jeit.arguments.checks import check_not_negative, check_positive
from jeit.layout.layout import MAX_SKIN_SIZE
from jeit_solvers.module import Module

# Time between two slots of a multiplexer in seconds, and number of slots per multiplexer. Eight 4:1 multiplexers switch
# simultaneously every 25 µs, so each microphone is sampled every 100 µs (Park 2022, text S3).
MULTIPLEXER_INTERVAL = 25e-6
NUM_MULTIPLEXER_CHANNELS = 4


class MicrophoneModel(Module):
    """Properties of the microphones under a skin, and their variation between microphones.

    **Fields**

    - `depth`: depth of the nominal microphone under the surface, in metres.
    - `reach`, `snr_db`: a nominal microphone receives a steady source of strength 1 at the horizontal distance `reach`
      in metres, far from all edges, with the signal-to-noise ratio `snr_db` in the frequency band, in decibels. The
      microphones of Park 2022 sense touches up to "about 5.5 cm" (Fig. S15), interpreted here as the distance for 0 dB.
    - `gain_spread_db`, `noise_spread_db`: standard deviations of gain and noise power, in decibels of power.
    - `depth_spread`: standard deviation of the logarithm of the depth. The values of all three spreads are choices of
      this library.

    Raises `ValueError` for invalid properties of the microphones.
    """

    depth: float = 0.01
    reach: float = 0.055
    snr_db: float = 0.0
    gain_spread_db: float = 2.0
    depth_spread: float = 0.1
    noise_spread_db: float = 1.0

    def __check_init__(self):
        for field_name in ("depth", "reach"):
            check_metres(field_name, getattr(self, field_name), MAX_SKIN_SIZE, "the longest skin known")
        for field_name in ("gain_spread_db", "depth_spread", "noise_spread_db"):
            check_not_negative(field_name, getattr(self, field_name))
        if not np.isfinite(self.snr_db):
            raise ValueError(f"snr_db must be finite, in decibels; it is {self.snr_db}.")


class Readout(Module):
    """Readout of the microphones of a skin: analogue filters, multiplexers, and sampling.

    **Fields**

    - `band`: (low, high) in Hz, the frequencies at which the filters halve the power of the source and of the noise.
    - `coupling_db`: crosstalk in a multiplexer from the microphone read 25 µs earlier, in decibels, below 0; −∞ for no
      crosstalk.
    - `multiplexed`: if True, the sampling rate is 10 kHz and microphone i is sampled (i mod 4) · 25 µs after the first.
      If False, all microphones are sampled simultaneously at 40 kHz, without crosstalk. The device of Park 2022 has 8
      multiplexers; in the simulation, the number of multiplexers is not limited.

    Raises `ValueError` for a frequency band that is too high for the sampling rate, and for crosstalk of 0 dB or more.
    """

    band: tuple[float, float] = (60.0, 900.0)
    coupling_db: float = -35.0
    multiplexed: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        if not self.coupling_db < 0:
            raise ValueError(f"coupling_db: crosstalk must be below 0 dB; it is {self.coupling_db}.")
        max_frequency = self.rate / 2 / np.sqrt(2)
        if len(self.band) != 2 or not 0 < self.band[0] < self.band[1] < max_frequency:
            raise ValueError(
                f"band: give (low, high) in Hz, rising, with high below {max_frequency:.0f} Hz so that nothing is left "
                f"at half the sampling rate; it is {self.band}."
            )

    @property
    def rate(self) -> float:
        """Sampling rate of each microphone in Hz."""
        return 1 / (NUM_MULTIPLEXER_CHANNELS * MULTIPLEXER_INTERVAL) if self.multiplexed else 1 / MULTIPLEXER_INTERVAL

    @property
    def coupling(self):
        """Amplitude of the crosstalk from the previously read microphone, relative to that microphone's amplitude."""
        return 10 ** (self.coupling_db / 20)

    def stagger(self, number: int) -> np.ndarray:
        """Sampling delay (M,) of each of `number` microphones relative to the first, in seconds."""
        return MULTIPLEXER_INTERVAL * (np.arange(number) % NUM_MULTIPLEXER_CHANNELS) * self.multiplexed


def microphone_grid(number: int, *, width: float = 0.2, height: float = 0.2) -> np.ndarray:
    """Positions (number², 2) in metres of microphones at the centres of number × number equal cells of a skin, row by
    row from the lower left.

    **Arguments:**

    - `number`: number of microphones in a row and in a column.
    - `width`, `height`: sides of the skin, metres.

    Raises `ValueError` if `number` is less than 1.

    **Example:**

    ```python
    skin = SoundingSkin(key, microphone_grid(3, width=0.2, height=0.2))
    print(skin.microphones.shape)  # (9, 2)
    ```
    """
    if number < 1:
        raise ValueError(f"number: give the number of points in a row, at least 1; it is {number}.")
    cell_centres = (np.arange(number) + 0.5) / number - 0.5
    y, x = np.meshgrid(cell_centres * height, cell_centres * width, indexing="ij")
    return np.stack([x.ravel(), y.ravel()], axis=-1)


class Elastomer(Module):
    """A soft rubber, in which a touch radiates mainly shear waves of speed √(shear modulus / density).

    **Fields**: `shear_modulus`: shear modulus in Pa; `density`: density in kg/m³; `attenuation`: attenuation in nepers
    per metre at `attenuation_frequency`, in Hz; `attenuation_exponent`: exponent n of the attenuation, which is
    proportional to frequency to the power n.

    The default shear modulus, of a soft silicone, gives a wave speed of 10 m/s at `attenuation_frequency`. For a loss
    tangent d the attenuation at frequency f is π f d / speed; the default of 4 /m at 100 Hz corresponds to d = 0.13,
    typical of soft rubber (chosen by this library, not given in Park 2022). Raises `ValueError` for values that no
    rubber has.
    """

    shear_modulus: float = 1e5
    density: float = 1e3
    attenuation: float = 4.0
    attenuation_frequency: float = 100.0
    attenuation_exponent: float = 1.2

    def __check_init__(self):
        for field_name in ("shear_modulus", "density", "attenuation_frequency"):
            check_positive(field_name, getattr(self, field_name))
        check_not_negative("attenuation", self.attenuation)
        if not 0 <= self.attenuation_exponent <= 2:
            raise ValueError(
                f"attenuation_exponent must be from 0 to 2, in rubber 1 to 1.5; it is {self.attenuation_exponent}."
            )

    @property
    def wave_speed(self):
        """Speed of shear waves in the elastomer in metres per second."""
        return (self.shear_modulus / self.density) ** 0.5

    def loss(self, frequencies: Float[Array, " F"]) -> Float[Array, " F"]:
        """Attenuation (F,) of shear waves in nepers per metre at `frequencies` (F,) in Hz."""
        return self.attenuation * (frequencies / self.attenuation_frequency) ** self.attenuation_exponent

    def wavenumber(self, frequencies: Float[Array, " F"]) -> Float[Array, " F"]:
        """Wavenumber (F,) of shear waves in radians per metre at `frequencies` f (F,) in Hz: 2πf / speed plus the
        dispersion that causality requires for an attenuation proportional to f^n.

        The Kramers-Kronig relation for a power law gives the dispersion loss(f0) tan(πn/2) (x^n - x) with x = f / f0,
        where f0 is `attenuation_frequency` (Szabo, J. Acoust. Soc. Am. 96 (1994) 491). With the default attenuation,
        the wave speed increases by an eighth over the band.
        """
        # The limit of the dispersion for n → 1 is a logarithm, which the formula with this value of n approximates
        # closely enough.
        attenuation_exponent = jnp.where(
            jnp.abs(self.attenuation_exponent - 1) < 1e-6, 1 + 1e-6, self.attenuation_exponent
        )
        relative_frequencies = frequencies / self.attenuation_frequency
        dispersion_term = (
            self.attenuation
            * jnp.tan(jnp.pi / 2 * attenuation_exponent)
            * (relative_frequencies**attenuation_exponent - relative_frequencies)
        )
        return 2 * jnp.pi * frequencies / self.wave_speed + dispersion_term


class ElastomerLayer(Module):
    """A rectangular layer of an elastomer, centred at the origin.

    **Fields**: `width`, `height`, `thickness`: dimensions in metres; `material`: the elastomer; `reflection`: amplitude
    reflection coefficient of the edges, -1 for a clamped edge, +1 for a free edge, and between about -0.3 and 0.3 for
    an edge in a soft seal or frame. Raises `ValueError` for invalid values.
    """

    width: float = 0.2
    height: float = 0.2
    thickness: float = 0.01
    material: Elastomer = Elastomer()
    reflection: float = 0.2

    def __check_init__(self):
        for field_name in ("width", "height"):
            check_metres(field_name, getattr(self, field_name), MAX_SKIN_SIZE, "the longest skin known")
        check_metres("thickness", self.thickness, max(self.width, self.height), "the layer is wide")
        check_kind("material", self.material, Elastomer, "an Elastomer, such as Elastomer(shear_modulus=1e5)")
        if not -1 <= self.reflection <= 1:
            raise ValueError(
                f"reflection: the amplitude reflection coefficient is from -1 to 1; it is {self.reflection}."
            )

    @property
    def longest_delay(self) -> float:
        """Travel time of sound along the longest simulated path in the layer, in seconds."""
        return 2 * float(np.hypot(self.width, self.height)) / self.material.wave_speed

    def spreading(self, length: Array, depth) -> Array:
        """Amplitude of the sound after a path of `length` metres, relative to the amplitude at a nominal microphone
        `depth` metres directly below the source.

        Near the source, the wave spreads in three dimensions, with amplitude 1/ρ after a path of length ρ. Beyond about
        one thickness, the layer guides the wave in two dimensions, with amplitude 1/√ρ. The formula √(1 + ρ/thickness)
        / ρ has both limits.
        """
        return jnp.sqrt((1 + length / self.thickness) / (1 + depth / self.thickness)) * depth / length

    def check_inside(self, name: str, points) -> Float[np.ndarray, "P 2"]:
        """Return `points` (P, 2) in metres as floats. Raises `ValueError` unless all points are finite and on the
        layer; `name` is the argument's name in the message."""
        try:
            point_array = np.asarray(points, float)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name}: give (x, y) in metres for each; {error}.") from None
        if point_array.ndim != 2 or point_array.shape[1] != 2 or len(point_array) == 0:
            raise ValueError(f"{name}: give (x, y) in metres for each, shape (P, 2), not {point_array.shape}.")
        if not np.isfinite(point_array).all():
            raise ValueError(f"{name}: row {np.argmin(np.isfinite(point_array).all(axis=1))} is not finite.")
        half_layer_size = np.array([self.width, self.height]) / 2 * (1 + 1e-9)
        is_outside_layer = (np.abs(point_array) > half_layer_size).any(axis=1)
        if is_outside_layer.any():
            first_outside_index = int(np.argmax(is_outside_layer))
            looks_like_millimetres = (np.abs(point_array) > 10 * half_layer_size).any() and (
                np.abs(point_array) <= 1000 * half_layer_size
            ).all()
            unit_hint = " Are they in millimetres? Divide by 1000." if looks_like_millimetres else ""
            raise ValueError(
                f"{name}: row {first_outside_index}, ({point_array[first_outside_index, 0]:g}, "
                f"{point_array[first_outside_index, 1]:g}) m, lies off the skin, which is {self.width:g} m by "
                f"{self.height:g} m about the origin. Positions are in metres from its middle.{unit_hint}"
            )
        return point_array


class SoundingSkin(Module):
    """An elastomer layer with microphones under its surface, for simulations.

    The unit of samples is arbitrary: a source of strength 1 gives samples with a mean square of 1 at a nominal
    microphone directly below the source, without loss and echoes.

    **Arguments:**

    - `key`: random key from which depths, gains and noise of the microphones are drawn.
    - `microphones`: positions (M, 2) of the microphones, metres; by default those of `microphone_grid(5)`.
    - `layer`: shape and material of the layer.
    - `microphone_model`: properties of the nominal microphone.
    - `readout`: analogue filters and sampling of the microphones.
    - `spectral_slope`: the power spectral density of a touch is proportional to frequency to the power
      −`spectral_slope` (1 is 3 dB per octave).

    **Fields**: the arguments except `key`; and for each microphone `microphone_depth` (M,), the depth under the surface
    in metres; `gain` (M,), the gain in amplitude; and `noise_factor` (M,), the noise power divided by the noise power
    of the nominal microphone.

    **Example:**

    ```python
    skin = SoundingSkin(key, microphone_grid(3))
    touch = simulate_tap(skin, key, (0.03, 0.02))
    ```
    """

    microphones: Float[Array, "M 2"]
    microphone_depth: Float[Array, " M"]
    gain: Float[Array, " M"]
    noise_factor: Float[Array, " M"]
    layer: ElastomerLayer
    microphone_model: MicrophoneModel
    readout: Readout
    spectral_slope: float

    def __init__(
        self,
        key: Array,
        microphones: ArrayLike | None = None,
        *,
        layer: ElastomerLayer | None = None,
        microphone_model: MicrophoneModel | None = None,
        readout: Readout | None = None,
        spectral_slope: float = 1.0,
    ):
        """Create a skin with randomly varying microphones.

        `key`: random key for the deviations of the microphones from `microphone_model`. `microphones`: positions (M, 2)
        in metres; by default a grid of 5 × 5 microphones. The defaults of `layer`, `microphone_model` and `readout`
        describe the device of Park 2022. Raises `ValueError` for microphones outside the layer, and for arguments of
        the wrong type.
        """
        check_key(key)
        self.layer = ElastomerLayer() if layer is None else layer
        self.microphone_model = MicrophoneModel() if microphone_model is None else microphone_model
        self.readout = Readout() if readout is None else readout
        check_kind("layer", self.layer, ElastomerLayer, "an ElastomerLayer, such as ElastomerLayer(0.2, 0.2, 0.01)")
        check_kind(
            "microphone_model", self.microphone_model, MicrophoneModel, "a MicrophoneModel, such as MicrophoneModel()"
        )
        check_kind("readout", self.readout, Readout, "a Readout, such as Readout(multiplexed=False)")
        if not np.isfinite(spectral_slope):
            raise ValueError(f"spectral_slope must be finite; it is {spectral_slope}.")
        self.spectral_slope = spectral_slope
        layer_width, layer_height = self.layer.width, self.layer.height
        microphone_positions = (
            microphone_grid(5, width=layer_width, height=layer_height) if microphones is None else microphones
        )
        microphone_positions = self.layer.check_inside("microphones", microphone_positions)
        normal_draws = np.asarray(jax.random.normal(key, (3, len(microphone_positions))))
        self.microphones = jnp.asarray(microphone_positions)
        self.microphone_depth = jnp.asarray(
            self.microphone_model.depth * np.exp(self.microphone_model.depth_spread * normal_draws[0])
        )
        self.gain = jnp.asarray(10 ** (self.microphone_model.gain_spread_db * normal_draws[1] / 20))
        self.noise_factor = jnp.asarray(10 ** (self.microphone_model.noise_spread_db * normal_draws[2] / 10))

    @property
    def num_microphones(self) -> int:
        """Number of microphones, M."""
        return self.microphones.shape[0]

    @property
    def rate(self) -> float:
        """Sampling rate of each microphone in Hz."""
        return self.readout.rate

    @property
    def stagger(self) -> np.ndarray:
        """Sampling delay (M,) of each microphone relative to the first, in seconds."""
        return self.readout.stagger(self.num_microphones)


def check_skin_and_key(skin: SoundingSkin, key: Array) -> None:
    """Raises `ValueError` if `skin` is not a `SoundingSkin`, or `key` is not a random key."""
    check_kind("skin", skin, SoundingSkin, "a SoundingSkin, such as SoundingSkin(jax.random.key(0))")
    check_key(key)
