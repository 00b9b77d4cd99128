"""Data exchanged by the parts of a live session: frames of a source, and the picture that a view computes from each
frame."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from jeit.inverse.streaming.stream import FrameStatus


@dataclass(frozen=True)
class LiveFrame:
    """A frame of a live session, as a source delivers it.

    **Fields**: `number`: index in order of arrival, from 0; `second`: time since the session began, seconds; `arrived`:
    `time.monotonic()` when the frame's last byte was read; `values`: voltages (channels,) in volts, NaN for a channel
    without a reading, or the text of a line that is not a frame.

    **Example:**

    ```python
    frame = LiveFrame(0, second=0.0, arrived=0.0, values=still[0])
    picture = view.picture(frame)
    ```
    """

    number: int
    second: float
    arrived: float
    values: Float[np.ndarray, " M"] | str


@dataclass(frozen=True)
class Marker:
    """A position that a view estimates, for example of a contact, a touch or a sound.

    **Fields**: `x`, `y`: metres; `label`: text beside the marker, such as "2.1 N" or "stroke 93 %"; `radius`: radius of
    the region that contains the position with a probability of 68 %, metres, NaN if unknown; `track`: number of the
    contact to which the marker belongs, so that the path of the contact can be drawn, or None.

    **Example:**

    ```python
    marker = Marker(0.02, -0.01, label="2.1 N", radius=3e-3)
    picture = Picture(None, markers=(marker,))
    ```
    """

    x: float
    y: float
    label: str = ""
    radius: float = float("nan")
    track: int | None = None


@dataclass(frozen=True)
class Picture:
    """Picture that a view computes from one frame.

    **Fields**: `pixels` (rows, columns): float32 image in the scene's unit, row 0 at the largest y, NaN outside the
    body; None for a refused frame or a view without an image; `markers`: estimated positions; `status`, `reason`: as in
    `jeit.inverse.streaming.FrameImage`; `events`: sentences for the page's list of events, such as a named gesture.

    **Example:**

    ```python
    refused = Picture(None, reason="The frame has 100 channels; the reference has 208.")
    print(view.picture(frame).pixels.shape, refused.reason)
    ```
    """

    pixels: Float[np.ndarray, "H W"] | None
    markers: tuple[Marker, ...] = ()
    status: FrameStatus = FrameStatus.IMAGED
    reason: str = ""
    events: tuple[str, ...] = ()


@dataclass(frozen=True)
class Scene:
    """Description of a view, which a page receives once, before the first picture.

    **Fields**: `title`; `quantity`, `unit`: quantity and unit of the pixels, such as "conductivity change", "S/m";
    `diverging`: whether colours are centred on zero; `extent`: x of left and right edge, y of lower and upper edge of
    the image, metres; `outline`: closed curves of the body's edge, metres, each of n points (n, 2); `electrodes`: a
    curve (n, 2) of each electrode, metres; `names`: names of the electrodes; `channels`: name of each channel, such as
    "1-2 → 3-4"; `notes`: remarks for the user.

    **Example:**

    ```python
    scene = Scene("tank", "conductivity change", "S", True, (-0.1, 0.1, -0.1, 0.1), outline=[])
    print(scene.title, view.scene.unit)
    ```
    """

    title: str
    quantity: str
    unit: str
    diverging: bool
    extent: tuple[float, float, float, float]
    outline: Sequence[Float[np.ndarray, "n 2"]]
    electrodes: Sequence[Float[np.ndarray, "n 2"]] = ()
    names: Sequence[str] = ()
    channels: Sequence[str] = ()
    notes: Sequence[str] = field(default=())


class AbstractView(abc.ABC):
    """Base class of views, which compute pictures from frames, one after another, in the order of frame numbers.

    **Attributes**: `scene`: description of the view, which a page receives before the first picture.

    **Example:**

    ```python
    print(isinstance(view, AbstractView), view.scene.quantity)
    print(view.picture(frame).status)
    ```
    """

    scene: Scene

    @abc.abstractmethod
    def picture(self, frame: LiveFrame) -> Picture:
        """Compute the picture of a frame. If the view refuses the frame, the picture has no pixels and states the
        reason."""

    @abc.abstractmethod
    def set_reference(self, frames: Float[np.ndarray, "N M"]) -> None:
        """Take the mean of `frames` (frames, channels) of the undisturbed sensor, in volts, as the new reference.

        Raises `ValueError` for frames that cannot be a reference; the view then continues with the old reference.
        """
