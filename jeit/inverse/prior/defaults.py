"""Default priors, and the quadratic priors by the names of the command line."""

from __future__ import annotations

from collections.abc import Callable

from jeit.inverse.prior.priors import AbstractPrior, Gaussian, Laplace, Noser, Tikhonov

PRIOR = Noser()
"""Of `one_step` and `reconstruct`: needs no length, and serves where nothing is known of a body."""
MEASURED = "gaussian"
"""Of images of measured data, in `PRIORS`; streams take it too."""


def smooth_prior(size: float) -> Gaussian:
    """The smooth prior that worked on measured tanks and skins, for a body of this size: its longer side, metres."""
    return Gaussian(0.085 * size)


def _matern(size: float) -> AbstractPrior:
    from jeit.inverse.prior.matern import Matern

    return Matern(smooth_prior(size).length)


PRIORS: dict[str, Callable[[float], AbstractPrior]] = {
    "tikhonov": lambda size: Tikhonov(),
    "laplace": lambda size: Laplace(),
    "noser": lambda size: Noser(),
    "gaussian": smooth_prior,
    "matern": _matern,
}
"""Quadratic priors by name, made for a body of a given size: its longer side, metres."""
