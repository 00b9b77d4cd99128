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

# Maximum number of recordings used to determine whether touches raise or lower the conductivity.
_MAX_RECORDINGS_FOR_SIGN = 60


@dataclass(frozen=True)
class LearntGestures:
    """A gesture classifier trained on recordings.

    **Fields**: `model`: the classifier; `images`: imager that computes images from frames of the skin; `without_touch`:
    numbers of the recordings in which no touch was found.

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
    """Train a gesture classifier on the longest touch in each recording of a described skin.

    **Arguments:**

    - `description`: description of the skin.
    - `recordings`: recordings of one gesture each.
    - `method`, `form`: classifier and its features; see `GestureModel.fit`.
    - `progress`: function that is called with a description of each step.

    Raises `ValueError` as `TouchImages.prepare` and `GestureModel.fit` do, and if most recordings contain no touch.

    **Example:**

    ```python
    learnt = learn_gestures(description, made, method="linear-svm", form="seven")
    learnt.model.write("gestures.skops")
    ```
    """
    check_kind("recordings", recordings, GestureSet, "a GestureSet, as of GestureSet.read(path)")
    report = progress or (lambda message: None)
    check_name("method", method, METHODS)
    check_labels(recordings.gesture)
    images = TouchImages.prepare(description, recordings.reference[None], progress=report)
    untouched_changes = images.changes(recordings.untouched)
    level, sign = _touch_level_and_sign(images, untouched_changes, recordings)
    touches: list[StreamTouch] = []
    indices_with_touch, indices_without_touch = [], []
    for recording_index, (seconds, changes) in enumerate(
        _times_and_changes(images, recordings, range(len(recordings)))
    ):
        if recording_index % 50 == 0:
            report(f"images: recording {recording_index} of {len(recordings)}")
        recording_touches = find_touches(level, seconds, sign * changes) if len(seconds) else []
        if recording_touches:
            touches.append(max(recording_touches, key=lambda touch: touch.offset - touch.onset))
            indices_with_touch.append(recording_index)
        else:
            indices_without_touch.append(recording_index)
    if len(indices_without_touch) > len(indices_with_touch):
        raise ValueError(
            f"recordings: {len(indices_without_touch)} of {len(recordings)} have no touch that exceeds the untouched "
            "skin's noise and drift; touch more firmly, or record the untouched skin just before."
        )
    rate = 1 / float(
        np.median([np.median(np.diff(touch.course.seconds)) for touch in touches if len(touch.course) > 1])
    )
    protocol = images.calibration.model.protocol
    model = GestureModel.fit(
        touches,
        recordings.gesture[indices_with_touch],
        people=recordings.person[indices_with_touch],
        method=method,
        form=form,
        reading=Reading(level.level, images.background, sign, rate, images.num_channels, protocol.name),
        notes=(f"{counted(len(indices_without_touch), 'recording')} without a touch left out.",)
        if indices_without_touch
        else (),
        progress=report,
    )
    return LearntGestures(model, images, tuple(indices_without_touch))


def _touch_level_and_sign(images: TouchImages, untouched: np.ndarray, recordings: GestureSet) -> tuple[TouchLevel, int]:
    """Determine the level of change above which the skin is touched, and the sign of touches: the sign for which
    touches exceed the level by the larger factor."""
    indices = np.unique(np.linspace(0, len(recordings) - 1, min(_MAX_RECORDINGS_FOR_SIGN, len(recordings))).astype(int))
    changes_of_recordings = [changes for _, changes in _times_and_changes(images, recordings, indices.tolist())]
    candidates = []
    for sign in (1, -1):
        level = TouchLevel.of_untouched(images.mesh, sign * untouched)
        signed_ratios = [
            np.nanmax(sign * changes) / level.level for changes in changes_of_recordings if np.isfinite(changes).any()
        ]
        candidates.append((float(np.median(signed_ratios)) if signed_ratios else 0.0, level, sign))
    return max(candidates, key=lambda candidate: candidate[0])[1:]


def _times_and_changes(
    images: TouchImages, recordings: GestureSet, indices: Sequence[int]
) -> Iterator[tuple[Float[np.ndarray, " T"], Float[np.ndarray, "T m"]]]:
    """Yield the times (T,) and images of change (T, m) of each recording in `indices`, imaged as one stream."""
    frames = (frame for recording_index in indices for frame in recordings.recording(recording_index)[1])
    stream = images.stream(frames)
    for recording_index in indices:
        seconds, _ = recordings.recording(recording_index)
        changes = [change for _, change in islice(stream, len(seconds))]
        yield seconds, np.array(changes).reshape(len(seconds), images.mesh.num_cells)
