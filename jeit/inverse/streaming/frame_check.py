"""Checks of frames: whether a frame is imaged, imaged in part, or refused."""

from __future__ import annotations

from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float, Int

from jeit.arguments import counted
from jeit_solvers import Status

# A frame that differs from an undisturbed one by more than this share is another sensor's, or faulty.
_LARGEST_DIFFERENCE = 0.5
# Beyond this change, an electrode counts as dead if its channels have changed by half or more and hold most of the
# change.
_SUSPICIOUS, _EXPLAINED, _LOST = 0.15, 0.5, 0.5
_LEAST_CHANNELS = 0.5
# Beyond the same change, this many channels with equal readings, above or below all others, are at a rail.
_AT_RAIL, _ALIKE = 3, 1e-6
# Reciprocal channels that hold only noise agree by chance: a change is detected from this many standard deviations of
# that agreement, over at least this many pairs; a relative change smaller than the last number, against an undisturbed
# frame, counts as none.
_CHANCE, _FEWEST_PAIRS, _EQUAL = 3.0, 10, 1e-12


class FrameStatus(StrEnum):
    """Status of a frame. Each is equal to its word."""

    IMAGED = "imaged"
    PARTIAL = "partial"
    """Imaged, with some channels left out."""
    UNCHANGED = "unchanged"
    """Imaged, though it differs from an undisturbed frame by noise alone."""
    STEP_LIMIT = Status.STEP_LIMIT.value
    """Imaged, though the steps that a frame is given were too few for it to converge."""
    REFUSED = "refused"
    """There is no image of it."""


