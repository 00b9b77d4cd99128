"""Swapped microphones: plugs exchanged since the calibration, found by the misfit they cause."""

from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from jeit.acoustic.likelihood import Listeners
from jeit.acoustic.localiser import Localiser

# Loudest frames looked at; misfit per degree of freedom above which something is wrong, and beyond which more does not
# count; part to which an exchange must lower it to be believed.
_FRAMES, _WRONG, _MOST, _BETTER = 24, 3.0, 100.0, 0.7
_MOST_SWAPS = 4


def find_swaps(
    listeners: Listeners, power: Float[np.ndarray, "F M"], use: Bool[np.ndarray, "F M"]
) -> list[tuple[int, int]]:
    """Pairs of microphones that look exchanged: with their intensities exchanged back, one source explains the frames.

    `power` (F, M): intensities above the floor of frames with a touch. Looks at the loudest frames; finds nothing in
    fewer than three, or where the typical frame is explained as it is. One pair after the other, the best first.
    """
    order = np.argsort(-np.where(use, power, 0.0).sum(axis=1))[:_FRAMES]
    power, use = np.where(use, power, 0.0)[order], use[order]
    if len(power) < 3:
        return []
    power, use = power[np.arange(_FRAMES) % len(power)], use[np.arange(_FRAMES) % len(power)]
    localiser = Localiser.create(listeners)

    def misfit(tried: list[np.ndarray]) -> np.ndarray:
        """Mean misfit per degree of freedom with the channels in each of some orders."""
        found = localiser(
            np.concatenate([power[:, one] for one in tried]), np.concatenate([use[:, one] for one in tried])
        )
        ratio = np.asarray(found.misfit) / np.maximum(np.asarray(found.freedom), 1)
        return np.minimum(np.nan_to_num(ratio, nan=_MOST), _MOST).reshape(len(tried), -1).mean(axis=1)

    count = power.shape[1]
    channels = np.arange(count)
    pairs = [pair for pair in combinations(range(count), 2) if use[:, pair].any()]
    swaps: list[tuple[int, int]] = []
    now = float(misfit([channels])[0])
    while now > _WRONG and len(swaps) < _MOST_SWAPS and pairs:
        orders = []
        for one, other in pairs:
            order = channels.copy()
            order[[one, other]] = order[[other, one]]
            orders.append(order)
        values = misfit(orders)
        best = int(values.argmin())
        if not values[best] < _BETTER * now:
            break
        now, channels = float(values[best]), orders[best]
        swaps.append(pairs[best])
        pairs = [pair for pair in pairs if not set(pair) & set(swaps[-1])]
    return swaps
