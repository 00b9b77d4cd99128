"""Rules that choose the hyperparameter λ.

A rule takes the `Spectrum` of the problem, the whitened data (or None) and the mesh, and returns a `Choice`. All rules
use the eigendecomposition of the spectrum, in the notation of `jeit.inverse.spectrum`: with the data components c =
UᵀQᵀv and the filter f = λ²/(Λ + λ²), the residual r has ‖r‖² = Σ f²c² and the image x has the penalty xᵀQx = Σ Λc²/(Λ +
λ²)².
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import KDTree
from scipy.special import ndtr

from jeit.arguments import check_has_values, check_name
from jeit.inverse.hyperparameter.choice import Choice
from jeit.inverse.spectrum import Spectrum
from jeit.mesh import Mesh, centroids, measures
from jeit_solvers.engines import adjoint, has_values


def best_resolution(
    spectrum: Spectrum,
    data: ArrayLike | None,
    mesh: Mesh | None,
    *,
    signal_to_noise: float = 1.0,
    num_targets: int = 30,
) -> Choice:
    """Choose the λ with the smallest blur radius, averaged over point targets spread through the body.

    Without noise the smallest λ would always give the sharpest image, so noise is added to the images of the targets.
    No measured data are used, so λ depends on the system and not on the frame. Graham and Adler, Physiol. Meas. 27
    (2006) S65-S79, calibrate λ in this way with a small target in a tank. Criterion: mean `blur_radius` over the
    targets, relative to the size of the body.

    **Arguments:**

    - `spectrum`: eigendecomposition of the problem, which `choose_hyperparameter` passes to the rule.
    - `data`: not used.
    - `mesh`: the mesh of the image.
    - `signal_to_noise`: root mean square of a target's data, in standard deviations of the noise.
    - `num_targets`: number of targets.

    Raises `ValueError` without a mesh and for settings that are not positive.

    **Example:**

    ```python
    rule = lambda *problem: best_resolution(*problem, num_targets=10)
    choose_hyperparameter(model, 1.0, rule=rule).hyperparameter
    ```
    """
    if mesh is None:
        raise ValueError("The rule 'best-resolution' measures areas: give the mesh that the spectrum belongs to.")
    if not signal_to_noise > 0 or num_targets < 1:
        raise ValueError(
            "signal_to_noise and num_targets must be positive, and there must be at least one target; they are "
            f"{signal_to_noise} and {num_targets}."
        )
    candidate_hyperparameters = spectrum.candidates()[::4]
    radii = blur_radius(
        spectrum,
        mesh,
        select_spread_cells(mesh, num_targets),
        candidate_hyperparameters,
        signal_to_noise=signal_to_noise,
    )
    mean_radius = radii.mean(axis=1)
    return Choice.among(
        "best-resolution",
        candidate_hyperparameters,
        int(np.argmin(mean_radius)),
        mean_radius,
        spectrum.curves(data, candidate_hyperparameters),
        target=None,
    )


def blur_radius(
    spectrum: Spectrum,
    mesh: Mesh,
    targets: Int[np.ndarray, " T"],
    candidates: Float[np.ndarray, " K"],
    *,
    signal_to_noise: float = 1.0,
) -> Float[np.ndarray, "K T"]:
    """Blur radius of the noisy image of every target cell for every candidate λ, relative to the size of the body.

    The blur radius is √(A/A₀) (3-D: the cube root), where A₀ is the area (volume) of the body and A the area of the
    half-amplitude set: the cells where the image is at least half of its value *at the target*. (With half of the
    image's maximum instead, as in Adler and Guardo, IEEE Trans. Med. Imaging 15 (1996) 170-179, an image with a narrow
    peak elsewhere would count as sharp.) A is replaced by its expected value for white noise of unit variance in the
    data: for a target of strength s in cell t with image p = R_λJ_t and noise variance (RRᵀ)_ii, cell i belongs to the
    set with probability Φ(s (p_i - p_t/2) / √(RRᵀ)_ii).
    """
    cell_areas = np.asarray(measures(mesh))
    eigenvalues, modes = np.asarray(spectrum.eigenvalues), np.asarray(spectrum.modes())
    signals_of_targets = np.asarray(spectrum.directions) @ np.asarray(spectrum.reduced)[:, targets]
    signal_norms = np.linalg.norm(signals_of_targets, axis=0)
    target_strengths = (
        signal_to_noise * np.sqrt(len(signals_of_targets)) / np.maximum(signal_norms, np.finfo(float).tiny)
    )
    signal_components = adjoint(np.asarray(spectrum.basis)) @ signals_of_targets
    # Data that images in the prior's null space explain are imaged independently of λ.
    null_space_weights = np.asarray(spectrum.null_space) @ np.linalg.pinv(np.asarray(spectrum.observed_null_space))
    null_space_images, null_space_variance = (
        null_space_weights @ signals_of_targets,
        np.sum(abs(null_space_weights) ** 2, axis=1),
    )
    damping_factors = 1 / (eigenvalues + np.asarray(candidates)[:, None] ** 2)
    variance = damping_factors**2 @ (abs(modes) ** 2).T + null_space_variance
    expected_areas = np.empty((len(candidates), len(targets)))
    for candidate_index in range(len(candidates)):
        image = np.real(modes @ (damping_factors[candidate_index][:, None] * signal_components) + null_space_images)
        excess_over_half = image - image[targets, np.arange(len(targets))] / 2
        expected_areas[candidate_index] = cell_areas @ ndtr(
            target_strengths * excess_over_half / np.sqrt(variance[candidate_index])[:, None]
        )
    return (expected_areas / cell_areas.sum()) ** (1 / mesh.dimension)


def select_spread_cells(mesh: Mesh, num_cells: int) -> Int[np.ndarray, " T"]:
    """Indices (T,) of about `num_cells` cells spread evenly through the body: the cells nearest to the points of a
    regular lattice."""
    centres, cell_measures = np.asarray(centroids(mesh)), np.asarray(measures(mesh))
    lower_corner, upper_corner = np.asarray(mesh.points).min(axis=0), np.asarray(mesh.points).max(axis=0)
    grid_spacing = (cell_measures.sum() / num_cells) ** (1 / mesh.dimension)
    num_grid_points = np.maximum(np.round((upper_corner - lower_corner) / grid_spacing).astype(int), 1)
    axis_coordinates = [
        first_coordinate + (np.arange(num_intervals) + 0.5) * (last_coordinate - first_coordinate) / num_intervals
        for first_coordinate, last_coordinate, num_intervals in zip(
            lower_corner, upper_corner, num_grid_points, strict=True
        )
    ]
    grid_points = np.stack(np.meshgrid(*axis_coordinates, indexing="ij"), axis=-1).reshape(-1, mesh.space_dimension)
    distances_to_cells, nearest_cells = (
        np.asarray(query_result) for query_result in KDTree(centres).query(grid_points)
    )
    # A surface in space passes between lattice points, so lattice points up to half a spacing from the surface count as
    # inside.
    is_inside = distances_to_cells <= (
        grid_spacing / 2 if mesh.is_surface else cell_measures[nearest_cells] ** (1 / mesh.dimension)
    )
    return np.unique(nearest_cells[is_inside] if is_inside.any() else nearest_cells)


def greit_noise_figure(
    target: float, eigenvalues, signal, data_signal_to_noise: float, image_mode_coefficients, measure
) -> float:
    """Smallest λ at which GREIT's noise figure is `target`. Raises `ValueError` if no λ gives this noise figure.

    The noise figure is the signal-to-noise ratio of the data divided by that of the image, for one target object (Adler
    et al., Physiol. Meas. 30, S35, 2009); in contrast, `noise_figure` draws signals from the prior.

    The columns of X are the desired images of training targets, the columns of Y the data of the targets, and λ is the
    hyperparameter. With the eigendecomposition YYᵀ = VΛVᵀ, the image of data y is XYᵀV (Λ + λ²)⁻¹ Vᵀy. `signal`: Vᵀy;
    `image_mode_coefficients`: XYᵀV; `data_signal_to_noise`: signal-to-noise ratio of the data; `measure`: areas of the
    cells. White noise of unit variance in the data gives a cell of the image the variance Σ (XYᵀV)² / (Λ + λ²)².
    """
    cell_weights = measure / measure.sum()
    noise_gain = cell_weights @ image_mode_coefficients**2

    def excess_noise_figure(log_hyperparameter) -> float:
        filter_values = 1 / (eigenvalues + np.exp(2 * log_hyperparameter))
        noise, image = (
            np.sqrt(noise_gain @ filter_values**2),
            cell_weights @ np.abs(image_mode_coefficients @ (signal * filter_values)),
        )
        return float(np.log(data_signal_to_noise * noise / image / target))

    log_hyperparameters = np.log(np.sqrt(eigenvalues.max()) * np.logspace(-6, 1, 71))
    grid_excesses = np.array([excess_noise_figure(grid_hyperparameter) for grid_hyperparameter in log_hyperparameters])
    below_target = np.flatnonzero(grid_excesses <= 0)
    if below_target.size == 0 or below_target[0] == 0:
        min_figure, max_figure = target * np.exp([grid_excesses.min(), grid_excesses.max()])
        raise ValueError(
            f"noise_figure: no hyperparameter gives {target:g}; here it lies between {min_figure:.3g} and "
            f"{max_figure:.3g}. A larger radius brings it down; a larger noise_figure takes a noisier image."
        )
    search_interval = (log_hyperparameters[below_target[0] - 1], log_hyperparameters[below_target[0]])
    return float(np.exp(scipy.optimize.root_scalar(excess_noise_figure, bracket=search_interval, rtol=1e-10).root))


Rule = Callable[[Spectrum, Float[Array, " M"] | None, Mesh | None], Choice]


def generalised_cross_validation(spectrum: Spectrum, data: ArrayLike | None, mesh: Mesh | None = None) -> Choice:
    """Choose λ by generalised cross-validation: λ minimises M‖r‖²/(tr(I - H))², an estimate of the error of predicting
    each of M channels from the other channels; r is the residual, and the matrix H maps data to predicted data. Golub,
    Heath and Wahba 1979.

    Criterion: M‖r‖²/(tr(I - H))², in units of the noise variance. Raises `ValueError` without data.

    **Arguments:**

    - `spectrum`, `data`, `mesh`: as in `discrepancy`.

    **Example:**

    ```python
    choose_hyperparameter(model, 1.0, rule=lambda *problem: generalised_cross_validation(*problem), difference=change)
    ```
    """
    candidate_hyperparameters, data = spectrum.candidates(), _check_data(data, "gcv")
    residual, penalty = spectrum.curves(data, candidate_hyperparameters)
    # Repeated readings have filter 1 but no residual, so their number is subtracted from the number of channels and
    # from the trace.
    num_independent = len(data) - spectrum.repeated
    gcv_scores = (
        num_independent
        * residual**2
        / (_filter_factors(spectrum, candidate_hyperparameters).sum(axis=1) - spectrum.repeated) ** 2
    )
    return Choice.among("gcv", candidate_hyperparameters, int(np.argmin(gcv_scores)), gcv_scores, (residual, penalty))


def discrepancy(spectrum: Spectrum, data: ArrayLike | None, mesh: Mesh | None = None, *, noise: float = 1.0) -> Choice:
    """Choose λ by the discrepancy principle: the largest λ with ‖r‖² ≤ n noise², for the residual r with n independent
    components.

    Criterion: ‖r‖/√n, the residual in standard deviations. Morozov, Soviet Math. Dokl. 7 (1966) 414-417.

    **Arguments:**

    - `spectrum`: eigendecomposition of the problem, which `choose_hyperparameter` passes to the rule.
    - `data`: whitened difference of frames (M,).
    - `mesh`: not used.
    - `noise`: standard deviation of the whitened data (of each part of complex data), 1 if the noise of the channels
      was specified correctly.

    Raises `ValueError` without data.

    **Example:**

    ```python
    rule = lambda *problem: discrepancy(*problem, noise=1.2)
    choose_hyperparameter(model, 1.0, rule=rule, difference=change, noise=1e-4).hyperparameter
    ```
    """
    candidate_hyperparameters, data = spectrum.candidates(), _check_data(data, "discrepancy")
    data_components = abs(adjoint(np.asarray(spectrum.basis)) @ data)
    degrees_of_freedom = spectrum.freedom * (2 if np.iscomplexobj(data) else 1)
    residual, penalty = spectrum.curves(data, candidate_hyperparameters)
    normalised_residual = residual / np.sqrt(degrees_of_freedom)
    allowed_indices = np.flatnonzero(normalised_residual <= noise)
    candidate_index = allowed_indices[-1] if allowed_indices.size else 0
    search_interval = None
    if allowed_indices.size and candidate_index + 1 < len(candidate_hyperparameters):

        def excess_misfit(log_hyperparameter) -> float:
            return float(
                np.sqrt(
                    ((_filter_factors(spectrum, np.exp(log_hyperparameter)) * data_components) ** 2).sum()
                    / degrees_of_freedom
                )
                - noise
            )

        search_interval = np.exp(
            scipy.optimize.root_scalar(
                excess_misfit, bracket=np.log(candidate_hyperparameters[candidate_index : candidate_index + 2])
            ).root
        )
    return Choice.among(
        "discrepancy",
        candidate_hyperparameters,
        candidate_index,
        normalised_residual,
        (residual, penalty),
        target=float(noise),
        between=search_interval,
    )


def l_curve(spectrum: Spectrum, data: ArrayLike | None, mesh: Mesh | None = None) -> Choice:
    """Choose λ at the corner of the L-curve, where the curve of log √(xᵀQx) against log ‖r‖ has its maximum curvature.
    Hansen, SIAM Review 34 (1992) 561-580.

    Criterion: the curvature of the L-curve, positive at a corner that points to the origin. Raises `ValueError` without
    data.

    **Arguments:**

    - `spectrum`, `data`, `mesh`: as in `discrepancy`.

    **Example:**

    ```python
    choose_hyperparameter(model, 1.0, rule=lambda *problem: l_curve(*problem), difference=change, noise=1e-6)
    ```
    """
    candidate_hyperparameters, data = spectrum.candidates(), _check_data(data, "l-curve")
    residual, penalty = spectrum.curves(data, candidate_hyperparameters)
    curvature = _curvature(spectrum, data, candidate_hyperparameters)
    curvature = np.where(np.isfinite(curvature), curvature, np.min(curvature[np.isfinite(curvature)], initial=0))
    return Choice.among("l-curve", candidate_hyperparameters, int(np.argmax(curvature)), curvature, (residual, penalty))


def noise_figure(
    spectrum: Spectrum, data: ArrayLike | None = None, mesh: Mesh | None = None, *, target: float = 1.25
) -> Choice:
    """Choose the λ at which the noise figure, the signal-to-noise ratio of the data divided by that of the image,
    equals `target`. No measured data are used.

    Signals are drawn from the prior and the noise is white. In squared amplitudes, the signal-to-noise ratio of the
    data is trΛ / n for n components, and that of the image is tr(RJΓJᵀRᵀ) / tr(RRᵀ). This follows Adler and Guardo
    1996, who use one object at the centre in place of the prior. Criterion: the noise figure.

    **Arguments:**

    - `spectrum`: eigendecomposition of the problem, which `choose_hyperparameter` passes to the rule.
    - `data`, `mesh`: not used.
    - `target`: requested noise figure.

    **Example:**

    ```python
    rule = lambda *problem: noise_figure(*problem, target=0.5)
    image = one_step(model, 1.0, hyperparameter=rule).image(change)
    ```
    """
    candidate_hyperparameters = spectrum.candidates()
    eigenvalues = np.asarray(spectrum.eigenvalues)
    squared_modes = spectrum.squared_modes()
    noise_weights = squared_modes / (eigenvalues + candidate_hyperparameters[:, None] ** 2) ** 2
    image_ratio = noise_weights @ eigenvalues / noise_weights.sum(axis=1)
    noise_figures = np.sqrt(eigenvalues.sum() / spectrum.freedom / image_ratio)
    return Choice.among(
        "noise-figure",
        candidate_hyperparameters,
        int(np.argmin(np.abs(np.log(noise_figures / target)))),
        noise_figures,
        spectrum.curves(data, candidate_hyperparameters),
        target=target,
    )


RULES: dict[str, Rule] = {
    "gcv": generalised_cross_validation,
    "l-curve": l_curve,
    "discrepancy": discrepancy,
    "noise-figure": noise_figure,
    "best-resolution": best_resolution,
}
"""Rules by name: each takes a `Spectrum`, the whitened data and the mesh, and returns a `Choice`."""


def choose(spectrum: Any, hyperparameter: float | str | Rule | Choice, data, mesh: Mesh | None = None) -> Choice:
    """Choose λ from `hyperparameter`, which is a number, the name of a rule, a rule, or an earlier choice.

    `spectrum`: a `Spectrum`, used by rules only. Raises `ValueError` for an unknown name, for a rule if the problem is
    traced, and for a number that is not positive and finite.
    """
    if isinstance(hyperparameter, Choice):
        return hyperparameter
    if isinstance(hyperparameter, str):
        check_name("hyperparameter", hyperparameter, RULES, ", or a number")
        _check_problem(spectrum, hyperparameter)
        return RULES[hyperparameter](spectrum, data, mesh)
    if callable(hyperparameter):
        _check_problem(spectrum, getattr(hyperparameter, "__name__", "given"))
        return hyperparameter(spectrum, data, mesh)
    if has_values(hyperparameter):
        hyperparameter_value = np.asarray(hyperparameter)
        if (
            hyperparameter_value.shape != ()
            or hyperparameter_value.dtype.kind not in "iuf"
            or not (np.isfinite(hyperparameter_value) and hyperparameter_value > 0)
        ):
            raise ValueError(f"hyperparameter must be positive and finite; it is {hyperparameter}.")
    return Choice.given(hyperparameter)


def _check_problem(problem, name: str) -> None:
    """Raise `ValueError` for a traced problem, because a rule for λ needs numerical values."""
    advice_to_user = "give a number, such as the one that jeit.inverse.choose_hyperparameter finds outside"
    check_has_values("hyperparameter: the problem", problem, f"the rule '{name}' looks at", advice_to_user)


def _filter_factors(spectrum: Spectrum, candidates) -> Float[np.ndarray, "K r"]:
    squared_candidates = np.atleast_1d(candidates)[:, None] ** 2
    return squared_candidates / (np.asarray(spectrum.eigenvalues) + squared_candidates)


def _curvature(spectrum: Spectrum, data, candidates) -> Float[np.ndarray, " K"]:
    """Curvature of the L-curve with parameter t = log λ, computed with df/dt = 2f(1 - f) for the filter f."""
    filter_factors, eigenvalues = _filter_factors(spectrum, candidates), np.asarray(spectrum.eigenvalues)
    squared_components = abs(adjoint(np.asarray(spectrum.basis)) @ data) ** 2
    penalty_terms = (
        squared_components * eigenvalues / (eigenvalues + candidates[:, None] ** 2) ** 2
    )  # the sum is the penalty
    residual_terms = squared_components * filter_factors**2  # its sum is ‖r‖²
    # The derivatives with respect to t are 4 residual_terms (1 - f) and -4 penalty_terms f.
    residual_derivatives = _second_log_derivative(
        residual_terms, 4 * (1 - filter_factors), 8 * (1 - filter_factors) * (2 - 3 * filter_factors)
    )
    penalty_derivatives = _second_log_derivative(
        penalty_terms, -4 * filter_factors, -8 * filter_factors * (1 - 3 * filter_factors)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return (residual_derivatives[0] * penalty_derivatives[1] - penalty_derivatives[0] * residual_derivatives[1]) / (
            residual_derivatives[0] ** 2 + penalty_derivatives[0] ** 2
        ) ** 1.5


def _second_log_derivative(terms, first_factors, second_factors):
    """First and second derivatives of ½ log Σ terms, where the first and second derivatives of the terms are the
    products terms · first_factors and terms · second_factors."""
    sum_of_terms = terms.sum(axis=1)
    log_slope = (terms * first_factors).sum(axis=1) / sum_of_terms
    return log_slope / 2, ((terms * second_factors).sum(axis=1) / sum_of_terms - log_slope**2) / 2


def _check_data(data, rule: str) -> Float[np.ndarray, " M"]:
    if data is None:
        raise ValueError(f"The rule '{rule}' looks at the data: give difference, the change of voltages to be imaged.")
    advice_to_user = "give a number as hyperparameter, such as the one that the rule finds outside"
    check_has_values("difference (voltages)", data, f"the rule '{rule}' looks at", advice_to_user)
    data_values = np.asarray(data)
    if not (np.isfinite(data_values).all() and data_values.any()):
        raise ValueError(f"The rule '{rule}' looks at the data, and they are all zero, NaN or infinite: give others.")
    return data_values
