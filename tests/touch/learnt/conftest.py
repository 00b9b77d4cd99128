"""A skin that has learnt, and a quick one."""

from contextlib import contextmanager

import numpy as np
import pytest
from made_skins import record
from thread_limits import libraries_found_once

from jeit.touch import LearntSkin, Presses
from jeit.touch.learnt import methods


@pytest.fixture(scope="module", autouse=True)
def _libraries_found_once():
    with libraries_found_once():
        yield


@pytest.fixture(scope="session")
def recorded():
    """Presses on the made-up skin."""
    return record(200)


class Mean:
    """What errs most: the mean of what was learnt from, whatever is asked."""

    def __init__(self, features, targets):
        self.mean = targets.mean(axis=0)

    def predict(self, features):
        return np.tile(self.mean, (len(features), 1))


@contextmanager
def few_seconds():
    """Methods that take seconds say the mean, and trees are few; `test_methods` has those methods themselves."""
    with libraries_found_once(), pytest.MonkeyPatch.context() as patch:
        for slow in ("trees", "network", "som"):
            patch.setitem(methods.REGRESSORS, slow, Mean)
        patch.setattr(methods, "_TREES", 10)
        yield


@pytest.fixture
def few_seconds_for_all_methods():
    with few_seconds():
        yield


@pytest.fixture(scope="session")
def skin(recorded):
    """What was learnt from them with all defaults."""
    with few_seconds():
        return LearntSkin.fit(Presses.create(**recorded))


@pytest.fixture(scope="session")
def quick(recorded):
    """The same by the quickest method."""
    with libraries_found_once():
        return LearntSkin.fit(Presses.create(**recorded), method="neighbours")
