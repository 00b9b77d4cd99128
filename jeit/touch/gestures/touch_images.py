"""`TouchImages`: images of the change of a skin's conductivity from its untouched state; contacts in a recording.

Each image is one linear reconstruction step on a coarse mesh, by default with the NOSER prior of Silvera Tawil et al.
(2011). Invalid frames are refused, and the channels of a dead electrode are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind, counted
from jeit.data import FrameRecording, Measurement
from jeit.data.description import Description
from jeit.imaging.stream_preparation import StreamSettings, described_reference, prepare_imager
from jeit.inverse import Imager, stream
from jeit.inverse.calibration import Calibration
from jeit.inverse.nonlinear.solvers import OneStep
from jeit.inverse.streaming.stream import FrameImage
from jeit.mesh import Mesh
from jeit.touch.contacts import CellFinder, Contact, ImageNoise, find_contacts, track_contacts
from jeit.touch.contacts.tracker import TouchPath, remove_side_lobes

# Minimum number of frames of the untouched skin for imaging, and for an estimate of the noise of images.
_MIN_UNTOUCHED_FRAMES, _MIN_NOISE_FRAMES = 3, 10

TOUCH_IMAGES = StreamSettings(solver=OneStep(), prior="noser")
"""Default settings for imaging touches."""


@dataclass(frozen=True)
class TouchImages:
    """Computes images of the changes of a skin's conductivity under touches.

    **Fields**: `imager`: reconstructs images from frames; `calibration`: calibrated model of the skin that the imager
    uses; `reference`: mean frame of the untouched skin.

    **Example:**

    ```python
    images = TouchImages.prepare(description, empty, settings)
    changes = images.changes(film)  # (F, m), S
    ```
    """

    imager: Imager
    calibration: Calibration
    reference: Measurement

    @classmethod
    def prepare(
        cls,
        description: Description,
        untouched: Float[np.ndarray, "u M"],
        settings: StreamSettings = TOUCH_IMAGES,
        *,
        progress: Callable[[str], None] | None = None,
    ) -> "TouchImages":
        """Prepare imaging of a described skin from frames `untouched` (u, M), volts, of the untouched skin.

        The mean of these frames is the reference. `progress` is called with the name of each step as it begins. Raises
        `ValueError` for an incomplete description, a three-dimensional skin, frames whose number of channels is not
        that of the description, and as `jeit.imaging.prepare_imager` does.
        """
        check_kind("description", description, Description, "a Description, as of load_description('skin.toml')")
        reference = described_reference(description, untouched, name="untouched")
        imager, calibration = prepare_imager(reference, settings, progress=progress)
        if calibration.model.mesh.dimension != 2:
            raise ValueError(f"{description.origin}: touches are detected on sheets (2-D); this is a solid.")
        return cls(imager, calibration, reference)

    @property
    def mesh(self) -> Mesh:
        """The mesh of the images."""
        return self.calibration.model.mesh

    @property
    def background(self) -> float:
        """Conductivity of the untouched skin, S."""
        return float(self.calibration.conductivity)

    @property
    def num_channels(self) -> int:
        """Number M of voltages of a frame."""
        return self.calibration.model.protocol.num_measurements

    def stream(self, frames: Iterable) -> Iterator[tuple[FrameImage, Float[np.ndarray, " m"]]]:
        """Compute images of frames (M,), volts, one by one.

        Yields the status of each frame, and its image of the change of conductivity (m,), S, which is NaN if the frame
        was refused.
        """
        change_of_refused_frame = np.full(self.mesh.num_cells, np.nan)
        for frame_image in stream(self.imager, frames):
            yield (
                frame_image,
                change_of_refused_frame
                if frame_image.conductivity is None
                else frame_image.conductivity - self.background,
            )

    def changes(self, frames: Float[np.ndarray, "F M"]) -> Float[np.ndarray, "F m"]:
        """Compute images of the change of conductivity (F, m), S, of frames (F, M), volts; NaN for refused frames."""
        changes = [change for _, change in self.stream(frames)]
        return np.array(changes).reshape(len(changes), self.mesh.num_cells)


def untouched_frames(
    recording: FrameRecording, seconds: Float[np.ndarray, " F"], span: float
) -> Float[np.ndarray, "u M"]:
    """Return frames (u, M), volts, of the untouched skin: the recording's `reference`, otherwise the frames of its
    first `span` seconds.

    **Arguments:**

    - `recording`: the recording.
    - `seconds`: times (F,) of its frames, seconds.
    - `span`: time from the beginning of the recording in which the skin is untouched, seconds.

    Of the latter, frames without any reading are left out. Raises `ValueError` if fewer than three frames remain.

    **Example:**

    ```python
    still = untouched_frames(healthy_recording, np.arange(len(healthy)) / 5, span=1.0)
    print(still.shape)  # (u, M)
    ```
    """
    if recording.reference is not None:
        return recording.reference
    first_frames = recording.frames[seconds < seconds[0] + span]
    frames_with_readings = first_frames[np.isfinite(first_frames).any(axis=1)]
    if len(frames_with_readings) < _MIN_UNTOUCHED_FRAMES:
        frame_interval = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
        unit_hint = (
            f" Frames are {frame_interval:.3g} s apart: are these milliseconds?" if frame_interval > span else ""
        )
        raise ValueError(
            f"untouched: the first {span:g} s of '{recording.name}' have "
            f"{counted(len(frames_with_readings), 'frame')} with a reading; {_MIN_UNTOUCHED_FRAMES} are needed of the "
            f"untouched skin. Give a longer time, or a reference.{unit_hint}"
        )
    return frames_with_readings


@dataclass(frozen=True)
class RecordedContacts:
    """Contacts that were found in a recording.

    **Fields**: `seconds` (F,): times of the frames; `changes` (F, m): change of conductivity, S, NaN for refused
    frames; `contacts`: list of the contacts of each frame; `touches`: paths of the touches, which last for two frames
    or more; `notes`: reasons to doubt contacts and touches.

    **Example:**

    ```python
    found = find_recorded_contacts(images, film, np.arange(len(film)) / 30, empty)
    print(isinstance(found, RecordedContacts), [touch.position[0] for touch in found.touches])
    ```
    """

    seconds: Float[np.ndarray, " F"]
    changes: Float[np.ndarray, "F m"]
    contacts: list[list[Contact]]
    touches: list[TouchPath]
    notes: tuple[str, ...]

    def number_of(self, frame: int, contact: Contact) -> int | None:
        """Return the number of the touch to which a contact of the frame with index `frame` belongs, or None."""
        return self._touch_numbers.get((float(self.seconds[frame]), *contact.centroid.tolist()))

    @cached_property
    def _touch_numbers(self) -> dict[tuple[float, ...], int]:
        return {
            (time, *touch_position): touch_path.number
            for touch_path in self.touches
            for time, touch_position in zip(touch_path.times.tolist(), touch_path.position.tolist(), strict=True)
        }


def find_recorded_contacts(
    images: TouchImages,
    frames: Float[np.ndarray, "F M"],
    seconds: Float[np.ndarray, " F"],
    untouched: Float[np.ndarray, "u M"],
    *,
    sign: int = 1,
    weakest: float = 0.4,
) -> RecordedContacts:
    """Find and track the contacts in the frames of a recording.

    **Arguments:**

    - `images`: imager of the skin.
    - `frames`: frames (F, M), volts.
    - `seconds`: increasing times (F,) of the frames, seconds.
    - `untouched`: frames (u, M) of the untouched skin, volts, from which the noise of images is estimated if there are
      ten or more.
    - `sign`: 1 if touched skin conducts better, -1 if worse.
    - `weakest`: minimum peak of a contact, relative to that of the strongest contact in its frame. A linear image of a
      contact has side lobes of up to a third of its peak.

    Raises `ValueError` if no frame can be imaged, and as `track_contacts` does.

    **Example:**

    ```python
    found = find_recorded_contacts(images, film, np.arange(len(film)) / 30, empty)
    for touch in found.touches:
        print(touch.onset, touch.position[0], touch.peak.max())
    ```
    """
    finder = CellFinder(images.mesh, sign=sign)
    changes, untouched_changes = images.changes(frames), images.changes(untouched)
    untouched_changes = untouched_changes[np.isfinite(untouched_changes).all(axis=1)]
    image_noise = None
    if len(untouched_changes) >= _MIN_NOISE_FRAMES and (untouched_changes != untouched_changes[0]).any():
        image_noise = ImageNoise.of_images(untouched_changes)
    if not np.isfinite(changes).all(axis=1).any():
        raise ValueError(f"frames: none of the {counted(len(frames), 'frame')} could be imaged.")
    all_contacts = [
        find_contacts(finder, change, image_noise) if np.isfinite(change).all() else [] for change in changes
    ]
    contacts = []
    for frame_contacts in all_contacts:
        max_contact_peak = max((abs(contact.peak) for contact in frame_contacts), default=0.0)
        contacts.append([contact for contact in frame_contacts if abs(contact.peak) >= weakest * max_contact_peak])
    touches = remove_side_lobes(track_contacts(seconds, contacts), weakest)
    notes = []
    if image_noise is None:
        notes.append(
            f"noise is estimated from each image, because fewer than {_MIN_NOISE_FRAMES} different frames of the "
            "untouched skin are known: contacts may be missed"
        )
    elif len(untouched_changes) < 3 * _MIN_NOISE_FRAMES:
        notes.append(
            f"noise is estimated from {len(untouched_changes)} untouched frames; a hundred give fewer false contacts"
        )
    if num_refused := int((~np.isfinite(changes).all(axis=1)).sum()):
        notes.append(f"{counted(num_refused, 'frame')} could not be imaged")
    if num_excluded_contacts := sum(map(len, all_contacts)) - sum(map(len, contacts)):
        notes.append(
            f"{counted(num_excluded_contacts, 'contact')} with less than {100 * weakest:.0f} % of the strongest change "
            "of the frame may be side lobes of the image, and are left out"
        )
    if num_unassigned_contacts := sum(map(len, contacts)) - sum(len(touch_path.times) for touch_path in touches):
        notes.append(f"{counted(num_unassigned_contacts, 'contact')} of brief or weak appearance belong to no touch")
    return RecordedContacts(seconds, changes, contacts, touches, tuple(notes))
