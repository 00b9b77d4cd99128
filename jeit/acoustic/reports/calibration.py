"""Files of a calibration of microphones: the calibration, and a plot of its fit."""

from __future__ import annotations

from pathlib import Path

from jeit.acoustic.calibration.calibrate import CalibrationFit
from jeit.report.folder import results


def write_calibration(fit: CalibrationFit, path: str | Path) -> None:
    """Write the calibration to `path` (JSON, for `Calibration.load`) and a plot of it to the same path with suffix
    `.png`; the folder is created if needed. Raises `ValueError` for a path that is a folder, in no folder, or that of
    the plot."""
    path, picture = calibration_files(path)
    with results(path.parent, (path.name, picture.name)) as made:
        fit.calibration.save(made / path.name)
        draw_calibration(fit).savefig(made / picture.name, dpi=130)


def calibration_files(path: str | Path) -> tuple[Path, Path]:
    """Paths of the calibration file and the plot that `write_calibration` writes for `path`. Raises `ValueError` as it
    does."""
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"path {path} is a folder; give a file, such as {path / 'calibration.json'}.")
    picture = path.with_suffix(".png")
    if picture == path:
        raise ValueError(f"path {path}: the calibration is JSON; give another name, such as {path.stem}.json.")
    return path, picture


def draw_calibration(fit: CalibrationFit):
    """Plot the receptive fields of all microphones, as a matplotlib `Figure` that needs no display."""
    from matplotlib.figure import Figure

    from jeit.acoustic.plots import plot_receptive_fields

    figure = Figure(figsize=(9.6, 8.4), layout="constrained")
    plot_receptive_fields(fit, title=fit.calibration.name, ax=figure.subplots())
    return figure
