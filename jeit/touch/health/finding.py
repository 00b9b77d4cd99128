"""Classify a lasting change of a skin: failing electrodes, a cut, or a touch that is held."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jeit.touch.health.cut_path import FittedLoss
from jeit.touch.health.event import EventKind
from jeit.touch.health.healthy import HealthyState
from jeit.touch.health.imaged_skin import ImagedSkin

# Failing electrodes: maximum fraction of a change's energy that they may leave unexplained; minimum fraction of an
# electrode's channels that have changed; minimum change of such a channel, divided by its reading; maximum fraction of
# electrodes that may fail at once.
_LEFT, _OWN, _RELATIVE, _AT_ONCE = 0.1, 0.75, 0.12, 0.25
# Maximum ratio of a reading to its reference for a torn wire; minimum ratio of the noise to its healthy value for a
# loose contact.
_NOTHING, _WANDERS = 0.2, 5.0
# Ratio of the standard deviation of a normal variable to the median magnitude of the difference of two.
_DEVIATION = 1.0484
# Maximum of a change divided by the reading; larger ones are clipped.
_MOST = 10.0


def faulty_electrodes(
    change: Float[np.ndarray, " M"], reference: Float[np.ndarray, " M"], uses_electrode: Bool[np.ndarray, "L M"]
) -> list[int]:
    """Find the electrodes whose failure alone explains a change from the reference, volts.

    Returns the numbers of these electrodes, or an empty list if the skin must have changed too. `uses_electrode` (L,
    M): whether each channel uses each electrode.
    """
    size = np.sqrt(np.mean(reference[np.isfinite(reference)] ** 2))
    relative = np.abs(np.nan_to_num(change)) / np.maximum(np.abs(reference), 0.1 * size)
    relative = np.minimum(relative, _MOST)
    # The change of a channel with a weak reading is compared with the mean reading, not with its own.
    energy = np.minimum(np.abs(np.nan_to_num(change)) / size, relative) ** 2
    total, left, found = energy.sum(), np.ones(len(energy), bool), []
    while total > 0 and energy[left].sum() > _LEFT * total and len(found) < max(1, _AT_ONCE * len(uses_electrode)):
        own = np.array([energy[left & one].sum() / max(1, (left & one).sum()) ** 0.5 for one in uses_electrode])
        best = int(own.argmax())
        mine = uses_electrode[best] & left
        if not mine.any() or np.mean(relative[mine] > _RELATIVE) < _OWN:
            return []
        found.append(best)
        left &= ~uses_electrode[best]
    return found if total > 0 and energy[left].sum() <= _LEFT * total else []


def kind_of_fault(
    frames: Float[np.ndarray, "n M"],
    reference: Float[np.ndarray, " M"],
    noise: Float[np.ndarray, " M"],
    electrode_channels: Bool[np.ndarray, " M"],
) -> EventKind:
    """Classify the fault of an electrode with channels `electrode_channels` (M,) from its latest `frames` (n, M)."""
    now = frames[:, electrode_channels]
    middle = np.nanmedian(now, axis=0)
    size = np.sqrt(np.mean(reference[electrode_channels] ** 2))
    constant = (
        len(middle) > 1
        and np.ptp(middle) <= 0.02 * np.abs(middle).max()
        and np.ptp(reference[electrode_channels]) > 0.1 * size
    )
    if constant or np.median(np.abs(middle)) < _NOTHING * np.median(np.abs(reference[electrode_channels])):
        return EventKind.TORN
    # Touches hardly affect differences from frame to frame.
    steps = np.diff(now, axis=0)
    some = np.isfinite(steps).any(axis=0)
    wander = np.zeros(len(middle))
    if some.any():
        wander[some] = _DEVIATION * np.nanmedian(np.abs(steps[:, some]), axis=0)
    wander /= np.minimum(noise[electrode_channels], size)
    if np.median(wander) > _WANDERS and np.median(np.abs(middle)) < _MOST * np.median(
        np.abs(reference[electrode_channels])
    ):
        return EventKind.LOOSE
    return EventKind.DEAD


# Maximum fraction of the energy of a change in an electrode's channels that a cut beside the electrode leaves
# unexplained; for a failing contact, the fraction is larger.
_CUT_BESIDE = 0.1


@dataclass(frozen=True)
class LastingChange:
    """A lasting change.

    **Fields**: `vector` (M,): change of each channel, volts; `size`: size relative to healthy changes; `time`, `frame`:
    time and frame at which it began; `noticed`: time at which it was detected.
    """

    vector: Float[np.ndarray, " M"]
    size: float
    time: float
    frame: int
    noticed: float


@dataclass(frozen=True)
class Finding:
    """Classification of a lasting change.

    **Fields**: `kind`: kind of event; `reason`: explanation; `sure`: False if a press may cause the same change;
    `electrode`: number of the failing electrode, or None; `loss`: fitted cut, or None; `own` (M,): channels that are
    affected, None for all.
    """

    kind: EventKind
    reason: str
    sure: bool
    electrode: int | None = None
    loss: FittedLoss | None = None
    own: Bool[np.ndarray, " M"] | None = None


def classify_change(
    change: np.ndarray,
    frames: Float[np.ndarray, "n M"],
    reference: np.ndarray,
    healthy: HealthyState,
    touching: Bool[np.ndarray, "L M"] | None,
    skin: ImagedSkin | None,
) -> list[Finding]:
    """Classify a `change` (M,) from the `reference` (M,), with the `frames` (n, M) after it."""
    used = healthy.used & np.isfinite(change)
    electrodes = [] if touching is None else faulty_electrodes(change, reference, touching & healthy.used)
    faults = []
    for one in electrodes:
        own = touching[one] & healthy.used  # pyright: ignore[reportOptionalSubscript]
        kind = kind_of_fault(frames, reference, healthy.noise, own)
        reason = f"Nearly all of the change is in the {int(own.sum())} channels of electrode {one + 1}."
        faults.append(Finding(kind, reason, True, electrode=one, own=own))
    # A cut right beside an electrode also changes almost only that electrode's channels. But it does not fluctuate, and
    # does not increase the current at the electrode.
    if faults and (skin is None or any(one.kind != EventKind.DEAD for one in faults)):
        return faults
    loss = None if skin is None else skin.fit_cut(change, used, healthy.scale)
    if faults and (loss is None or loss.misfit > _CUT_BESIDE):
        return faults
    outside = healthy.fraction_outside(change)
    unlike = outside > healthy.unlike
    said = (
        f"{100 * outside:.0f} % of it is in no direction of touches; of those, {100 * healthy.unlike:.0f} % at most."
        if unlike
        else "A press that is held looks the same: wait, or check the skin."
    )
    if loss is not None:
        across = "through the whole skin" if loss.through else "perhaps through a part of its depth"
        said = f"Conductivity is lost along a line, {across}. {said}"
        return [Finding(EventKind.CUT, said, unlike or _loss_is_opposite_to_touch(skin), loss=loss)]
    return [Finding(EventKind.CHANGED, said, unlike)]


def _loss_is_opposite_to_touch(skin: ImagedSkin | None) -> bool:
    """Whether touches raise the conductivity, so that a loss of conductivity cannot be a touch."""
    return skin is not None and skin.sign > 0
