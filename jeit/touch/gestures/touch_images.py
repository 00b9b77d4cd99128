"""`TouchImages`: images of the change of a skin's conductivity from its untouched state, frame by frame.

Each image is one linear reconstruction step on a coarse mesh, by default with the NOSER prior of Silvera Tawil et al.
(2011). As in every stream, invalid frames are refused, and the channels of a dead electrode are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

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

# Minimum number of frames of an untouched skin.
_MIN_UNTOUCHED_FRAMES = 3

TOUCH_IMAGES = StreamSettings(solver=OneStep(), prior="noser")
"""Default settings for imaging touches."""


@dataclass(frozen=True)
class TouchImages:
    """Imager of the touches of a skin.

    **Fields**: `imager`: reconstructs images from frames; `calibration`: calibrated model of the skin that it uses;
    `reference`: mean frame of the untouched skin.

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

        The mean of these frames is the reference. `progress` is called with each step as it begins. Raises `ValueError`
        for an incomplete description, a three-dimensional skin, another number of channels, and as
        `jeit.imaging.prepare_imager` does.
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
        """Image frames (M,), volts.

        Yields the status of each frame, and its change of conductivity (m,), S, which is NaN if the frame was refused.
        """
        refused_change = np.full(self.mesh.num_cells, np.nan)
        for frame_image in stream(self.imager, frames):
            yield (
                frame_image,
                refused_change if frame_image.conductivity is None else frame_image.conductivity - self.background,
            )

    def changes(self, frames: Float[np.ndarray, "F M"]) -> Float[np.ndarray, "F m"]:
        """Compute changes of conductivity (F, m), S, from frames (F, M), volts; NaN for frames that are refused."""
        changes = [change for _, change in self.stream(frames)]
        return np.array(changes).reshape(len(changes), self.mesh.num_cells)


def untouched_frames(
    recording: FrameRecording, seconds: Float[np.ndarray, " F"], span: float
) -> Float[np.ndarray, "u M"]:
    """Return frames (u, M) of the untouched skin: the recording's `reference`, otherwise its first seconds. Frames
    without any reading are left out.

    **Arguments:**

    - `recording`: the recording.
    - `seconds`: times (F,) of its frames, seconds.
    - `span`: time from the beginning that is untouched, seconds.

    Raises `ValueError` if fewer than three frames remain.

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
        interval = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
        hint = f" Frames are {interval:.3g} s apart: are these milliseconds?" if interval > span else ""
        raise ValueError(
            f"untouched: the first {span:g} s of '{recording.name}' have "
            f"{counted(len(frames_with_readings), 'frame')} with a reading; {_MIN_UNTOUCHED_FRAMES} are needed of the "
            f"untouched skin. Give a longer time, or a reference.{hint}"
        )
    return frames_with_readings
