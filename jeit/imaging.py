"""From two frames to a picture: check, mesh, calibrate, image, and say what is in it.

This is what `jeit reconstruct` runs, as one function. Its steps are the public functions of `jeit.data`,
`jeit.inverse` and `jeit.image`; take them from there for anything out of the ordinary.
"""

import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.data import FrameQuality, Measurement, check_imageable
from jeit.electrodes import AbstractElectrodes, BoundaryElectrodes, PointElectrodes, SheetDiscs
from jeit.forward import ForwardModel
from jeit.image import Inclusion, Raster, find_inclusions
from jeit.inverse import (
    RULES,
    AbstractPrior,
    Calibration,
    Gaussian,
    Laplace,
    LinearReconstruction,
    Noser,
    Tikhonov,
    back_projection,
    calibrate,
    one_step,
    relative_noise,
)
from jeit.mesh import Domain, Mesh, Refine

METHODS = ("one-step", "back-projection", "filtered-back-projection")
CONTACTS = ("each", "common", "fixed")

# Priors by name, made for a body of a given size: the longer side of its outline in metres.
PRIORS: dict[str, Callable[[float], AbstractPrior]] = {
    "tikhonov": lambda size: Tikhonov(),
    "laplace": lambda size: Laplace(),
    "noser": lambda size: Noser(),
    "gaussian": lambda size: Gaussian(0.085 * size),
}


@dataclass(frozen=True)
class ImagingSettings:
    """How to image. The defaults here are jeit's defaults, for Python and command line alike.

    - `method`: one of `METHODS`.
    - `prior`: a name in `PRIORS`, or a prior; used by one-step imaging.
    - `hyperparameter`: λ, or the name of a rule in `jeit.inverse.RULES`; not used by plain back-projection.
    - `contact`: how the contact impedance is calibrated ("each", "common", "fixed"); None decides by the protocol: each
      electrode's own where voltages are read on driven electrodes, else fixed, for then nothing shows it.
    - `num_points`: nodes of the mesh, about.
    - `raster_shape`: (rows, columns) of the raster.
    - `level`, `least_peak`: see `jeit.image.find_inclusions`.
    """

    method: str = "one-step"
    prior: str | AbstractPrior = "gaussian"
    hyperparameter: float | str = "noise-figure"
    contact: str | None = None
    num_points: int = 2000
    raster_shape: tuple[int, int] = (256, 256)
    level: float = 0.65
    least_peak: float = 0.3

    def __post_init__(self):
        if self.method not in METHODS:
            raise ValueError(f"method: there is no '{self.method}'; give one of {', '.join(METHODS)}.")
        known = self.prior in PRIORS if isinstance(self.prior, str) else isinstance(self.prior, AbstractPrior)
        if not known:
            raise ValueError(f"prior: there is no {self.prior!r}; give one of {', '.join(PRIORS)}, or a prior.")
        if isinstance(self.hyperparameter, str):
            if self.hyperparameter not in RULES:
                raise ValueError(
                    f"hyperparameter: '{self.hyperparameter}' is neither a number nor a rule; the rules are "
                    f"{', '.join(RULES)}."
                )
            if self.method == "filtered-back-projection" and self.hyperparameter != type(self).hyperparameter:
                raise ValueError("hyperparameter: filtered back-projection takes a number such as 0.05, not a rule.")
        elif isinstance(self.hyperparameter, bool) or not (
            np.isfinite(self.hyperparameter) and self.hyperparameter > 0
        ):
            raise ValueError(f"hyperparameter must be a positive number or a rule; it is {self.hyperparameter}.")
        if self.contact is not None and self.contact not in CONTACTS:
            raise ValueError(f"contact: there is no '{self.contact}'; give one of {', '.join(CONTACTS)}.")
        if not 50 <= self.num_points <= 100_000:
            raise ValueError(f"num_points: give 50 to 100,000 nodes of the mesh; it is {self.num_points}.")


