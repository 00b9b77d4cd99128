"""Processes forked from one that has used JAX: compiled code is refused there, for it would wait for ever."""

from __future__ import annotations

import os

import jax

_refusing = False


def refuse_compiled_code_in_forks() -> None:
    """See to it that compiled code raises `RuntimeError` in processes that `os.fork` makes once JAX has started: its
    threads are not in them, so that a program would wait for ever. What NumPy answers is answered; and where a process
    forks before JAX has started, all works."""
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
    """A listener to what JAX tells of its work: tracing ends before a program is compiled."""
    del duration_secs
    if event.startswith("/jax/core/compile"):
        raise RuntimeError(
            "This process was forked from one that had started JAX, whose threads are not in it: compiled code would "
            'wait for ever. Start processes by multiprocessing.get_context("spawn"), or fork before anything is '
            "computed; methods of a model that are called as they are, outside jax.jit and derivatives, work here."
        )
