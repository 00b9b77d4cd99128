"""`Reading`: how a skin was read whose touches gestures were learnt from, and what another reading must share."""

from dataclasses import dataclass

from jeit.arguments import is_number, told


@dataclass(frozen=True)
class Reading:
    """**Fields**: the `level` that a touch exceeds, S (a solid's: S/m); `sign`, 1 where a touch raises conductivity, -1
    where it lowers it; the frame `rate`, frames/s; `num_channels`, and the `protocol`'s name."""

    level: float
    sign: int
    rate: float
    num_channels: int
    protocol: str

    def __post_init__(self):
        """Raises `ValueError` for levels and rates that are not positive, and what is no sign or number."""
        for name in ("level", "rate"):
            if not (is_number(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} must be positive; it is {told(getattr(self, name))}.")
        if self.sign not in (-1, 1):
            raise ValueError(f"sign must be 1 or -1; it is {told(self.sign)}.")
        if not (isinstance(self.num_channels, int) and self.num_channels > 0):
            raise ValueError(f"num_channels must be a positive number; it is {told(self.num_channels)}.")

    def check_same_skin(self, num_channels: int, protocol: str) -> None:
        """Raise `ValueError` for frames of another number of channels, or by another protocol."""
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
