"""`stream`: images of frames one by one, from any source; a bad frame is reported as such, and the stream goes on."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jeit.arguments import check_kind
from jeit.inverse.nonlinear.solvers import counted_iterations
from jeit.inverse.streaming.frame_check import FrameCheck, FrameStatus
from jeit.inverse.streaming.imager import Imager


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
