"""Rules for the hyperparameter against explicit matrices, known corners and simulated noise, and their reports."""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import RULES, Laplace, Noser, choose_hyperparameter, compare_rules, one_step
from jeit.inverse.hyperparameter.choice import Choice
from jeit.inverse.hyperparameter.rules import best_resolution, blur_radius, choose, discrepancy, select_spread_cells
from jeit.inverse.linearisation import Linearisation
from jeit.inverse.spectrum import Spectrum
from jeit.layout import ring
from jeit.mesh import Mesh, box, centroids, disk, measures
from jeit.protocol import adjacent

PRIORS = {"noser": Noser(), "laplace": Laplace()}
CHANNELS = 40  # of 8 electrodes
SPREAD = (1e-3, 1e-2, 0.1, 1.0)  # candidates relative to the largest singular value


@pytest.fixture(scope="module")
def model():
    electrodes = BoundaryElectrodes(ring(0.1, 8), 0.03, 1e-3)
    return ForwardModel(disk(0.1, num_points=500), electrodes, adjacent(8, current=1e-3))


@pytest.fixture(scope="module")
def frame(model):
    """Difference voltages of an inclusion on another mesh, with noise of 1 % of their root mean square, and that
    noise."""
    fine = ForwardModel(disk(0.1, num_points=600), model.electrodes, model.protocol)
    inside = np.linalg.norm(np.asarray(centroids(fine.mesh)) - [0.05, 0.02], axis=1) < 0.025
    change = np.asarray(fine.voltages(np.where(inside, 1.2, 1.0))) - np.asarray(fine.voltages(1.0))
    noise = 1e-2 * float(np.sqrt(np.mean(change**2)))
    return change + noise * np.random.default_rng(3).normal(size=change.shape), noise


@pytest.fixture(scope="module", params=PRIORS)
def linear(request, model, frame):
    return Linearisation.create(model, 1.0, prior=PRIORS[request.param], noise=frame[1])


@pytest.fixture
def data(linear, frame):
    return np.asarray(linear.whiten(frame[0]))


def explicit(linear, model, hyperparameter):
    """R = (JᵀJ + λ²Q)⁻¹ Jᵀ, with J and Q."""
    jacobian = np.asarray(linear.spectrum.jacobian)
    precision = linear.prior.precision(model.mesh, jacobian).toarray()
    return np.linalg.solve(jacobian.T @ jacobian + hyperparameter**2 * precision, jacobian.T), jacobian, precision


def some(choice):
    """Indices of a few candidates, small to large."""
    largest = float(choice.candidates[-1]) / 10
    return [int(np.argmin(np.abs(np.log(np.asarray(choice.candidates) / (part * largest))))) for part in SPREAD]


def test_curves_and_gcv_equal_their_definitions(linear, model, data):
    choice = RULES["gcv"](linear.spectrum, data, model.mesh)
    for index in some(choice):
        matrix, jacobian, precision = explicit(linear, model, float(choice.candidates[index]))
        image = matrix @ data
        residual = data - jacobian @ image
        hat = np.trace(np.eye(CHANNELS) - jacobian @ matrix)
        curves = (np.asarray(curve)[index] for curve in (choice.residual, choice.penalty, choice.criterion))
        residual_norm, penalty, criterion = curves
        assert residual_norm == pytest.approx(np.linalg.norm(residual), rel=1e-6)
        assert penalty == pytest.approx(np.sqrt(image @ precision @ image), rel=1e-6)
        assert criterion == pytest.approx(CHANNELS * residual @ residual / hat**2, rel=1e-6)
    assert choice.hyperparameter == choice.candidates[np.argmin(choice.criterion)]
    assert choice.target is None


def test_discrepancy_leaves_exactly_the_noise(linear, model, data):
    """Explicitly ‖v - J R v‖ = noise √r, and any larger λ leaves more."""
    components = linear.spectrum.eigenvalues.size
    for noise in (1.0, 3.0):
        choice = discrepancy(linear.spectrum, data, model.mesh, noise=noise)
        matrix, jacobian, _ = explicit(linear, model, float(choice.hyperparameter))
        residual = np.linalg.norm(data - jacobian @ (matrix @ data))
        assert residual == pytest.approx(noise * np.sqrt(components), rel=1e-6)
        assert choice.target == noise
        assert not choice.edge
        assert (np.asarray(choice.criterion)[choice.candidates > choice.hyperparameter] > noise).all()


