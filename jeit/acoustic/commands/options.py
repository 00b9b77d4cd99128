"""Intensity options shared by the commands that read microphones."""

from __future__ import annotations

from typing import Annotated

import typer

BandLow = Annotated[
    float | None, typer.Option(help="Lowest frequency of the band, hertz (default 50, or the calibration's).")
]
BandHigh = Annotated[
    float | None, typer.Option(help="Highest frequency of the band, hertz (default 1000, or the calibration's).")
]
Window = Annotated[float | None, typer.Option(help="Length of a window, seconds (default 0.05, or the calibration's).")]
Hop = Annotated[
    float | None, typer.Option(help="From one window to the next, seconds (default 0.0125, or the calibration's).")
]


def intensity_settings(low: float | None, high: float | None, window: float | None, hop: float | None):
    """`IntensitySettings` with what was given, None if nothing was."""
    given = {"low": low, "high": high, "window": window, "hop": hop}
    given = {name: value for name, value in given.items() if value is not None}
    if not given:
        return None
    from jeit.acoustic import IntensitySettings

    return IntensitySettings(**given)
