"""What is known of an array of microphones after its calibration, and the file that keeps it."""

import json
import math
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jeit.acoustic.decay import DECAYS
from jeit.acoustic.intensity import IntensitySettings
from jeit.acoustic.likelihood import Listeners
from jeit.acoustic.noise import IntensityNoise
from jeit.acoustic.surface import AbstractSurface, CurvedSurface, Plane
from jeit.mesh import Polygon

FORMAT, VERSION = "jeit microphone calibration", 1
_UNITS = {"length": "m", "intensity": "square of the samples' unit"}
_SCALE = "strength 1 is the source whose intensity upon a microphone has geometric mean 1 over the usable ones"
_CURVE = ("origin", "axes", "normal", "knots", "weights", "affine")


class Calibration(eqx.Module):
    """Microphones, their surface, decay models and noise, and which of them are of use.

    - `listeners`: microphones (M, d) in metres, surface, decay, noise.
    - `usable`: (M,), and `reasons`, why a microphone is not ("" for the others).
    - `standard_errors`: (K, M), relative, of the decay model's K parameters.
    - `intensity`: band and window with which the taps' samples were read; None where intensities were given.
    - `name`: of the taps.

    The data fix parameters and strengths but for a factor. It is chosen so that the geometric mean of f_i(0) over the
    usable microphones is 1: a source's strength is the intensity that a typical microphone right under it would read.
    """

    listeners: Listeners
    usable: Bool[np.ndarray, " M"]
    reasons: tuple[str, ...] = eqx.field(static=True)
    standard_errors: Float[np.ndarray, "K M"]
    intensity: IntensitySettings | None
    name: str = eqx.field(static=True)

    @property
    def num_microphones(self) -> int:
        """M."""
        return len(self.listeners.microphones)

    def save(self, path: str | Path) -> None:
        """Write a JSON file, with its version and units."""
        Path(path).write_text(
            json.dumps(self._content(), indent=1, ensure_ascii=False, allow_nan=False) + "\n", "utf-8"
        )

    @classmethod
    def load(cls, path: str | Path) -> "Calibration":
        """Read what `save` wrote. Raises `ValueError` for another format, version or unit, and for values that no
        calibration has; `OSError` where there is no such file."""
        name = Path(path).name
        try:
            content = json.loads(Path(path).read_text("utf-8"))
        except (json.JSONDecodeError, UnicodeDecodeError, RecursionError):
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
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{name}: incomplete or changed by hand ({error!r}); calibrate again.") from None
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None

    def _content(self) -> dict[str, Any]:
        listeners = self.listeners
        surface: dict[str, Any] = {
            "outline": _list(listeners.surface.outline.vertices),
            "holes": [_list(hole) for hole in listeners.surface.outline.holes],
        }
        if isinstance(listeners.surface, CurvedSurface):
            surface["curve"] = {key: _list(getattr(listeners.surface, key)) for key in _CURVE}
        kind = type(listeners.decay)
        microphones = []
        for number in range(self.num_microphones):
            parameters = {key: float(getattr(listeners.decay, key)[number]) for key in kind.parameters}
            errors = dict(zip(kind.parameters, self.standard_errors[:, number], strict=True))
            microphones.append(
                {
                    "position": _list(listeners.microphones[number]),
                    **parameters,
                    "relative_standard_error": {key: _number(error) for key, error in errors.items()},
                    "relative_noise": float(listeners.noise.relative[number]),
                    "noise_floor": float(listeners.noise.floor[number]),
                    "noise_deviation": float(listeners.noise.deviation[number]),
                    "noise_cross": float(listeners.noise.cross[number]),
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
            "microphones": microphones,
        }

    @classmethod
    def _from_content(cls, content: dict[str, Any]) -> "Calibration":
        each = content["microphones"]
        if content["decay"] not in DECAYS:
            raise ValueError(f"decay is {content['decay']!r}; it must be one of {', '.join(DECAYS)}.")
        kind = DECAYS[content["decay"]]
        surface = _surface(content["surface"])

        def column(key: str) -> Array:
            values = np.array([_real(one[key], f"{key} of microphone {k}") for k, one in enumerate(each)])
            return jnp.asarray(values)

        parameters = [column(key) for key in kind.parameters]
        for key, values in zip(kind.parameters, parameters, strict=True):
            if not (np.asarray(values) > 0).all():
                raise ValueError(f"{key} of microphone {int(np.argmin(values))} is not positive.")
        noise = [column(f"noise_{key}") for key in ("floor", "deviation", "cross")]
        if min(float(jnp.min(values)) for values in (*noise, column("relative_noise"))) < 0:
            raise ValueError("noise of a microphone is negative.")
        positions = np.array([one["position"] for one in each], float)
        if positions.ndim != 2 or positions.shape[1] != surface.dimension or not np.isfinite(positions).all():
            raise ValueError(f"positions of microphones must be {surface.dimension} finite coordinates in metres.")
        listeners = Listeners(
            jnp.asarray(positions),
            surface,
            kind(*parameters),
            IntensityNoise(noise[0], noise[1], noise[2], column("relative_noise")),
        )
        errors = [[one["relative_standard_error"][key] for one in each] for key in kind.parameters]
        settings = content["intensity"]
        return cls(
            listeners,
            np.array([bool(one["usable"]) for one in each]),
            tuple(str(one["reason"]) for one in each),
            np.array([[math.nan if value is None else float(value) for value in row] for row in errors]),
            None if settings is None else IntensitySettings(**settings),
            str(content["name"]),
        )


def _surface(content: dict[str, Any]) -> AbstractSurface:
    outline = Polygon(np.array(content["outline"], float), [np.array(hole, float) for hole in content["holes"]])
    if "curve" not in content:
        return Plane(outline)
    return CurvedSurface(outline, *(jnp.asarray(np.array(content["curve"][key], float)) for key in _CURVE))


def _list(array) -> list:
    return np.asarray(array).tolist()


def _number(value) -> float | None:
    return float(value) if np.isfinite(value) else None


def _real(value, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"{what} is {value!r}; it must be a finite number.")
    return float(value)