@dataclass(frozen=True)
class ImagedDifference:
    """What `image_difference` found.

    - `measurement`, `reference`: the two frames compared, one frame each.
    - `quality`: what was found about the data before imaging.
    - `settings`: how it was imaged, with what was decided on the way filled in.
    - `calibration`: the forward model fitted to the reference; `model` and `mesh` are in it.
    - `reconstruction`: the reconstruction matrix, with the hyperparameter used and the rule that chose it.
    - `change`: change of conductivity in every cell (m,), S/m (2-D: S); against `calibration.conductivity`.
    - `raster`: `change` on a grid, NaN outside the mesh; `extent` (x_min, x_max, y_min, y_max) in metres.
    - `inclusions`: regions of changed conductivity, strongest first.
    - `timings`: seconds of each step.
    """

    measurement: Measurement
    reference: Measurement
    quality: FrameQuality
    settings: ImagingSettings
    calibration: Calibration
    reconstruction: LinearReconstruction
    change: Float[Array, " m"]
    raster: Float[Array, "rows columns"]
    extent: tuple[float, float, float, float]
    inclusions: tuple[Inclusion, ...]
    timings: dict[str, float] = field(default_factory=dict)

    @property
    def lowest(self) -> float:
        """Least change relative to the background; below -1 the linear image claims a negative conductivity."""
        return float(jnp.min(self.change) / self.calibration.conductivity)

    @property
    def mesh(self) -> Mesh:
        """The mesh imaged on."""
        return self.calibration.model.mesh


def image_difference(
    measurement: Measurement,
    reference: Measurement | None = None,
    settings: ImagingSettings | None = None,
    *,
    frame: int | str | None = None,
    progress: Callable[[str], None] | None = None,
) -> ImagedDifference:
    """Image what changed between a reference frame and a frame of `measurement`.

    `reference`: the undisturbed body (the mean of its frames is used); None if `measurement` carries its own, a
    frame named "reference". `frame`: which frame to image, by number from 0 or by name; the first unless given.
    `progress` is called with the name of each step as it begins. Raises `ValueError` for data that cannot be
    imaged (see `jeit.data.check_imageable`), that do not say where the electrodes are, or that are complex.
    """
    settings = ImagingSettings() if settings is None else settings
    clock = _Clock(progress)
    with clock("check"):
        one, base = select_frames(measurement, reference, frame)
        (quality,) = check_imageable(one, base)
        domain, electrodes = _setup(one, base)
        both = np.asarray(one.mask[0] & base.mask[0])
        difference = jnp.where(both, one.voltages[0] - base.voltages[0], 0)
    with clock("mesh"):
        mesh = imaging_mesh(domain, electrodes, settings.num_points)
        model = ForwardModel(mesh, electrodes, one.protocol)
    with clock("calibrate"):
        contact = settings.contact or default_contact(one)
        calibration = calibrate(model, base.voltages[0], mask=base.mask[0], contact=contact)
        if settings.contact is None and contact == "each" and calibration.status != "converged":
            contact = "common"  # the data do not tell so many impedances apart
            calibration = calibrate(model, base.voltages[0], mask=base.mask[0], contact=contact)
        calibration = jax.block_until_ready(calibration)
        if not np.isfinite(calibration.misfit):
            raise ValueError(
                f"'{base.name}': calibration on it failed ({calibration.status}); is this a frame of the empty body, "
                "and are geometry and protocol right?"
            )
    with clock("image"):
        noise = quality.difference_noise
        reconstruction = _reconstruction(calibration, settings, domain, base, difference, both, noise)
        change = jax.block_until_ready(reconstruction.image(difference))
        largest = float(jnp.abs(change).max())
        if not largest > 1e-9 * float(calibration.conductivity):
            raise ValueError(
                f"'{one.name}': the image is empty, no change reaches a billionth of the background. The "
                f"hyperparameter {float(reconstruction.hyperparameter):.3g} leaves nothing of the data: give a smaller "
                "one, or a rule."
            )
    with clock("raster and inclusions"):
        grid = Raster.create(mesh, shape=settings.raster_shape)
        raster = jax.block_until_ready(grid.sample(change))
        inclusions = find_inclusions(mesh, change, level=settings.level, least_peak=settings.least_peak)
    return ImagedDifference(
        measurement=one,
        reference=base,
        quality=quality,
        settings=ImagingSettings(**{**vars(settings), "contact": contact}),
        calibration=calibration,
        reconstruction=reconstruction,
        change=change,
        raster=raster,
        extent=grid.extent,
        inclusions=tuple(inclusions),
        timings=clock.seconds,
    )


