"""Series of linear images: every frame of a measurement against one reference, with one factorisation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool

from jeit.data import Measurement
from jeit.data.imageable import check_same_setup
from jeit.files import check_memory
from jeit.image.image_series import ImageSeries
from jeit.imaging.clock import Clock
from jeit.imaging.method import METHODS, Asked
from jeit.imaging.preparation import (
    PreparedDifference,
    check_measurement,
    check_real,
    prepare_difference,
    select_frames,
)
from jeit.imaging.settings import AUTO, ImagingSettings, as_settings
from jeit.inverse.linear.one_step import LinearReconstruction
from jeit.mesh import Mesh
from jeit_solvers.engines import as_array

# Frames that are imaged at once, and bytes of a number that is kept.
_BATCH, _KEPT = 256, 4
# Channels that a frame may lack, of those that most frames have.
_MOST_FRAMES = 0.5


@dataclass(frozen=True)
class ImagedSequence:
    """Result of `image_sequence`: the `series` of images; `prepared`, the model of the body; the `reconstruction`
    matrix that made all of them; `refused` (F,), True for frames that lack channels and have no image; `regions`, (m,)
    True for the cells of each that was asked for, by name."""

    series: ImageSeries
    prepared: PreparedDifference
    reconstruction: LinearReconstruction
    refused: Bool[np.ndarray, " F"]
    regions: Mapping[str, Bool[np.ndarray, " m"]] = field(default_factory=dict)


def image_sequence(
    measurement: Measurement,
    reference: Measurement | None = None,
    settings: ImagingSettings | None = None,
    *,
    regions: Mapping[str, Callable[[Mesh], Bool[np.ndarray, " m"]]] | None = None,
    progress: Callable[[str], None] | None = None,
) -> ImagedSequence:
    """Image every frame of a measurement that has times, with one linear method and one λ.

    - `reference`: the undisturbed body; unless given a frame named "reference", or else the mean over all frames: then
      images are changes about what the body is like on average.
    - `settings`: of a linear method, one-step unless given. λ is chosen for the frame that differs most.
    - `regions`: of interest, by name, each a function of the mesh, such as
      `lambda mesh: jeit.image.ball_region(mesh, (0, 0), 0.01)`; called before any image, so that what they raise is.

    Channels that fewer than half of the frames have are left out of all; frames that lack another are refused. The
    images take four bytes a cell and frame. Raises `ValueError` as `image_difference`, for a measurement without times
    or of one frame, for an iterative method, and for images that would not fit in memory.
    """
    check_measurement("measurement", measurement)
    check_real(measurement)
    if measurement.times is None or measurement.num_frames < 2:
        untimed = "" if measurement.times is not None else ", without times"
        raise ValueError(
            f"'{measurement.name}' has {measurement.num_frames} frames{untimed}; a series takes two at least, and "
            "their times: give [data] frame_rate in a description."
        )
    settings = as_settings(settings)
    if settings.method == AUTO:
        settings = replace(settings, method="one-step")
    clock = Clock(progress)
    voltages, mask = np.asarray(measurement.voltages), np.asarray(measurement.mask)
    if reference is None and "reference" not in measurement.frame_names:
        reference = measurement.mean_frame()
    _, base = select_frames(measurement, reference)
    check_same_setup(measurement, base)
    expected = np.asarray(base.voltages)[0]
    common = (mask.mean(axis=0) >= _MOST_FRAMES) & np.asarray(base.mask)[0]
    refused = np.asarray(~mask[:, common].all(axis=1))
    if not common.any() or refused.all():
        raise ValueError(f"'{measurement.name}': no channel is usable in most frames, or none has all of them.")
    away = np.abs(np.where(common, voltages - expected, 0)).sum(axis=1)
    strongest = int(np.argmax(np.where(refused, -1, away)))
    usable = measurement.masked(common, "they are missing in most frames, or in the reference.")
    prepared = prepare_difference(
        usable if not common.all() else measurement,
        base,
        frame=strongest,
        contact=settings.contact,
        num_points=settings.num_points,
        as_is=settings.as_is,
        clock=clock,
    )
    chosen = {name: region(prepared.mesh) for name, region in (regions or {}).items()}
    number, cells = measurement.num_frames, prepared.mesh.num_cells
    check_memory(f"the images of '{measurement.name}', {number} frames,", float(_KEPT * number * cells))
    with clock("image"):
        found, _ = METHODS[settings.method].image(prepared, Asked(settings.prior, settings.hyperparameter))
        if not isinstance(found, LinearReconstruction):
            raise ValueError(
                f"method: {settings.method} images frame by frame; take a linear one, or `jeit.inverse.stream`."
            )
        changes = np.full((number, cells), np.nan, np.float32)
        good = np.flatnonzero(~refused)
        for start in range(0, len(good), _BATCH):
            some = good[start : start + _BATCH]
            difference = as_array(np.where(common, voltages[some] - expected, 0))
            changes[some] = np.asarray(found.image(difference))
    background = float(np.real(prepared.calibration.conductivity))
    series = ImageSeries(prepared.mesh, changes, np.asarray(measurement.times), background)
    return ImagedSequence(series, prepared, found, refused, chosen)
