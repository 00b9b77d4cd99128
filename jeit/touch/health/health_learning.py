"""What a skin is like while it is healthy, from a recording of it: on frames alone, or with a calibrated model."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind
from jeit.data import FrameRecording
from jeit.data.description import Description
from jeit.touch.gestures.touch_images import TouchImages
from jeit.touch.health import SkinHealth

# Of a frame's channels, how many have a reading at least; healthy frames of which little is known of drift; and between
# recordings, how many times larger readings are of another unit.
_READ, _FEW, _ANOTHER = 0.5, 250, 20.0


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


def doubts_of(health: SkinHealth, healthy: FrameRecording, frames: Float[np.ndarray, "F M"]) -> list[str]:
    """What speaks against what a `health`, learnt from `healthy`, tells of frames (F, M): a sentence each.

    Raises `ValueError` for frames of which none has enough readings.
    """
    known = health.healthy
    there = np.isfinite(frames)
    if not (there[:, known.used].mean(axis=1) >= _READ).any():
        raise ValueError("frames: none of them has a reading in half of the healthy recording's channels.")
    doubts = []
    window = known.window * known.stride
    if len(frames) < 2 * window:
        doubts.append(
            f"{len(frames)} frames are fewer than two windows of {window}: a change that lasts cannot be told from a "
            "touch in them."
        )
    if known.brief or len(healthy.frames) < _FEW:
        doubts.append(
            f"the healthy recording has {len(healthy.frames)} frames, few beside the length of touches, or at all: "
            "what is told may be false, and what is not may be there. Give forty of the longest touches, and a minute."
        )
    silent = np.flatnonzero(known.used & ~there.any(axis=0))
    if silent.size:
        doubts.append(f"without any reading: channels {', '.join(map(str, silent[:12]))}, counted from 0.")
    first = np.where(there.any(axis=0), np.take_along_axis(frames, there.argmax(axis=0)[None], axis=0)[0], np.nan)
    constant = np.flatnonzero(known.used & there.any(axis=0) & (~there | (frames == first)).all(axis=0))
    if constant.size and len(frames) > 2:
        doubts.append(f"constant throughout: channels {', '.join(map(str, constant[:12]))}, counted from 0.")
    off = np.nanmedian(np.where(there, frames, np.nan)[:, known.used & there.any(axis=0)], axis=0)
    own = known.reference[known.used & there.any(axis=0)]
    ratio = float(np.median(np.abs(off)) / max(np.median(np.abs(own)), 1e-300))
    if not 1 / _ANOTHER < ratio < _ANOTHER:
        doubts.append(f"frames are {ratio:.3g} times the healthy ones: are both in the same unit?")
    return doubts
