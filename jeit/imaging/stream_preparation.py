"""Preparation of streams: an imager for a measured sensor, and frames read one by one from a file or a pipe."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind
from jeit.data import Measurement, screen
from jeit.data.description import Description
from jeit.forward import ForwardModel
from jeit.imaging.calibration import StepTimer, calibrated_model, imaging_mesh
from jeit.imaging.electrode_changes import ElectrodeChange, ElectrodeChanges
from jeit.imaging.method import NamedPrior, check_body, check_hyperparameter, check_prior, prior_for
from jeit.imaging.preparation import (
    body_of,
    check_measurement,
    check_real,
    select_frames,
)
from jeit.imaging.wiring import check_wiring, find_wiring
from jeit.inverse import Imager
from jeit.inverse.calibration import Calibration
from jeit.inverse.nonlinear import GaussNewton
from jeit.inverse.nonlinear.solvers import AbstractSolver, as_solver
from jeit.inverse.prior.matern import MEASURED_DATA_PRIOR
from jeit.inverse.streaming.imager import check_memory
from jeit.inverse.streaming.stream import FrameImage, FrameStatus, StreamState

# Default number of mesh nodes for bodies without a mesh of their own.
DEFAULT_STREAM_NUM_POINTS = 1200


@dataclass(frozen=True)
class StreamSettings:
    """Settings of imaging frame by frame. The defaults apply to Python and the command line alike.

    **Arguments:**

    - `solver`: `GaussNewton()`, `LevenbergMarquardt()`, or `OneStep()` for linear images; or one of the names
      "gauss-newton", "levenberg-marquardt", "one-step".
    - `max_steps`: maximum number of iterations per frame, if the solver does not set it; default: 4, as for
      `jeit.inverse.Imager`.
    - `prior`: a name in `jeit.inverse.prior.matern.PRIORS`, or a quadratic prior.
    - `hyperparameter`: λ, or the name of a rule in `jeit.inverse.RULES`; default: "noise-figure".
    - `memory`: number of frames over which images are correlated, see `jeit.inverse.Imager`; 0: frames are imaged
      independently.
    - `contact`, `num_points` (default: 1,200), `as_is`: as in `jeit.imaging.ImagingSettings`.

    Raises `ValueError` for a solver that cannot image frames, an unknown prior, a memory that is not a number of
    frames, and in the same cases as `jeit.imaging.ImagingSettings`.

    **Example:**

    ```python
    settings = StreamSettings(solver="one-step", num_points=200)
    ```
    """

    solver: AbstractSolver | str = field(default_factory=GaussNewton)
    max_steps: int | None = None
    prior: NamedPrior = MEASURED_DATA_PRIOR
    hyperparameter: float | str | None = None
    memory: float = 0.0
    contact: str | None = None
    num_points: int | None = None
    as_is: bool = False

    def __post_init__(self):
        object.__setattr__(self, "solver", as_solver(self.solver, frames=True).for_frames(self.max_steps))
        check_prior(self.prior)
        check_memory(self.memory)
        check_body(self.contact, self.num_points)
        if self.hyperparameter is not None:
            check_hyperparameter(self.hyperparameter)


def prepare_imager(
    reference: Measurement,
    settings: StreamSettings | None = None,
    *,
    measurement: Measurement | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[Imager, Calibration]:
    """Prepare an imager for a sensor, and return it with the model calibrated on frames of the undisturbed sensor.

    **Arguments:**

    - `reference`: frames of the undisturbed sensor.
    - `settings`: default: `StreamSettings()`.
    - `measurement`: the frames to image, if they are available; their protocol must be that of the reference.
    - `progress`: function called with the name of each step when the step begins.

    Raises `ValueError` if the protocols differ, and in the same cases as `image_difference`.

    **Example:**

    ```python
    imager, calibration = prepare_imager(rest, StreamSettings(solver="one-step", num_points=200))
    ```
    """
    settings = StreamSettings() if settings is None else settings
    check_kind("settings", settings, StreamSettings, "StreamSettings, such as StreamSettings(solver='one-step')")
    check_measurement("reference", reference)
    imaged_measurement = reference if measurement is None else measurement
    _, reference_frame = select_frames(imaged_measurement, reference)
    if not reference_frame.protocol.same_patterns(imaged_measurement.protocol):
        raise ValueError(
            f"'{imaged_measurement.name}' was measured with another protocol than the reference "
            f"'{reference_frame.name}'."
        )
    check_real(imaged_measurement)
    check_real(reference_frame)
    domain, electrodes = body_of(imaged_measurement, reference_frame)
    step_timer = StepTimer(progress)
    with step_timer("mesh"):
        mesh = imaging_mesh(domain, electrodes, settings.num_points, usual=DEFAULT_STREAM_NUM_POINTS)
        model = ForwardModel(mesh, electrodes, reference_frame.protocol)
    with step_timer("wiring"):
        check_wiring(find_wiring(model, reference_frame), reference_frame, settings.as_is)
    calibration, _ = calibrated_model(model, reference_frame, contact=settings.contact, clock=step_timer)
    with step_timer("prepare"):
        imager = Imager.create(
            calibration.model,
            calibration.conductivity,
            reference=reference_frame.filled()[0],
            mask=reference_frame.mask[0],
            solver=settings.solver,
            prior=prior_for(settings.prior, domain),
            hyperparameter=settings.hyperparameter,
            memory=settings.memory,
        )
    return imager, calibration


class ElectrodeChangeFilter:
    """Subtracts from the frames of a stream the part of their difference from the reference that moved electrodes
    explain.

    Moved electrodes are searched for in the first, the second, the fourth suspicious frame and so on, since a search
    takes up to a second. Once they are found, the voltage change that they explain is subtracted from every frame in
    which it is a large part of the difference. The search continues in the other suspicious frames, as electrodes may
    move again.

    `imager`, `calibration`: see `prepare_imager`.
    """

    def __init__(self, imager: Imager, calibration: Calibration):
        channel_noise, channel_mask = np.asarray(imager.noise), np.asarray(imager.mask)
        self._electrode_changes = ElectrodeChanges.on_edge(
            calibration.model, float(calibration.conductivity), channel_noise, channel_mask
        )
        self._change_estimator: Float[np.ndarray, "p M"] | None = None
        self._num_suspicious_frames = 0

    def rest(self, state: StreamState, frame: Any) -> tuple[Any, ElectrodeChange | None]:
        """Return a `frame` without what moved electrodes explain of its difference from the reference of the `state`,
        and the change of the electrodes if it was found in this frame. A frame with a fault is returned as it is."""
        electrode_changes, voltage_difference = (
            self._electrode_changes,
            None if self._electrode_changes is None else _fault_free_difference(state, frame),
        )
        if electrode_changes is None or voltage_difference is None:
            return frame, None
        change_due_to_electrodes, electrode_change = np.zeros(len(voltage_difference)), None
        if self._change_estimator is not None:
            change_due_to_electrodes = electrode_changes.voltages(voltage_difference[None], self._change_estimator)[0]
        if not change_due_to_electrodes.any() and electrode_changes.are_suspicious(voltage_difference[None])[0]:
            self._num_suspicious_frames += 1
            is_power_of_two = self._num_suspicious_frames.bit_count() == 1
            new_estimator = electrode_changes.estimator(voltage_difference) if is_power_of_two else None
            electrode_change = (
                None if new_estimator is None else electrode_changes.find(voltage_difference, new_estimator)
            )
            if new_estimator is not None and electrode_change is not None:
                self._change_estimator = new_estimator
                change_due_to_electrodes = electrode_changes.voltages(voltage_difference[None], new_estimator)[0]
        return np.asarray(frame) - change_due_to_electrodes, electrode_change


def image_stream(
    imager: Imager,
    calibration: Calibration,
    frames: Iterable,
    found: Callable[[int, ElectrodeChange], None],
) -> Iterator[FrameImage]:
    """Yield the image of each frame as `jeit.inverse.stream` does, without the part of its difference from the
    reference that moved electrodes explain (`ElectrodeChangeFilter`).

    `imager`, `calibration`: see `prepare_imager`; `frames`: see `jeit.inverse.stream`; `found`: function called with
    the number of a frame and a change of the electrodes when it is found.
    """
    state, change_filter = StreamState(imager), ElectrodeChangeFilter(imager, calibration)
    for frame_number, frame in enumerate(frames):
        start_time = time.perf_counter()
        frame_without_change, electrode_change = change_filter.rest(state, frame)
        if electrode_change is not None:
            found(frame_number, electrode_change)
        filter_seconds = time.perf_counter() - start_time
        frame_image = state.image(frame_number, frame_without_change)
        yield replace(frame_image, latency=frame_image.latency + filter_seconds)


def _fault_free_difference(state: StreamState, frame: object) -> Float[np.ndarray, " M"] | None:
    """Change (M,) of a frame since the reference, volts, 0 in masked channels; None if the frame has a fault."""
    frame_voltages, usable_channels, frame_status, _ = state.check(frame)
    is_fault_free = frame_status == FrameStatus.IMAGED and usable_channels is state.mask
    return np.where(state.mask, frame_voltages - state.expected, 0.0) if is_fault_free else None


def described_reference(
    description: Description, frames: Float[np.ndarray, "N M"], *, name: str = "reference"
) -> Measurement:
    """Create a measurement from a description of a sensor and the mean of `frames` (N, M), volts, of the undisturbed
    sensor.

    Raises `ValueError` for a description without geometry, electrodes or protocol, and in the same cases as
    `jeit.data.screen`.
    """
    protocol = description.protocol(description.origin)
    if protocol is None or description.domain is None or description.electrodes is None:
        description_sections = {
            "geometry": description.domain,
            "electrodes": description.electrodes,
            "protocol": protocol,
        }
        missing_sections = ", ".join(
            f"[{section_name}]" for section_name, section_value in description_sections.items() if section_value is None
        )
        raise ValueError(f"{description.origin}: images need {missing_sections} too; describe it.")
    return screen(
        frames,
        protocol,
        electrodes=description.electrodes,
        domain=description.domain,
        name=name,
        notes=description.notes,
    ).mean_frame()


def frames_of(measurement: Measurement) -> Float[np.ndarray, "F M"]:
    """Voltages (F, M) of a measurement, volts, NaN in masked channels: the input of `jeit.inverse.stream`.

    **Arguments:**

    - `measurement`: the frames.

    **Example:**

    ```python
    voltages = frames_of(pressed)
    ```
    """
    return np.where(measurement.mask, measurement.voltages, np.nan)


def parse_frames(lines: Iterable[str]) -> Iterator[object]:
    """Parse a frame from each line that is not empty: voltages separated by spaces, commas or semicolons. A line that
    does not contain numbers is returned as text, and refused later."""
    for line in lines:
        separated_values = line.strip().rstrip(",;").replace(";", ",").split(",")
        value_texts = (
            line.split()
            if len(separated_values) == 1
            else [separated_value.strip() or "nan" for separated_value in separated_values]
        )
        if not line.strip():
            continue
        try:
            yield [float(value_text) for value_text in value_texts]
        except ValueError:
            yield line
