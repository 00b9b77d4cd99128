"""jeit: differentiable electrical impedance tomography in JAX.

The most common names, and the packages that contain further names:

- `read`: reading of measured files (`jeit.data`);
- `image_difference`: an image from two frames, in one call (`jeit.imaging`, `jeit.report`);
- `Disk`, `Rectangle`: outlines and their meshes (`jeit.mesh`);
- `BoundaryElectrodes`, `ring`: electrodes (`jeit.electrodes`) and their layouts (`jeit.layout`);
- `body_mesh`: a mesh with smaller cells at the electrodes;
- `adjacent`: drive and measurement patterns (`jeit.protocol`);
- `ForwardModel`: voltages and Jacobian for a given conductivity (`jeit.forward`);
- `calibrate`, `one_step`, `reconstruct`: linear and nonlinear imaging (`jeit.inverse`);
- `find_inclusions`: analysis of images (`jeit.image`); location, force and gestures of touches on a skin: `jeit.touch`;
- comparison and optimisation of electrode layouts: `jeit.design`; microphones under a skin: `jeit.acoustic`;
- `plot_image`: plots (`jeit.plot`).

Importing jeit turns on JAX's 64-bit mode, unless JAX_ENABLE_X64 is set. It also keeps compiled code in the user's cache
folder, unless JAX is configured with another folder or JEIT_COMPILATION_CACHE is "off". Subpackages are imported when
first used.
"""

from __future__ import annotations

import lazy_loader

from jeit.start import keep_compiled_code as _keep_compiled_code
from jeit.start import refuse_compiled_code_in_forks as _refuse_compiled_code_in_forks
from jeit.start import take_double_precision as _take_double_precision

_take_double_precision()
_keep_compiled_code()
_refuse_compiled_code_in_forks()

_load_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str):
    if name == "__version__":
        from importlib.metadata import version

        return version("jeit")
    return _load_attribute(name)
