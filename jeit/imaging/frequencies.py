"""Frequency-difference imaging: one body at two frequencies, without a frame of it empty.

Admittivity σ + iωε changes with frequency, in tissue and the tanks that stand for it more than in saline. The plain
difference v₂ - v₁ holds the change of the background beside that of what is in it; the weighted one, v₂ - αv₁ with
α = ⟨v₁, v₂⟩ / ⟨v₁, v₁⟩, leaves out all that looks like the body at the first frequency, scaled: a homogeneous body
gives zero. Seo, Lee, Kim, Zribi and Woo, Physiol. Meas. 29 (2008) 755-769; Jun, Kuen, Lee, Woo, Holder and Seo,
Physiol. Meas. 30 (2009) 1087-1099.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jeit.data import Measurement
from jeit.imaging.difference import ImagedDifference, image_difference
from jeit.imaging.preparation import check_measurement
from jeit.imaging.settings import ImagingSettings
from jeit_solvers.engines import as_array


@dataclass(frozen=True)
class ImagedFrequencies:
    """Result of `image_frequencies`: `image`, the change from the first frequency, scaled, to the second, and `weight`
    α, the factor between the two, by which the body as a whole has changed; 1 for plain differences."""

    image: ImagedDifference
    weight: complex


def image_frequencies(
    second: Measurement,
    first: Measurement,
    settings: ImagingSettings | None = None,
    *,
    weighted: bool = True,
    frame: int | str | None = None,
) -> ImagedFrequencies:
    """Image the change of a body between two frequencies, relative to the change of the body as a whole.

    `first`, `second`: the same body, electrodes and protocol at two frequencies, in volts; complex voltages give an
    image of admittivity. `weighted`: v₂ - αv₁, else v₂ - v₁. The background is that of the second frequency, fitted to
    αv₁; with α = 1, that of the first. `frame`: of `second`, as for `image_difference`, as are `settings`. Raises
    `ValueError` for data that cannot be imaged, and for two frequencies at which the body has nothing in common.
    """
    check_measurement("second", second)
    check_measurement("first", first)
    one = second.frame(0 if frame is None else frame)
    base = first.mean_frame()
    weight = frequency_weight(one, base) if weighted else 1.0
    voltages = as_array(weight * np.asarray(base.voltages))
    scaled = replace(base, voltages=voltages, name=f"{_weight_text(weight)} × {base.name}" if weighted else base.name)
    return ImagedFrequencies(image_difference(one, scaled, settings), complex(weight))


def frequency_weight(second: Measurement, first: Measurement) -> float | complex:
    """α = ⟨v₁, v₂⟩ / ⟨v₁, v₁⟩ over the channels usable at both frequencies, one frame each; complex of complex ones.

    Raises `ValueError` for other channels, and where α is not finite or turns the voltages round.
    """
    ahead, before = np.asarray(second.voltages)[0], np.asarray(first.voltages)[0]
    if ahead.shape != before.shape:
        raise ValueError(f"second has {ahead.size} channels and first {before.size}; measure both with one protocol.")
    used = np.asarray(second.mask)[0] & np.asarray(first.mask)[0]
    weight = np.vdot(before[used], ahead[used]) / np.vdot(before[used], before[used])
    if not (np.isfinite(weight) and weight.real > 0):
        raise ValueError(
            f"second and first have nothing in common (α = {weight:.3g}); are they the same body at two frequencies, "
            "with the polarity of the one that of the other?"
        )
    return weight.item()


def _weight_text(weight: float | complex) -> str:
    return f"{weight.real:.3g}{weight.imag:+.3g}i" if isinstance(weight, complex) else f"{weight:.3g}"
