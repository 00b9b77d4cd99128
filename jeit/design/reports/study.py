"""Report of a study as one self-contained HTML page: plots, table, and the exact configuration."""

from __future__ import annotations

import base64
import contextlib
import io
import math
import platform
from html import escape
from importlib import metadata
from pathlib import Path
from typing import Any

from jeit.design.reports.study_pictures import draw_maps, draw_scatter, draw_scores, scores_of, shown, values_and_unit
from jeit.design.study.run import study_progress
from jeit.design.study.spec import Study
from jeit.design.study.store import Store, open_results

_PACKAGES = ("jeit", "jax", "numpy", "zarr", "xarray", "matplotlib")
_TEXT = ("layout", "protocol")
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 70em; margin: 2em auto; padding: 0 1em; color: #222 }
table { border-collapse: collapse; font-size: 13px } th, td { padding: .2em .7em; text-align: right }
th { border-bottom: 1px solid #888 } tr:nth-child(even) { background: #f4f4f4 } td.text, th.text { text-align: left }
img { max-width: 100% } pre { background: #f4f4f4; padding: 1em; overflow-x: auto } div.wide { overflow-x: auto }
"""


def write_study_report(study: Study, store: str | Path, path: str | Path) -> None:
    """Write the results so far of the study in `store` as one HTML file at `path`, replaced as a whole.

    Maps of 24 finished points at most on one scale; mean against least sensitivity; every point's values and scores;
    the study file, fingerprint and versions. Raises `ValueError` if no chunk is finished, `OSError` if the page cannot
    be written, and as `open_results` does.
    """
    data = open_results(study, store)
    if not data.finished.values.any():
        raise ValueError(f"{store}: no chunk of the study is finished, so there is nothing to report; resume it.")
    progress = study_progress(study, store)
    made_by, now = Store(study, store, create=False).versions, {name: metadata.version(name) for name in _PACKAGES}
    parts = [
        f"<h1>{escape(study.name)}</h1>",
        f"<p>{progress.points} of {progress.all_points} points finished, in {progress.chunks} of {progress.all_chunks} "
        f"chunks. Sensitivity: ‖Δv‖₂ of all channels to one touch, {'exact' if study.exact else 'linearised'}, on "
        f"{'a layer' if study.points[0].layers else 'a sheet'}.</p>",
        *([_picture(draw_scatter(data), "Mean and least sensitivity of every point")] if len(study.points) > 1 else []),
        *([_picture(draw_scores(data), "Scores of every point; triangles are infinite")] if scores_of(data) else []),
        _picture(
            draw_maps(study, data),
            f"Sensitivity maps of {len(shown(data))} points, electrodes as circles, axes in millimetres"
            f"{', of the skin unrolled' if study.surface else ''}",
        ),
        "<h2>Points</h2>",
        _table(study, data),
        "<h2>Configuration</h2>",
        f"<pre>{escape(study.text)}</pre>",
        f"<p>Fingerprint {study.fingerprint}</p>",
        "<h2>Versions</h2>",
        f"<p>Computed with {_listed(made_by)}.</p>",
        f"<p>Reported with {_listed(now)}, Python {platform.python_version()}, {escape(platform.platform())}.</p>",
    ]
    page = (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(study.name)}</title>'
        f"<style>{_STYLE}</style></head>\n<body>\n" + "\n".join(parts) + "\n</body></html>\n"
    )
    path = Path(path)
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        temporary.write_text(page, "utf-8")
        temporary.replace(path)
    except OSError as error:
        raise OSError(error.errno, f"the report cannot be written ({error.strerror})", str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def _picture(figure: Any, caption: str) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    encoded = base64.b64encode(buffer.getvalue()).decode()
    return f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{encoded}">' + (
        f"<figcaption>{escape(caption)}.</figcaption></figure>"
    )


def _table(study: Study, data) -> str:
    """Table with a row for every point: the swept values, then the results."""
    swept = list(study.points[0].coordinates)
    found = {name: values_and_unit(data, name) for name in scores_of(data)}
    heads = ["point", *swept, *(name if unit == "1" else f"{name} / {unit}" for name, (_, unit) in found.items())]
    lines = ["".join(f'<th class="{"text" if head in _TEXT else "number"}">{escape(head)}</th>' for head in heads)]
    columns = [data[name].values.tolist() for name in swept] + [values.tolist() for values, _ in found.values()]
    for number, row in enumerate(zip(*columns, strict=True)):
        lines.append("".join(_cell(value) for value in (number, *row)))
    return '<div class="wide"><table>' + "\n".join(f"<tr>{line}</tr>" for line in lines) + "</table></div>"


def _cell(value) -> str:
    if isinstance(value, str):
        return f'<td class="text">{escape(value)}</td>'
    if math.isinf(value):
        return "<td>∞</td>"
    return f"<td>{'–' if math.isnan(value) else f'{value:.4g}'}</td>"


def _listed(versions: dict[str, str]) -> str:
    return ", ".join(f"{escape(name)} {escape(version)}" for name, version in versions.items())
