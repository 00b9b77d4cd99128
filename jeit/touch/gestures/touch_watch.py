"""Classify touches of a live skin as they end.

A touch is classified at the first frame below the touch level, the earliest at which it may have ended. It has ended
for good when the skin has been untouched for the time `gap`. While the skin is untouched, the reference frame follows
its drift, so that drift is not detected as a touch. A touch that lasts longer than the time `patience` is reported as
held, and becomes part of the reference.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind, describe, is_number
from jeit.inverse.streaming.stream import FrameImage
from jeit.touch.gestures import GestureModel, StreamTouch, TouchLevel, TouchStream
from jeit.touch.gestures.touch_images import TouchImages

# Minimum untouched time between two touches, in seconds and in frames, of which the longer applies; untouched time
# after which the reference frame follows the skin's drift, and time constant of this adaptation, both in seconds.
_MIN_GAP, _MIN_GAP_FRAMES, _SETTLING_TIME, _DRIFT_TIME_CONSTANT = 0.1, 2.5, 0.5, 2.0
# Maximum fraction of the initial untouched frames that may exceed the touch level of the model.
_MAX_FRACTION_ABOVE_LEVEL = 0.1
# A change of the sign opposite to a touch shows that the skin was touched when its reference was recorded: minimum
# ratio of this change to the touch level.
_MIN_OPPOSITE_RATIO = 3.0
# Minimum duration of an opposite change, seconds.
_MIN_OPPOSITE_TIME = 0.5


@dataclass(frozen=True)
class NamedTouch:
    """A touch and its predicted gesture.

    **Fields**: `number`: rank in order of onset, from 1; `touch`: the touch; `gesture`: most probable gesture;
    `probability`: probability of this gesture; `probabilities` (C,): probabilities of all C gestures; `unlike`: whether
    the touch is unlike all touches of the training set, so that the prediction is not valid; `named`: time in the
    stream at which the touch was classified, seconds; `latency`: computing time from the arrival of the last frame to
    the prediction, seconds; `held`: whether the touch was cut off because it lasted longer than the watch's `patience`.

    **Example:**

    ```python
    for touch in named_touches:
        print(isinstance(touch, NamedTouch), touch.gesture, touch.probability)
    ```
    """

    number: int
    touch: StreamTouch
    gesture: str
    probability: float
    probabilities: Float[np.ndarray, " C"]
    unlike: bool
    named: float
    latency: float
    held: bool = False


@dataclass(frozen=True)
class WatchedFrame:
    """Result of a `TouchWatch` for one frame: whether the skin is touched, and which touches have ended.

    **Fields**: `second`: time of the frame, seconds; `image`: image of the frame, None in the result after the last
    frame; `peak`: maximum change, S, NaN if the frame was refused; `touched`: whether the skin is touched; `named`:
    touch that was classified at this frame but may still continue, or None; `ended`: touches that have ended for good;
    `latency`: time from the frame to the result, seconds; `note`: remark on the frame, or an empty string.

    **Example:**

    ```python
    watched = TouchWatch.create(images, gestures, empty, rate=30.0)
    for frame in watched.follow(zip(seconds.tolist(), film, strict=True)):
        print(isinstance(frame, WatchedFrame), frame.touched, frame.peak)
    ```
    """

    second: float
    image: FrameImage | None
    peak: float
    touched: bool
    named: NamedTouch | None
    ended: tuple[NamedTouch, ...]
    latency: float
    note: str = ""


@dataclass(frozen=True)
class TouchWatch:
    """Classifies the touches of a live skin, frame by frame, from fixed settings.

    **Fields**: `images`: imager of the skin; `level`: change of conductivity that a touch exceeds; `model`: gesture
    classifier; `gap`: minimum untouched time between two touches, seconds; `patience`: duration after which a touch
    becomes part of the reference frame, seconds; `notes`: remarks on the untouched skin and the frame rate.

    **Example:**

    ```python
    watched = TouchWatch.create(images, gestures, empty, rate=30.0)
    frames = list(watched.follow(zip(seconds.tolist(), film, strict=True)))
    ```
    """

    images: TouchImages
    level: TouchLevel
    model: GestureModel
    gap: float = _MIN_GAP
    patience: float = 30.0
    notes: tuple[str, ...] = ()

    @classmethod
    def create(
        cls,
        images: TouchImages,
        model: GestureModel,
        untouched: Float[np.ndarray, "u M"],
        *,
        rate: float,
        patience: float = 30.0,
    ) -> "TouchWatch":
        """Create a watch for a skin whose frames come at `rate`, frames/s.

        `untouched` (u, M): first frames of the skin, untouched, volts. The touch level is that stored in `model`; if
        more than a tenth of the untouched frames exceed this level, a higher level is estimated from these frames.
        Raises `ValueError` for a model that was trained on a different skin, or does not store on which, for untouched
        frames from which no level can be estimated, and for rates and patience that are not positive.
        """
        check_kind("images", images, TouchImages, "TouchImages, as of TouchImages.prepare(description, untouched)")
        check_kind("model", model, GestureModel, "a GestureModel, as of GestureModel.read(path)")
        for option_name, option_value in (("rate", rate), ("patience", patience)):
            if not (is_number(option_value) and option_value > 0):
                raise ValueError(f"{option_name} must be positive; it is {describe(option_value)}.")
        if model.reading is None:
            raise ValueError("model does not say how its skin was read; learn it with learn_gestures.")
        protocol = images.calibration.model.protocol
        model.reading.check_same_skin(protocol.num_measurements, protocol.name, images.background)
        notes = []
        touch_level = TouchLevel(images.mesh, model.reading.level)
        untouched_peaks = np.nanmax(model.reading.sign * images.changes(untouched), axis=1)
        untouched_peaks = untouched_peaks[np.isfinite(untouched_peaks)]
        if len(untouched_peaks) and np.mean(untouched_peaks > touch_level.level) > _MAX_FRACTION_ABOVE_LEVEL:
            untouched_level = TouchLevel.of_untouched(images.mesh, model.reading.sign * images.changes(untouched))
            notes.append(
                f"the untouched skin's images reach {untouched_peaks.max() / touch_level.level:.2g} times the level "
                "that a touch "
                "exceeded when gestures were learnt: a higher one is used, and weak touches are missed. Was the "
                "skin touched meanwhile?"
            )
            touch_level = untouched_level
        training_frame_rate = model.reading.rate
        if not 0.5 < rate / training_frame_rate < 2:
            notes.append(f"gestures were learnt at {training_frame_rate:.3g} frames/s, and frames come at {rate:.3g}.")
        return cls(images, touch_level, model, max(_MIN_GAP, _MIN_GAP_FRAMES / rate), patience, tuple(notes))

    def follow(self, frames: Iterable[tuple[float, Any]]) -> Iterator[WatchedFrame]:
        """Yield a result for each frame as it comes; a frame is a pair of a time in seconds and voltages (M,).

        Frames that are refused, and frames with the same time as the frame before, count as lost. A touch that is
        present at the end is reported as cut off by one more `WatchedFrame`, without an image. Raises `ValueError` for
        times that decrease.
        """
        check_kind("frames", frames, Iterable, "pairs of a second and a frame (M,), one after another")
        return _WatchState(self).follow(frames)


class _WatchState:
    """State of a `TouchWatch` between two frames."""

    def __init__(self, watch: TouchWatch):
        self.watch = watch
        self.touch_sign = 1 if watch.model.reading is None else watch.model.reading.sign
        self.touch_stream = TouchStream(watch.level, gap=watch.gap)
        self.untouched_frame = np.asarray(watch.images.imager.expected, float)
        self.untouched_drift = np.zeros_like(self.untouched_frame)
        # The last frame with the drift subtracted, None if this frame is invalid; then the clock time at which the
        # frame came, its time in the stream, and the time in the stream of the last result.
        self.latest_frame: np.ndarray | None = None
        self.arrival_time, self.frame_time, self.last_result_time = 0.0, -np.inf, -np.inf
        self.last_touch_time, self.num_ended_touches = -np.inf, 0
        self.last_named_touch: NamedTouch | None = None
        self.opposite_change_start: float | None = None

    def follow(self, frames: Iterable) -> Iterator[WatchedFrame]:
        """Yield a result for each frame; see `TouchWatch.follow`."""
        for image, change in self.watch.images.stream(self._frames_without_drift(frames)):
            yield self._frame_result(image, self.touch_sign * change)
        if self.touch_stream.touches:
            self.arrival_time = time.perf_counter()
            ended_touches = tuple(self._ended_touch(ended_touch) for ended_touch in self.touch_stream.touches)
            yield WatchedFrame(
                self.frame_time, None, np.nan, False, None, ended_touches, time.perf_counter() - self.arrival_time
            )

    def _frames_without_drift(self, frames: Iterable) -> Iterator:
        """Yield frames with the drift of the untouched skin subtracted."""
        for frame_time, frame in frames:
            self.arrival_time = time.perf_counter()
            if not (is_number(frame_time) and frame_time >= self.frame_time):
                raise ValueError(
                    f"seconds must not fall: after {self.frame_time:g} s a frame has {describe(frame_time)}."
                )
            self.frame_time = float(frame_time)
            try:
                frame_voltages = np.asarray(frame)
            except ValueError:  # a ragged array, which the stream refuses
                frame_voltages = np.empty(0)
            is_valid_frame = frame_voltages.shape == self.untouched_frame.shape and frame_voltages.dtype.kind in "iuf"
            self.latest_frame = frame_voltages - self.untouched_drift if is_valid_frame else None
            yield frame if self.latest_frame is None else self.latest_frame

    def _frame_result(self, image: FrameImage, conductivity_change: np.ndarray) -> WatchedFrame:
        """Return the result for a frame with change of conductivity `conductivity_change` (m,), which is positive where
        the skin is touched."""
        frame_time = self.frame_time
        self.touch_stream = self.touch_stream.follow(frame_time, conductivity_change)
        ended_touches = tuple(self._ended_touch(touch) for touch in self.touch_stream.ended)
        self.touch_stream = replace(self.touch_stream, ended=())
        is_ongoing, newly_named = bool(self.touch_stream.open), None
        is_touched = is_ongoing and self.touch_stream.held == len(self.touch_stream.open)
        if is_touched:
            self.last_touch_time, self.last_named_touch = frame_time, None  # the named touch continues
        elif self.last_named_touch is None and self.touch_stream.touches:
            (ended_stream_touch,) = self.touch_stream.touches
            newly_named = self.last_named_touch = self._classify_touch(ended_stream_touch)
        note = ""
        if self._is_lifted(image, conductivity_change):
            note = (
                f"at {frame_time:.2f} s the skin is more at rest than when its rest was read: was it touched? Read "
                "anew."
            )
            ended_touches = (*ended_touches, *self._reset_reference(image))
        elif is_ongoing and frame_time - self.touch_stream.open[0].seconds[0] >= self.watch.patience:
            ended_touches = (*ended_touches, *(replace(touch, held=True) for touch in self._reset_reference(image)))
        elif frame_time - self.last_touch_time >= _SETTLING_TIME and np.isfinite(self.last_result_time):
            self._follow_drift(image, 1 - np.exp(-(frame_time - self.last_result_time) / _DRIFT_TIME_CONSTANT))
        self.last_result_time = frame_time
        peak_change = float(conductivity_change.max())
        return WatchedFrame(
            frame_time,
            image,
            peak_change,
            is_touched,
            newly_named,
            ended_touches,
            time.perf_counter() - self.arrival_time,
            note,
        )

    def _is_lifted(self, image: FrameImage, conductivity_change: np.ndarray) -> bool:
        """Return whether a touch that was present when the reference was recorded has ended for good."""
        if not image.imaged or -conductivity_change.min() <= max(
            conductivity_change.max(), _MIN_OPPOSITE_RATIO * self.watch.level.level
        ):
            self.opposite_change_start = None
        elif self.opposite_change_start is None:
            self.opposite_change_start = self.frame_time
        return (
            self.opposite_change_start is not None
            and self.frame_time - self.opposite_change_start >= _MIN_OPPOSITE_TIME
        )

    def _reset_reference(self, image: FrameImage) -> tuple[NamedTouch, ...]:
        """Make the last frame the reference of the untouched skin; return the current touch, which ends, if any."""
        ended_touches = tuple(self._ended_touch(touch) for touch in self.touch_stream.touches)
        self.touch_stream = replace(self.touch_stream, open=(), held=0, lost=(0, 0))
        self.opposite_change_start = None
        self._follow_drift(image, 1.0)
        return ended_touches

    def _follow_drift(self, image: FrameImage, update_fraction: float) -> None:
        """Add a fraction `update_fraction` of the last frame's deviation from the reference to the drift."""
        if self.latest_frame is not None and image.imaged:
            is_usable = image.usable & np.isfinite(self.latest_frame)
            self.untouched_drift = self.untouched_drift + np.where(
                is_usable, update_fraction * (self.latest_frame - self.untouched_frame), 0.0
            )

    def _classify_touch(self, touch: StreamTouch) -> NamedTouch:
        """Predict the gesture of a touch; record the computing time since the last frame arrived."""
        gestures = self.watch.model.predict([touch])
        return NamedTouch(
            number=self.num_ended_touches + 1,
            touch=touch,
            gesture=str(gestures.gesture[0]),
            probability=float(gestures.probability[0]),
            probabilities=gestures.probabilities[0],
            unlike=bool(gestures.unlike[0]),
            named=self.frame_time,
            latency=time.perf_counter() - self.arrival_time,
        )

    def _ended_touch(self, touch: StreamTouch) -> NamedTouch:
        """Return an ended touch with the prediction that was made at its end, or with a new prediction if the earlier
        prediction was not for the whole touch."""
        named_touch, self.last_named_touch = self.last_named_touch, None
        if named_touch is None or len(named_touch.touch.course) != len(touch.course):
            named_touch = self._classify_touch(touch)
        self.num_ended_touches += 1
        return replace(named_touch, touch=touch)
