"""Pictures of hyperparameter choices, checked by the drawn artists: the curve, the point, the names."""

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from jeit.inverse import RULES
from jeit.inverse.hyperparameter.choice import Choice
from jeit.inverse.spectrum import Spectrum
from jeit.mesh import disk
from jeit.plot import plot_choice
from jeit.plot.imaging.judgement import RULE_COLOURS


@pytest.fixture(scope="module")
def choices():
    """Choices for a diagonal problem with as many unknowns as the mesh has cells, and eigenvalues over six decades."""
    mesh = disk(0.1, num_points=60)
    rng = np.random.default_rng(0)
    directions = np.linalg.qr(rng.normal(size=(mesh.num_cells, 12)))[0].T
    jacobian = jnp.asarray(np.logspace(0, -3, 12)[:, None] * directions)
    spectrum = Spectrum.create(jacobian, jacobian.T, jnp.zeros((mesh.num_cells, 0)))
    data = 1e3 * np.asarray(jacobian) @ rng.normal(size=mesh.num_cells) + rng.normal(size=12)
    return {name: rule(spectrum, jnp.asarray(data), mesh) for name, rule in RULES.items()}


@pytest.fixture
def ax():
    return Figure(layout="constrained").subplots()


def points(ax):
    """(x, y) of every single point drawn, by colour."""
    drawn = {}
    for line in ax.lines:
        x, y = line.get_data()
        if np.size(x) == 1 and line.get_marker() == "o":
            drawn[to_hex(line.get_markerfacecolor())] = (float(np.ravel(x)[0]), float(np.ravel(y)[0]))
    return drawn


@pytest.mark.parametrize("rule", [name for name in RULES if name != "l-curve"])
def test_one_rule_shows_its_criterion_against_the_hyperparameter(rule, choices, ax):
    choice = choices[rule]
    assert plot_choice(choice, ax=ax) is ax
    x, y = ax.lines[0].get_data()
    np.testing.assert_allclose(x, choice.candidates)
    np.testing.assert_allclose(y, choice.criterion)
    place = points(ax)["#ffffff" if choice.edge else RULE_COLOURS[rule]]
    assert place == pytest.approx((float(choice.hyperparameter), choice.read(choice.criterion)))
    assert ax.get_xscale() == "log"
    assert "λ" in ax.get_xlabel()
    assert f"λ = {float(choice.hyperparameter):.3g}" in ax.get_title("left")
    if choice.target is not None:
        assert any(np.allclose(line.get_ydata(), choice.target) for line in ax.lines)


def test_the_l_curve_shows_penalty_against_residual(choices, ax):
    choice = choices["l-curve"]
    plot_choice(choice, ax=ax)
    x, y = ax.lines[0].get_data()
    np.testing.assert_allclose(x, choice.residual)
    np.testing.assert_allclose(y, choice.penalty)
    expected = choice.read(choice.residual), choice.read(choice.penalty)
    assert points(ax)[RULE_COLOURS["l-curve"]] == pytest.approx(expected)
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    assert "Residual" in ax.get_xlabel()
    assert "Penalty" in ax.get_ylabel()
    decades = [text for text in ax.texts if "10^" in text.get_text()]
    assert [text.get_text().startswith("λ = ") for text in decades] == [True, *(len(decades) - 1) * [False]]
    for text in decades:
        value = 10.0 ** int(text.get_text().partition("{")[2].rstrip("}$"))
        assert text.xy == pytest.approx((choice.read(choice.residual, value), choice.read(choice.penalty, value)))


def test_several_rules_are_marked_on_one_l_curve_with_a_panel_each(choices, ax):
    everything = {**choices, "mine": Choice.given(float(choices["gcv"].hyperparameter))}
    plot_choice(everything, ax=ax)
    curve, *panels = ax.child_axes
    assert len(panels) == len(RULES)
    named = [text.get_text() for text in curve.texts if ": λ = " in text.get_text()]
    assert sorted(text.split(":")[0] for text in named) == sorted([*RULES, "given"])
    for name, panel in zip(choices, panels, strict=True):
        assert panel.get_title("left").startswith(name)
        # A line for every choice in every panel.
        assert sum(np.ptp(line.get_xdata()) == 0 and np.size(line.get_xdata()) == 2 for line in panel.lines) == 6


def test_labels_on_the_l_curve_do_not_overlap(choices, ax):
    """Decades of λ without effect lie on one point of the curve, and only one of them is labelled."""
    plot_choice(choices["l-curve"], ax=ax)
    ax.figure.draw_without_rendering()
    decades = [text for text in ax.texts if "10^" in text.get_text()]
    assert len(decades) > 1
    boxes = [text.get_window_extent() for text in decades]
    for k, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:k])
        assert box.x0 > ax.get_window_extent().x0


def test_a_choice_at_the_edge_is_hollow_with_a_note(choices, ax):
    choice = choices["gcv"]
    edge = Choice.among("gcv", choice.candidates, 0, choice.criterion, (choice.residual, choice.penalty))
    plot_choice(edge, ax=ax)
    assert "edge of the grid" in ax.get_title("left")
    assert points(ax) == {"#ffffff": pytest.approx((float(edge.candidates[0]), float(edge.criterion[0])))}


def test_without_data_there_is_no_l_curve(choices, ax):
    choice = choices["noise-figure"]
    blind = Choice.among("noise-figure", choice.candidates, 3, choice.criterion, ([], []), target=1.25)
    plot_choice({"noise-figure": blind}, ax=ax)
    (panel,) = ax.child_axes
    assert "Noise figure" in panel.get_ylabel()


@pytest.mark.parametrize("choices", [Choice.given(1.0), {"given": Choice.given(1.0)}, {}], ids=["one", "some", "none"])
def test_a_given_number_is_refused(choices, ax):
    with pytest.raises(ValueError, match="curve"):
        plot_choice(choices, ax=ax)
