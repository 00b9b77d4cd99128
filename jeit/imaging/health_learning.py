"""What a skin is like while it is healthy, from a recording of it: on frames alone, or with a calibrated model."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind
from jeit.data import FrameRecording
from jeit.data.description import Description
from jeit.imaging.touch_images import TouchImages
from jeit.touch.health import SkinHealth


def learn_health(
    healthy: FrameRecording,
    description: Description | None = None,
    *,
    sign: int = 1,
    rate: float | None = None,
    patience: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> SkinHealth:
    """A skin to be watched, from frames of it while it is healthy, at its times, or `rate` frames/s; without either,
    frames are counted.

    A `description` with a protocol lets electrodes that fail be named; with geometry and electrodes too, a model is
    calibrated on the median of the frames, so that cuts are found on it: `sign` as in `SkinHealth.fit`, -1 for skins
    that conduct worse where touched. `patience`, seconds. Raises `ValueError` as `SkinHealth.fit` and
    `TouchImages.prepare` do.
    """
    check_kind("healthy", healthy, FrameRecording, "a FrameRecording, as of read_frame_recording(path)")
    frames, seconds = healthy.frames, seconds_of(healthy, rate)
    if seconds is not None:
        later = np.diff(seconds, prepend=-np.inf) > 0  # doubled frames are left out
        frames, seconds = frames[later], seconds[later]
    given = {"patience": patience, "sign": sign}
    if description is None:
        return SkinHealth.fit(frames, seconds, **given)
    if description.domain is None or description.electrodes is None:
        return SkinHealth.fit(frames, seconds, protocol=description.protocol(healthy.name), **given)
    rest = np.nanmedian(frames, axis=0, keepdims=True) if healthy.reference is None else healthy.reference
    images = TouchImages.prepare(description, rest, progress=progress)
    background = np.full(images.mesh.num_cells, images.background)
    return SkinHealth.fit(frames, seconds, model=images.calibration.model, conductivity=background, **given)


def seconds_of(recording: FrameRecording, rate: float | None) -> Float[np.ndarray, " F"] | None:
    """When frames came: as the recording says, or at `rate` frames/s; None where nobody knows."""
    if recording.seconds is None:
        return None if rate is None else np.arange(len(recording.frames)) / rate
    return recording.seconds
