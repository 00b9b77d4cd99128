"""Studies: sweeps over electrode layouts, skins and measurement protocols described by a TOML file, run in chunks and
resumable after a crash.

`read_study` reads and checks the file, `run_study` computes the unfinished chunks, `open_results` opens the results as
an xarray dataset, and `jeit.design.reports.write_study_report` writes a report of one page. Studies need the extra
`cluster`: zarr, xarray and dask.distributed.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
