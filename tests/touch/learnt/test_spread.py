"""Standard deviations of what is learnt hold as often as they say."""

import numpy as np

from jeit.touch.learnt.numbers import Spread


def test_deviations_hold_for_errors_of_which_few_are_large():
    """Their root mean square would hold for nearly all of them."""
    rng = np.random.default_rng(0)
    said, changes, errors = rng.normal(size=(3, 1500, 2))
    errors = errors * np.where(rng.random((1500, 1)) < 0.1, 10.0, 1.0)
    spread = Spread.learn(said[:500], changes[:500], errors[:500], np.ones(500, bool))
    for some, deviations in ((slice(500, None), spread), (slice(500), spread.held_out)):
        within = np.mean(np.abs(errors[some]) <= deviations(said[some], changes[some]))
        assert 0.6 < within < 0.86


def test_deviations_are_in_the_units_of_what_is_told():
    rng = np.random.default_rng(0)
    said, changes, errors = rng.normal(size=(3, 300, 2))
    one, thousand = (
        Spread.learn(unit * said, changes, unit * errors, np.ones(300, bool))(unit * said, changes)
        for unit in (1.0, 1000.0)
    )
    np.testing.assert_allclose(thousand, 1000 * one, rtol=1e-6)
