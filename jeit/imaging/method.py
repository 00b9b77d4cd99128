"""Settings of imaging, and its methods by name."""

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
from jeit.inverse.hyperparameter.defaults import EDGE_PRICE, ITERATED, RULE
from jeit.inverse.hyperparameter.rules import Rule, discrepancy
from jeit.inverse.linear.one_step import LinearReconstruction
from jeit.inverse.nonlinear import GaussNewton, LevenbergMarquardt
from jeit.inverse.nonlinear.reconstruct import Reconstruction
from jeit.inverse.nonlinear.solvers import AbstractSolver
from jeit.inverse.prior.matern import MEASURED, PRIORS
from jeit.inverse.prior.priors import AbstractPrior
from jeit.inverse.shapes import KINDS, LEAST_RISE, EllipsoidPrior, ShapeReconstruction, reconstruct_shapes
from jeit.mesh import Body
from jeit_solvers import Status
from jeit_solvers.engines import as_array, host

CONTACTS = ("each", "common", "fixed")
AUTO = "auto"


@dataclass(frozen=True)
class ImagingSettings:
    """Settings of imaging. The defaults here are jeit's defaults, for Python and command line alike.

    - `method`: "auto", the one-step image where it is sound, else Gauss-Newton's with its bodies outlined; in solids,
      bodies as ellipsoids wherever the data support them (`jeit.inverse.shapes`); or one of `METHODS`: linear ones,
      iterative ones that solve for conductivity itself, and "shapes", outlines alone.
    - `prior`: a name in `jeit.inverse.prior.matern.PRIORS`, or a quadratic prior; used by one-step, Gauss-Newton and
      Levenberg-Marquardt imaging. With "auto", one that is not the default asks in solids for an image by it, and no
      bodies.
    - `hyperparameter`: λ, or the name of a rule in `jeit.inverse.RULES`; a number for total variation and filtered
      back-projection; not used by plain back-projection. With "auto" it asks for a one-step image. None:
      "noise-figure" for one-step images, 5 for Gauss-Newton and Levenberg-Marquardt, 300 for total variation, what
      served on measured tanks.
    - `contact`: how the contact impedance is calibrated ("each", "common", "fixed"); None decides by the protocol: each
      electrode's own where voltages are read on driven electrodes, else fixed, for then nothing shows it.
    - `num_points`: nodes of the mesh, about; None for 2,000 of a sheet, and of a solid body 10,000.
    - `raster_shape`: (rows, columns) of the raster.
    - `level`, `least_peak`: see `jeit.image.find_inclusions`.
    - `as_is`: image even where the wiring is found to be another than described, see `jeit.imaging.wiring`.
    - `segment`: whether to cut the image up into background, resistive and conductive: by the outlines where there are
      any, else at half of every inclusion's own peak; with "auto", of an image by total variation.
    - `bodies`: of which kind those of a solid are: "either", "ellipsoids", or "columns" through its whole height.

    Raises `ValueError`, naming the setting, for what there is not or what does not go together.
    """

    method: str = AUTO
    prior: str | AbstractPrior = MEASURED
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
            if isinstance(self.hyperparameter, str) and (number := METHODS[self.method].number) is not None:
                name = self.method.replace("-", " ").replace("back ", "back-")
                raise ValueError(f"hyperparameter: {name} takes a number such as {number:g}, not a rule.")
        if self.bodies != KINDS[0] and (self.method not in (AUTO, "shapes") or self.prior != MEASURED):
            raise ValueError(
                "bodies: only methods 'auto' and 'shapes' with the default prior look for any; leave it out."
            )
        check_body(self.contact, self.num_points)


def as_settings(given: ImagingSettings | None) -> ImagingSettings:
    """The settings given, or the defaults. Raises `ValueError` for something else."""
    settings = ImagingSettings() if given is None else given
    check_kind("settings", settings, ImagingSettings, "ImagingSettings, such as ImagingSettings(method='gauss-newton')")
    return settings


def check_prior(prior) -> None:
    """Raises `ValueError` for what is neither a prior nor the name of one."""
    if not isinstance(prior, AbstractPrior):
        check_name("prior", prior, PRIORS, "" if isinstance(prior, str) else ", or an object such as Noser()")


