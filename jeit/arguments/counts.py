"""How many of a thing, and what share of it, in words."""

from __future__ import annotations

import math

# Below it nobody cares how little it is.
_LEAST_PERCENT = 0.001


def counted(number: int, noun: str) -> str:
    """So many of a thing: "1 frame", "1,000 frames", "2 touches"."""
    several = "es" if noun.endswith(("ch", "s", "x")) else "s"
    return f"{number:,} {noun}{'' if number == 1 else several}"


def percent(value: float | None) -> str:
    """A ratio in per cent with two digits, all of those before the point, and never an exponent."""
    if value is None:
        return "not known"
    share = 100 * float(value)
    if not math.isfinite(share) or abs(share) >= 99.5:
        return f"{share:.0f} %"
    if 0 < abs(share) < _LEAST_PERCENT:
        return f"less than {_LEAST_PERCENT:g} %"
    return f"{share:.2g} %"
