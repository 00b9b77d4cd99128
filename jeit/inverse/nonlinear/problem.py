"""The nonlinear inverse problem as all solvers see it: coefficients in, misfit, Jacobian and cost out."""

from __future__ import annotations

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jeit.forward import ForwardModel
from jeit.forward.model import (
    channel_voltages,
    evaluate,
    fields_and_impedance_of,
    jacobian_blocks,
    voltages_and_jacobian_of,
    voltages_of,
)
from jeit.inverse.channels import Data
from jeit.inverse.nonlinear.links import AbstractLink
from jeit.inverse.nonlinear.unknowns import AbstractUnknown
from jeit.inverse.prior.bases import AbstractBasis
from jeit.inverse.prior.penalty import AbstractPenalty
from jeit_solvers import QuadraticModel
from jeit_solvers.engines import has_values, namespace


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
        """Whether it can be solved in NumPy, for all of its values are at hand and nothing needs a derivative."""
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
        """What the model predicts for the independent channels, volts."""
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
            jacobian *= weight[:, None]  # where it is: it may be all that there is room for
            return residual, jacobian
        return residual, weight[:, None] * jacobian

    def cost(self, coefficients: Float[Array, " n"]) -> Float[Array, ""]:
        """½ rᵀ G r + penalty."""
        residual = self.residual(coefficients)
        return 0.5 * residual @ self.data.precision @ residual + self.penalty.cost(coefficients)

    def quadratic_model(self, coefficients: Float[Array, " n"]) -> QuadraticModel:
        """Cost and step, for `jeit_solvers.Descent`."""
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
