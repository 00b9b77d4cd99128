"""Preparation of two frames for imaging: checks, mesh, model and calibration, with progress and timing."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Array, Bool, Float

from jeit.arguments import check_kind
from jeit.data import Measurement
from jeit.data.frame_checks import FrameQuality, assess, check_same_setup, rounding_of_difference
from jeit.data.screening import mask_spikes
from jeit.data.transfer import converted_to_protocol
from jeit.electrodes import AbstractElectrodes
from jeit.forward import ForwardModel
from jeit.imaging.calibration import StepTimer, calibrated_model, described_model, estimated_positions, relative_misfit
from jeit.imaging.doubts import doubts_of_data
from jeit.imaging.electrode_changes import ElectrodeChange, ElectrodeChanges
from jeit.imaging.wiring import Wiring, check_wiring, exchanges_message, find_wiring
from jeit.inverse import relative_noise
from jeit.inverse.calibration import Calibration
from jeit.inverse.channels import electrode_misfits
from jeit.inverse.placement import Uncertainty
from jeit.inverse.shapes.quantities import Accuracy
from jeit.mesh import Body, Mesh
from jeit_solvers.engines import as_array


def selected_frame_number(measurement: Measurement, frame: int | str | None = None) -> int:
    """Number, from 0, of the frame to image, which is specified by number or name; default: the first frame that is not
    named "reference". Raises `ValueError` for a frame that does not exist."""
    if frame is not None:
        return measurement.frame_number(frame)
    return int(measurement.num_frames > 1 and measurement.frame_names[:1] == ("reference",))


@contextmanager
def naming_frame_in_errors(measurement: Measurement, number: int) -> Iterator[None]:
    """Context manager that adds the frame number to a `ValueError` that names the measurement, if the measurement has
    several frames. A reference may have the same name."""
    try:
        yield
    except ValueError as error:
        quoted_name = f"'{measurement.name}'"
        name_pattern = re.compile(f"(?<!reference ){re.escape(quoted_name)}")
        if measurement.num_frames < 2 or not name_pattern.search(str(error)):
            raise
        raise ValueError(name_pattern.sub(lambda _: f"{quoted_name}, frame {number}", str(error), count=1)) from error


# Minimum share of a voltage difference that is assumed to remain unexplained by any model.
_MIN_UNEXPLAINED_SHARE = 0.03
# Factor by which the unexplained share of the voltage difference is larger for images with sharp outlines.
_SHARP_OUTLINE_FACTOR = 3.0
# Relative standard deviation, due to the discretisation, of the strengths of fitted bodies in a sheet and in a solid:
# the cells of a solid are coarse relative to the bodies. Estimated on 23 bodies in simulated boxes and cylinders.
_DISCRETISATION_ERROR = {2: 0.0, 3: 0.03}
# Misfit of an electrode, relative to that of the other electrodes, above which the electrode counts as unlike the
# others. In sound tanks the ratio was at most 2.6.
_MIN_UNLIKE_ELECTRODE_MISFIT = 3.0


@dataclass(frozen=True)
class PreparedDifference:
    """A difference of two frames, ready to be imaged.

    **Fields**

    - `measurement`, `reference`: the two frames compared, one frame each.
    - `quality`: the quality of the data.
    - `domain`: the body.
    - `contact`: calibration of the contact impedance: "each", "common" or "fixed".
    - `wiring`: the estimated connection of electrodes and channels.
    - `calibration`: the forward model fitted to the reference, with its mesh.
    - `difference`: difference of the voltages (M,) in volts, zero in masked channels, without the part due to the
      `electrode_change`.
    - `mask`: (M,), True for channels that are usable in both frames.
    - `electrode_change`: the change of the electrodes, if it explains much of the measured difference.
    - `frame`: number of the frame in its file, from 0; `num_frames`: number of frames in the file.

    **Example:**

    ```python
    prepared = prepare_difference(pressed, rest, num_points=200)
    prepared.calibration, prepared.noise
    ```
    """

    measurement: Measurement
    reference: Measurement
    quality: FrameQuality
    domain: Body
    contact: str
    wiring: Wiring
    calibration: Calibration
    difference: Float[Array, " M"]
    mask: Bool[Array, " M"]
    frame: int = 0
    num_frames: int = 1
    electrode_change: ElectrodeChange | None = None

    @property
    def model(self) -> ForwardModel:
        """Calibrated forward model."""
        return self.calibration.model

    @property
    def mesh(self) -> Mesh:
        """Mesh of the calibrated model, on which images are computed."""
        return self.calibration.model.mesh

    @property
    def doubts(self) -> tuple[str, ...]:
        """Reasons to doubt the data, in sentences: too few channels, noise, an implausible background, exchanged
        frames."""
        checked_data = self.measurement, self.reference, self.calibration, self.quality
        return tuple(doubts_of_data(*checked_data, self.electrode_change))

    @property
    def uncertainty(self) -> Uncertainty:
        """Standard deviations of the described positions, sizes and contacts of the sensor."""
        return self.reference.uncertainty or Uncertainty()

    @property
    def relative_noise(self) -> Float[Array, " M"]:
        """Noise of the channels up to a common factor, volts: `jeit.inverse.relative_noise` of the reference. For
        channels that measure on `unlike_electrodes`, the noise is multiplied by the relative misfit of the
        electrode."""
        noise = relative_noise(np.asarray(self.reference.voltages)[0], self.mask)
        is_measuring_electrode = np.asarray(self.model.protocol.channel_measurement) != 0
        return as_array(noise * np.max(np.where(is_measuring_electrode, self._electrode_noise_factors, 1), axis=1))

    @property
    def unlike_electrodes(self) -> dict[int, float]:
        """Electrodes, numbered from 0, whose channels in the reference the model fits far worse than those of the other
        electrodes. Each electrode is listed with its misfit, divided by the median misfit of all electrodes. Such
        electrodes may be loose or displaced, or their gain may differ. Channels that measure on these electrodes have
        less weight."""
        return {
            int(electrode): float(self._electrode_noise_factors[electrode])
            for electrode in np.flatnonzero(self._electrode_noise_factors > 1)
        }

    @functools.cached_property
    def _electrode_noise_factors(self) -> Float[np.ndarray, " L"]:
        """Relative misfit (L,) of each unlike electrode, by which the noise of its channels is multiplied; 1 for all
        other electrodes."""
        reference_voltages = np.asarray(self.reference.voltages)[0]
        reference_residual = np.asarray(self.calibration.voltages) - reference_voltages
        relative_misfits = electrode_misfits(
            self.model.protocol, reference_residual, relative_noise(reference_voltages, self.mask), self.mask
        )
        return np.where(relative_misfits > _MIN_UNLIKE_ELECTRODE_MISFIT, relative_misfits, 1)

    @property
    def noise(self) -> float | None:
        """Estimated standard deviation of the noise of the voltage difference, including rounding, in units of
        `relative_noise`; None if the noise is not known."""
        if self.quality.trusted_noise is None:
            return None
        relative_rounding = np.asarray(self._rounding_deviation)[self.mask] / np.asarray(self.relative_noise)[self.mask]
        return float(np.hypot(self.quality.trusted_noise, np.sqrt(np.mean(relative_rounding**2))))

    @property
    def modelled_noise(self) -> Float[Array, " M"]:
        """Expected deviation of the measured voltage difference from the modelled one, volts: the root of the sum of
        squares of the noise of the difference, rounding and the model error. The model error is the root mean square of
        the difference times the relative misfit of the reference (at least 3 %).

        If the noise is not known, 0.1 of the difference is used as noise, at most 1 in units of `relative_noise`.
        """
        return self._noise_with_error_share(max(self._reference_misfit, _MIN_UNEXPLAINED_SHARE))

    @property
    def sharp_noise(self) -> Float[Array, " M"]:
        """`modelled_noise` for bodies with sharp outlines, volts. The model error in it is three times larger, since
        bodies with sharp outlines, unlike smooth images, cannot adapt to model errors."""
        return self._noise_with_error_share(_SHARP_OUTLINE_FACTOR * max(self._reference_misfit, _MIN_UNEXPLAINED_SHARE))

    @property
    def common_change(self) -> Float[np.ndarray, " M"]:
        """The part of `difference` (M,), volts, that is a factor common to all voltages, as of a bath that has become
        warmer or of a gain that has drifted; 0 if this part is not most of the difference."""
        return self.quality.common_factor * np.where(self.mask, np.asarray(self.reference.voltages)[0], 0)

    def with_noise_from(self, misfit: float, noise_share: float | None = None) -> PreparedDifference:
        """Copy of the difference with a noise estimated from the `misfit` of an image, in units of `modelled_noise`, if
        the noise is not known and the misfit exceeds 1. `noise_share`: see `FrameQuality`; default: from the misfit."""
        if self.noise is not None or misfit <= 1:
            return self
        relative_noise, usable_channels = np.asarray(self.relative_noise), np.asarray(self.mask)
        unexplained_noise = misfit * np.sqrt(
            np.mean((np.asarray(self.modelled_noise) / relative_noise)[usable_channels] ** 2)
        )
        change_without_common = np.asarray(self.difference) - self.common_change
        difference_rms = float(np.sqrt(np.mean(np.abs(change_without_common / relative_noise)[usable_channels] ** 2)))
        updated_quality = replace(
            self.quality,
            trusted_noise=float(unexplained_noise),
            noise_share=min(1.0, float(unexplained_noise) / difference_rms if noise_share is None else noise_share),
            noise_source="what the image leaves unexplained",
        )
        return replace(self, quality=updated_quality)

    @functools.cached_property
    def electrode_changes(self) -> ElectrodeChanges | None:
        """Estimator of changes of electrodes on the edge of a sheet; None for other electrodes and complex voltages."""
        if np.iscomplexobj(self.difference):
            return None
        channel_noise, background_conductivity = np.asarray(self.relative_noise), float(self.calibration.conductivity)
        return ElectrodeChanges.on_edge(self.model, background_conductivity, channel_noise, np.asarray(self.mask))

    def without_electrode_change(self) -> PreparedDifference:
        """Copy of the difference without the part that a change of the electrodes explains, if that is a large part."""
        estimator, difference = self.electrode_changes, np.asarray(self.difference)
        if estimator is None or (change := estimator.find(difference)) is None:
            return self
        remaining_difference = as_array(difference - change.voltages)
        remaining_quality = self.quality.of_rest(change.rest)
        return replace(self, difference=remaining_difference, quality=remaining_quality, electrode_change=change)

    @functools.cached_property
    def accuracy(self) -> Accuracy:
        """Errors of the voltage difference, from which the intervals of fitted bodies are computed.

        The errors of the voltages are noise, the unknown part of electrode positions and contacts, and a share of the
        difference that equals the misfit of the reference, at least 2 %. The error common to the strengths of all
        bodies combines the part of this misfit that noise does not explain and, in a solid, the discretisation error.
        """
        model_error = self.calibration.model_error
        if model_error is None:  # the described positions are uncertain even if they explain the reference
            reference_voltages = np.asarray(self.reference.voltages)[0]
            position_deviation = self.uncertainty.position_on(self.mesh)
            placement = estimated_positions(self.model, reference_voltages, self.mask, position_deviation)
            model_error = placement and placement.error
        uncertainty = self.uncertainty
        model_error = model_error and model_error._replace(drift=uncertainty.drift)
        error_share = max(self._reference_misfit, uncertainty.other)
        strength_error = float(np.hypot(self._field_error, _DISCRETISATION_ERROR[self.mesh.dimension]))
        # How far electrodes move does not depend on how well their positions in the reference are known.
        shift_deviation = Uncertainty().position_on(self.mesh)
        return Accuracy(
            self._noise_with_error_share(error_share), model_error, uncertainty.size, strength_error, shift_deviation
        )

    @property
    def modelled_share(self) -> float:
        """Share of the variance of `sharp_noise` that is due to the model error, from 0 to 1; 1 if the noise is not
        known."""
        sharp_to_smooth_noise_ratios = (
            np.asarray(self.sharp_noise)[self.mask] / np.asarray(self.relative_noise)[self.mask]
        )
        return 1 - (0 if self.noise is None else self.noise**2 / float(np.mean(sharp_to_smooth_noise_ratios**2)))

    def _noise_with_error_share(self, error_share: float) -> Float[Array, " M"]:
        """Root of the sum of squares of noise, rounding, and a share of the measured difference,
        volts."""
        relative_noise, usable_channels = np.asarray(self.relative_noise), np.asarray(self.mask)
        electrode_change = self.electrode_change
        change_due_to_electrodes, change_error_share = (
            (np.zeros(len(usable_channels)), 0.0)
            if electrode_change is None
            else (electrode_change.voltages, electrode_change.relative_error)
        )
        difference_rms, electrode_change_rms = (
            np.sqrt(np.mean(np.abs(voltages[usable_channels] / relative_noise[usable_channels]) ** 2))
            for voltages in (np.asarray(self.difference) + change_due_to_electrodes, change_due_to_electrodes)
        )
        noise_level = min(1.0, 0.1 * difference_rms) if self.noise is None else self.quality.trusted_noise
        error_level = np.hypot(error_share * difference_rms, change_error_share * electrode_change_rms)
        return as_array(np.hypot(relative_noise * np.hypot(noise_level, error_level), self._rounding_deviation))

    @functools.cached_property
    def _reference_misfit(self) -> float:
        """Relative misfit of the model to the reference, with equally weighted channels or with channels weighted by
        their noise, whichever misfit is smaller."""
        voltages_and_mask = np.asarray(self.reference.voltages)[0], np.asarray(self.reference.mask)[0]
        return min(float(self.calibration.misfit), relative_misfit(self.calibration.voltages, *voltages_and_mask))

    @property
    def _field_error(self) -> float:
        """Relative error of the model's fields: the part of the misfit of the reference that noise does not explain."""
        reference_voltages, usable_channels = np.asarray(self.reference.voltages)[0], np.asarray(self.mask)
        reference_rms = np.sqrt(
            np.mean(np.abs(reference_voltages[usable_channels] / np.asarray(self.relative_noise)[usable_channels]) ** 2)
        )
        noise_share = 0.0 if self.noise is None else self.noise / np.sqrt(2) / reference_rms
        return float(np.sqrt(max(self._reference_misfit**2 - noise_share**2, 0.0)))

    @functools.cached_property
    def _rounding_deviation(self) -> Float[np.ndarray, " M"]:
        """Standard deviation of the rounding of the difference, volts."""
        return rounding_of_difference(self.measurement, self.reference)


