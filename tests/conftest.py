"""Fixtures and settings shared by all tests: the folders of measured data, and a cache of compiled code between
runs."""

import gc
import os
import signal
import sys
import zlib
from pathlib import Path

# Two workers with two threads each would wait for each other, which makes small products tens of times slower.
if "OPENBLAS_NUM_THREADS" not in os.environ:
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    if "numpy" in sys.modules:  # a plugin has already imported NumPy, so that the variable comes too late
        from threadpoolctl import threadpool_limits

        threadpool_limits(1, user_api="blas")

import jax
import pytest

# In CI, deprecation warnings of other packages are errors where a module of this repository triggers them.
DEPRECATIONS = ("DeprecationWarning", "PendingDeprecationWarning", "FutureWarning")
OWN_MODULES = (r"jeit(_solvers)?(\..*)?$", r"(test_|conftest|benchmarks).*")

ROOT = Path(__file__).resolve().parents[1]
MAPS = Path("/proc/self/maps")

# A background job, and so its child processes, starts with Ctrl-C ignored; some tests stop processes by Ctrl-C.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)

# Tracing creates many small objects, which would trigger Python's garbage collection again and again.
gc.set_threshold(100_000, 20, 50)

# The same programs are compiled in every run, and many in both workers and in the processes that tests start: keep them
# all. The variables are for the processes.
jax.config.update("jax_compilation_cache_dir", str(ROOT / ".jax_cache"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
os.environ["JAX_COMPILATION_CACHE_DIR"] = str(ROOT / ".jax_cache")
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"

# Most of a test's time is compilation. Compile quickly and run a little slower; XLA_FLAGS="" tests the users' settings.
from jeit.start import quick_compilation  # noqa: E402, after JAX's cache folder is set

os.environ.setdefault("XLA_FLAGS", f"{quick_compilation()} --xla_cpu_parallel_codegen_split_count=1")


def pytest_configure(config):
    """Turn deprecation warnings into errors in CI, so that changes of other packages are noticed there first."""
    if os.environ.get("JEIT_DEPRECATIONS") == "error":
        for module in OWN_MODULES:
            for category in DEPRECATIONS:
                config.addinivalue_line("filterwarnings", f"error::{category}:{module}")


def pytest_collection_finish():
    """Exclude what has been imported from garbage collection: it stays until the end.

    Hypothesis would parse every module of jeit for numbers and words to try, for three seconds in each worker.
    """
    if "hypothesis.internal.conjecture.providers" in sys.modules:
        sys.modules["hypothesis.internal.conjecture.providers"].is_local_module_file = lambda path: False
    gc.freeze()


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish():
    """Exclude everything: pytest and Python collect garbage six times at the end, for up to ten seconds."""
    gc.freeze()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Mark the tests of `repeated.txt` as slow: quicker ones reach the same code (see `find_repeated.py`). Run those
    marked `slow(first=True)` first: they take longest, and no worker waits for another one at the end.

    With JEIT_REPEATED=name, as in CI, only a third of the repeated tests are kept: the third that the name selects.
    """
    repeated = set((ROOT / "tests" / "repeated.txt").read_text("utf-8").splitlines())
    name, kept, left_out = os.environ.get("JEIT_REPEATED"), [], []
    for item in items:
        if item.nodeid in repeated:
            item.add_marker(pytest.mark.slow)
        is_left_out = item.nodeid in repeated and name and zlib.crc32(f"{name} {item.nodeid}".encode()) % 3
        (left_out if is_left_out else kept).append(item)
    items[:] = kept
    config.hook.pytest_deselected(items=left_out)
    items.sort(key=lambda item: not any(mark.kwargs.get("first") for mark in item.iter_markers("slow")))


def _shared(variable: str, folder: str) -> Path | None:
    named = os.environ.get(variable)
    candidates = [*([Path(named)] if named else []), ROOT.parent / "shared" / folder]
    return next((path for path in candidates if path.is_dir()), None)


@pytest.fixture(scope="module", autouse=True)
def _compiled_code_goes_before_memory_maps_do():
    """Clear compiled code before the process reaches Linux's limit of 65,530 memory maps, at which XLA crashes.

    A program takes several maps and a quick test module up to 5,000. Clearing after every module would compile the same
    small programs again.
    """
    yield
    if not MAPS.exists() or MAPS.read_bytes().count(b"\n") > 20_000:
        jax.clear_caches()


@pytest.fixture(scope="module", autouse=True)
def _figures_are_closed():
    """Close figures after each module: Matplotlib warns of more than twenty open figures."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of measured data (kit4, ktc2023, tank6cm); the test is skipped without it."""
    folder = _shared("JEIT_DATA", "data")
    if folder is None:
        pytest.skip("no measured data: set JEIT_DATA to the folder that holds kit4, ktc2023 and tank6cm")
    return folder


@pytest.fixture(scope="session")
def reference_folder() -> Path:
    """The folder of another toolkit's reference numbers; the test is skipped without it."""
    folder = _shared("JEIT_REFERENCE", "reference")
    if folder is None:
        pytest.skip("no reference numbers: set JEIT_REFERENCE to the folder that holds circ2d_cem_576.mat")
    return folder
