"""Layout scores: differentiable measures of how precisely a sheet with a given layout detects and locates touches.

A touch of amplitude a_k at position k changes the M voltages by a_k Δv_k, in the linear approximation. The noise of the
voltages has standard deviation σ. The prior of the amplitudes at all positions is a = S c, where the entries of c are
independent with unit variance. The voltage changes are y = Aᵀa + noise, where the rows of A are the Δv_k. Then the
posterior covariance of the amplitudes is

    C = S (1 + Sᵀ A σ⁻² Aᵀ S)⁻¹ Sᵀ.

The Cramér-Rao bound is the minimum variance of an unbiased estimate of the position of a touch of unknown amplitude.
The parameters (x, y, a) have the Fisher information J_ij = ∂_i(a Δv)ᵀ σ⁻² ∂_j(a Δv), and the bound of the position's
variance is the trace of the (x, y) block of J⁻¹.

Atkinson, Donev and Tobias, Optimum Experimental Designs (Oxford, 2007), chapter 10; Kay, Fundamentals of Statistical
Signal Processing: Estimation Theory (1993), chapter 3.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.design.defaults import TEMPERATURE
from jeit.design.sensitivity import uniformity
from jeit.design.skin.sheet_touches import SheetTouches
from jeit.design.skin.touch_shapes import check_places
from jeit.forward import ForwardModel
from jeit.forward.system import cell_conductivity, check_conductivity
from jeit_solvers.dense import inverse_cholesky
from jeit_solvers.engines import as_array, has_values, namespace, numpy_or_compiled, undifferentiated
from jeit_solvers.module import Module

# Number k of matrix squarings. The largest eigenvalue of an r × r matrix then has a relative error of at most ln(r) /
# 2^k, however close the second largest eigenvalue is.
_NUM_SQUARINGS = 10


class TouchPrior(Module):
    """Gaussian prior of the amplitudes of touches, with covariance SSᵀ.

    **Fields**: `factor`: S (n, r) for touches at n positions. The touches for which voltage changes are computed have
    the amplitude 1.

    **Example:**

    ```python
    prior = TouchPrior.create(touches.places, correlation=0.02)
    covariance = prior.factor @ prior.factor.T
    ```
    """

    factor: Float[Array, "n r"]

    @classmethod
    def create(
        cls, places: ArrayLike, *, correlation: float, deviation: float = 1.0, lengths: ArrayLike | None = None
    ) -> "TouchPrior":
        """Create the prior in which the amplitudes of touches at a distance of d metres have the covariance deviation²
        exp(-d² / 2 correlation²).

        `places`: touched positions (n, 2), or (n, 3) on a curved skin, metres. `lengths`: distances (n, n) between the
        positions, metres, such as distances along a curved surface from `Geodesics.between`; by default the straight
        distances. Principal components with less than a millionth of the largest variance are omitted. Raises
        `ValueError` if `correlation` or `deviation` is not positive, and for invalid positions.
        """
        if not (0 < correlation < np.inf and 0 < deviation < np.inf):
            raise ValueError(
                f"correlation (metres) and deviation must be positive; they are {correlation!r} and {deviation!r}."
            )
        touched_positions = check_places(places, 3 if np.shape(places)[-1:] == (3,) else 2)
        squared_distances = np.sum((touched_positions[:, None] - touched_positions) ** 2, axis=-1)
        squared_path_lengths = squared_distances if lengths is None else np.asarray(lengths, float) ** 2
        if squared_path_lengths.shape != squared_distances.shape:
            raise ValueError(
                f"lengths has shape {squared_path_lengths.shape}; give one between any two of {len(touched_positions)} "
                "places."
            )
        covariance_eigenvalues, covariance_eigenvectors = np.linalg.eigh(
            deviation**2 * np.exp(-squared_path_lengths / (2 * correlation**2))
        )
        is_significant_eigenvalue = covariance_eigenvalues > 1e-6 * covariance_eigenvalues[-1]
        return cls(
            as_array(
                covariance_eigenvectors[:, is_significant_eigenvalue]
                * np.sqrt(covariance_eigenvalues[is_significant_eigenvalue])
            )
        )


class Scores(Module):
    """Scores of an electrode layout for touches at n positions. After `jax.vmap`, every array has a leading axis for
    the layouts.

    **Fields**

    - `sensitivity` (n,): Θ = ‖Δv‖₂, norm of the voltage changes due to a touch at each position, volts.
    - `soft_worst`: smooth minimum (mean Θ^(-1/T))^(-T) of Θ, volts, which tends to the minimum as the temperature T →
      0.
    - `variance` (n,): posterior variance of the relative amplitude of a touch at each position, the diagonal of the
      covariance C.
    - `log_information`: D-optimality, log-determinant of the posterior information matrix minus that of the prior,
      nats.
    - `largest_variance`: E-optimality, the largest eigenvalue of C, which is the variance of the least certain pattern
      of touches.
    - `localisation_error` (n,): Cramér-Rao bound of the root-mean-square error of an unbiased estimate of the position
      of a single touch of amplitude 1, metres.
    """

    sensitivity: Float[Array, "*layouts n"]
    soft_worst: Float[Array, "*layouts"]
    variance: Float[Array, "*layouts n"]
    log_information: Float[Array, "*layouts"]
    largest_variance: Float[Array, "*layouts"]
    localisation_error: Float[Array, "*layouts n"]

    @property
    def worst(self) -> Float[Array, "*layouts"]:
        """Minimum of the sensitivity Θ over the touched positions, volts."""
        return self.sensitivity.min(axis=-1)

    @property
    def mean(self) -> Float[Array, "*layouts"]:
        """Mean of the sensitivity Θ over the touched positions, volts."""
        return self.sensitivity.mean(axis=-1)

    @property
    def uniformity(self) -> Float[Array, "*layouts"]:
        """Mean of the sensitivity Θ divided by its root mean square, as in `SensitivityMap`."""
        return uniformity(self.sensitivity)

    @property
    def mean_variance(self) -> Float[Array, "*layouts"]:
        """A-optimality: tr C / n, the mean of the posterior variances at the n positions."""
        return self.variance.mean(axis=-1)


Score = Callable[[Scores], Float[Array, ""]]


def layout_scores(
    model: ForwardModel,
    conductivity: ArrayLike,
    touches: SheetTouches,
    *,
    prior: TouchPrior,
    noise: ArrayLike,
    temperature: float = TEMPERATURE,
) -> Scores:
    """Compute all scores of the electrode layout of a sheet, from its forward model.

    The scores are differentiable with respect to the positions, radii and contact impedances of the electrodes. For a
    batch of layouts with the same number of electrodes, protocol and touches::

        jax.vmap(lambda electrodes: layout_scores(model.with_electrodes(electrodes), …))(stacked_electrodes)

    A protocol of all two-terminal pairs does not depend on the order of the electrodes, and its voltages determine
    every other measurement. A protocol of adjacent electrodes depends on their numbering, which becomes meaningless
    once the electrodes move.

    **Arguments:**

    - `model`: forward model of the sheet.
    - `conductivity`: sheet conductivity, siemens.
    - `touches`: touches of the sheet, as returned by `Skin.sheet_touches`.
    - `prior`: prior of the amplitudes of the touches.
    - `noise`: standard deviation of the noise of each of M channels (M,), or one value for all, volts.
    - `temperature`: temperature T of the smooth minimum of the sensitivity.

    Raises `ValueError` if the model is not of a sheet, and for incompatible shapes and invalid values.

    **Example:**

    ```python
    pressed = sheet.sheet_touches(touches.places, Bell(2e-3))
    scores = layout_scores(sheet.model, sheet.model_conductivity, pressed, prior=objective.prior, noise=1e-4)
    ```
    """
    conductivity = check_conductivity(model.mesh, conductivity)
    if conductivity.ndim == 3 or jnp.iscomplexobj(conductivity):
        raise ValueError("conductivity: scores need a real, scalar one.")
    noise = as_array(noise, float)
    _check_arguments(model, touches, prior, noise, temperature)
    conductivity = cell_conductivity(model.mesh, conductivity)
    return _compute_scores(model.jacobian(conductivity), conductivity, touches, prior, noise, temperature)


def _check_arguments(model: ForwardModel, touches: SheetTouches, prior: TouchPrior, noise, temperature) -> None:
    num_channels = model.protocol.num_measurements
    if model.mesh.dimension != 2:
        raise ValueError(f"model is of a {model.mesh.dimension}-D body; scores are of the equivalent sheet.")
    if len(prior.factor) != len(touches.slope):
        raise ValueError(
            f"prior is of {len(prior.factor)} places and there are {len(touches.slope)} touches; make it of theirs, "
            "TouchPrior.create(touches.touched.places, …)."
        )
    if noise.shape not in ((), (num_channels,)):
        raise ValueError(f"noise has shape {noise.shape}; give one number, or one for each of {num_channels} channels.")
    if has_values(noise) and not (np.isfinite(noise) & (np.asarray(noise) > 0)).all():
        raise ValueError("noise must be positive and finite: the standard deviation of each channel, in volts.")
    if has_values(temperature) and not 0 < temperature < np.inf:
        raise ValueError(f"temperature must be positive; it is {temperature!r}.")


@numpy_or_compiled
def _compute_scores(jacobian, conductivity, touches: SheetTouches, prior: TouchPrior, noise, temperature) -> Scores:
    """Compute the scores of a layout from the Jacobian (M, m) of the M voltages with respect to the conductivities of m
    cells."""
    xp = namespace(jacobian)
    conductivity_changes, conductivity_slopes = touches.weights(conductivity)
    voltage_changes = conductivity_changes @ jacobian.T  # (n, M)
    sensitivity = xp.linalg.norm(voltage_changes, axis=1)
    soft_minimum_exponents = -xp.log(sensitivity) / temperature
    max_exponent = undifferentiated(soft_minimum_exponents.max())
    log_mean_exponential = max_exponent + xp.log(xp.exp(soft_minimum_exponents - max_exponent).mean())
    whitened_changes = voltage_changes / noise
    information_rows = prior.factor.T @ whitened_changes  # (r, M)
    inverse_cholesky_factor = inverse_cholesky(
        (xp.eye(len(information_rows)) + information_rows @ information_rows.T)[None]
    )[0]
    covariance_factor = prior.factor @ inverse_cholesky_factor.T  # factor B of the posterior covariance C = BBᵀ
    return Scores(
        sensitivity,
        xp.exp(-temperature * log_mean_exponential),
        (covariance_factor**2).sum(axis=1),
        -2 * xp.log(xp.diagonal(inverse_cholesky_factor)).sum(),
        _largest_eigenvalue(covariance_factor.T @ covariance_factor),
        _localisation_error(whitened_changes, conductivity_slopes @ jacobian.T / noise),
    )


def _largest_eigenvalue(semidefinite_matrix: Float[Array, "r r"]) -> Float[Array, ""]:
    """Largest eigenvalue of a positive semidefinite `semidefinite_matrix`. The eigenvalue is computed by repeated
    squaring, which needs only matrix products and can be batched.

    The derivative of a simple eigenvalue is the derivative of vᵀ(matrix)v with the eigenvector v held fixed.
    """
    matrix_power = undifferentiated(semidefinite_matrix)
    for _ in range(_NUM_SQUARINGS):
        matrix_power = matrix_power @ matrix_power
        matrix_power = matrix_power / abs(matrix_power).max()
    dominant_vector = matrix_power[:, namespace(matrix_power).diagonal(matrix_power).argmax()]
    return dominant_vector @ semidefinite_matrix @ dominant_vector / (dominant_vector @ dominant_vector)


def _localisation_error(
    amplitude_slope: Float[Array, "n M"], position_slopes: Float[Array, "2 n M"]
) -> Float[Array, " n"]:
    """Cramér-Rao bound (n,) of the position of a touch, metres: square root of the trace of the (x, y) block of the
    inverse Fisher information, by a Schur complement. The bound is infinite if the information is singular.
    `amplitude_slope`, `position_slopes`: derivatives of the whitened voltages with respect to the amplitude, and to x
    and y."""
    xp, squared_amplitude_slopes = namespace(amplitude_slope), (amplitude_slope**2).sum(axis=1)
    # Part of the position derivatives that is orthogonal to the amplitude derivative. This part may be small, so it is
    # computed before squaring.
    x_slope, y_slope = (
        position_slopes
        - ((position_slopes * amplitude_slope).sum(axis=2) / squared_amplitude_slopes)[..., None] * amplitude_slope
    )
    information_xx, information_yy, information_xy = (
        (x_slope * x_slope).sum(axis=1),
        (y_slope * y_slope).sum(axis=1),
        (x_slope * y_slope).sum(axis=1),
    )
    information_determinant = information_xx * information_yy - information_xy**2
    is_invertible = information_determinant > 1e-12 * information_xx * information_yy
    return xp.where(
        is_invertible,
        xp.sqrt((information_xx + information_yy) / xp.where(is_invertible, information_determinant, 1.0)),
        xp.inf,
    )
