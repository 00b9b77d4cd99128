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
- layouts of electrodes compared and improved: `jeit.design`; microphones under a skin: `jeit.acoustic`;
- `plot_image`: pictures (`jeit.plot`).

Importing jeit turns on JAX's 64-bit mode, unless JAX_ENABLE_X64 is set, and keeps compiled code in the user's cache
folder, unless JAX has been given another or JEIT_COMPILATION_CACHE is "off". Rooms are imported when first used.
"""

from __future__ import annotations

import lazy_loader

from jeit.start import keep_compiled_code as _keep_compiled_code
from jeit.start import refuse_compiled_code_in_forks as _refuse_compiled_code_in_forks
from jeit.start import take_double_precision as _take_double_precision

_take_double_precision()
_keep_compiled_code()
_refuse_compiled_code_in_forks()

_find, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str):
    if name == "__version__":
        from importlib.metadata import version

        return version("jeit")
    return _find(name)
