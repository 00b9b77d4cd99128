"""Set-up of JAX on importing jeit: double precision, compiler flags, and what happens in forked processes."""

from __future__ import annotations

import os
import warnings
from importlib.metadata import version

import jax


def take_double_precision() -> None:
    """Set JAX to double precision: a light touch changes voltages by 1e-4, for which single precision is not enough.
    JAX_ENABLE_X64 set by the user takes precedence, with a warning of the cost of single precision
    (docs/numerics.md)."""
    if "JAX_ENABLE_X64" not in os.environ:
        jax.config.update("jax_enable_x64", True)
    elif not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        warnings.warn(
            f"JAX_ENABLE_X64={os.environ['JAX_ENABLE_X64'][:20]}: jeit computes in single precision, where voltages "
            "are wrong by 1e-5 of the largest (1e-14 in double precision), a tenth of what a light touch changes, and "
            "contacts and conductivities must not differ by more than some thousand times; unset it for double "
            "precision.",
            UserWarning,
            stacklevel=3,
        )


def quick_compilation() -> str:
    """A value for the environment variable XLA_FLAGS, to be set before JAX computes anything.

    Code without optimisation takes a quarter of the time to compile. XLA ends the process at flags that it does not
    know, and they come and go.
    """
    fusion = " --xla_cpu_use_fusion_emitters=false" if version("jaxlib").startswith("0.10.") else ""
    return f"--xla_backend_optimization_level=0{fusion}"


_refusing = False


def refuse_compiled_code_in_forks() -> None:
    """Make compiled code raise `RuntimeError` in processes that `os.fork` makes once JAX has started: its threads are
    not in them, so that a program would wait for ever. Methods that run in NumPy still work; and where a process forks
    before JAX has started, everything works."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_forked)


def _forked() -> None:
    global _refusing
    if _refusing or not _has_started():
        return
    _refusing = True
    jax.clear_caches()  # nothing compiled before the fork is found again, and what is traced anew is refused
    jax.monitoring.register_event_duration_secs_listener(_refuse)


def _has_started() -> bool:
    from jax._src import xla_bridge

    return xla_bridge.backends_are_initialized()


def _refuse(event: str, duration_secs: float, **_: str | int) -> None:
    """A listener to JAX's monitoring events: raises before a program is compiled, after tracing."""
    del duration_secs
    if event.startswith("/jax/core/compile"):
        raise RuntimeError(
            "This process was forked from one that had started JAX, whose threads are not in it: compiled code would "
            'wait for ever. Start processes by multiprocessing.get_context("spawn"), or fork before anything is '
            "computed; methods of a model that are called as they are, outside jax.jit and derivatives, work here."
        )
