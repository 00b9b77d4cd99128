"""`Imager`: images frame after frame, linear or by Gauss-Newton from the last image, in a bounded time.

Everything that does not depend on the frame is computed once: which channels are independent, the prior's basis, the
hyperparameter, the electrodes' integrals, the linear image's matrix, and the combinations of the prior's shapes, some
dozens, that the data can resolve. Array shapes never change, so nothing is compiled again: a channel that is masked
keeps its place, and gets a variance so large that it does not count.
"""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jeit.arguments import describe, is_number
from jeit.electrodes.point import IntegratedElectrodes
from jeit.forward import ForwardModel
from jeit.inverse.channels import IndependentChannels, Weighing
from jeit.inverse.hyperparameter.rules import Rule
from jeit.inverse.nonlinear.parametrisation import Parametrisation, as_parametrisation
from jeit.inverse.nonlinear.problem import Inversion, check_background, check_frame, check_noise, informed
from jeit.inverse.nonlinear.reconstruct import pose
from jeit.inverse.nonlinear.solvers import AbstractSolver, GaussNewton, as_solver, expand, residual
from jeit.inverse.prior.matern import smooth_prior
from jeit.inverse.prior.priors import AbstractPrior, check_prior
from jeit_solvers.engines import as_array

FRAME_STEPS = 4
"""Most iterations that a frame is given, unless the solver says otherwise."""
# The tolerance unless the solver says otherwise, and the least information of a shape that is kept.
_RTOL, _INFORMATIVE = 1e-3, 0.03
# Standard deviation of a masked channel over the largest noise. With a larger one, combinations that only masked
# channels measure would have no inverse in double precision.
_BLIND = 1e3


def check_memory(memory) -> None:
    """Raises `ValueError` for what is no number of frames."""
    if not (is_number(memory) and memory >= 0):
        raise ValueError(f"memory must be a number of frames, or 0 for none; it is {describe(memory)}.")


class FrameEstimate(eqx.Module):
    """Result of an `Imager` for one frame by iteration.

    **Fields**: `conductivity` (m,), S/m (2-D: S); `coefficients`, where the next frame may start; `misfit`, root mean
    square in standard deviations of the channels used; `iterations`; `converged`, whether one more step would have
    changed the objective by less than the tolerance.
    """

    conductivity: Float[Array, " m"]
    coefficients: Float[Array, " n"]
    misfit: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


class LinearMap(eqx.Module):
    """The linear image: σ = `level` (m,) + `matrix` (m, k) · `estimator` (k, M) · voltages (M,), S/m (2-D: S).

    k is the number of independent channels or of the prior's shapes, whichever is smaller. With a memory, the weights
    of the last image's shapes (k,), less those of an undisturbed frame, come in times `carry` (k, k).
    """

    matrix: Float[Array, "m k"]
    estimator: Float[Array, "k M"]
    level: Float[Array, " m"]
    carry: Float[Array, "k k"]


