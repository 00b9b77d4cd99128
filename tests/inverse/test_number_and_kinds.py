"""Number and kinds of bodies in a solid: which descriptions are tried, and which are left out, for given evidence."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ball_in_a_box import BALL, RADIUS, SIZE

from jeit.inverse.shapes import EllipsoidPrior, alternatives, number_and_kinds, search
from jeit.inverse.shapes.ellipsoid import Ellipsoids
from jeit.inverse.shapes.problem import ShapeFit
from jeit.mesh import box

MESH = box(*SIZE, num_points=400)
# Placeholder for the rows of fits, which these tests do not use.
ROWS: Any = None


@pytest.mark.parametrize("column", [True, False])
@pytest.mark.parametrize(("worse", "decided"), [(3.0, False), (5.0, True)])
def test_an_alternative_kind_depends_on_the_data_alone_and_has_its_own_deviation(worse, decided, column):
    bodies = Ellipsoids.create(MESH, EllipsoidPrior(odds_for_columns=1e6), [[0.0, 0.0, 0.05]], [1])
    bodies, coefficients = bodies.with_other_kind([0] if column else [], bodies.of_radii([RADIUS]))

    class Evidence:
        """The other kind is `worse` and has twice the deviation."""

        def fit(self, bodies, coefficients, *steps):
            return ShapeFit(bodies, coefficients, 1.0, ROWS)

        def negative_log_evidence(self, fit):
            return fit.bodies.odds + (0.0 if fit.bodies.is_other_kind[0] == column else worse)

        def deviations(self, fit):
            return np.full(len(fit.coefficients), 0.1 if fit.bodies.is_other_kind[0] == column else 0.2)

    problem: Any = Evidence()
    fitted = ShapeFit(bodies, coefficients, 1.0, ROWS)
    ((other, deviation),) = alternatives.alternatives(problem, fitted)  # pyright: ignore
    assert (other is None) == decided
    if other is not None:
        (own,) = alternatives.contrast_deviations(problem, fitted)  # pyright: ignore
        assert other.column != column
        assert deviation**2 - 0.01 == pytest.approx(4 * (own**2 - 0.01))


def test_a_kind_that_the_data_exclude_by_far_is_not_tried_again():
    bodies = Ellipsoids.create(MESH, EllipsoidPrior(), [[0.0, 0.0, 0.05], [0.03, 0.0, 0.04]], [1, 1])
    tried = []

    class Evidence:
        """The first body as a column costs 200 times as much; the second one costs 20 times as much."""

        def fit(self, bodies, coefficients, *steps):
            tried.append(bodies.is_other_kind.tolist())
            return ShapeFit(bodies, coefficients, 200.0 if bodies.is_other_kind[0] else 20.0, ROWS)

        def negative_log_evidence(self, fit):
            return fit.bodies.odds + fit.cost

    problem: Any = Evidence()
    found = number_and_kinds.SearchResult(ShapeFit(bodies, bodies.of_radii([0.02, 0.02]), 1.0, ROWS), [9.0, 9.0], ())  # pyright: ignore
    found, change = number_and_kinds.alternative_fits(problem, found)
    assert change is None
    assert sorted(tried) == [[False, True], [True, False], [True, True]]  # in any order, on several cores
    assert found.fit.bodies.is_kind_certain.tolist() == [True, False]
    tried.clear()
    assert number_and_kinds.alternative_fits(problem, found)[1] is None
    alternatives.alternatives(problem, found.fit)
    assert tried == [[False, True], [False, True]]
    on_another_mesh = found.fit.bodies.on(MESH)  # type: ignore[attr-defined]
    assert on_another_mesh.subset([1, 0]).is_kind_certain.tolist() == [False, True]
    assert found.fit.bodies.split(0, found.fit.coefficients, 0)[0].is_kind_certain.tolist() == [False] * 3


class Costs:
    """Problem whose fits cost what is given, one after the other."""

    def __init__(self, *costs):
        self.costs, self.steps = list(costs), []

    def fit(self, bodies, coefficients, steps, *_):
        self.steps.append(steps)
        return ShapeFit(bodies, coefficients, self.costs.pop(0), ROWS)

    def negative_log_evidence(self, fit):
        return fit.cost


def test_fits_that_cannot_be_supported_are_not_made():
    """A split when no gain of evidence is left; more steps without a body that is beyond doubt."""
    bodies = Ellipsoids.create(MESH, EllipsoidPrior(), [[0.0, 0.0, 0.05], [0.03, 0.0, 0.04]], [1, 1])
    coefficients = bodies.of_radii([0.02, 0.02])
    nothing_left: Any = Costs()
    assert number_and_kinds._split_bodies(nothing_left, ShapeFit(bodies, coefficients, 1.9, ROWS), 1.0) is None
    without = bodies.without(0, coefficients)
    hopeless: Any = Costs(1000.0)
    assert number_and_kinds._fit_without(hopeless, 30.0, without).cost == 1000.0
    # Of two trials the one with the least cost has more parameters than any cost could justify.
    trials = [ShapeFit(bodies, coefficients, cost, ROWS) for cost in (1.0, 2.0)]
    evidence: Any = SimpleNamespace(
        negative_log_evidence=lambda fit: {1.0: 12.0, 2.0: 9.0, 3.0: 10.0}[fit.cost],
        fit=lambda bodies, coefficients, steps: ShapeFit(bodies, coefficients, 2.0, ROWS),
    )
    fitted = ShapeFit(bodies, coefficients, 3.0, ROWS)
    assert number_and_kinds._best_fit(evidence, fitted, trials[:1]) is None
    assert number_and_kinds._best_fit(evidence, fitted, trials) is not None
    doubtful: Any = Costs(800.0, 20.0)
    assert number_and_kinds._fit_without(doubtful, 30.0, without).cost == 20.0
    assert doubtful.steps == [3, 6]


def test_certain_bodies_are_fitted_together_before_others_are_tried():
    """Alone, the first of the two would move between them. Fits are replaced by a record of their starts."""
    fitted = []

    class Recorded:
        def fit_level(self, bodies, coefficients, level, steps):
            fitted.append((list(bodies.sign), coefficients))
            return level, ShapeFit(bodies, coefficients, 1.0, ROWS), 0.0  # no other is more probable

    places = [BALL, [-0.03, 0.04, 0.03], [0.0, 0.0, 0.05]]
    balls = Ellipsoids.create(MESH, EllipsoidPrior(modes=1), places, [1, 1, -1])
    start: Any = balls.of_radii([0.02, 0.02, 0.02])
    recorded: Any = Recorded()
    _, _, chosen = search._add_bodies(recorded, balls, start, 2)
    assert chosen == [0, 1]
    assert [signs for signs, _ in fitted] == [[1, 1], [1, 1, -1]]
    np.testing.assert_array_equal(fitted[0][1], balls.without(2, start)[1])
    np.testing.assert_array_equal(fitted[1][1], start)


@pytest.mark.parametrize(("found", "is_tried"), [(8.0, False), (9.0, True)])
def test_splits_are_tried_unless_a_change_of_kind_is_likelier_than_any(monkeypatch, found, is_tried):
    """The bodies cost 4, and -log evidence is 12.5, so that a perfect fit would have 8.5."""
    tried = []
    bodies = Ellipsoids.create(MESH, EllipsoidPrior(), [[0.0, 0.0, 0.05]], [1])
    base, changed = (ShapeFit(bodies, bodies.of_radii([0.02]), cost, ROWS) for cost in (4.0, 1.0))
    problem: Any = SimpleNamespace(negative_log_evidence=lambda fit: 12.5 if fit is base else found)
    result = number_and_kinds.SearchResult(base, [9.0], ())
    monkeypatch.setattr(number_and_kinds, "alternative_fits", lambda *_: (result, changed))
    monkeypatch.setattr(number_and_kinds, "_split_bodies", lambda *_: tried.append(True))
    monkeypatch.setattr(number_and_kinds, "_search_until_stable", lambda *_: result._replace(fit=changed))
    assert number_and_kinds.improve_fit(problem, result, 1.0).fit is changed
    assert bool(tried) == is_tried