class FrameCheck:
    """Checks frames (M,) of a sensor that reads `expected` (M,) volts when undisturbed, in the channels of `mask`.

    `touching` (L, M): which channels each electrode takes part in. `tied`: pairs (P, 2) of channels that reciprocity
    ties, and the ratio (P,) of the second's voltage to the first's. `noise` (M,): volts, relative to each other.
    """

    def __init__(
        self,
        mask: Bool[np.ndarray, " M"],
        expected: Float[np.ndarray, " M"],
        touching: Bool[np.ndarray, "L M"],
        tied: tuple[Int[np.ndarray, "P 2"], Float[np.ndarray, " P"]],
        noise: Float[np.ndarray, " M"],
    ):
        self.mask, self.expected, self.touching = mask, expected, touching
        self.first, self.second = tied[0].T
        self.ratio = tied[1]
        self.trust = 1 / np.hypot(noise[self.first], noise[self.second] / self.ratio)
        self.size = np.linalg.norm(expected[mask])
        self.ordinary = (_SUSPICIOUS * self.size) ** 2

    @np.errstate(over="ignore")  # a square that overflows is not an ordinary one
    def __call__(self, frame):
        """Values, usable channels, status and reason of a frame as it came."""
        values, usable, status, reason = self._looked_at(frame)
        if status != FrameStatus.REFUSED and (noise := self._unchanged(values, usable)):
            return values, usable, FrameStatus.UNCHANGED, f"{reason} {noise}".lstrip()
        return values, usable, status, reason

    def _unchanged(self, values, usable) -> str:
        """A sentence, if a frame differs from an undisturbed one by noise alone."""
        change = np.where(usable, values - self.expected, 0)
        if np.linalg.norm(change) <= _EQUAL * self.size:
            return "It equals an undisturbed frame."
        both = usable[self.first] & usable[self.second]
        if np.count_nonzero(both) < _FEWEST_PAIRS:
            return ""
        one, other = (self.trust * change[self.first])[both], (self.trust * change[self.second] / self.ratio)[both]
        alike = 2 * (one @ other) / (one @ one + other @ other)
        if alike * np.sqrt(len(one)) > _CHANCE:
            return ""
        return "Nothing but noise: reciprocal channels change alike as by chance."

    def _looked_at(self, frame):
        none = np.zeros_like(self.mask)
        if np.ma.isMaskedArray(frame):
            frame = np.ma.filled(frame.astype(float), np.nan)
        try:
            values = np.asarray(frame)
        except ValueError:
            return none, none, FrameStatus.REFUSED, f"The frame is ragged, not {self.mask.size} real voltages."
        if values.dtype.kind in "US":
            return values, none, FrameStatus.REFUSED, f"The frame is text, not {self.mask.size} real voltages."
        if values.shape != self.mask.shape or values.dtype.kind not in "iuf":
            reason = f"The frame is {values.dtype} of shape {values.shape}, not {self.mask.size} real voltages."
            return values, none, FrameStatus.REFUSED, reason
        change = (values - self.expected)[self.mask]
        if change @ change < self.ordinary:  # which NaN is not, nor a frame of zeros
            return values, self.mask, FrameStatus.IMAGED, ""
        finite = np.isfinite(values)
        usable = self.mask if finite.all() else self.mask & finite
        count = np.count_nonzero(usable)
        if count < _LEAST_CHANNELS * np.count_nonzero(self.mask):
            return (
                values,
                usable,
                FrameStatus.REFUSED,
                f"Only {count} of {np.count_nonzero(self.mask)} channels can be used.",
            )
        if not values[usable].any():
            return values, none, FrameStatus.REFUSED, "All channels read zero; the current source has failed."
        difference = np.where(usable, values - self.expected, 0)
        relative = np.linalg.norm(difference) / self.size
        if relative > _SUSPICIOUS:
            usable, reason = self._without_dead_electrode(difference, usable)
            if reason:
                return values, usable, FrameStatus.PARTIAL, reason
            if (rail := self._at_rail(values, usable)).any():
                return self._without_saturated(values, difference, usable, rail)
            if relative > _LARGEST_DIFFERENCE:
                reason = f"It differs by {relative:.0%} from an undisturbed frame: another sensor's, or a fault."
                return values, none, FrameStatus.REFUSED, reason
        if count < np.count_nonzero(self.mask):
            missing = int(np.count_nonzero(self.mask) - count)
            reason = f"Left out: {counted(missing, 'channel')} without a reading."
            return values, usable, FrameStatus.PARTIAL, reason
        return values, usable, FrameStatus.IMAGED, ""

    def _without_dead_electrode(self, difference, usable):
        """The usable channels less those of an electrode that explains most of a large difference, and a sentence."""
        total = np.linalg.norm(difference)
        left = np.array([np.linalg.norm(difference[usable & ~touching]) for touching in self.touching])
        # An electrode that all channels read, such as a common reference, cannot be left out.
        left[(usable & ~self.touching).sum(axis=1) < _LEAST_CHANNELS * self.mask.sum()] = np.inf
        electrode = int(np.argmin(left))
        if not np.isfinite(left[electrode]):
            return usable, ""
        own, rest = usable & self.touching[electrode], usable & ~self.touching[electrode]
        read = own & (self.expected != 0)
        lost = read.any() and np.median(np.abs(difference[read]) / np.abs(self.expected[read])) > _LOST
        explained = left[electrode] <= min(_EXPLAINED * total, _LARGEST_DIFFERENCE * self.size)
        if not (lost and explained):
            return usable, ""
        return rest, f"Electrode {electrode + 1} seems to be dead; its channels are left out."

    def _at_rail(self, values, usable):
        """Channels of an amplifier that can give no more."""
        far = np.abs(values - self.expected) > _SUSPICIOUS * np.abs(self.expected)
        rail = np.zeros_like(usable)
        for end in (values[usable].max(), values[usable].min()):
            same = usable & (values == end)
            if np.count_nonzero(same) < _AT_RAIL or not end:
                continue
            # Channels that symmetry makes equal, in numbers that nobody measured, are so undisturbed too.
            if far[same].all() and np.ptp(self.expected[same]) > _ALIKE * np.abs(self.expected[same]).max():
                rail |= same
        return rail

    def _without_saturated(self, values, difference, usable, rail):
        rest, channels = usable & ~rail, counted(int(np.count_nonzero(rail)), "channel")
        if np.count_nonzero(rest) < _LEAST_CHANNELS * np.count_nonzero(self.mask):
            return values, rest, FrameStatus.REFUSED, f"Saturated: {channels} at the ends of the range."
        if np.linalg.norm(difference[rest]) > _LARGEST_DIFFERENCE * self.size:
            return values, rest, FrameStatus.REFUSED, f"Saturated: {channels}, and the others are far off too."
        return values, rest, FrameStatus.PARTIAL, f"Left out: {channels} at the ends of the range, saturated."
