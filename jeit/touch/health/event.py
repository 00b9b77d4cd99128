"""`HealthEvent`: an event in the state of a skin: what happened, when, where, and how certain it is."""

from __future__ import annotations

from enum import StrEnum

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float


class EventKind(StrEnum):
    """The kind of an event. Each is equal to its word."""

    CUT = "cut"
    """Conductivity is permanently lost along a path."""
    DEAD = "dead electrode"
    """An electrode's channels have changed by far more than its contact ever did."""
    TORN = "torn wire"
    """An electrode's channels read next to nothing, or one constant; a dead electrode may look the same."""
    LOOSE = "loose electrode"
    """An electrode's contact is worse, and fluctuates."""
    NOISY = "noisy channel"
    """A single channel has several times its noise, or jumps."""
    STUCK = "stuck channel"
    """A single channel no longer changes, while others do."""
    CHANGED = "changed"
    """The skin has changed; frames alone do not determine how, or no model explains it."""
    REPAIRED = "repaired"
    """A change has disappeared, or the user has reported a repair."""


class EventStatus(StrEnum):
    """How certain an event is. Each is equal to its word."""

    HELD = "held, or a void"
    """It looks like a touch that is held: only time or the user can distinguish the two."""
    LASTING = "lasting"
    """It has lasted longer than every touch, or is unlike any."""
    CONFIRMED = "confirmed"
    DENIED = "denied"
    MENDED = "mended"
    """It has disappeared: mended, or a press that was held longer than any was assumed to be."""


class HealthEvent(eqx.Module):
    """An event in the state of a skin.

    **Fields**: `number`, in the order of detection; `kind`; `status`; `time`, when it began, and `noticed`, when it was
    detected, both seconds (frames, where there are no times); `frame`, the number of the frame at which it began;
    `channels` (M,) that changed; `change` (M,), by how much, volts; `strength`: the ratio to the greatest change among
    healthy frames; `electrode`, its number from 0, or None; `path` (k, 2) of a cut, metres, or None, its `length`,
    metres, and the standard `deviation` of the length, estimated from the voltages; `through`, whether all of the
    skin's depth is cut, or None; `reason`, a sentence.
    """

    number: int
    kind: EventKind
    status: EventStatus
    time: float
    noticed: float
    frame: int
    channels: Bool[np.ndarray, " M"]
    change: Float[np.ndarray, " M"]
    strength: float
    electrode: int | None = None
    path: Float[np.ndarray, "k 2"] | None = None
    deviation: float = 0.0
    through: bool | None = None
    reason: str = ""

    @property
    def length(self) -> float:
        """Length of the path, metres; 0 where there is none."""
        return 0.0 if self.path is None else float(np.linalg.norm(np.diff(self.path, axis=0), axis=1).sum())

    @property
    def open(self) -> bool:
        """Whether the event still applies: neither denied nor mended, and no repair."""
        gone = self.status in (EventStatus.DENIED, EventStatus.MENDED)
        return not gone and self.kind != EventKind.REPAIRED