def prepare_difference(
    measurement: Measurement,
    reference: Measurement | None = None,
    *,
    frame: int | str | None = None,
    contact: str | None = None,
    num_points: int | None = None,
    as_is: bool = False,
    clock: StepTimer | None = None,
) -> PreparedDifference:
    """Check a frame and its reference, mask spikes, build a mesh, and calibrate a model of the body on the reference.

    **Arguments:**

    - `measurement`, `reference`, `frame`: as in `image_difference`.
    - `contact`, `num_points`: as in `ImagingSettings`.
    - `as_is`: image even if the wiring seems to differ from its description, and leave spikes and the effects of moved
      electrodes in place.
    - `clock`: timer that measures the duration of each step.

    Raises `ValueError` for data that cannot be imaged (see `jeit.data.check_imageable`) or lack the positions of the
    electrodes, if the calibration fails, and, unless `as_is`, if the wiring differs from its description or from that
    of the reference (see `jeit.imaging.wiring`).

    **Example:**

    ```python
    prepared = prepare_difference(pressed, rest, num_points=200)
    ```
    """
    clock = StepTimer(None) if clock is None else clock
    imaged_frame, reference_frame = select_frames(measurement, reference, frame)
    frame_number = selected_frame_number(measurement, frame)
    with clock("check"), naming_frame_in_errors(measurement, frame_number):
        check_same_setup(imaged_frame, reference_frame)
        if not as_is:
            imaged_frame = mask_spikes(imaged_frame, reference_frame)
            reference_frame = replace(
                reference_frame, mask=as_array(np.asarray(reference_frame.mask) & np.asarray(imaged_frame.mask))
            )
        (quality,) = assess(imaged_frame, reference_frame)
        domain, electrodes = body_of(imaged_frame, reference_frame)
        reference_frame = (
            reference_frame
            if imaged_frame.uncertainty is None
            else replace(reference_frame, uncertainty=imaged_frame.uncertainty)
        )
        usable_channels = np.asarray(imaged_frame.mask)[0] & np.asarray(reference_frame.mask)[0]
        voltage_difference = as_array(
            np.where(usable_channels, np.asarray(imaged_frame.voltages)[0] - np.asarray(reference_frame.voltages)[0], 0)
        )
        if not as_is and (exchange_message := exchanges_message(imaged_frame, reference_frame)):
            raise ValueError(f"'{imaged_frame.name}' does not fit its reference: {exchange_message}")
    with clock("mesh"):
        model = described_model(domain, electrodes, reference_frame.protocol, num_points)
    with clock("wiring"):
        wiring = find_wiring(model, reference_frame)
        # For data that cannot be imaged, a wiring error is reported only if a different wiring explains the data: pure
        # noise fits no wiring.
        if wiring.explanation or quality.imageable:
            check_wiring(wiring, reference_frame, as_is)
        if not quality.imageable:
            with naming_frame_in_errors(measurement, frame_number):
                raise ValueError(f"'{imaged_frame.name}' cannot be imaged: {quality.reason}")
    calibration, contact_method = calibrated_model(model, reference_frame, contact=contact, clock=clock)
    prepared = PreparedDifference(
        imaged_frame,
        reference_frame,
        quality,
        domain,
        contact_method,
        wiring,
        calibration,
        voltage_difference,
        usable_channels,
        frame_number,
        measurement.num_frames,
    )
    return prepared if as_is else prepared.without_electrode_change()


