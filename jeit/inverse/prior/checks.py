"""What is asked of a prior."""

from __future__ import annotations

from typing import Any

from jeit.arguments import check_kind
from jeit.inverse.prior.priors import AbstractPrior

_WANTED = "an object of jeit.inverse: Noser(), Gaussian(length in metres), Laplace(), Tikhonov(), TotalVariation()"


def check_prior(prior: Any) -> None:
    """Raise `ValueError` for what is no prior: names of priors are the command line's and `ImagingSettings`' only."""
    check_kind("prior", prior, AbstractPrior, _WANTED)
