"""Design variables of a layout, and the objective of a layout optimisation."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, check_name, describe
from jeit.design.defaults import CONTRAST, CORRELATION, NOISE, TEMPERATURE
from jeit.design.scores import Score, Scores, TouchPrior, layout_scores
from jeit.design.skin.indentation import AbstractIndentation
from jeit.design.skin.sheet_touches import SheetTouches
from jeit.design.skin.skin import Skin, check_skin
from jeit.electrodes import SheetDiscs
from jeit.mesh import Domain
from jeit_solvers.module import Module

Symmetry = Literal["mirror-x", "mirror-y", "rotate-2", "rotate-4"]
_IMAGES = {
    None: ((1, 0, 0, 1),),
    "mirror-x": ((1, 0, 0, 1), (-1, 0, 0, 1)),
    "mirror-y": ((1, 0, 0, 1), (1, 0, 0, -1)),
    "rotate-2": ((1, 0, 0, 1), (-1, 0, 0, -1)),
    "rotate-4": ((1, 0, 0, 1), (0, -1, 1, 0), (-1, 0, 0, -1), (0, 1, -1, 0)),
}


class Varied(NamedTuple):
    """The parameters that an optimisation may vary: `centres` (L, 2) and `radii` (L,) of the electrodes in metres,
    their `contact_impedance` (L,) in ohm·m², and the `thickness` of the sheet in metres."""

    centres: Float[Array, "L 2"]
    radii: Float[Array, " L"]
    contact_impedance: Float[Array, " L"]
    thickness: Float[Array, ""]


class Range(Module):
    """Logarithmic scale for k positive values between `least` (k,) and `least` · exp(`span`)."""

    least: Float[np.ndarray, " k"]
    span: Float[np.ndarray, " k"]

    @classmethod
    def create(cls, name: str, ends, start, unit: str) -> "Range":
        """Create the range from its two `ends`, the same for all k values of `start` (k,). Raises `ValueError` for
        invalid ends."""
        least, most = ends if np.shape(ends) == (2,) else (0.0, 0.0)
        if not 0 < least < most < np.inf:
            raise ValueError(f"{name} must be two values in {unit}, the smaller one first; it is {ends!r}.")
        return cls(np.full(np.shape(start), least), np.full(np.shape(start), np.log(most / least)))

    def variables(self, values) -> Float[np.ndarray, " k"]:
        """Variables between 0 and 1 that correspond to `values`; values outside the range are clipped to it."""
        return np.minimum(np.maximum(np.log(np.asarray(values) / self.least) / self.span, 0), 1)

    def values(self, variables) -> Float[Array, " k"]:
        """Values that correspond to variables between 0 and 1."""
        return jnp.asarray(self.least) * jnp.exp(self.span * variables)


class Variables(Module):
    """Mapping from variables between 0 and 1 to the parameters `Varied`. The variables describe G generators; the other
    electrodes are their images under the symmetry.

    **Fields**

    - `low`, `size` (2,): lower left corner and side lengths of the bounding box of the centres, metres.
    - `images` (k, 2, 2): matrices of the symmetry; `order` (L,): index of the image that each electrode is.
    - `given`: the initial parameters; `start`: the variables that correspond to them.
    - `sizes` (G), `contacts` (G), `thickness` (1): ranges of the radii, contact impedances and thickness; None if these
      are not varied.
    - `pitch`: mean spacing of the electrodes, metres: the side of a square with the area available to each.
    """

    low: np.ndarray
    size: np.ndarray
    images: np.ndarray
    order: np.ndarray
    given: Varied
    sizes: Range | None
    contacts: Range | None
    thickness: Range | None
    start: np.ndarray
    pitch: float

    @classmethod
    def create(
        cls, outline: Domain, given: Varied, *, symmetry=None, sizes=False, contacts=None, thickness=None
    ) -> "Variables":
        """Create the variables from the `given` parameters. Raises `ValueError` for settings that contradict them."""
        if symmetry is not None:
            check_name("symmetry", symmetry, filter(None, _IMAGES), ", or None")
        centres, radii = np.asarray(given.centres), np.asarray(given.radii)
        images = np.array(_IMAGES[symmetry], float).reshape(-1, 2, 2)
        x_min, x_max, y_min, y_max = outline.extent
        if symmetry == "rotate-4" and not np.isclose(x_max - x_min, y_max - y_min):
            raise ValueError("symmetry: a quarter turn maps only a square onto itself, and the outline's box is none.")
        middle = np.array([x_min + x_max, y_min + y_max]) / 2
        first = _is_in_first_part(centres - middle, symmetry)
        _check_shares(first.sum(), len(images), len(centres), symmetry)
        size_range = contact_range = None
        if sizes is True:
            size_range = Range(radii[first] / 2, np.full(first.sum(), np.log(4.0)))
        elif sizes is not False:
            diameters = Range.create("sizes", sizes, radii[first], "metres")
            size_range = Range(diameters.least / 2, diameters.span)
        if contacts is not None:
            contact_range = Range.create("contact_impedance", contacts, radii[first], "ohm·m²")
        thickness_range = None if thickness is None else Range.create("thickness", thickness, np.ones(1), "metres")
        room = radii.min() if size_range is None else size_range.least.min()
        low, size = np.array([x_min, y_min]) + room, np.array([x_max - x_min, y_max - y_min]) - 2 * room
        if (size <= 0).any():
            name = "outline: it" if size_range is None else "sizes: the outline"
            raise ValueError(f"{name} is smaller than an electrode; give millimetres divided by 1000.")
        every = (np.einsum("kij,gj->kgi", images, centres[first] - middle) + middle).reshape(-1, 2)
        # Images are assigned to electrodes such that the sum of their distances is minimal.
        order = scipy.optimize.linear_sum_assignment(np.linalg.norm(centres[:, None] - every, axis=-1))[1]
        start = [np.clip((centres[first] - low) / size, 0, 1).ravel()]
        if size_range is not None:
            start.append(size_range.variables(radii[first]))
        if contact_range is not None:
            start.append(contact_range.variables(np.asarray(given.contact_impedance)[first]))
        if thickness_range is not None:
            start.append(thickness_range.variables(np.asarray(given.thickness)[None]))
        radii, impedance = (
            jnp.tile(jnp.asarray(values)[first], len(images))[order] for values in (radii, given.contact_impedance)
        )
        repeated = Varied(given.centres, radii, impedance, given.thickness)
        pitch = float(np.sqrt(np.prod(size) / len(order)))
        ranges = size_range, contact_range, thickness_range
        return cls(low, size, images, order, repeated, *ranges, np.concatenate(start), pitch)

    def holds(self, varied: Varied) -> bool:
        """Whether the start represents `varied` exactly: True if `varied` has the symmetry and lies in the ranges."""
        found = self.varied(jnp.asarray(self.start))
        same = (np.allclose(one, other, rtol=1e-6, atol=0) for one, other in zip(found[1:], varied[1:], strict=True))
        return bool(np.allclose(found.centres, varied.centres, atol=1e-6)) and all(same)

    @property
    def num_generators(self) -> int:
        """Number of generators, G."""
        return len(self.order) // len(self.images)

    @property
    def smallest(self) -> Float[np.ndarray, " L"]:
        """Minimum radii (L,) of the electrodes, metres."""
        if self.sizes is None:
            return np.asarray(self.given.radii)
        return np.tile(self.sizes.least, len(self.images))[self.order]

    def varied(self, variables: Float[Array, " v"]) -> Varied:
        """Parameters that correspond to the variables."""
        number = self.num_generators
        place, rest = variables[: 2 * number].reshape(number, 2) * self.size - self.size / 2, variables[2 * number :]
        centres = jnp.einsum("kij,gj->kgi", self.images, place).reshape(-1, 2) + self.low + self.size / 2
        _, radii, contact_impedance, thickness = self.given
        if self.sizes is not None:
            radii, rest = self._repeated(self.sizes.values(rest[:number])), rest[number:]
        if self.contacts is not None:
            contact_impedance, rest = self._repeated(self.contacts.values(rest[:number])), rest[number:]
        if self.thickness is not None:
            thickness = self.thickness.values(rest)[0]
        return Varied(centres[self.order], radii, contact_impedance, thickness)

    def _repeated(self, values: Float[Array, " G"]) -> Float[Array, " L"]:
        return jnp.tile(values, len(self.images))[self.order]


def _is_in_first_part(offset: np.ndarray, symmetry: str | None) -> np.ndarray:
    x, y = offset.T
    if symmetry == "mirror-x":
        return x < 0
    if symmetry in ("mirror-y", "rotate-2"):
        return y < 0
    return (x > 0) & (y >= 0) if symmetry == "rotate-4" else np.ones(len(offset), bool)


def _check_shares(number: int, parts: int, total: int, symmetry: str | None) -> None:
    if number * parts == total:
        return
    if total % parts:
        advice = (
            f"{total} electrodes cannot be shared equally among {parts} parts; add or remove {total % parts}, or "
            "choose another symmetry."
        )
    else:
        advice = "give a layout with the same number in each."
    raise ValueError(
        f"symmetry: {number} of {total} electrodes are in the first of {parts} parts of the skin for '{symmetry}'; "
        f"{advice}"
    )


def balanced_score(scores: Scores) -> Float[Array, ""]:
    """Default score of an `Objective`: log of the smooth minimum of the sensitivity minus log of the mean variance, so
    that a change of either by one per cent counts the same."""
    return jnp.log(scores.soft_worst) - jnp.log(scores.mean_variance)


class Objective(Module):
    """Objective of a layout optimisation: a function of the `Scores` of a layout, which is maximised.

    **Fields**: `touches`: touches of the skin, as from `Skin.sheet_touches`; `prior`, `noise` (volts) and
    `temperature`: as in `layout_scores`; `score`: function of `Scores` whose values differ by the order of 1 between
    layouts, such as a logarithm. Raises `ValueError` if `score` is not a function, and for touches or a prior of
    another type.

    **Example:**

    ```python
    objective = Objective.create(sheet, touches.places, Bell(2e-3), noise=1e-4, correlation=0.02)
    print(objective.scores(sheet).worst)  # volts
    ```
    """

    touches: SheetTouches
    prior: TouchPrior
    noise: Float[Array, "..."] = eqx.field(default=NOISE, converter=lambda noise: jnp.asarray(noise, float))
    score: Score = eqx.field(default=balanced_score, static=True)
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
        """Create the objective for touches of a `skin` at `places` (n, 2), metres, as in `Skin.sheet_touches`.

        `correlation`: correlation length of the touch amplitudes under the prior, metres; `options`: `noise`, `score`
        and `temperature`. Raises `ValueError` as `Skin.sheet_touches` and `TouchPrior.create` do.
        """
        check_skin("skin", skin)
        touches = skin.sheet_touches(places, indentation, contrast=contrast)
        return cls(touches, TouchPrior.create(places, correlation=correlation), **options)

    def scores(self, skin: Skin) -> Scores:
        """Compute all scores of a skin. Raises `ValueError` as `layout_scores` does."""
        options = {"prior": self.prior, "noise": self.noise, "temperature": self.temperature}
        return layout_scores(skin.model, skin.model_conductivity, self.touches, **options)

    def scores_of_varied(self, skin: Skin, varied: Varied) -> Scores:
        """Compute the scores of a skin with its electrodes and thickness replaced by those of `varied`; differentiable
        with respect to these."""
        model = skin.model.with_electrodes(SheetDiscs(varied.centres, varied.radii, varied.contact_impedance))
        conductance = skin.model_conductivity * (varied.thickness / skin.thickness)
        touches = self.touches.at_thickness(varied.thickness)
        options = {"prior": self.prior, "noise": self.noise, "temperature": self.temperature}
        return layout_scores(model, conductance, touches, **options)
