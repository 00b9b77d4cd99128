"""What skins that learn need besides jeit's own dependencies."""

from __future__ import annotations

from importlib.util import find_spec

_PACKAGES = {"sklearn": "scikit-learn", "skops": "skops", "optax": "optax", "networkx": "networkx"}


def need_learning() -> None:
    """Raise `ImportError`, saying what to install, where a package of the extra "learn" is missing."""
    missing = [_PACKAGES[name] for name in _PACKAGES if find_spec(name) is None]
    if missing:
        raise ImportError(f"learnt skins need {' and '.join(missing)}; pip install 'jeit[learn]'.")
