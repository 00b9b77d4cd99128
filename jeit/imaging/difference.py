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

_SEGMENTATION_LEVEL = 0.5
# Maximum misfit of an image's voltages, in standard deviations, that raises no doubt.
_MAX_UNDOUBTED_IMAGE_MISFIT = 3.0


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
      exceed the noise of the image. In linear images, inclusions are found after a change common to all voltages is
      removed. In iterative images, they are found in the logarithm of conductivity, which weights both signs equally;
      in complex images, in the real part.
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
        contrast_intervals = [inclusion.contrast_interval or (None, None) for inclusion in self.inclusions]
        change_ranges = [
            (background * lowest_contrast, background * highest_contrast)
            for lowest_contrast, highest_contrast in contrast_intervals
            if lowest_contrast is not None and highest_contrast is not None
        ]
        return tuple(change_ranges) if len(change_ranges) == len(contrast_intervals) else ()

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
        checked_data = self.measurement, self.reference, self.calibration, self.quality
        doubt_texts = doubts_of_data(*checked_data, self.electrode_change)
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
        if (image_misfit := float(reconstruction.misfit)) > _MAX_UNDOUBTED_IMAGE_MISFIT:
            doubt_texts.append(
                f"its voltages miss the data by {image_misfit:.2g} standard deviations: bodies may be missing, or "
                "shown where none are."
            )
        for body in reconstruction.alternatives if isinstance(reconstruction, ShapeReconstruction) else ():
            if body is not None:
                x, y = 1e3 * body.centroid[:2]
                body_kind = "a column through the whole height" if body.column else "no column but an ellipsoid"
                doubt_texts.append(
                    f"the body at x {x:.0f} mm, y {y:.0f} mm may as well be {body_kind}, of "
                    f"{np.exp(body.sign * body.contrast):.2g} times the background and {1e6 * body.volume:.3g} cm³: "
                    "these electrodes do not determine which. If you know, bodies (--bodies) says so."
                )
        return tuple(doubt_texts)

    @property
    def detectable_strength(self) -> Float[np.ndarray, " m"] | None:
        """Smallest strength with which a body in each cell (m,) of the calibrated model's mesh is detected, m² (3-D:
        m³), see `jeit.inverse.detectable_strength`; None for complex images, and if the noise is not known."""
        return self._detection_limits(detectable_strength)

    @property
    def detectable_diameters(self) -> DetectableDiameters | None:
        """Diameters of the smallest insulating bodies that are detected, see `jeit.inverse.detectable_diameters`; None
        for complex images, and if the noise is not known."""
        return self._detection_limits(detectable_diameters)

    def _detection_limits(self, compute_limits: Callable[..., Any]) -> Any:
        if self.noise is None or self.is_complex or np.iscomplexobj(self.calibration.conductivity):
            return None
        usable_channels = np.asarray(self.measurement.mask)[0] & np.asarray(self.reference.mask)[0]
        return compute_limits(self.calibration.model, self.calibration.conductivity, self.noise, usable_channels)

    @property
    def level(self) -> float:
        """Level at which an inclusion ends, as a share of its peak: 0.5, the middle of its blurred edge, in segmented
        images, otherwise the level of the settings."""
        return _SEGMENTATION_LEVEL if self.settings.segment else self.settings.level

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
    image_on_finer_mesh = reconstruction.finer if isinstance(reconstruction, ShapeReconstruction) else None
    return calibration.model if image_on_finer_mesh is None else image_on_finer_mesh.model


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
    step_timer = StepTimer(progress)
    prepared = prepare_difference(
        measurement,
        reference,
        frame=frame,
        contact=settings.contact,
        num_points=settings.num_points,
        as_is=settings.as_is,
        clock=step_timer,
    )
    calibration = prepared.calibration
    if prepared.mesh.dimension == 2 and settings.bodies != KINDS[0]:
        raise ValueError("bodies: ellipsoids and columns are of solids, and this is a sheet; leave it out.")
    # Imaging uses one thread of the BLAS, because several threads wait for each other: if another program occupies a
    # core, images of solids take four times and images of sheets ten times as long with several threads.
    with step_timer("image"), one_thread_of_blas():
        method_reason, fitted_shapes = "", None
        method_options = MethodOptions(settings.prior, settings.hyperparameter, settings.bodies, progress)
        if settings.method == AUTO:
            method_name, method_reason, (reconstruction, conductivity_change), fitted_shapes = image_automatically(
                prepared, method_options, settings.segment
            )
            settings = replace(settings, method=method_name)
        else:
            reconstruction, conductivity_change = METHODS[settings.method].image(prepared, method_options)
            fitted_shapes = reconstruction if isinstance(reconstruction, ShapeReconstruction) else None
        max_conductivity_change = float(np.abs(conductivity_change).max())
        if not max_conductivity_change > 1e-9 * abs(complex(calibration.conductivity)):
            raise ValueError(
                f"'{prepared.measurement.name}': the image is empty, no change reaches a billionth of the background. "
                f"The hyperparameter {float(reconstruction.hyperparameter):.3g} leaves nothing of the data: give "
                "another, or a rule."
            )
        if isinstance(reconstruction, LinearReconstruction) and not np.iscomplexobj(conductivity_change):
            prepared = estimate_unexplained_noise(prepared, reconstruction, conductivity_change)
    with step_timer("raster and inclusions"):
        raster = Raster.create(_model_of_reconstruction(reconstruction, calibration).mesh, shape=settings.raster_shape)
        imaged = ImagedDifference(
            measurement=prepared.measurement,
            reference=prepared.reference,
            quality=prepared.quality,
            settings=replace(settings, contact=prepared.contact),
            calibration=calibration,
            reconstruction=reconstruction,
            change=conductivity_change,
            raster=_sample_on_raster(raster, conductivity_change),
            extent=raster.extent,
            inclusions=(),
            wiring=prepared.wiring,
            why=method_reason,
            unlike_electrodes=prepared.unlike_electrodes,
            shapes=fitted_shapes,
            timings=step_timer.seconds,
            frame=prepared.frame,
            num_frames=prepared.num_frames,
            electrode_change=prepared.electrode_change,
            noise=prepared.modelled_noise,
        )
        inclusions, pixel_labels = _inclusions_and_labels(imaged, raster, prepared)
    return replace(imaged, inclusions=tuple(inclusions), labels=pixel_labels)


