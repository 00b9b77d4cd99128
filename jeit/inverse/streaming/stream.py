"""Streams of frames: each frame is checked for faults and imaged as it arrives."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from enum import StrEnum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jeit.arguments import check_kind, counted
from jeit.inverse.nonlinear.solvers import counted_iterations
from jeit.inverse.streaming.imager import Imager
from jeit_solvers import Status
from jeit_solvers.module import Module

# Relative difference from an undisturbed frame above which a frame is faulty or from a different sensor.
_MAX_RELATIVE_DIFFERENCE = 0.5
# Relative difference from an undisturbed frame above which a frame is checked for dead electrodes and saturation. An
# electrode is dead if at most `_MAX_REMAINING_SHARE` of the difference is left without the electrode's channels, and if
# the median relative change of these channels exceeds `_MIN_DEAD_CHANGE`.
_SUSPICIOUS_RELATIVE_DIFFERENCE, _MAX_REMAINING_SHARE, _MIN_DEAD_CHANGE = 0.15, 0.5, 0.5
# Minimum number of channels with valid readings, as a fraction of the channels in use.
_MIN_VALID_CHANNEL_SHARE = 0.5
# Minimum number of channels with equal readings, above or below all others, that count as saturated.
_MIN_SATURATED_CHANNELS = 3
# Relative difference within which the undisturbed voltages of these channels count as equal.
_EXPECTED_EQUALITY_TOLERANCE = 1e-6
# Minimum evidence that a frame differs from an undisturbed frame by more than noise, in standard deviations; minimum
# number of pairs; relative change below which a frame counts as equal to an undisturbed frame.
_MIN_EVIDENCE_DEVIATIONS, _MIN_RECIPROCAL_PAIRS, _EQUALITY_TOLERANCE = 3.0, 10, 1e-12
# Noise, as a share of the voltages, above which a noisy electrode is searched for, and a frame without a change that
# exceeds the noise is refused. Instruments have less than 0.01, skins up to 0.08.
_MAX_RELATIVE_NOISE = 0.1


class FrameStatus(StrEnum):
    """Status of a frame of a stream, as a string.

    **Example:**

    ```python
    imager = Imager.create(model, 1.0, reference=reference, solver="one-step")
    [frame.status == FrameStatus.IMAGED for frame in stream(imager, [voltages, reference])]
    ```
    """

    IMAGED = "imaged"
    PARTIAL = "partial"
    """The frame was imaged, with some channels left out."""
    UNCHANGED = "unchanged"
    """The frame was imaged, but differs from an undisturbed frame by noise only."""
    STEP_LIMIT = Status.STEP_LIMIT.value
    """The frame was imaged, but did not converge within the maximum number of steps."""
    REFUSED = "refused"
    """The frame was not imaged."""


class FrameCheck:
    """Check of the frames of a sensor for faults. A frame is an array (M,) of voltages.

    `mask` (M,): True for channels that are used. `expected` (M,): voltages of an undisturbed frame. `touching` (L, M):
    True for channels that drive or read each electrode. `tied`: pairs (P, 2) of reciprocal channels, and the ratio (P,)
    of the second voltage to the first. `noise` (M,): standard deviation of the channels, in volts, or up to a common
    factor.
    """

    def __init__(
        self,
        mask: Bool[np.ndarray, " M"],
        expected_voltages: Float[np.ndarray, " M"],
        touching: Bool[np.ndarray, "L M"],
        reciprocal_channels: tuple[Int[np.ndarray, "P 2"], Float[np.ndarray, " P"]],
        noise: Float[np.ndarray, " M"],
    ):
        self.mask, self.expected_voltages, self.touching = mask, expected_voltages, touching
        self.first, self.second = reciprocal_channels[0].T
        self.ratio = reciprocal_channels[1]
        self.pair_weights = 1 / np.hypot(noise[self.first], noise[self.second] / self.ratio)
        self.expected_norm = np.linalg.norm(expected_voltages[mask])
        self.max_ordinary_square = (_SUSPICIOUS_RELATIVE_DIFFERENCE * self.expected_norm) ** 2

    @np.errstate(over="ignore")  # a frame whose square overflows is treated as faulty
    def __call__(self, frame):
        """Check a raw frame. Returns its voltages (M,), the mask (M,) of usable channels, the status, and the reason
        for the status as a sentence."""
        frame_voltages, usable_channels, status, reason = self._inspect_frame(frame)
        if status == FrameStatus.REFUSED:
            return frame_voltages, usable_channels, status, reason
        voltage_change = np.where(usable_channels, frame_voltages - self.expected_voltages, 0)
        if np.linalg.norm(voltage_change) <= _EQUALITY_TOLERANCE * self.expected_norm:
            return (
                frame_voltages,
                usable_channels,
                FrameStatus.UNCHANGED,
                f"{reason} It equals an undisturbed frame.".lstrip(),
            )
        usable_channels, noise_status, noise = self.check_noise_by_reciprocity(voltage_change, usable_channels)
        return frame_voltages, usable_channels, noise_status or status, f"{reason} {noise}".strip()

    def check_noise_by_reciprocity(self, change, usable) -> tuple[Bool[np.ndarray, " M"], FrameStatus | None, str]:
        """Compare the changes of reciprocal channels, which noise alone makes unequal. Returns the usable channels, and
        a status and a sentence if a noisy electrode is left out, if noise hides every change, or if there is none."""
        is_usable_pair = usable[self.first] & usable[self.second]
        if np.count_nonzero(is_usable_pair) < _MIN_RECIPROCAL_PAIRS:
            return usable, None, ""
        first_changes, second_changes = (
            self.pair_weights * change[self.first],
            self.pair_weights * change[self.second] / self.ratio,
        )
        # As in `jeit.data.quality.signal_evidence`: differences of reciprocal channels contain noise, sums also signal.
        noise, signal_power = (
            np.where(is_usable_pair, (first_changes - second_changes) ** 2, 0),
            np.sum((first_changes + second_changes)[is_usable_pair] ** 2),
        )
        noise_power, num_pairs = noise.sum(), np.count_nonzero(is_usable_pair)
        has_signal = (signal_power - noise_power) * np.sqrt(num_pairs) > 2 * _MIN_EVIDENCE_DEVIATIONS * noise_power
        expected_power = 2 * np.sum((self.pair_weights * self.expected_voltages[self.first])[is_usable_pair] ** 2)
        if noise_power > _MAX_RELATIVE_NOISE**2 * expected_power:
            noise_fractions = np.sqrt(noise_power / expected_power)
            num_pairs_of_others = np.maximum((is_usable_pair & ~self.touching[:, self.first]).sum(axis=1), 1)
            noise_of_others = (noise * ~self.touching[:, self.first]).sum(axis=1) / num_pairs_of_others
            electrode = int(np.argmin(noise_of_others))
            remaining_channels = usable & ~self.touching[electrode]
            if noise_of_others[electrode] < _MAX_REMAINING_SHARE**2 * noise_power / num_pairs and np.count_nonzero(
                remaining_channels
            ) >= _MIN_VALID_CHANNEL_SHARE * np.count_nonzero(self.mask):
                reason = f"Electrode {electrode + 1} breaks reciprocity: its contact is bad. Its channels are left out."
                return remaining_channels, FrameStatus.PARTIAL, reason
            if not has_signal:
                reason = f"Noise is {noise_fractions:.0%} of the voltages, by reciprocity, and hides every change."
                return usable, FrameStatus.REFUSED, reason
        if has_signal:
            return usable, None, ""
        reason = "Nothing but noise: reciprocal channels change alike as by chance."
        return usable, FrameStatus.UNCHANGED, reason

    def _inspect_frame(self, frame):
        no_usable_channels = np.zeros_like(self.mask)
        if np.ma.isMaskedArray(frame):
            frame = np.ma.filled(frame.astype(float), np.nan)
        try:
            frame_voltages = np.asarray(frame)
        except ValueError:
            return (
                no_usable_channels,
                no_usable_channels,
                FrameStatus.REFUSED,
                f"The frame is ragged, not {self.mask.size} real voltages.",
            )
        if frame_voltages.dtype.kind in "US":
            return (
                frame_voltages,
                no_usable_channels,
                FrameStatus.REFUSED,
                f"The frame is text, not {self.mask.size} real voltages.",
            )
        if frame_voltages.shape != self.mask.shape or frame_voltages.dtype.kind not in "iuf":
            is_real_vector = frame_voltages.ndim == 1 and frame_voltages.dtype.kind in "iuf"
            shape_text = (
                f"has {frame_voltages.size} numbers"
                if is_real_vector
                else f"is {frame_voltages.dtype} of shape {frame_voltages.shape}"
            )
            reason = f"The frame {shape_text}, not {self.mask.size} real voltages."
            return frame_voltages, no_usable_channels, FrameStatus.REFUSED, reason
        voltage_change = (frame_voltages - self.expected_voltages)[self.mask]
        # False for frames with NaN and for frames of zeros.
        if voltage_change @ voltage_change < self.max_ordinary_square:
            return frame_voltages, self.mask, FrameStatus.IMAGED, ""
        is_finite_voltage = np.isfinite(frame_voltages)
        usable_channels = self.mask if is_finite_voltage.all() else self.mask & is_finite_voltage
        num_usable = np.count_nonzero(usable_channels)
        if num_usable < _MIN_VALID_CHANNEL_SHARE * np.count_nonzero(self.mask):
            return (
                frame_voltages,
                usable_channels,
                FrameStatus.REFUSED,
                f"Only {num_usable} of {np.count_nonzero(self.mask)} channels can be used.",
            )
        if not frame_voltages[usable_channels].any():
            return (
                frame_voltages,
                no_usable_channels,
                FrameStatus.REFUSED,
                "All channels read zero; the current source has failed.",
            )
        usable_change = np.where(usable_channels, frame_voltages - self.expected_voltages, 0)
        relative_change = np.linalg.norm(usable_change) / self.expected_norm
        if relative_change > _SUSPICIOUS_RELATIVE_DIFFERENCE:
            usable_channels, reason = self._remove_dead_electrode(usable_change, usable_channels)
            if reason:
                return frame_voltages, usable_channels, FrameStatus.PARTIAL, reason
            if (is_saturated := self._saturated_channels(frame_voltages, usable_channels)).any():
                return self._remove_saturated_channels(frame_voltages, usable_change, usable_channels, is_saturated)
            if relative_change > _MAX_RELATIVE_DIFFERENCE:
                reason = f"It differs by {relative_change:.0%} from an undisturbed frame: another sensor's, or a fault."
                return frame_voltages, no_usable_channels, FrameStatus.REFUSED, reason
        if num_usable < np.count_nonzero(self.mask):
            num_missing = int(np.count_nonzero(self.mask) - num_usable)
            reason = f"Left out: {counted(num_missing, 'channel')} without a reading."
            return frame_voltages, usable_channels, FrameStatus.PARTIAL, reason
        return frame_voltages, usable_channels, FrameStatus.IMAGED, ""

    def _remove_dead_electrode(self, voltage_change, usable_channels):
        """Return the usable channels without the channels of a dead electrode, and a sentence that names the electrode.
        If no electrode is dead, return all usable channels and an empty string."""
        total_change = np.linalg.norm(voltage_change)
        remaining_changes = np.array(
            [np.linalg.norm(voltage_change[usable_channels & ~touching]) for touching in self.touching]
        )
        # An electrode whose removal leaves too few channels, such as a common reference, cannot be left out.
        remaining_changes[
            (usable_channels & ~self.touching).sum(axis=1) < _MIN_VALID_CHANNEL_SHARE * self.mask.sum()
        ] = np.inf
        electrode = int(np.argmin(remaining_changes))
        if not np.isfinite(remaining_changes[electrode]):
            return usable_channels, ""
        electrode_channels, channels_of_others = (
            usable_channels & self.touching[electrode],
            usable_channels & ~self.touching[electrode],
        )
        expected_channels = electrode_channels & (self.expected_voltages != 0)
        is_dead = (
            expected_channels.any()
            and np.median(np.abs(voltage_change[expected_channels]) / np.abs(self.expected_voltages[expected_channels]))
            > _MIN_DEAD_CHANGE
        )
        explains_change = remaining_changes[electrode] <= min(
            _MAX_REMAINING_SHARE * total_change, _MAX_RELATIVE_DIFFERENCE * self.expected_norm
        )
        if not (is_dead and explains_change):
            return usable_channels, ""
        return channels_of_others, f"Electrode {electrode + 1} seems to be dead; its channels are left out."

    def _saturated_channels(self, frame_voltages, usable_channels):
        """Mask (M,) of the channels at which the amplifier is saturated."""
        is_far_from_expected = np.abs(
            frame_voltages - self.expected_voltages
        ) > _SUSPICIOUS_RELATIVE_DIFFERENCE * np.abs(self.expected_voltages)
        is_saturated = np.zeros_like(usable_channels)
        for extreme_value in (frame_voltages[usable_channels].max(), frame_voltages[usable_channels].min()):
            is_at_extreme = usable_channels & (frame_voltages == extreme_value)
            if np.count_nonzero(is_at_extreme) < _MIN_SATURATED_CHANNELS or not extreme_value:
                continue
            # Channels whose readings are equal by symmetry, as in simulated frames, are also equal in the undisturbed
            # frame.
            if (
                is_far_from_expected[is_at_extreme].all()
                and np.ptp(self.expected_voltages[is_at_extreme])
                > _EXPECTED_EQUALITY_TOLERANCE * np.abs(self.expected_voltages[is_at_extreme]).max()
            ):
                is_saturated |= is_at_extreme
        return is_saturated

    def _remove_saturated_channels(self, frame_voltages, voltage_change, usable_channels, is_saturated):
        remaining_channels, channel_count = (
            usable_channels & ~is_saturated,
            counted(int(np.count_nonzero(is_saturated)), "channel"),
        )
        if np.count_nonzero(remaining_channels) < _MIN_VALID_CHANNEL_SHARE * np.count_nonzero(self.mask):
            return (
                frame_voltages,
                remaining_channels,
                FrameStatus.REFUSED,
                f"Saturated: {channel_count} at the ends of the range.",
            )
        if np.linalg.norm(voltage_change[remaining_channels]) > _MAX_RELATIVE_DIFFERENCE * self.expected_norm:
            return (
                frame_voltages,
                remaining_channels,
                FrameStatus.REFUSED,
                f"Saturated: {channel_count}, and the others are far off too.",
            )
        return (
            frame_voltages,
            remaining_channels,
            FrameStatus.PARTIAL,
            f"Left out: {channel_count} at the ends of the range, saturated.",
        )


class FrameImage(Module):
    """Result for one frame of a stream.

    **Fields**: `number`: number of the frame, from 0; `conductivity` (m,): S/m (2-D: S), a NumPy array, None for a
    refused frame; `status`: `FrameStatus`; `reason`: sentence that explains the status, empty for an ordinary frame;
    `usable` (M,): True for the channels used; `misfit`: root mean square of predicted - measured voltages in standard
    deviations (NaN for refused frames and linear images, for which no forward problem is solved); `iterations`: number
    of iterations; `latency`: time from the frame to its image, seconds.

    **Example:**

    ```python
    imager = Imager.create(model, 1.0, reference=reference, solver="one-step")
    image = next(stream(imager, [voltages]))
    image.status, image.latency
    ```
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
        """Whether the frame was imaged, and not refused."""
        return self.conductivity is not None