def check_body(contact: str | None, num_points: int | None) -> None:
    """Raises `ValueError` for a calibration that there is not, and for meshes too coarse or too fine."""
    if contact is not None:
        check_name("contact", contact, CONTACTS)
    if num_points is not None and not (isinstance(num_points, Integral) and 50 <= num_points <= 100_000):
        raise ValueError(f"num_points: give 50 to 100,000 nodes of the mesh; it is {describe(num_points)}.")


def check_hyperparameter(hyperparameter: float | str) -> None:
    """Raises `ValueError` for what is neither a positive number nor a rule."""
    if isinstance(hyperparameter, str):
        check_name("hyperparameter", hyperparameter, RULES, ", or a number")
    elif not (is_number(hyperparameter) and hyperparameter > 0):
        raise ValueError(f"hyperparameter must be a positive number or a rule; it is {describe(hyperparameter)}.")


Imaged = tuple[LinearReconstruction | Reconstruction | ShapeReconstruction, Inexact[Array, " m"]]
"""A reconstruction, and the change of conductivity per cell that it finds, S/m (2-D: S); complex of complex ones."""
NamedPrior = str | AbstractPrior
"""A prior, or the name of one."""
NamedWeight = float | str | None
"""λ, or the name of the rule that chooses it; None for methods that have no use for one."""


class Asked(NamedTuple):
    """Settings passed to a method: the `prior` and λ, `hyperparameter`; `kinds` of bodies of a solid, see
    `jeit.inverse.shapes.EllipsoidPrior`; `progress`, called with the name of each stage of what takes long."""

    prior: NamedPrior
    hyperparameter: NamedWeight = None
    kinds: str = KINDS[0]
    progress: Callable[[str], None] | None = None


# Starts of shapes: all peaks of a smooth image that may be bodies, ghosts among them.
_PEAK, _AREA, _MOST = 0.15, 0.002, 8


@dataclass(frozen=True)
class Method:
    """A method to image a difference.

    - `image`: the function that does it, given what the settings ask.
    - `takes_prior`: whether it uses the prior of the settings; `prior`, what it is called where the method has its own.
    - `hyperparameter`: λ unless given. `takes_hyperparameter`: whether it has any use for one; `number`: one that
      serves, where λ cannot be chosen by a rule.
    """

    image: Callable[[PreparedDifference, Asked], Imaged]
    takes_prior: bool = False
    prior: str | None = None
    hyperparameter: float | str | None = None
    takes_hyperparameter: bool = True
    number: float | None = None


def prior_for(prior: NamedPrior, domain: Body) -> AbstractPrior:
    """The prior itself, or the one of that name in `jeit.inverse.prior.matern.PRIORS`, made for the body's size."""
    if not isinstance(prior, str):
        return prior
    x_min, x_max, y_min, y_max = domain.extent
    return PRIORS[prior](max(x_max - x_min, y_max - y_min))


def rule_for(name: str, prepared: PreparedDifference) -> Rule:
    """The rule of that name, with the noise of the data where the rule needs it. Raises `ValueError` if the noise is
    not known."""
    if name != "discrepancy":
        return RULES[name]
    if prepared.noise is None:
        raise ValueError(
            "hyperparameter: 'discrepancy' needs to know the noise, and no two channels of "
            f"'{prepared.model.protocol.name}' are tied by reciprocity to estimate it from; choose another rule, or a "
            "number."
        )
    return partial(discrepancy, noise=prepared.noise)


def _weight(prepared: PreparedDifference, hyperparameter: NamedWeight) -> float | Rule:
    """λ, with the rule in place of its name."""
    assert hyperparameter is not None
    return rule_for(hyperparameter, prepared) if isinstance(hyperparameter, str) else hyperparameter


def _one_step(prepared: PreparedDifference, asked: Asked) -> Imaged:
    found = one_step(
        prepared.model,
        prepared.calibration.conductivity,
        prior=prior_for(asked.prior, prepared.domain),
        hyperparameter=_weight(prepared, asked.hyperparameter),
        difference=prepared.difference,
        noise=prepared.relative_noise,
        mask=prepared.mask,
    )
    return found, found.image(prepared.difference)


def _back_projection(prepared: PreparedDifference, asked: Asked, *, filtered: bool) -> Imaged:
    weight = asked.hyperparameter
    given = {"hyperparameter": weight} if isinstance(weight, (int, float)) else {}
    # Bands lie between the equipotential lines of the real background; complex voltages are imaged part by part.
    conductivity = np.real(prepared.calibration.conductivity)
    found = back_projection(prepared.model, conductivity, filtered=filtered, mask=prepared.mask, **given)
    return found, found.image(prepared.difference)


