"""The microphones of a simulated skin: positions, properties, and readout."""

from __future__ import annotations

import equinox as eqx
import numpy as np

from jeit.acoustic.simulate.checks import check_not_negative
from jeit.arguments import check_metres
from jeit.layout.layout import LARGEST

# Text S3: eight 4:1 multiplexers step together every 25 µs, so each microphone is sampled every 100 µs.
STEP = 25e-6
SLOTS = 4


class MicrophoneModel(eqx.Module):
    """Properties of the microphones under a skin, and their spread.

    **Fields**

    - `depth`: metres under the surface, of the nominal microphone.
    - `reach`, metres, and `snr_db`: a steady source of strength 1 at horizontal distance `reach` from a nominal
      microphone, no edge near, is received with this signal-to-noise ratio in the band. The paper's microphones sense
      from "about 5.5 cm" (Fig. S15), read here as 0 dB.
    - `gain_spread_db`, `noise_spread_db`, in decibels of power, and `depth_spread`, relative: standard deviations, all
      log-normal, this library's choices, not the paper's.

    Raises `ValueError` for invalid properties.
    """

    depth: float = 0.01
    reach: float = 0.055
    snr_db: float = 0.0
    gain_spread_db: float = 2.0
    depth_spread: float = 0.1
    noise_spread_db: float = 1.0

    def __check_init__(self):
        for name in ("depth", "reach"):
            check_metres(name, getattr(self, name), LARGEST, "the longest skin known")
        for name in ("gain_spread_db", "depth_spread", "noise_spread_db"):
            check_not_negative(name, getattr(self, name))
        if not np.isfinite(self.snr_db):
            raise ValueError(f"snr_db must be finite, in decibels; it is {self.snr_db}.")


class Readout(eqx.Module):
    """Readout of the microphones: analogue filters, multiplexers, and the converter's clock.

    **Fields**

    - `band` (low, high), Hz, where the source and the analogue filters have half their power.
    - `coupling_db`: what is left, in a multiplexer, of the microphone read 25 µs earlier, in decibels below 0; -∞ for
      nothing.
    - `multiplexed`: samples at 10 kHz, microphone i later than the first by (i mod 4) · 25 µs; or all microphones at
      once at 40 kHz, with no coupling. The paper's device has 8 inputs; here there are as many as are needed.

    Raises `ValueError` for a band that the rate cannot hold, and for a coupling that amplifies.
    """

    band: tuple[float, float] = (60.0, 900.0)
    coupling_db: float = -35.0
    multiplexed: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        if not self.coupling_db < 0:
            raise ValueError(f"coupling_db: a neighbour leaks in weakened, below 0 dB; it is {self.coupling_db}.")
        highest = self.rate / 2 / np.sqrt(2)
        if len(self.band) != 2 or not 0 < self.band[0] < self.band[1] < highest:
            raise ValueError(
                f"band: give (low, high) in Hz, rising, with high below {highest:.0f} Hz so that nothing is left at "
                f"half the sampling rate; it is {self.band}."
            )

    @property
    def rate(self) -> float:
        """Samples of each microphone per second."""
        return 1 / (SLOTS * STEP) if self.multiplexed else 1 / STEP

    @property
    def coupling(self):
        """Amplitude of the crosstalk from the microphone read before."""
        return 10 ** (self.coupling_db / 20)

    def stagger(self, number: int) -> np.ndarray:
        """Delay of the sampling of each of `number` microphones after the first, (M,) seconds."""
        return STEP * (np.arange(number) % SLOTS) * self.multiplexed


def microphone_grid(number: int, *, width: float = 0.2, height: float = 0.2) -> np.ndarray:
    """The centres (number², 2), metres, of number x number equal cells of the skin, row by row from the lower left.

    Raises `ValueError` for less than one in a row.
    """
    if number < 1:
        raise ValueError(f"number: give how many points a row has, at least 1; it is {number}.")
    along = (np.arange(number) + 0.5) / number - 0.5
    y, x = np.meshgrid(along * height, along * width, indexing="ij")
    return np.stack([x.ravel(), y.ravel()], axis=-1)
