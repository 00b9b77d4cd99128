"""`TouchImages`: images of the change of a skin from its untouched state, frame by frame.

They are one linear step on a coarse mesh, by default with the prior of Silvera Tawil et al. (2011), NOSER. Frames are
checked as in every stream: bad ones are refused, a dead electrode's channels left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind, counted
from jeit.data import FrameRecording, Measurement
from jeit.data.description import Description
from jeit.data.screening import screen
from jeit.imaging.stream_preparation import StreamSettings, prepare_imager
from jeit.inverse import Imager, stream
from jeit.inverse.calibration import Calibration
from jeit.inverse.nonlinear.solvers import OneStep
from jeit.inverse.streaming.stream import FrameImage
from jeit.mesh import Mesh

# The least number of frames of an untouched skin.
_FEWEST = 3

TOUCH_IMAGES = StreamSettings(solver=OneStep(), prior="noser")
"""Default settings for imaging touches."""


@dataclass(frozen=True)
class TouchImages:
    """An `imager` of a skin and the `calibration` that it is based on; `reference`, the untouched skin."""

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
        """Prepare imaging of a described skin that reads `untouched` (u, M), volts, while nobody touches it.

        The mean of these frames is the reference. `progress` is called with each step as it begins. Raises `ValueError`
        for a skin that is not described whole, a solid one, another number of channels, and as
        `jeit.imaging.prepare_imager`.
        """
        check_kind("description", description, Description, "a Description, as of load_description('skin.toml')")
        protocol = description.protocol(description.origin)
        if protocol is None or description.domain is None or description.electrodes is None:
            said = {"geometry": description.domain, "electrodes": description.electrodes, "protocol": protocol}
            missing = ", ".join(f"[{section}]" for section, one in said.items() if one is None)
            raise ValueError(f"{description.origin}: images of touches need {missing} too; describe it.")
        reference = screen(
            untouched,
            protocol,
            electrodes=description.electrodes,
            domain=description.domain,
            name="untouched",
            notes=description.notes,
        ).mean_frame()
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
        """Number of voltages of a frame, M."""
        return self.calibration.model.protocol.num_measurements

    def stream(self, frames: Iterable) -> Iterator[tuple[FrameImage, Float[np.ndarray, " m"]]]:
        """Image each frame (M,), volts: its status, and its change of conductivity (m,), S; NaN where it was
        refused."""
        refused = np.full(self.mesh.num_cells, np.nan)
        for one in stream(self.imager, frames):
            yield one, refused if one.conductivity is None else one.conductivity - self.background

    def changes(self, frames: Float[np.ndarray, "F M"]) -> Float[np.ndarray, "F m"]:
        """Changes of conductivity (F, m), S, of frames (F, M), volts; NaN for frames that are refused."""
        found = [change for _, change in self.stream(frames)]
        return np.array(found).reshape(len(found), self.mesh.num_cells)


def untouched_frames(
    recording: FrameRecording, seconds: Float[np.ndarray, " F"], span: float
) -> Float[np.ndarray, "u M"]:
    """Frames (u, M) of the untouched skin: the recording's `reference`, or else its first `span` seconds.

    `seconds` (F,): when its frames came. Raises `ValueError` for fewer than three frames, and such as have no reading.
    """
    if recording.reference is not None:
        return recording.reference
    first = recording.frames[seconds < seconds[0] + span]
    read = first[np.isfinite(first).any(axis=1)]
    if len(read) < _FEWEST:
        step = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
        hint = f" Frames are {step:.3g} s apart: are these milliseconds?" if step > span else ""
        raise ValueError(
            f"untouched: the first {span:g} s of '{recording.name}' have {counted(len(read), 'frame')} with a reading; "
            f"{_FEWEST} are needed of the untouched skin. Give a longer time, or a reference.{hint}"
        )
    return read
