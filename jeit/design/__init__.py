"""Where electrodes should go, before any material is cut.

What a skin of a given layout, its electrodes' positions, will feel: sensitivity maps, virtual taxels, scores. Better
layouts: moved by gradients, within an outline and with minimum spacing; and the measurements worth making with them.
Studies of many layouts, which survive a crash. Here is what a designer uses; the rest, such as the classes of what is
found, is in the modules.

Names are imported when first used: the command line shows defaults (`jeit.design.defaults`) without waiting.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
