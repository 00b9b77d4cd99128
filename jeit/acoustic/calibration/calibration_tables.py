"""Schema of a calibration file: type, range and unit of the value of each key."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import FailFast, Field

from jeit.files.schema import Number, Numbers, Table

_MAX_MICROPHONES, _MAX_VERTICES, _MAX_HOLES = 4096, 4096, 64

Positive = Annotated[float, Number(5e-324, math.inf)]
NotNegative = Annotated[float, Number(0, math.inf)]
Text = Annotated[str, Field(max_length=10_000)]
Vector = Annotated[np.ndarray, Numbers(((3, 3),))]
Loop = Annotated[np.ndarray, Numbers(((3, _MAX_VERTICES), (2, 2)), -1e6, 1e6, "m")]


class UnitsTable(Table):
    """Units of the values in a calibration file."""

    subject = "units"
    length: Literal["m"]
    intensity: Literal["square of the samples' unit"]


class CurveTable(Table):
    """Parameters of a curved surface; see `CurvedSurface`."""

    subject = "a curve"
    origin: Vector
    axes: Annotated[np.ndarray, Numbers(((3, 3), (2, 2)))]
    normal: Vector
    knots: Annotated[np.ndarray, Numbers(((1, 4096), (2, 2)))]
    weights: Annotated[np.ndarray, Numbers(((1, 4096),))]
    affine: Vector


class SurfaceTable(Table):
    """Surface of the skin: its outline, holes and curvature, in metres."""

    subject = "a surface"
    outline: Loop
    holes: Annotated[list[Loop], FailFast()] = Field(max_length=_MAX_HOLES)
    curve: CurveTable | None = None


class IntensityTable(Table):
    """Frequency band and windows with which samples are analysed; see `IntensitySettings`."""

    subject = "intensity"
    low: Annotated[float, Number(0, 1e9, "Hz")] = 50.0
    high: Annotated[float, Number(0, 1e9, "Hz")] = 1000.0
    window: Annotated[float, Number(1e-9, 10, "s")] = 0.05
    hop: Annotated[float, Number(1e-9, 10, "s")] = 0.0125


class ErrorsTable(Table):
    """Relative standard error of each parameter of a microphone's decay model; null where unknown."""

    subject = "relative standard errors"
    a: NotNegative | None = None
    b: NotNegative | None = None
    length: NotNegative | None = None


class MicrophoneTable(Table):
    """Position, decay model and noise of one microphone."""

    subject = "a microphone"
    position: Annotated[np.ndarray, Numbers(((2, 3),), -1e6, 1e6, "m")]
    a: Positive | None = None
    b: Positive | None = None
    length: Positive | None = None
    relative_standard_error: ErrorsTable
    relative_noise: NotNegative
    noise_floor: NotNegative
    noise_deviation: NotNegative
    noise_cross: NotNegative
    usable: bool
    reason: Text


class CalibrationTable(Table):
    """Content of a calibration file."""

    subject = "a calibration"
    format: Literal["jeit microphone calibration"]
    version: Literal[1]
    units: UnitsTable
    scale: Text = ""
    name: Text
    decay: Literal["inverse-square", "exponential", "attenuated"]
    surface: SurfaceTable
    intensity: IntensityTable | None
    strengths: Annotated[np.ndarray, Numbers(((2, 2),), 5e-324, math.inf)] | None
    widening: Annotated[float, Number(1, math.inf)] = 1.0
    microphones: Annotated[list[MicrophoneTable], FailFast()] = Field(min_length=1, max_length=_MAX_MICROPHONES)
