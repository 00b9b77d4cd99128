"""Population medians of the traits of pats, tickles, strokes and wind, the modalities of Park et al. (2022).

The paper has no numbers; these were chosen here, once, before any accuracy was looked at. A hand pats three times a
second, with thuds of 80 ms; fingers that tickle land fifteen times a second, lightly, within a centimetre; a stroke
runs to and fro over 12 cm at 0.1 m/s; an air brush covers some 3 cm. Loudness, in units of the skin's sources, is that
of `jeit.acoustic.simulate.pat`, `tickle` and `stroke`, and of wind that of a stroke. Each has a tone, `slope`, how
steeply its power density falls with frequency: what is soft and firm sounds duller than what is light, rubbing
brightest.
"""

from __future__ import annotations

from dataclasses import dataclass

from jeit.acoustic.simulate.wind_sound import TURBULENCE

# From clip to clip of one person, the deviation of the logarithm of every trait; and of `slope`, which is no size, the
# deviation itself, half of that among people.
WITHIN, SLOPE_AMONG = 0.25, 0.3


@dataclass(frozen=True)
class Trait:
    """The `median` of a trait among people, in SI units, and the `spread` of its logarithm from person to person."""

    median: float
    spread: float


SOUND_MANNERS: dict[str, dict[str, Trait]] = {
    "pat": {
        "strength": Trait(2.0, 0.4),
        "length": Trait(0.08, 0.25),
        "interval": Trait(0.3, 0.3),
        "slope": Trait(1.5, SLOPE_AMONG),
    },
    "tickle": {
        "strength": Trait(0.7, 0.4),
        "length": Trait(0.04, 0.25),
        "interval": Trait(1 / 15, 0.3),
        "radius": Trait(0.01, 0.3),
        "slope": Trait(1.0, SLOPE_AMONG),
    },
    "stroke": {
        "strength": Trait(1.0, 0.4),
        "speed": Trait(0.1, 0.35),
        "path": Trait(0.12, 0.35),
        "slope": Trait(0.7, SLOPE_AMONG),
    },
    "wind": {
        "strength": Trait(1.0, 0.4),
        "radius": Trait(0.03, 0.3),
        "gusts": Trait(0.15, 0.4),
        "slope": Trait(TURBULENCE, SLOPE_AMONG),
    },
    "none": {},
}
"""Of each modality its traits; nobody touches the skin in "none"."""

MODALITIES = tuple(SOUND_MANNERS)
"""Their names, in the paper's order."""
