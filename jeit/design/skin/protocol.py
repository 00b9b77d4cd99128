"""Measurement protocols of skins with electrodes."""

from __future__ import annotations

from typing import Literal

import numpy as np

from jeit.arguments import check_name
from jeit.design.defaults import CURRENT, NUM_PAIRS, PROTOCOL
from jeit.design.measurements import nearest_pairs
from jeit.layout import Layout, SurfaceLayout
from jeit.layout.surface_layout import check_layout
from jeit.protocol import Protocol, adjacent, opposite, two_terminal

ProtocolName = Literal["adjacent", "opposite", "two-terminal"]
PROTOCOLS: tuple[ProtocolName, ...] = ("adjacent", "opposite", "two-terminal")


def skin_protocol(
    layout: Layout | SurfaceLayout,
    name: ProtocolName = PROTOCOL,
    *,
    num_pairs: int | None = None,
    current: float = CURRENT,
) -> Protocol:
    """Create the measurement protocol of a skin with electrodes of `layout`.

    - `name`: name of the protocol; `current`: injected current, amperes.
    - `num_pairs`: for "two-terminal" only: number of pairs of nearest electrodes that are measured, 0 for all pairs. On
      a curved skin, distances are along the surface. The default is 94 pairs, as in Park et al. 2022, or all pairs if
      fewer.

    Raises `ValueError` for an unknown name, for more pairs than exist, for `num_pairs` with another protocol than
    "two-terminal", and as `two_terminal`, `adjacent` and `opposite` do.
    """
    check_layout("layout", layout)
    check_name("protocol", name, PROTOCOLS)
    if name != "two-terminal":
        if num_pairs:
            raise ValueError(f"num_pairs is {num_pairs}, and only 'two-terminal' has pairs, not {name!r}.")
        return {"adjacent": adjacent, "opposite": opposite}[name](layout.num_electrodes, current=current)
    checked_num_pairs = number_of_pairs(layout, num_pairs)
    pairs = np.column_stack(np.triu_indices(layout.num_electrodes, 1))
    if checked_num_pairs < len(pairs):
        pairs = pairs[np.sort(nearest_pairs(layout.centres, checked_num_pairs, lengths=layout.lengths()))]
    return two_terminal(layout.num_electrodes, pairs, current=current)


def number_of_pairs(layout: Layout | SurfaceLayout, num_pairs: int | None) -> int:
    """Number of measured pairs of electrodes, as in `skin_protocol`. Raises `ValueError` for more pairs than exist."""
    num_all_pairs = layout.num_electrodes * (layout.num_electrodes - 1) // 2
    if num_pairs is None:
        return min(NUM_PAIRS, num_all_pairs)
    if not 0 <= num_pairs <= num_all_pairs:
        raise ValueError(
            f"num_pairs is {num_pairs}; '{layout.name}' has {layout.num_electrodes} electrodes, and they make "
            f"{num_all_pairs} pairs; give so many or fewer."
        )
    return num_pairs or num_all_pairs
