"""`Calibration`: decay models and noise of an array of microphones, stored in a JSON file; and the intensities of a
recording, computed with the frequency band and windows of the calibration."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from jeit.acoustic.decay import DECAY_MODELS
from jeit.acoustic.microphones import IntensityNoise, MicrophoneArray
from jeit.acoustic.signal._arrays import check_extent, check_microphones
from jeit.acoustic.signal.faults import describe_faults
from jeit.acoustic.signal.intensity import IntensitySettings, check_settings, intensities
from jeit.acoustic.signal.recording import Intensities, Recording
from jeit.acoustic.surface import AbstractSurface, CurvedSurface, Plane
from jeit.arguments import check_kind, describe
from jeit.files import atomically_written_file, read_json
from jeit.mesh import Polygon
from jeit_solvers.engines import as_array, on_host
from jeit_solvers.module import Module

if TYPE_CHECKING:
    from jeit.acoustic.calibration.calibration_tables import CalibrationTable, SurfaceTable

FORMAT, VERSION = "jeit microphone calibration", 1
_QUANTITY_UNITS = {"length": "m", "intensity": "square of the samples' unit"}
_SCALE_DESCRIPTION = (
    "strength 1 is the source whose intensity upon a microphone has geometric mean 1 over the usable ones"
)
# Fields of `CurvedSurface` that are stored in a calibration file.
_CURVE_FIELDS = ("origin", "axes", "normal", "knots", "weights", "affine")
# Maximum size of a calibration file in bytes. A microphone takes several hundred bytes.
_MAX_FILE_SIZE = 2**24
# Ratio of two noise floors above which the floors are considered different.
_MAX_FLOOR_RATIO = 4.0


class Calibration(Module):
    """A calibrated array of microphones, such as the `calibration` in the result of `calibrate_microphones`.

    **Fields**

    - `microphone_array`: positions of the M microphones, surface, decay models and noise.
    - `usable`: mask (M,) of the usable microphones.
    - `reasons`: M reasons why a microphone is not usable; "" for usable microphones.
    - `standard_errors`: relative standard errors (K, M) of the K parameters of each microphone's decay model.
    - `intensity`: frequency band and windows with which the samples of the taps were analysed; None if the taps were
      given as intensities.
    - `name`: name of the calibration taps.
    - `strengths`: strengths of the weakest and the strongest calibration tap; None if unknown.
    - `widening`: factor by which `locate` multiplies covariances of positions, chosen so that the 90 % error ellipses
      contain 90 % of the taps that were left out of the fit; at least 1.

    The taps determine the gains of the decay models and the strengths of the taps only up to a common factor. The
    factor is chosen so that the geometric mean of the responses f_i(0) at distance 0 over the usable microphones is 1.
    The strength of a source is therefore the intensity at a typical microphone directly below the source.

    **Example:**

    ```python
    calibration.save("skin.json")
    locations = locate(recording, Calibration.load("skin.json"))
    ```
    """

    microphone_array: MicrophoneArray
    usable: Bool[np.ndarray, " M"]
    reasons: tuple[str, ...] = eqx.field(static=True)
    standard_errors: Float[np.ndarray, "K M"]
    intensity: IntensitySettings | None
    name: str = eqx.field(static=True)
    strengths: tuple[float, float] | None = None
    widening: float = 1.0

    @property
    def num_microphones(self) -> int:
        """Number of microphones, M."""
        return len(self.microphone_array.microphones)

    def save(self, path: str | Path) -> None:
        """Write the calibration to a JSON file, together with the format version and the units."""
        json_text = json.dumps(self._to_json(), indent=1, ensure_ascii=False, allow_nan=False)
        with atomically_written_file(path) as calibration_file:
            calibration_file.write(f"{json_text}\n".encode())

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """Read a calibration from a file written by `save`. Raises `ValueError` for a file of a different format,
        version or unit and for invalid values, and `OSError` if the file cannot be opened."""
        # Imported here, since the import of pydantic takes longer than most operations with a calibration.
        from jeit.acoustic.calibration.calibration_tables import CalibrationTable
        from jeit.files.limits import faults_message
        from jeit.files.schema import validated

        file_name = Path(path).name
        try:
            file_content = read_json(path, max_bytes=_MAX_FILE_SIZE)
        except ValueError:
            file_content = None
        if not isinstance(file_content, dict) or file_content.get("format") != FORMAT:
            raise ValueError(
                f"{file_name[:80]} is no calibration of microphones; make one with 'jeit calibrate-microphones'."
            )
        if file_content.get("version") != VERSION:
            raise ValueError(
                f"{file_name[:80]} is of version {describe(file_content.get('version'))} of the format; this jeit "
                f"reads version {VERSION}. Calibrate again, or use the jeit that wrote it."
            )
        calibration_table = validated(CalibrationTable, file_content, file_name)
        try:
            return cls._from_table(calibration_table)
        except ValueError as error:
            raise ValueError(faults_message(file_name, [str(error)])) from None

    def _to_json(self) -> dict[str, Any]:
        microphone_array = on_host(self.microphone_array)
        surface_fields: dict[str, Any] = {
            "outline": _array_to_lists(microphone_array.surface.outline.vertices),
            "holes": [_array_to_lists(hole_vertices) for hole_vertices in microphone_array.surface.outline.holes],
        }
        if isinstance(microphone_array.surface, CurvedSurface):
            surface_fields["curve"] = {
                field_name: _array_to_lists(getattr(microphone_array.surface, field_name))
                for field_name in _CURVE_FIELDS
            }
        decay_class = type(microphone_array.decay)
        microphone_entries = []
        for microphone_index in range(self.num_microphones):
            decay_parameters = {
                field_name: float(getattr(microphone_array.decay, field_name)[microphone_index])
                for field_name in decay_class.parameters
            }
            parameter_errors = dict(zip(decay_class.parameters, self.standard_errors[:, microphone_index], strict=True))
            microphone_entries.append(
                {
                    "position": _array_to_lists(microphone_array.microphones[microphone_index]),
                    **decay_parameters,
                    "relative_standard_error": {
                        field_name: _number_or_none(parameter_error)
                        for field_name, parameter_error in parameter_errors.items()
                    },
                    "relative_noise": float(microphone_array.noise.relative[microphone_index]),
                    "noise_floor": float(microphone_array.noise.floor[microphone_index]),
                    "noise_deviation": float(microphone_array.noise.deviation[microphone_index]),
                    "noise_cross": float(microphone_array.noise.cross[microphone_index]),
                    "usable": bool(self.usable[microphone_index]),
                    "reason": self.reasons[microphone_index],
                }
            )
        intensity_settings = self.intensity
        return {
            "format": FORMAT,
            "version": VERSION,
            "units": _QUANTITY_UNITS,
            "scale": _SCALE_DESCRIPTION,
            "name": self.name,
            "decay": decay_class.name,
            "surface": surface_fields,
            "intensity": None
            if intensity_settings is None
            else {
                field_name: float(getattr(intensity_settings, field_name))
                for field_name in ("low", "high", "window", "hop")
            },
            "strengths": None
            if self.strengths is None
            else [float(strength_limit) for strength_limit in self.strengths],
            "widening": float(self.widening),
            "microphones": microphone_entries,
        }

    @classmethod
    def _from_table(cls, calibration_table: CalibrationTable) -> Calibration:
        microphone_tables, decay_class, surface = (
            calibration_table.microphones,
            DECAY_MODELS[calibration_table.decay],
            _surface_from_table(calibration_table.surface),
        )
        for microphone_index, microphone_table in enumerate(microphone_tables):
            if len(microphone_table.position) != surface.dimension:
                raise ValueError(
                    f"microphones[{microphone_index}].position must be {surface.dimension} coordinates in metres; it "
                    f"has {len(microphone_table.position)}."
                )
            missing_parameters = [
                field_name for field_name in decay_class.parameters if getattr(microphone_table, field_name) is None
            ]
            missing_errors = [
                field_name
                for field_name in decay_class.parameters
                if field_name not in microphone_table.relative_standard_error.model_fields_set
            ]
            if missing_parameters or missing_errors:
                field_name = (
                    missing_parameters[0] if missing_parameters else f"relative_standard_error.{missing_errors[0]}"
                )
                raise ValueError(
                    f"microphones[{microphone_index}].{field_name} is missing; decay is '{decay_class.name}', which "
                    "has it."
                )

        def microphone_column(field_name: str) -> Array:
            return as_array(np.array([getattr(microphone_table, field_name) for microphone_table in microphone_tables]))

        microphone_positions = np.array([microphone_table.position for microphone_table in microphone_tables])
        host_surface = on_host(surface)
        surface_points: Any = host_surface.outline.vertices
        if isinstance(host_surface, CurvedSurface):
            surface_points = np.concatenate([surface_points, host_surface.knots])
        check_microphones(microphone_positions, np.asarray(host_surface.place(surface_points.T)).T)
        microphone_array = MicrophoneArray(
            as_array(microphone_positions),
            surface,
            decay_class(*(microphone_column(field_name) for field_name in decay_class.parameters)),
            IntensityNoise(
                microphone_column("noise_floor"),
                microphone_column("noise_deviation"),
                microphone_column("noise_cross"),
                microphone_column("relative_noise"),
            ),
        )
        parameter_errors = [
            [getattr(microphone_table.relative_standard_error, field_name) for microphone_table in microphone_tables]
            for field_name in decay_class.parameters
        ]
        intensity_settings = calibration_table.intensity
        return cls(
            microphone_array,
            np.array([microphone_table.usable for microphone_table in microphone_tables]),
            tuple(microphone_table.reason for microphone_table in microphone_tables),
            np.array(
                [
                    [math.nan if error_value is None else error_value for error_value in error_row]
                    for error_row in parameter_errors
                ]
            ),
            None if intensity_settings is None else IntensitySettings(**intensity_settings.model_dump()),
            calibration_table.name,
            None if calibration_table.strengths is None else _check_strengths(calibration_table.strengths),
            calibration_table.widening,
        )


def _surface_from_table(surface_table: SurfaceTable) -> AbstractSurface:
    check_extent(surface_table.outline, "surface.outline")
    outline, curve_table = Polygon(surface_table.outline, surface_table.holes), surface_table.curve
    if curve_table is None:
        return Plane(outline)
    if len(curve_table.knots) != len(curve_table.weights):
        raise ValueError(
            f"surface.curve has {len(curve_table.knots)} knots and {len(curve_table.weights)} weights; give a weight "
            "for each knot."
        )
    return CurvedSurface(outline, *(as_array(getattr(curve_table, field_name)) for field_name in _CURVE_FIELDS))


def _check_strengths(strength_limits: np.ndarray) -> tuple[float, float]:
    min_strength, max_strength = map(float, strength_limits)
    if min_strength > max_strength:
        raise ValueError(f"strengths are {min_strength:g} and {max_strength:g}; give the weaker first.")
    return min_strength, max_strength


def _array_to_lists(numeric_array) -> list:
    return np.asarray(numeric_array).tolist()


def _number_or_none(number) -> float | None:
    return float(number) if np.isfinite(number) else None


def calibrated_intensities(
    recording: Recording | Intensities,
    calibration: Calibration,
    intensity: IntensitySettings | None = None,
    *,
    silence: Recording | None = None,
) -> Intensities:
    """Compute the intensities of a recording. A recording of intensities is returned unchanged.

    `intensity`: frequency band and windows, by default as in the calibration. `silence`: recording of the untouched
    array at the same gain, from which the noise floor is estimated. A silence is required if touches never pause; by
    default the floor is estimated from the quietest windows of the recording. Raises `ValueError` if the number of
    microphones differs from that of the calibration, for a `silence` that is louder than the quietest windows of the
    recording, and for arguments of the wrong type.
    """
    recordings = {"recording": recording} if silence is None else {"recording": recording, "silence": silence}
    for argument_name, checked_value in recordings.items():
        check_kind(
            argument_name,
            checked_value,
            (Recording, Intensities),
            "a Recording or Intensities, as of read_recording(path)",
        )
    check_kind("calibration", calibration, Calibration, "a Calibration, as of Calibration.load(path)")
    check_settings("intensity", intensity)
    for checked_value in recordings.values():
        num_channels = (
            checked_value.samples.shape[0] if isinstance(checked_value, Recording) else checked_value.power.shape[1]
        )
        if num_channels != calibration.num_microphones:
            raise ValueError(
                f"'{checked_value.name}' has {num_channels} microphones and the calibration '{calibration.name}' "
                f"{calibration.num_microphones}; give the calibration of this array."
            )
    if silence is not None and not (isinstance(recording, Recording) and isinstance(silence, Recording)):
        raise ValueError(
            "silence applies to a recording of samples, and must be one itself; recordings of intensities have "
            "their floor."
        )
    if isinstance(recording, Intensities):
        return recording
    intensity_settings = intensity or calibration.intensity or IntensitySettings()
    recorded_intensities = intensities(recording, intensity_settings)
    if silence is not None:
        return _replace_floor(recorded_intensities, intensities(silence, intensity_settings))
    # Noise floors can be compared only if frequency band and windows are those of the calibration.
    if intensity_settings != calibration.intensity:
        if calibration.intensity is None:
            return recorded_intensities
        settings_note = (
            "band or window are not the calibration's: its decay models may not hold; calibrate with the same."
        )
        return dataclasses.replace(recorded_intensities, notes=(settings_note,))
    calibration_floor = np.asarray(calibration.microphone_array.noise.floor)
    floor_ratios = np.where(
        calibration.usable, recorded_intensities.floor / np.where(calibration_floor > 0, calibration_floor, np.inf), 0.0
    )
    excess_description = (
        f"the noise floor, taken from the quietest windows, is up to {floor_ratios.max():.3g} times the calibration's"
    )
    floor_faults = describe_faults(
        [excess_description if checked_value > _MAX_FLOOR_RATIO else "" for checked_value in floor_ratios]
    )
    settings_note = (
        f"{floor_faults}. If the recording never pauses, touches count as silence: give a recording of the array "
        "untouched (silence=). If gain, unit, surroundings or microphones have changed, calibrate again."
    )
    return dataclasses.replace(recorded_intensities, notes=(settings_note,)) if floor_faults else recorded_intensities


def _replace_floor(recorded_intensities: Intensities, silence_intensities: Intensities) -> Intensities:
    """Replace the noise floor of a recording by the noise floor of `silence_intensities`. Microphones that are unusable
    in the silence become unusable in the recording."""
    is_usable = np.asarray(silence_intensities.usable.any(axis=0))
    has_noise_floors = (silence_intensities.floor > 0) & (recorded_intensities.floor > 0)
    floor_ratio = (
        float(np.median(silence_intensities.floor[has_noise_floors] / recorded_intensities.floor[has_noise_floors]))
        if has_noise_floors.any()
        else 1.0
    )
    if floor_ratio > _MAX_FLOOR_RATIO:
        raise ValueError(
            f"silence '{silence_intensities.name}' is {floor_ratio:.3g} times as loud as the quietest windows of "
            f"'{recorded_intensities.name}': record the array untouched, at the same gain."
        )
    silence_faults = [
        ("" if is_working else f"in the silence: {microphone_fault}")
        for is_working, microphone_fault in zip(is_usable, silence_intensities.faults, strict=True)
    ]
    combined_faults = [
        "; ".join(filter(None, fault_pair))
        for fault_pair in zip(recorded_intensities.faults, silence_faults, strict=True)
    ]
    return dataclasses.replace(
        recorded_intensities,
        power=recorded_intensities.power + recorded_intensities.floor - silence_intensities.floor,
        floor=silence_intensities.floor,
        usable=recorded_intensities.usable & is_usable,
        faults=combined_faults,
    )
