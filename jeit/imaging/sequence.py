"""Imaging of many frames at once, and of frames measured at two frequencies.

Frequency-difference imaging compares a body at two frequencies, without a frame of the empty body. Admittivity σ + iωε
depends on frequency, in tissue and in phantoms of tissue more than in saline. The plain difference v₂ - v₁ of the
voltages at the second and the first frequency contains the changes of the background and of the objects. The weighted
difference v₂ - αv₁ with α = ⟨v₁, v₂⟩ / ⟨v₁, v₁⟩ removes the part of v₂ that is proportional to v₁; the weighted
difference is zero for a homogeneous body. Seo, Lee, Kim, Zribi and Woo, Physiol. Meas. 29 (2008) 755-769; Jun, Kuen,
Lee, Woo, Holder and Seo, Physiol. Meas. 30 (2009) 1087-1099.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float

from jeit.arguments import counted
from jeit.data import Measurement
from jeit.data.frame_checks import assess, check_same_setup
from jeit.data.screening import mask_spikes
from jeit.files import check_memory
from jeit.image.image_series import ImageSeries
from jeit.imaging.calibration import StepTimer
from jeit.imaging.difference import ImagedDifference, image_difference
from jeit.imaging.method import AUTO, METHODS, ImagingSettings, MethodOptions, as_settings
from jeit.imaging.preparation import (
    PreparedDifference,
    check_measurement,
    check_real,
    prepare_difference,
    select_frames,
)
from jeit.inverse import relative_noise
from jeit.inverse.linear.one_step import LinearReconstruction
from jeit.inverse.streaming.stream import FrameCheck, FrameStatus
from jeit.mesh import Mesh
from jeit_solvers.engines import as_array

# Number of frames imaged at once, and number of bytes of a stored value.
_FRAMES_PER_BATCH, _BYTES_PER_VALUE = 256, 4
# Minimum share of the frames in which a channel must be valid for the channel to be used.
_MIN_USABLE_FRAME_SHARE = 0.5
# Maximum number of frames that are assessed, in order of decreasing difference from the reference, until one can be
# imaged.
_MAX_ASSESSED_FRAMES = 10
# Maximum number of frames, those that differ most from the reference, in which moved electrodes are searched for.
_MAX_SEARCHED_FRAMES = 1000


@dataclass(frozen=True)
class ImagedSequence:
    """Images of the frames of a measurement: the result of `image_sequence`.

    **Fields**

    - `series`: the images.
    - `prepared`: the prepared difference, with the model of the body.
    - `reconstruction`: the reconstruction matrix, the same for all images.
    - `refused`: (F,), True for frames without an image; `reasons`: why, by the number of the frame, from 0.
    - `regions`: cells of each requested region, (m,) booleans, by name.
    - `moved`: (F,), True for frames much of whose difference moved electrodes explain; their images show the rest.

    **Example:**

    ```python
    imaged = image_sequence(join([rest, pressed]), rest, quick)
    imaged.series.changes, imaged.refused
    ```
    """

    series: ImageSeries
    prepared: PreparedDifference
    reconstruction: LinearReconstruction
    refused: Bool[np.ndarray, " F"]
    regions: Mapping[str, Bool[np.ndarray, " m"]] = field(default_factory=dict)
    moved: Bool[np.ndarray, " F"] = field(default_factory=lambda: np.zeros(0, bool))
    reasons: Mapping[int, str] = field(default_factory=dict)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Reasons to doubt the images, in sentences, from the frame for which λ was chosen: the one that differs most
        from the reference; and the number of frames with moved electrodes."""
        doubt_texts = replace(self.prepared, electrode_change=None).doubts
        if not self.moved.any():
            return doubt_texts
        num_moved, num_imaged = int(self.moved.sum()), int((~self.refused).sum())
        return (
            *doubt_texts,
            f"in {num_moved} of {counted(num_imaged, 'frame')} the voltages have changed as if electrodes had moved "
            "since the reference. Their images show the rest of the difference (as_is=True, --as-is: all of it). "
            "Measure a new reference.",
        )


