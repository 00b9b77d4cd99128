"""Studies: a TOML file describes a sweep over layouts, skins and protocols, which runs in chunks and survives a crash.

`read_study` checks the file, `run_study` solves what is not finished, `open_results` opens it in xarray;
`jeit.design.reports.write_study_report` makes one page of it. Needs the extra `cluster`: zarr, xarray and
dask.distributed.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
