"""Shared by all tests: where measured data lie, and a cache that keeps compiled code between runs."""

import gc
import os
import signal
import sys
from pathlib import Path

# Two workers with two threads each would wait for each other: small products are tens of times slower then.
if "OPENBLAS_NUM_THREADS" not in os.environ:
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    if "numpy" in sys.modules:  # a plugin of another package has loaded it, and the variable comes too late
        from threadpoolctl import threadpool_limits

        threadpool_limits(1, user_api="blas")

import jax
import pytest

# What other packages deprecate ends a test where CI asks for it, and a module of ours called it.
DEPRECATIONS = ("DeprecationWarning", "PendingDeprecationWarning", "FutureWarning")
OWN_MODULES = (r"jeit(_solvers)?(\..*)?$", r"(test_|conftest|benchmarks).*")

ROOT = Path(__file__).resolve().parents[1]
MAPS = Path("/proc/self/maps")

# A job in the background starts with Ctrl-C ignored, and so do its children, some of which tests stop by it.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)

# Programs being traced are many small objects, which Python would look through for rubbish again and again.
gc.set_threshold(100_000, 20, 50)

# The same shapes come back run after run.
jax.config.update("jax_compilation_cache_dir", str(ROOT / ".jax_cache"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)

# Most of a test's time is compilation: compile quickly, run a little slower; XLA_FLAGS="" tests what users run.
from jeit.start import quick_compilation  # noqa: E402, after JAX was told where to keep code

os.environ.setdefault("XLA_FLAGS", f"{quick_compilation()} --xla_cpu_parallel_codegen_split_count=1")


def pytest_configure(config):
    """Let deprecations be errors in CI: there a release of another package is noticed, and not by users."""
    if os.environ.get("JEIT_DEPRECATIONS") == "error":
        for module in OWN_MODULES:
            for category in DEPRECATIONS:
                config.addinivalue_line("filterwarnings", f"error::{category}:{module}")


def _shared(variable: str, folder: str) -> Path | None:
    named = os.environ.get(variable)
    candidates = [*([Path(named)] if named else []), ROOT.parent / "shared" / folder]
    return next((path for path in candidates if path.is_dir()), None)


@pytest.fixture(scope="module", autouse=True)
def _compiled_code_goes_before_memory_maps_do():
    """Linux gives a process 65,530 memory maps; compiled code takes several a program, and XLA crashes at the end.

    A quick module takes up to 5,000 of them; to forget after each compiled the same small programs in the next.
    """
    yield
    if not MAPS.exists() or MAPS.read_bytes().count(b"\n") > 20_000:
        jax.clear_caches()


@pytest.fixture(scope="module", autouse=True)
def _figures_are_closed():
    """Matplotlib warns of more than twenty that are open."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of measured data (kit4, ktc2023, tank6cm); skips the test where there is none."""
    folder = _shared("JEIT_DATA", "data")
    if folder is None:
        pytest.skip("no measured data: set JEIT_DATA to the folder that holds kit4, ktc2023 and tank6cm")
    return folder


@pytest.fixture(scope="session")
def reference_folder() -> Path:
    """The folder of another toolkit's numbers; skips the test where there is none."""
    folder = _shared("JEIT_REFERENCE", "reference")
    if folder is None:
        pytest.skip("no reference numbers: set JEIT_REFERENCE to the folder that holds circ2d_cem_576.mat")
    return folder
