"""Reasons to doubt the data of a difference image, in sentences: few usable voltages, an implausible level of the
voltages, lengths in another unit, exchanged frames."""

from __future__ import annotations

import numpy as np

from jeit.arguments import percent
from jeit.data import Measurement
from jeit.data.frame_checks import FrameQuality
from jeit.electrodes import BoundaryElectrodes
from jeit.imaging.electrode_changes import ElectrodeChange
from jeit.inverse.calibration import Calibration
from jeit.mesh import Domain

# Minimum width of electrodes, relative to their spacing, that raises no doubt; misfit of the reference above which
# frame and reference may be exchanged; and ratio of the misfit of the frame to the misfit of the reference below which
# an exchange is likely. Both misfits are computed with the scale factor that fits the voltages best.
_MIN_RELATIVE_WIDTH, _MIN_SUSPICIOUS_REFERENCE_MISFIT, _MAX_EXCHANGED_MISFIT_RATIO = 0.005, 0.1, 0.7
# Minimum share of usable voltages that raises no doubt.
_MIN_USABLE_VOLTAGE_SHARE = 0.5
# Ranges of plausible conductivities: of sheets in S, from a megohm a square to metal; of solids in S/m, from tap water
# and fat to brine, with a margin on both sides.
_PLAUSIBLE_CONDUCTIVITY_RANGES = {2: (1e-6, 1e5), 3: (1e-3, 30.0)}
# Voltage above the range of an EIT instrument's amplifiers.
_MAX_AMPLIFIER_VOLTAGE = 60.0
# Units smaller than a volt, with their number per volt.
_SMALLER_VOLTAGE_UNITS = (("mV", 1e3), ("uV", 1e6))


def doubts_of_data(
    measurement: Measurement,
    reference: Measurement,
    calibration: Calibration,
    quality: FrameQuality | None = None,
    electrode_change: ElectrodeChange | None = None,
) -> list[str]:
    """Reasons to doubt the data: few usable voltages, an implausible level of the voltages, implausible lengths, a
    frame that may be the reference, an `electrode_change`, or, with the frame's `quality`, noise."""
    usable_channels, doubt_texts = np.asarray(measurement.mask)[0], []
    if (usable_channel_share := np.mean(usable_channels)) < _MIN_USABLE_VOLTAGE_SHARE:
        doubt_texts.append(
            f"only {usable_channels.sum()} of {usable_channels.size} voltages are left "
            f"({percent(float(usable_channel_share))}): they determine little of what is where."
        )
    unit_doubt, length_doubt = _doubt_of_units(measurement, reference, calibration), _doubt_of_lengths(measurement)
    order_doubt = _doubt_of_order(measurement, reference, calibration)
    movement_doubt = "" if electrode_change is None else electrode_change.doubt
    noise_doubt = "" if quality is None else quality.doubt
    return [*doubt_texts, *filter(None, (unit_doubt, length_doubt, order_doubt, movement_doubt, noise_doubt))]


def _doubt_of_lengths(measurement: Measurement) -> str:
    """Return a sentence if electrodes on the edge of a sheet are so narrow that lengths may not be in metres; otherwise
    an empty string."""
    electrodes, domain = measurement.electrodes, measurement.domain
    if not isinstance(electrodes, BoundaryElectrodes) or not isinstance(domain, Domain):
        return ""
    electrode_width, electrode_pitch = float(np.max(electrodes.width)), domain.perimeter / electrodes.num_electrodes
    if electrode_width > _MIN_RELATIVE_WIDTH * electrode_pitch:
        return ""
    x_min, x_max, _, _ = domain.extent
    return (
        f"the electrodes are {1e3 * electrode_width:.3g} mm wide and {1e3 * electrode_pitch:.3g} mm apart, on a body "
        f"{x_max - x_min:.3g} m wide: are all lengths in metres?"
    )


