"""Electrode positions and contact impedances estimated from a reference frame.

Electrodes are rarely exactly where a description says, and their contacts differ. A frame of the homogeneous body shows
by how much: with shifts t of the electrodes along the ways in which they can move, contact impedances z = z₀ e^ζ and a
conductivity σ, the estimate minimises

    ½ ‖(v(σ, t, z) - y) / κn‖² + ½ ‖t / s‖² + ½ ζᵀ Γ⁻¹ ζ,

n being the `relative_noise` of the channels, s the standard deviation of the positions before the data, and Γ the
covariance of the logarithms of the contact impedances, which have a common part. κ is estimated from the residual.
Derivatives need no further solve: at fixed fields only the energy of electrode l depends on t_l
(`jeit.forward.changes`).

Kolehmainen, Vauhkonen, Karjalainen and Kaipio, Physiological Measurement 18 (1997) 289, errors of electrode positions;
Vilhunen, Kaipio, Vauhkonen, Savolainen and Vauhkonen, Measurement Science and Technology 13 (2002) 1848, contact
impedances; Darde, Hyvönen, Seppänen and Staboulis, SIAM Journal on Imaging Sciences 6 (2013) 176, both at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float

from jeit.arguments import check_has_values, describe, is_number
from jeit.electrodes.electrodes import AbstractMovableElectrodes
from jeit.forward import ForwardModel
from jeit.forward.changes import PlacementSensitivity, shift_electrodes
from jeit.forward.model import select_channels
from jeit.inverse.channels import IndependentChannels, relative_noise
from jeit.inverse.nonlinear.problem import check_frame
from jeit_solvers import Descent, QuadraticModel, ridge_model
from jeit_solvers.engines import as_array, on_host

# Standard deviations of the logarithms of contact impedances: of each electrode's own part, and of the common one. And
# of the logarithm of the conductivity, about that which fits the described model best.
_OWN_CONTACT_DEVIATION, _COMMON_CONTACT_DEVIATION, _CONDUCTIVITY_DEVIATION = 1.0, 4.0, 2.0
# Steps of the two fits, before and after κ is estimated, in sheets and in solids, where each takes a second; the
# tolerance of their cost.
_MAX_STEPS, _RTOL = {2: (40, 40), 3: (5, 3)}, {2: 1e-4, 3: 3e-3}
# κ in units of `relative_noise`: 0.1 % of a voltage at least.
_MIN_NOISE = 0.1


@dataclass(frozen=True)
class Uncertainty:
    """How accurately a sensor is described, as standard deviations. All but the first are shares: 0.1 is 10 %.

    **Fields**: `position`: of electrode positions, metres, in every direction in which they can move; default: 0.0175
    of the width of the body, 2° of a disk. `drift`: of the logarithm of each contact impedance, from the reference to
    the frame. `size`: of the lengths of the body, relative. `other`: of whatever else differs from the model, as a
    share of the difference of the two frames; the misfit of the reference, if that is larger. Raises `ValueError` for
    values that are negative or not finite, and for sizes and others above 1.

    **Example:**

    ```python
    doubts = Uncertainty(position=1e-3, drift=0.05)
    ```
    """

    position: float | None = None
    drift: float = 0.1
    size: float = 0.01
    other: float = 0.02

    def __post_init__(self):
        for name, most in (("position", np.inf), ("drift", np.inf), ("size", 1.0), ("other", 1.0)):
            value: Any = getattr(self, name)
            known = is_number(value) and np.isfinite(value) and 0 <= float(value) <= most
            if not (known or (value is None and name == "position")):
                wanted = "metres, 0 or more" if name == "position" else "a share, not per cent"
                wanted += " from 0 to 1" if most == 1 else ""
                raise ValueError(f"{name} must be a number, {wanted}; it is {describe(value)}.")


class Placement(NamedTuple):
    """Estimated positions of electrodes, the result of `place_electrodes`.

    **Fields**: `model`: the model with the estimated electrodes; `conductivity`: estimated background, S/m (2-D: S);
    `shift` (L, a): displacements along the a directions in which each electrode can move, metres; `deviation` (L, a):
    their posterior standard deviations, metres; `error`: the `ModelError` that remains.

    **Example:**

    ```python
    placed = place_electrodes(model, reference, deviation=1e-3)
    placed.shift, placed.deviation
    ```
    """

    model: ForwardModel
    conductivity: float
    shift: Float[np.ndarray, "L a"]
    deviation: Float[np.ndarray, "L a"]
    error: "ModelError"


class ModelError(NamedTuple):
    """Error of the model, and so of a difference of two frames, because electrode positions and contact impedances are
    known only as well as the reference frame determines them.

    **Fields**: `factor` (p, p): F with the posterior covariance F Fᵀ of the shifts, metres, and of the logarithms of
    the contact impedances; `drift`: standard deviation of the logarithm of each contact impedance, from the reference
    to the frame.

    Kaipio and Somersalo, Journal of Computational and Applied Mathematics 198 (2007) 493.

    **Example:**

    ```python
    error = place_electrodes(model, reference, deviation=1e-3).error
    error.factor.shape
    ```
    """

    factor: Float[np.ndarray, "p p"]
    drift: float = Uncertainty().drift

    def voltages(self, model: ForwardModel, conductivity: ArrayLike, background: ArrayLike) -> Float[np.ndarray, "M q"]:
        """Errors (M, q) of the difference v(`conductivity`) - v(`background`), volts, for unit coefficients.

        `conductivity` and `background` per cell, S/m (2-D: S). The covariance of the difference is the product of the
        errors with their transpose.
        """
        electrodes: Any = model.electrodes
        sensitivity, protocol = PlacementSensitivity(model.mesh, electrodes), on_host(model.protocol)

        def channels(impedances):
            return np.stack([np.asarray(select_channels(protocol, one)) for one in impedances], axis=1)

        there, here = (sensitivity(*map(np.asarray, model.fields(one))) for one in (conductivity, background))
        drifted = self.drift * channels(there[-electrodes.num_electrodes :])
        return np.concatenate([channels(there - here) @ self.factor, drifted], axis=1)


class _LinearisedModel(NamedTuple):
    """Model at a trial point, with its conductivity, fields F, impedance Z and predicted voltages (M,)."""

    model: ForwardModel
    conductivity: float
    fields: Float[np.ndarray, "n L"]
    impedance: Float[np.ndarray, "L L"]
    voltages: Float[np.ndarray, " M"]


def place_electrodes(
    model: ForwardModel,
    voltages: Float[ArrayLike, " M"],
    *,
    deviation: float,
    mask: Bool[ArrayLike, " M"] | None = None,
) -> Placement:
    """Estimate where the electrodes of a model are, and their contact impedances, from a frame of the homogeneous body.

    **Arguments:**

    - `model`: the model with the electrodes as they are described.
    - `voltages` (M,): of the homogeneous body, volts.
    - `deviation`: standard deviation of the described positions, metres, in every direction in which an electrode can
      move; 0 if they are exact.
    - `mask` (M,): True for the channels to use.

    Raises `ValueError` for electrodes that cannot move, invalid arguments, voltages that have the opposite sign of the
    model's, and where nothing is found that explains them.

    **Example:**

    ```python
    placed = place_electrodes(model, reference, deviation=1e-3)
    ```
    """
    measured, used = check_frame(model, voltages, mask)
    check_has_values("place_electrodes", (model, measured), "the fit takes steps of NumPy", "take calibrate")
    width = float(np.ptp(np.asarray(model.mesh.points), axis=0).max())
    if not (is_number(deviation) and 0 <= deviation < width):
        raise ValueError(
            f"deviation must be a number of metres, less than the width of the body, {width:.3g} m; it is "
            f"{describe(deviation)}."
        )
    if not isinstance(model.electrodes, AbstractMovableElectrodes):
        raise ValueError(f"electrodes: {type(model.electrodes).__name__} have no position that can be estimated.")
    problem = _PlacementProblem(model, np.asarray(measured), used, deviation)
    size, scale = len(problem.spread), 1.0
    found: Any = np.zeros(size)
    here, covariance = None, np.eye(size)
    for steps in _MAX_STEPS[model.mesh.dimension]:
        descent = Descent(rtol=_RTOL[model.mesh.dimension], damping=1e-2, history=steps + 1)
        found, _ = descent.at_once(problem.expand, found, scale, steps)
        here = problem.at(found)
        if here is None or not np.isfinite(here.voltages).all():
            raise ValueError("voltages: no electrode positions were found that explain them.")
        scale, covariance = problem.noise_and_covariance(here, scale)
    assert here is not None
    factor, shape = problem.factor(covariance), problem.directions.shape[:2]
    number = shape[0] * shape[1]
    shift = (problem.spread @ found)[1 : 1 + number].reshape(shape)
    left = np.linalg.norm(factor[:number], axis=1).reshape(shape)
    return Placement(here.model, here.conductivity, shift, left, ModelError(factor))


class _PlacementProblem:
    """Voltages and their derivatives by coefficients of unit variance: those of log σ, of the shifts, and of log zσ."""

    def __init__(self, model: ForwardModel, measured: np.ndarray, used: np.ndarray, deviation: float):
        self.given, self.mesh, self.protocol = model, on_host(model.mesh), on_host(model.protocol)
        self.used = used
        self.measured = measured
        self.independent = len(IndependentChannels.create(self.protocol).index)
        self.noise = np.asarray(relative_noise(as_array(measured), as_array(self.used)))
        electrodes: Any = model.electrodes
        self.directions = np.asarray(electrodes.directions(self.mesh))
        number, ways = self.directions.shape[:2]
        unit = np.asarray(model.voltages(1.0))[self.used]
        if not unit @ measured[self.used] > 0:
            raise ValueError("voltages: they have the opposite sign of the model's.")
        self.first = float(np.log(unit @ unit / (unit @ measured[self.used])))
        contact = _OWN_CONTACT_DEVIATION**2 * np.eye(number) + _COMMON_CONTACT_DEVIATION**2
        self.spread = np.zeros((1 + number * (ways + 1),) * 2)
        self.spread[0, 0] = _CONDUCTIVITY_DEVIATION
        middle = np.arange(1, 1 + number * ways)
        self.spread[middle, middle] = deviation
        self.spread[1 + number * ways :, 1 + number * ways :] = np.linalg.cholesky(contact)

    def at(self, coefficients: Float[np.ndarray, " p"]) -> _LinearisedModel | None:
        """The model at some coefficients; None where electrodes would overlap or leave the body."""
        number, ways = self.directions.shape[:2]
        values = self.spread @ coefficients
        shift, contact = values[1 : 1 + number * ways].reshape(number, ways), values[1 + number * ways :]
        log_conductivity = self.first + values[0]
        given: Any = self.given.electrodes
        electrodes: Any = shift_electrodes(given, self.directions, shift)
        impedance = np.asarray(given.contact_impedance) * np.exp(contact - values[0])
        try:
            model = self.given.with_electrodes(electrodes.with_contact_impedance(impedance))
        except ValueError:
            return None
        conductivity = float(np.exp(log_conductivity))
        fields, transfer = on_host(model.fields(conductivity))
        predicted = np.asarray(select_channels(self.protocol, transfer))
        return _LinearisedModel(model, conductivity, fields, transfer, predicted)

    def expand(self, coefficients, scale: float) -> QuadraticModel:
        """Cost, and a step of Levenberg-Marquardt, at a `scale` κ of the noise."""
        here = self.at(coefficients)
        if here is None:
            return np.inf, lambda damping: None  # pyright: ignore
        residual = self._residual(here) / scale
        cost = 0.5 * (residual @ residual + coefficients @ coefficients)
        same: Any = np.eye(len(residual))

        def step(damping):
            rows = self._jacobian(here) / scale
            return ridge_model(residual, rows, coefficients, same, same)[1](damping)  # pyright: ignore

        return cost, step

    def noise_and_covariance(self, point: _LinearisedModel, scale: float) -> tuple[float, Float[np.ndarray, "p p"]]:
        """κ estimated from the residual of a fit at `scale`, and the posterior covariance of the coefficients with it.

        Dependent channels count once: the residual has as many degrees of freedom as independent channels, less those
        that the fit has used.
        """
        residual, rows = self._residual(point), self._jacobian(point)
        independent = min(self.independent, len(residual))
        share = independent / len(residual)
        # With eigenvalues, the covariance stays definite where the Hessian's inverse loses its sign to rounding.
        values, axes = np.linalg.eigh(rows.T @ rows)
        values = np.maximum(values, 0)
        fitted = np.sum(values / (values + scale**2))
        freedom = max(independent - fitted, 0.3 * independent)
        scale = max(_MIN_NOISE, float(np.sqrt(share * (residual @ residual) / freedom)))
        return scale, (axes / (1 + values / scale**2)) @ axes.T

    def factor(self, covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "q q"]:
        """Factor of the covariance of shifts, metres, and of log z, from that of the coefficients."""
        of_values = self.spread.copy()
        of_values[1 + self.directions.shape[0] * self.directions.shape[1] :] -= self.spread[0]  # log z = log zσ - log σ
        of_values = of_values[1:]
        values, axes = np.linalg.eigh(of_values @ covariance @ of_values.T)
        return axes * np.sqrt(np.maximum(values, 0))

    def _residual(self, point: _LinearisedModel) -> Float[np.ndarray, " u"]:
        return ((point.voltages - self.measured) / self.noise)[self.used]

    def _jacobian(self, point: _LinearisedModel) -> Float[np.ndarray, "u p"]:
        """Derivatives of the weighted voltages by the coefficients."""
        electrodes: Any = point.model.electrodes
        by_placement = PlacementSensitivity(self.mesh, electrodes)(point.fields, point.impedance)
        every = np.concatenate([-point.impedance[None], by_placement])  # the first by log σ at fixed zσ
        rows = np.stack([np.asarray(select_channels(self.protocol, one)) for one in every], axis=1)
        return (rows / self.noise[:, None])[self.used] @ self.spread
