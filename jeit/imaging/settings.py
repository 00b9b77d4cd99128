"""How to image: the method, the prior, λ, the mesh. The defaults here are jeit's, for Python and command line alike."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from jeit.inverse import (
    RULES,
    AbstractPrior,
    Gaussian,
    Laplace,
    Noser,
    Tikhonov,
)
from jeit.inverse.nonlinear.reconstruct import EDGE_PRICE
from jeit.mesh import Domain

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


def prior_for(prior: str | AbstractPrior, domain: Domain) -> AbstractPrior:
    """The prior itself, or the one of that name in `PRIORS`, made for the size of the body."""
    if not isinstance(prior, str):
        return prior
    x_min, x_max, y_min, y_max = domain.extent
    return PRIORS[prior](max(x_max - x_min, y_max - y_min))
