"""Neural networks that estimate a map of indentation depth from a skin's voltages, trained on simulated touches.

`learn_images` simulates touches of a described skin, trains a network on them, and stores the network in a file;
`read_network` reads the network, and `ImageNetwork.depth` computes depth maps of frames. There are two network designs:
"three-stages", that of Park et al. 2022, and "unrolled", which is trained with the skin's forward model.
"""

from __future__ import annotations

import lazy_loader

from jeit.arguments.moved_names import with_moved_names as _with_moved_names

_load_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = _with_moved_names(__name__, _load_attribute)
