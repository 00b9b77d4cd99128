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
    report_progress = progress or (lambda message: None)
    check_name("method", method, METHODS)
    check_labels(recordings.gesture)
    touch_images = TouchImages.prepare(description, recordings.reference[None], progress=report_progress)
    untouched_changes = touch_images.changes(recordings.untouched)
    touch_level, touch_sign = _touch_level_and_sign(touch_images, untouched_changes, recordings)
    touches: list[StreamTouch] = []
    indices_with_touch, indices_without_touch = [], []
    for recording_index, (frame_times, recording_changes) in enumerate(
        _times_and_changes(touch_images, recordings, range(len(recordings)))
    ):
        if recording_index % 50 == 0:
            report_progress(f"images: recording {recording_index} of {len(recordings)}")
        recording_touches = (
            find_touches(touch_level, frame_times, touch_sign * recording_changes) if len(frame_times) else []
        )
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
    frame_rate = 1 / float(
        np.median([np.median(np.diff(touch.course.seconds)) for touch in touches if len(touch.course) > 1])
    )
    protocol = touch_images.calibration.model.protocol
    gesture_model = GestureModel.fit(
        touches,
        recordings.gesture[indices_with_touch],
        people=recordings.person[indices_with_touch],
        method=method,
        form=form,
        reading=Reading(
            touch_level.level, touch_images.background, touch_sign, frame_rate, touch_images.num_channels, protocol.name
        ),
        notes=(f"{counted(len(indices_without_touch), 'recording')} without a touch left out.",)
        if indices_without_touch
        else (),
        progress=report_progress,
    )
    return LearntGestures(gesture_model, touch_images, tuple(indices_without_touch))


def _touch_level_and_sign(
    images: TouchImages, untouched_changes: np.ndarray, recordings: GestureSet
) -> tuple[TouchLevel, int]:
    """Determine the level of change above which the skin is touched, and the sign of touches: the sign for which
    touches exceed the level by the larger factor."""
    recording_indices = np.unique(
        np.linspace(0, len(recordings) - 1, min(_MAX_RECORDINGS_FOR_SIGN, len(recordings))).astype(int)
    )
    changes_of_recordings = [
        recording_changes for _, recording_changes in _times_and_changes(images, recordings, recording_indices.tolist())
    ]
    sign_candidates = []
    for touch_sign in (1, -1):
        touch_level = TouchLevel.of_untouched(images.mesh, touch_sign * untouched_changes)
        peak_to_level_ratios = [
            np.nanmax(touch_sign * recording_changes) / touch_level.level
            for recording_changes in changes_of_recordings
            if np.isfinite(recording_changes).any()
        ]
        sign_candidates.append(
            (float(np.median(peak_to_level_ratios)) if peak_to_level_ratios else 0.0, touch_level, touch_sign)
        )
    return max(sign_candidates, key=lambda sign_candidate: sign_candidate[0])[1:]


def _times_and_changes(
    images: TouchImages, recordings: GestureSet, recording_indices: Sequence[int]
) -> Iterator[tuple[Float[np.ndarray, " T"], Float[np.ndarray, "T m"]]]:
    """Yield the times (T,) and images of change (T, m) of the recordings `recording_indices`, imaged as one stream."""
    frames = (frame for recording_index in recording_indices for frame in recordings.recording(recording_index)[1])
    change_stream = images.stream(frames)
    for recording_index in recording_indices:
        frame_times, _ = recordings.recording(recording_index)
        recording_changes = [change for _, change in islice(change_stream, len(frame_times))]
        yield frame_times, np.array(recording_changes).reshape(len(frame_times), images.mesh.num_cells)
