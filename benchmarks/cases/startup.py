"""Cold starts: `import jeit`, and the first picture of `jeit demo`."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.harness.case import NOT_MEASURED, Asked, Case, Options, Result, Table, judged
from benchmarks.harness.tables import duration

IMPORT, DEMO, LIMIT = 2.0, 15.0, 120.0


def run(options: Options) -> Result:
    """Both, in fresh processes; a quick run leaves out the demonstration."""
    importing = import_seconds(2 if options.quick else 5)
    demo = None if options.quick else demo_seconds()
    told = "–" if demo is None else duration(demo) if demo < LIMIT else f"> {LIMIT:g} s"
    asked = f"first picture of `jeit demo` within {DEMO:g} s of a cold start"
    checks = [
        judged(f"`import jeit` < {IMPORT:g} s", duration(importing), importing < IMPORT),
        Asked(asked, "–", NOT_MEASURED) if demo is None else judged(asked, told, demo < DEMO),
    ]
    rows = [["import jeit", duration(importing)], ["jeit demo, first picture", told]]
    return Result([Table(["cold start", "time"], rows)], checks)


def import_seconds(repeats: int = 5) -> float:
    """Median time of `import jeit` in a fresh interpreter, in seconds."""
    code = "import time; start = time.perf_counter(); import jeit; print(time.perf_counter() - start)"
    runs = [
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        for _ in range(repeats)
    ]
    return statistics.median(float(run) for run in runs)


def demo_seconds(limit: float = LIMIT) -> float | None:
    """Time from starting `jeit demo` to its first picture on disk, nothing cached, or the limit if it takes longer.

    None if it ends without a picture.
    """
    with tempfile.TemporaryDirectory() as folder:
        environment = dict(os.environ, XDG_CACHE_HOME=folder + "/cache", MPLCONFIGDIR=folder + "/matplotlib")
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        start = time.perf_counter()
        command = [sys.executable, "-c", "from jeit.cli import main; main()", "demo", "--output", folder + "/out"]
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            while time.perf_counter() - start < limit:
                ended = process.poll() is not None
                if any(picture.stat().st_size for picture in Path(folder, "out").glob("*.png")):
                    return time.perf_counter() - start
                if ended:
                    return None
                time.sleep(0.02)
            return limit
        finally:
            process.kill()
            process.wait()


CASE = Case("startup", "cold starts: `import jeit`, and the first picture of `jeit demo`", run, 0.5)
