"""What is known of an array of microphones after its calibration, and the file that keeps it."""

import json
import math
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from jeit.acoustic.decay import DECAYS
from jeit.acoustic.microphones import MicrophoneArray
from jeit.acoustic.noise import IntensityNoise
from jeit.acoustic.signal._arrays import check_extent, check_microphones, real
from jeit.acoustic.signal.intensity import IntensitySettings
from jeit.acoustic.surface import AbstractSurface, CurvedSurface, Plane
from jeit.files import written_whole
from jeit.mesh import Polygon
from jeit_solvers.engines import as_array, on_host

FORMAT, VERSION = "jeit microphone calibration", 1
_UNITS = {"length": "m", "intensity": "square of the samples' unit"}
_SCALE = "strength 1 is the source whose intensity upon a microphone has geometric mean 1 over the usable ones"
# Shapes of the arrays of a curved surface; -1 is any length.
_CURVE = {"origin": (3,), "axes": (3, 2), "normal": (3,), "knots": (-1, 2), "weights": (-1,), "affine": (3,)}


class Calibration(eqx.Module):
    """Microphones, their surface, decay models and noise, and which of them are of use.

    - `microphone_array`: microphones (M, d) in metres, surface, decay, noise.
    - `usable`: (M,), and `reasons`, why a microphone is not ("" for the others).
    - `standard_errors`: (K, M), relative, of the decay model's K parameters.
    - `intensity`: band and window with which the taps' samples were read; None where intensities were given.
    - `name`: of the taps.
    - `strengths`: of the weakest and the strongest tap; None where not known.
    - `widening`: by which `locate` multiplies covariances, so that ellipses hold taps that were left out of the fit.

    The data fix parameters and strengths but for a factor. It is chosen so that the geometric mean of f_i(0) over the
    usable microphones is 1: a source's strength is the intensity that a typical microphone right under it would read.
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
        """M."""
        return len(self.microphone_array.microphones)

    def save(self, path: str | Path) -> None:
        """Write a JSON file, with its version and units."""
        text = json.dumps(self._content(), indent=1, ensure_ascii=False, allow_nan=False)
        with written_whole(path) as file:
            file.write(f"{text}\n".encode())

    @classmethod
    def load(cls, path: str | Path) -> "Calibration":
        """Read what `save` wrote. Raises `ValueError` for another format, version or unit, and for values that no
        calibration has; `OSError` where there is no such file."""
        name = Path(path).name
        try:
            content = json.loads(Path(path).read_text("utf-8"))
        except (ValueError, RecursionError):
            content = None
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise ValueError(f"{name} is no calibration of microphones; make one with 'jeit calibrate-microphones'.")
        if content.get("version") != VERSION:
            raise ValueError(
                f"{name} is of version {content.get('version')!r} of the format; this jeit reads version {VERSION}. "
                "Calibrate again, or use the jeit that wrote it."
            )
        if content.get("units") != _UNITS:
            raise ValueError(f"{name}: units are {content.get('units')}; they must be {_UNITS}. Calibrate again.")
        try:
            return cls._from_content(content)
        except (KeyError, TypeError, AttributeError, OverflowError) as error:
            raise ValueError(f"{name}: incomplete or changed by hand ({error!r}); calibrate again.") from None
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None

    def _content(self) -> dict[str, Any]:
        microphone_array = on_host(self.microphone_array)
        surface: dict[str, Any] = {
            "outline": _list(microphone_array.surface.outline.vertices),
            "holes": [_list(hole) for hole in microphone_array.surface.outline.holes],
        }
        if isinstance(microphone_array.surface, CurvedSurface):
            surface["curve"] = {key: _list(getattr(microphone_array.surface, key)) for key in _CURVE}
        kind = type(microphone_array.decay)
        microphones = []
        for number in range(self.num_microphones):
            parameters = {key: float(getattr(microphone_array.decay, key)[number]) for key in kind.parameters}
            errors = dict(zip(kind.parameters, self.standard_errors[:, number], strict=True))
            microphones.append(
                {
                    "position": _list(microphone_array.microphones[number]),
                    **parameters,
                    "relative_standard_error": {key: _number(error) for key, error in errors.items()},
                    "relative_noise": float(microphone_array.noise.relative[number]),
                    "noise_floor": float(microphone_array.noise.floor[number]),
                    "noise_deviation": float(microphone_array.noise.deviation[number]),
                    "noise_cross": float(microphone_array.noise.cross[number]),
                    "usable": bool(self.usable[number]),
                    "reason": self.reasons[number],
                }
            )
        settings = self.intensity
        return {
            "format": FORMAT,
            "version": VERSION,
            "units": _UNITS,
            "scale": _SCALE,
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
    def _from_content(cls, content: dict[str, Any]) -> "Calibration":
        each = content["microphones"]
        if each == []:
            raise ValueError("it lists no microphones; calibrate again.")
        if content["decay"] not in DECAYS:
            raise ValueError(f"decay is {content['decay']!r}; it must be one of {', '.join(DECAYS)}.")
        kind = DECAYS[content["decay"]]
        surface = _surface(content["surface"])

        def column(key: str) -> Array:
            values = np.array([_real(one[key], f"{key} of microphone {k}") for k, one in enumerate(each)])
            return as_array(values)

        parameters = [column(key) for key in kind.parameters]
        for key, values in zip(kind.parameters, parameters, strict=True):
            if not (np.asarray(values) > 0).all():
                raise ValueError(f"{key} of microphone {int(np.argmin(values))} is not positive.")
        noise = [column(f"noise_{key}") for key in ("floor", "deviation", "cross")]
        if min(np.asarray(values).min() for values in (*noise, column("relative_noise"))) < 0:
            raise ValueError("noise of a microphone is negative.")
        positions = np.array([_place(one["position"], surface.dimension, k) for k, one in enumerate(each)])
        at_hand = on_host(surface)
        known: Any = at_hand.outline.vertices
        if isinstance(at_hand, CurvedSurface):
            known = np.concatenate([known, at_hand.knots])
        check_microphones(positions, np.asarray(at_hand.place(known.T)).T)
        microphone_array = MicrophoneArray(
            as_array(positions),
            surface,
            kind(*parameters),
            IntensityNoise(noise[0], noise[1], noise[2], column("relative_noise")),
        )
        errors = [[one["relative_standard_error"][key] for one in each] for key in kind.parameters]
        what = "relative_standard_error of a microphone"
        settings, strengths = content["intensity"], content["strengths"]
        return cls(
            microphone_array,
            np.array([_flag(one["usable"], f"usable of microphone {k}") for k, one in enumerate(each)]),
            tuple(str(one["reason"]) for one in each),
            np.array([[math.nan if value is None else _real(value, what) for value in row] for row in errors]),
            None if settings is None else IntensitySettings(**settings),
            str(content["name"]),
            None if strengths is None else _strengths(strengths),
            _widening(content.get("widening", 1.0)),  # files of older jeits have none
        )


def _surface(content: dict[str, Any]) -> AbstractSurface:
    vertices = _array(content["outline"], "outline", (-1, 2))
    check_extent(vertices, "outline")
    outline = Polygon(vertices, [_array(hole, f"holes[{k}]", (-1, 2)) for k, hole in enumerate(content["holes"])])
    if "curve" not in content:
        return Plane(outline)
    arrays = [_array(content["curve"][key], f"curve, {key}", shape) for key, shape in _CURVE.items()]
    if len(arrays[3]) != len(arrays[4]):
        raise ValueError(f"curve: {len(arrays[3])} knots and {len(arrays[4])} weights; give a weight for each knot.")
    return CurvedSurface(outline, *(as_array(array) for array in arrays))


def _array(value, what: str, shape: tuple[int, ...]) -> np.ndarray:
    """Finite numbers of this shape, in which -1 is any length."""
    wanted = ", ".join("n" if length < 0 else str(length) for length in shape)
    array = real(value, what, wanted)
    if any(length not in (-1, found) for length, found in zip(shape, array.shape, strict=True)):
        raise ValueError(f"{what} has shape {array.shape}; it must be ({wanted}).")
    if not np.isfinite(array).all():
        raise ValueError(f"{what} holds NaN or infinity; every number must be finite.")
    return array


def _place(value, dimension: int, number: int) -> list[float]:
    what = f"position of microphone {number}"
    if not isinstance(value, list) or len(value) != dimension:
        raise ValueError(f"{what} is {value!r}; it must be {dimension} coordinates in metres.")
    return [_real(coordinate, f"a coordinate of the {what}") for coordinate in value]


def _strengths(value) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError(f"strengths is {value!r}; it must be the weakest and the strongest tap's.")
    low, high = (_real(one, "one of strengths") for one in value)
    if not 0 < low <= high:
        raise ValueError(f"strengths are {low:g} and {high:g}; they must be positive, the weaker first.")
    return low, high


def _widening(value) -> float:
    if not _real(value, "widening") >= 1:
        raise ValueError(f"widening is {value!r}; it must be 1 or more.")
    return float(value)


def _flag(value, what: str) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{what} is {value!r}; it must be true or false.")
    return value


def _list(array) -> list:
    return np.asarray(array).tolist()


def _number(value) -> float | None:
    return float(value) if np.isfinite(value) else None


def _real(value, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"{what} is {value!r}; it must be a finite number.")
    return float(value)