def _inclusions_and_labels(
    imaged: ImagedDifference, raster: Raster, prepared: PreparedDifference
) -> tuple[list[Inclusion], UInt8[np.ndarray, "rows columns"] | None]:
    """Find the inclusions of an image, with the change of conductivity as their peak, and label the pixels if
    requested. Inclusions of smooth images must exceed the noise of the image. Inclusions of linear images are found in
    the image of the difference without a change common to all voltages."""
    settings, reconstruction, background = imaged.settings, imaged.reconstruction, imaged.calibration.conductivity
    if imaged.shapes is not None:
        fitted_bodies = imaged.shapes.bodies
        pixel_labels = _label_body_pixels(imaged.mesh, fitted_bodies, raster) if settings.segment else None
        return [_inclusion_of_body(body, float(background)) for body in fitted_bodies], pixel_labels
    conductivity_change, noise_per_cell = as_array(np.real(imaged.departure)), None
    if isinstance(reconstruction, Reconstruction) and reconstruction.inversion.penalty.is_standard_normal:
        noise_per_cell = as_array(image_noise(reconstruction))
    elif isinstance(reconstruction, LinearReconstruction):
        conductivity_change, noise_per_cell = change_and_noise(prepared, reconstruction, imaged.change)
    inclusions_with_regions = inclusion_regions(
        imaged.mesh, conductivity_change, level=imaged.level, least_peak=settings.least_peak, noise=noise_per_cell
    )
    inclusions = [
        _peak_from_logarithm(inclusion, background) if imaged.iterative else inclusion
        for inclusion, _ in inclusions_with_regions
    ]
    return inclusions, _label_region_pixels(inclusions_with_regions, raster) if settings.segment else None


