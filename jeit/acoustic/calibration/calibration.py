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
_UNITS = {"length": "m", "intensity": "square of the samples' unit"}
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
        text = json.dumps(self._to_json(), indent=1, ensure_ascii=False, allow_nan=False)
        with atomically_written_file(path) as file:
            file.write(f"{text}\n".encode())

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """Read a calibration from a file written by `save`. Raises `ValueError` for a file of a different format,
        version or unit and for invalid values, and `OSError` if the file cannot be opened."""
        # Imported here, since the import of pydantic takes longer than most operations with a calibration.
        from jeit.acoustic.calibration.calibration_tables import CalibrationTable
        from jeit.files.limits import faults_message
        from jeit.files.schema import validated

        name = Path(path).name
        try:
            content = read_json(path, max_bytes=_MAX_FILE_SIZE)
        except ValueError:
            content = None
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise ValueError(
                f"{name[:80]} is no calibration of microphones; make one with 'jeit calibrate-microphones'."
            )
        if content.get("version") != VERSION:
            raise ValueError(
                f"{name[:80]} is of version {describe(content.get('version'))} of the format; this jeit reads version "
                f"{VERSION}. Calibrate again, or use the jeit that wrote it."
            )
        table = validated(CalibrationTable, content, name)
        try:
            return cls._from_table(table)
        except ValueError as error:
            raise ValueError(faults_message(name, [str(error)])) from None

    def _to_json(self) -> dict[str, Any]:
        microphone_array = on_host(self.microphone_array)
        surface: dict[str, Any] = {
            "outline": _array_to_lists(microphone_array.surface.outline.vertices),
            "holes": [_array_to_lists(hole) for hole in microphone_array.surface.outline.holes],
        }
        if isinstance(microphone_array.surface, CurvedSurface):
            surface["curve"] = {key: _array_to_lists(getattr(microphone_array.surface, key)) for key in _CURVE_FIELDS}
        kind = type(microphone_array.decay)
        microphones = []
        for microphone_index in range(self.num_microphones):
            parameters = {key: float(getattr(microphone_array.decay, key)[microphone_index]) for key in kind.parameters}
            errors = dict(zip(kind.parameters, self.standard_errors[:, microphone_index], strict=True))
            microphones.append(
                {
                    "position": _array_to_lists(microphone_array.microphones[microphone_index]),
                    **parameters,
                    "relative_standard_error": {key: _number_or_none(error) for key, error in errors.items()},
                    "relative_noise": float(microphone_array.noise.relative[microphone_index]),
                    "noise_floor": float(microphone_array.noise.floor[microphone_index]),
                    "noise_deviation": float(microphone_array.noise.deviation[microphone_index]),
                    "noise_cross": float(microphone_array.noise.cross[microphone_index]),
                    "usable": bool(self.usable[microphone_index]),
                    "reason": self.reasons[microphone_index],
                }
            )
        settings = self.intensity
        return {
            "format": FORMAT,
            "version": VERSION,
            "units": _UNITS,
            "scale": _SCALE_DESCRIPTION,
            "name": self.name,
            "decay": kind.name,
            "surface": surface,
            "intensity": None
            if settings is None
            else {key: float(getattr(settings, key)) for key in ("low", "high", "window", "hop")},
            "strengths": None if self.strengths is None else [float(value) for value in self.strengths],
            "widening": float(self.widening),
            "microphones": microphones,
        }

    @classmethod
    def _from_table(cls, table: CalibrationTable) -> Calibration:
        microphone_tables, decay_class, surface = (
            table.microphones,
            DECAY_MODELS[table.decay],
            _surface_from_table(table.surface),
        )
        for microphone_index, microphone in enumerate(microphone_tables):
            if len(microphone.position) != surface.dimension:
                raise ValueError(
                    f"microphones[{microphone_index}].position must be {surface.dimension} coordinates in metres; it "
                    f"has {len(microphone.position)}."
                )
            missing_parameters = [key for key in decay_class.parameters if getattr(microphone, key) is None]
            missing_errors = [
                key for key in decay_class.parameters if key not in microphone.relative_standard_error.model_fields_set
            ]
            if missing_parameters or missing_errors:
                key = missing_parameters[0] if missing_parameters else f"relative_standard_error.{missing_errors[0]}"
                raise ValueError(
                    f"microphones[{microphone_index}].{key} is missing; decay is '{decay_class.name}', which has it."
                )

        def column(key: str) -> Array:
            return as_array(np.array([getattr(microphone, key) for microphone in microphone_tables]))

        positions = np.array([microphone.position for microphone in microphone_tables])
        host_surface = on_host(surface)
        surface_points: Any = host_surface.outline.vertices
        if isinstance(host_surface, CurvedSurface):
            surface_points = np.concatenate([surface_points, host_surface.knots])
        check_microphones(positions, np.asarray(host_surface.place(surface_points.T)).T)
        microphone_array = MicrophoneArray(
            as_array(positions),
            surface,
            decay_class(*(column(key) for key in decay_class.parameters)),
            IntensityNoise(
                column("noise_floor"), column("noise_deviation"), column("noise_cross"), column("relative_noise")
            ),
        )
        errors = [
            [getattr(microphone.relative_standard_error, key) for microphone in microphone_tables]
            for key in decay_class.parameters
        ]
        settings = table.intensity
        return cls(
            microphone_array,
            np.array([microphone.usable for microphone in microphone_tables]),
            tuple(microphone.reason for microphone in microphone_tables),
            np.array([[math.nan if value is None else value for value in row] for row in errors]),
            None if settings is None else IntensitySettings(**settings.model_dump()),
            table.name,
            None if table.strengths is None else _check_strengths(table.strengths),
            table.widening,
        )


