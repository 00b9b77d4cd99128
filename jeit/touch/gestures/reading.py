"""`Reading`: how the skin was read from which gestures were learnt, and checks that another reading is compatible."""

from __future__ import annotations

from dataclasses import dataclass

from jeit.arguments import describe, is_number

# A conductivity that differs by this factor is of another skin, or in another unit.
_OTHER_SKIN = 5.0


@dataclass(frozen=True)
class Reading:
    """How a skin was read.

    **Fields**: the `level` that a touch exceeds, and the `background`, the untouched skin's conductivity, both S;
    `sign`, 1 where a touch raises conductivity, -1 where it lowers it; the frame `rate`, frames/s; `num_channels`, and
    the `protocol`'s name.
    """

    level: float
    background: float
    sign: int
    rate: float
    num_channels: int
    protocol: str

    def __post_init__(self):
        """Raises `ValueError` for levels and rates that are not positive, and what is no sign or number."""
        for name in ("level", "background", "rate"):
            if not (is_number(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} must be positive; it is {describe(getattr(self, name))}.")
        if self.sign not in (-1, 1):
            raise ValueError(f"sign must be 1 or -1; it is {describe(self.sign)}.")
        if not (isinstance(self.num_channels, int) and self.num_channels > 0):
            raise ValueError(f"num_channels must be a positive number; it is {describe(self.num_channels)}.")

    def check_same_skin(self, num_channels: int, protocol: str, background: float) -> None:
        """Raise `ValueError` for frames of another number of channels, by another protocol, or of a skin of another
        `background`, S."""
        if num_channels != self.num_channels:
            raise ValueError(
                f"gestures were learnt from frames of {self.num_channels} channels, and this skin has {num_channels}: "
                "learn them on this skin."
            )
        if protocol != self.protocol:
            raise ValueError(
                f"gestures were learnt from a skin driven by '{self.protocol}', and this one is by '{protocol}': learn "
                "them on this skin."
            )
        ratio = background / self.background
        if not 1 / _OTHER_SKIN < ratio < _OTHER_SKIN:
            raise ValueError(
                f"the untouched skin has {ratio:.3g} times the conductivity of that which gestures were learnt on: is "
                "it the same, and are voltages in the unit and at the current that its description says?"
            )
