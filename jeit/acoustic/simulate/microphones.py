"""Microphones of a simulated skin: positions, properties, and readout."""

from __future__ import annotations

import equinox as eqx
import numpy as np

from jeit.arguments import check_metres
from jeit.arguments.checks import check_not_negative
from jeit.layout.layout import LARGEST
from jeit_solvers.module import Module

# Time between two slots of a multiplexer in seconds, and number of slots per multiplexer. Eight 4:1 multiplexers switch
# simultaneously every 25 µs, so each microphone is sampled every 100 µs (Park 2022, text S3).
SLOT_TIME = 25e-6
NUM_SLOTS = 4


class MicrophoneModel(Module):
    """Properties of the microphones under a skin, and their variation between microphones.

    **Fields**

    - `depth`: depth of the nominal microphone under the surface, in metres.
    - `reach`, `snr_db`: signal-to-noise ratio in the frequency band, in decibels, at which a nominal microphone
      receives a steady source of strength 1 at the horizontal distance `reach` in metres, far from all edges. The
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
        for name in ("depth", "reach"):
            check_metres(name, getattr(self, name), LARGEST, "the longest skin known")
        for name in ("gain_spread_db", "depth_spread", "noise_spread_db"):
            check_not_negative(name, getattr(self, name))
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
        highest = self.rate / 2 / np.sqrt(2)
        if len(self.band) != 2 or not 0 < self.band[0] < self.band[1] < highest:
            raise ValueError(
                f"band: give (low, high) in Hz, rising, with high below {highest:.0f} Hz so that nothing is left at "
                f"half the sampling rate; it is {self.band}."
            )

    @property
    def rate(self) -> float:
        """Sampling rate of each microphone in Hz."""
        return 1 / (NUM_SLOTS * SLOT_TIME) if self.multiplexed else 1 / SLOT_TIME

    @property
    def coupling(self):
        """Amplitude of the crosstalk from the previously read microphone, relative to that microphone's amplitude."""
        return 10 ** (self.coupling_db / 20)

    def stagger(self, number: int) -> np.ndarray:
        """Sampling delay (M,) of each of `number` microphones relative to the first, in seconds."""
        return SLOT_TIME * (np.arange(number) % NUM_SLOTS) * self.multiplexed


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