def image_sequence(
    measurement: Measurement,
    reference: Measurement | None = None,
    settings: ImagingSettings | None = None,
    *,
    regions: Mapping[str, Callable[[Mesh], Bool[np.ndarray, " m"]]] | None = None,
    progress: Callable[[str], None] | None = None,
) -> ImagedSequence:
    """Image every frame of a measurement, with one linear method and one λ. If frames have no times, their numbers
    replace the times.

    **Arguments:**

    - `measurement`: the frames.
    - `reference`: the undisturbed body; default: the frame named "reference", or else the mean of all frames, so that
      images show changes relative to the average.
    - `settings`: settings of a linear method; default: one-step imaging. λ is chosen for the frame that differs most
      from the reference.
    - `regions`: regions of interest by name, each a function of the mesh, such as `lambda mesh:
      jeit.image.ball_region(mesh, (0, 0), 0.01)`. These functions are called before imaging, so that their errors are
      raised early.
    - `progress`: function called with the name of each step when the step begins.

    Spikes in single channels are replaced by values that other channels determine (`jeit.data.mask_spikes`). Channels
    missing in more than half of the frames are not used; frames that lack any of the used channels are refused. Frames
    whose noise hides every change or is caused by one electrode are also refused, as by `jeit.inverse.stream`. So are
    frames that cannot be imaged (`jeit.data.check_imageable`) and differ more from the reference than all frames that
    can be imaged. The images need four bytes per cell and frame. Raises `ValueError` in the same cases as
    `image_difference`, for a measurement with one frame, for an iterative method, and for images that would not fit in
    memory.

    **Example:**

    ```python
    imaged = image_sequence(join([rest, pressed]), rest, quick)
    ```
    """
    check_measurement("measurement", measurement)
    check_real(measurement)
    if measurement.num_frames < 2:
        raise ValueError(f"'{measurement.name}' has {measurement.num_frames} frame; a series takes two at least.")
    frame_times = np.arange(measurement.num_frames) if measurement.times is None else np.asarray(measurement.times)
    settings = as_settings(settings)
    if settings.method == AUTO:
        settings = replace(settings, method="one-step")
    step_timer = StepTimer(progress)
    if reference is None and "reference" not in measurement.frame_names:
        reference = measurement.mean_frame()
    _, reference_frame = select_frames(measurement, reference)
    check_same_setup(measurement, reference_frame)
    if not settings.as_is:
        measurement = mask_spikes(measurement, reference_frame, fill=True)
    measured_voltages, usable_channels = np.asarray(measurement.voltages), np.asarray(measurement.mask)
    reference_voltages = np.asarray(reference_frame.voltages)[0]
    usable_in_most_frames = (usable_channels.mean(axis=0) >= _MIN_USABLE_FRAME_SHARE) & np.asarray(
        reference_frame.mask
    )[0]
    is_refused_frame = np.asarray(~usable_channels[:, usable_in_most_frames].all(axis=1))
    refusal_reasons = dict.fromkeys(
        map(int, np.flatnonzero(is_refused_frame)), "It lacks channels that most frames have."
    )
    if not usable_in_most_frames.any() or is_refused_frame.all():
        raise ValueError(f"'{measurement.name}': no channel is usable in most frames, or none has all of them.")
    if not settings.as_is:
        faulty_frames = _noisy_frames(
            measured_voltages - reference_voltages, usable_in_most_frames & usable_channels, reference_frame
        )
        # If all frames are refused, the error of the frame with the largest change is raised later.
        if len(refusal_reasons | faulty_frames) < measurement.num_frames:
            refusal_reasons |= faulty_frames
            is_refused_frame[list(refusal_reasons)] = True
    total_voltage_change = np.abs(np.where(usable_in_most_frames, measured_voltages - reference_voltages, 0)).sum(
        axis=1
    )
    if not usable_in_most_frames.all():
        measurement = measurement.masked(usable_in_most_frames, "they are missing in most frames, or in the reference.")
    frames_by_change = np.argsort(np.where(is_refused_frame, 1.0, -total_voltage_change), kind="stable")[
        : (~is_refused_frame).sum()
    ]
    faulty_frames = {}
    for change_rank, frame_index in enumerate(map(int, frames_by_change[:_MAX_ASSESSED_FRAMES])):
        if not (refusal_reason := assess(measurement.frame(frame_index), reference_frame)[0].reason):
            is_refused_frame[list(faulty_frames)] = True
            refusal_reasons |= faulty_frames
            frames_by_change = frames_by_change[change_rank:]
            break
        faulty_frames[frame_index] = f"{refusal_reason[0].upper()}{refusal_reason[1:]}"
    largest_change_frame = int(frames_by_change[0])
    prepared = prepare_difference(
        measurement,
        reference_frame,
        frame=largest_change_frame,
        contact=settings.contact,
        num_points=settings.num_points,
        as_is=settings.as_is,
        clock=step_timer,
    )
    region_masks = {name: region(prepared.mesh) for name, region in (regions or {}).items()}
    num_frames, num_cells = measurement.num_frames, prepared.mesh.num_cells
    check_memory(
        f"the images of '{measurement.name}', {num_frames} frames,", float(_BYTES_PER_VALUE * num_frames * num_cells)
    )
    with step_timer("image"):
        reconstruction, _ = METHODS[settings.method].image(
            prepared, MethodOptions(settings.prior, settings.hyperparameter)
        )
        if not isinstance(reconstruction, LinearReconstruction):
            raise ValueError(
                f"method: {settings.method} images frame by frame; take a linear one, or `jeit.inverse.stream`."
            )
        conductivity_changes, has_moved_electrodes = (
            np.full((num_frames, num_cells), np.nan, np.float32),
            np.zeros(num_frames, bool),
        )
        electrode_changes = None if settings.as_is else prepared.electrode_changes
        voltage_differences = np.where(
            usable_in_most_frames, measured_voltages[frames_by_change[:_MAX_SEARCHED_FRAMES]] - reference_voltages, 0
        )
        change_estimator = electrode_changes and electrode_changes.estimator_for(voltage_differences)
        imaged_frames = np.flatnonzero(~is_refused_frame)
        for batch_start in range(0, len(imaged_frames), _FRAMES_PER_BATCH):
            batch_frames = imaged_frames[batch_start : batch_start + _FRAMES_PER_BATCH]
            batch_differences = np.where(usable_in_most_frames, measured_voltages[batch_frames] - reference_voltages, 0)
            if electrode_changes is not None and change_estimator is not None:
                change_due_to_electrodes = electrode_changes.voltages(batch_differences, change_estimator)
                has_moved_electrodes[batch_frames] = change_due_to_electrodes.any(axis=1)
                batch_differences = batch_differences - change_due_to_electrodes
            conductivity_changes[batch_frames] = np.asarray(reconstruction.image(as_array(batch_differences)))
    background_conductivity = float(np.real(prepared.calibration.conductivity))
    series = ImageSeries(
        prepared.mesh, conductivity_changes, frame_times, background_conductivity, timed=measurement.times is not None
    )
    return ImagedSequence(
        series, prepared, reconstruction, is_refused_frame, region_masks, has_moved_electrodes, refusal_reasons
    )