class Imager(eqx.Module):
    """Images frames of one sensor. Made by `Imager.create`; `stream` passes frames to it, and handles bad ones.

    **Fields**: `channels`, which of them are independent; `inversion`, the problem, whose data are exchanged for every
    frame's; `noise` (M,), volts; `mask` (M,), the channels used at all; `expected` (M,) volts, an undisturbed frame;
    `offset` (M,) volts, added to frames: the part of the model's voltages that the sensor's lack; `touching` (L, M),
    channels that drive or read each electrode; `tied`, pairs (P, 2) of channels that reciprocity ties, and the ratio
    (P,) of the second's voltage to the first's; `solver`, with the most iterations that a frame is given;
    `persistence`, the share of the last image that the next one is expected to keep, 0 without a memory.
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
        """`background`: conductivity of the undisturbed body, S/m (2-D: S). `reference` (M,): a measured frame of it,
        volts; frames are then imaged by their difference to it, so that errors of the model cancel. `solver`:
        `GaussNewton()` unless given, `LevenbergMarquardt()` or, for linear images, `OneStep()`; by at most 4 steps a
        frame, and until the objective changes by less than 1e-3, unless it says otherwise. `prior`: `Gaussian` of a
        twelfth of the body's width unless given. `parametrisation`: its link, regions and `informative` shapes.
        `memory`: frames over which an image changes; the last image then predicts the next (a Kalman filter in its
        steady state, of coefficients with covariance exp(-|t - t'| / memory) in time), which takes noise out and lags
        by a part of it; 0 takes every frame alone. The rest as in `reconstruct`. Raises `ValueError` for arguments that
        do not fit.

        Kaipio, Karjalainen, Somersalo and Vauhkonen, Ann. N. Y. Acad. Sci. 873 (1999) 430-439.
        """
        check_memory(memory)
        chosen = as_solver(GaussNewton() if solver is None else solver, frames=True).for_frames(FRAME_STEPS, _RTOL)
        prior = smooth_prior(float(np.ptp(np.asarray(model.mesh.points), axis=0).max())) if prior is None else prior
        check_prior(prior)
        parametrisation = as_parametrisation(parametrisation)
        _check_together(chosen, prior, parametrisation, memory)
        background = check_background(model, background)
        predicted = model.voltages(background)
        frame, used = check_frame(model, predicted if reference is None else reference, mask)
        _check_reference(np.asarray(frame)[used], np.asarray(predicted)[used])
        deviation = check_noise(noise, frame, used)
        channels = IndependentChannels.create(model.protocol)
        small = model.with_protocol(model.protocol.subset(np.asarray(channels.index)))
        inversion, _ = pose(
            eqx.tree_at(lambda m: m.electrodes, small, IntegratedElectrodes(model.electrodes, model.mesh)),
            channels.weigh(_blinded(deviation, used)).combine(predicted),
            background,
            prior,
            hyperparameter,
            parametrisation,
        )
        persistence = float(np.exp(-1 / memory)) if memory > 0 else 0.0
        least = _INFORMATIVE if parametrisation.informative is None else parametrisation.informative
        if (least > 0 or memory > 0) and inversion.penalty.is_standard_normal:
            inversion = informed(inversion, least, persistence)
        return cls(
            channels=channels,
            inversion=inversion,
            noise=as_array(deviation),
            mask=as_array(used),
            expected=jnp.where(used, frame, predicted),
            offset=jnp.where(used, predicted - frame, 0),
            touching=jnp.asarray([model.protocol.channels_touching(k) for k in range(model.protocol.num_electrodes)]),
            tied=jax.tree.map(as_array, model.protocol.reciprocal_pairs()),
            solver=chosen,
            persistence=persistence,
        )

    @property
    def start(self) -> Float[Array, " n"]:
        """Coefficients of the background: where the first frame starts."""
        return jnp.zeros(self.inversion.num_coefficients)

    @property
    def steps(self) -> int:
        """Most iterations that a frame is given."""
        return 1 if self.solver.is_linear else self.solver.descent(FRAME_STEPS, _RTOL).history - 1

    def weighing(self, usable: Bool[Array, " M"]) -> Weighing:
        """Weights that combine frames of which only the `usable` channels count."""
        return self.channels.weigh(_blinded(self.noise, self.mask & usable))

    def linear_map(self, weighing: Weighing) -> LinearMap:
        """The linear image for frames combined in this way: one Gauss-Newton step from the background."""
        return _linear_map(self.inversion, weighing, self.offset, self.persistence)

    def estimate(self, frame: Float[Array, " M"], weighing: Weighing, start: Float[Array, " n"]) -> FrameEstimate:
        """The image of a frame (M,) in volts, by at most `steps` iterations from coefficients `start`.

        With a memory, `start` is also what the prior expects: `persistence` times the last image's coefficients.
        Channels that do not count must hold some finite voltage, best that of the last frame.
        """
        return _estimate(self, frame, weighing, start)


def _check_together(solver: AbstractSolver, prior: AbstractPrior, parametrisation: Parametrisation, memory) -> None:
    """Raise `ValueError` for settings that need a covariance, or more than a bounded time."""
    if memory > 0 and not prior.is_quadratic:
        raise ValueError("memory: total variation has no covariance to carry on; take another prior, or memory 0.")
    if solver.is_linear and not prior.is_quadratic:
        raise ValueError("prior: total variation is not linear; take solver 'gauss-newton', or another prior.")
    for name, given in (("bounds", parametrisation.bounds), ("unknowns", parametrisation.unknowns)):
        if given:
            raise ValueError(f"{name}: an Imager takes none, for its time a frame is bounded; take reconstruct.")


def _check_reference(measured, predicted) -> None:
    """Check units and polarity: a factor of ten, or a wrong sign, is not an error of the model."""
    ratio = measured @ predicted / (predicted @ predicted)
    if not 0.1 < ratio < 10:
        raise ValueError(
            f"reference: it is {ratio:.2g} times what the model predicts for the background; are both in SI units, and "
            "the signs right? See calibrate."
        )


def _blinded(noise, used) -> Float[Array, " M"]:
    return jnp.where(used, noise, _BLIND * jnp.max(jnp.where(used, noise, 0)))


@functools.partial(jax.jit, static_argnames="persistence")
def _linear_map(inversion: Inversion, weighing: Weighing, offset, persistence: float) -> LinearMap:
    start = jnp.zeros(inversion.num_coefficients)
    posed = eqx.tree_at(lambda i: i.data, inversion, weighing.combine(offset))
    residual, jacobian = posed.linearise(start)
    lower = jnp.linalg.cholesky(jacobian @ jacobian.T + posed.data.covariance)
    gain = jax.scipy.linalg.cho_solve((lower, True), jacobian).T
    if inversion.num_coefficients <= len(residual):
        shapes = jnp.eye(inversion.num_coefficients)
        carry = persistence * (shapes - gain @ jacobian)
    else:  # never with a memory, whose shapes are no more than the data
        shapes, gain = gain.T, jnp.eye(len(residual))
        carry = jnp.zeros_like(gain)
    matrix = jax.vmap(inversion.basis.expand)(shapes).T * inversion.link.slope(inversion.reference)[:, None]
    level = inversion.link.conductivity(inversion.reference) - matrix @ (gain @ residual)
    return LinearMap(matrix, gain @ (weighing.weight[:, None] * weighing.estimator), level, carry)


@jax.jit
def _estimate(imager: Imager, frame, weighing: Weighing, start) -> FrameEstimate:
    data = weighing.combine(frame + imager.offset)
    inversion = eqx.tree_at(lambda i: i.data, imager.inversion, data)
    expected = jnp.zeros_like(start)
    if imager.persistence > 0:  # the prior's centre moves, and the coefficients count from there
        expected, start = start, expected
        inversion = eqx.tree_at(lambda i: i.reference, inversion, inversion.estimate(expected))
    descent = imager.solver.descent(FRAME_STEPS, _RTOL)
    solution = optx.least_squares(
        residual, descent, start, inversion, options={"expand": expand}, max_steps=imager.steps, throw=False
    )
    # The last step leads to a point not looked at yet. It takes voltages, but no Jacobian, to see if it is better.
    state = solution.state
    cost = inversion.cost(state.trial)
    better = cost < state.cost
    coefficients = jnp.where(better, state.trial, solution.value)
    penalty, least = inversion.penalty.cost(coefficients), jnp.where(better, cost, state.cost)
    squares = 2 * (least - penalty) + data.rest
    return FrameEstimate(
        conductivity=inversion.conductivity(coefficients),
        coefficients=expected + coefficients,
        misfit=jnp.sqrt(squares / jnp.sum(weighing.noise <= jnp.max(imager.noise))),
        iterations=state.num_accepted - 1 + better,
        converged=state.converged | (least <= descent.atol),  # no step can lower it by more than there is
    )
