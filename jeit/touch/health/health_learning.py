"""Learn the healthy state of a skin from a recording of the skin, with or without a calibrated model."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind
from jeit.data import FrameRecording
from jeit.data.description import Description
from jeit.touch.gestures.touch_images import TouchImages
from jeit.touch.health import SkinHealth

# Minimum fraction of a frame's channels that have a reading.
_MIN_READ_FRACTION = 0.5
# Number of healthy frames below which drift is poorly known.
_MIN_NUM_FRAMES = 250
# Ratio of the readings of two recordings above which different units are suspected.
_MAX_UNIT_RATIO = 20.0


def learn_health(
    healthy: FrameRecording,
    description: Description | None = None,
    *,
    sign: int = 1,
    rate: float | None = None,
    patience: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> SkinHealth:
    """Learn the healthy state of a skin to be monitored, from a recording of frames of the healthy skin.

    **Arguments:**

    - `healthy`: the recording of the healthy skin. The times of its frames are recorded, or computed from `rate`;
      without either, times are frame numbers.
    - `description`: description of the skin. If the description has a protocol, failing electrodes are identified. If
      the description also has geometry and electrodes, a model is calibrated on the untouched frames to locate cuts.
    - `sign`: as in `SkinHealth.fit`, -1 for skins that conduct worse where touched.
    - `rate`: frames/s of a recording without times.
    - `patience`: time longer than any touch is held, seconds.
    - `progress`: called with a description of each step as the step begins.

    Raises `ValueError` as `SkinHealth.fit` and `TouchImages.prepare` do.

    **Example:**

    ```python
    health = learn_health(healthy_recording, rate=5.0)
    print(watch(health, damaged).events)
    ```
    """
    check_kind("healthy", healthy, FrameRecording, "a FrameRecording, as of read_frame_recording(path)")
    frames, seconds = healthy.frames, seconds_of(healthy, rate)
    if seconds is not None:
        is_later_than_previous = np.diff(seconds, prepend=-np.inf) > 0  # duplicate frames are left out
        frames, seconds = frames[is_later_than_previous], seconds[is_later_than_previous]
    skin_health_options = {"patience": patience, "sign": sign}
    if description is None:
        return SkinHealth.fit(frames, seconds, **skin_health_options)
    if description.domain is None or description.electrodes is None:
        return SkinHealth.fit(frames, seconds, protocol=description.protocol(healthy.name), **skin_health_options)
    median_untouched_frame = (
        np.nanmedian(frames, axis=0, keepdims=True) if healthy.reference is None else healthy.reference
    )
    touch_images = TouchImages.prepare(description, median_untouched_frame, progress=progress)
    background_conductivity = np.full(touch_images.mesh.num_cells, touch_images.background)
    return SkinHealth.fit(
        frames,
        seconds,
        model=touch_images.calibration.model,
        conductivity=background_conductivity,
        **skin_health_options,
    )


def seconds_of(recording: FrameRecording, rate: float | None) -> Float[np.ndarray, " F"] | None:
    """Return the times of a recording's frames, seconds: those recorded, or computed from `rate`, frames/s; None if
    neither is known."""
    if recording.seconds is None:
        return None if rate is None else np.arange(len(recording.frames)) / rate
    return recording.seconds


def doubts_of(health: SkinHealth, healthy: FrameRecording, frames: Float[np.ndarray, "F M"]) -> list[str]:
    """List reasons to doubt the detected events of a monitored skin, as sentences.

    **Arguments:**

    - `health`: state of the monitored skin, as from `learn_health`.
    - `healthy`: the recording from which the healthy state was learnt.
    - `frames`: the monitored frames (frames, channels), volts.

    Raises `ValueError` if no frame has a reading in half of the healthy channels.

    **Example:**

    ```python
    health = learn_health(healthy_recording)
    print(doubts_of(health, healthy_recording, damaged))
    ```
    """
    healthy_state = health.healthy
    has_reading = np.isfinite(frames)
    if not (has_reading[:, healthy_state.used].mean(axis=1) >= _MIN_READ_FRACTION).any():
        raise ValueError("frames: none of them has a reading in half of the healthy recording's channels.")
    warning_texts = []
    window_length = healthy_state.window * healthy_state.stride
    if len(frames) < 2 * window_length:
        warning_texts.append(
            f"{len(frames)} frames are fewer than two windows of {window_length}: a change that lasts cannot be "
            "distinguished from a touch in them."
        )
    if healthy_state.is_brief or len(healthy.frames) < _MIN_NUM_FRAMES:
        warning_texts.append(
            f"the healthy recording has {len(healthy.frames)} frames, few beside the length of touches, or at all: "
            "findings may be false, and damage may be missed. Give forty of the longest touches, and a minute; or a "
            f"shorter patience than {health.patience:.3g}, if no touch lasts that long."
        )
    silent_channels = np.flatnonzero(healthy_state.used & ~has_reading.any(axis=0))
    if silent_channels.size:
        warning_texts.append(
            f"without any reading: channels {', '.join(map(str, silent_channels[:12]))}, counted from 0."
        )
    first_readings = np.where(
        has_reading.any(axis=0), np.take_along_axis(frames, has_reading.argmax(axis=0)[None], axis=0)[0], np.nan
    )
    constant_channels = np.flatnonzero(
        healthy_state.used & has_reading.any(axis=0) & (~has_reading | (frames == first_readings)).all(axis=0)
    )
    if constant_channels.size and len(frames) > 2:
        warning_texts.append(
            f"constant throughout: channels {', '.join(map(str, constant_channels[:12]))}, counted from 0."
        )
    median_voltages = np.nanmedian(
        np.where(has_reading, frames, np.nan)[:, healthy_state.used & has_reading.any(axis=0)], axis=0
    )
    healthy_median_voltages = healthy_state.reference[healthy_state.used & has_reading.any(axis=0)]
    voltage_ratio = float(np.median(np.abs(median_voltages)) / max(np.median(np.abs(healthy_median_voltages)), 1e-300))
    if not 1 / _MAX_UNIT_RATIO < voltage_ratio < _MAX_UNIT_RATIO:
        warning_texts.append(f"frames are {voltage_ratio:.3g} times the healthy ones: are both in the same unit?")
    return warning_texts
