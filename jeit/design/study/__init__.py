"""Studies: a TOML file describes a sweep over layouts, skins and protocols, which runs in chunks and survives a crash.

`read_study` checks the file, `run_study` solves what is not finished, `open_results` opens it in xarray;
`jeit.report.write_study_report` makes one page of it. Needs the extra `cluster`: zarr, xarray and dask.distributed.
"""

from jeit.design.study.run import Progress as Progress
from jeit.design.study.run import run_study as run_study
from jeit.design.study.run import study_progress as study_progress
from jeit.design.study.spec import Point as Point
from jeit.design.study.spec import Study as Study
from jeit.design.study.spec import read_study as read_study
from jeit.design.study.store import open_results as open_results
