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
from jeit.design.skin.sheet_touches import SheetTouches
from jeit.design.skin.skin import Skin, check_skin
from jeit.design.skin.touch_shapes import AbstractIndentation
from jeit.electrodes import SheetDiscs
from jeit.mesh import Domain
from jeit_solvers.engines import as_array, namespace, values_at_once
from jeit_solvers.module import Module

Symmetry = Literal["mirror-x", "mirror-y", "rotate-2", "rotate-4"]
_SYMMETRY_MATRICES = {
    None: ((1, 0, 0, 1),),
    "mirror-x": ((1, 0, 0, 1), (-1, 0, 0, 1)),
    "mirror-y": ((1, 0, 0, 1), (1, 0, 0, -1)),
    "rotate-2": ((1, 0, 0, 1), (-1, 0, 0, -1)),
    "rotate-4": ((1, 0, 0, 1), (0, -1, 1, 0), (-1, 0, 0, -1), (0, 1, -1, 0)),
}


class LayoutParameters(NamedTuple):
    """The parameters that an optimisation may vary: `centres` (L, 2) and `radii` (L,) of the electrodes in metres,
    their `contact_impedance` (L,) in ohm·m², and the `thickness` of the sheet in metres."""

    centres: Float[Array, "L 2"]
    radii: Float[Array, " L"]
    contact_impedance: Float[Array, " L"]
    thickness: Float[Array, ""]


class LogarithmicRange(Module):
    """Logarithmic mapping from k variables between 0 and 1 to positive values between `lower_limits` (k,) and
    `lower_limits` · exp(`log_ratios`)."""

    lower_limits: Float[np.ndarray, " k"]
    log_ratios: Float[np.ndarray, " k"]

    @classmethod
    def create(cls, name: str, limits, initial_values, unit: str) -> "LogarithmicRange":
        """Create the range of k values between two `limits`, which are the same for all values. `initial_values` (k,)
        only determines the number k. Raises `ValueError` for invalid limits."""
        lower_limit, upper_limit = limits if np.shape(limits) == (2,) else (0.0, 0.0)
        if not 0 < lower_limit < upper_limit < np.inf:
            raise ValueError(f"{name} must be two values in {unit}, the smaller one first; it is {limits!r}.")
        return cls(
            np.full(np.shape(initial_values), lower_limit),
            np.full(np.shape(initial_values), np.log(upper_limit / lower_limit)),
        )

    def variables(self, values) -> Float[np.ndarray, " k"]:
        """Variables (k,) between 0 and 1 that correspond to `values` (k,); values outside the range are clipped to the
        range."""
        return np.minimum(np.maximum(np.log(np.asarray(values) / self.lower_limits) / self.log_ratios, 0), 1)

    def values(self, variables) -> Float[Array, " k"]:
        """Values (k,) that correspond to `variables` (k,) between 0 and 1."""
        return jnp.asarray(self.lower_limits) * jnp.exp(self.log_ratios * variables)