def _noisy_frames(
    voltage_changes: Float[np.ndarray, "F M"], usable_channels: Bool[np.ndarray, "F M"], reference: Measurement
) -> dict[int, str]:
    """Find the frames whose noise hides every change or is caused by one electrode, from their `voltage_changes` (F, M)
    in volts. Returns the number of each such frame with the reason to refuse it."""
    protocol, reference_voltages = reference.protocol, np.asarray(reference.voltages)[0]
    channels_at_electrodes = np.array(
        [protocol.channels_touching(electrode) for electrode in range(protocol.num_electrodes)]
    )
    reciprocal_pairs, reciprocal_ratios = map(np.asarray, protocol.reciprocal_pairs())
    is_used_channel = usable_channels.any(axis=0)
    channel_noise = np.asarray(relative_noise(reference_voltages, as_array(is_used_channel)))
    frame_check = FrameCheck(
        is_used_channel,
        reference_voltages,
        channels_at_electrodes,
        (reciprocal_pairs.reshape(-1, 2), reciprocal_ratios),
        channel_noise,
    )
    noise_judgements = (
        frame_check.check_noise_by_reciprocity(np.where(is_used_channel, voltage_change, 0), is_used_channel)
        for voltage_change, is_used_channel in zip(voltage_changes, usable_channels, strict=True)
    )
    faulty_statuses = FrameStatus.REFUSED, FrameStatus.PARTIAL
    return {
        frame_number: refusal_reason.removesuffix(" Its channels are left out.")
        for frame_number, (_, frame_status, refusal_reason) in enumerate(noise_judgements)
        if frame_status in faulty_statuses
    }