def test_l_curve_turns_at_its_known_corner():
    """Two components, of which the data determine one. At the corner the residual is all of the second, and the penalty
    that of the first alone."""
    strong, weak = 1.0, 1e-6
    spectrum = spectrum_of([strong, weak, 0.0])
    choice = choose(spectrum, "l-curve", jnp.array([1.0, 1e-3, 0.0]))
    assert choice.read(choice.residual) == pytest.approx(1e-3, rel=0.1)
    assert choice.read(choice.penalty) == pytest.approx(1 / np.sqrt(strong), rel=0.1)
    # The vertical branch ends where both penalties are equal, the horizontal one begins where both residuals are.
    assert 1e-3**0.5 * (strong * weak) ** 0.25 < choice.hyperparameter < np.sqrt(1e-3 * strong)
    assert not choice.edge


def test_curvature_of_the_l_curve(linear, model, data):
    """Against differences along the curve. Regression: zero eigenvalues, which adjacent channels always have, made the
    curvature NaN and the choice the smallest candidate."""
    assert (np.asarray(linear.spectrum.eigenvalues) < 1e-12 * float(linear.spectrum.eigenvalues.max())).any()
    choice = choose(linear.spectrum, "l-curve", data)
    step = np.log(choice.candidates[1] / choice.candidates[0])
    x, y = np.log(np.asarray(choice.residual)), np.log(np.asarray(choice.penalty))
    dx, dy = (np.gradient(a, step)[1:-1] for a in (x, y))
    ddx, ddy = (np.diff(a, 2) / step**2 for a in (x, y))
    bend = (dx * ddy - dy * ddx) / (dx**2 + dy**2) ** 1.5
    # Differences over a step of 8 % of λ are accurate to its square, and the curve is sharply bent.
    np.testing.assert_allclose(choice.criterion[1:-1], bend, atol=0.03 * np.abs(bend).max())
    assert not choice.edge


def test_noise_figure_is_the_ratio_of_explicit_traces(linear, model, data):
    """√(SNR of the data / SNR of the image), with signals drawn from the prior outside of its null space."""
    choice = RULES["noise-figure"](linear.spectrum, None, model.mesh)
    spectrum = linear.spectrum
    outer = np.asarray(spectrum.basis * spectrum.eigenvalues) @ np.asarray(spectrum.basis).T
    white = np.asarray(spectrum.basis) @ np.asarray(spectrum.basis).T
    for index in some(choice):
        matrix, _, _ = explicit(linear, model, float(choice.candidates[index]))
        image = np.trace(matrix @ outer @ matrix.T) / np.trace(matrix @ white @ matrix.T)
        before = np.trace(outer) / np.trace(white)
        assert choice.criterion[index] == pytest.approx(np.sqrt(before / image), rel=1e-6)
    assert choice.read(choice.criterion) == pytest.approx(1.25, rel=0.05)  # half a step of the grid
    assert choice.residual.size == choice.penalty.size == 0


def test_noise_figure_does_not_depend_on_the_order_of_cells(model):
    """Regression: for priors with a null space, the grounding of cell 0 had influenced the result."""
    order = np.random.default_rng(0).permutation(model.mesh.num_cells)
    shuffled = Mesh(model.mesh.points, model.mesh.cells[order], model.mesh.facets, model.mesh.tags)
    other = ForwardModel(shuffled, model.electrodes, model.protocol)
    first, second = (RULES["noise-figure"](spectrum_for(m, Laplace()), None, m.mesh) for m in (model, other))
    np.testing.assert_allclose(first.criterion, second.criterion, rtol=1e-6)


def test_blur_radius_is_that_of_explicit_point_spreads(linear, model):
    """Against R J_t of the definition, and its half-amplitude area with simulated noise."""
    mesh, spectrum = model.mesh, linear.spectrum
    targets, area = select_spread_cells(mesh, 6), np.asarray(measures(mesh))
    largest = float(jnp.sqrt(spectrum.eigenvalues.max()))
    candidates = largest * np.array([1e-3, 0.03, 1.0])
    radius = blur_radius(spectrum, mesh, targets, candidates, signal_to_noise=2.0)
    draws = np.random.default_rng(1).normal(size=(CHANNELS, 400))
    for k, hyperparameter in enumerate(candidates):
        matrix, jacobian, _ = explicit(linear, model, hyperparameter)
        for t, target in enumerate(targets):
            signal = jacobian[:, target]
            signal = signal * 2.0 / np.sqrt(np.mean(signal**2))
            image = matrix @ signal
            covered = area @ (image[:, None] + matrix @ draws >= image[target] / 2)
            # The mean over 400 draws of an area: the tolerance is its scatter, or a hundredth if there is none.
            expected = np.mean(covered) / area.sum()
            error = 5 * np.std(covered) / np.sqrt(400) / area.sum()
            assert radius[k, t] ** 2 == pytest.approx(expected, abs=error + 1e-3)


