"""Imaging of successive frames in bounded time (`Imager`): linear, or by Gauss-Newton steps from the last image.

Everything that does not depend on the frame is computed once, in advance: independent channels, the prior's basis, the
hyperparameter, integrals over electrodes, the matrix of linear images, and the few dozen combinations of the prior's
shapes (columns of its basis) that the data can resolve. The sizes of arrays never change, so nothing is compiled again:
a masked channel remains in the arrays, with a variance so large that the channel has no effect.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jeit.arguments import counted, describe, is_number, object_text
from jeit.electrodes.point import IntegratedElectrodes
from jeit.forward import ForwardModel
from jeit.inverse.channels import ChannelWeighting, IndependentChannels
from jeit.inverse.hyperparameter.rules import Rule
from jeit.inverse.nonlinear.parametrisation import Parametrisation, as_parametrisation
from jeit.inverse.nonlinear.problem import Inversion, check_background, check_frame, check_noise, keep_informed_shapes
from jeit.inverse.nonlinear.reconstruct import pose_least_squares
from jeit.inverse.nonlinear.solvers import AbstractSolver, GaussNewton, as_solver, expand, residual
from jeit.inverse.prior.bases import expand_rows
from jeit.inverse.prior.matern import smooth_prior
from jeit.inverse.prior.priors import AbstractPrior, check_prior
from jeit_solvers.dense import inverse_cholesky
from jeit_solvers.engines import as_array, namespace, numpy_or_compiled
from jeit_solvers.module import Module

MAX_STEPS_PER_FRAME = 4
"""Default maximum number of iterations per frame."""
# Default tolerance of the solver.
_FRAME_TOLERANCE = 1e-3
# Default minimum signal of a shape of the prior (see `Parametrisation.informative`).
_MIN_SIGNAL = 0.03
# Standard deviation assigned to masked channels, relative to the largest standard deviation of the noise. With a larger
# ratio, covariances to which only masked channels contribute would be singular in double precision.
_MASKED_NOISE_RATIO = 1e3


def check_memory(memory) -> None:
    """Raise `ValueError` unless `memory`, a number of frames, is at least 0."""
    if not (is_number(memory) and memory >= 0):
        raise ValueError(f"memory must be a number of frames, or 0 for none; it is {describe(memory)}.")


class FrameEstimate(Module):
    """Result of an iterative `Imager` for one frame.

    **Fields**: `conductivity` (m,): S/m (2-D: S); `coefficients` (n,): coefficients of the image, from which the next
    frame may start; `misfit`: root mean square of predicted - measured voltages over the channels used, in standard
    deviations; `iterations`: number of iterations; `converged`: whether the next step would have changed the objective
    by less than the tolerance.
    """

    conductivity: Float[Array, " m"]
    coefficients: Float[Array, " n"]
    misfit: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


class LinearMap(Module):
    """Linear image σ = `level` (m,) + `matrix` (m, k) · `estimator` (k, M) · voltages (M,), S/m (2-D: S).

    k is the number of independent channels or of the prior's shapes, whichever is smaller. `matrix` multiplies k
    weights. If earlier frames are remembered, `carry` (k, k) times the deviation of the last image's weights (k,) from
    the weights of an undisturbed frame is added to the weights.
    """

    matrix: Float[Array, "m k"]
    estimator: Float[Array, "k M"]
    level: Float[Array, " m"]
    carry: Float[Array, "k k"]


class Imager(Module):
    """Imager for the frames of one sensor, created by `Imager.create`. `stream` passes frames to the imager and handles
    faulty frames.

    **Fields**: `channels`: independent channels; `inversion`: the least squares problem, whose data are replaced for
    every frame; `noise` (M,): standard deviation of the channels, volts; `mask` (M,): True for channels that are used;
    `expected` (M,): voltages of an undisturbed frame; `offset` (M,): predicted minus measured voltages of the
    undisturbed body, which are added to every frame; `touching` (L, M): True for channels that drive or read each
    electrode; `tied`: pairs (P, 2) of reciprocal channels, and the ratio (P,) of the second voltage to the first;
    `solver`: solver with its settings; `persistence`: fraction of the last image that is expected in the next one, 0
    without a memory.

    **Example:**

    ```python
    imager = Imager.create(model, 1.0, reference=reference, solver="one-step")
    [image.conductivity for image in stream(imager, [voltages])]
    ```
    """

    channels: IndependentChannels
    inversion: Inversion
    noise: Float[Array, " M"]
    mask: Bool[Array, " M"]
    expected: Float[Array, " M"]
    offset: Float[Array, " M"]
    touching: Bool[Array, "L M"]
    tied: tuple[Int[Array, "P 2"], Float[Array, " P"]]
    solver: AbstractSolver
    persistence: float = eqx.field(static=True)

    def __repr__(self) -> str:
        return object_text(
            lambda: (
                f"Imager({type(self.solver).__name__}: {int(np.sum(self.mask))} of {len(self.mask)} channels,\n"
                f"  {self.inversion.model!r})"
            ),
            self,
        )

    @classmethod
    def create(
        cls,
        model: ForwardModel,
        background: ArrayLike,
        *,
        reference: Float[Array, " M"] | None = None,
        solver: AbstractSolver | str | None = None,
        prior: AbstractPrior | None = None,
        hyperparameter: float | str | Rule | None = None,
        noise: Float[Array, " M"] | float | None = None,
        mask: Bool[Array, " M"] | None = None,
        parametrisation: Parametrisation | None = None,
        memory: float = 0.0,
    ) -> "Imager":
        """Create an imager for a forward model.

        - `background`: conductivity of the undisturbed body, S/m (2-D: S).
        - `reference` (M,): measured frame of the undisturbed body, volts. Images are then computed from differences to
          the reference, so that model errors cancel.
        - `solver`: `GaussNewton()` (default), `LevenbergMarquardt()`, or `OneStep()` for linear images. By default a
          solver makes 4 steps per frame and has a tolerance of 1e-3 for the relative change of the objective.
        - `prior`: by default `Gaussian` with a correlation length of about a twelfth of the body's width.
        - `parametrisation`: link, regions and `informative` shapes of the images.
        - `memory`: number of frames over which images are correlated. The last image then predicts the next one (a
          steady-state Kalman filter for coefficients with covariance exp(-|t - t'| / memory) in time), which reduces
          noise but delays changes by a fraction of the memory. With 0, every frame is imaged independently.

        Other arguments are as in `reconstruct`. Raises `ValueError` for invalid or inconsistent arguments.

        Kaipio, Karjalainen, Somersalo and Vauhkonen, Ann. N. Y. Acad. Sci. 873 (1999) 430-439.
        """
        check_memory(memory)
        frame_solver = as_solver(GaussNewton() if solver is None else solver, frames=True).for_frames(
            MAX_STEPS_PER_FRAME, _FRAME_TOLERANCE
        )
        prior = smooth_prior(float(np.ptp(np.asarray(model.mesh.points), axis=0).max())) if prior is None else prior
        check_prior(prior)
        parametrisation = as_parametrisation(parametrisation)
        _check_combination(frame_solver, prior, parametrisation, memory)
        background = check_background(model, background)
        predicted_voltages = model.voltages(background)
        frame, is_used_channel = check_frame(model, predicted_voltages if reference is None else reference, mask)
        _check_reference(np.asarray(frame)[is_used_channel], np.asarray(predicted_voltages)[is_used_channel])
        noise_deviation = check_noise(noise, frame, is_used_channel)
        independent_channels = IndependentChannels.create(model.protocol)
        independent_model = model.with_protocol(model.protocol.subset(np.asarray(independent_channels.index)))
        inversion, _ = pose_least_squares(
            eqx.tree_at(
                lambda forward_model: forward_model.electrodes,
                independent_model,
                IntegratedElectrodes(model.electrodes, model.mesh),
            ),
            independent_channels.weigh(_masked_noise(noise_deviation, is_used_channel)).combine(predicted_voltages),
            background,
            prior,
            hyperparameter,
            parametrisation,
        )
        persistence_per_frame = float(np.exp(-1 / memory)) if memory > 0 else 0.0
        min_signal = _MIN_SIGNAL if parametrisation.informative is None else parametrisation.informative
        if (min_signal > 0 or memory > 0) and inversion.penalty.is_standard_normal:
            inversion = keep_informed_shapes(inversion, min_signal, persistence_per_frame)
        return cls(
            channels=independent_channels,
            inversion=inversion,
            noise=as_array(noise_deviation),
            mask=as_array(is_used_channel),
            expected=jnp.where(is_used_channel, frame, predicted_voltages),
            offset=jnp.where(is_used_channel, predicted_voltages - frame, 0),
            touching=jnp.asarray(
                [model.protocol.channels_touching(electrode) for electrode in range(model.protocol.num_electrodes)]
            ),
            tied=jax.tree.map(as_array, model.protocol.reciprocal_pairs()),
            solver=frame_solver,
            persistence=persistence_per_frame,
        )

    def with_reference(self, reference: Float[Array | np.ndarray, " M"]) -> "Imager":
        """Copy of the imager with a new reference frame (M,) of the undisturbed body, volts, for example after
        electrodes were wetted.

        Model, noise, hyperparameter and the channels in use do not change, so nothing is compiled again. Raises
        `ValueError` for a reference that has the wrong shape, lacks a reading of a channel in use, or differs from the
        model's voltages by a factor of ten or in sign.
        """
        frame, is_used_channel = np.asarray(reference, float), np.asarray(self.mask)
        if frame.shape != is_used_channel.shape:
            raise ValueError(
                f"reference has shape {frame.shape}; give ({is_used_channel.size},), a frame of the undisturbed body."
            )
        if (missing_channels := np.flatnonzero(is_used_channel & ~np.isfinite(frame))).size:
            raise ValueError(
                f"reference has no reading of {counted(missing_channels.size, 'channel')} in use, the first number "
                f"{missing_channels[0]}."
            )
        predicted_voltages = np.asarray(self.expected) + np.asarray(self.offset)
        _check_reference(frame[is_used_channel], predicted_voltages[is_used_channel])
        new_fields = (
            as_array(np.where(is_used_channel, frame, predicted_voltages)),
            as_array(np.where(is_used_channel, predicted_voltages - frame, 0)),
        )
        return eqx.tree_at(lambda imager: (imager.expected, imager.offset), self, new_fields)

    @property
    def start(self) -> Float[Array, " n"]:
        """Coefficients (n,) of the background, from which the iteration for the first frame starts."""
        return jnp.zeros(self.inversion.num_coefficients)

    @property
    def steps(self) -> int:
        """Maximum number of iterations per frame."""
        return 1 if self.solver.is_linear else self.solver.descent(MAX_STEPS_PER_FRAME, _FRAME_TOLERANCE).history - 1

    def weighing(self, usable: Bool[Array, " M"]) -> ChannelWeighting:
        """`ChannelWeighting` that maps frames to data in which only the `usable` channels have an effect."""
        return self.channels.weigh(_masked_noise(self.noise, self.mask & usable))

    def linear_map(self, weighing: ChannelWeighting) -> LinearMap:
        """Linear map from frames to images for a `weighing` of the channels: one Gauss-Newton step from the
        background."""
        return _compute_linear_map(self.inversion, weighing, self.offset, self.persistence)

    def estimate(
        self, frame: Float[Array, " M"], weighing: ChannelWeighting, start: Float[Array, " n"]
    ) -> FrameEstimate:
        """Image of a frame (M,) in volts, computed by at most `steps` iterations from the coefficients `start`.

        With a memory, `start` is also the prior mean, `persistence` times the last image's coefficients. Unused
        channels must have finite voltages, preferably those of the last frame.
        """
        return _estimate_frame(self, frame, weighing, start)


def _check_combination(solver: AbstractSolver, prior: AbstractPrior, parametrisation: Parametrisation, memory) -> None:
    """Raise `ValueError` for settings that require a covariance that the prior does not have, or that take unbounded
    time per frame."""
    if memory > 0 and not prior.is_quadratic:
        raise ValueError("memory: total variation has no covariance to carry on; take another prior, or memory 0.")
    if solver.is_linear and not prior.is_quadratic:
        raise ValueError("prior: total variation is not linear; take solver 'gauss-newton', or another prior.")
    for name, unsupported_option in (("bounds", parametrisation.bounds), ("unknowns", parametrisation.unknowns)):
        if unsupported_option:
            raise ValueError(f"{name}: an Imager takes none, for its time a frame is bounded; take reconstruct.")


def _check_reference(measured, predicted) -> None:
    """Check units and polarity of a reference frame. Raise `ValueError` if measured and predicted voltages differ by a
    factor of ten or in sign, which model errors do not explain."""
    voltage_ratio = measured @ predicted / (predicted @ predicted)
    if not 0.1 < voltage_ratio < 10:
        raise ValueError(
            f"reference: it is {voltage_ratio:.2g} times what the model predicts for the background; are both in SI "
            "units, and the signs right? See calibrate."
        )


@numpy_or_compiled
def _masked_noise(noise, is_used) -> Float[Array, " M"]:
    xp = namespace(noise, is_used)
    return xp.where(is_used, noise, _MASKED_NOISE_RATIO * xp.max(xp.where(is_used, noise, 0)))


@numpy_or_compiled
def _compute_linear_map(inversion: Inversion, weighing: ChannelWeighting, offset, persistence: float) -> LinearMap:
    xp = namespace(inversion, weighing, offset)
    zero_coefficients = xp.zeros(inversion.num_coefficients)
    problem = eqx.tree_at(lambda inverse_problem: inverse_problem.data, inversion, weighing.combine(offset))
    residual, jacobian = problem.linearise(zero_coefficients)
    inverse_factor = inverse_cholesky((jacobian @ jacobian.T + problem.data.covariance)[None])[0]
    gain_matrix = (inverse_factor.T @ (inverse_factor @ jacobian)).T
    if inversion.num_coefficients <= len(residual):
        unit_coefficients = xp.eye(inversion.num_coefficients)
        carried_estimate_matrix = persistence * (unit_coefficients - gain_matrix @ jacobian)
    else:  # not reached with a memory: there are then no more shapes than data
        unit_coefficients, gain_matrix = gain_matrix.T, xp.eye(len(residual))
        carried_estimate_matrix = xp.zeros_like(gain_matrix)
    image_matrix = (
        expand_rows(inversion.basis, unit_coefficients).T * inversion.link.slope(inversion.reference)[:, None]
    )
    constant_image = inversion.link.conductivity(inversion.reference) - image_matrix @ (gain_matrix @ residual)
    return LinearMap(
        image_matrix,
        gain_matrix @ (weighing.weight[:, None] * weighing.estimator),
        constant_image,
        carried_estimate_matrix,
    )


@jax.jit
def _estimate_frame(imager: Imager, frame, weighing: ChannelWeighting, start_coefficients) -> FrameEstimate:
    combined_data = weighing.combine(frame + imager.offset)
    inversion = eqx.tree_at(lambda inverse_problem: inverse_problem.data, imager.inversion, combined_data)
    zero_mean = jnp.zeros_like(start_coefficients)
    if imager.persistence > 0:  # the prior mean follows the last image, and the coefficients are relative to this mean
        zero_mean, start_coefficients = start_coefficients, zero_mean
        inversion = eqx.tree_at(
            lambda inverse_problem: inverse_problem.reference, inversion, inversion.estimate(zero_mean)
        )
    gauss_newton_descent = imager.solver.descent(MAX_STEPS_PER_FRAME, _FRAME_TOLERANCE)
    solver_solution = optx.least_squares(
        residual,
        gauss_newton_descent,
        start_coefficients,
        inversion,
        options={"expand": expand},
        max_steps=imager.steps,
        throw=False,
    )
    # The objective at the point reached by the last step is not known yet; it requires voltages but no Jacobian.
    descent_state = solver_solution.state
    trial_cost = inversion.cost(descent_state.trial)
    is_trial_better = trial_cost < descent_state.cost
    coefficients = jnp.where(is_trial_better, descent_state.trial, solver_solution.value)
    penalty, min_cost = inversion.penalty.cost(coefficients), jnp.where(is_trial_better, trial_cost, descent_state.cost)
    squared_misfit = 2 * (min_cost - penalty) + combined_data.rest
    return FrameEstimate(
        conductivity=inversion.conductivity(coefficients),
        coefficients=zero_mean + coefficients,
        misfit=jnp.sqrt(squared_misfit / jnp.sum(weighing.noise <= jnp.max(imager.noise))),
        iterations=descent_state.num_accepted - 1 + is_trial_better,
        converged=descent_state.converged
        | (min_cost <= gauss_newton_descent.atol),  # no step can lower the cost by more than its value
    )
