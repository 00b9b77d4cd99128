"""Views of sheets that are touched: contacts with their paths, and gestures as they are named."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Float

from jeit.data.description import Description
from jeit.inverse.streaming.stream import FrameStatus, StreamState
from jeit.live.pictures import AbstractView, LiveFrame, Marker, Picture
from jeit.live.views.conductivity import ConductivityView, mean_frame
from jeit.live.views.scene import PixelGrid, scene_of
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

# Fewest frames of the reference from which the noise of images is estimated.
_LEAST_FRAMES = 10
# Time between two frames with the same time, and seconds for which the name of a gesture stays on the image.
_STEP, _SHOWN = 1e-6, 1.5

Given = TypeVar("Given")
Made = TypeVar("Made")


class Fed(Generic[Given, Made]):
    """A generator over items that are given one by one: each call returns the result for its item."""

    def __init__(self, follow: Callable[[Iterable[Given]], Iterator[Made]]):
        self._items: list[Given] = []
        self._results = follow(self._given())

    def __call__(self, item: Given) -> Made:
        self._items.append(item)
        return next(self._results)

    def _given(self) -> Iterator[Given]:
        while True:
            yield self._items.pop()


class ContactsView(AbstractView):
    """Contacts in images of change, with their paths: a marker for each, with the number of its touch.

    Contacts are those of `jeit.touch.find_contacts`, followed by a `jeit.touch.ContactTracker`. The noise of images is
    that of the frames of the reference, ten or more, otherwise it is estimated from each image.

    **Arguments:**

    - `images`: view of the images, of a sheet.
    - `still`: frames (N, M) of the untouched sheet, volts.
    - `sign`: 1 if touched skin conducts better, -1 if worse; None: as the strongest change of each image.

    Raises `ValueError` for a solid, and for another sign.

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
        signs = (1, -1) if sign is None else (sign,)
        self._finders = {one: CellFinder(mesh, sign=one) for one in signs}
        self._noise = None if still is None else _noise_of(images, still)
        self._tracker = ContactTracker()

    def picture(self, frame: LiveFrame) -> Picture:
        """The image of a frame with its contacts; see `AbstractView.picture`."""
        one, picture = self.images.image(frame)
        if one.conductivity is None:
            return picture
        found = self.contacts(one.conductivity - self.images.background)
        self._follow(frame.second, found)
        tracks = {tuple(touch.position): touch.number for touch in self._tracker.open}
        background = self.images.background
        markers = tuple(
            Marker(
                float(contact.centroid[0]),
                float(contact.centroid[1]),
                label=f"{100 * contact.peak / background:+.0f} %",
                radius=contact.deviation,
                track=tracks.get(tuple(contact.centroid)),
            )
            for contact in found
        )
        return replace(picture, markers=markers)

    def contacts(self, change: Float[np.ndarray, " m"]) -> list[Contact]:
        """Contacts in a change (m,), S, strongest first."""
        strongest = 1 if change.max() >= -change.min() else -1
        finder = self._finders.get(strongest) or next(iter(self._finders.values()))
        return find_contacts(finder, change, self._noise)

    def set_reference(self, frames: Float[np.ndarray, "N M"]) -> None:
        """Take the mean of frames (N, M) as the new reference, and the noise of images from ten or more of them."""
        self.images.set_reference(frames)
        self._noise = _noise_of(self.images, np.asarray(frames, float))
        self._tracker = ContactTracker()

    def _follow(self, second: float, found: list[Contact]) -> None:
        tracker = self._tracker.follow(max(second, self._tracker.time + _STEP), found)
        # Only the last frame of a touch is needed here, whose memory would grow with time.
        going = tuple(replace(touch, observations=touch.observations[-1:]) for touch in tracker.open)
        self._tracker = replace(tracker, open=going, closed=())


