import jax
import pytest

from jeit_solvers.sparse import padded_fronts

jax.config.update("jax_enable_x64", True)


@pytest.fixture(autouse=True)
def _small_problems_have_several_stages(monkeypatch):
    """As large problems have: small ones, which compile quickly, would otherwise be a single front."""
    monkeypatch.setattr(padded_fronts, "_MAX_SINGLE_FRONT", padded_fronts._LEAF_SIZE)
