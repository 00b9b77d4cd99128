"""What comes before any image of measured data: two frames checked, a mesh, and a model calibrated on the reference."""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from jeit.arguments import check_kind
from jeit.data import Measurement, check_imageable
from jeit.data.imageable import FrameQuality
from jeit.electrodes import AbstractElectrodes
from jeit.forward import ForwardModel
from jeit.imaging.clock import Clock
from jeit.inverse import calibrate, relative_noise
from jeit.inverse.calibration import Calibration
from jeit.mesh import Domain, Mesh
from jeit_solvers.engines import as_array


@dataclass(frozen=True)
class PreparedDifference:
    """A difference of two frames, ready to be imaged.

    - `measurement`, `reference`: the two frames compared, one frame each.
    - `quality`: what was found about the data.
    - `domain`: the outline of the body.
    - `contact`: how the contact impedance was calibrated: "each", "common" or "fixed".
    - `calibration`: the forward model fitted to the reference; `model` and `mesh` are in it.
    - `difference`: (M,) volts, zero in masked channels; `mask` (M,), True for channels usable in both frames.
    """

    measurement: Measurement
    reference: Measurement
    quality: FrameQuality
    domain: Domain
    contact: str
    calibration: Calibration
    difference: Float[Array, " M"]
    mask: Bool[Array, " M"]

    @property
    def model(self) -> ForwardModel:
        """The calibrated forward model."""
        return self.calibration.model

    @property
    def mesh(self) -> Mesh:
        """The mesh to image on."""
        return self.calibration.model.mesh

    @property
    def relative_noise(self) -> Float[Array, " M"]:
        """How far channels are trusted relative to each other: `relative_noise` of the reference, volts."""
        return relative_noise(np.asarray(self.reference.voltages)[0], self.mask)

    @property
    def noise(self) -> float | None:
        """Standard deviation of the noise found in the difference, in units of `relative_noise`; None if not known."""
        found = self.quality.difference_noise
        if found is None:
            return None
        return found.standard_deviation / float(np.sqrt(np.mean(np.asarray(self.relative_noise)[self.mask] ** 2)))


def prepare_difference(
    measurement: Measurement,
    reference: Measurement | None = None,
    *,
    frame: int | str | None = None,
    contact: str | None = None,
    num_points: int = 2000,
    clock: Clock | None = None,
) -> PreparedDifference:
    """Check a frame against its reference, make a mesh, and calibrate a model of the body on the reference.

    Arguments as in `jeit.imaging.image_difference` and its settings; `clock` takes the time of each step. Raises
    `ValueError` for data that cannot be imaged (see `jeit.data.check_imageable`), that do not say where the electrodes
    are, or on which the calibration fails.
    """
    clock = Clock(None) if clock is None else clock
    with clock("check"):
        one, base = select_frames(measurement, reference, frame)
        (quality,) = check_imageable(one, base)
        domain, electrodes = body_of(one, base)
        both = np.asarray(one.mask)[0] & np.asarray(base.mask)[0]
        difference = as_array(np.where(both, np.asarray(one.voltages)[0] - np.asarray(base.voltages)[0], 0))
    calibration, chosen = calibrated_model(
        base, domain, electrodes, contact=contact, num_points=num_points, clock=clock
    )
    return PreparedDifference(one, base, quality, domain, chosen, calibration, difference, both)


def calibrated_model(
    base: Measurement,
    domain: Domain,
    electrodes: AbstractElectrodes,
    *,
    contact: str | None = None,
    num_points: int = 2000,
    clock: Clock | None = None,
) -> tuple[Calibration, str]:
    """A forward model on a new mesh, calibrated on a frame of the undisturbed body; and which `contact` was
    fitted.

    `contact`: "each", "common" or "fixed"; decided by the protocol, and by what converges, unless given. Raises
    `ValueError` if the calibration fails.
    """
    clock = Clock(None) if clock is None else clock
    with clock("mesh"):
        model = ForwardModel(imaging_mesh(domain, electrodes, num_points), electrodes, base.protocol)
    with clock("calibrate"):
        chosen = contact or default_contact(base)
        voltages, mask = np.asarray(base.voltages)[0], np.asarray(base.mask)[0]
        calibration = calibrate(model, voltages, mask=mask, contact=chosen)
        if contact is None and chosen == "each" and not calibration.tells_contacts_apart:
            chosen = "common"  # the data do not tell so many impedances apart
            calibration = calibrate(model, voltages, mask=mask, contact=chosen)
        calibration = jax.block_until_ready(calibration)
        if not np.isfinite(calibration.misfit):
            raise ValueError(
                f"'{base.name}': calibration on it failed ({calibration.reason}); is this a frame of the empty body, "
                "and are geometry and protocol right?"
            )
    return calibration, chosen


def select_frames(
    measurement: Measurement, reference: Measurement | None = None, frame: int | str | None = None
) -> tuple[Measurement, Measurement]:
    """The frame to image and the reference to image it against, one frame each.

    A frame named "reference" in `measurement` is never imaged unless asked for, and is what the others are compared
    with when no `reference` is given. Raises `ValueError` when there is no reference, no such frame, or no measurement.
    """
    check_measurement("measurement", measurement)
    if reference is not None:
        check_measurement("reference", reference)
    if reference is None:
        objects, reference = measurement.split_reference()
    elif "reference" in measurement.frame_names and measurement.num_frames > 1:
        objects, _ = measurement.split_reference()
    else:
        objects = measurement
    if "reference" in reference.frame_names and reference.num_frames > 1:
        _, reference = reference.split_reference()
    one = objects.frame(0) if frame is None else measurement.frame(frame)
    return one, reference.mean_frame()


def check_measurement(name: str, given: Measurement) -> None:
    """Raise `ValueError`, about the argument `name`, for what is no `Measurement`, such as the path of one."""
    check_kind(name, given, Measurement, "a Measurement, as of jeit.read(path)")


def imaging_mesh(domain: Domain, electrodes: AbstractElectrodes, num_points: int) -> Mesh:
    """A mesh of `domain` with about `num_points` nodes, finer near the electrodes, where fields are steep."""
    return domain.mesh(num_points=num_points, refine=electrodes.refinement() or None)


def default_contact(measurement: Measurement) -> str:
    """How to calibrate contact impedance: "each" if driven electrodes are read, else "fixed".

    Only the voltage of an electrode that carries current drops across its contact; without such channels the fit would
    bend contact impedances to explain something else.
    """
    return "each" if measurement.protocol.channels_on_driven_electrodes().any() else "fixed"


def check_real(measurement: Measurement) -> None:
    """Raise `ValueError` for complex voltages, where only `image_difference` takes them."""
    if np.iscomplexobj(measurement.voltages):
        raise ValueError(
            f"'{measurement.name}' is complex; choose the part to image with [data] component in its description: "
            "real, imaginary or magnitude."
        )


def body_of(measurement: Measurement, reference: Measurement) -> tuple[Domain, AbstractElectrodes]:
    """Outline and electrodes, from whichever of the two says them; raises `ValueError` where neither does."""
    domain = measurement.domain if measurement.domain is not None else reference.domain
    electrodes = measurement.electrodes if measurement.electrodes is not None else reference.electrodes
    if domain is None or electrodes is None:
        missing = "[geometry]" if domain is None else "[electrodes]"
        raise ValueError(
            f"'{measurement.name}' does not say what it was measured on: give a description with {missing} "
            "(a TOML file beside the data, or description=)."
        )
    return domain, electrodes
