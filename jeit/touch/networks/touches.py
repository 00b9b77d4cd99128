"""Training data of image networks: bodies pressed into a skin, and the noise of its readings."""

from __future__ import annotations

import numpy as np

from jeit.design import Bell, Skin, touches_away_from_the_edge
from jeit.touch.simulate import Bar, Disc, Indent, IndentDraws, Joined, Placed, Revolved, Ring, ball, material
from jeit.touch.simulate.contact.indenters import AbstractIndenter
from jeit.touch.simulate.contact.indents import relative_changes

# Least and greatest depth of a touch, as shares of the skin's thickness; in Park et al., 1 and 8 mm of 10 mm.
DEPTHS = (0.1, 0.8)
# The greatest number of bodies that touch at once.
_AT_ONCE = 3
# The paper's limit of detection, of a ball 15 mm across, in deviations of the noise; the number of places along a side
# at which its reading is computed.
_LIMIT, _DEVIATIONS, _PLACES = 0.7, 3.0, 15
# Least distance of a touch's centre from the skin's edge, as a share of its shorter side.
_MARGIN = 0.04


def wrench() -> Joined:
    """An open-ended wrench laid flat, 100 mm long."""
    jaw = Placed(Ring(0.030, 0.014), (0.040, 0.0))
    return Joined(Placed(Bar(0.070, 0.010), (-0.010, 0.0)), jaw)


def bodies() -> list[AbstractIndenter]:
    """Bodies that are pressed in: bells, balls, discs, bars, and a wrench."""
    return [
        *(Revolved(Bell(0.02, deviation)) for deviation in (5e-3, 7.5e-3, 10e-3)),
        *(ball(diameter) for diameter in (0.015, 0.020, 0.030)),
        *(Disc(diameter) for diameter in (0.010, 0.020, 0.030)),
        *(Bar(length, width) for length, width in ((0.040, 0.008), (0.030, 0.015), (0.060, 0.010))),
        wrench(),
    ]


def touch_draws(skin: Skin) -> IndentDraws:
    """Touches of one to three of these bodies, anywhere on a skin, turned by any angle."""
    thickness = float(skin.thickness)
    low_x, high_x, low_y, high_y = map(float, skin.flat_outline.extent)
    depth = (DEPTHS[0] * thickness, DEPTHS[1] * thickness)
    margin = _MARGIN * min(high_x - low_x, high_y - low_y)
    return IndentDraws(bodies(), skin.flat_outline, depth, margin=margin, at_once=_AT_ONCE)


def detection_noise(skin: Skin, limit: float = _LIMIT) -> float:
    """Relative noise of a channel with which a ball 15 mm across under `limit` newtons is just detected.

    It is a third of the greatest relative change of any channel, in the median of places all over the skin. Park et al.
    2022 detect 0.7 N; a hydrogel of 100 kPa is then indented by 1.7 mm.
    """
    tip = ball(0.015)
    depth = material("hydrogel").support.pressure(tip, limit).approach
    grid = touches_away_from_the_edge(skin.flat_outline, 0.0075, _PLACES, _PLACES)
    change = relative_changes(skin, [[Indent(tip, depth, place)] for place in grid.places])
    # Rounded to four digits, which do not depend on the order of sums.
    return float(f"{np.median(np.abs(change).max(axis=1)) / _DEVIATIONS:.4g}")
