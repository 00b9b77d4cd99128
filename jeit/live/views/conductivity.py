"""View of the change of conductivity: frames imaged by an `Imager`."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind
from jeit.data import Measurement
from jeit.image.inclusions import StrongestRegion
from jeit.imaging.stream_preparation import StreamSettings, prepare_imager
from jeit.inverse import Imager
from jeit.inverse.calibration import Calibration
from jeit.inverse.streaming.stream import FrameImage, FrameStatus, StreamState
from jeit.live.pictures import AbstractView, LiveFrame, Marker, Picture
from jeit.live.views.scene import PixelGrid, scene_of


class ConductivityView(AbstractView):
    """View of the change of conductivity from that of the undisturbed body: the images of `jeit.inverse.stream`.

    Images are in S/m (2-D: S). A marker stands at the centroid of the strongest change, unless the frame differs from
    an undisturbed one by noise only. `ConductivityView.prepare` makes the view from a measurement of the undisturbed
    body.

    **Arguments:**

    - `imager`: reconstructs images from frames, as from `jeit.imaging.prepare_imager`.
    - `calibration`: calibrated model of the body, from the same function.
    - `title`: title of the page.
    - `notes`: remarks for the page.

    Raises `ValueError` for objects of another kind, and for a surface in space, which has no flat image.

    **Example:**

    ```python
    view = ConductivityView.prepare(reference, settings)
    print(view.picture(frame).markers)
    ```
    """

    def __init__(
        self, imager: Imager, calibration: Calibration, *, title: str = "Conductivity change", notes: Sequence[str] = ()
    ):
        check_kind("imager", imager, Imager, "an Imager, as of prepare_imager(reference)[0]")
        check_kind("calibration", calibration, Calibration, "a Calibration, as of prepare_imager(reference)[1]")
        model = calibration.model
        self.imager, self.background = imager, float(calibration.conductivity)
        self.grid = PixelGrid(model.mesh)
        self._strongest = StrongestRegion(model.mesh)
        self._state = StreamState(imager)
        plane = model.mesh.dimension == 2
        self.scene = scene_of(
            model.mesh,
            model.electrodes,
            model.protocol,
            self.grid,
            title=title,
            quantity="conductivity change",
            unit="S" if plane else "S/m",
            diverging=True,
            notes=(*notes, *(() if plane else ("The image is a slice at half the height of the body.",))),
        )

    @classmethod
    def prepare(
        cls,
        reference: Measurement,
        settings: StreamSettings | None = None,
        *,
        progress: Callable[[str], None] | None = None,
    ) -> ConductivityView:
        """Prepare the view of a sensor from `reference`, frames of the undisturbed sensor, which say what it is.

        Raises `ValueError` as `jeit.imaging.prepare_imager`.
        """
        imager, calibration = prepare_imager(reference, settings, progress=progress)
        return cls(imager, calibration, title=f"Conductivity change, {reference.name}", notes=reference.notes)

    def picture(self, frame: LiveFrame) -> Picture:
        """The image of a frame; see `AbstractView.picture`."""
        return self.image(frame)[1]

    def image(self, frame: LiveFrame) -> tuple[FrameImage, Picture]:
        """The image of a frame on the cells of the mesh, and its picture."""
        one = self._state.image(frame.number, frame.values)
        if one.conductivity is None:
            return one, Picture(None, status=one.status, reason=one.reason)
        change = one.conductivity - self.background
        markers = ()
        if one.status != FrameStatus.UNCHANGED:
            centroid, peak = self._strongest(change)
            x, y = centroid[:2].tolist()
            markers = (Marker(x, y, f"{100 * peak / self.background:+.0f} %"),)
        return one, Picture(self.grid(change), markers, one.status, one.reason)

    def set_reference(self, frames: Float[np.ndarray, "N M"]) -> None:
        """Take the mean of frames (N, M) as the new reference; images with a memory begin anew."""
        self.imager = self.imager.with_reference(mean_frame(frames))
        self._state = StreamState(self.imager)


def mean_frame(frames: Float[np.ndarray, "N M"]) -> Float[np.ndarray, " M"]:
    """Mean (M,) of the readings of each channel in frames (N, M), NaN for a channel without one.

    Raises `ValueError` if there are no frames, or frames that are not (N, M).
    """
    values = np.asarray(frames, float)
    if values.ndim != 2 or not len(values):
        raise ValueError(f"reference: give frames (N, M) of the undisturbed sensor; they have shape {values.shape}.")
    known = np.isfinite(values)
    number = known.sum(axis=0)
    return np.where(number, np.where(known, values, 0).sum(axis=0) / np.maximum(number, 1), np.nan)