@dataclass(frozen=True)
class ImagedFrequencies:
    """Image of the change of a body between two frequencies: the result of `image_frequencies`.

    **Fields**

    - `image`: the image of the weighted difference of the two frequencies.
    - `weight`: factor α that multiplies the voltages at the first frequency: the ratio by which the voltages of the
      body as a whole change; 1 for plain differences.

    **Example:**

    ```python
    imaged = image_frequencies(pressed, rest, quick)
    imaged.weight, imaged.image.inclusions
    ```
    """

    image: ImagedDifference
    weight: complex


def image_frequencies(
    second: Measurement,
    first: Measurement,
    settings: ImagingSettings | None = None,
    *,
    weighted: bool = True,
    frame: int | str | None = None,
) -> ImagedFrequencies:
    """Image the change of a body between two frequencies, relative to the change of the body as a whole.

    **Arguments:**

    - `second`, `first`: voltages of the same body, electrodes and protocol at two frequencies; complex voltages give an
      image of admittivity.
    - `settings`: as for `image_difference`.
    - `weighted`: whether to image v₂ - αv₁ (see `frequency_weight`) or v₂ - v₁. The background is fitted to the
      subtracted voltages, αv₁ or v₁.
    - `frame`: number (from 0) or name of the frame of `second`; default: the first.

    Raises `ValueError` for data that cannot be imaged, and if the voltages at the two frequencies are not similar.

    **Example:**

    ```python
    imaged = image_frequencies(pressed, rest, quick)
    ```
    """
    check_measurement("second", second)
    check_measurement("first", first)
    second_frame = second.frame(0 if frame is None else frame)
    first_frame = first.mean_frame()
    voltage_weight = frequency_weight(second_frame, first_frame) if weighted else 1.0
    scaled_voltages = as_array(voltage_weight * np.asarray(first_frame.voltages))
    scaled_reference = replace(
        first_frame,
        voltages=scaled_voltages,
        name=f"{_weight_text(voltage_weight)} × {first_frame.name}" if weighted else first_frame.name,
    )
    return ImagedFrequencies(image_difference(second_frame, scaled_reference, settings), complex(voltage_weight))


def frequency_weight(second: Measurement, first: Measurement) -> float | complex:
    """Weight α = ⟨v₁, v₂⟩ / ⟨v₁, v₁⟩ of the voltages at the first frequency, computed from the first frame of each
    measurement and the channels that are usable in both frames; complex for complex voltages.

    **Arguments:**

    - `second`, `first`: voltages of the same body at two frequencies.

    Raises `ValueError` if the numbers of channels differ, and if α is not finite or its real part is not positive.

    **Example:**

    ```python
    weight = frequency_weight(pressed, rest)
    ```
    """
    second_voltages, first_voltages = np.asarray(second.voltages)[0], np.asarray(first.voltages)[0]
    if second_voltages.shape != first_voltages.shape:
        raise ValueError(
            f"second has {second_voltages.size} channels and first {first_voltages.size}; measure both with one "
            "protocol."
        )
    usable_channels = np.asarray(second.mask)[0] & np.asarray(first.mask)[0]
    voltage_weight = np.vdot(first_voltages[usable_channels], second_voltages[usable_channels]) / np.vdot(
        first_voltages[usable_channels], first_voltages[usable_channels]
    )
    if not (np.isfinite(voltage_weight) and voltage_weight.real > 0):
        raise ValueError(
            f"second and first have nothing in common (α = {voltage_weight:.3g}); are they the same body at two "
            "frequencies, with the polarity of the one that of the other?"
        )
    return voltage_weight.item()


def _weight_text(voltage_weight: float | complex) -> str:
    return (
        f"{voltage_weight.real:.3g}{voltage_weight.imag:+.3g}i"
        if isinstance(voltage_weight, complex)
        else f"{voltage_weight:.3g}"
    )
