"""Train neural networks on arrays, and store trained networks as files.

`fit_network` trains any equinox network by Adam with early stopping, and resumes after an interruption; `write_model`
and `read_model` store networks as arrays of numbers with a JSON header, never a pickle. Training needs the extra
`learn`; using a trained network does not.
"""

from __future__ import annotations

import lazy_loader

from jeit.arguments.moved_names import with_moved_names as _with_moved_names

_load_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = _with_moved_names(__name__, _load_attribute)
