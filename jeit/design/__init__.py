"""Design of electrode layouts: comparison, optimisation, and choice of measurements, before any material is cut.

For a given layout (the electrodes' positions), sensitivity maps, virtual taxels and scores are computed. Layouts are
optimised by gradients, within an outline and with minimum spacing, and the most informative measurements are selected.
Studies of many layouts can be resumed after a crash. Results are drawn by `plot_…` and written to files by `write_…`.
This package exports the functions and classes that users call; the classes of the results are in the package's modules.

Names are imported when first used, so that the command line shows the defaults (`jeit.design.defaults`) without delay.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