def test_best_resolution_is_the_least_mean_blur(linear, model, data):
    choice = RULES["best-resolution"](linear.spectrum, data, model.mesh)
    targets = select_spread_cells(model.mesh, 30)
    expected = blur_radius(linear.spectrum, model.mesh, targets, np.asarray(choice.candidates)).mean(axis=1)
    np.testing.assert_allclose(choice.criterion, expected)
    assert choice.hyperparameter == choice.candidates[np.argmin(expected)]
    assert not choice.edge
    # Less noise requires less regularisation.
    quiet = best_resolution(linear.spectrum, data, model.mesh, signal_to_noise=30.0)
    assert quiet.hyperparameter < choice.hyperparameter
    assert quiet.criterion.min() < choice.criterion.min()


@pytest.mark.parametrize("mesh", [disk(0.1, num_points=500), box(0.2, 0.1, 0.1, num_points=400)], ids=["disk", "box"])
def test_targets_are_distributed_over_the_body(mesh):
    targets = select_spread_cells(mesh, 30)
    assert 20 <= targets.size <= 40
    place = np.asarray(centroids(mesh))
    spacing = (float(measures(mesh).sum()) / 30) ** (1 / mesh.dimension)
    nearest = np.linalg.norm(place[:, None] - place[targets], axis=-1).min(axis=1)
    assert nearest.max() < 1.3 * spacing


EDGES = {
    "residual above the noise": ("discrepancy", {"noise": 1e-9}, "smallest"),
    "residual below the noise": ("discrepancy", {"noise": 1e9}, "largest"),
    "figure out of reach": ("noise-figure", {"target": 1e9}, "smallest"),
    "figure below reach": ("noise-figure", {"target": 1e-9}, "largest"),
}


@pytest.mark.parametrize(("rule", "options", "edge"), EDGES.values(), ids=EDGES.keys())
def test_a_choice_at_the_edge_is_reported(rule, options, edge, model, frame):
    result = one_step(model, 1.0, hyperparameter=partial(RULES[rule], **options), difference=frame[0], noise=frame[1])
    assert result.choice is not None
    assert result.choice.edge == edge
    assert result.rule == rule
    assert f"'{rule}' ran to the {edge}" in result.choice.note
    assert result.choice.hyperparameter == result.choice.candidates[{"smallest": 0, "largest": -1}[edge]]


def test_all_rules_compared_in_one_call_equal_those_of_one_step(model, frame):
    difference, noise = frame
    compared = compare_rules(model, 1.0, difference=difference, noise=noise)
    assert list(compared) == list(RULES)
    for rule, choice in compared.items():
        alone = choose_hyperparameter(model, 1.0, rule=rule, difference=difference, noise=noise)
        image = one_step(model, 1.0, hyperparameter=rule, difference=difference, noise=noise)
        assert choice.hyperparameter == alone.hyperparameter == image.hyperparameter
        assert choice.rule == image.rule == rule
        assert choice.candidates.shape == choice.criterion.shape == choice.residual.shape == choice.penalty.shape
        assert choice.read(choice.residual) > 0
    # A choice can be used like its rule's name.
    image = one_step(model, 1.0, hyperparameter=compared["gcv"], noise=noise)
    expected = one_step(model, 1.0, hyperparameter="gcv", difference=difference, noise=noise)
    np.testing.assert_array_equal(image.weights, expected.weights)


def test_a_given_number_is_a_choice(model):
    choice = one_step(model, 1.0, hyperparameter=0.3).choice
    assert isinstance(choice, Choice)
    assert (float(choice.hyperparameter), choice.rule, choice.edge, choice.note) == (0.3, "given", "", "")
    assert choice.criterion.size == choice.residual.size == 0
    with pytest.raises(ValueError, match="has none"):
        choice.read(choice.residual)
    np.testing.assert_array_equal(choice.candidates, [0.3])


