"""Bursts: how loud a tap is in time."""

import numpy as np

from jeit.simulate.acoustic.checks import check_positive

# When the first burst begins, seconds: time for its ringing.
ONSET = 0.02


def check_burst(strength: float, length: float, duration: float) -> None:
    check_positive("strength", strength)
    check_positive("length", length)
    check_positive("duration", duration)
    if duration < ONSET + length:
        raise ValueError(
            f"duration: a burst of {length:g} s that begins at {ONSET:g} s does not fit in {duration:g} s. Give at "
            f"least {ONSET + length:g} s, or a shorter length."
        )


def burst_envelope(times: np.ndarray, onsets: np.ndarray, length: float, strengths: np.ndarray) -> np.ndarray:
    """Envelope (S,) of bursts t e^(-t / a), a = length / 6: risen in a sixth of `length`, at its end down to 4 %.

    Its square, t² e^(-2t / a), integrates to a³ / 4: divided by `length`, that is the mean square to scale by.
    """
    rise = length / 6
    after = np.maximum(times - onsets[:, None], 0)
    shape = after * np.exp(-after / rise) / np.sqrt(rise**3 / 4 / length)
    # Bursts that overlap are independent noises: their powers add.
    return np.sqrt(((strengths[:, None] * shape) ** 2).sum(axis=0))
