"""Schema of a calibration file: type, range and unit of the value of each key."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import FailFast, Field

from jeit.files.schema import Number, Numbers, Table

_MAX_MICROPHONES, _MAX_VERTICES, _MAX_HOLES = 4096, 4096, 64

PositiveNumber = Annotated[float, Number(5e-324, math.inf)]
NonNegativeNumber = Annotated[float, Number(0, math.inf)]
Text = Annotated[str, Field(max_length=10_000)]
SpaceVector = Annotated[np.ndarray, Numbers(((3, 3),))]
LoopVertices = Annotated[np.ndarray, Numbers(((3, _MAX_VERTICES), (2, 2)), -1e6, 1e6, "m")]


class UnitsTable(Table):
    """Units of the values in a calibration file."""

    name_in_messages = "units"
    length: Literal["m"]
    intensity: Literal["square of the samples' unit"]


class CurveTable(Table):
    """Parameters of a curved surface; see `CurvedSurface`."""

    name_in_messages = "a curve"
    origin: SpaceVector
    axes: Annotated[np.ndarray, Numbers(((3, 3), (2, 2)))]
    normal: SpaceVector
    knots: Annotated[np.ndarray, Numbers(((1, 4096), (2, 2)))]
    weights: Annotated[np.ndarray, Numbers(((1, 4096),))]
    affine: SpaceVector


class SurfaceTable(Table):
    """Surface of the skin: its outline, holes and curvature, in metres."""

    name_in_messages = "a surface"
    outline: LoopVertices
    holes: Annotated[list[LoopVertices], FailFast()] = Field(max_length=_MAX_HOLES)
    curve: CurveTable | None = None


class IntensityTable(Table):
    """Frequency band and windows with which samples are analysed; see `IntensitySettings`."""

    name_in_messages = "intensity"
    low: Annotated[float, Number(0, 1e9, "Hz")] = 50.0
    high: Annotated[float, Number(0, 1e9, "Hz")] = 1000.0
    window: Annotated[float, Number(1e-9, 10, "s")] = 0.05
    hop: Annotated[float, Number(1e-9, 10, "s")] = 0.0125


class ErrorsTable(Table):
    """Relative standard error of each parameter of a microphone's decay model; null where unknown."""

    name_in_messages = "relative standard errors"
    a: NonNegativeNumber | None = None
    b: NonNegativeNumber | None = None
    length: NonNegativeNumber | None = None


class MicrophoneTable(Table):
    """Position, decay model and noise of one microphone."""

    name_in_messages = "a microphone"
    position: Annotated[np.ndarray, Numbers(((2, 3),), -1e6, 1e6, "m")]
    a: PositiveNumber | None = None
    b: PositiveNumber | None = None
    length: PositiveNumber | None = None
    relative_standard_error: ErrorsTable
    relative_noise: NonNegativeNumber
    noise_floor: NonNegativeNumber
    noise_deviation: NonNegativeNumber
    noise_cross: NonNegativeNumber
    usable: bool
    reason: Text


class CalibrationTable(Table):
    """Content of a calibration file."""

    name_in_messages = "a calibration"
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