def _surface_from_table(table: SurfaceTable) -> AbstractSurface:
    check_extent(table.outline, "surface.outline")
    outline, curve = Polygon(table.outline, table.holes), table.curve
    if curve is None:
        return Plane(outline)
    if len(curve.knots) != len(curve.weights):
        raise ValueError(
            f"surface.curve has {len(curve.knots)} knots and {len(curve.weights)} weights; give a weight for each knot."
        )
    return CurvedSurface(outline, *(as_array(getattr(curve, key)) for key in _CURVE_FIELDS))


def _check_strengths(strengths: np.ndarray) -> tuple[float, float]:
    min_strength, max_strength = map(float, strengths)
    if min_strength > max_strength:
        raise ValueError(f"strengths are {min_strength:g} and {max_strength:g}; give the weaker first.")
    return min_strength, max_strength


def _array_to_lists(array) -> list:
    return np.asarray(array).tolist()


def _number_or_none(value) -> float | None:
    return float(value) if np.isfinite(value) else None


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
    for name, value in recordings.items():
        check_kind(name, value, (Recording, Intensities), "a Recording or Intensities, as of read_recording(path)")
    check_kind("calibration", calibration, Calibration, "a Calibration, as of Calibration.load(path)")
    check_settings("intensity", intensity)
    for value in recordings.values():
        num_channels = value.samples.shape[0] if isinstance(value, Recording) else value.power.shape[1]
        if num_channels != calibration.num_microphones:
            raise ValueError(
                f"'{value.name}' has {num_channels} microphones and the calibration '{calibration.name}' "
                f"{calibration.num_microphones}; give the calibration of this array."
            )
    if silence is not None and not (isinstance(recording, Recording) and isinstance(silence, Recording)):
        raise ValueError(
            "silence applies to a recording of samples, and must be one itself; recordings of intensities have "
            "their floor."
        )
    if isinstance(recording, Intensities):
        return recording
    settings = intensity or calibration.intensity or IntensitySettings()
    recorded_intensities = intensities(recording, settings)
    if silence is not None:
        return _replace_floor(recorded_intensities, intensities(silence, settings))
    # Noise floors can be compared only if frequency band and windows are those of the calibration.
    if settings != calibration.intensity:
        if calibration.intensity is None:
            return recorded_intensities
        settings_note = (
            "band or window are not the calibration's: its decay models may not hold; calibrate with the same."
        )
        return dataclasses.replace(recorded_intensities, notes=(settings_note,))
    calibration_floor = np.asarray(calibration.microphone_array.noise.floor)
    ratio = np.where(
        calibration.usable, recorded_intensities.floor / np.where(calibration_floor > 0, calibration_floor, np.inf), 0.0
    )
    description = (
        f"the noise floor, taken from the quietest windows, is up to {ratio.max():.3g} times the calibration's"
    )
    floor_faults = describe_faults([description if value > _MAX_FLOOR_RATIO else "" for value in ratio])
    settings_note = (
        f"{floor_faults}. If the recording never pauses, touches count as silence: give a recording of the array "
        "untouched (silence=). If gain, unit, surroundings or microphones have changed, calibrate again."
    )
    return dataclasses.replace(recorded_intensities, notes=(settings_note,)) if floor_faults else recorded_intensities


def _replace_floor(recorded_intensities: Intensities, silence: Intensities) -> Intensities:
    """Replace the noise floor of a recording by the noise floor of `silence`. Microphones that are unusable in the
    silence become unusable in the recording."""
    is_usable = np.asarray(silence.usable.any(axis=0))
    has_floors = (silence.floor > 0) & (recorded_intensities.floor > 0)
    ratio = (
        float(np.median(silence.floor[has_floors] / recorded_intensities.floor[has_floors]))
        if has_floors.any()
        else 1.0
    )
    if ratio > _MAX_FLOOR_RATIO:
        raise ValueError(
            f"silence '{silence.name}' is {ratio:.3g} times as loud as the quietest windows of "
            f"'{recorded_intensities.name}': record the array untouched, at the same gain."
        )
    silence_faults = [
        ("" if is_working else f"in the silence: {fault}")
        for is_working, fault in zip(is_usable, silence.faults, strict=True)
    ]
    faults = [
        "; ".join(filter(None, floor_pair))
        for floor_pair in zip(recorded_intensities.faults, silence_faults, strict=True)
    ]
    return dataclasses.replace(
        recorded_intensities,
        power=recorded_intensities.power + recorded_intensities.floor - silence.floor,
        floor=silence.floor,
        usable=recorded_intensities.usable & is_usable,
        faults=faults,
    )
