"""Difference imaging of two frames: check, mesh, calibrate, image, and find inclusions.

The command `jeit reconstruct` runs `image_difference`. Its steps are public functions of `jeit.data`,
`jeit.imaging.preparation`, `jeit.inverse` and `jeit.image`, which can also be called one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Inexact, UInt8

from jeit.arguments import object_html, object_text, percent, picture
from jeit.data import Measurement
from jeit.data.frame_checks import FrameQuality
from jeit.electrodes import AbstractElectrodes
from jeit.forward import ForwardModel
from jeit.image import Inclusion, Raster, SolidForm
from jeit.image.inclusions import inclusion_regions
from jeit.image.rasters import CONDUCTIVE, RESISTIVE
from jeit.imaging.automatic import change_and_noise, estimate_unexplained_noise, image_automatically
from jeit.imaging.calibration import StepTimer
from jeit.imaging.doubts import doubts_of_data
from jeit.imaging.electrode_changes import ElectrodeChange
from jeit.imaging.method import AUTO, METHODS, ImagingSettings, MethodOptions, as_settings
from jeit.imaging.preparation import PreparedDifference, prepare_difference
from jeit.imaging.wiring import Wiring
from jeit.inverse.calibration import Calibration
from jeit.inverse.linear.one_step import LinearReconstruction
from jeit.inverse.nonlinear.reconstruct import Reconstruction
from jeit.inverse.shapes import KINDS, Ellipsoid, ShapeReconstruction, Star
from jeit.inverse.uncertainty import DetectableDiameters, detectable_diameters, detectable_strength, image_noise
from jeit.mesh import Mesh
from jeit_solvers import Status, one_thread_of_blas
from jeit_solvers.engines import as_array

_RELATIVE_SEGMENTATION_THRESHOLD = 0.5
# Maximum misfit of an image's voltages, in standard deviations, that raises no doubt.
_MAX_UNDOUBTED_MISFIT = 3.0


@dataclass(frozen=True)
class ImagedDifference:
    """Image of the change between two frames: the result of `image_difference`.

    **Fields**

    - `measurement`, `reference`: the two frames compared, one frame each.
    - `quality`: the quality of the data, assessed before imaging.
    - `settings`: the settings used, with automatic choices filled in.
    - `why`: the reason for the imaging method, if the method was chosen automatically.
    - `wiring`: the estimated connection of electrodes and channels.
    - `calibration`: the forward model fitted to the reference, with its mesh.
    - `reconstruction`: the reconstruction matrix, the result of the iteration, or the shapes; with the hyperparameter
      used and the rule that chose it.
    - `change`: change of conductivity in every cell (m,), S/m (2-D: S), relative to `calibration.conductivity`. For
      complex voltages, the complex change of admittivity σ + iωε.
    - `raster`: `change` on a grid, NaN outside the mesh; `extent`: (x_min, x_max, y_min, y_max) in metres.
    - `inclusions`: regions of changed conductivity, strongest first; the `shapes` if there are any. Inclusions must
      exceed the noise of the image. In linear images they are changes beside one common to all voltages. In
      iterative images they are found in the logarithm of conductivity, which weights both signs alike; in complex
      images in the real part.
    - `unlike_electrodes`: electrodes, numbered from 0, whose channels the model fits far worse than those of the other
      electrodes, each with the ratio of the misfits. These channels have less weight.
    - `shapes`: fitted bodies with outlines; None if no bodies were fitted, or if they do not explain the voltages.
    - `labels`: label of every pixel of the raster, if requested: 0 background, 1 resistive, 2 conductive.
    - `timings`: duration of each step in seconds.
    - `frame`: number of the imaged frame in its file, from 0; `num_frames`: number of frames in the file.
    - `electrode_change`: the change of the electrodes since the reference, if it explains much of the difference; the
      image shows the rest.
    - `noise` (M,): expected deviation of the measured voltage difference from the modelled one, volts, see
      `PreparedDifference.modelled_noise`; None if not known.

    **Example:**

    ```python
    imaged = image_difference(pressed, rest, quick)
    imaged.inclusions, imaged.change, imaged.doubts
    ```
    """

    measurement: Measurement
    reference: Measurement
    quality: FrameQuality
    settings: ImagingSettings
    calibration: Calibration
    reconstruction: LinearReconstruction | Reconstruction | ShapeReconstruction
    change: Inexact[Array, " m"]
    raster: Inexact[Array, "rows columns"]
    extent: tuple[float, float, float, float]
    inclusions: tuple[Inclusion, ...]
    wiring: Wiring
    why: str = ""
    unlike_electrodes: dict[int, float] = field(default_factory=dict)
    shapes: ShapeReconstruction | None = None
    labels: UInt8[np.ndarray, "rows columns"] | None = None
    timings: dict[str, float] = field(default_factory=dict)
    frame: int = 0
    num_frames: int = 1
    electrode_change: ElectrodeChange | None = None
    noise: Float[Array, " M"] | None = None

    def __repr__(self) -> str:
        return object_text(
            lambda: (
                f"ImagedDifference({self.measurement.name!r}, by {self.settings.method}: "
                f"{len(self.inclusions)} inclusions in {self.mesh.num_cells} cells,\n"
                f"  background {complex(self.calibration.conductivity).real:.3g}, "
                f"misfit {percent(float(self.calibration.misfit))}"
                f"{self._doubts_text})"
            ),
            self,
        )

    @property
    def _doubts_text(self) -> str:
        return f";\n  doubts: {' '.join(self.doubts)}" if self.doubts else ""

    def _repr_png_(self) -> bytes | None:
        return picture(self)

    def _repr_html_(self) -> str | None:
        return object_html(self)

    @property
    def lowest(self) -> float:
        """Minimum change of conductivity, relative to the background; below -1, conductivity is negative."""
        return float(np.real(self.change).min()) / float(np.real(self.calibration.conductivity))

    @property
    def peak_ranges(self) -> tuple[tuple[float, float], ...]:
        """68 % interval of the change in each inclusion, S/m (2-D: S). Empty without fitted bodies, and if the data do
        not determine a limit of an interval."""
        background = float(np.real(self.calibration.conductivity))
        intervals = [inclusion.contrast_interval or (None, None) for inclusion in self.inclusions]
        ranges = [
            (background * low, background * high) for low, high in intervals if low is not None and high is not None
        ]
        return tuple(ranges) if len(ranges) == len(intervals) else ()

    @property
    def mesh(self) -> Mesh:
        """Mesh of the image; with bodies in a solid, a mesh that is refined at their surfaces."""
        return _model_of_reconstruction(self.reconstruction, self.calibration).mesh

    @property
    def electrodes(self) -> AbstractElectrodes:
        """Electrodes on the mesh of the image."""
        return _model_of_reconstruction(self.reconstruction, self.calibration).electrodes

    @property
    def chosen_by(self) -> str:
        """Source of the hyperparameter: the name of a rule, "default" for the method's default number, "given" for any
        other number, "none" for methods without a hyperparameter."""
        rule, requested_hyperparameter = self.reconstruction.rule, self.settings.hyperparameter
        is_default = (
            requested_hyperparameter is None or requested_hyperparameter == METHODS[self.settings.method].hyperparameter
        )
        return "default" if rule == "given" and is_default else rule

    @property
    def doubts(self) -> tuple[str, ...]:
        """Reasons to doubt the image, in sentences: too few channels, noise, an implausible background, an iteration
        that did not converge, voltages not explained by the image, or bodies whose kind the data do not determine."""
        reconstruction = self.reconstruction
        data = self.measurement, self.reference, self.calibration, self.quality
        doubt_texts = doubts_of_data(*data, self.electrode_change)
        if isinstance(reconstruction, LinearReconstruction):
            if self.lowest < -1:
                doubt_texts.append(
                    f"the linear image falls to {percent(self.lowest)} of the background, below -100 %: bodies may be "
                    "out of place, missing, or shown where none are; leave out --method, or take gauss-newton."
                )
            return tuple(doubt_texts)
        if isinstance(reconstruction, Reconstruction) and reconstruction.status != Status.CONVERGED:
            doubt_texts.append(
                f"the iteration did not converge ({reconstruction.status}): neither peaks nor places are to be "
                "trusted. Take the default hyperparameter, or a larger one."
            )
        if (misfit := float(reconstruction.misfit)) > _MAX_UNDOUBTED_MISFIT:
            doubt_texts.append(
                f"its voltages miss the data by {misfit:.2g} standard deviations: bodies may be missing, or shown "
                "where none are."
            )
        for body in reconstruction.alternatives if isinstance(reconstruction, ShapeReconstruction) else ():
            if body is not None:
                x, y = 1e3 * body.centroid[:2]
                kind = "a column through the whole height" if body.column else "no column but an ellipsoid"
                doubt_texts.append(
                    f"the body at x {x:.0f} mm, y {y:.0f} mm may as well be {kind}, of "
                    f"{np.exp(body.sign * body.contrast):.2g} times the background and {1e6 * body.volume:.3g} cm³: "
                    "these electrodes do not determine which. If you know, bodies (--bodies) says so."
                )
        return tuple(doubt_texts)

    @property
    def detectable_strength(self) -> Float[np.ndarray, " m"] | None:
        """Smallest strength with which a body in each cell (m,) of the calibrated model's mesh is detected, m² (3-D:
        m³), see `jeit.inverse.detectable_strength`; None for complex images, and if the noise is not known."""
        return self._detectable(detectable_strength)

    @property
    def detectable_diameters(self) -> DetectableDiameters | None:
        """Diameters of the smallest insulating bodies that are detected, see `jeit.inverse.detectable_diameters`; None
        for complex images, and if the noise is not known."""
        return self._detectable(detectable_diameters)

    def _detectable(self, compute: Callable[..., Any]) -> Any:
        if self.noise is None or self.is_complex or np.iscomplexobj(self.calibration.conductivity):
            return None
        usable = np.asarray(self.measurement.mask)[0] & np.asarray(self.reference.mask)[0]
        return compute(self.calibration.model, self.calibration.conductivity, self.noise, usable)

    @property
    def level(self) -> float:
        """Level at which an inclusion ends, as a share of its peak: 0.5, the middle of its blurred edge, in segmented
        images, otherwise the level of the settings."""
        return _RELATIVE_SEGMENTATION_THRESHOLD if self.settings.segment else self.settings.level

    @property
    def is_complex(self) -> bool:
        """Whether the image shows complex admittivity, computed from complex voltages."""
        return np.iscomplexobj(self.change)

    @property
    def iterative(self) -> bool:
        """Whether the image was computed by an iterative method, which solves for conductivity itself."""
        return isinstance(self.reconstruction, Reconstruction | ShapeReconstruction)

    @property
    def departure(self) -> Float[Array, " m"]:
        """Values per cell in which inclusions are found: the change of conductivity, or, for iterative images, the
        change of the natural logarithm of conductivity."""
        if not self.iterative:
            return self.change
        return as_array(np.log1p(np.asarray(self.change) / float(self.calibration.conductivity)))


def _model_of_reconstruction(reconstruction, calibration: Calibration) -> ForwardModel:
    """Forward model on the mesh of a reconstruction."""
    finer_mesh_image = reconstruction.finer if isinstance(reconstruction, ShapeReconstruction) else None
    return calibration.model if finer_mesh_image is None else finer_mesh_image.model


def image_difference(
    measurement: Measurement,
    reference: Measurement | None = None,
    settings: ImagingSettings | None = None,
    *,
    frame: int | str | None = None,
    progress: Callable[[str], None] | None = None,
) -> ImagedDifference:
    """Image the change between a reference frame and a frame of `measurement`.

    **Arguments:**

    - `measurement`: the frames, with protocol, electrodes and body.
    - `reference`: measurement of the undisturbed body, whose frames are averaged; None if `measurement` has a frame
      named "reference".
    - `settings`: default: `ImagingSettings()`.
    - `frame`: number (from 0) or name of the frame to image; default: the first.
    - `progress`: function called with the name of each step when the step begins.

    Raises `ValueError` for data that cannot be imaged (see `jeit.data.check_imageable`) or lack the positions of the
    electrodes, and for arguments of the wrong type, such as the path of a file.

    **Example:**

    ```python
    imaged = image_difference(pressed, rest, quick)
    imaged.inclusions[0].centroid
    ```
    """
    settings = as_settings(settings)
    clock = StepTimer(progress)
    prepared = prepare_difference(
        measurement,
        reference,
        frame=frame,
        contact=settings.contact,
        num_points=settings.num_points,
        as_is=settings.as_is,
        clock=clock,
    )
    calibration = prepared.calibration
    if prepared.mesh.dimension == 2 and settings.bodies != KINDS[0]:
        raise ValueError("bodies: ellipsoids and columns are of solids, and this is a sheet; leave it out.")
    # Threads of the BLAS wait for each other: if another program occupies a core, images of solids take four times as
    # long with them, and those of sheets ten times as long.
    with clock("image"), one_thread_of_blas():
        reason, shapes = "", None
        options = MethodOptions(settings.prior, settings.hyperparameter, settings.bodies, progress)
        if settings.method == AUTO:
            method, reason, (reconstruction, change), shapes = image_automatically(prepared, options, settings.segment)
            settings = replace(settings, method=method)
        else:
            reconstruction, change = METHODS[settings.method].image(prepared, options)
            shapes = reconstruction if isinstance(reconstruction, ShapeReconstruction) else None
        max_change = float(np.abs(change).max())
        if not max_change > 1e-9 * abs(complex(calibration.conductivity)):
            raise ValueError(
                f"'{prepared.measurement.name}': the image is empty, no change reaches a billionth of the background. "
                f"The hyperparameter {float(reconstruction.hyperparameter):.3g} leaves nothing of the data: give "
                "another, or a rule."
            )
        if isinstance(reconstruction, LinearReconstruction) and not np.iscomplexobj(change):
            prepared = estimate_unexplained_noise(prepared, reconstruction, change)
    with clock("raster and inclusions"):
        grid = Raster.create(_model_of_reconstruction(reconstruction, calibration).mesh, shape=settings.raster_shape)
        imaged = ImagedDifference(
            measurement=prepared.measurement,
            reference=prepared.reference,
            quality=prepared.quality,
            settings=replace(settings, contact=prepared.contact),
            calibration=calibration,
            reconstruction=reconstruction,
            change=change,
            raster=_sample_on_raster(grid, change),
            extent=grid.extent,
            inclusions=(),
            wiring=prepared.wiring,
            why=reason,
            unlike_electrodes=prepared.unlike_electrodes,
            shapes=shapes,
            timings=clock.seconds,
            frame=prepared.frame,
            num_frames=prepared.num_frames,
            electrode_change=prepared.electrode_change,
            noise=prepared.modelled_noise,
        )
        inclusions, labels = _inclusions(imaged, grid, prepared)
    return replace(imaged, inclusions=tuple(inclusions), labels=labels)


def _inclusions(
    imaged: ImagedDifference, grid: Raster, prepared: PreparedDifference
) -> tuple[list[Inclusion], UInt8[np.ndarray, "rows columns"] | None]:
    """Inclusions of an image, with the change of conductivity as their peak; and labels of the pixels, if requested.
    Inclusions of smooth images must exceed the noise of the image. Those of linear images are found in the image of the
    difference without a change common to all voltages."""
    settings, reconstruction, background = imaged.settings, imaged.reconstruction, imaged.calibration.conductivity
    if imaged.shapes is not None:
        bodies = imaged.shapes.bodies
        labels = _labels(imaged.mesh, bodies, grid) if settings.segment else None
        return [_body_inclusion(body, float(background)) for body in bodies], labels
    conductivity_change, noise = as_array(np.real(imaged.departure)), None
    if isinstance(reconstruction, Reconstruction) and reconstruction.inversion.penalty.is_standard_normal:
        noise = as_array(image_noise(reconstruction))
    elif isinstance(reconstruction, LinearReconstruction):
        conductivity_change, noise = change_and_noise(prepared, reconstruction, imaged.change)
    regions = inclusion_regions(
        imaged.mesh, conductivity_change, level=imaged.level, least_peak=settings.least_peak, noise=noise
    )
    inclusions = [_convert_peak(inclusion, background) if imaged.iterative else inclusion for inclusion, _ in regions]
    return inclusions, _region_labels(regions, grid) if settings.segment else None


def _body_inclusion(body: Star | Ellipsoid, background: float) -> Inclusion:
    """A fitted body as an inclusion, with the intervals of its properties if they were estimated."""
    centroid = tuple(body.centroid.tolist())
    if (quantities := body.quantities) is not None:
        return Inclusion(
            body.sign,
            centroid,
            quantities.measure,
            background * quantities.change,
            form=_solid_form(body),
            contrast_interval=quantities.change_interval,
            area_interval=quantities.measure_interval,
            strength=quantities.strength,
            strength_interval=quantities.strength_interval,
            centroid_radius=quantities.centroid_radius,
        )
    inclusion = Inclusion(body.sign, centroid, body.measure, body.sign * body.contrast, form=_solid_form(body))
    return _convert_peak(inclusion, background)


def _solid_form(body: Star | Ellipsoid) -> SolidForm | None:
    """Form of a body in a solid, for drawing; None for star shapes."""
    if isinstance(body, Star):
        return None
    axes = sorted(body.axes.tolist(), key=lambda axis: abs(axis[2])) if body.column else body.axes.tolist()
    return SolidForm(tuple(body.centre.tolist()), tuple(map(tuple, axes)), body.column)


def _region_labels(regions, grid: Raster) -> UInt8[np.ndarray, "rows columns"]:
    """Label the pixels in the regions of resistive and conductive inclusions."""
    cell = np.asarray(grid.cell)
    labels = np.zeros(cell.shape, np.uint8)
    for inclusion, region in regions:
        labels[(cell >= 0) & region[cell]] = CONDUCTIVE if inclusion.sign > 0 else RESISTIVE
    return labels


def _labels(mesh: Mesh, bodies: Sequence[Star | Ellipsoid], grid: Raster) -> UInt8[np.ndarray, "rows columns"]:
    """Label the pixels in resistive and conductive bodies, in a solid at half its height. Where bodies overlap, the
    first body of the list determines the label."""
    centres, is_inside = grid.pixel_centres(), np.asarray(grid.cell) >= 0
    if mesh.dimension == 3:
        z = np.asarray(mesh.points)[:, 2]
        centres = np.concatenate([centres, np.full((*is_inside.shape, 1), (z.min() + z.max()) / 2)], axis=-1)
    labels = np.zeros(is_inside.shape, np.uint8)
    for body in reversed(bodies):
        labels[is_inside & body.holds(centres)] = CONDUCTIVE if body.sign > 0 else RESISTIVE
    return labels


def _sample_on_raster(grid: Raster, change) -> Inexact[Array, "rows columns"]:
    """Sample an image on a raster, real and imaginary part separately for complex images."""
    if not np.iscomplexobj(change):
        return grid.sample(change)
    rasters = [np.asarray(grid.sample(as_array(values))) for values in (np.real(change), np.imag(change))]
    return as_array(rasters[0] + 1j * rasters[1])


def _convert_peak(inclusion: Inclusion, background) -> Inclusion:
    """Convert the peak of an inclusion from a change of log conductivity to a change of conductivity."""
    peak = float(background * np.expm1(inclusion.peak))
    return replace(inclusion, peak=peak)
