"""jeit: differentiable electrical impedance tomography in JAX.

The names used most, and where the rest is:

- `read`: measured files (`jeit.data`);
- `image_difference`: from two frames to a picture, in one call (`jeit.imaging`, `jeit.report`);
- `Disk`: outlines and their meshes (`jeit.mesh`);
- `BoundaryElectrodes`, `ring`: electrodes (`jeit.electrodes`) and where to put them (`jeit.layout`);
- `adjacent`: what is driven and measured (`jeit.protocol`);
- `ForwardModel`: conductivity to voltages and Jacobian (`jeit.forward`);
- `calibrate`, `one_step`, `reconstruct`: linear and nonlinear imaging (`jeit.inverse`);
- `find_inclusions`: what an image shows (`jeit.image`); who touches a skin, where and how hard: `jeit.touch`;
- layouts of electrodes compared and improved: `jeit.design`; microphones under a skin: `jeit.acoustic`; what is not
  measured: `jeit.simulate`;
- `plot_image`: pictures (`jeit.plot`).

Importing jeit turns on JAX's 64-bit mode, unless JAX_ENABLE_X64 is set, and keeps compiled code in the user's cache
folder, unless JAX has been told of another or JEIT_COMPILATION_CACHE is "off". Rooms are imported when first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from jeit.start import keep_compiled_code as _keep_compiled_code
from jeit.start import refuse_compiled_code_in_forks as _refuse_compiled_code_in_forks
from jeit.start import take_double_precision as _take_double_precision

if TYPE_CHECKING:
    from jeit.data import read as read
    from jeit.electrodes import BoundaryElectrodes as BoundaryElectrodes
    from jeit.forward import ForwardModel as ForwardModel
    from jeit.image import find_inclusions as find_inclusions
    from jeit.imaging import image_difference as image_difference
    from jeit.inverse import calibrate as calibrate
    from jeit.inverse import one_step as one_step
    from jeit.inverse import reconstruct as reconstruct
    from jeit.layout import ring as ring
    from jeit.mesh import Disk as Disk
    from jeit.plot import plot_image as plot_image
    from jeit.protocol import adjacent as adjacent

_take_double_precision()
_keep_compiled_code()
_refuse_compiled_code_in_forks()

_ROOMS = (
    "acoustic",
    "data",
    "design",
    "electrodes",
    "forward",
    "image",
    "imaging",
    "inverse",
    "layout",
    "mesh",
    "plot",
    "protocol",
    "report",
    "simulate",
    "touch",
)
_HOMES = {
    "BoundaryElectrodes": "electrodes",
    "Disk": "mesh",
    "ForwardModel": "forward",
    "adjacent": "protocol",
    "calibrate": "inverse",
    "find_inclusions": "image",
    "image_difference": "imaging",
    "one_step": "inverse",
    "plot_image": "plot",
    "read": "data",
    "reconstruct": "inverse",
    "ring": "layout",
}


def __getattr__(name: str):
    if name in _ROOMS:
        return importlib.import_module(f"jeit.{name}")
    if name in _HOMES:
        return getattr(importlib.import_module(f"jeit.{_HOMES[name]}"), name)
    if name == "__version__":
        from importlib.metadata import version

        return version("jeit")
    from jeit.arguments.moved import missing

    raise missing(__name__, name)


__all__ = sorted(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


def __dir__() -> list[str]:
    return sorted([*_ROOMS, *_HOMES, "__version__"])
