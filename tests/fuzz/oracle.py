"""Permitted outcomes for a file: it is accepted, or one clear error says why not, within limits of time and memory."""

import resource
import signal
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass

LONGEST, SECONDS, MEMORY = 400, 60, 2 * 10**9
# Errors that describe what is wrong with a file, or what is not installed.
CLEAR = (ValueError, FileNotFoundError, ImportError)


class Hung(BaseException):
    """The time limit was exceeded. This is no `Exception`, so that no handler catches it."""


@dataclass(frozen=True)
class Outcome:
    """The outcome for one file: "accepted", "refused", or the kind of fault, with the message."""

    kind: str
    message: str
    seconds: float

    @property
    def faulty(self) -> bool:
        return self.kind not in ("accepted", "refused")


def outcome(use: Callable[[], object], seconds: float = SECONDS) -> Outcome:
    """Use a file within limits of time and address space, and return the outcome."""
    start = time.perf_counter()
    try:
        with _limits(seconds), warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            use()
        kind, message = "accepted", ""
    except Hung:
        kind, message = "hung", "".join(traceback.format_exc(limit=-3))
    except CLEAR as error:
        message = str(error)
        foreign = type(error) not in (ValueError, FileNotFoundError, ImportError, UnicodeError)
        foreign &= not type(error).__module__.startswith("jeit")
        kind = "refused" if message and len(message) <= LONGEST and not foreign else "unclear"
        message = f"{type(error).__name__} ({len(message)}): {message[:LONGEST]}"
    except (Exception, RecursionError) as error:
        kind = type(error).__name__
        message = f"{str(error)[:200]} | {_where(error)}"
    return Outcome(kind, message, time.perf_counter() - start)


def _where(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    return " < ".join(f"{one.filename.rpartition('/')[2]}:{one.lineno}" for one in reversed(frames[-6:]))


@contextmanager
def _limits(seconds: float):
    def stop(number, frame):
        raise Hung

    before = signal.signal(signal.SIGALRM, stop)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    with open("/proc/self/statm") as file:
        taken = int(file.read().split()[0]) * resource.getpagesize()
    signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)  # repeat it, in case the first is raised where it is ignored
    resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
