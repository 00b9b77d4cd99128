"""Calibration: the background conductivity and contact impedance that explain a frame of the empty tank."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jeit.arguments import check_name
from jeit.forward import ForwardModel
from jeit.forward.model import check_model
from jeit_solvers import Status, ended

_REASONS = {
    Status.STEP_LIMIT: "Stopped after {} steps.",
    Status.STALLED: "No step made the model fit better.",
    Status.FAILED: "The fit became NaN.",
}


# A relative misfit that measured tanks of known geometry do not reach: 1 % of KIT4's, 8 % of the Kuopio challenge's.
_MUCH = 0.12


class Calibration(eqx.Module):
    """A forward model fitted to a reference frame.

    **Fields**: `model`, with its electrodes' contact impedance fitted; `conductivity`, the uniform background
    (S/m; 2-D: S); `voltages` (M,), what the model predicts; `misfit`, ‖predicted - measured‖ / ‖measured‖ over the
    channels used; `iterations`; `status`, how the fit ended, and `reason`, in a sentence, empty where all is well.
    """

    model: ForwardModel
    conductivity: Float[Array, ""]
    voltages: Float[Array, " M"]
    misfit: Float[Array, ""]
    iterations: int = eqx.field(static=True)
    status: Status = eqx.field(static=True)
    reason: str = eqx.field(static=True, default="")

    @property
    def note(self) -> str:
        """What a large misfit means, in a sentence; empty where it is not large."""
        if not self.misfit > _MUCH:
            return ""
        return (
            f"the model misses {100 * float(self.misfit):.0f} % of the reference: radius, width of the electrodes, "
            "protocol or gain may be others than described, or the body deeper than a sheet. What is missed alike in "
            "both frames does little to where a change is seen; but do not trust its size, nor the background's."
        )


def calibrate(
    model: ForwardModel,
    voltages: Float[Array, " M"],
    *,
    mask: Bool[Array, " M"] | None = None,
    contact: str = "common",
    max_steps: int = 100,
) -> Calibration:
    """Fit background conductivity and contact impedance to a reference frame, by Levenberg-Marquardt.

    `voltages` (M,) volts of the empty tank. `mask`: True for the channels to use. `contact`: "common", one impedance
    for all electrodes; "each", one per electrode; "fixed", the model's own. The parameters are logarithms, so both
    stay positive; the start is the model's impedance with the conductivity that scales the prediction best (voltages
    are proportional to 1/σ at fixed z·σ). Raises `ValueError` for a frame of another shape or without signal.
    """
    check_model(model)
    if jnp.iscomplexobj(voltages):
        raise ValueError("voltages are complex; calibrate on their real part or magnitude.")
    measured = jnp.asarray(voltages, float)
    shape = (model.protocol.num_measurements,)
    used = jnp.ones(shape, bool) if mask is None else jnp.asarray(mask, bool)
    if measured.shape != shape or used.shape != shape:
        raise ValueError(
            f"voltages has shape {measured.shape} and mask {used.shape}; protocol '{model.protocol.name}' has {shape}."
        )
    check_name("contact", contact, ("common", "each", "fixed"))
    measured = jnp.where(used, measured, 0)
    size = jnp.linalg.norm(measured)
    if not np.isfinite(size) or size == 0:
        raise ValueError("voltages: the reference frame has no finite, non-zero values to calibrate on.")
    return _fit(model, measured, used, contact, max_steps)


def _fit(model: ForwardModel, measured, used, contact: str, max_steps: int) -> Calibration:
    num_electrodes = model.electrodes.num_electrodes
    if model.electrodes.is_point:
        contact = "fixed"
    size = jnp.linalg.norm(measured)
    # Start at the model's own contact impedance for a conductivity of one, scaled to fit.
    shape = {"fixed": (0,), "common": (), "each": (num_electrodes,)}[contact]
    unit = jnp.where(used, model.voltages(1.0), 0)
    if not unit @ measured > 0:
        raise ValueError(
            "voltages: they have the opposite sign of the model's. Is the polarity of drive or measurement turned "
            "round, or the order of the channels another than the protocol's?"
        )
    conductivity = jnp.log(jnp.abs(unit @ unit / (unit @ measured)))
    initial = {"conductivity": conductivity, "contact": jnp.zeros(shape) + conductivity}
    solver = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-8)
    arguments = (model, measured, used, size)
    solution = optx.least_squares(_residual, solver, initial, arguments, max_steps=max_steps, throw=False)
    fitted, conductivity = _fitted(model, solution.value)
    voltages = fitted.voltages(conductivity)
    misfit = jnp.linalg.norm(jnp.where(used, voltages - measured, 0)) / size
    status = ended(solution.result) if np.isfinite(misfit) else Status.FAILED
    reason = "" if status == Status.CONVERGED else _REASONS[status].format(max_steps)
    return Calibration(fitted, conductivity, voltages, misfit, int(solution.stats["num_steps"]), status, reason)


def _fitted(model: ForwardModel, parameters) -> tuple[ForwardModel, Float[Array, ""]]:
    """The model and conductivity that the parameters (logarithms of σ and of z·σ over the model's z) stand for."""
    conductivity = jnp.exp(parameters["conductivity"])
    if parameters["contact"].shape == (0,):
        return model, conductivity
    # Voltages at fixed z·σ are proportional to 1/σ, so these two are nearly independent of each other.
    factor = jnp.exp(parameters["contact"] - parameters["conductivity"])
    electrodes = model.electrodes
    impedance = electrodes.contact_impedance * factor
    return model.with_electrodes(electrodes.with_contact_impedance(impedance)), conductivity


def _residual(parameters, arguments):
    """A function of its arguments alone, so that it is compiled once for all models of one shape."""
    model, measured, used, size = arguments
    fitted, conductivity = _fitted(model, parameters)
    return jnp.where(used, fitted.voltages(conductivity) - measured, 0) / size