class Variables(Module):
    """Mapping from design variables between 0 and 1 to the parameters `LayoutParameters` of a layout. The variables
    describe G electrodes, the generators; the other electrodes are images of the generators under the symmetry.

    **Fields**

    - `low`, `size` (2,): lower left corner and side lengths of the box in which the electrodes' centres may lie,
      metres.
    - `images` (k, 2, 2): matrices of the k operations of the symmetry; `electrode_order` (L,): index of each electrode
      among the images of the generators.
    - `initial`: the initial parameters of the layout; `start`: the design variables that correspond to `initial`.
    - `sizes` (G), `contacts` (G), `thickness` (1): ranges of the radii, contact impedances and thickness; None for
      parameters that are not varied.
    - `pitch`: mean spacing of the electrodes, metres: the side of a square with the area available to each electrode.
    """

    low: np.ndarray
    size: np.ndarray
    images: np.ndarray
    electrode_order: np.ndarray
    initial: LayoutParameters
    sizes: LogarithmicRange | None
    contacts: LogarithmicRange | None
    thickness: LogarithmicRange | None
    start: np.ndarray
    pitch: float

    @classmethod
    def create(
        cls, outline: Domain, initial: LayoutParameters, *, symmetry=None, sizes=False, contacts=None, thickness=None
    ) -> "Variables":
        """Create the mapping from the `initial` parameters of a layout. Raises `ValueError` for settings that
        contradict the parameters."""
        if symmetry is not None:
            check_name("symmetry", symmetry, filter(None, _SYMMETRY_MATRICES), ", or None")
        electrode_centres, electrode_radii = np.asarray(initial.centres), np.asarray(initial.radii)
        symmetry_matrices = np.array(_SYMMETRY_MATRICES[symmetry], float).reshape(-1, 2, 2)
        x_min, x_max, y_min, y_max = outline.extent
        if symmetry == "rotate-4" and not np.isclose(x_max - x_min, y_max - y_min):
            raise ValueError("symmetry: a quarter turn maps only a square onto itself, and the outline's box is none.")
        box_centre = np.array([x_min + x_max, y_min + y_max]) / 2
        is_generating_electrode = _is_in_first_sector(electrode_centres - box_centre, symmetry)
        _check_symmetric_counts(is_generating_electrode.sum(), len(symmetry_matrices), len(electrode_centres), symmetry)
        radius_range = contact_impedance_range = None
        if sizes is True:
            radius_range = LogarithmicRange(
                electrode_radii[is_generating_electrode] / 2, np.full(is_generating_electrode.sum(), np.log(4.0))
            )
        elif sizes is not False:
            diameter_range = LogarithmicRange.create("sizes", sizes, electrode_radii[is_generating_electrode], "metres")
            radius_range = LogarithmicRange(diameter_range.lower_limits / 2, diameter_range.log_ratios)
        if contacts is not None:
            contact_impedance_range = LogarithmicRange.create(
                "contact_impedance", contacts, electrode_radii[is_generating_electrode], "ohm·m²"
            )
        thickness_range = (
            None if thickness is None else LogarithmicRange.create("thickness", thickness, np.ones(1), "metres")
        )
        min_electrode_radius = electrode_radii.min() if radius_range is None else radius_range.lower_limits.min()
        low_corner, box_size = (
            np.array([x_min, y_min]) + min_electrode_radius,
            np.array([x_max - x_min, y_max - y_min]) - 2 * min_electrode_radius,
        )
        if (box_size <= 0).any():
            constrained_argument = "outline: it" if radius_range is None else "sizes: the outline"
            raise ValueError(f"{constrained_argument} is smaller than an electrode; give millimetres divided by 1000.")
        mirrored_positions = (
            np.einsum("kij,gj->kgi", symmetry_matrices, electrode_centres[is_generating_electrode] - box_centre)
            + box_centre
        ).reshape(-1, 2)
        # Images of generators are assigned to electrodes such that the sum of the distances between image and electrode
        # is minimal.
        electrode_order = scipy.optimize.linear_sum_assignment(
            np.linalg.norm(electrode_centres[:, None] - mirrored_positions, axis=-1)
        )[1]
        initial_variables = [
            np.clip((electrode_centres[is_generating_electrode] - low_corner) / box_size, 0, 1).ravel()
        ]
        if radius_range is not None:
            initial_variables.append(radius_range.variables(electrode_radii[is_generating_electrode]))
        if contact_impedance_range is not None:
            initial_variables.append(
                contact_impedance_range.variables(np.asarray(initial.contact_impedance)[is_generating_electrode])
            )
        if thickness_range is not None:
            initial_variables.append(thickness_range.variables(np.asarray(initial.thickness)[None]))
        electrode_radii, contact_impedances = (
            as_array(
                np.tile(np.asarray(electrode_values)[is_generating_electrode], len(symmetry_matrices))[electrode_order]
            )
            for electrode_values in (electrode_radii, initial.contact_impedance)
        )
        symmetric_parameters = LayoutParameters(initial.centres, electrode_radii, contact_impedances, initial.thickness)
        electrode_spacing = float(np.sqrt(np.prod(box_size) / len(electrode_order)))
        parameter_ranges = radius_range, contact_impedance_range, thickness_range
        return cls(
            low_corner,
            box_size,
            symmetry_matrices,
            electrode_order,
            symmetric_parameters,
            *parameter_ranges,
            np.concatenate(initial_variables),
            electrode_spacing,
        )

    def reproduces_parameters(self, parameters: LayoutParameters) -> bool:
        """Whether the variables `start` reproduce the given `parameters`: True if the parameters have the symmetry and
        lie in the ranges."""
        represented_parameters = _compiled_parameters(self, jnp.asarray(self.start))
        are_values_equal = (
            np.allclose(represented_values, parameter_values, rtol=1e-6, atol=0)
            for represented_values, parameter_values in zip(represented_parameters[1:], parameters[1:], strict=True)
        )
        return bool(np.allclose(represented_parameters.centres, parameters.centres, atol=1e-6)) and all(
            are_values_equal
        )

    @property
    def num_generators(self) -> int:
        """Number of generators, G: electrodes that the variables describe directly."""
        return len(self.electrode_order) // len(self.images)

    @property
    def min_radii(self) -> Float[np.ndarray, " L"]:
        """Minimum radii (L,) of the electrodes, metres."""
        if self.sizes is None:
            return np.asarray(self.initial.radii)
        return np.tile(self.sizes.lower_limits, len(self.images))[self.electrode_order]

    def parameters(self, variables: Float[Array, " v"]) -> LayoutParameters:
        """Parameters of the layout that correspond to the design variables (v,) between 0 and 1."""
        num_generators = self.num_generators
        generator_offsets, remaining_variables = (
            variables[: 2 * num_generators].reshape(num_generators, 2) * self.size - self.size / 2,
            variables[2 * num_generators :],
        )
        centres = jnp.einsum("kij,gj->kgi", self.images, generator_offsets).reshape(-1, 2) + self.low + self.size / 2
        _, radii, contact_impedance, thickness = self.initial
        if self.sizes is not None:
            radii, remaining_variables = (
                self._values_of_mirror_images(self.sizes.values(remaining_variables[:num_generators])),
                remaining_variables[num_generators:],
            )
        if self.contacts is not None:
            contact_impedance, remaining_variables = (
                self._values_of_mirror_images(self.contacts.values(remaining_variables[:num_generators])),
                remaining_variables[num_generators:],
            )
        if self.thickness is not None:
            thickness = self.thickness.values(remaining_variables)[0]
        return LayoutParameters(centres[self.electrode_order], radii, contact_impedance, thickness)

    def _values_of_mirror_images(self, generator_values: Float[Array, " G"]) -> Float[Array, " L"]:
        """Repeat the values (G,) of the generators for their images: values (L,) of all electrodes."""
        return jnp.tile(generator_values, len(self.images))[self.electrode_order]


