"""A skin that has learnt, and a quick one."""

import pytest
from made_skins import record

from jeit.touch import LearntSkin, Presses


@pytest.fixture(scope="session")
def recorded():
    """Presses on the made-up skin."""
    return record(200)


@pytest.fixture(scope="session")
def skin(recorded):
    """What was learnt from them with all defaults."""
    return LearntSkin.fit(Presses.create(**recorded))


@pytest.fixture(scope="session")
def quick(recorded):
    """The same by the quickest method."""
    return LearntSkin.fit(Presses.create(**recorded), method="neighbours")