def _doubt_of_order(measurement: Measurement, reference: Measurement, calibration: Calibration) -> str:
    """Return a sentence if the frame fits an undisturbed body much better than the reference does; otherwise an empty
    string."""
    usable_channels = np.asarray(measurement.mask)[0] & np.asarray(reference.mask)[0]
    if not (float(calibration.misfit) > _MIN_SUSPICIOUS_REFERENCE_MISFIT and usable_channels.any()):
        return ""
    predicted_voltages = np.asarray(calibration.voltages)[usable_channels]

    def misfit_of_frame(frame: Measurement) -> float:
        measured_voltages = np.asarray(frame.voltages)[0][usable_channels]
        scale_factor = np.vdot(predicted_voltages, measured_voltages) / np.vdot(predicted_voltages, predicted_voltages)
        return float(
            np.linalg.norm(measured_voltages - scale_factor * predicted_voltages) / np.linalg.norm(measured_voltages)
        )

    reference_misfit = misfit_of_frame(reference)
    if reference_misfit <= _MIN_SUSPICIOUS_REFERENCE_MISFIT:
        return ""
    frame_misfit = misfit_of_frame(measurement)
    if frame_misfit > _MAX_EXCHANGED_MISFIT_RATIO * reference_misfit:
        return ""
    return (
        f"the frame fits an undisturbed body better ({percent(frame_misfit)} misfit) than the reference does "
        f"({percent(reference_misfit)}): are the two exchanged?"
    )


def _doubt_of_units(measurement: Measurement, reference: Measurement, calibration: Calibration) -> str:
    """Return a sentence that suggests a unit if the level of the voltages is implausible. Returns an empty string
    otherwise, and if notes of the measurement or its reference say that the scale is not known."""
    min_conductivity, max_conductivity = _PLAUSIBLE_CONDUCTIVITY_RANGES[calibration.model.mesh.dimension]
    background_conductivity = abs(complex(calibration.conductivity))
    voltage_magnitudes = [
        np.abs(np.asarray(frame.voltages)[np.asarray(frame.mask)]) for frame in (measurement, reference)
    ]
    max_voltage = max(float(frame_voltages.max(initial=0)) for frame_voltages in voltage_magnitudes)
    is_scale_unknown = any("trust relative changes" in note for note in (*measurement.notes, *reference.notes))
    if is_scale_unknown or (
        min_conductivity < background_conductivity < max_conductivity and max_voltage < _MAX_AMPLIFIER_VOLTAGE
    ):
        return ""
    is_solid = calibration.model.mesh.dimension == 3
    conductivity_unit, comparison_text = (
        ("S/m", "no water's, gel's or tissue's") if is_solid else ("S", "no sheet's or shallow tank's")
    )
    if not min_conductivity < background_conductivity < max_conductivity:
        fault_text = (
            f"a background of {background_conductivity:.3g} {conductivity_unit} is {comparison_text}, which conduct "
            f"{min_conductivity:g} to {max_conductivity:g} {conductivity_unit}"
        )
    else:
        fault_text = f"voltages of up to {max_voltage:.3g} V are beyond what instruments read"
    if background_conductivity < max_conductivity:
        suggestions = [
            f'"{unit_name}" (a background of {background_conductivity * unit_factor:.3g} {conductivity_unit})'
            for unit_name, unit_factor in _SMALLER_VOLTAGE_UNITS
            if min_conductivity < background_conductivity * unit_factor < max_conductivity
            and max_voltage < _MAX_AMPLIFIER_VOLTAGE * unit_factor
        ]
        description_key = "[data] unit"
    else:
        suggestions = [
            f'"{unit_name}"'
            for unit_name, unit_factor in (("mA", 1e3), ("uA", 1e6))
            if min_conductivity < background_conductivity / unit_factor < max_conductivity
        ]
        description_key = "[protocol] current_unit"
    suggestions = [f"{description_key} = {' or '.join(suggestions)}?"] if suggestions else []
    if (
        all((frame_voltages == np.round(frame_voltages)).all() for frame_voltages in voltage_magnitudes)
        and max_voltage > 1
    ):
        suggestions.append(
            "They are whole numbers, as the counts of a converter are: those show relative changes, not S/m."
        )
    return f"{fault_text}: {' '.join(suggestions) or 'are currents in amperes, voltages in volts, lengths in metres?'}"