_compiled_parameters = eqx.filter_jit(Variables.parameters)


@values_at_once
def _scale_conductance(sheet_conductance, thickness, initial_thickness):
    return sheet_conductance * (thickness / initial_thickness)


def _is_in_first_sector(centre_offsets: np.ndarray, symmetry: str | None) -> np.ndarray:
    x, y = centre_offsets.T
    if symmetry == "mirror-x":
        return x < 0
    if symmetry in ("mirror-y", "rotate-2"):
        return y < 0
    return (x > 0) & (y >= 0) if symmetry == "rotate-4" else np.ones(len(centre_offsets), bool)


def _check_symmetric_counts(
    num_in_first_sector: int, num_sectors: int, num_electrodes: int, symmetry: str | None
) -> None:
    if num_in_first_sector * num_sectors == num_electrodes:
        return
    if num_electrodes % num_sectors:
        suggested_remedy = (
            f"{num_electrodes} electrodes cannot be shared equally among {num_sectors} parts; add or remove "
            f"{num_electrodes % num_sectors}, or choose another symmetry."
        )
    else:
        suggested_remedy = "give a layout with the same number in each."
    raise ValueError(
        f"symmetry: {num_in_first_sector} of {num_electrodes} electrodes are in the first of {num_sectors} parts of "
        f"the skin for '{symmetry}'; {suggested_remedy}"
    )


@values_at_once
def balanced_score(scores: Scores) -> Float[Array, ""]:
    """Default score of an `Objective`: log of the smooth minimum of the sensitivity minus log of the mean variance, so
    that a change by one per cent has the same effect for both quantities."""
    xp = namespace(scores)
    return xp.log(scores.soft_worst) - xp.log(scores.mean_variance)


class Objective(Module):
    """Objective of a layout optimisation: the function of a layout's `Scores` that is maximised.

    **Fields**: `touches`: touches of the skin, as returned by `Skin.sheet_touches`; `prior`, `noise` (volts) and
    `temperature`: as in `layout_scores`; `score`: function of `Scores` whose values differ by about 1 between layouts,
    such as a logarithm. Raises `ValueError` if `score` is not a function, and for touches or a prior of the wrong type.

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
        score_options = {"prior": self.prior, "noise": self.noise, "temperature": self.temperature}
        return layout_scores(skin.model, skin.model_conductivity, self.touches, **score_options)

    def scores_of_varied(self, skin: Skin, varied: LayoutParameters) -> Scores:
        """Compute the scores of a skin with its electrodes and thickness replaced by those of `varied`. The scores are
        differentiable with respect to `varied`."""
        model = skin.model.with_electrodes(SheetDiscs(varied.centres, varied.radii, varied.contact_impedance))
        sheet_conductance = _scale_conductance(skin.model_conductivity, varied.thickness, skin.thickness)
        touches = self.touches.with_thickness(varied.thickness)
        score_options = {"prior": self.prior, "noise": self.noise, "temperature": self.temperature}
        return layout_scores(model, sheet_conductance, touches, **score_options)
