"""Draw presses at random: indenters, loads, places, and the number at once."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from jeit.arguments import check_key, check_kind, describe, is_number, real_array
from jeit.mesh import Domain
from jeit.touch.simulate.contact.indenters import AbstractIndenter, check_indenter
from jeit.touch.simulate.contact.press import Press

# The number of places drawn at once for each that is needed, until one is on the skin.
_TRIES = 20


class PressDraws(eqx.Module):
    """Touches of one to `at_once` presses, each number as likely as another, all independent.

    **Fields**: `indenters`, each as likely as another, turned by any angle; `outline` of the places, and their least
    distance `margin` from it, metres, all over alike; `load`, least and greatest, newtons, its logarithm uniform.
    """

    indenters: tuple[AbstractIndenter, ...]
    outline: Domain
    load: tuple[float, float]
    margin: float
    at_once: int

    def __init__(
        self,
        indenters: Sequence[AbstractIndenter],
        outline: Domain,
        load: tuple[float, float],
        *,
        margin: float = 0.0,
        at_once: int = 1,
    ):
        """Raises `ValueError` for no indenters, no outline, loads that are not positive and rising, and a margin that
        leaves no place."""
        check_kind("indenters", indenters, (list, tuple), "a list of them, such as [ball(0.015)]")
        indenters = tuple(indenters)
        if not indenters:
            raise ValueError("indenters: give one at least, such as [ball(0.015)].")
        for number, indenter in enumerate(indenters):
            check_indenter(f"indenters[{number}]", indenter)
        check_kind("outline", outline, Domain, "an outline, such as Disk(0.05)")
        wanted = "the least and the greatest, positive, in newtons, such as (0.3, 10.0)"
        span = real_array("load", load, wanted)
        if span.shape != (2,) or not 0 < span[0] <= span[1] < np.inf:
            raise ValueError(f"load must be {wanted}; it is {load!r}.")
        if not (isinstance(at_once, int) and at_once >= 1):
            raise ValueError(f"at_once must be a whole number, 1 or more; it is {at_once!r}.")
        if not (is_number(margin) and margin >= 0):
            raise ValueError(f"margin must be metres, zero or more; it is {describe(margin)}.")
        self.indenters, self.outline, self.at_once = indenters, outline, at_once
        self.load, self.margin = (float(span[0]), float(span[1])), float(margin)
        if not self._inside(self._anywhere(np.random.default_rng(0), 1000)).any():
            raise ValueError(f"margin is {1e3 * self.margin:g} mm, which leaves no place on the skin; give less.")

    def draw(self, key: Array, number: int) -> list[tuple[Press, ...]]:
        """Draw `number` touches. Raises `ValueError` for what is no key, and no number."""
        check_key(key)
        if not (isinstance(number, (int, np.integer)) and not isinstance(number, bool) and number >= 0):
            raise ValueError(f"number must be a whole number of touches, 0 or more; it is {describe(number)}.")
        random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        counts = random.integers(1, self.at_once, number, endpoint=True)
        total = counts.sum()
        which = random.integers(len(self.indenters), size=total)
        load = np.exp(random.uniform(np.log(self.load[0]), np.log(self.load[1]), total))
        angle = random.uniform(-np.pi, np.pi, total)
        place = np.zeros((0, 2))
        while len(place) < total:
            tried = self._anywhere(random, _TRIES * int(total))
            place = np.concatenate([place, tried[self._inside(tried)]])
        presses = [
            Press(self.indenters[one], float(newtons), where, float(turned))
            for one, newtons, where, turned in zip(which, load, place[:total], angle, strict=True)
        ]
        ends = np.cumsum(counts)
        return [tuple(presses[end - count : end]) for end, count in zip(ends, counts, strict=True)]

    def innermost(self) -> np.ndarray:
        """Of a thousand places (x, y), metres, on the skin, the one farthest from its edge."""
        places = self._anywhere(np.random.default_rng(0), 1000)
        return places[np.asarray(self.outline.signed_distance(places)).argmax()]

    def _anywhere(self, random: np.random.Generator, number: int) -> np.ndarray:
        low_x, high_x, low_y, high_y = map(float, self.outline.extent)
        return random.uniform((low_x, low_y), (high_x, high_y), (number, 2))

    def _inside(self, places: np.ndarray) -> np.ndarray:
        return np.asarray(self.outline.signed_distance(places)) >= self.margin