def stream(imager: Imager, frames: Iterable) -> Iterator[FrameImage]:
    """Yield the image of each frame as soon as the frame arrives.

    Iterative methods start from the last image; an imager with a memory also uses the last image as prior mean.
    Everything is compiled before the first frame is requested. A frame is refused, and the stream continues, if the
    frame has the wrong number of channels, is not real, has fewer than half of the channels usable, reads zero
    everywhere (the current source has failed), or differs from an undisturbed frame by more than half of the
    undisturbed voltages. Channels of a dead electrode and saturated channels are left out and named in `reason`. A
    frame that differs from an undisturbed frame by noise only is imaged with status "unchanged".

    **Arguments:**

    - `imager`: the imager of the sensor.
    - `frames`: iterable of frames (M,) in volts; NaN marks channels without a reading.

    Raises `ValueError` if `imager` is not an `Imager`, if `frames` is not iterable, and for an array of frames whose
    shape is not (frames, channels).

    **Example:**

    ```python
    imager = Imager.create(model, 1.0, reference=reference, solver="one-step")
    for image in stream(imager, [reference, voltages]):
        print(image.number, image.status)
    ```
    """
    check_kind("imager", imager, Imager, "an Imager, as of Imager.create or prepare_imager(reference)[0]")
    check_kind("frames", frames, Iterable, "frames one after another, each (M,) volts")
    if isinstance(frames, (np.ndarray, jax.Array)) and frames.ndim != 2:
        raise ValueError(f"frames has shape {frames.shape}; give (frames, channels), or for one frame [frame].")
    return _image_frames(imager, frames)


