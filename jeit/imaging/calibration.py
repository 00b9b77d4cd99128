"""Creation of the mesh of a body, and calibration of a forward model on a frame of the undisturbed body, with timing of
the steps. The result of the last calibration is stored and reused for the next frame."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import replace
from typing import ParamSpec, TypeVar

import jax
import numpy as np

from jeit.data import Measurement
from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.electrodes import AbstractMovableElectrodes
from jeit.electrodes.face_patches import body_mesh
from jeit.forward import ForwardModel
from jeit.inverse import calibrate, relative_noise
from jeit.inverse.calibration import Calibration
from jeit.inverse.placement import Placement, Uncertainty, place_electrodes
from jeit.mesh import Body, Mesh, OwnMesh, Solid
from jeit.protocol import Protocol
from jeit_solvers import one_thread_of_blas
from jeit_solvers.engines import as_array

# Default number of mesh nodes for a solid and for a sheet.
DEFAULT_SOLID_NUM_POINTS, DEFAULT_SHEET_NUM_POINTS = 10_000, 2000
# Misfit of the model to the reference frame up to which the described electrode positions are used. If the misfit is
# larger, estimated positions are used, provided that they reduce the misfit: the ratio of the misfit with estimated to
# the misfit with described positions must be below a limit both for channels divided by their noise and for equally
# weighted channels.
_MAX_MISFIT_OF_DESCRIBED_POSITIONS, _MAX_WEIGHTED_MISFIT_RATIO, _MAX_UNWEIGHTED_MISFIT_RATIO = 0.01, 0.7, 2.0


_FunctionArguments = ParamSpec("_FunctionArguments")
_FunctionResult = TypeVar("_FunctionResult")


def keep_last_result(
    function: Callable[_FunctionArguments, _FunctionResult],
) -> Callable[_FunctionArguments, _FunctionResult]:
    """Decorator: store the result of the last call of a function, and return it for equal arguments.

    Mesh and calibration are thus computed once per reference if several frames are imaged in succession. Arguments are
    compared by value. NumPy arrays are copied, because the caller may modify them.
    """
    last_call: tuple | None = None

    @functools.wraps(function)
    def call_or_reuse(*args: _FunctionArguments.args, **kwargs: _FunctionArguments.kwargs) -> _FunctionResult:
        nonlocal last_call
        argument_leaves, argument_structure = jax.tree.flatten((args, kwargs))
        stored_call = last_call
        if (
            stored_call is None
            or stored_call[1] != argument_structure
            or not all(map(_are_equal_arguments, stored_call[0], argument_leaves))
        ):
            copied_leaves = [
                argument_leaf.copy() if isinstance(argument_leaf, np.ndarray) else argument_leaf
                for argument_leaf in argument_leaves
            ]
            last_call = stored_call = copied_leaves, argument_structure, function(*args, **kwargs)
        return stored_call[2]

    return call_or_reuse


def _are_equal_arguments(first_argument, second_argument) -> bool:
    """Whether two leaves of arguments are the same object, or arrays or numbers of equal types and values."""
    if first_argument is second_argument:
        return True
    have_same_type = type(first_argument) is type(second_argument) and getattr(
        first_argument, "dtype", None
    ) == getattr(second_argument, "dtype", None)
    # Masked voltages may be NaN.
    return have_same_type and np.array_equal(
        first_argument, second_argument, equal_nan=np.asarray(first_argument).dtype.kind in "fc"
    )


class StepTimer:
    """Timer of steps: reports the start of each step to `progress`, and stores its duration in `seconds`."""

    def __init__(self, progress: Callable[[str], None] | None):
        self.progress = progress
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, step: str):
        if self.progress is not None:
            self.progress(step)
        start_time = time.perf_counter()
        yield
        self.seconds[step] = time.perf_counter() - start_time


def imaging_mesh(
    domain: Body, electrodes: AbstractElectrodes, num_points: int | None, *, usual: int | None = None
) -> Mesh:
    """Mesh of a body, finer near the electrodes, where fields are steep.

    **Arguments:**

    - `domain`: the body.
    - `electrodes`: the electrodes.
    - `num_points`: number of nodes, approximately; None: `usual`, or, without it, 2,000 for a sheet and 10,000 for a
      solid.
    - `usual`: default of `num_points`.

    Raises `ValueError` if `num_points` is given for a body that has its own mesh.

    **Example:**

    ```python
    mesh = imaging_mesh(pressed.domain, pressed.electrodes, 300)
    ```
    """
    if num_points is None and not isinstance(domain, OwnMesh):
        num_points = usual or (DEFAULT_SOLID_NUM_POINTS if isinstance(domain, Solid) else DEFAULT_SHEET_NUM_POINTS)
    return body_mesh(domain, electrodes, num_points)


@keep_last_result
def described_model(
    domain: Body, electrodes: AbstractElectrodes, protocol: Protocol, num_points: int | None
) -> ForwardModel:
    """Forward model of the body as it is described."""
    return ForwardModel(imaging_mesh(domain, electrodes, num_points), electrodes, protocol)


def calibrated_model(
    model: ForwardModel, base: Measurement, *, contact: str | None = None, clock: StepTimer | None = None
) -> tuple[Calibration, str]:
    """Calibrate the forward model on a frame of the undisturbed body; return the `Calibration`, and the kind of
    calibration of the contact impedance.

    **Arguments:**

    - `model`: the forward model.
    - `base`: a frame of the undisturbed body.
    - `contact`: "each", "common" or "fixed"; default: `default_contact`, or "common" if the data do not determine the
      contact impedance of each electrode.
    - `clock`: timer that measures the duration of each step.

    Raises `ValueError` if the calibration fails.

    **Example:**

    ```python
    fit, contact = calibrated_model(skin.model(), rest)
    fit.conductivity, fit.misfit
    ```
    """
    clock = StepTimer(None) if clock is None else clock
    with clock("calibrate"), one_thread_of_blas():
        return _calibrate_on_reference(model, base, contact)


@keep_last_result
def _calibrate_on_reference(
    model: ForwardModel, reference: Measurement, requested_contact: str | None
) -> tuple[Calibration, str]:
    """Calibrate the forward model, see `calibrated_model`."""
    contact_method = requested_contact or default_contact(reference)
    reference_voltages, channel_mask = np.asarray(reference.voltages)[0], np.asarray(reference.mask)[0]
    calibration = calibrate(model, reference_voltages, mask=channel_mask, contact=contact_method)
    if requested_contact is None and contact_method == "each" and not calibration.distinguishes_contacts:
        contact_method = "common"  # the data do not determine one impedance per electrode
        calibration = calibrate(model, reference_voltages, mask=channel_mask, contact=contact_method)
    position_deviation = (reference.uncertainty or Uncertainty()).position_on(model.mesh)
    calibration = _with_estimated_positions(calibration, model, reference_voltages, channel_mask, position_deviation)
    calibration = jax.block_until_ready(calibration)
    if not np.isfinite(calibration.misfit):
        raise ValueError(
            f"'{reference.name}': calibration on it failed ({calibration.reason}); is this a frame of the empty body, "
            "and are geometry and protocol right?"
        )
    return calibration, contact_method


def _with_estimated_positions(
    calibration: Calibration, model: ForwardModel, reference_voltages, channel_mask, position_deviation: float
) -> Calibration:
    """The calibration with estimated electrode positions, if these positions explain the reference frame far better.

    The described positions are used if they explain the reference, or if the misfit has other causes: for example,
    estimated positions explain little of the misfit of a two-dimensional model of a deep tank. The background is
    estimated together with the positions, from channels weighted by their relative noise. If the background were fitted
    mainly to the largest voltages, those at the driven electrodes, the background would follow the errors of a
    two-dimensional model at these electrodes.
    """
    described_misfit = relative_misfit(calibration.voltages, reference_voltages, channel_mask)
    if (
        not described_misfit > _MAX_MISFIT_OF_DESCRIBED_POSITIONS
        or (placement := estimated_positions(model, reference_voltages, channel_mask, position_deviation)) is None
    ):
        return calibration
    predicted_voltages = np.asarray(placement.model.voltages(placement.conductivity))
    estimated_misfit = float(
        np.linalg.norm((predicted_voltages - reference_voltages)[channel_mask])
        / np.linalg.norm(reference_voltages[channel_mask])
    )
    is_weighted_misfit_better = (
        relative_misfit(predicted_voltages, reference_voltages, channel_mask)
        < _MAX_WEIGHTED_MISFIT_RATIO * described_misfit
    )
    if not (is_weighted_misfit_better and estimated_misfit < _MAX_UNWEIGHTED_MISFIT_RATIO * float(calibration.misfit)):
        return replace(calibration, model_error=placement.error)
    return replace(
        calibration,
        model=placement.model,
        conductivity=as_array(placement.conductivity),
        voltages=as_array(predicted_voltages),
        misfit=as_array(estimated_misfit),
        contact_deviation=as_array(np.linalg.norm(placement.error.factor, axis=1)[placement.shift.size :]),
        shift=as_array(placement.shift),
        model_error=placement.error,
    )


def relative_misfit(predicted_voltages, measured, mask) -> float:
    """Norm of the errors of predicted voltages (M,), as a share of the norm of the measured voltages, with each channel
    divided by its expected noise."""
    channel_noise = np.asarray(relative_noise(measured, mask))[mask]
    voltage_errors = (np.asarray(predicted_voltages) - measured)[mask]
    return float(np.linalg.norm(voltage_errors / channel_noise) / np.linalg.norm(measured[mask] / channel_noise))


@keep_last_result
def estimated_positions(model: ForwardModel, voltages, mask, deviation: float) -> Placement | None:
    """Estimate electrode positions from a reference frame; None if the positions cannot be estimated. `deviation`:
    standard deviation of the described positions, metres."""
    if not isinstance(model.electrodes, AbstractMovableElectrodes) or np.iscomplexobj(voltages):
        return None
    try:
        return place_electrodes(model, voltages, deviation=deviation, mask=mask)
    except ValueError:
        return None


def default_contact(measurement: Measurement) -> str:
    """Default calibration of contact impedances: "each" if voltages are measured on driven electrodes, else "fixed".

    Voltage drops only across the contacts of electrodes that carry current. Without channels on these electrodes, the
    fit would distort contact impedances to explain other effects.
    """
    return "each" if measurement.protocol.channels_on_driven_electrodes().any() else "fixed"
