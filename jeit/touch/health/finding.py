"""Classify a lasting change: an electrode's fault, a cut, a change unlike a touch, or one that a touch may make too."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jeit.touch.health.cut_path import FittedLoss
from jeit.touch.health.electrode_faults import faulty_electrodes, kind_of_fault
from jeit.touch.health.event import EventKind
from jeit.touch.health.healthy import Healthy
from jeit.touch.health.imaged_skin import ImagedSkin

# The greatest share of a change in an electrode's channels that a cut beside it leaves; a contact leaves more.
_CUT_BESIDE = 0.1


@dataclass(frozen=True)
class Change:
    """A lasting change.

    `vector` (M,), volts; its `size` in the scale of healthy changes; `time` and `frame` at which it began; `noticed`,
    the time at which it was detected.
    """

    vector: Float[np.ndarray, " M"]
    size: float
    time: float
    frame: int
    noticed: float


@dataclass(frozen=True)
class Finding:
    """The classification of a lasting change.

    **Fields**: `kind`; `reason`; whether it is `sure`, or a press may do the same; `electrode`; `loss`, of a cut; `own`
    (M,), the channels that it affects, all if None.
    """

    kind: EventKind
    reason: str
    sure: bool
    electrode: int | None = None
    loss: FittedLoss | None = None
    own: Bool[np.ndarray, " M"] | None = None


def findings(
    change: np.ndarray,
    frames: Float[np.ndarray, "n M"],
    reference: np.ndarray,
    healthy: Healthy,
    touching: Bool[np.ndarray, "L M"] | None,
    skin: ImagedSkin | None,
) -> list[Finding]:
    """Classify a `change` (M,) from `reference` (M,), with the `frames` (n, M) that came after it."""
    used = healthy.used & np.isfinite(change)
    electrodes = [] if touching is None else faulty_electrodes(change, reference, touching & healthy.used)
    faults = []
    for one in electrodes:
        own = touching[one] & healthy.used  # pyright: ignore[reportOptionalSubscript]
        kind = kind_of_fault(frames, reference, healthy.noise, own)
        reason = f"Nearly all of the change is in the {int(own.sum())} channels of electrode {one}."
        faults.append(Finding(kind, reason, True, electrode=one, own=own))
    # Nearly all of a cut right beside an electrode is in its channels too; but it does not fluctuate, and does not
    # increase the current at the electrode.
    if faults and (skin is None or any(one.kind != EventKind.DEAD for one in faults)):
        return faults
    loss = None if skin is None else skin.loss(change, used, healthy.scale)
    if faults and (loss is None or loss.misfit > _CUT_BESIDE):
        return faults
    outside = healthy.outside(change)
    unlike = outside > healthy.unlike
    said = (
        f"{100 * outside:.0f} % of it is in no direction of touches; of those, {100 * healthy.unlike:.0f} % at most."
        if unlike
        else "A press that is held looks the same: wait, or check the skin."
    )
    if loss is not None:
        across = "through the whole skin" if loss.through else "perhaps through a part of its depth"
        said = f"Conductivity is lost along a line, {across}. {said}"
        return [Finding(EventKind.CUT, said, unlike or _opposite(skin), loss=loss)]
    return [Finding(EventKind.CHANGED, said, unlike)]


def _opposite(skin: ImagedSkin | None) -> bool:
    """Whether a loss of conductivity has the sign opposite to that of a touch."""
    return skin is not None and skin.sign > 0
