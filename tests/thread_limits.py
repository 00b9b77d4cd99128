"""Learning skins and gestures quickly among many other tests."""

from contextlib import contextmanager

import pytest
from threadpoolctl import ThreadpoolController

from jeit.touch.learnt import extras, learnt_skin


@contextmanager
def libraries_found_once():
    """Libraries that keep to one thread are looked for once, and not anew at each fold.

    They are looked for among all that a process has mapped, and compiled code maps tens of thousands of pieces.
    """
    with extras.one_thread(), pytest.MonkeyPatch.context() as patch:
        controller = ThreadpoolController()
        for module in (extras, learnt_skin):
            patch.setattr(module, "one_thread", lambda: controller.limit(limits=1))
        yield
