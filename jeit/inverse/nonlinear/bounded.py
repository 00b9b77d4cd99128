"""Reconstruction between bounds, by jaxopt: what optimistix does not do."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jeit.inverse.nonlinear.problem import AbstractPenalty, Inversion

BOUNDED_METHODS = ("l-bfgs-b", "projected-gradient")


class QuadraticForm(AbstractPenalty):
    """½ cᵀQc with a sparse precision Q: entries `value` (k,) at (`row`, `column`); a unit ridge on further unknowns."""

    row: Int[Array, " k"]
    column: Int[Array, " k"]
    value: Float[Array, " k"]
    size: int = eqx.field(static=True)

    @classmethod
    def create(cls, precision, hyperparameter) -> "QuadraticForm":
        """λ² times a SciPy sparse matrix."""
        entries = precision.tocoo()
        return cls(
            jnp.asarray(entries.row),
            jnp.asarray(entries.col),
            hyperparameter**2 * jnp.asarray(entries.data),
            entries.shape[0],
        )

    def cost(self, coefficients):
        """½ cᵀQc."""
        image, rest = coefficients[: self.size], coefficients[self.size :]
        return 0.5 * (jnp.sum(self.value * image[self.row] * image[self.column]) + rest @ rest)

    def diagonal(self, coefficients):
        """Of Q."""
        own = jnp.zeros(self.size).at[self.row].add(jnp.where(self.row == self.column, self.value, 0))
        return jnp.concatenate([own, jnp.ones(coefficients.size - self.size)])

    def model(self, residual, jacobian, coefficients, data):
        """Not for descent along quadratic models: the bounded solvers take gradients. Raises `ValueError`."""
        raise ValueError("A QuadraticForm is minimised by bounded solvers only.")


@eqx.filter_jit
def minimise_between(
    inversion: Inversion,
    start: Float[Array, " n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    method: str,
    max_steps: int,
    tolerance: float,
) -> tuple[Float[Array, " n"], Int[Array, ""], Bool[Array, ""]]:
    """The coefficients of least cost between two bounds, the iterations, and whether they converged.

    `method`: one of `BOUNDED_METHODS`. Converged: a step along the projected gradient, scaled by each coefficient's
    own curvature, changes none by more than `tolerance`.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # jaxopt says on import that it is not developed further
        import jaxopt

    # One size for all coefficients: conditioning decides how many steps a gradient method takes.
    _, jacobian = inversion.linearise(start)
    scale = jax.lax.rsqrt(jnp.sum(jacobian**2, axis=0) + inversion.penalty.diagonal(start))
    unit = inversion.cost(start)

    def objective(scaled):
        return inversion.cost(scale * scaled) / unit

    box = (lower / scale, upper / scale)
    if method == "l-bfgs-b":
        solver = jaxopt.LBFGSB(objective, maxiter=max_steps, tol=tolerance, history_size=20)
        solution = solver.run(start / scale, bounds=box)
    else:
        solver = jaxopt.ProjectedGradient(
            objective, jaxopt.projection.projection_box, maxiter=max_steps, tol=tolerance, acceleration=True
        )
        solution = solver.run(start / scale, hyperparams_proj=box)
    return scale * solution.params, solution.state.iter_num, solution.state.error <= tolerance
