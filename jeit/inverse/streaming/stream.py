"""Streams: frames are checked, and imaged one after the other."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from enum import StrEnum

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jeit.arguments import check_kind, counted
from jeit.inverse.nonlinear.solvers import counted_iterations
from jeit.inverse.streaming.imager import Imager
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


class FrameImage(eqx.Module):
    """Result for one frame of a stream.

    **Fields**: `number`, from 0; `conductivity` (m,), S/m (2-D: S), NumPy, None for a frame that is refused; `status`,
    and its `reason`, in a sentence, empty where all is well; `usable` (M,), the channels used; `misfit`, root mean
    square in standard deviations (NaN for linear images, which solve no forward problem, and refused frames);
    `iterations`; `latency`, seconds from the frame to its image.
    """

    number: int
    conductivity: Float[np.ndarray, " m"] | None
    status: FrameStatus
    reason: str
    usable: Bool[np.ndarray, " M"]
    misfit: float
    iterations: int
    latency: float

    @property
    def imaged(self) -> bool:
        """Whether there is an image."""
        return self.conductivity is not None


def stream(imager: Imager, frames: Iterable) -> Iterator[FrameImage]:
    """Images of frames (M,) in volts, each as soon as its frame has come. NaN marks channels without a reading.

    Iterative methods start from the last image, and an imager with a memory expects the next one near it. Everything is
    compiled before the first frame is asked for. A frame is refused, and the stream goes on, when it has another number
    of channels or is not real, when fewer than half of the channels can be used, when all read zero (the current source
    has failed), or when it differs from an undisturbed frame by more than half of it. A dead electrode's channels are
    left out, and named, and so are those that an amplifier cuts at the ends of its range. A frame that differs from an
    undisturbed one by noise alone is imaged, with status "unchanged". Raises `ValueError` for what is no imager, for
    what are no frames, and for an array of frames that is not (frames, channels).
    """
    check_kind("imager", imager, Imager, "an Imager, as of Imager.create or prepare_imager(reference)[0]")
    check_kind("frames", frames, Iterable, "frames one after another, each (M,) volts")
    if isinstance(frames, (np.ndarray, jax.Array)) and frames.ndim != 2:
        raise ValueError(f"frames has shape {frames.shape}; give (frames, channels), or for one frame [frame].")
    return _images(imager, frames)


def _images(imager: Imager, frames: Iterable) -> Iterator[FrameImage]:
    session = _Session(imager)
    for number, frame in enumerate(frames):
        yield session.image(number, frame)


class _Session:
    """State of a stream from one frame to the next, in NumPy where JAX's dispatch would cost more than the work."""

    def __init__(self, imager: Imager):
        self.imager = imager
        self.mask = np.asarray(imager.mask)
        self.unmasked = bool(self.mask.all())
        self.expected = np.asarray(imager.expected)
        touching, tied, noise = jax.tree.map(np.asarray, (imager.touching, imager.tied, imager.noise))
        self.check = FrameCheck(self.mask, self.expected, touching, tied, noise)
        self.coefficients = np.asarray(imager.start)
        self.last = self.expected
        self._weigh(self.mask)
        self._estimate(self.expected)  # compiles
        self.coefficients = np.asarray(imager.start)

    def image(self, number: int, frame) -> FrameImage:
        """The image of one frame, or the reason why there is none."""
        begin = time.perf_counter()
        values, usable, status, reason = self.check(frame)
        if status == FrameStatus.REFUSED:
            return FrameImage(number, None, status, reason, usable, np.nan, 0, time.perf_counter() - begin)
        if usable is not self.usable and not np.array_equal(usable, self.usable):
            self._weigh(usable)
        filled = values if usable is self.mask and self.unmasked else np.where(usable, values, self.last)
        conductivity, misfit, iterations, converged = self._estimate(filled)
        if not np.isfinite(conductivity).all():
            reason = "The image became NaN; the next frame starts from the background again."
            self.coefficients = np.asarray(self.imager.start)
            return FrameImage(
                number, None, FrameStatus.REFUSED, reason, usable, np.nan, iterations, time.perf_counter() - begin
            )
        self.last = filled
        if not converged and status in (FrameStatus.IMAGED, FrameStatus.UNCHANGED):
            status = FrameStatus.STEP_LIMIT
            done = counted_iterations(iterations, self.imager.steps - iterations)
            reason = f"Stopped after {done}: this frame needs more than a frame is given."
        return FrameImage(number, conductivity, status, reason, usable, misfit, iterations, time.perf_counter() - begin)

    def _weigh(self, usable) -> None:
        self.usable = usable
        self.weighing = self.imager.weighing(jnp.asarray(usable))
        if self.imager.solver.is_linear:
            linear = self.imager.linear_map(self.weighing)
            # Reading the matrix takes most of a linear image's time; it multiplies differences, so single will do, and
            # BLAS reads it column by column in half the time.
            self.matrix = np.asfortranarray(linear.matrix, np.float32)
            self.estimator = np.asarray(linear.estimator)
            self.resting = self.estimator @ self.expected
            self.carry = np.asarray(linear.carry)
            self.level = np.asarray(linear.level) + np.asarray(linear.matrix) @ self.resting

    def _estimate(self, frame):
        """Conductivity, misfit, iterations, and whether they converged."""
        if self.imager.solver.is_linear:
            weights = self.estimator @ frame - self.resting
            if self.imager.persistence > 0:
                weights = self.coefficients = weights + self.carry @ self.coefficients
            return self.level + self.matrix @ weights.astype(np.float32), np.nan, 1, True
        found = self.imager.estimate(frame, self.weighing, jnp.asarray(self.coefficients))
        self.coefficients = found.coefficients * (self.imager.persistence or 1.0)
        return np.asarray(found.conductivity), float(found.misfit), int(found.iterations), bool(found.converged)
