"""The nonlinear problem, checks of its arguments, and implicit derivatives of its solution.

Informed shapes are the combinations of a prior's shapes, some dozens, that the data resolve; they replace the full set.

They are the right singular vectors of the whitened Jacobian at the background, kept in single precision, which alters
an image by a millionth.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jeit.arguments import describe
from jeit.forward import ForwardModel
from jeit.forward.model import (
    channel_voltages,
    check_model,
    evaluate,
    fields_and_impedance_of,
    jacobian_blocks,
    voltages_and_jacobian_of,
    voltages_of,
)
from jeit.inverse.channels import Data, IndependentChannels, relative_noise
from jeit.inverse.linearisation import check_mask
from jeit.inverse.nonlinear.parametrisation import AbstractLink, AbstractUnknown
from jeit.inverse.prior.bases import AbstractBasis, DenseBasis
from jeit.inverse.prior.penalties import AbstractPenalty
from jeit_solvers import QuadraticModel, symmetric_eigen
from jeit_solvers.engines import either_engine, has_values, host, namespace, on_device, on_host


def check_frame(model: ForwardModel, voltages, mask) -> tuple[Float[Array, " M"], np.ndarray]:
    """Voltages as an array with zeros for what is left out, and which channels are used; raises `ValueError`.

    Values of tracers are not checked.
    """
    check_model(model)
    check_mask(mask)
    voltages = _array(voltages)
    if voltages.dtype.kind == "c":
        raise ValueError("voltages are complex; reconstruct from their real part or magnitude.")
    if voltages.dtype.kind not in "biuf":
        raise ValueError(f"voltages are {voltages.dtype}; give real numbers, in volts.")
    shape = (model.protocol.num_measurements,)
    measured = voltages.astype(float)
    used = np.ones(shape, bool) if mask is None else np.asarray(mask)
    if measured.shape != shape or used.shape != shape or used.dtype != bool:
        raise ValueError(
            f"voltages has shape {measured.shape} and mask {used.shape} of {used.dtype}; protocol "
            f"'{model.protocol.name}' has {shape[0]} channels, and the mask must be booleans."
        )
    if not used.any():
        raise ValueError("mask: every channel is left out, so there is nothing to reconstruct from.")
    if not has_values(measured):
        return jnp.where(used, measured, 0), used
    values = np.asarray(measured)[used]
    if not np.isfinite(values).all():
        raise ValueError(
            f"voltages: NaN or infinite in {(~np.isfinite(values)).sum()} of the channels in use; mask them."
        )
    if not values.any():
        raise ValueError("voltages: all channels in use read zero; was the current source on?")
    return host.where(used, measured, 0), used


def check_background(model: ForwardModel, background) -> Float[Array, " m"]:
    """The background per cell; raises `ValueError` for what is not one positive number or one for each cell."""
    background = _array(background)
    if background.dtype.kind not in "biuf" or background.shape not in ((), (model.mesh.num_cells,)):
        raise ValueError(
            f"background must be one real conductivity, or one for each of the {model.mesh.num_cells} cells; it is "
            f"{background.dtype} of shape {background.shape}."
        )
    values = np.asarray(background) if has_values(background) else np.ones(())
    if (wrong := values[~((values > 0) & np.isfinite(values))]).size:
        raise ValueError(
            f"background must be positive and finite everywhere, S/m (2-D: S); {describe(wrong[0])} is not."
        )
    return namespace(background).broadcast_to(background.astype(float), (model.mesh.num_cells,))


def check_noise(noise, measured: Float[Array, " M"], used: np.ndarray) -> Float[Array, " M"]:
    """Standard deviation of every channel, volts (1 where left out); raises `ValueError`."""
    given = np.zeros(()) if noise is None else _array(noise)
    if given.shape not in ((), measured.shape) or given.dtype.kind not in "iuf":
        raise ValueError(
            f"noise is {given.dtype} of shape {given.shape}; give one real number, or one for each channel."
        )
    xp = namespace(given, measured)
    deviation = relative_noise(measured, xp.asarray(used)) if noise is None else xp.broadcast_to(given, measured.shape)
    if has_values(deviation) and not (np.isfinite(deviation)[used] & (np.asarray(deviation)[used] > 0)).all():
        raise ValueError("noise must be positive and finite for every channel in use.")
    return xp.where(used, deviation, 1)


def _array(values):
    """A NumPy copy of an array that has values."""
    return host.array(values) if has_values(values) else jnp.asarray(values)


def check_steps(name: str, steps) -> int:
    """A whole number from 1. Raises `ValueError` otherwise."""
    if isinstance(steps, bool) or not isinstance(steps, (int, np.integer)) or steps < 1:
        raise ValueError(f"{name} must be a whole number from 1; it is {steps!r}.")
    return int(steps)


def check_tolerance(name: str, tolerance) -> float:
    """A number from 0 up to, but not including, 1. Raises `ValueError` otherwise."""
    if not isinstance(tolerance, (int, float, np.number)) or not 0 <= tolerance < 1:
        raise ValueError(f"{name} must be a number from 0 and less than 1; it is {tolerance!r}.")
    return float(tolerance)


def independent_data(
    model: ForwardModel,
    measured: Float[Array, " M"],
    used: Bool[np.ndarray, " M"],
    deviation: Float[Array, " M"],
    *,
    at_once: bool,
) -> tuple[ForwardModel, Data]:
    """The model of the independent channels among those used, and their voltages.

    `deviation` (M,) of the noise, volts. `at_once`: in NumPy, if the model works that way.
    """
    kept = np.flatnonzero(used)
    observed = model if used.all() else model.with_protocol(model.protocol.subset(kept))
    channels = IndependentChannels.create(observed.protocol)
    small = observed
    if has_values(observed.protocol):
        small = observed.with_protocol(observed.protocol.subset(np.asarray(channels.index)))
    # For a solid body compiled programs would hold the Jacobian several times over.
    if at_once and (model.at_once or model.mesh.dimension == 3) and has_values(small):
        small, channels = on_host((small, channels))  # and so is everything computed from them
    return small, channels.weigh(deviation[kept]).combine(measured[kept])


def informed(inversion: Inversion, least: float, persistence: float = 0.0) -> Inversion:
    """The problem reduced to the shapes whose signal exceeds `least`, in standard deviations of the noise for one of
    the prior. The shapes' variances are those expected before a frame when the share `persistence` of the last image
    persists.

    The rest of the image stays at the reference. For penalties that are standard normal.
    """
    squares, rows = (np.asarray(values) for values in _singular_values(inversion))
    kept = squares > max(least**2, 1e-12 * squares[-1])
    size = np.sqrt(_expected_variance(squares[kept], persistence) / squares[kept])
    shapes = host.asarray(jax.vmap(inversion.basis.expand)(jnp.asarray(size[:, None] * rows[kept])).T, np.float32)
    chosen = eqx.tree_at(lambda i: i.basis, inversion, DenseBasis(shapes))
    return chosen if namespace(inversion) is np else on_device(chosen)


@either_engine
def _singular_values(inversion: Inversion):
    """Singular values, squared, of the image's whitened Jacobian at the background, and its right singular vectors
    times them."""
    xp = namespace(inversion)
    start = xp.zeros(inversion.num_coefficients)
    rows = inversion.data.whiten(inversion.linearise(start)[1])[:, : inversion.basis.num_coefficients]
    squares, left = symmetric_eigen(rows @ rows.T)
    return squares, left.T @ rows


def _expected_variance(strength, persistence: float):
    """Variance of a coefficient before its frame comes, p = a² p / (1 + s p) + 1 - a², for data of `strength` s."""
    fresh = 1 - persistence**2
    half = fresh * (1 - strength) / 2
    root = np.sqrt(half**2 + strength * fresh)
    return np.where(half > 0, fresh / (half + root), (root - half) / strength)


class Inversion(eqx.Module):
    """The c that minimises ½ rᵀ G r + penalty(c), r = w (v(σ) - ŷ), σ = link(x₀ + S c).

    **Fields**: `model` of the independent channels; `data` with ŷ, w and G; `link`; `reference` x₀ (m,), on the link's
    scale; `basis` S, with the hyperparameter in it; `penalty`; `unknowns`, estimated along with the conductivity: their
    values are the last of the coefficients.
    """

    model: ForwardModel
    data: Data
    link: AbstractLink
    reference: Float[Array, " m"]
    basis: AbstractBasis
    penalty: AbstractPenalty
    unknowns: tuple[AbstractUnknown, ...] = ()

    @property
    def runs_at_once(self) -> bool:
        """Whether the problem can be solved in NumPy: all of its values are known and no derivative is needed."""
        in_pieces = self.model.at_once or namespace(self.model) is np
        return in_pieces and not self.unknowns and has_values(self)

    @property
    def num_coefficients(self) -> int:
        """Number of coefficients n, those of the unknowns included."""
        return self.basis.num_coefficients + sum(unknown.size for unknown in self.unknowns)

    def conductivity(self, coefficients: Float[Array, " n"]) -> Float[Array, " m"]:
        """σ per cell, S/m (2-D: S)."""
        return self.link.conductivity(self.estimate(coefficients))

    def estimate(self, coefficients: Float[Array, " n"]) -> Float[Array, " m"]:
        """x per cell, on the link's scale."""
        return self._situation(*self._parts(coefficients))[1]

    def applied(self, model: ForwardModel, coefficients: Float[Array, " n"]) -> ForwardModel:
        """`model` with the estimated contact impedances, positions ... put in."""
        for unknown, values in zip(self.unknowns, self.values(coefficients), strict=True):
            model, _ = unknown.apply(model, self.reference, values)
        return model

    def values(self, coefficients: Float[Array, " n"]) -> tuple[Float[Array, " k"], ...]:
        """The estimated values of every unknown, as `AbstractUnknown.apply` takes them."""
        return self._parts(coefficients)[1]

    def voltages(self, coefficients: Float[Array, " n"]) -> Float[Array, " r"]:
        """Voltages of the independent channels that the model predicts, volts."""
        return self._predict(*self._parts(coefficients))

    def residual(self, coefficients: Float[Array, " n"]) -> Float[Array, " r"]:
        """w (v(σ) - ŷ), with covariance `data.covariance`."""
        return self.data.weight * (self.voltages(coefficients) - self.data.voltages)

    def linearise(self, coefficients: Float[Array, " n"]) -> tuple[Float[Array, " r"], Float[Array, "r n"]]:
        """`residual`, and its Jacobian with respect to the coefficients."""
        shapes, values = self._parts(coefficients)
        model, estimate = self._situation(shapes, values)
        conductivity = self.link.conductivity(estimate)
        if namespace(model, conductivity, self.basis) is np:
            fields, impedance = evaluate(model, fields_and_impedance_of, conductivity)
            voltages, slope = channel_voltages(model.protocol, impedance), self.link.slope(estimate)
            blocks = jacobian_blocks(model.mesh, model.protocol, fields)
            jacobian = self.basis.restrict_blocks((cells, block * slope[cells]) for cells, block in blocks)
        else:
            voltages, jacobian = evaluate(model, voltages_and_jacobian_of, conductivity)
            jacobian = self.basis.restrict(jacobian * self.link.slope(estimate))
        columns = [jacobian]
        if self.unknowns:
            along = jax.jacfwd(lambda values: self._predict(shapes, values))(values)
            columns += [block * unknown.deviation for block, unknown in zip(along, self.unknowns, strict=True)]
        weight, xp = self.data.weight, namespace(voltages, jacobian)
        # A factorisation may go well though some conductivities are below zero; no descent is to end there.
        residual = xp.where((conductivity > 0).all(), weight * (voltages - self.data.voltages), xp.nan)
        jacobian = xp.concatenate(columns, axis=1) if self.unknowns else jacobian
        if xp is np:
            jacobian *= weight[:, None]  # in place: there may be no room for a second
            return residual, jacobian
        return residual, weight[:, None] * jacobian

    def cost(self, coefficients: Float[Array, " n"]) -> Float[Array, ""]:
        """½ rᵀ G r + penalty."""
        residual = self.residual(coefficients)
        return 0.5 * residual @ self.data.precision @ residual + self.penalty.cost(coefficients)

    def quadratic_model(self, coefficients: Float[Array, " n"]) -> QuadraticModel:
        """The cost and its step, for `jeit_solvers.Descent`."""
        residual, jacobian = self.linearise(coefficients)
        return self.penalty.model(residual, jacobian, coefficients, self.data)

    def _parts(self, coefficients):
        """Coefficients of the image, and the values of every unknown."""
        values, start = [], self.basis.num_coefficients
        for unknown in self.unknowns:
            values.append(unknown.deviation * coefficients[start : start + unknown.size])
            start += unknown.size
        return coefficients[: self.basis.num_coefficients], tuple(values)

    def _situation(self, shapes, values) -> tuple[ForwardModel, Float[Array, " m"]]:
        """The model with the unknowns put in, and the estimate x, S c included."""
        model, estimate = self.model, self.reference + self.basis.expand(shapes)
        for unknown, value in zip(self.unknowns, values, strict=True):
            model, estimate = unknown.apply(model, estimate, value)
        return model, estimate

    def _predict(self, shapes, values):
        model, estimate = self._situation(shapes, values)
        return evaluate(model, voltages_of, self.link.conductivity(estimate))