def _iterated(
    prepared: PreparedDifference, asked: Asked, *, solver: AbstractSolver, own: AbstractPrior | None = None
) -> Imaged:
    """The conductivity whose voltages differ from the model's own as the frame differs from its reference.

    Errors of the model that are the same with and without objects cancel. `own`: the method's own prior, in place of
    that asked for. Raises `ValueError` if the solver fails.
    """
    model, background = prepared.model, prepared.calibration.conductivity
    if np.iscomplexobj(prepared.difference):
        raise ValueError(
            f"'{prepared.measurement.name}' is complex, and iterative methods are for real voltages: take one-step, or "
            "choose a part with [data] component in its description."
        )
    found = reconstruct(
        model,
        host.add(model.voltages(background), prepared.difference),
        background,
        prior=prior_for(asked.prior, prepared.domain) if own is None else own,
        hyperparameter=_weight(prepared, asked.hyperparameter),
        noise=prepared.modelled_noise if own is None else prepared.relative_noise,
        mask=prepared.mask,
        solver=solver,
    )
    if found.status == Status.FAILED:
        raise ValueError(f"'{prepared.measurement.name}': the reconstruction failed. {found.reason}")
    return found, found.conductivity - background


def shapes_in(prepared: PreparedDifference, smooth: Reconstruction, asked: Asked) -> ShapeReconstruction:
    """Estimate the bodies that explain a difference, starting from all inclusions of a smooth image of it.

    The factor by which the objective must rise without a body, besides the test by evidence, allows for errors of the
    model, which the noise does not include.
    """
    model, background = prepared.model, prepared.calibration.conductivity
    solid = prepared.mesh.dimension == 3
    departure = as_array(np.log(np.asarray(smooth.conductivity) / float(background)))
    peaks = find_inclusions(prepared.mesh, departure, level=0.5, least_peak=_PEAK, least_area=_AREA)
    return reconstruct_shapes(
        model,
        host.add(model.voltages(background), prepared.difference),
        background,
        start=[(one.sign, one.centroid, one.radius) for one in peaks[:_MOST]],
        noise=prepared.sharp_noise,
        mask=prepared.mask,
        prior=EllipsoidPrior(kinds=asked.kinds) if solid else None,
        # In a solid, errors of the model are modelled as a smooth field.
        least_rise=1 if solid else 1 + (LEAST_RISE - 1) * prepared.modelled_share,
        smooth=smooth if solid else None,
        progress=asked.progress,
    )


def _shapes(prepared: PreparedDifference, asked: Asked) -> Imaged:
    smooth, _ = _iterated(prepared, Asked(MEASURED, ITERATED), solver=_GAUSS_NEWTON)
    assert isinstance(smooth, Reconstruction)
    return of_shapes(prepared, shapes_in(prepared, smooth, asked))


def of_shapes(prepared: PreparedDifference, found: ShapeReconstruction) -> Imaged:
    """Shapes and their change of conductivity; of a solid, per cell of the finer mesh."""
    drawn = found if found.finer is None else found.finer
    return found, drawn.conductivity - prepared.calibration.conductivity


_GAUSS_NEWTON, _LEVENBERG_MARQUARDT = GaussNewton(100, 1e-4), LevenbergMarquardt(100, 1e-4)
METHODS: dict[str, Method] = {
    "one-step": Method(_one_step, takes_prior=True, hyperparameter=RULE),
    "back-projection": Method(partial(_back_projection, filtered=False), takes_hyperparameter=False),
    "filtered-back-projection": Method(partial(_back_projection, filtered=True), number=0.05),
    "gauss-newton": Method(partial(_iterated, solver=_GAUSS_NEWTON), takes_prior=True, hyperparameter=ITERATED),
    "levenberg-marquardt": Method(
        partial(_iterated, solver=_LEVENBERG_MARQUARDT), takes_prior=True, hyperparameter=ITERATED
    ),
    "total-variation": Method(
        partial(_iterated, solver=_GAUSS_NEWTON, own=TotalVariation()),
        prior="total variation",
        hyperparameter=EDGE_PRICE,
        number=EDGE_PRICE,
    ),
    "shapes": Method(_shapes, prior="star shapes", takes_hyperparameter=False),
}
"""Methods by the names of the command line."""
