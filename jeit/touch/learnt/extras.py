"""What learning needs besides jeit's own dependencies."""

from contextlib import AbstractContextManager
from importlib.util import find_spec


def need_learning() -> None:
    """Raise `ImportError`, saying what to install, where a package of the extra "learn" is missing."""
    missing = [name for name in ("sklearn", "skops", "optax") if find_spec(name) is None]
    if missing:
        raise ImportError(f"learnt skins need {' and '.join(missing)}; pip install 'jeit[learn]'.")


def one_thread() -> AbstractContextManager:
    """Within it libraries keep to one thread: on presses by the thousand, more wait for each other longer than they
    work."""
    from threadpoolctl import threadpool_limits

    return threadpool_limits(1)
