"""The soft layer in which sound propagates: material, with wave speed and loss, and shape, with spreading and edges."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.acoustic.simulate.checks import check_not_negative, check_positive
from jeit.arguments import check_kind, check_metres
from jeit.layout.layout import LARGEST


class Elastomer(eqx.Module):
    """A soft rubber. A touch radiates mostly shear waves in it, of speed √(modulus / density).

    **Fields**: `shear_modulus` in pascals and `density` in kg/m³: about 100 kPa, a soft silicone, gives 10 m/s at
    `attenuation_frequency` (Hz). `attenuation` in nepers per metre at that frequency, growing as frequency to the
    `attenuation_exponent`. With loss tangent d it is π f d / speed; 4 /m at 100 Hz is d = 0.13, as of soft rubber (a
    choice of this library, not of the paper's). Raises `ValueError` for values that no rubber has.
    """

    shear_modulus: float = 1e5
    density: float = 1e3
    attenuation: float = 4.0
    attenuation_frequency: float = 100.0
    attenuation_exponent: float = 1.2

    def __check_init__(self):
        for name in ("shear_modulus", "density", "attenuation_frequency"):
            check_positive(name, getattr(self, name))
        check_not_negative("attenuation", self.attenuation)
        if not 0 <= self.attenuation_exponent <= 2:
            raise ValueError(
                f"attenuation_exponent must be from 0 to 2, in rubber 1 to 1.5; it is {self.attenuation_exponent}."
            )

    @property
    def wave_speed(self):
        """Speed of shear waves, metres per second."""
        return (self.shear_modulus / self.density) ** 0.5

    def loss(self, frequencies: Float[Array, " F"]) -> Float[Array, " F"]:
        """Attenuation (F,) in nepers per metre at `frequencies` (F,), Hz."""
        return self.attenuation * (frequencies / self.attenuation_frequency) ** self.attenuation_exponent

    def wavenumber(self, frequencies: Float[Array, " F"]) -> Float[Array, " F"]:
        """Phase (F,) per metre, 2πf / speed, with the dispersion that a loss ∝ f^n has where no sound comes too early.

        Kramers and Kronig's relation for a power law gives loss(f0) tan(πn/2) (x^n - x), x = f / f0, as in Szabo, J.
        Acoust. Soc. Am. 96 (1994) 491: with the default loss, speed grows by an eighth over the band.
        """
        # At n = 1 it tends to a logarithm, to which this close an n is near enough.
        exponent = jnp.where(jnp.abs(self.attenuation_exponent - 1) < 1e-6, 1 + 1e-6, self.attenuation_exponent)
        relative = frequencies / self.attenuation_frequency
        dispersion = self.attenuation * jnp.tan(jnp.pi / 2 * exponent) * (relative**exponent - relative)
        return 2 * jnp.pi * frequencies / self.wave_speed + dispersion


class ElastomerLayer(eqx.Module):
    """A rectangular layer of an elastomer, centred at the origin.

    **Fields**: `width`, `height`, `thickness` in metres; `material`; `reflection`, amplitude of the echo of an edge: -1
    for a clamped edge, +1 for a free one; a layer that ends in a soft seal or frame lies near zero, between about -0.3
    and 0.3. Raises `ValueError` for what is no layer.
    """

    width: float = 0.2
    height: float = 0.2
    thickness: float = 0.01
    material: Elastomer = Elastomer()
    reflection: float = 0.2

    def __check_init__(self):
        for name in ("width", "height"):
            check_metres(name, getattr(self, name), LARGEST, "the longest skin known")
        check_metres("thickness", self.thickness, max(self.width, self.height), "the layer is wide")
        check_kind("material", self.material, Elastomer, "an Elastomer, such as Elastomer(shear_modulus=1e5)")
        if not -1 <= self.reflection <= 1:
            raise ValueError(f"reflection: an edge returns at most what reaches it, -1 to 1; it is {self.reflection}.")

    @property
    def longest_delay(self) -> float:
        """Travel time of sound along the longest simulated path, seconds."""
        return 2 * float(np.hypot(self.width, self.height)) / self.material.wave_speed

    def spreading(self, length: Array, depth) -> Array:
        """Amplitude after a path of `length` metres, relative to that at a nominal microphone `depth` m under a source.

        Near its source a wave spreads as in a body (amplitude 1/ρ). Beyond a thickness or so it is guided by the layer
        and spreads as in a sheet (1/√ρ). √(1 + ρ/thickness) / ρ has both limits.
        """
        return jnp.sqrt((1 + length / self.thickness) / (1 + depth / self.thickness)) * depth / length

    def check_inside(self, name: str, points) -> Float[np.ndarray, "P 2"]:
        """`points` (P, 2), metres, as floats; raises `ValueError` that says `name` unless all are on the layer."""
        try:
            place = np.asarray(points, float)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name}: give (x, y) in metres for each; {error}.") from None
        if place.ndim != 2 or place.shape[1] != 2 or len(place) == 0:
            raise ValueError(f"{name}: give (x, y) in metres for each, shape (P, 2), not {place.shape}.")
        if not np.isfinite(place).all():
            raise ValueError(f"{name}: row {np.argmin(np.isfinite(place).all(axis=1))} is not finite.")
        half = np.array([self.width, self.height]) / 2 * (1 + 1e-9)
        outside = (np.abs(place) > half).any(axis=1)
        if outside.any():
            row = int(np.argmax(outside))
            in_millimetres = (np.abs(place) > 10 * half).any() and (np.abs(place) <= 1000 * half).all()
            hint = " Are they in millimetres? Divide by 1000." if in_millimetres else ""
            raise ValueError(
                f"{name}: row {row}, ({place[row, 0]:g}, {place[row, 1]:g}) m, lies off the skin, which is "
                f"{self.width:g} m by {self.height:g} m about the origin. Positions are in metres from its middle."
                f"{hint}"
            )
        return place
