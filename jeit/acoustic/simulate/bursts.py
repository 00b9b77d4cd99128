"""Bursts: the amplitude of a tap as a function of time."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jeit.acoustic.simulate.checks import check_positive
from jeit.arguments import check_kind

# When the first burst begins, seconds: time for its ringing.
ONSET = 0.02


class Burst(eqx.Module):
    """Envelope of one tap: it rises fast and decays within `length` seconds, over which its root mean square is
    `strength`. Raises `ValueError` for what is not positive."""

    strength: float = 1.0
    length: float = 0.06

    def __check_init__(self):
        check_positive("strength", self.strength)
        check_positive("length", self.length)

    def check_fits(self, duration: float) -> None:
        """Raises `ValueError` unless a recording of `duration` seconds holds one burst."""
        check_positive("duration", duration)
        if duration < ONSET + self.length:
            raise ValueError(
                f"duration: a burst of {self.length:g} s that begins at {ONSET:g} s does not fit in {duration:g} s. "
                f"Give at least {ONSET + self.length:g} s, or a shorter length."
            )

    def envelope(
        self, times: Float[np.ndarray, " S"], onsets: Float[np.ndarray, " N"], strengths: Float[np.ndarray, " N"]
    ) -> Float[np.ndarray, " S"]:
        """Root mean square at `times` (s) of N bursts of this length that begin at `onsets` (s), with `strengths`.

        A burst is t e^(-t / a), a = length / 6: risen in a sixth of `length`, at its end down to 4 %. Its square,
        t² e^(-2t / a), integrates to a³ / 4: divided by `length`, that is the mean square to scale by.
        """
        rise = self.length / 6
        after = np.maximum(times - onsets[:, None], 0)
        shape = after * np.exp(-after / rise) / np.sqrt(rise**3 / 4 / self.length)
        # Bursts that overlap are independent noises: their powers add.
        return np.sqrt(((strengths[:, None] * shape) ** 2).sum(axis=0))


def check_burst(burst: Burst, duration: float) -> None:
    """Raises `ValueError` for what is no `Burst`, and unless a recording of `duration` seconds holds one of it."""
    check_kind("burst", burst, Burst, "a Burst, such as Burst(strength=2.0)")
    burst.check_fits(duration)


# A vibrator with a rubber tip, the palm of a hand, and fingers that tickle.
VIBRATOR, FIRM, LIGHT = Burst(), Burst(2.0, 0.08), Burst(0.7, 0.04)
