"""Check that electrodes on an edge are numbered in the order in which they follow each other along it.

A layout may be numbered in any order. But two exchanged rows of a table of positions look the same, spoil every image,
and go unnoticed; so such an order is reported, with what the signs of the voltages, which depend on the order, say of
it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from jeit.data.measurement import Measurement
from jeit.data.quality import boundary_order, impossible_signs

# Electrodes that are listed, at most.
_MOST = 40
# Difference that noise alone makes to the share of impossible signs between two orders.
_CHANCE = 0.01


def order_note(measurement: Measurement) -> str | None:
    """A sentence on electrodes that are not numbered along the edge; None where they are, or do not lie on it."""
    order = boundary_order(measurement)
    if order is None or len(order) < 4 or follows(order):
        return None
    listed = ", ".join(str(number + 1) for number in _from_the_first(order)[:_MOST])
    more = " …" if len(order) > _MOST else ""
    note = f"going round the edge, the positions of the electrodes come in the order {listed}{more}"
    here, numbered = (impossible_signs(measurement, one) for one in (order, np.arange(len(order))))
    if here is None or numbered is None or abs(here.mean() - numbered.mean()) <= _CHANCE:
        return f"{note}. If they are not numbered so, rows of the positions are exchanged."
    if here.mean() < numbered.mean():
        return f"{note}; the signs of the voltages agree."
    return (
        f"{note}, and the voltages contradict it: {100 * here.mean():.0f} % of their signs are impossible at these "
        f"positions, {100 * numbered.mean():.0f} % if the electrodes followed each other by their numbers. Rows of the "
        "positions are exchanged: mend them, or every image is wrong."
    )


def follows(order: Int[np.ndarray, " L"]) -> bool:
    """Whether electrodes in this order go up, or down, by one all the way round."""
    steps = (np.roll(order, -1) - order) % len(order)
    return bool((steps == 1).all() or (steps == len(order) - 1).all())


def _from_the_first(order: Int[np.ndarray, " L"]) -> Int[np.ndarray, " L"]:
    """The order from the first electrode on, in the sense in which most numbers increase."""
    steps = (np.roll(order, -1) - order) % len(order)
    if (steps == len(order) - 1).sum() > (steps == 1).sum():
        order = order[::-1]
    return np.roll(order, -int(np.flatnonzero(order == 0)[0]))
