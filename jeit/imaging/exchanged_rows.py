"""Drives or measurements exchanged in a frame, and not in its reference: which exchange makes the two alike.

Where every drive is read by every measurement, a frame is a matrix F (drives, measurements), as its reference R is.
With two drives exchanged two of its rows are; that breaks reciprocity, as noise does, or not, and no image explains it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Inexact

from jeit.arguments import percent
from jeit.data import Measurement

# What an exchange must lower the difference to: each, and all that are told of; and how many are looked for.
_STEP, _BETTER, _MOST = 0.9, 0.5, 4


def told_exchanges(frame: Measurement, reference: Measurement) -> str:
    """Which drives, or which measurements of every drive, look exchanged in a frame, in a sentence, counted from 1;
    empty where no exchange halves its difference from the reference, and where some drive has other readings than
    others."""
    order = _order(frame)
    if order is None:
        return ""
    both = (np.asarray(frame.mask)[0] & np.asarray(reference.mask)[0])[order]
    measured, rest = (np.where(both, np.asarray(one.filled())[0][order], 0) for one in (frame, reference))
    described = float(np.linalg.norm(measured - rest))
    found = [
        (*_exchanges(measured, rest), "drives"),
        (*_exchanges(measured.T, rest.T), "measurements of every drive"),
    ]
    left, pairs, what = min(found, key=lambda one: one[0])
    if not pairs or left > _BETTER * described:
        return ""
    size = float(np.linalg.norm(rest))
    named = ", ".join(f"{one + 1} and {other + 1}" for one, other in pairs)
    return (
        f"{what} {named} look exchanged in it, and not in its reference: so taken it differs from that by "
        f"{percent(left / size)}, as it is by {percent(described / size)}. Mend its order; or go on as it is "
        "(as_is=True, --as-is)."
    )


def _order(frame: Measurement) -> np.ndarray | None:
    """(drives, measurements) where each channel is; None where some drive lacks one."""
    drive, reading = (np.asarray(one) for one in (frame.protocol.drive_index, frame.protocol.measurement_index))
    shape = int(drive.max()) + 1, int(reading.max()) + 1
    order = np.full(shape, -1)
    order[drive, reading] = np.arange(len(drive))
    return None if (order < 0).any() else order


def _exchanges(
    measured: Inexact[np.ndarray, "n k"], rest: Inexact[np.ndarray, "n k"]
) -> tuple[float, list[tuple[int, int]]]:
    """How much is left between rows once some are exchanged, and which, the one that makes most of it first."""
    square = np.sum(np.abs(measured) ** 2, axis=1)[:, None] + np.sum(np.abs(rest) ** 2, axis=1)
    apart: Float[np.ndarray, "n n"] = np.maximum(square - 2 * np.real(measured @ rest.conj().T), 0)
    left, pairs = float(np.trace(apart)), []
    for _ in range(_MOST):
        own = np.diag(apart)
        gain = own[:, None] + own - apart - apart.T
        one, other = np.unravel_index(np.argmax(gain), gain.shape)
        if left - gain[one, other] > _STEP**2 * left:
            break
        left = max(left - float(gain[one, other]), 0.0)
        pairs.append((int(min(one, other)), int(max(one, other))))
        apart[[one, other]] = apart[[other, one]]
    return float(np.sqrt(left)), pairs
