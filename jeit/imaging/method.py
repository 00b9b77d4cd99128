"""Settings of imaging, and the imaging methods by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from numbers import Integral
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Inexact

from jeit.arguments import check_kind, check_name, describe, is_number
from jeit.image import find_inclusions
from jeit.imaging.preparation import PreparedDifference
from jeit.inverse import RULES, TotalVariation, back_projection, one_step, reconstruct
from jeit.inverse.hyperparameter.choice import DEFAULT_RULE, EDGE_HYPERPARAMETER_PENALTY, GAUSS_NEWTON_HYPERPARAMETER
from jeit.inverse.hyperparameter.rules import Rule, discrepancy
from jeit.inverse.linear.one_step import LinearReconstruction
from jeit.inverse.nonlinear import GaussNewton, LevenbergMarquardt
from jeit.inverse.nonlinear.reconstruct import Reconstruction
from jeit.inverse.nonlinear.solvers import AbstractSolver
from jeit.inverse.prior.matern import MEASURED_DATA_PRIOR, PRIORS
from jeit.inverse.prior.priors import AbstractPrior
from jeit.inverse.shapes import KINDS, MIN_OBJECTIVE_RATIO, EllipsoidPrior, ShapeReconstruction, reconstruct_shapes
from jeit.mesh import Body
from jeit_solvers import Status
from jeit_solvers.engines import as_array, host

CONTACTS = ("each", "common", "fixed")
AUTO = "auto"


@dataclass(frozen=True)
class ImagingSettings:
    """Settings of imaging. The defaults apply to Python and the command line alike.

    **Arguments:**

    - `method`: "auto" or a name in `METHODS`: linear methods, iterative methods that solve for conductivity itself, and
      "shapes", which fits outlines of bodies. "auto" uses one-step imaging if its image is sound, otherwise
      Gauss-Newton imaging with outlines of the bodies; in solids, ellipsoids are fitted wherever the data support them
      (see `jeit.inverse.shapes`).
    - `prior`: a name in `jeit.inverse.prior.matern.PRIORS`, or a quadratic prior; used by one-step, Gauss-Newton and
      Levenberg-Marquardt imaging. With "auto" in solids, no bodies are fitted if the prior is not the default.
    - `hyperparameter`: λ, or the name of a rule in `jeit.inverse.RULES`. Total variation and filtered back-projection
      need a number; plain back-projection and "shapes" have no hyperparameter. With "auto" and a hyperparameter,
      one-step imaging is used. Defaults: "noise-figure" for one-step imaging, 5 for Gauss-Newton and
      Levenberg-Marquardt, 300 for total variation; these defaults gave good images of measured tanks.
    - `contact`: calibration of the contact impedance: "each" (one value per electrode), "common" (one value) or
      "fixed". Default: "each" if voltages are measured on driven electrodes. Otherwise the data do not determine the
      contact impedance, and the default is "fixed".
    - `num_points`: approximate number of mesh nodes; default: 2,000 for a sheet, 10,000 for a solid.
    - `raster_shape`: (rows, columns) of the raster.
    - `level`, `least_peak`: see `jeit.image.find_inclusions`.
    - `as_is`: whether to image the data unchanged, without corrections for spikes and moved electrodes, and even if the
      wiring seems to differ from its description, see `jeit.imaging.wiring`.
    - `segment`: whether to label background, resistive and conductive pixels: by the outlines of fitted bodies if there
      are any, otherwise at half of each inclusion's peak. With "auto", images without outlines are then computed by
      total variation.
    - `bodies`: kind of the bodies in a solid: "either", "ellipsoids", or "columns" through its whole height.

    Raises `ValueError`, naming the setting, for unknown or incompatible values.

    **Example:**

    ```python
    settings = ImagingSettings(method="gauss-newton", hyperparameter=5.0, num_points=500)
    ```
    """

    method: str = AUTO
    prior: str | AbstractPrior = MEASURED_DATA_PRIOR
    hyperparameter: float | str | None = None
    contact: str | None = None
    num_points: int | None = None
    raster_shape: tuple[int, int] = (256, 256)
    level: float = 0.65
    least_peak: float = 0.3
    segment: bool = False
    as_is: bool = False
    bodies: str = KINDS[0]

    def __post_init__(self):
        check_name("method", self.method, (AUTO, *METHODS))
        check_name("bodies", self.bodies, KINDS)
        check_prior(self.prior)
        if isinstance(self.prior, AbstractPrior) and not self.prior.is_quadratic:
            raise ValueError("prior: total variation is a method of its own; give method='total-variation'.")
        if self.method == AUTO and self.hyperparameter is not None:
            object.__setattr__(self, "method", "one-step")
        if self.hyperparameter is None:
            if self.method != AUTO:
                object.__setattr__(self, "hyperparameter", METHODS[self.method].hyperparameter)
        else:
            check_hyperparameter(self.hyperparameter)
            if (
                isinstance(self.hyperparameter, str)
                and (suggested_hyperparameter := METHODS[self.method].number) is not None
            ):
                method_text = self.method.replace("-", " ").replace("back ", "back-")
                raise ValueError(
                    f"hyperparameter: {method_text} takes a number such as {suggested_hyperparameter:g}, not a rule."
                )
        if self.bodies != KINDS[0] and (self.method not in (AUTO, "shapes") or self.prior != MEASURED_DATA_PRIOR):
            raise ValueError(
                "bodies: only methods 'auto' and 'shapes' with the default prior look for any; leave it out."
            )
        check_body(self.contact, self.num_points)


def as_settings(requested: ImagingSettings | None) -> ImagingSettings:
    """Return the `requested` settings, or the defaults for None. Raises `ValueError` for an argument of any other
    type."""
    settings = ImagingSettings() if requested is None else requested
    check_kind("settings", settings, ImagingSettings, "ImagingSettings, such as ImagingSettings(method='gauss-newton')")
    return settings


def check_prior(prior) -> None:
    """Raise `ValueError` unless `prior` is a prior or the name of a prior."""
    if not isinstance(prior, AbstractPrior):
        check_name("prior", prior, PRIORS, "" if isinstance(prior, str) else ", or an object such as Noser()")


def check_body(contact: str | None, num_points: int | None) -> None:
    """Check the calibration of contacts and the number of mesh nodes. Raises `ValueError` for an unknown calibration,
    and for meshes that are too coarse or too fine."""
    if contact is not None:
        check_name("contact", contact, CONTACTS)
    if num_points is not None and not (isinstance(num_points, Integral) and 50 <= num_points <= 100_000):
        raise ValueError(f"num_points: give 50 to 100,000 nodes of the mesh; it is {describe(num_points)}.")


def check_hyperparameter(hyperparameter: float | str) -> None:
    """Check λ or the name of its rule. Raises `ValueError` unless `hyperparameter` is a positive number or the name of
    a rule."""
    if isinstance(hyperparameter, str):
        check_name("hyperparameter", hyperparameter, RULES, ", or a number")
    elif not (is_number(hyperparameter) and hyperparameter > 0):
        raise ValueError(f"hyperparameter must be a positive number or a rule; it is {describe(hyperparameter)}.")


Imaged = tuple[LinearReconstruction | Reconstruction | ShapeReconstruction, Inexact[Array, " m"]]
"""A reconstruction, and its change of conductivity per cell, S/m (2-D: S); complex for complex voltages."""
NamedPrior = str | AbstractPrior
"""A prior, or the name of a prior."""
NamedWeight = float | str | None
"""λ, or the name of the rule that chooses it; None for methods without a hyperparameter."""


class MethodOptions(NamedTuple):
    """Settings passed to a method: `prior`; `hyperparameter`: λ or the name of its rule; `kinds`: kinds of bodies in a
    solid (see `jeit.inverse.shapes.EllipsoidPrior`); `progress`: called with the name of each stage of long
    computations."""

    prior: NamedPrior
    hyperparameter: NamedWeight = None
    kinds: str = KINDS[0]
    progress: Callable[[str], None] | None = None


# Fits of shapes start from the inclusions of a smooth image, some of which are artefacts: minimum peak and minimum area
# of these inclusions, see `jeit.image.find_inclusions`, and their maximum number.
_MIN_START_PEAK, _MIN_START_AREA, _MAX_START_INCLUSIONS = 0.15, 0.002, 8


@dataclass(frozen=True)
class Method:
    """An imaging method for the difference of two frames.

    - `image`: the function that computes the image from a prepared difference and the requested settings.
    - `takes_prior`: whether the method uses the prior of the settings.
    - `prior`: name of the method's own prior, if it has one.
    - `hyperparameter`: the default λ or rule.
    - `takes_hyperparameter`: whether the method has a hyperparameter.
    - `number`: a suitable λ, for methods whose λ cannot be chosen by a rule.
    """

    image: Callable[[PreparedDifference, MethodOptions], Imaged]
    takes_prior: bool = False
    prior: str | None = None
    hyperparameter: float | str | None = None
    takes_hyperparameter: bool = True
    number: float | None = None


def prior_for(prior: NamedPrior, domain: Body) -> AbstractPrior:
    """Return a prior; if `prior` is a name in `jeit.inverse.prior.matern.PRIORS`, create it for the size of the
    body."""
    if not isinstance(prior, str):
        return prior
    x_min, x_max, y_min, y_max = domain.extent
    return PRIORS[prior](max(x_max - x_min, y_max - y_min))


def choose_rule(name: str, prepared: PreparedDifference) -> Rule:
    """Return the rule `name`, which chooses the hyperparameter, with the noise of the data if the rule needs it. Raises
    `ValueError` if the rule needs noise that is not known."""
    if name != "discrepancy":
        return RULES[name]
    if prepared.noise is None:
        raise ValueError(
            "hyperparameter: 'discrepancy' needs to know the noise, and no two channels of "
            f"'{prepared.model.protocol.name}' are tied by reciprocity to estimate it from; choose another rule, or a "
            "number."
        )
    return partial(discrepancy, noise=prepared.noise)


def _hyperparameter_or_rule(prepared: PreparedDifference, hyperparameter: NamedWeight) -> float | Rule:
    """Return λ as a number, or the rule that chooses it."""
    assert hyperparameter is not None
    return choose_rule(hyperparameter, prepared) if isinstance(hyperparameter, str) else hyperparameter


def _one_step_image(prepared: PreparedDifference, options: MethodOptions) -> Imaged:
    reconstruction = one_step(
        prepared.model,
        prepared.calibration.conductivity,
        prior=prior_for(options.prior, prepared.domain),
        hyperparameter=_hyperparameter_or_rule(prepared, options.hyperparameter),
        difference=prepared.difference,
        noise=prepared.relative_noise,
        mask=prepared.mask,
    )
    return reconstruction, reconstruction.image(prepared.difference)


def _back_projection_image(prepared: PreparedDifference, options: MethodOptions, *, filtered: bool) -> Imaged:
    requested_hyperparameter = options.hyperparameter
    hyperparameter_keyword = (
        {"hyperparameter": requested_hyperparameter} if isinstance(requested_hyperparameter, (int, float)) else {}
    )
    # Equipotential lines are computed for the real part of the background; real and imaginary voltages are projected
    # separately.
    real_background = np.real(prepared.calibration.conductivity)
    reconstruction = back_projection(
        prepared.model, real_background, filtered=filtered, mask=prepared.mask, **hyperparameter_keyword
    )
    return reconstruction, reconstruction.image(prepared.difference)


def _iterative_image(
    prepared: PreparedDifference,
    options: MethodOptions,
    *,
    solver: AbstractSolver,
    method_prior: AbstractPrior | None = None,
) -> Imaged:
    """Estimate conductivity iteratively from the model's reference voltages plus the measured difference.

    Model errors that are the same in the frame and its reference cancel. `method_prior`: a prior of the method that
    replaces the requested prior. Raises `ValueError` if the solver fails, and for complex voltages.
    """
    model, background = prepared.model, prepared.calibration.conductivity
    if np.iscomplexobj(prepared.difference):
        raise ValueError(
            f"'{prepared.measurement.name}' is complex, and iterative methods are for real voltages: take one-step, or "
            "choose a part with [data] component in its description."
        )
    reconstruction = reconstruct(
        model,
        host.add(model.voltages(background), prepared.difference),
        background,
        prior=prior_for(options.prior, prepared.domain) if method_prior is None else method_prior,
        hyperparameter=_hyperparameter_or_rule(prepared, options.hyperparameter),
        noise=prepared.modelled_noise if method_prior is None else prepared.relative_noise,
        mask=prepared.mask,
        solver=solver,
    )
    if reconstruction.status == Status.FAILED:
        raise ValueError(f"'{prepared.measurement.name}': the reconstruction failed. {reconstruction.reason}")
    return reconstruction, reconstruction.conductivity - background


def shapes_in(
    prepared: PreparedDifference, smooth_image: Reconstruction, options: MethodOptions
) -> ShapeReconstruction:
    """Fit bodies that explain a difference, starting from the inclusions of its smooth image.

    The result contains a body only if the objective of the fit without it is larger by the factor `least_rise` and the
    Bayesian evidence favours the body. In a sheet, the factor allows for model errors and increases with their share in
    the variance of the noise. If the noise of the voltages is not known, it is estimated from what the smooth image
    leaves unexplained.
    """
    prepared = prepared.with_noise_from(float(smooth_image.misfit))
    model, background = prepared.model, prepared.calibration.conductivity
    is_solid = prepared.mesh.dimension == 3
    log_conductivity_change = as_array(np.log(np.asarray(smooth_image.conductivity) / float(background)))
    inclusions = find_inclusions(
        prepared.mesh, log_conductivity_change, level=0.5, least_peak=_MIN_START_PEAK, least_area=_MIN_START_AREA
    )
    return reconstruct_shapes(
        model,
        host.add(model.voltages(background), prepared.difference),
        background,
        start=[
            (inclusion.sign, inclusion.centroid, inclusion.radius) for inclusion in inclusions[:_MAX_START_INCLUSIONS]
        ],
        noise=prepared.sharp_noise,
        mask=prepared.mask,
        prior=EllipsoidPrior(kinds=options.kinds) if is_solid else None,
        # In a solid, model errors are represented by a smooth field instead.
        least_rise=1 if is_solid else 1 + (MIN_OBJECTIVE_RATIO - 1) * prepared.modelled_share,
        smooth=smooth_image if is_solid else None,
        accuracy=prepared.accuracy,
        progress=options.progress,
    )


def _shapes_image(prepared: PreparedDifference, options: MethodOptions) -> Imaged:
    smooth_image, _ = _iterative_image(
        prepared, MethodOptions(MEASURED_DATA_PRIOR, GAUSS_NEWTON_HYPERPARAMETER), solver=_GAUSS_NEWTON_SOLVER
    )
    assert isinstance(smooth_image, Reconstruction)
    return conductivity_change_of_shapes(prepared, shapes_in(prepared, smooth_image, options))


def conductivity_change_of_shapes(prepared: PreparedDifference, shapes: ShapeReconstruction) -> Imaged:
    """Return the shapes and their change of conductivity per cell; for a solid, per cell of the refined mesh."""
    conductivity_image = shapes if shapes.finer is None else shapes.finer
    return shapes, conductivity_image.conductivity - prepared.calibration.conductivity


_GAUSS_NEWTON_SOLVER, _LEVENBERG_MARQUARDT_SOLVER = GaussNewton(100, 1e-4), LevenbergMarquardt(100, 1e-4)
METHODS: dict[str, Method] = {
    "one-step": Method(_one_step_image, takes_prior=True, hyperparameter=DEFAULT_RULE),
    "back-projection": Method(partial(_back_projection_image, filtered=False), takes_hyperparameter=False),
    "filtered-back-projection": Method(partial(_back_projection_image, filtered=True), number=0.05),
    "gauss-newton": Method(
        partial(_iterative_image, solver=_GAUSS_NEWTON_SOLVER),
        takes_prior=True,
        hyperparameter=GAUSS_NEWTON_HYPERPARAMETER,
    ),
    "levenberg-marquardt": Method(
        partial(_iterative_image, solver=_LEVENBERG_MARQUARDT_SOLVER),
        takes_prior=True,
        hyperparameter=GAUSS_NEWTON_HYPERPARAMETER,
    ),
    "total-variation": Method(
        partial(_iterative_image, solver=_GAUSS_NEWTON_SOLVER, method_prior=TotalVariation()),
        prior="total variation",
        hyperparameter=EDGE_HYPERPARAMETER_PENALTY,
        number=EDGE_HYPERPARAMETER_PENALTY,
    ),
    "shapes": Method(_shapes_image, prior="star shapes", takes_hyperparameter=False),
}
"""Imaging methods by name, as used in Python and on the command line."""