def _image_frames(imager: Imager, frames: Iterable) -> Iterator[FrameImage]:
    stream_state = StreamState(imager)
    for frame_index, frame in enumerate(frames):
        yield stream_state.image(frame_index, frame)


class StreamState:
    """State of a stream between frames, for programs that receive frames one by one; `stream` also uses this class.
    Everything is compiled when a state is created.

    **Arguments:**

    - `imager`: the imager of the sensor.

    **Example:**

    ```python
    state = StreamState(Imager.create(model, 1.0, reference=reference, solver="one-step"))
    state.image(0, voltages).status
    ```
    """

    # NumPy is used where JAX's dispatch would take longer than the computation.

    def __init__(self, imager: Imager):
        self.imager = imager
        self.mask = np.asarray(imager.mask)
        self.is_unmasked = bool(self.mask.all())
        self.expected = np.asarray(imager.expected)
        touching, reciprocal_pairs, noise = jax.tree.map(np.asarray, (imager.touching, imager.tied, imager.noise))
        self.check = FrameCheck(self.mask, self.expected, touching, reciprocal_pairs, noise)
        self.coefficients = np.asarray(imager.start)
        self.last = self.expected
        self._set_weighing(self.mask)
        self._estimate_image(self.expected)  # compiles
        self.coefficients = np.asarray(imager.start)

    def image(self, number: int, frame: Any) -> FrameImage:
        """Image of the frame with this `number`, or the reason why the frame was refused."""
        start_time = time.perf_counter()
        frame_voltages, usable, status, reason = self.check(frame)
        if status == FrameStatus.REFUSED:
            return FrameImage(number, None, status, reason, usable, np.nan, 0, time.perf_counter() - start_time)
        if usable is not self.usable and not np.array_equal(usable, self.usable):
            self._set_weighing(usable)
        filled_frame = (
            frame_voltages if usable is self.mask and self.is_unmasked else np.where(usable, frame_voltages, self.last)
        )
        conductivity, misfit, iterations, has_converged = self._estimate_image(filled_frame)
        if not np.isfinite(conductivity).all():
            reason = "The image became NaN; the next frame starts from the background again."
            self.coefficients = np.asarray(self.imager.start)
            return FrameImage(
                number, None, FrameStatus.REFUSED, reason, usable, np.nan, iterations, time.perf_counter() - start_time
            )
        self.last = filled_frame
        if not has_converged and status in (FrameStatus.IMAGED, FrameStatus.UNCHANGED):
            status = FrameStatus.STEP_LIMIT
            iteration_text = counted_iterations(iterations, self.imager.steps - iterations)
            reason = f"Stopped after {iteration_text}: this frame needs more than a frame is given."
        return FrameImage(
            number, conductivity, status, reason, usable, misfit, iterations, time.perf_counter() - start_time
        )

    def _set_weighing(self, usable_channels) -> None:
        self.usable = usable_channels
        self.weighing = self.imager.weighing(jnp.asarray(usable_channels))
        if self.imager.solver.is_linear:
            linear_map = self.imager.linear_map(self.weighing)
            # Reading the matrix takes most of the time of a linear image. The matrix multiplies differences, so single
            # precision suffices; BLAS reads the matrix in half the time in column-major order.
            self.matrix = np.asfortranarray(linear_map.matrix, np.float32)
            self.estimator = np.asarray(linear_map.estimator)
            self.expected_weights = self.estimator @ self.expected
            self.carry_matrix = np.asarray(linear_map.carry)
            self.level = np.asarray(linear_map.level) + np.asarray(linear_map.matrix) @ self.expected_weights

    def _estimate_image(self, frame):
        """Image a checked frame. Returns the conductivity, the misfit, the number of iterations, and whether the image
        converged."""
        if self.imager.solver.is_linear:
            coefficient_weights = self.estimator @ frame - self.expected_weights
            if self.imager.persistence > 0:
                coefficient_weights = self.coefficients = coefficient_weights + self.carry_matrix @ self.coefficients
            return self.level + self.matrix @ coefficient_weights.astype(np.float32), np.nan, 1, True
        estimate = self.imager.estimate(frame, self.weighing, jnp.asarray(self.coefficients))
        self.coefficients = estimate.coefficients * (self.imager.persistence or 1.0)
        return (
            np.asarray(estimate.conductivity),
            float(estimate.misfit),
            int(estimate.iterations),
            bool(estimate.converged),
        )
