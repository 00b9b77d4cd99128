"""The frame of 16 electrodes that the Göttingen, Dräger and Carefusion systems have: 208 adjacent voltages.

Drive 1-2 is read at 3-4, 4-5, … 15-16; drive 2-3 at 4-5, … 16-1; and so on. Voltages are read in the sense that makes
them positive on every body: the opposite of `jeit.protocol.adjacent`'s.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jeit.data.instruments.recording import Recording
from jeit.protocol import adjacent

CHANNELS = 208
# Amperes; what all of these systems are said to drive at most.
_CURRENT = 5e-3
_CURRENT_NOTE = "a current of 5 mA is assumed; the file does not say it."


def adjacent_recording(
    values: Float[np.ndarray, "F 208"], times: Float[np.ndarray, " F"] | None, notes: tuple[str, ...]
) -> Recording:
    """Of positive voltages in that order. Channels that are zero in every frame were not measured."""
    usable = (values != 0).any(axis=0)
    if not usable.all() and usable.any():
        notes = (*notes, f"{int((~usable).sum())} of {CHANNELS} channels were not measured (zero in every frame).")
    with np.errstate(invalid="ignore"):  # a NaN of four bytes may be a signal
        voltages = -values.astype(float)
    return Recording(voltages, adjacent(16, current=_CURRENT), usable, times, notes=(*notes, _CURRENT_NOTE))