def _inclusion_of_body(body: Star | Ellipsoid, background: float) -> Inclusion:
    """Convert a fitted body to an inclusion, with the credible intervals of its properties if they were estimated."""
    centroid = tuple(body.centroid.tolist())
    if (body_quantities := body.quantities) is not None:
        return Inclusion(
            body.sign,
            centroid,
            body_quantities.measure,
            background * body_quantities.change,
            form=_solid_form(body),
            contrast_interval=body_quantities.change_interval,
            area_interval=body_quantities.measure_interval,
            strength=body_quantities.strength,
            strength_interval=body_quantities.strength_interval,
            centroid_radius=body_quantities.centroid_radius,
        )
    inclusion = Inclusion(body.sign, centroid, body.measure, body.sign * body.contrast, form=_solid_form(body))
    return _peak_from_logarithm(inclusion, background)


def _solid_form(body: Star | Ellipsoid) -> SolidForm | None:
    """Return the form of a body in a solid, for drawing; None for star shapes."""
    if isinstance(body, Star):
        return None
    semi_axes = sorted(body.axes.tolist(), key=lambda axis: abs(axis[2])) if body.column else body.axes.tolist()
    return SolidForm(tuple(body.centre.tolist()), tuple(map(tuple, semi_axes)), body.column)


def _label_region_pixels(inclusions_with_regions, raster: Raster) -> UInt8[np.ndarray, "rows columns"]:
    """Label the pixels in the regions of resistive and conductive inclusions."""
    cell_of_pixel = np.asarray(raster.cell)
    pixel_labels = np.zeros(cell_of_pixel.shape, np.uint8)
    for inclusion, region_cells in inclusions_with_regions:
        pixel_labels[(cell_of_pixel >= 0) & region_cells[cell_of_pixel]] = (
            CONDUCTIVE if inclusion.sign > 0 else RESISTIVE
        )
    return pixel_labels


def _label_body_pixels(
    mesh: Mesh, fitted_bodies: Sequence[Star | Ellipsoid], raster: Raster
) -> UInt8[np.ndarray, "rows columns"]:
    """Label the pixels in resistive and conductive bodies. In a solid, the section at half its height is labelled.
    Where bodies overlap, the first body of the list determines the label."""
    pixel_centres, is_inside = raster.pixel_centres(), np.asarray(raster.cell) >= 0
    if mesh.dimension == 3:
        node_heights = np.asarray(mesh.points)[:, 2]
        pixel_centres = np.concatenate(
            [pixel_centres, np.full((*is_inside.shape, 1), (node_heights.min() + node_heights.max()) / 2)], axis=-1
        )
    pixel_labels = np.zeros(is_inside.shape, np.uint8)
    for body in reversed(fitted_bodies):
        pixel_labels[is_inside & body.holds(pixel_centres)] = CONDUCTIVE if body.sign > 0 else RESISTIVE
    return pixel_labels


def _sample_on_raster(raster: Raster, conductivity_change) -> Inexact[Array, "rows columns"]:
    """Sample an image on a raster, real and imaginary part separately for complex images."""
    if not np.iscomplexobj(conductivity_change):
        return raster.sample(conductivity_change)
    sampled_parts = [
        np.asarray(raster.sample(as_array(part_per_cell)))
        for part_per_cell in (np.real(conductivity_change), np.imag(conductivity_change))
    ]
    return as_array(sampled_parts[0] + 1j * sampled_parts[1])


def _peak_from_logarithm(inclusion: Inclusion, background_conductivity) -> Inclusion:
    """Convert the peak of an inclusion from a change of log conductivity to a change of conductivity."""
    conductivity_peak = float(background_conductivity * np.expm1(inclusion.peak))
    return replace(inclusion, peak=conductivity_peak)
