"""Classify touches of a live skin as they end.

A touch is named with the first frame below its level, as soon as its end can be known; it has ended finally when it has
been over for the `gap`. While nobody touches, the reference follows the untouched skin, so that drift makes no touches;
what lasts longer than the `patience` is reported as held, and is from then on part of the reference.
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

# Seconds that separate two touches, or so many frames if that is longer; untouched seconds after which the skin is at
# rest again, and the time constant, seconds, with which the reference follows it then.
_GAP, _FRAMES_APART, _SETTLED, _FOLLOWED = 0.1, 2.5, 0.5, 2.0
# The greatest share of the initial untouched frames that may exceed the learnt level.
_MOST_ABOVE = 0.1
# If a change opposite to a touch is the greatest, above the level by the first factor, for the second number of
# seconds, the skin was touched when its reference was read.
_OPPOSITE, _LIFTED = 3.0, 0.5


@dataclass(frozen=True)
class NamedTouch:
    """A touch and its predicted gesture.

    **Fields**: `number`, from 1, in order of onset; `touch`; the `gesture`, its `probability`, and `probabilities` (C,)
    of all; `unlike`, whether it is unlike any in the training set, where the prediction does not count; `named`, the
    stream's second when it was named, and `latency`, seconds of computing from that frame to the name; `held`, whether
    it lasted beyond the patience and was cut off for that.
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
    """The result of a frame at a `second`.

    Its `image`, None of what comes after the last frame; the greatest change `peak`, S, NaN where it was refused;
    whether the skin is `touched`; the touch that was `named` with it, or None, which may yet continue; those that have
    `ended` finally; `latency`, seconds from the frame to the result; and a `note`, where there is one.
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
    """Settings of a watched skin.

    `images` of the skin, the `level` that a touch exceeds, the `model` that classifies it; `gap`, seconds untouched
    that separate two touches; `patience`, seconds after which a touch becomes part of the reference; `notes` on what
    was found.
    """

    images: TouchImages
    level: TouchLevel
    model: GestureModel
    gap: float = _GAP
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
        """Create a watch for frames at `rate`, frames/s, of a skin that initially read `untouched` (u, M), volts.

        The level is the one that the model learnt with, or the untouched frames' own where these are noisier. Raises
        `ValueError` for a model of another skin, or of none, frames in which the skin is touched, and rates and
        patience that are not positive.
        """
        check_kind("images", images, TouchImages, "TouchImages, as of TouchImages.prepare(description, untouched)")
        check_kind("model", model, GestureModel, "a GestureModel, as of GestureModel.read(path)")
        for name, value in (("rate", rate), ("patience", patience)):
            if not (is_number(value) and value > 0):
                raise ValueError(f"{name} must be positive; it is {describe(value)}.")
        if model.reading is None:
            raise ValueError("model does not say how its skin was read; learn it with learn_gestures.")
        protocol = images.calibration.model.protocol
        model.reading.check_same_skin(protocol.num_measurements, protocol.name, images.background)
        notes = []
        level = TouchLevel(images.mesh, model.reading.level)
        peaks = np.nanmax(model.reading.sign * images.changes(untouched), axis=1)
        peaks = peaks[np.isfinite(peaks)]
        if len(peaks) and np.mean(peaks > level.level) > _MOST_ABOVE:
            own = TouchLevel.of_untouched(images.mesh, model.reading.sign * images.changes(untouched))
            notes.append(
                f"the untouched skin's images reach {peaks.max() / level.level:.2g} times the level that a touch "
                "exceeded when gestures were learnt: a higher one is used, and weak touches are missed. Was the "
                "skin touched meanwhile?"
            )
            level = own
        learnt = model.reading.rate
        if not 0.5 < rate / learnt < 2:
            notes.append(f"gestures were learnt at {learnt:.3g} frames/s, and frames come at {rate:.3g}.")
        return cls(images, level, model, max(_GAP, _FRAMES_APART / rate), patience, tuple(notes))

    def follow(self, frames: Iterable[tuple[float, Any]]) -> Iterator[WatchedFrame]:
        """Process frames as they come, each its second and its voltages (M,).

        Frames that are refused, or come with the time of the one before, count as lost. A touch that is there at the
        end is reported, cut off, with one more `WatchedFrame`, without an image. Raises `ValueError` for times that
        fall.
        """
        check_kind("frames", frames, Iterable, "pairs of a second and a frame (M,), one after another")
        return _Session(self).follow(frames)


class _Session:
    """The state of a watch from one frame to the next."""

    def __init__(self, watch: TouchWatch):
        self.watch = watch
        self.sign = 1 if watch.model.reading is None else watch.model.reading.sign
        self.touches = TouchStream(watch.level, gap=watch.gap)
        self.rest = np.asarray(watch.images.imager.expected, float)
        self.drift = np.zeros_like(self.rest)
        # The last frame without drift, None where it has no numbers; when it came, and its second.
        self.frame: np.ndarray | None = None
        self.came, self.second, self.last_seen = 0.0, -np.inf, -np.inf
        self.last_touched, self.number = -np.inf, 0
        self.named: NamedTouch | None = None
        self.opposite_since: float | None = None

    def follow(self, frames: Iterable) -> Iterator[WatchedFrame]:
        """As `TouchWatch.follow`."""
        for image, change in self.watch.images.stream(self._coming(frames)):
            yield self._watched(image, self.sign * change)
        if self.touches.touches:
            self.came = time.perf_counter()
            ended = tuple(self._ended(one) for one in self.touches.touches)
            yield WatchedFrame(self.second, None, np.nan, False, None, ended, time.perf_counter() - self.came)

    def _coming(self, frames: Iterable) -> Iterator:
        """Subtract the drift of the untouched skin from frames before they are imaged."""
        for second, frame in frames:
            self.came = time.perf_counter()
            if not (is_number(second) and second >= self.second):
                raise ValueError(f"seconds must not fall: after {self.second:g} s a frame has {describe(second)}.")
            self.second = float(second)
            try:
                values = np.asarray(frame)
            except ValueError:  # ragged: refused by the stream
                values = np.empty(0)
            plain = values.shape == self.rest.shape and values.dtype.kind in "iuf"
            self.frame = values - self.drift if plain else None
            yield frame if self.frame is None else self.frame

    def _watched(self, image: FrameImage, change: np.ndarray) -> WatchedFrame:
        """Process a frame whose change of conductivity is `change` (m,), positive where touched."""
        second = self.second
        self.touches = self.touches.follow(second, change)
        ended = tuple(self._ended(one) for one in self.touches.ended)
        self.touches = replace(self.touches, ended=())
        going, named = bool(self.touches.open), None
        touched = going and self.touches.held == len(self.touches.open)
        if touched:
            self.last_touched, self.named = second, None  # the named touch continues
        elif self.named is None and self.touches.touches:
            (over,) = self.touches.touches
            named = self.named = self._name(over)
        note = ""
        if self._lifted(image, change):
            note = f"at {second:.2f} s the skin is more at rest than when its rest was read: was it touched? Read anew."
            ended = (*ended, *self._rest_here(image))
        elif going and second - self.touches.open[0].seconds[0] >= self.watch.patience:
            ended = (*ended, *(replace(one, held=True) for one in self._rest_here(image)))
        elif second - self.last_touched >= _SETTLED and np.isfinite(self.last_seen):
            self._follow_rest(image, 1 - np.exp(-(second - self.last_seen) / _FOLLOWED))
        self.last_seen = second
        peak = float(change.max())
        return WatchedFrame(second, image, peak, touched, named, ended, time.perf_counter() - self.came, note)

    def _lifted(self, image: FrameImage, change: np.ndarray) -> bool:
        """Whether a touch that was there when the reference was read has been lifted for good."""
        if not image.imaged or -change.min() <= max(change.max(), _OPPOSITE * self.watch.level.level):
            self.opposite_since = None
        elif self.opposite_since is None:
            self.opposite_since = self.second
        return self.opposite_since is not None and self.second - self.opposite_since >= _LIFTED

    def _rest_here(self, image: FrameImage) -> tuple[NamedTouch, ...]:
        """Take the skin as it is now as the reference; returns the touch that this ends."""
        ended = tuple(self._ended(one) for one in self.touches.touches)
        self.touches = replace(self.touches, open=(), held=0, lost=(0, 0))
        self.opposite_since = None
        self._follow_rest(image, 1.0)
        return ended

    def _follow_rest(self, image: FrameImage, share: float) -> None:
        """Add a `share` of the last frame's deviation to the drift."""
        if self.frame is not None and image.imaged:
            there = image.usable & np.isfinite(self.frame)
            self.drift = self.drift + np.where(there, share * (self.frame - self.rest), 0.0)

    def _name(self, touch: StreamTouch) -> NamedTouch:
        said = self.watch.model.predict([touch])
        return NamedTouch(
            number=self.number + 1,
            touch=touch,
            gesture=str(said.gesture[0]),
            probability=float(said.probability[0]),
            probabilities=said.probabilities[0],
            unlike=bool(said.unlike[0]),
            named=self.second,
            latency=time.perf_counter() - self.came,
        )

    def _ended(self, touch: StreamTouch) -> NamedTouch:
        """A touch that has ended, as it was named when it was over; touches that are cut off are named now."""
        named, self.named = self.named, None
        if named is None or len(named.touch.course) != len(touch.course):
            named = self._name(touch)
        self.number += 1
        return replace(named, touch=touch)