def select_frames(
    measurement: Measurement, reference: Measurement | None = None, frame: int | str | None = None
) -> tuple[Measurement, Measurement]:
    """The frame to image and the reference to image it against, one frame each.

    A frame named "reference" in `measurement` is never imaged unless asked for, and is what the others are compared
    with when no `reference` is given. Raises `ValueError` when there is no reference, or no such frame.
    """
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


def imaging_mesh(domain: Domain, electrodes: AbstractElectrodes, num_points: int) -> Mesh:
    """A mesh of `domain` with about `num_points` nodes, finer near the electrodes, where fields are steep."""
    if isinstance(electrodes, SheetDiscs):
        radius = np.asarray(electrodes.radius)
        refine = Refine(np.asarray(electrodes.position), cell_size=0.7 * radius.min(), distance=float(radius.max()))
    elif isinstance(electrodes, (BoundaryElectrodes, PointElectrodes)):
        refine = Refine(np.asarray(electrodes.position), factor=2.0)
    else:
        refine = None
    return domain.mesh(num_points=num_points, refine=refine)


def default_contact(measurement: Measurement) -> str:
    """How to calibrate contact impedance: "each" if driven electrodes are read, else "fixed".

    Only the voltage of an electrode that carries current drops across its contact; without such channels the fit would
    bend contact impedances to explain something else.
    """
    return "each" if measurement.protocol.channels_on_driven_electrodes().any() else "fixed"


class _Clock:
    """Tells `progress` of each step and keeps the seconds that it took."""

    def __init__(self, progress: Callable[[str], None] | None):
        self.progress = progress
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, step: str):
        if self.progress is not None:
            self.progress(step)
        start = time.perf_counter()
        yield
        self.seconds[step] = time.perf_counter() - start


def _setup(measurement: Measurement, reference: Measurement) -> tuple[Domain, AbstractElectrodes]:
    domain = measurement.domain if measurement.domain is not None else reference.domain
    electrodes = measurement.electrodes if measurement.electrodes is not None else reference.electrodes
    if domain is None or electrodes is None:
        missing = "[geometry]" if domain is None else "[electrodes]"
        raise ValueError(
            f"'{measurement.name}' does not say what it was measured on: give a description with {missing} "
            "(a TOML file beside the data, or --description)."
        )
    if jnp.iscomplexobj(measurement.voltages):
        raise ValueError(
            f"'{measurement.name}' is complex; choose the part to image with [data] component in its description: "
            "real, imaginary or magnitude."
        )
    return domain, electrodes


def _reconstruction(
    calibration: Calibration, settings: ImagingSettings, domain: Domain, base: Measurement, difference, mask, noise
) -> LinearReconstruction:
    model, conductivity = calibration.model, calibration.conductivity
    if settings.method != "one-step":
        filtered = settings.method.startswith("filtered")
        given = {} if isinstance(settings.hyperparameter, str) else {"hyperparameter": settings.hyperparameter}
        return back_projection(model, conductivity, filtered=filtered, mask=mask, **given)
    prior = settings.prior
    if isinstance(prior, str):
        x_min, x_max, y_min, y_max = domain.extent
        prior = PRIORS[prior](max(x_max - x_min, y_max - y_min))
    deviation = relative_noise(base.voltages[0], mask)
    if settings.hyperparameter == "discrepancy":
        if noise is None:
            raise ValueError(
                "hyperparameter: 'discrepancy' needs to know the noise, and no two channels of "
                f"'{model.protocol.name}' are tied by reciprocity to tell it from; choose another rule, or a number."
            )
        deviation = deviation * noise.standard_deviation / jnp.sqrt(jnp.mean(deviation[mask] ** 2))
    return one_step(
        model,
        conductivity,
        prior=prior,
        hyperparameter=settings.hyperparameter,
        difference=difference,
        noise=deviation,
        mask=mask,
    )
