"""Objective of a layout optimisation: a score of a sheet's layout, to be maximised."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, describe
from jeit.design.defaults import CONTRAST, CORRELATION, NOISE, TEMPERATURE
from jeit.design.optimisation.variables import Varied
from jeit.design.scores import Score, Scores, TouchPrior, layout_scores
from jeit.design.skin.indentation import AbstractIndentation
from jeit.design.skin.sheet_touches import SheetTouches
from jeit.design.skin.skin import Skin, check_skin
from jeit.electrodes import SheetDiscs


def balanced(scores: Scores) -> Float[Array, ""]:
    """log of the soft-worst sensitivity minus that of the mean variance: a per cent of either counts alike."""
    return jnp.log(scores.soft_worst) - jnp.log(scores.mean_variance)


class Objective(eqx.Module):
    """The `score`, a function of the `Scores` of a layout, to be maximised.

    **Fields**: `touches`, of the skin, as of `Skin.sheet_touches`; `prior`, `noise` (volts) and `temperature` as in
    `layout_scores`; `score`, a function of `Scores` with differences of order 1, as logarithms have. Raises
    `ValueError` for a score that is no function, and for touches or a prior of another kind.
    """

    touches: SheetTouches
    prior: TouchPrior
    noise: Float[Array, "..."] = eqx.field(default=NOISE, converter=lambda noise: jnp.asarray(noise, float))
    score: Score = eqx.field(default=balanced, static=True)
    temperature: float = TEMPERATURE

    def __check_init__(self):
        if not callable(self.score):
            raise ValueError(f"score must be a function of Scores, such as balanced; it is {describe(self.score)}.")
        check_kind("touches", self.touches, SheetTouches, "SheetTouches, as of skin.sheet_touches(places)")
        check_kind("prior", self.prior, TouchPrior, "a TouchPrior, as of TouchPrior.create(places, correlation=0.05)")

    @classmethod
    def create(
        cls,
        skin: Skin,
        places: ArrayLike,
        indentation: AbstractIndentation | None = None,
        *,
        contrast: float = CONTRAST,
        correlation: float = CORRELATION,
        **options: Any,
    ) -> "Objective":
        """Of touches of a `skin` at `places` (n, 2), metres, as in `Skin.sheet_touches`, whose amplitudes are
        correlated over `correlation` metres; `options`: `noise`, `score`, `temperature`. Raises `ValueError` as
        `Skin.sheet_touches` and `TouchPrior.create` do."""
        check_skin("skin", skin)
        touches = skin.sheet_touches(places, indentation, contrast=contrast)
        return cls(touches, TouchPrior.create(places, correlation=correlation), **options)

    def scores(self, skin: Skin) -> Scores:
        """Compute all scores of a skin. Raises `ValueError` as `layout_scores` does."""
        options = {"prior": self.prior, "noise": self.noise, "temperature": self.temperature}
        return layout_scores(skin.model, skin.model_conductivity, self.touches, **options)

    def scores_of_varied(self, skin: Skin, varied: Varied) -> Scores:
        """Compute the scores with other electrodes and another thickness; differentiable in them."""
        model = skin.model.with_electrodes(SheetDiscs(varied.centres, varied.radii, varied.contact_impedance))
        conductance = skin.model_conductivity * (varied.thickness / skin.thickness)
        touches = self.touches.at_thickness(varied.thickness)
        options = {"prior": self.prior, "noise": self.noise, "temperature": self.temperature}
        return layout_scores(model, conductance, touches, **options)