def select_frames(
    measurement: Measurement, reference: Measurement | None = None, frame: int | str | None = None
) -> tuple[Measurement, Measurement]:
    """Select the frame to image and its reference, one frame each.

    A frame named "reference" in `measurement` is imaged only if requested, and serves as reference if `reference` is
    None. A reference measured with other currents is converted to the currents of the measurement if it determines the
    voltages for these currents (see `jeit.data.driven_by`); its notes record the conversion.

    **Arguments:**

    - `measurement`, `reference`, `frame`: as in `image_difference`.

    Raises `ValueError` if there is no reference or no such frame, and for arguments that are not measurements.

    **Example:**

    ```python
    frame, undisturbed = select_frames(pressed, rest)
    ```
    """
    check_measurement("measurement", measurement)
    if reference is not None:
        check_measurement("reference", reference)
    if reference is None:
        _, reference = measurement.split_reference()
    if "reference" in reference.frame_names and reference.num_frames > 1:
        _, reference = reference.split_reference()
    imaged_frame = measurement.frame(selected_frame_number(measurement, frame))
    return imaged_frame, converted_to_protocol(reference.mean_frame(), imaged_frame)


def check_measurement(name: str, given: Measurement) -> None:
    """Raise `ValueError` if the argument `name` is not a `Measurement` but, for example, a path."""
    check_kind(name, given, Measurement, "a Measurement, as of jeit.read(path)")


