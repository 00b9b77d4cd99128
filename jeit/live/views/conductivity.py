"""View of the change of conductivity, reconstructed from frames by an `Imager`."""

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
    """View of the change of conductivity from the undisturbed body: the images of `jeit.inverse.stream`.

    Images are in S/m (2-D: S). A marker shows the centroid of the strongest change, unless the frame differs from the
    reference by noise only. `ConductivityView.prepare` creates the view from a measurement of the undisturbed body.

    **Arguments:**

    - `imager`: object that reconstructs images from frames, as returned by `jeit.imaging.prepare_imager`.
    - `calibration`: calibrated model of the body, as returned by `jeit.imaging.prepare_imager`.
    - `title`: title of the page.
    - `notes`: remarks for the page.

    Raises `ValueError` for arguments of a wrong type, and for a curved surface in space, which has no plane image.

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
        is_plane = model.mesh.dimension == 2
        self.scene = scene_of(
            model.mesh,
            model.electrodes,
            model.protocol,
            self.grid,
            title=title,
            quantity="conductivity change",
            unit="S" if is_plane else "S/m",
            diverging=True,
            notes=(*notes, *(() if is_plane else ("The image is a slice at half the height of the body.",))),
        )

    @classmethod
    def prepare(
        cls,
        reference: Measurement,
        settings: StreamSettings | None = None,
        *,
        progress: Callable[[str], None] | None = None,
    ) -> ConductivityView:
        """Prepare the view of a sensor from `reference`, a measurement of the undisturbed sensor.

        Raises `ValueError` if `jeit.imaging.prepare_imager` does.
        """
        imager, calibration = prepare_imager(reference, settings, progress=progress)
        return cls(imager, calibration, title=f"Conductivity change, {reference.name}", notes=reference.notes)

    def picture(self, frame: LiveFrame) -> Picture:
        """Compute the image of a frame; see `AbstractView.picture`."""
        return self.image(frame)[1]

    def image(self, frame: LiveFrame) -> tuple[FrameImage, Picture]:
        """Compute the image of a frame on the cells of the mesh, and the picture for the page."""
        frame_image = self._state.image(frame.number, frame.values)
        if frame_image.conductivity is None:
            return frame_image, Picture(None, status=frame_image.status, reason=frame_image.reason)
        change = frame_image.conductivity - self.background
        markers = ()
        if frame_image.status != FrameStatus.UNCHANGED:
            centroid, peak = self._strongest(change)
            x, y = centroid[:2].tolist()
            markers = (Marker(x, y, f"{100 * peak / self.background:+.0f} %"),)
        return frame_image, Picture(self.grid(change), markers, frame_image.status, frame_image.reason)

    def set_reference(self, frames: Float[np.ndarray, "N M"]) -> None:
        """Take the mean of `frames` (frames, channels) as the new reference, and reset the temporal smoothing of
        images."""
        self.imager = self.imager.with_reference(mean_frame(frames))
        self._state = StreamState(self.imager)


def mean_frame(frames: Float[np.ndarray, "N M"]) -> Float[np.ndarray, " M"]:
    """Mean reading (channels,) of each channel over `frames` (frames, channels); NaN for a channel without readings.

    Raises `ValueError` if there are no frames, or if `frames` is not two-dimensional.
    """
    values = np.asarray(frames, float)
    if values.ndim != 2 or not len(values):
        raise ValueError(f"reference: give frames (N, M) of the undisturbed sensor; they have shape {values.shape}.")
    is_finite = np.isfinite(values)
    counts = is_finite.sum(axis=0)
    return np.where(counts, np.where(is_finite, values, 0).sum(axis=0) / np.maximum(counts, 1), np.nan)
