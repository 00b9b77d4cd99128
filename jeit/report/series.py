"""Files of a series of images: curves of regions, maps of amplitude and phase, a picture and a film."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from jeit.image import Oscillation, oscillation
from jeit.imaging.sequence import ImagedSequence
from jeit.report.film import check_film, write_film
from jeit.report.folder import describe_measurement, plain, results, write_json, write_rows

SERIES_FILES = ("series.png", "series.npz", "regions.csv", "report.json")


def write_series(
    found: ImagedSequence,
    folder: str | Path,
    *,
    regions: Mapping[str, Bool[np.ndarray, " m"]] | None = None,
    oscillations: Sequence[Oscillation] = (),
    film: str | None = None,
) -> dict[str, Any]:
    """Write `series.png`, `series.npz`, `regions.csv` and `report.json` into `folder`, and a film if its name is given;
    return the report.

    `regions`: cells (m,) by name; the whole body unless given. `oscillations`: of `found.series.changes`. The table has
    `time_s` and the mean change of each region, S/m (2-D: S), empty for refused frames. The NPZ holds `changes` (F, m),
    `times` (F,), `background`, `points`, `cells`, `functional` (m,), and for every oscillation `frequency` (k,),
    `amplitude` (k, m) and `phase` (k, m) radians. Raises `ValueError` for what cannot be a folder or a film.
    """
    series, model = found.series, found.prepared.model
    chosen = {"whole body": np.ones(series.mesh.num_cells, bool)} if not regions else dict(regions)
    films = () if film is None else (check_film(film),)
    curves = {name: series.mean_change(region) for name, region in chosen.items()}
    report = _report(found, curves, oscillations)
    from jeit.plot.imaging.series import plot_series

    with results(folder, (*SERIES_FILES, *films)) as made:
        plot_series(series, chosen, oscillations, model.electrodes).savefig(made / "series.png", dpi=130)
        np.savez_compressed(
            made / "series.npz",
            changes=series.changes,
            times=series.times,
            background=series.background,
            points=np.asarray(series.mesh.points),
            cells=np.asarray(series.mesh.cells),
            functional=series.functional(),
            frequency=np.array([one.frequency for one in oscillations], float),
            amplitude=np.array([one.amplitude for one in oscillations], float).reshape(-1, series.mesh.num_cells),
            phase=np.array([one.phase for one in oscillations], float).reshape(-1, series.mesh.num_cells),
        )
        rows = zip(series.times, *curves.values(), strict=True)
        cells = ([f"{time:.9g}", *("" if np.isnan(one) else f"{one:.6g}" for one in row)] for time, *row in rows)
        write_rows(made / "regions.csv", ("time_s", *curves), cells)
        write_json(report, made / "report.json")
        if film is not None:
            titles = [f"{time:.2f} s" for time in series.times]
            rate = series.frame_rate
            write_film(made / film, series.mesh, series.changes, model.electrodes, titles=titles, rate=rate)
    return report


def _report(found: ImagedSequence, curves: Mapping[str, np.ndarray], oscillations: Sequence[Oscillation]) -> dict:
    series = found.series
    reported = []
    for one in oscillations:
        at = {name: oscillation(curve, series.times, one.frequency) for name, curve in curves.items()}
        parts = {
            name: {
                "amplitude": float(part.amplitude),
                "noise": float(part.noise),
                "phase_degrees": float(np.degrees(part.phase)),
            }
            for name, part in at.items()
        }
        reported.append({"frequency": one.frequency, "resolution": one.resolution, "unit": "Hz", "regions": parts})
    return plain(
        {
            "measurement": describe_measurement(found.prepared.measurement),
            "frames": len(series.times),
            "refused": int(found.refused.sum()),
            "frame_rate": series.frame_rate,
            "frame_rate_unit": "Hz",
            "background": series.background,
            "unit": series.unit,
            "hyperparameter": float(found.reconstruction.hyperparameter),
            "oscillations": reported,
        }
    )
