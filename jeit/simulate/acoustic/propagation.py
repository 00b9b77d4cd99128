"""How sound gets from a touch to the microphones: spreading, loss, dispersion, edge echoes, and the multiplexer.

Sound is propagated frequency by frequency; powers are integrals over frequency with no random numbers in them.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jeit.simulate.acoustic.checks import check_inside
from jeit.simulate.acoustic.sounding_skin import SLOTS, STEP, SoundingSkin


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
