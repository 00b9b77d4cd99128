"""Cold starts: `import jeit`, and the first picture of `jeit demo`."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def import_seconds(repeats: int = 5) -> float:
    """Median time of `import jeit` in a fresh interpreter, in seconds."""
    code = "import time; start = time.perf_counter(); import jeit; print(time.perf_counter() - start)"
    runs = [
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        for _ in range(repeats)
    ]
    return statistics.median(float(run) for run in runs)


def demo_seconds(limit: float = 120.0) -> float | None:
    """Time from starting `jeit demo` to its first picture on disk, nothing cached; None if there is no such command."""
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
            return None
        finally:
            process.kill()
            process.wait()
