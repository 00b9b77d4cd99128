"""Simulated people: each makes each gesture in a way of their own, with variation between touches."""

from __future__ import annotations

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jeit.arguments import check_key, check_kind, check_name, describe, is_number
from jeit.mesh import Domain
from jeit.touch.simulate.contact.press import MovingPress
from jeit.touch.simulate.people.gesture_motion import gesture_motion
from jeit.touch.simulate.people.manners import GESTURES, MANNERS, TRAITS

# Least distance, metres, of a hand's centre from the edge; a skin has room for it.
_LEAST_SIDE = 0.06


class Person(eqx.Module):
    """How one person makes the six gestures: the medians (6, 5) of `TRAITS` of their touches, `GESTURES` in rows."""

    medians: Float[np.ndarray, "6 5"]

    def __check_init__(self):
        """Raises `ValueError` for other shapes, and what is negative or not finite."""
        check_kind("medians", self.medians, np.ndarray, "an array (6, 5), such as of Person.draw(key)")
        if self.medians.shape != (len(GESTURES), len(TRAITS)):
            raise ValueError(f"medians have shape {self.medians.shape}; give ({len(GESTURES)}, {len(TRAITS)}).")
        if not np.isfinite(self.medians).all() or (self.medians < 0).any():
            raise ValueError("medians must be finite, and zero or more, in SI units.")

    @classmethod
    def draw(cls, key: Array) -> "Person":
        """Draw a person: medians are log-normal about those of each gesture. Raises `ValueError` for what is no key."""
        check_key(key)
        normal = np.asarray(jax.random.normal(key, (len(GESTURES), len(TRAITS))))
        manners = MANNERS.values()
        medians, spread = (np.stack([getattr(one, name) for one in manners]) for name in ("medians", "spread"))
        return cls(medians * np.exp(spread * normal))

    def touch(
        self, key: Array, gesture: str, outline: Domain, *, rate: float = 60.0
    ) -> tuple[MovingPress, Float[np.ndarray, " T"]]:
        """Simulate a gesture by this person anywhere on a skin of this `outline`.

        Returns the press, and the times (T,) of its frames, seconds, at `rate` frames/s, some before and after it.
        Traits are log-normal about the person's own. Raises `ValueError` for what is no key, gesture, outline or rate,
        and a skin too small for a hand.
        """
        check_key(key)
        check_name("gesture", gesture, GESTURES)
        check_kind("outline", outline, Domain, "an outline, such as Rectangle(0.32, 0.2)")
        if not (is_number(rate) and rate > 0):
            raise ValueError(f"rate must be frames per second, positive; it is {describe(rate)}.")
        low_x, high_x, low_y, high_y = map(float, outline.extent)
        if min(high_x - low_x, high_y - low_y) < _LEAST_SIDE:
            raise ValueError(f"outline must be {1e3 * _LEAST_SIDE:g} mm wide and high at least, for a hand.")
        rng = np.random.default_rng(np.asarray(jax.random.bits(key, (4,))).tolist())
        own = MANNERS[gesture].within * rng.normal(size=len(TRAITS))
        traits = self.medians[GESTURES.index(gesture)] * np.exp(own)
        return gesture_motion(rng, gesture, traits, outline, float(rate))
