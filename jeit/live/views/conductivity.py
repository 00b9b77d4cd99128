"""View of the change of conductivity, reconstructed from frames by an `Imager`; and the scenes of images: outline,
electrodes, channels and raster of a body, which a page draws."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind
from jeit.data import Measurement
from jeit.electrodes import AbstractElectrodes
from jeit.image import Raster
from jeit.image.inclusions import StrongestRegion
from jeit.imaging.stream_preparation import ElectrodeChangeFilter, StreamSettings, prepare_imager
from jeit.inverse import Imager
from jeit.inverse.calibration import Calibration
from jeit.inverse.streaming.stream import FrameImage, FrameStatus, StreamState
from jeit.live.pictures import AbstractView, LiveFrame, Marker, Picture, Scene
from jeit.mesh import Mesh
from jeit.protocol import Protocol

# Number of pixels along the longer side of an image, and number of vertices of a circle.
_NUM_PIXELS, _NUM_VERTICES = 160, 36
# Coefficient of a pattern, relative to its largest coefficient, below which an electrode is considered unused.
_MIN_COEFFICIENT = 1e-9


class PixelGrid:
    """Pixel grid on a plane mesh, or on a slice through a solid at half its height, for the images of a page.

    `extent`: x of the left and right edge, y of the lower and upper edge, metres. Raises `ValueError` for a curved
    surface in space.
    """

    def __init__(self, mesh: Mesh, num_pixels: int = _NUM_PIXELS):
        points = np.asarray(mesh.points)[:, :2]
        (x_min, y_min), (x_max, y_max) = points.min(axis=0), points.max(axis=0)
        pixel_size = max(x_max - x_min, y_max - y_min) / num_pixels
        grid_shape = max(1, round((y_max - y_min) / pixel_size)), max(1, round((x_max - x_min) / pixel_size))
        raster = Raster.create(mesh, shape=grid_shape, extent=(x_min, x_max, y_min, y_max))
        cell_of_pixel = np.asarray(raster.cell)
        self.extent = raster.extent
        self._inside_indices = np.flatnonzero(cell_of_pixel.ravel() >= 0)
        self._cell_indices = cell_of_pixel.ravel()[self._inside_indices]
        self._blank_image = np.full(grid_shape, np.nan, np.float32)

    @property
    def inside(self) -> np.ndarray:
        """Mask (rows, columns) of the pixels inside the body."""
        inside_mask = np.zeros(self._blank_image.size, bool)
        inside_mask[self._inside_indices] = True
        return inside_mask.reshape(self._blank_image.shape)

    def __call__(self, image: Float[np.ndarray, " m"]) -> Float[np.ndarray, "H W"]:
        """Sample an image (cells,) at the pixels (rows, columns), in single precision; NaN outside the body."""
        pixel_values = self._blank_image.copy()
        pixel_values.ravel()[self._inside_indices] = image[self._cell_indices]
        return pixel_values


def create_scene(
    mesh: Mesh,
    electrodes: AbstractElectrodes,
    protocol: Protocol,
    grid: PixelGrid,
    *,
    title: str,
    quantity: str,
    unit: str,
    diverging: bool,
    notes: Sequence[str] = (),
) -> Scene:
    """Create the scene of a body with electrodes, whose images are sampled on `grid`."""
    outline_curves = closed_outline(mesh) if mesh.dimension == 2 else _slice_outline(grid)
    electrode_names = [str(electrode_number) for electrode_number in range(1, electrodes.num_electrodes + 1)]
    return Scene(
        title=title,
        quantity=quantity,
        unit=unit,
        diverging=diverging,
        extent=grid.extent,
        outline=outline_curves,
        electrodes=electrode_curves(mesh, electrodes),
        names=electrode_names,
        channels=channel_names(protocol),
        notes=tuple(notes),
    )


def channel_names(protocol: Protocol) -> list[str]:
    """Names of the channels of a protocol, such as "1-2 → 3-4": numbers, from 1, of the driving electrodes and of the
    measuring electrodes."""
    channel_drives, channel_measurements = np.asarray(protocol.channel_drive), np.asarray(protocol.channel_measurement)
    return [
        f"{_pattern_name(drive_row)} → {_pattern_name(measurement_row)}"
        for drive_row, measurement_row in zip(channel_drives, channel_measurements, strict=True)
    ]


def electrode_curves(mesh: Mesh, electrodes: AbstractElectrodes) -> list[Float[np.ndarray, "n 2"]]:
    """Curve of n points (n, 2) around each electrode as seen from above, in metres; a single point for a point
    electrode."""
    curve_pen = _CurveDrawing()
    electrodes.draw(mesh, curve_pen)
    return curve_pen.curves


def _pattern_name(pattern_row: np.ndarray) -> str:
    """Name of a pattern: its electrodes with positive coefficients, followed by those with negative coefficients; for
    more than two electrodes, only the first electrode and "…"."""
    max_coefficient = np.abs(pattern_row).max()
    positive_electrodes, negative_electrodes = (
        np.flatnonzero(coefficient_sign * pattern_row > _MIN_COEFFICIENT * max_coefficient) + 1
        for coefficient_sign in (1, -1)
    )
    if len(positive_electrodes) + len(negative_electrodes) > 2:
        return f"{(positive_electrodes if len(positive_electrodes) else negative_electrodes)[0]}…"
    return "-".join(map(str, (*positive_electrodes, *negative_electrodes)))


def closed_outline(mesh: Mesh) -> list[Float[np.ndarray, "n 2"]]:
    """Closed curves of n points (n, 2) each along the boundary of a plane mesh, in metres."""
    boundary_edges, points = np.asarray(mesh.facets), np.asarray(mesh.points)
    loop_starts = np.flatnonzero(np.append(True, boundary_edges[1:, 0] != boundary_edges[:-1, 1]))
    return [
        points[np.append(loop_edges[:, 0], loop_edges[0, 0])]
        for loop_edges in np.split(boundary_edges, loop_starts[1:])
    ]


def _slice_outline(pixel_grid: PixelGrid) -> list[np.ndarray]:
    """Outline of a slice through a solid, from the mask of the pixels inside the solid."""
    from contourpy import contour_generator

    inside_values = np.pad(pixel_grid.inside.astype(float), 1)
    num_rows, num_columns = pixel_grid.inside.shape
    x_min, x_max, y_min, y_max = pixel_grid.extent
    x = x_min + (np.arange(-1, num_columns + 1) + 0.5) * (x_max - x_min) / num_columns
    y = y_max - (np.arange(-1, num_rows + 1) + 0.5) * (y_max - y_min) / num_rows
    return [np.asarray(line) for line in contour_generator(x, y, inside_values).lines(0.5)]


class _CurveDrawing:
    """Pen that collects the electrodes it draws as curves; see `jeit.electrodes.electrodes.ElectrodePen`."""

    def __init__(self):
        self.curves: list[np.ndarray] = []

    def lines(self, segments: list[np.ndarray], centre: np.ndarray) -> None:
        self.curves.append(
            np.concatenate([np.asarray(line_segment)[:, :2] for line_segment in segments])
            if segments
            else centre[None, :2]
        )

    def disc(self, centre: np.ndarray, radius: float) -> None:
        circle_angles = np.linspace(0, 2 * np.pi, _NUM_VERTICES + 1)
        unit_circle = np.column_stack([np.cos(circle_angles), np.sin(circle_angles)])
        self.curves.append(np.asarray(centre)[:2] + float(radius) * unit_circle)

    def rectangle(self, centre: np.ndarray, width: float, height: float) -> None:
        unit_corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) / 2
        self.curves.append(np.asarray(centre)[:2] + unit_corners * [width, height])

    def dot(self, centre: np.ndarray) -> None:
        self.curves.append(np.asarray(centre)[None, :2])


class ConductivityView(AbstractView):
    """View of the change of conductivity from the undisturbed body: the images of `jeit.inverse.stream`.

    Images are in S/m (2-D: S). A marker shows the centroid of the strongest change, unless the frame differs from the
    reference by noise only. What moved electrodes explain of a frame is left out of its picture, and an event states
    how far they have moved. `ConductivityView.prepare` creates the view from a measurement of the undisturbed body.

    **Arguments:**

    - `imager`: object that reconstructs images from frames, as returned by `jeit.imaging.prepare_imager`.
    - `calibration`: calibrated model of the body, as returned by `jeit.imaging.prepare_imager`.
    - `title`: title of the page.
    - `notes`: remarks for the page.
    - `as_is`: leave the effects of moved electrodes in the pictures.

    Raises `ValueError` for arguments of a wrong type, and for a curved surface in space, which has no plane image.

    **Example:**

    ```python
    view = ConductivityView.prepare(reference, settings)
    print(view.picture(frame).markers)
    ```
    """

    def __init__(
        self,
        imager: Imager,
        calibration: Calibration,
        *,
        title: str = "Conductivity change",
        notes: Sequence[str] = (),
        as_is: bool = False,
    ):
        check_kind("imager", imager, Imager, "an Imager, as of prepare_imager(reference)[0]")
        check_kind("calibration", calibration, Calibration, "a Calibration, as of prepare_imager(reference)[1]")
        model = calibration.model
        self.imager, self.calibration = imager, calibration
        self.background = float(calibration.conductivity)
        self.grid = PixelGrid(model.mesh)
        self._find_strongest = StrongestRegion(model.mesh)
        self._state = StreamState(imager)
        self._electrode_changes = None if as_is else ElectrodeChangeFilter(imager, calibration)
        is_plane_mesh = model.mesh.dimension == 2
        self.scene = create_scene(
            model.mesh,
            model.electrodes,
            model.protocol,
            self.grid,
            title=title,
            quantity="conductivity change",
            unit="S" if is_plane_mesh else "S/m",
            diverging=True,
            notes=(*notes, *(() if is_plane_mesh else ("The image is a slice at half the height of the body.",))),
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
        is_imaged_as_is = settings is not None and settings.as_is
        picture_title = f"Conductivity change, {reference.name}"
        return cls(imager, calibration, title=picture_title, notes=reference.notes, as_is=is_imaged_as_is)

    def picture(self, frame: LiveFrame) -> Picture:
        """Compute the image of a frame without the effect of moved electrodes; see `AbstractView.picture`. A search for
        moved electrodes takes up to a second."""
        electrode_changes, frame_values, corrected_change = self._electrode_changes, frame.values, None
        if electrode_changes is not None:
            frame_values, corrected_change = electrode_changes.rest(self._state, frame_values)
        picture = self.image(replace(frame, values=frame_values))[1]
        if corrected_change is None:
            return picture
        electrode_event = (
            f"Measure a new reference: the voltages have changed as if {corrected_change.description}. "
            "Pictures show the rest."
        )
        return replace(picture, events=(electrode_event,))

    def image(self, frame: LiveFrame) -> tuple[FrameImage, Picture]:
        """Compute the image of a frame as it is on the cells of the mesh, and the picture for the page."""
        frame_image = self._state.image(frame.number, frame.values)
        if frame_image.conductivity is None:
            return frame_image, Picture(None, status=frame_image.status, reason=frame_image.reason)
        conductivity_change = frame_image.conductivity - self.background
        peak_markers = ()
        if frame_image.status != FrameStatus.UNCHANGED:
            peak_centroid, peak_change = self._find_strongest(conductivity_change)
            x, y = peak_centroid[:2].tolist()
            peak_markers = (Marker(x, y, f"{100 * peak_change / self.background:+.0f} %"),)
        return frame_image, Picture(
            self.grid(conductivity_change), peak_markers, frame_image.status, frame_image.reason
        )

    def set_reference(self, frames: Float[np.ndarray, "N M"]) -> None:
        """Take the mean of `frames` (frames, channels) as the new reference, and reset the temporal smoothing of
        images."""
        self.imager = self.imager.with_reference(mean_frame(frames))
        self._state = StreamState(self.imager)
        if self._electrode_changes is not None:
            self._electrode_changes = ElectrodeChangeFilter(self.imager, self.calibration)


def mean_frame(frames: Float[np.ndarray, "N M"]) -> Float[np.ndarray, " M"]:
    """Mean reading (channels,) of each channel over `frames` (frames, channels); NaN for a channel without readings.

    Raises `ValueError` if there are no frames, or if `frames` is not two-dimensional.
    """
    frame_array = np.asarray(frames, float)
    if frame_array.ndim != 2 or not len(frame_array):
        raise ValueError(
            f"reference: give frames (N, M) of the undisturbed sensor; they have shape {frame_array.shape}."
        )
    is_finite = np.isfinite(frame_array)
    num_known_values = is_finite.sum(axis=0)
    return np.where(
        num_known_values, np.where(is_finite, frame_array, 0).sum(axis=0) / np.maximum(num_known_values, 1), np.nan
    )