def _noise_of(images: ConductivityView, still: Float[np.ndarray, "N M"]) -> ImageNoise | None:
    """Noise of the images of frames (N, M) of the untouched sheet; None if there are too few."""
    state = StreamState(images.imager)
    imaged = [state.image(number, frame).conductivity for number, frame in enumerate(still)]
    found = np.array([one for one in imaged if one is not None])
    if len(found) < _LEAST_FRAMES or not found.std(axis=0).any():
        return None
    return ImageNoise.of_images(found)


class GestureView(AbstractView):
    """Touches of a skin as they come, and their gestures as they end, as `jeit.touch.TouchWatch` classifies them.

    **Arguments:**

    - `description`: description of the skin.
    - `model`: the learnt gestures.
    - `still`: frames (N, M) of the untouched skin, volts.
    - `rate`: frames/s, by default that of the frames learnt from.
    - `patience`: time after which a touch becomes part of the reference, seconds.
    - `progress`: called with each step as it begins.

    Raises `ValueError` as `jeit.touch.TouchImages.prepare` and `jeit.touch.TouchWatch.create` do.

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
        usual = 60.0 if model.reading is None else model.reading.rate
        self._rate = usual if rate is None else rate
        self._sign = 1 if model.reading is None else model.reading.sign
        images = TouchImages.prepare(description, still, progress=progress)
        own = images.calibration.model
        self.grid = PixelGrid(own.mesh)
        self._begin(images, still)
        self.scene = scene_of(
            own.mesh,
            own.electrodes,
            own.protocol,
            self.grid,
            title=f"Gestures, {description.title}",
            quantity="conductivity change",
            unit="S",
            diverging=True,
            notes=(*self.watch.notes, f"Gestures: {', '.join(model.names)}."),
        )

    def picture(self, frame: LiveFrame) -> Picture:
        """The image of a frame, the touch in it, and the gesture if one has ended; see `AbstractView.picture`."""
        self._second = max(frame.second, self._second)
        seen = self._follow((self._second, frame.values))
        image = seen.image
        events = tuple(one for one in (self._named(seen.named), *map(_held, seen.ended), seen.note) if one)
        if image is None or image.conductivity is None:
            reason = "" if image is None else image.reason
            return Picture(None, status=FrameStatus.REFUSED, reason=reason, events=events)
        change = image.conductivity - self.watch.images.background
        markers = () if seen.second > self._shown[1] else (self._shown[0],)
        if seen.touched:
            course = self.watch.level.course(np.array([seen.second]), self._sign * change[None])
            x, y = course.centroid[0].tolist()
            markers = (Marker(x, y, track=self._number + 1),)
        return Picture(self.grid(change), markers, image.status, image.reason, events)

    def set_reference(self, frames: Float[np.ndarray, "N M"]) -> None:
        """Take frames (N, M) of the untouched skin as the new reference; a touch under way is given up."""
        still = np.asarray(frames, float)
        images = replace(self.watch.images, imager=self.watch.images.imager.with_reference(mean_frame(still)))
        self._begin(images, still)

    def _begin(self, images: TouchImages, still: Float[np.ndarray, "N M"]) -> None:
        self.watch = TouchWatch.create(images, self._model, still, rate=self._rate, patience=self._patience)
        self._follow = Fed(self.watch.follow)
        self._second, self._number = -np.inf, 0
        self._shown = Marker(0.0, 0.0), -np.inf

    def _named(self, one: NamedTouch | None) -> str:
        """Sentence for a touch that has been classified, whose name then stands on the image for a while."""
        if one is None:
            return ""
        self._number = one.number
        course = one.touch.course
        x, y = course.centroid[int(course.peak.argmax())].tolist()
        name = "unlike any gesture" if one.unlike else f"{one.gesture} {100 * one.probability:.0f} %"
        self._shown = Marker(x, y, name), self._second + _SHOWN
        return f"{name} at ({1e3 * x:+.0f}, {1e3 * y:+.0f}) mm, {one.touch.offset - one.touch.onset:.2f} s long"


def _held(one: NamedTouch) -> str:
    """Sentence for a touch that became part of the reference; empty for others."""
    return f"a touch is held since {one.touch.onset:.1f} s and counts as the skin at rest" if one.held else ""
