"""Settings of imaging: the method, the prior, λ, the mesh. The defaults here are jeit's, for Python and command line
alike."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral

from jeit.arguments import check_kind, check_name, describe, is_number
from jeit.imaging.method import METHODS
from jeit.inverse import RULES
from jeit.inverse.prior.defaults import MEASURED, PRIORS
from jeit.inverse.prior.priors import AbstractPrior
from jeit.inverse.shapes import KINDS

CONTACTS = ("each", "common", "fixed")
AUTO = "auto"


@dataclass(frozen=True)
class ImagingSettings:
    """Settings of imaging. The defaults here are jeit's defaults, for Python and command line alike.

    - `method`: "auto", the one-step image where it is sound, else Gauss-Newton's with its bodies outlined; in solids,
      bodies as ellipsoids wherever the data support them (`jeit.inverse.shapes`); or one of `METHODS`: linear ones,
      iterative ones that solve for conductivity itself, and "shapes", outlines alone.
    - `prior`: a name in `jeit.inverse.prior.defaults.PRIORS`, or a quadratic prior; used by one-step, Gauss-Newton and
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
