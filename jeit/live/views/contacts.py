"""Views of touched sheets: contacts with their paths, and classified gestures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Float

from jeit.data.description import Description
from jeit.inverse.streaming.stream import FrameStatus, StreamState
from jeit.live.pictures import AbstractView, LiveFrame, Marker, Picture
from jeit.live.views.conductivity import ConductivityView, PixelGrid, create_scene, mean_frame
from jeit.touch import (
    CellFinder,
    Contact,
    ContactTracker,
    GestureModel,
    ImageNoise,
    NamedTouch,
    TouchImages,
    TouchWatch,
    find_contacts,
)

# Minimum number of frames of the reference from which the noise of images is estimated.
_MIN_FRAMES = 10
# Minimum difference in seconds of the times of successive frames in tracking, since frames may have equal times.
_MIN_TIME_STEP = 1e-6
# Time in seconds for which the name of a gesture is shown on the image.
_LABEL_DURATION = 1.5

Item = TypeVar("Item")
Output = TypeVar("Output")


class StepwiseGenerator(Generic[Item, Output]):
    """Callable that passes items one by one to a generator function, and returns the generator's result for each
    item."""

    def __init__(self, generate: Callable[[Iterable[Item]], Iterator[Output]]):
        self._items: list[Item] = []
        self._results = generate(self._queued_items())

    def __call__(self, item: Item) -> Output:
        self._items.append(item)
        return next(self._results)

    def _queued_items(self) -> Iterator[Item]:
        while True:
            yield self._items.pop()


class ContactsView(AbstractView):
    """View of the contacts in images of the conductivity change: a marker for each contact, with the number of its
    touch.

    Contacts are found by `jeit.touch.find_contacts`, and tracked by a `jeit.touch.ContactTracker`. The noise of images
    is estimated from the frames of the reference if there are ten or more, otherwise from each image.

    **Arguments:**

    - `images`: view that computes the images of a sheet.
    - `still`: frames (frames, channels) of the untouched sheet, volts.
    - `sign`: 1 if touches increase the conductivity, -1 if they decrease it; by default the sign of the strongest
      change of each image.

    Raises `ValueError` for a solid, and for a sign other than 1 and -1.

    **Example:**

    ```python
    contacts = ContactsView(view, still, sign=-1)
    print(contacts.picture(frame).markers)
    ```
    """

    def __init__(
        self, images: ConductivityView, still: Float[np.ndarray, "N M"] | None = None, *, sign: int | None = None
    ):
        mesh = images.imager.inversion.model.mesh
        self.images, self.scene = images, replace(images.scene, title=f"Contacts, {images.scene.title}")
        allowed_signs = (1, -1) if sign is None else (sign,)
        self._contact_finders = {
            candidate_sign: CellFinder(mesh, sign=candidate_sign) for candidate_sign in allowed_signs
        }
        self._image_noise = None if still is None else _estimate_noise(images, still)
        self._contact_tracker = ContactTracker()

    def picture(self, frame: LiveFrame) -> Picture:
        """Compute the image of a frame with markers for its contacts; see `AbstractView.picture`."""
        frame_image, picture = self.images.image(frame)
        if frame_image.conductivity is None:
            return picture
        found_contacts = self.contacts(frame_image.conductivity - self.images.background)
        self._track_contacts(frame.second, found_contacts)
        number_by_position = {
            tuple(open_touch.position): open_touch.number for open_touch in self._contact_tracker.open
        }
        background_conductivity = self.images.background
        contact_markers = tuple(
            Marker(
                float(found_contact.centroid[0]),
                float(found_contact.centroid[1]),
                label=f"{100 * found_contact.peak / background_conductivity:+.0f} %",
                radius=found_contact.deviation,
                track=number_by_position.get(tuple(found_contact.centroid)),
            )
            for found_contact in found_contacts
        )
        return replace(picture, markers=contact_markers)

    def contacts(self, change: Float[np.ndarray, " m"]) -> list[Contact]:
        """Find the contacts in a conductivity change (cells,) in S, the strongest contact first."""
        dominant_sign = 1 if change.max() >= -change.min() else -1
        contact_finder = self._contact_finders.get(dominant_sign) or next(iter(self._contact_finders.values()))
        return find_contacts(contact_finder, change, self._image_noise)

    def set_reference(self, frames: Float[np.ndarray, "N M"]) -> None:
        """Take the mean of `frames` (frames, channels) as the new reference, and estimate the noise of images from the
        frames if there are ten or more."""
        self.images.set_reference(frames)
        self._image_noise = _estimate_noise(self.images, np.asarray(frames, float))
        self._contact_tracker = ContactTracker()

    def _track_contacts(self, frame_time: float, found_contacts: list[Contact]) -> None:
        new_tracker = self._contact_tracker.follow(
            max(frame_time, self._contact_tracker.time + _MIN_TIME_STEP), found_contacts
        )
        # Only the last observation of a touch is needed here. Keeping all observations would use ever more memory.
        open_touches = tuple(
            replace(open_touch, observations=open_touch.observations[-1:]) for open_touch in new_tracker.open
        )
        self._contact_tracker = replace(new_tracker, open=open_touches, closed=())


def _estimate_noise(
    conductivity_view: ConductivityView, untouched_frames: Float[np.ndarray, "N M"]
) -> ImageNoise | None:
    """Estimate the noise of images from frames (frames, channels) of the untouched sheet; None for fewer than ten
    frames."""
    stream_state = StreamState(conductivity_view.imager)
    images_or_none = [
        stream_state.image(frame_number, frame).conductivity for frame_number, frame in enumerate(untouched_frames)
    ]
    imaged_conductivities = np.array([frame_image for frame_image in images_or_none if frame_image is not None])
    if len(imaged_conductivities) < _MIN_FRAMES or not imaged_conductivities.std(axis=0).any():
        return None
    return ImageNoise.of_images(imaged_conductivities)


class GestureView(AbstractView):
    """View of the touches of a skin, and of their gestures, which `jeit.touch.TouchWatch` classifies when a touch ends.

    **Arguments:**

    - `description`: description of the skin.
    - `model`: the learnt gestures.
    - `still`: frames (frames, channels) of the untouched skin, volts.
    - `rate`: frames/s; by default the frame rate of the training data.
    - `patience`: time in seconds after which a lasting touch becomes part of the reference.
    - `progress`: function that is called with the name of each step when the step begins.

    Raises `ValueError` if `jeit.touch.TouchImages.prepare` or `jeit.touch.TouchWatch.create` does.

    **Example:**

    ```python
    named = GestureView(description, gestures, untouched, rate=30.0)
    print(named.picture(LiveFrame(0, 0.0, 0.0, untouched[0])).events)
    ```
    """

    def __init__(
        self,
        description: Description,
        model: GestureModel,
        still: Float[np.ndarray, "N M"],
        *,
        rate: float | None = None,
        patience: float = 30.0,
        progress: Callable[[str], None] | None = None,
    ):
        self._model, self._patience = model, patience
        default_rate = 60.0 if model.reading is None else model.reading.rate
        self._frame_rate = default_rate if rate is None else rate
        self._change_sign = 1 if model.reading is None else model.reading.sign
        touch_images = TouchImages.prepare(description, still, progress=progress)
        forward_model = touch_images.calibration.model
        self.grid = PixelGrid(forward_model.mesh)
        self._start_watch(touch_images, still)
        self.scene = create_scene(
            forward_model.mesh,
            forward_model.electrodes,
            forward_model.protocol,
            self.grid,
            title=f"Gestures, {description.title}",
            quantity="conductivity change",
            unit="S",
            diverging=True,
            notes=(*self.watch.notes, f"Gestures: {', '.join(model.names)}."),
        )

    def picture(self, frame: LiveFrame) -> Picture:
        """Compute the image of a frame with a marker for the touch, and name the gesture of a touch that has ended; see
        `AbstractView.picture`."""
        self._last_second = max(frame.second, self._last_second)
        watched_frame = self._watch_frame((self._last_second, frame.values))
        frame_image = watched_frame.image
        touch_events = tuple(
            event_sentence
            for event_sentence in (
                self._classified_sentence(watched_frame.named),
                *map(_held_touch_sentence, watched_frame.ended),
                watched_frame.note,
            )
            if event_sentence
        )
        if frame_image is None or frame_image.conductivity is None:
            refusal_reason = "" if frame_image is None else frame_image.reason
            return Picture(None, status=FrameStatus.REFUSED, reason=refusal_reason, events=touch_events)
        conductivity_change = frame_image.conductivity - self.watch.images.background
        gesture_markers = () if watched_frame.second > self._gesture_label[1] else (self._gesture_label[0],)
        if watched_frame.touched:
            time_course = self.watch.level.course(
                np.array([watched_frame.second]), self._change_sign * conductivity_change[None]
            )
            x, y = time_course.centroid[0].tolist()
            gesture_markers = (Marker(x, y, track=self._touch_number + 1),)
        return Picture(
            self.grid(conductivity_change), gesture_markers, frame_image.status, frame_image.reason, touch_events
        )

    def set_reference(self, frames: Float[np.ndarray, "N M"]) -> None:
        """Take `frames` (frames, channels) of the untouched skin as the new reference. A touch in progress is
        discarded."""
        reference_frames = np.asarray(frames, float)
        touch_images = replace(
            self.watch.images, imager=self.watch.images.imager.with_reference(mean_frame(reference_frames))
        )
        self._start_watch(touch_images, reference_frames)

    def _start_watch(self, touch_images: TouchImages, untouched_frames: Float[np.ndarray, "N M"]) -> None:
        self.watch = TouchWatch.create(
            touch_images, self._model, untouched_frames, rate=self._frame_rate, patience=self._patience
        )
        self._watch_frame = StepwiseGenerator(self.watch.follow)
        self._last_second, self._touch_number = -np.inf, 0
        self._gesture_label = Marker(0.0, 0.0), -np.inf

    def _classified_sentence(self, touch: NamedTouch | None) -> str:
        """Return a sentence about a touch that has been classified, and show the gesture's name on the image for a
        while. Returns an empty string if `touch` is None."""
        if touch is None:
            return ""
        self._touch_number = touch.number
        time_course = touch.touch.course
        x, y = time_course.centroid[int(time_course.peak.argmax())].tolist()
        name = "unlike any gesture" if touch.unlike else f"{touch.gesture} {100 * touch.probability:.0f} %"
        self._gesture_label = Marker(x, y, name), self._last_second + _LABEL_DURATION
        return f"{name} at ({1e3 * x:+.0f}, {1e3 * y:+.0f}) mm, {touch.touch.offset - touch.touch.onset:.2f} s long"


def _held_touch_sentence(ended_touch: NamedTouch) -> str:
    """Return a sentence about a touch that became part of the reference; an empty string for other touches."""
    return (
        f"a touch is held since {ended_touch.touch.onset:.1f} s and counts as the skin at rest"
        if ended_touch.held
        else ""
    )
