"""Train a gesture classifier on recordings of a skin: reconstruct images, segment touches, and fit the classifier."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind, check_name, counted
from jeit.data import GestureSet
from jeit.data.description import Description
from jeit.touch.gestures import GestureModel, StreamTouch, TouchLevel, find_touches
from jeit.touch.gestures.gesture_model import METHODS, Reading, check_labels
from jeit.touch.gestures.touch_images import TouchImages

# Maximum number of recordings used to determine the sign of touches.
_RECORDINGS_FOR_SIGN = 60


@dataclass(frozen=True)
class LearntGestures:
    """A gesture classifier trained on recordings.

    **Fields**: `model`: the classifier; `images`: the imager of the skin; `without_touch`: numbers of the recordings in
    which no touch was found.

    **Example:**

    ```python
    learnt = learn_gestures(description, made, method="linear-svm", form="seven")
    print(isinstance(learnt, LearntGestures), learnt.model.names)
    ```
    """

    model: GestureModel
    images: TouchImages
    without_touch: tuple[int, ...]


def learn_gestures(
    description: Description,
    recordings: GestureSet,
    *,
    method: str = "auto",
    form: str = "auto",
    progress: Callable[[str], None] | None = None,
) -> LearntGestures:
    """Learn the gestures of a described skin from recordings; the longest touch of each recording is used.

    **Arguments:**

    - `description`: description of the skin.
    - `recordings`: recordings of one gesture each.
    - `method`, `form`: classifier and its features; see `GestureModel.fit`.
    - `progress`: called with a description of the progress.

    Raises `ValueError` as `TouchImages.prepare` and `GestureModel.fit` do, and if most recordings contain no touch.

    **Example:**

    ```python
    learnt = learn_gestures(description, made, method="linear-svm", form="seven")
    learnt.model.write("gestures.skops")
    ```
    """
    check_kind("recordings", recordings, GestureSet, "a GestureSet, as of GestureSet.read(path)")
    report = progress or (lambda said: None)
    check_name("method", method, METHODS)
    check_labels(recordings.gesture)
    images = TouchImages.prepare(description, recordings.reference[None], progress=report)
    still = images.changes(recordings.untouched)
    level, sign = _touch_level_and_sign(images, still, recordings)
    touches: list[StreamTouch] = []
    kept, without_touch = [], []
    for number, (seconds, changes) in enumerate(_times_and_changes(images, recordings, range(len(recordings)))):
        if number % 50 == 0:
            report(f"images: recording {number} of {len(recordings)}")
        found = find_touches(level, seconds, sign * changes) if len(seconds) else []
        if found:
            touches.append(max(found, key=lambda one: one.offset - one.onset))
            kept.append(number)
        else:
            without_touch.append(number)
    if len(without_touch) > len(kept):
        raise ValueError(
            f"recordings: {len(without_touch)} of {len(recordings)} have no touch that exceeds the untouched skin's "
            "noise and drift; touch more firmly, or record the untouched skin just before."
        )
    rate = 1 / float(np.median([np.median(np.diff(one.course.seconds)) for one in touches if len(one.course) > 1]))
    protocol = images.calibration.model.protocol
    model = GestureModel.fit(
        touches,
        recordings.gesture[kept],
        people=recordings.person[kept],
        method=method,
        form=form,
        reading=Reading(level.level, images.background, sign, rate, images.num_channels, protocol.name),
        notes=(f"{counted(len(without_touch), 'recording')} without a touch left out.",) if without_touch else (),
        progress=report,
    )
    return LearntGestures(model, images, tuple(without_touch))


def _touch_level_and_sign(images: TouchImages, untouched: np.ndarray, recordings: GestureSet) -> tuple[TouchLevel, int]:
    """Determine the sign of touches, and their level: with this sign, touches exceed their level by the larger
    factor."""
    some = np.unique(np.linspace(0, len(recordings) - 1, min(_RECORDINGS_FOR_SIGN, len(recordings))).astype(int))
    changes = [one for _, one in _times_and_changes(images, recordings, some.tolist())]
    found = []
    for sign in (1, -1):
        level = TouchLevel.of_untouched(images.mesh, sign * untouched)
        exceeds = [np.nanmax(sign * one) / level.level for one in changes if np.isfinite(one).any()]
        found.append((float(np.median(exceeds)) if exceeds else 0.0, level, sign))
    return max(found, key=lambda one: one[0])[1:]


def _times_and_changes(
    images: TouchImages, recordings: GestureSet, indices: Sequence[int]
) -> Iterator[tuple[Float[np.ndarray, " T"], Float[np.ndarray, "T m"]]]:
    """Yield the times and the images of change of the recordings `indices`, all imaged as one stream."""
    frames = (frame for one in indices for frame in recordings.recording(one)[1])
    found = images.stream(frames)
    for one in indices:
        seconds, _ = recordings.recording(one)
        own = [change for _, change in islice(found, len(seconds))]
        yield seconds, np.array(own).reshape(len(seconds), images.mesh.num_cells)
