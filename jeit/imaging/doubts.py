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

# Minimum width of electrodes relative to their distance that raises no doubt. Misfit of the reference above which frame
# and reference may be exchanged, and ratio of the frame's misfit to the reference's misfit below which an exchange is
# likely, both with the scale that fits the voltages best.
_MIN_RELATIVE_WIDTH, _MIN_SUSPICIOUS_REFERENCE_MISFIT, _MAX_EXCHANGED_MISFIT = 0.005, 0.1, 0.7
# Minimum share of usable voltages that raises no doubt.
_MIN_USABLE_VOLTAGE_SHARE = 0.5
# Ranges of plausible conductivities: of sheets in S, from a megohm a square to metal; of solids in S/m, from tap water
# and fat to brine, with a margin on both sides.
_PLAUSIBLE_CONDUCTIVITY_RANGES = {2: (1e-6, 1e5), 3: (1e-3, 30.0)}
# Voltage above the range of an EIT instrument's amplifiers.
_MAX_AMPLIFIER_VOLTAGE = 60.0
# Units smaller than a volt, with their number per volt.
_SMALLER_UNITS = (("mV", 1e3), ("uV", 1e6))


def doubts_of_data(
    measurement: Measurement,
    reference: Measurement,
    calibration: Calibration,
    quality: FrameQuality | None = None,
    electrode_change: ElectrodeChange | None = None,
) -> list[str]:
    """Reasons to doubt the data: few usable voltages, an implausible level of the voltages, implausible lengths, a
    frame that may be the reference, an `electrode_change`, or, with the frame's `quality`, noise."""
    is_used, doubt_texts = np.asarray(measurement.mask)[0], []
    if (usable_share := np.mean(is_used)) < _MIN_USABLE_VOLTAGE_SHARE:
        doubt_texts.append(
            f"only {is_used.sum()} of {is_used.size} voltages are left ({percent(float(usable_share))}): they "
            "determine little of what is where."
        )
    level, lengths = _doubt_of_units(measurement, reference, calibration), _doubt_of_lengths(measurement)
    order_warning = _doubt_of_order(measurement, reference, calibration)
    movement = "" if electrode_change is None else electrode_change.doubt
    noise = "" if quality is None else quality.doubt
    return [*doubt_texts, *filter(None, (level, lengths, order_warning, movement, noise))]


def _doubt_of_lengths(measurement: Measurement) -> str:
    """Return a sentence if electrodes on the edge of a sheet are so narrow that lengths may not be in metres; otherwise
    an empty string."""
    electrodes, domain = measurement.electrodes, measurement.domain
    if not isinstance(electrodes, BoundaryElectrodes) or not isinstance(domain, Domain):
        return ""
    width, pitch = float(np.max(electrodes.width)), domain.perimeter / electrodes.num_electrodes
    if width > _MIN_RELATIVE_WIDTH * pitch:
        return ""
    x_min, x_max, _, _ = domain.extent
    return (
        f"the electrodes are {1e3 * width:.3g} mm wide and {1e3 * pitch:.3g} mm apart, on a body {x_max - x_min:.3g} m "
        "wide: are all lengths in metres?"
    )


def _doubt_of_order(measurement: Measurement, reference: Measurement, calibration: Calibration) -> str:
    """Return a sentence if the frame fits an undisturbed body much better than the reference does; otherwise an empty
    string."""
    usable = np.asarray(measurement.mask)[0] & np.asarray(reference.mask)[0]
    if not (float(calibration.misfit) > _MIN_SUSPICIOUS_REFERENCE_MISFIT and usable.any()):
        return ""
    predicted_voltages = np.asarray(calibration.voltages)[usable]

    def compute_misfit(measured: Measurement) -> float:
        voltages = np.asarray(measured.voltages)[0][usable]
        scale = np.vdot(predicted_voltages, voltages) / np.vdot(predicted_voltages, predicted_voltages)
        return float(np.linalg.norm(voltages - scale * predicted_voltages) / np.linalg.norm(voltages))

    misfit = compute_misfit(reference)
    if misfit <= _MIN_SUSPICIOUS_REFERENCE_MISFIT:
        return ""
    frame_misfit = compute_misfit(measurement)
    if frame_misfit > _MAX_EXCHANGED_MISFIT * misfit:
        return ""
    return (
        f"the frame fits an undisturbed body better ({percent(frame_misfit)} misfit) than the reference does "
        f"({percent(misfit)}): are the two exchanged?"
    )


def _doubt_of_units(measurement: Measurement, reference: Measurement, calibration: Calibration) -> str:
    """Return a sentence that suggests a unit if the level of the voltages is implausible. Returns an empty string
    otherwise, and if notes of the measurement or its reference say that the scale is not known."""
    min_conductivity, max_conductivity = _PLAUSIBLE_CONDUCTIVITY_RANGES[calibration.model.mesh.dimension]
    background = abs(complex(calibration.conductivity))
    frames = [np.abs(np.asarray(frame.voltages)[np.asarray(frame.mask)]) for frame in (measurement, reference)]
    max_voltage = max(float(voltages.max(initial=0)) for voltages in frames)
    is_scale_unknown = any("trust relative changes" in note for note in (*measurement.notes, *reference.notes))
    if is_scale_unknown or (min_conductivity < background < max_conductivity and max_voltage < _MAX_AMPLIFIER_VOLTAGE):
        return ""
    is_solid = calibration.model.mesh.dimension == 3
    unit, comparison = ("S/m", "no water's, gel's or tissue's") if is_solid else ("S", "no sheet's or shallow tank's")
    if not min_conductivity < background < max_conductivity:
        fault = (
            f"a background of {background:.3g} {unit} is {comparison}, which conduct {min_conductivity:g} to "
            f"{max_conductivity:g} {unit}"
        )
    else:
        fault = f"voltages of up to {max_voltage:.3g} V are beyond what instruments read"
    if background < max_conductivity:
        likely_units = [
            f'"{name}" (a background of {background * factor:.3g} {unit})'
            for name, factor in _SMALLER_UNITS
            if min_conductivity < background * factor < max_conductivity
            and max_voltage < _MAX_AMPLIFIER_VOLTAGE * factor
        ]
        key = "[data] unit"
    else:
        likely_units = [
            f'"{name}"'
            for name, factor in (("mA", 1e3), ("uA", 1e6))
            if min_conductivity < background / factor < max_conductivity
        ]
        key = "[protocol] current_unit"
    likely_units = [f"{key} = {' or '.join(likely_units)}?"] if likely_units else []
    if all((voltages == np.round(voltages)).all() for voltages in frames) and max_voltage > 1:
        likely_units.append(
            "They are whole numbers, as the counts of a converter are: those show relative changes, not S/m."
        )
    return f"{fault}: {' '.join(likely_units) or 'are currents in amperes, voltages in volts, lengths in metres?'}"
