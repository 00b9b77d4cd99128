"""Studies: a TOML file describes a sweep over layouts, skins and protocols, which runs in chunks and survives a crash.

`read_study` checks the file, `run_study` solves what is not finished, `open_results` opens it in xarray;
`jeit.report.write_study_report` makes one page of it. Needs the extra `cluster`: zarr, xarray and dask.distributed.
"""

from __future__ import annotations

from jeit.arguments.moved import tell_old_names as _tell_old_names
from jeit.design.study.progress import Progress
from jeit.design.study.run import run_study, study_progress
from jeit.design.study.spec import Point, Study, read_study
from jeit.design.study.store import open_results

_tell_old_names(__name__)

__all__ = [
    "Point",
    "Progress",
    "Study",
    "open_results",
    "read_study",
    "run_study",
    "study_progress",
]