def check_real(measurement: Measurement) -> None:
    """Raise `ValueError` if voltages are complex, in functions that, unlike `image_difference`, require real
    voltages."""
    if np.iscomplexobj(measurement.voltages):
        raise ValueError(
            f"'{measurement.name}' is complex; choose the part to image with [data] component in its description: "
            "real, imaginary or magnitude."
        )


def body_of(measurement: Measurement, reference: Measurement) -> tuple[Body, AbstractElectrodes]:
    """Body and electrodes of a measurement, or else of its reference. Raises `ValueError` if neither measurement has
    them, and if electrode positions are as uncertain as the body is wide."""
    domain = measurement.domain if measurement.domain is not None else reference.domain
    electrodes = measurement.electrodes if measurement.electrodes is not None else reference.electrodes
    if domain is None or electrodes is None:
        missing_table = "[geometry]" if domain is None else "[electrodes]"
        raise ValueError(
            f"'{measurement.name}' does not say what it was measured on: give a description with {missing_table} "
            "(a TOML file beside the data, or description=)."
        )
    position_deviation = (measurement.uncertainty or reference.uncertainty or Uncertainty()).position
    x_min, x_max, y_min, y_max = domain.extent
    if position_deviation is not None and position_deviation >= (body_width := max(x_max - x_min, y_max - y_min)):
        raise ValueError(
            f"'{measurement.name}': [uncertainty] position is {position_deviation:.3g} m, and the body is "
            f"{body_width:.3g} m wide; give the standard deviation of the electrodes' positions, in metres."
        )
    return domain, electrodes
