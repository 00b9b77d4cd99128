"""From two frames to a picture: check, mesh, calibrate, image, and say what is in it.

This is what `jeit reconstruct` runs, as one function. Its steps are the public functions of `jeit.data`,
`jeit.preparation`, `jeit.inverse` and `jeit.image`; take them from there for anything out of the ordinary.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from jeit.data import FrameQuality, Measurement
from jeit.image import Inclusion, Raster, find_inclusions, segment
from jeit.inverse import (
    RULES,
    AbstractPrior,
    Calibration,
    Gaussian,
    Laplace,
    LinearReconstruction,
    Noser,
    Reconstruction,
    Tikhonov,
    TotalVariation,
    back_projection,
    one_step,
    reconstruct,
)
from jeit.inverse.hyperparameter import Rule, discrepancy
from jeit.inverse.reconstruct import EDGE_PRICE
from jeit.mesh import Domain, Mesh
from jeit.preparation import Clock, PreparedDifference, prepare_difference
from jeit.preparation import default_contact as default_contact
from jeit.preparation import imaging_mesh as imaging_mesh
from jeit.preparation import select_frames as select_frames

LINEAR_METHODS = ("one-step", "back-projection", "filtered-back-projection")
ITERATIVE_METHODS = ("gauss-newton", "levenberg-marquardt", "total-variation")
METHODS = (*LINEAR_METHODS, *ITERATIVE_METHODS)
CONTACTS = ("each", "common", "fixed")

DEFAULT_HYPERPARAMETERS: dict[str, float | str] = {
    "one-step": "noise-figure",
    "gauss-newton": 5.0,
    "levenberg-marquardt": 5.0,
    "total-variation": EDGE_PRICE,
}

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

    - `method`: one of `METHODS`: linear ones, and iterative ones that solve for conductivity itself.
    - `prior`: a name in `PRIORS`, or a prior; used by one-step, Gauss-Newton and Levenberg-Marquardt imaging.
    - `hyperparameter`: λ, or the name of a rule in `jeit.inverse.RULES`; a number for total variation and filtered
      back-projection; not used by plain back-projection. None: "noise-figure" for one-step images, 5 for Gauss-Newton
      and Levenberg-Marquardt, 300 for total variation, what served on measured tanks.
    - `contact`: how the contact impedance is calibrated ("each", "common", "fixed"); None decides by the protocol: each
      electrode's own where voltages are read on driven electrodes, else fixed, for then nothing shows it.
    - `num_points`: nodes of the mesh, about.
    - `raster_shape`: (rows, columns) of the raster.
    - `level`, `least_peak`: see `jeit.image.find_inclusions`.
    - `segment`: whether to cut the image up into background, resistive and conductive, see `jeit.image.segment`.
    """

    method: str = "one-step"
    prior: str | AbstractPrior = "gaussian"
    hyperparameter: float | str | None = None
    contact: str | None = None
    num_points: int = 2000
    raster_shape: tuple[int, int] = (256, 256)
    level: float = 0.65
    least_peak: float = 0.3
    segment: bool = False

    def __post_init__(self):
        if self.method not in METHODS:
            raise ValueError(f"method: there is no '{self.method}'; give one of {', '.join(METHODS)}.")
        known = self.prior in PRIORS if isinstance(self.prior, str) else isinstance(self.prior, AbstractPrior)
        if not known:
            raise ValueError(f"prior: there is no {self.prior!r}; give one of {', '.join(PRIORS)}, or a prior.")
        if self.hyperparameter is None:
            object.__setattr__(self, "hyperparameter", DEFAULT_HYPERPARAMETERS.get(self.method))
        elif isinstance(self.hyperparameter, str):
            if self.hyperparameter not in RULES:
                raise ValueError(
                    f"hyperparameter: '{self.hyperparameter}' is neither a number nor a rule; the rules are "
                    f"{', '.join(RULES)}."
                )
            if self.method == "filtered-back-projection":
                raise ValueError("hyperparameter: filtered back-projection takes a number such as 0.05, not a rule.")
            if self.method == "total-variation":
                raise ValueError("hyperparameter: total variation takes a number such as 300, not a rule.")
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
    - `reconstruction`: the reconstruction matrix, or what the iteration found; with the hyperparameter used and the
      rule that chose it.
    - `change`: change of conductivity in every cell (m,), S/m (2-D: S); against `calibration.conductivity`.
    - `raster`: `change` on a grid, NaN outside the mesh; `extent` (x_min, x_max, y_min, y_max) in metres.
    - `inclusions`: regions of changed conductivity, strongest first; iterative images are looked at on the scale of the
      logarithm, which weighs both signs alike.
    - `labels`: 0 background, 1 resistive, 2 conductive for every pixel of the raster, if asked for.
    - `timings`: seconds of each step.
    """

    measurement: Measurement
    reference: Measurement
    quality: FrameQuality
    settings: ImagingSettings
    calibration: Calibration
    reconstruction: LinearReconstruction | Reconstruction
    change: Float[Array, " m"]
    raster: Float[Array, "rows columns"]
    extent: tuple[float, float, float, float]
    inclusions: tuple[Inclusion, ...]
    labels: UInt8[np.ndarray, "rows columns"] | None = None
    timings: dict[str, float] = field(default_factory=dict)

    @property
    def lowest(self) -> float:
        """Least change relative to the background; below -1 the linear image claims a negative conductivity."""
        return float(jnp.min(self.change) / self.calibration.conductivity)

    @property
    def mesh(self) -> Mesh:
        """The mesh imaged on."""
        return self.calibration.model.mesh

    @property
    def iterative(self) -> bool:
        """Whether the image solves for conductivity itself."""
        return isinstance(self.reconstruction, Reconstruction)

    @property
    def departure(self) -> Float[Array, " m"]:
        """What stands out, per cell: the change of conductivity, or of its logarithm in iterative images."""
        if not self.iterative:
            return self.change
        return jnp.log1p(self.change / self.calibration.conductivity)


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
    clock = Clock(progress)
    prepared = prepare_difference(
        measurement,
        reference,
        frame=frame,
        contact=settings.contact,
        num_points=settings.num_points,
        clock=clock,
    )
    calibration, mesh = prepared.calibration, prepared.mesh
    with clock("image"):
        if settings.method in LINEAR_METHODS:
            reconstruction = _reconstruction(prepared, settings)
            change = reconstruction.image(prepared.difference)
        else:
            reconstruction = _iterated(prepared, settings)
            change = reconstruction.conductivity - calibration.conductivity
        largest = float(jnp.abs(change).max())
        if not largest > 1e-9 * float(calibration.conductivity):
            raise ValueError(
                f"'{prepared.measurement.name}': the image is empty, no change reaches a billionth of the background. "
                f"The hyperparameter {float(reconstruction.hyperparameter):.3g} leaves nothing of the data: give a "
                "smaller one, or a rule."
            )
    with clock("raster and inclusions"):
        grid = Raster.create(mesh, shape=settings.raster_shape)
        found = ImagedDifference(
            measurement=prepared.measurement,
            reference=prepared.reference,
            quality=prepared.quality,
            settings=replace(settings, contact=prepared.contact),
            calibration=calibration,
            reconstruction=reconstruction,
            change=change,
            raster=grid.sample(change),
            extent=grid.extent,
            inclusions=(),
            timings=clock.seconds,
        )
        departure = found.departure
        inclusions = find_inclusions(mesh, departure, level=settings.level, least_peak=settings.least_peak)
        if found.iterative:
            inclusions = [_with_change(one, calibration.conductivity) for one in inclusions]
        labels = segment(np.asarray(grid.sample(departure))) if settings.segment else None
    return replace(found, inclusions=tuple(inclusions), labels=labels)


def _with_change(inclusion: Inclusion, background) -> Inclusion:
    """An inclusion found in the logarithm of conductivity over `background`, its peak turned into a change."""
    peak = float(background * np.expm1(inclusion.peak))
    return Inclusion(inclusion.sign, inclusion.centroid, inclusion.area, peak)


def prior_for(prior: str | AbstractPrior, domain: Domain) -> AbstractPrior:
    """The prior itself, or the one of that name in `PRIORS`, made for the size of the body."""
    if not isinstance(prior, str):
        return prior
    x_min, x_max, y_min, y_max = domain.extent
    return PRIORS[prior](max(x_max - x_min, y_max - y_min))


def rule_for(name: str, prepared: PreparedDifference) -> Rule:
    """The rule of that name, told of the noise in the data if it needs to know. Raises `ValueError` if none does."""
    if name != "discrepancy":
        return RULES[name]
    if prepared.noise is None:
        raise ValueError(
            "hyperparameter: 'discrepancy' needs to know the noise, and no two channels of "
            f"'{prepared.model.protocol.name}' are tied by reciprocity to tell it from; choose another rule, or a "
            "number."
        )
    return partial(discrepancy, noise=prepared.noise)


def _reconstruction(prepared: PreparedDifference, settings: ImagingSettings) -> LinearReconstruction:
    model, conductivity = prepared.model, prepared.calibration.conductivity
    hyperparameter = settings.hyperparameter
    if settings.method != "one-step":
        filtered = settings.method.startswith("filtered")
        given = {"hyperparameter": hyperparameter} if isinstance(hyperparameter, (int, float)) else {}
        return back_projection(model, conductivity, filtered=filtered, mask=prepared.mask, **given)
    assert hyperparameter is not None
    return one_step(
        model,
        conductivity,
        prior=prior_for(settings.prior, prepared.domain),
        hyperparameter=rule_for(hyperparameter, prepared) if isinstance(hyperparameter, str) else hyperparameter,
        difference=prepared.difference,
        noise=prepared.deviation,
        mask=prepared.mask,
    )


def _iterated(prepared: PreparedDifference, settings: ImagingSettings) -> Reconstruction:
    """The conductivity whose voltages differ from the model's own as the frame differs from its reference.

    So what the model gets wrong alike with and without objects is left out. Raises `ValueError` if the solver fails.
    """
    model, background = prepared.model, prepared.calibration.conductivity
    total_variation = settings.method == "total-variation"
    hyperparameter = settings.hyperparameter
    if isinstance(hyperparameter, str):
        hyperparameter = rule_for(hyperparameter, prepared)
    found = reconstruct(
        model,
        model.voltages(background) + prepared.difference,
        background,
        prior=TotalVariation() if total_variation else prior_for(settings.prior, prepared.domain),
        hyperparameter=hyperparameter,
        noise=prepared.deviation,
        mask=prepared.mask,
        solver="gauss-newton" if total_variation else settings.method,
        max_steps=100,
        rtol=1e-4,
    )
    if found.status == "failed":
        raise ValueError(f"'{prepared.measurement.name}': the reconstruction failed. {found.reason}")
    return found
