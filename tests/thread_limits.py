"""A fixture that speeds up many small trainings of skins and gestures."""

from contextlib import contextmanager

import pytest
from threadpoolctl import ThreadpoolController

from jeit.touch.learnt import learnt_skin, resource_limits


@contextmanager
def libraries_found_once():
    """Search once for libraries whose threads are limited, and not at each fold.

    The search reads all memory maps of the process, and compiled code makes tens of thousands of them.
    """
    with resource_limits.limit_to_one_thread(), pytest.MonkeyPatch.context() as patch:
        controller = ThreadpoolController()
        for module in (resource_limits, learnt_skin):
            patch.setattr(module, "limit_to_one_thread", lambda: controller.limit(limits=1))
        yield
