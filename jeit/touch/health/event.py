"""`HealthEvent`: one thing that happened to a skin, when, where, and how far it may be believed."""

from __future__ import annotations

from enum import StrEnum

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float


class EventKind(StrEnum):
    """What happened. Each is equal to its word."""

    CUT = "cut"
    """Conductivity is lost along a path, for good."""
    DEAD = "dead electrode"
    """An electrode's channels read something else altogether, far more than its contact ever made."""
    TORN = "torn wire"
    """An electrode's channels read next to nothing, or one constant; a dead electrode may look the same."""
    LOOSE = "loose electrode"
    """An electrode's contact is worse, and wanders."""
    NOISY = "noisy channel"
    """A single channel has several times its noise, or jumps about."""
    STUCK = "stuck channel"
    """A single channel does not move any more, while others do."""
    CHANGED = "changed"
    """The skin is not what it was; of what kind that is, frames alone do not tell, or no model bears out."""
    REPAIRED = "repaired"
    """A change is gone again, or the user says so."""


class EventStatus(StrEnum):
    """How sure it is. Each is equal to its word."""

    HELD = "held, or a void"
    """It looks like a touch that is held: only time or the user tells the two apart."""
    LASTING = "lasting"
    """It has outlasted every touch, or is unlike any."""
    CONFIRMED = "confirmed"
    DENIED = "denied"
    MENDED = "mended"
    """It is gone: mended, or a press that was held longer than any was taken to be."""


class HealthEvent(eqx.Module):
    """What happened to a skin.

    **Fields**: `number`, in order of telling; `kind`; `status`; `time`, when it began, and `told`, when it was noticed,
    both seconds (frames, where there are no times); `frame`, the number of the frame that it began at; `channels` (M,)
    that changed; `change` (M,), by what, volts; `strength`: how many times more than anything that healthy frames did;
    `electrode`, its number from 0, or None; `path` (k, 2) of a cut, metres, or None, its `length`, metres, and the
    standard `deviation` of that, as the voltages tell it; `through`, whether all of the skin's depth is cut, or None;
    `reason`, a sentence.
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
        """Of the path, metres; 0 where there is none."""
        return 0.0 if self.path is None else float(np.linalg.norm(np.diff(self.path, axis=0), axis=1).sum())

    @property
    def open(self) -> bool:
        """Whether it is still so: neither denied nor mended, and no repair."""
        gone = self.status in (EventStatus.DENIED, EventStatus.MENDED)
        return not gone and self.kind != EventKind.REPAIRED
