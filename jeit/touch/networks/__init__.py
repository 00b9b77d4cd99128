"""Networks that image: from a skin's voltages to a map of how deep it is indented, learnt from simulated touches.

`learn_images` makes the touches of a described skin, trains a network, and keeps it; `read_network` reads it again, and
`ImageNetwork.depth` images frames. Two designs: "three-stages", that of Park et al. 2022, and "unrolled", which is
trained through the skin's forward model.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