def test_image_is_the_matrix_times_the_data(linear, data):
    hyperparameter = 0.1 * np.sqrt(np.asarray(linear.spectrum.eigenvalues).max())
    expected = np.asarray(linear.spectrum.reconstruction(hyperparameter)) @ data
    image = linear.spectrum.image(data, hyperparameter)
    np.testing.assert_allclose(image, expected, atol=1e-9 * np.abs(expected).max())


BAD = {
    "no data": (lambda m, d: choose_hyperparameter(m, 1.0, rule="gcv"), "give difference"),
    "no data for a corner": (lambda m, d: choose_hyperparameter(m, 1.0, rule="l-curve"), "give difference"),
    "unknown rule": (lambda m, d: choose_hyperparameter(m, 1.0, rule="luck"), "one of gcv, l-curve"),
    "a number is no rule": (lambda m, d: choose_hyperparameter(m, 1.0, rule=0.1), "needs no"),  # pyright: ignore[reportArgumentType]
    "data of zeros": (lambda m, d: choose_hyperparameter(m, 1.0, rule="gcv", difference=0 * d), "all zero"),
    "data of NaN": (lambda m, d: compare_rules(m, 1.0, difference=np.nan * d), "mask them"),
    "data of another length": (lambda m, d: compare_rules(m, 1.0, difference=d[1:]), "give 40 voltages"),
    "noise of another length": (lambda m, d: compare_rules(m, 1.0, difference=d, noise=d[1:]), "one for each channel"),
    "noise below zero": (lambda m, d: compare_rules(m, 1.0, difference=d, noise=-1.0), "noise must be positive"),
    "mask of nothing": (lambda m, d: compare_rules(m, 1.0, difference=d, mask=d > 1), "at least one True"),
    "prior by name": (lambda m, d: compare_rules(m, 1.0, difference=d, prior="flat"), "Noser"),  # pyright: ignore[reportArgumentType]
    "hyperparameter of truth": (lambda m, d: one_step(m, 1.0, hyperparameter=True), "positive and finite"),
    "several hyperparameters": (lambda m, d: one_step(m, 1.0, hyperparameter=np.ones(2)), "positive"),  # pyright: ignore[reportArgumentType]
    "nothing given": (lambda m, d: one_step(m, 1.0, hyperparameter=None), "positive and finite"),  # pyright: ignore[reportArgumentType]
    "areas without a mesh": (lambda m, d: choose(spectrum_of([1.0]), "best-resolution", None), "give the mesh"),
    "target without signal": (
        lambda m, d: best_resolution(spectrum_of([1.0]), None, m.mesh, signal_to_noise=0.0),
        "must be positive",
    ),
}


@pytest.mark.parametrize(("call", "words"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_refused(call, words, model, frame):
    with pytest.raises(ValueError, match=words):
        call(model, frame[0])


@pytest.mark.slow
def test_rules_on_a_measured_tank(data_folder):
    """A metal rod beside electrode 1. With the known noise, which excludes model errors, discrepancy ends at the
    edge."""
    from jeit.data import read
    from jeit.imaging import ImagingSettings, compare_on_data

    (file,) = (data_folder / "tank6cm" / "electrode01_metal").glob("*.csv")
    result = compare_on_data(read(file), settings=ImagingSettings(num_points=500))
    assert list(result.outcomes) == list(RULES)
    assert not result.refused
    assert {name for name, outcome in result.outcomes.items() if outcome.choice.edge} == {"discrepancy"}
    assert result.outcomes["discrepancy"].residual < result.outcomes["gcv"].residual < 0.15
    assert result.outcomes["noise-figure"].noise_figure == pytest.approx(1.25, rel=0.05)
    for name in ("noise-figure", "best-resolution"):
        (inclusion,) = result.outcomes[name].inclusions
        x, y = inclusion.centroid
        assert abs(np.degrees(np.arctan2(x, y))) < 12


def spectrum_of(eigenvalues):
    """Spectrum of a diagonal problem with these eigenvalues and the identity as prior."""
    jacobian = jnp.diag(jnp.sqrt(jnp.asarray(eigenvalues)))
    return Spectrum.create(jacobian, jacobian.T, jnp.zeros((len(eigenvalues), 0)))


def spectrum_for(model, prior):
    return Linearisation.create(model, 1.0, prior=prior).spectrum
