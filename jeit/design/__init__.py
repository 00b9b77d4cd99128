"""Design of electrode layouts: comparison, optimisation, and choice of measurements, before any material is cut.

For a given layout (the electrodes' positions), sensitivity maps, virtual taxels and scores are computed. Layouts are
optimised by gradients, within an outline and with minimum spacing, and the most informative measurements are selected.
Studies of many layouts can be resumed after a crash. This package exports the main functions; the others, such as the
classes of results, are in the modules.

Names are imported when first used: the command line shows defaults (`jeit.design.defaults`) without waiting.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
