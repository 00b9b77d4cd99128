"""Preparation of streams: an imager for a measured sensor, and the frames of a file or a pipe, one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind
from jeit.data import Measurement
from jeit.forward import ForwardModel
from jeit.imaging.method import NamedPrior, check_body, check_hyperparameter, check_prior, prior_for
from jeit.imaging.preparation import (
    Clock,
    body_of,
    calibrated_model,
    check_measurement,
    check_real,
    check_wiring,
    imaging_mesh,
    select_frames,
)
from jeit.imaging.wiring import find_wiring
from jeit.inverse import Imager
from jeit.inverse.calibration import Calibration
from jeit.inverse.nonlinear import GaussNewton
from jeit.inverse.nonlinear.solvers import AbstractSolver, as_solver
from jeit.inverse.prior.matern import MEASURED
from jeit.inverse.streaming.imager import check_memory

# Default number of nodes of the mesh, for a body that is not a mesh itself.
STREAM_POINTS = 1200


@dataclass(frozen=True)
class StreamSettings:
    """Settings of imaging frame after frame. The defaults here are jeit's defaults, for Python and command line alike.

    - `solver`: `GaussNewton()`, `LevenbergMarquardt()`, or `OneStep()` for linear images; or the name of one
      ("gauss-newton", "levenberg-marquardt", "one-step"). `max_steps`: most iterations for a frame, where the solver
      has none of its own; as an `Imager` has it, 4, unless given.
    - `prior`: a name in `jeit.inverse.prior.matern.PRIORS`, or a quadratic prior.
    - `hyperparameter`: λ, or the name of a rule in `jeit.inverse.RULES`; "noise-figure" unless given.
    - `memory`: frames over which an image changes, see `jeit.inverse.Imager`; 0 takes every frame alone.
    - `contact`, `num_points` (1,200 unless given), `as_is`: as in `jeit.imaging.ImagingSettings`.

    Raises `ValueError` for a solver that does not image frames, a prior that there is not, a memory that is no number
    of frames, and as `jeit.imaging.ImagingSettings`.
    """

    solver: AbstractSolver | str = field(default_factory=GaussNewton)
    max_steps: int | None = None
    prior: NamedPrior = MEASURED
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
    """Prepare an imager for the sensor whose undisturbed frames are `reference`; return it and the model calibrated on
    them.

    `measurement`: what is to be imaged, if it is known already: its protocol must be the reference's. `progress` is
    called with the name of each step as it begins. Raises `ValueError` for another protocol, and as `image_difference`.
    """
    settings = StreamSettings() if settings is None else settings
    check_kind("settings", settings, StreamSettings, "StreamSettings, such as StreamSettings(solver='one-step')")
    check_measurement("reference", reference)
    measured = reference if measurement is None else measurement
    _, base = select_frames(measured, reference)
    if not base.protocol.same_patterns(measured.protocol):
        raise ValueError(f"'{measured.name}' was measured with another protocol than the reference '{base.name}'.")
    check_real(measured)
    check_real(base)
    domain, electrodes = body_of(measured, base)
    clock = Clock(progress)
    with clock("mesh"):
        mesh = imaging_mesh(domain, electrodes, settings.num_points, usual=STREAM_POINTS)
        model = ForwardModel(mesh, electrodes, base.protocol)
    with clock("wiring"):
        check_wiring(find_wiring(model, base), base, settings.as_is)
    calibration, _ = calibrated_model(model, base, contact=settings.contact, clock=clock)
    with clock("prepare"):
        imager = Imager.create(
            calibration.model,
            calibration.conductivity,
            reference=base.filled()[0],
            mask=base.mask[0],
            solver=settings.solver,
            prior=prior_for(settings.prior, domain),
            hyperparameter=settings.hyperparameter,
            memory=settings.memory,
        )
    return imager, calibration


def frames_of(measurement: Measurement) -> Float[np.ndarray, "F M"]:
    """The frames of a measurement, volts, NaN where a channel is masked: as `jeit.inverse.stream` takes them."""
    return np.where(measurement.mask, measurement.voltages, np.nan)


def parse_frames(lines: Iterable[str]) -> Iterator[object]:
    """A frame for every line that is not empty, its voltages parted by spaces, commas or semicolons; one that does not
    hold numbers comes as its text, and will be refused."""
    for line in lines:
        parts = line.strip().rstrip(",;").replace(";", ",").split(",")
        words = line.split() if len(parts) == 1 else [part.strip() or "nan" for part in parts]
        if not line.strip():
            continue
        try:
            yield [float(word) for word in words]
        except ValueError:
            yield line
