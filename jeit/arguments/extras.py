"""Optional packages, listed as extras in pyproject.toml, and the error raised if one is not installed."""

from __future__ import annotations

import importlib
from importlib.util import find_spec
from types import ModuleType

# For each extra, the modules that jeit imports, and the installable package that contains each module.
EXTRAS = {
    "mesh": {"gmsh": "gmsh"},
    "cad": {"ezdxf": "ezdxf"},
    "learn": {"sklearn": "scikit-learn", "skops": "skops", "optax": "optax", "networkx": "networkx"},
    "sound": {"soundfile": "soundfile"},
    "large": {"pyamg": "pyamg"},
    "live": {"starlette": "starlette", "uvicorn": "uvicorn", "websockets": "websockets", "serial": "pyserial"},
    "mkl": {"pypardiso": "pypardiso"},
    "vision": {"cv2": "opencv-python-headless"},
    "view": {"pyvista": "pyvista"},
    "cluster": {"dask": "dask", "distributed": "distributed", "zarr": "zarr", "xarray": "xarray"},
}

# Maximum number of characters of the reason why a package cannot be imported. The reason precedes the advice on what to
# install.
_MAX_REASON_LENGTH = 120


def require_extra(extra: str, task: str) -> None:
    """Raise `ImportError`, with the command to install it, if a package of `extra` is missing; `task` names the task
    for which the package is needed."""
    missing_packages = [package for module, package in EXTRAS[extra].items() if _is_missing(module)]
    if missing_packages:
        package_names = " and ".join(", ".join(missing_packages).rsplit(", ", 1))
        raise ImportError(f"{task} needs {package_names}: {installation_command(extra)}.")


def import_optional(module: str, task: str, alternative: str = "") -> ModuleType:
    """Import a module of an optional package; `task` names the task for which the module is needed.

    Raises `ImportError` if the import fails. The message states the reason, the package to install, and, if it is
    given, the `alternative` to the package.
    """
    try:
        return importlib.import_module(module)
    except (ImportError, OSError) as error:  # OSError: a system library that the package loads is missing
        extra = next(extra for extra, modules in EXTRAS.items() if module.partition(".")[0] in modules)
        package = EXTRAS[extra][module.partition(".")[0]]
        reason = (
            ""
            if _is_missing(module.partition(".")[0])
            else f", which cannot be imported ({str(error)[:_MAX_REASON_LENGTH]})"
        )
        raise ImportError(
            f"{task} needs {package}{reason}: {installation_command(extra)}.{alternative and f' {alternative}'}"
        ) from error


def installation_command(extra: str) -> str:
    """The command that installs jeit with an extra (a group of optional packages)."""
    return f"pip install 'jeit[{extra}]', or in a clone '.[{extra}]'"


def _is_missing(module: str) -> bool:
    try:
        return find_spec(module) is None
    except ValueError:  # the module is loaded but has no specification, as in a test
        return False
