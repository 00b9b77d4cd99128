"""Solvers of the nonlinear least squares problem: objects that contain settings and declare which problems they can
solve.

`SOLVERS` lists the solvers by name, and `as_solver` converts a name to an object.
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from jeit.arguments import check_kind, check_name, counted
from jeit.inverse.nonlinear.problem import Inversion, as_solution, check_steps, check_tolerance
from jeit_solvers import BoundedMinimum, Descent, Status, ended, ended_number, lbfgsb, projected_gradient
from jeit_solvers.engines import as_array, evaluate_in_numpy, has_values, on_host, undifferentiated
from jeit_solvers.module import Module

_Setting = TypeVar("_Setting")

_MAX_STEPS = 30
_REASON_BY_STATUS = {
    Status.CONVERGED: "The next step would change the objective by less than the tolerance.",
    Status.STEP_LIMIT: "Stopped after {}; raise max_steps, or the hyperparameter.",
    Status.STALLED: "No shorter step lowered the objective; the model is at odds with the data.",
}

_ROUNDED_REASON = "The next step would change the objective by less than its rounding."
# Rounding error of the objective, which is a sum over all channels, in units of its machine precision.
_ROUNDING_FACTOR = 100.0
_TRACED_REASON = "It was solved inside a transformation of JAX; the status says how that ended."


class Solution(NamedTuple):
    """Result of a solver.

    **Fields**: `coefficients` (n,): coefficients of the image at the minimum; `iterations`: number of iterations;
    `costs`: objective at the start and at every accepted iterate, for a traced problem only at start and end; `status`:
    how the solver ended, for a traced problem the number of the `Status`; `reason`: a sentence on how the solver ended.
    """

    coefficients: Float[Array, " n"]
    iterations: int | Int[Array, ""]
    costs: Float[Array, " steps"]
    status: Status | Int[Array, ""]
    reason: str


class AbstractSolver(Module):
    """Base of all solvers of `reconstruct` and `Imager`. A new solver is a subclass with `minimise` and an entry in
    `SOLVERS`."""

    name: ClassVar[str]

    @property
    def keeps_bounds(self) -> bool:
        """Whether the solver minimises between bounds on the coefficients, with one coefficient per cell."""
        return False

    @property
    def needs_squares(self) -> bool:
        """Whether the solver requires an objective that is a sum of squares, unlike total variation."""
        return False

    @property
    def is_linear(self) -> bool:
        """Whether the solver makes one step from the background, with the same matrix for every frame."""
        return False

    @abc.abstractmethod
    def minimise(self, inversion: Inversion, start: Float[Array, " n"], box) -> Solution:
        """Minimise the objective from `start`. A solver that keeps bounds minimises between the lower and upper bounds
        `box`, (n,) each."""

    def for_frames(self, max_steps: int | None = None, rtol: float | None = None) -> "AbstractSolver":
        """Copy of the solver for an `Imager`, in which `max_steps` and `rtol` replace settings that are None. Raises
        `ValueError` if the solver does not image a frame in a bounded time."""
        raise ValueError(
            f"solver: {self.name} does not image frames in a bounded time; take one of {', '.join(frame_solvers())}."
        )

    def descent(self, max_steps: int, rtol: float) -> Descent:
        """Descent method that optimistix runs, with the arguments in place of settings that are None. The descent
        records the cost at the start and after each of `max_steps` steps. Raises `ValueError` if the solver does not
        use a descent."""
        raise ValueError(f"solver: {self.name} does not descend along quadratic models.")


class GaussNewton(AbstractSolver):
    """Gauss-Newton method with a backtracking line search; total variation is treated by lagged diffusivity.

    **Arguments:** `max_steps`: maximum number of steps, default 30, for an `Imager` 4; rejected steps and the shorter
    steps that replace them all count. `rtol`: the iteration ends when the next step would change the objective by less
    than rtol times the objective or rtol times ½ (½ is the contribution of one voltage with an error of one standard
    deviation to the objective); default 1e-6, with total variation 1e-4, for an `Imager` 1e-3.

    **Example:**

    ```python
    image = reconstruct(model, voltages, 1.0, hyperparameter=1.0, solver=GaussNewton(max_steps=10))
    image.iterations, image.status
    ```
    """

    name: ClassVar[str] = "gauss-newton"
    max_steps: int | None = eqx.field(static=True, default=None)
    rtol: float | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        _check_settings(self.max_steps, self.rtol)

    def minimise(self, inversion, start, box):
        """Minimise by `jeit_solvers.Descent`."""
        return _run_descent(self.descent(_MAX_STEPS, inversion.penalty.descent_tolerance), inversion, start)

    def for_frames(self, max_steps=None, rtol=None):
        """Copy of the solver in which the arguments replace settings that are None."""
        return GaussNewton(_or_default(self.max_steps, max_steps), _or_default(self.rtol, rtol))

    def descent(self, max_steps, rtol):
        """Descent method without damping, with the arguments in place of settings that are None."""
        return _create_descent(_or_default(self.max_steps, max_steps), _or_default(self.rtol, rtol))


class LevenbergMarquardt(AbstractSolver):
    """Levenberg-Marquardt method: Gauss-Newton steps, whose damping is increased when a step is rejected.

    **Arguments:** `max_steps`, `rtol`: as for `GaussNewton`. `damping`: damping of the first step, as a factor of the
    prior's precision. Raises `ValueError` for invalid settings.

    **Example:**

    ```python
    image = reconstruct(model, voltages, 1.0, hyperparameter=1.0, solver=LevenbergMarquardt(max_steps=20))
    ```
    """

    name: ClassVar[str] = "levenberg-marquardt"
    max_steps: int | None = eqx.field(static=True, default=None)
    rtol: float | None = eqx.field(static=True, default=None)
    damping: float = eqx.field(static=True, default=1.0)

    def __check_init__(self):
        _check_settings(self.max_steps, self.rtol)
        if not self.damping > 0:
            raise ValueError(f"damping must be positive; it is {self.damping}. Without it, take GaussNewton().")

    def minimise(self, inversion, start, box):
        """Minimise by `jeit_solvers.Descent`."""
        return _run_descent(self.descent(_MAX_STEPS, inversion.penalty.descent_tolerance), inversion, start)

    def for_frames(self, max_steps=None, rtol=None):
        """Copy of the solver in which the arguments replace settings that are None."""
        return LevenbergMarquardt(_or_default(self.max_steps, max_steps), _or_default(self.rtol, rtol), self.damping)

    def descent(self, max_steps, rtol):
        """Descent method with damping, with the arguments in place of settings that are None."""
        return _create_descent(_or_default(self.max_steps, max_steps), _or_default(self.rtol, rtol), self.damping)


class LBFGSB(AbstractSolver):
    """L-BFGS-B method between bounds.

    **Arguments:**

    - `max_steps`: maximum number of steps.
    - `tolerance`: the iteration has converged when a step along the projected gradient changes no scaled coefficient by
      more than this number.

    **Example:**

    ```python
    parametrisation = Parametrisation(bounds=(0.5, 3.0))
    reconstruct(model, voltages, 1.0, hyperparameter=1.0, solver=LBFGSB(), parametrisation=parametrisation).status
    ```
    """

    name: ClassVar[str] = "l-bfgs-b"
    max_steps: int = eqx.field(static=True, default=1000)
    tolerance: float = eqx.field(static=True, default=1e-6)

    def __check_init__(self):
        _check_settings(self.max_steps, self.tolerance, "tolerance")

    @property
    def keeps_bounds(self):
        """True: the solver minimises between bounds on the coefficients."""
        return True

    def minimise(self, inversion, start, box):
        """Minimise by `jeit_solvers.lbfgsb`."""
        return _minimise_in_box(lbfgsb, inversion, start, box, self.max_steps, self.tolerance)


class ProjectedGradient(AbstractSolver):
    """Accelerated projected gradient method between bounds.

    **Arguments:**

    - `max_steps`, `tolerance`: as for `LBFGSB`.

    **Example:**

    ```python
    solver = ProjectedGradient(max_steps=500)
    ```
    """

    name: ClassVar[str] = "projected-gradient"
    max_steps: int = eqx.field(static=True, default=1000)
    tolerance: float = eqx.field(static=True, default=1e-6)

    def __check_init__(self):
        _check_settings(self.max_steps, self.tolerance, "tolerance")

    @property
    def keeps_bounds(self):
        """True: the solver minimises between bounds on the coefficients."""
        return True

    def minimise(self, inversion, start, box):
        """Minimise by `jeit_solvers.projected_gradient`."""
        return _minimise_in_box(projected_gradient, inversion, start, box, self.max_steps, self.tolerance)


class LeastSquares(AbstractSolver):
    """A least-squares `solver` of optimistix, with the tolerances of this solver; not for total variation."""

    name: ClassVar[str] = "a solver of optimistix"
    solver: optx.AbstractLeastSquaresSolver
    max_steps: int = eqx.field(static=True, default=_MAX_STEPS)

    def __check_init__(self):
        _check_settings(self.max_steps, None)

    @property
    def needs_squares(self):
        """True: the objective must be a sum of squares."""
        return True

    def minimise(self, inversion, start, box):
        """Minimise the sum of squares of the residuals of data and prior."""
        if not has_values(inversion, start):
            frozen_problem, frozen_start = undifferentiated((inversion, start))
            solution = _least_squares(frozen_problem, frozen_start, self.solver, self.max_steps, {})
            status_number = ended_number(solution.result)
            return _traced_solution(inversion, start, solution.value, solution.stats["num_steps"], status_number)
        solution = _least_squares(inversion, start, self.solver, self.max_steps, {})
        costs = _costs_at(inversion, start, solution.value)
        status, iterations = ended(solution.result), int(solution.stats["num_steps"])
        if status == Status.STEP_LIMIT and _is_within_rounding(inversion, solution.value):
            return Solution(solution.value, iterations, costs, Status.CONVERGED, _ROUNDED_REASON)
        return Solution(solution.value, iterations, costs, status, _reason_of_end(status, iterations))


class OneStep(AbstractSolver):
    """Linear images for an `Imager`: one Gauss-Newton step from the background.

    **Example:**

    ```python
    imager = Imager.create(model, 1.0, reference=reference, solver=OneStep())
    ```
    """

    name: ClassVar[str] = "one-step"

    @property
    def is_linear(self):
        """True: images are linear in the voltages."""
        return True

    def minimise(self, inversion, start, box):
        """Not available, because linear images require no minimisation. Raises `ValueError`."""
        raise ValueError("solver: linear images are those of one_step, or of an Imager; take another solver.")

    def for_frames(self, max_steps=None, rtol=None):
        """Copy of the solver in which the arguments replace settings that are None."""
        return self


SOLVERS: dict[str, type[AbstractSolver]] = {
    kind.name: kind for kind in (OneStep, GaussNewton, LevenbergMarquardt, LBFGSB, ProjectedGradient)
}
"""Solvers by name."""


def frame_solvers() -> tuple[str, ...]:
    """Names of the solvers that image a frame in a bounded time, for an `Imager`."""
    return tuple(name for name, method in SOLVERS.items() if method.for_frames is not AbstractSolver.for_frames)


def as_solver(
    solver: "AbstractSolver | optx.AbstractLeastSquaresSolver | str", *, frames: bool = False
) -> AbstractSolver:
    """Convert a name in `SOLVERS` or a least-squares solver of optimistix to a solver; solvers are returned unchanged.
    Raises `ValueError` for anything else; the message lists the solvers for `frames` or for `reconstruct`."""
    names = frame_solvers() if frames else tuple(name for name, method in SOLVERS.items() if not method().is_linear)
    if isinstance(solver, str):
        if solver not in SOLVERS:
            check_name("solver", solver, names)
        return SOLVERS[solver]()
    if isinstance(solver, optx.AbstractLeastSquaresSolver):
        return LeastSquares(solver)
    solver_hint = f"one of jeit.inverse.nonlinear, such as GaussNewton(), a name ({', '.join(names)}), or optimistix's"
    check_kind("solver", solver, AbstractSolver, f"{solver_hint} least squares")
    return solver


def counted_iterations(iterations: int, shortened: int = 0) -> str:
    """Text that states the numbers of iterations and of shortened steps of a solver."""
    iteration_count = counted(iterations, "iteration")
    if not shortened:
        return iteration_count
    return f"{iteration_count} and {counted(shortened, 'step')} that led too far"


def _reason_of_end(status: Status, iterations: int, shortened: int = 0) -> str:
    return _REASON_BY_STATUS[status].format(counted_iterations(iterations, shortened))


def expand(coefficients: Float[Array, " n"], inversion: Inversion):
    """Objective and step of the problem `inversion` at these coefficients, for the option `expand` of
    `jeit_solvers.Descent`."""
    return inversion.quadratic_model(coefficients)


def residual(coefficients: Float[Array, " n"], inversion: Inversion):
    """Residuals of data and prior, each of unit variance, for the least-squares solvers of optimistix."""
    return inversion.data.whiten(inversion.residual(coefficients)), coefficients


def _check_settings(max_steps, tolerance, name: str = "rtol") -> None:
    if max_steps is not None:
        check_steps("max_steps", max_steps)
    if tolerance is not None:
        check_tolerance(name, tolerance)


def _or_default(setting: _Setting | None, default: _Setting) -> _Setting:
    return default if setting is None else setting


@eqx.filter_jit
def _least_squares(inversion: Inversion, start, solver, max_steps: int, options: dict[str, Any]) -> Any:
    return optx.least_squares(residual, solver, start, inversion, options=options, max_steps=max_steps, throw=False)


def _create_descent(max_steps: int, rtol: float, damping: float = 0.0) -> Descent:
    """Descent of at most `max_steps` steps, with a history that also contains the start. `atol` ends the iteration when
    the objective tends to zero, as for an undisturbed frame, where no change is small relative to the objective."""
    return Descent(rtol=rtol, atol=0.5 * rtol, damping=damping, history=max_steps + 1)


def _run_descent(descent: Descent, inversion: Inversion, start) -> Solution:
    if inversion.is_solvable_in_numpy:
        start, problem = on_host((start, inversion))
        minimum, state = descent.at_once(expand, start, problem, descent.history)
        minimum = as_array(minimum)
        status = Status.CONVERGED if state.converged else Status.STALLED if state.is_stuck else Status.STEP_LIMIT
    elif not has_values(inversion, start):
        problem, frozen_start = undifferentiated((inversion, start))
        solution = _least_squares(problem, frozen_start, descent, descent.history, {"expand": expand})
        iterations = jnp.maximum(solution.state.num_accepted - 1, 0)
        return _traced_solution(inversion, start, solution.value, iterations, ended_number(solution.result))
    else:
        solution = _least_squares(inversion, start, descent, descent.history, {"expand": expand})
        minimum, state, status = solution.value, solution.state, ended(solution.result)
    num_accepted_steps = int(state.num_accepted)
    iterations = max(num_accepted_steps - 1, 0)
    reason = _reason_of_end(status, iterations, int(state.num_steps) - 1 - iterations)
    return Solution(minimum, iterations, as_array(np.asarray(state.history)[:num_accepted_steps]), status, reason)


def _traced_solution(inversion: Inversion, start, coefficients, iterations, status, box=None) -> Solution:
    """Result of a solver inside jax.jit, jax.grad or jax.vmap: `coefficients` with the derivatives of the exact
    minimum."""
    coefficients = as_solution(coefficients, inversion, box)
    costs = _costs_at(inversion, start, coefficients)
    return Solution(coefficients, iterations, costs, status, _TRACED_REASON)


def _minimise_in_box(minimise, inversion: Inversion, start, box, max_steps: int, tolerance: float) -> Solution:
    start = jnp.clip(start, *box)
    lower_bounds, upper_bounds = box
    if not has_values(inversion, start, box):
        problem, frozen_start, *frozen_bounds = undifferentiated((inversion, start, lower_bounds, upper_bounds))
        minimum = minimise_within_bounds(
            problem, frozen_start, frozen_bounds[0], frozen_bounds[1], minimise, int(max_steps), float(tolerance)
        )
        status = jnp.where(minimum.converged, Status.CONVERGED.number, Status.STEP_LIMIT.number)
        return _traced_solution(inversion, start, minimum.x, minimum.steps, status, box)
    minimum = minimise_within_bounds(
        inversion, start, lower_bounds, upper_bounds, minimise, int(max_steps), float(tolerance)
    )
    costs = _costs_at(inversion, start, minimum.x)
    if minimum.converged:
        reason = "No step between the bounds would change the image much."
        return Solution(minimum.x, int(minimum.steps), costs, Status.CONVERGED, reason)
    iterations = int(minimum.steps)
    return Solution(minimum.x, iterations, costs, Status.STEP_LIMIT, _reason_of_end(Status.STEP_LIMIT, iterations))


@eqx.filter_jit
def minimise_within_bounds(
    inversion: Inversion,
    start: Float[Array, " n"],
    lower_bounds: Float[Array, " n"],
    upper_bounds: Float[Array, " n"],
    minimise,
    max_steps: int,
    tolerance: float,
) -> BoundedMinimum:
    """Minimise the objective between `lower_bounds` and `upper_bounds` with the function `minimise`, which is
    `jeit_solvers.lbfgsb` or `projected_gradient`.

    Coefficients are divided by a scale computed from the curvature of the objective. The iteration has converged when a
    step along the projected gradient changes no scaled coefficient by more than `tolerance`.
    """
    # Coefficients are scaled to similar curvature, because the number of steps depends on the conditioning.
    _, jacobian = inversion.linearise(start)
    coefficient_scale = jax.lax.rsqrt(jnp.sum(jacobian**2, axis=0) + inversion.penalty.diagonal(start))
    start_cost = inversion.cost(start)
    scaled_minimum = minimise(
        lambda scaled_coefficients: inversion.cost(coefficient_scale * scaled_coefficients) / start_cost,
        start / coefficient_scale,
        lower_bounds / coefficient_scale,
        upper_bounds / coefficient_scale,
        max_steps=max_steps,
        tolerance=tolerance,
    )
    return BoundedMinimum(coefficient_scale * scaled_minimum.x, scaled_minimum.steps, scaled_minimum.converged)


@eqx.filter_jit
def _is_within_rounding(inversion: Inversion, coefficients):
    """Whether a Gauss-Newton step would lower the objective by no more than its rounding error. Solvers that accept
    steps by the decrease of the objective then stall before they reach very small tolerances."""
    cost, model_step = inversion.quadratic_model(coefficients)
    _, cost_slope, cost_curvature = model_step(0.0)
    return abs(cost_slope + 0.5 * cost_curvature) <= _ROUNDING_FACTOR * jnp.finfo(cost.dtype).eps * cost


def _costs_at(inversion: Inversion, *points: Float[Array, " n"]) -> Float[Array, " p"]:
    """Objective at some points; without compilation where the model runs in NumPy."""
    if inversion.is_solvable_in_numpy and has_values(points):
        return as_array(np.array([evaluate_in_numpy(Inversion.cost, inversion, point) for point in points]))
    return jnp.stack([_compiled_cost(inversion, point) for point in points])


@eqx.filter_jit
def _compiled_cost(inversion: Inversion, coefficients):
    return inversion.cost(coefficients)
