"""A fixture that speeds up many small trainings of skins and gestures."""

from contextlib import contextmanager

import pytest
from threadpoolctl import ThreadpoolController

from jeit.touch.learnt import extras, learnt_skin


@contextmanager
def libraries_found_once():
    """Search once for libraries whose threads are limited, and not at each fold.

    The search reads all memory maps of the process, and compiled code makes tens of thousands of them.
    """
    with extras.one_thread(), pytest.MonkeyPatch.context() as patch:
        controller = ThreadpoolController()
        for module in (extras, learnt_skin):
            patch.setattr(module, "one_thread", lambda: controller.limit(limits=1))
        yield
