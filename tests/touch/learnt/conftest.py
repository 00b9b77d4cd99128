"""A trained skin, and one trained by a quick method."""

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
    """Presses on the simulated skin."""
    return record(140)


class Mean:
    """A poor method: it predicts the mean of the training data for every frame."""

    def __init__(self, features, targets):
        self.mean = targets.mean(axis=0)

    def predict(self, features):
        return np.tile(self.mean, (len(features), 1))


@contextmanager
def few_seconds():
    """Methods that take seconds predict the mean, and trees are few. `test_methods` covers those methods themselves."""
    with libraries_found_once(), pytest.MonkeyPatch.context() as patch:
        for slow in ("trees", "network", "som"):
            patch.setitem(methods.REGRESSORS, slow, Mean)
        patch.setattr(methods, "_NUM_TREES", 10)
        yield


@pytest.fixture
def few_seconds_for_all_methods():
    with few_seconds():
        yield


@pytest.fixture(scope="session")
def skin(recorded):
    """A skin trained on the recorded presses with all defaults."""
    with few_seconds():
        return LearntSkin.fit(Presses.create(**recorded))


@pytest.fixture(scope="session")
def quick(recorded):
    """The same, trained by the quickest method."""
    with libraries_found_once():
        return LearntSkin.fit(Presses.create(**recorded), method="neighbours")
