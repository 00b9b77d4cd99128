"""The design space and the constraints of a layout optimisation, and bounded minimisation from several starts."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.arguments import check_kind, check_metres, describe, is_number
from jeit.design.optimisation.variables import LayoutParameters, Symmetry, Variables
from jeit.design.skin.skin import Skin, longer_side
from jeit.layout import SurfaceLayout
from jeit.mesh import Domain
from jeit_solvers import Status, scipy_lbfgsb
from jeit_solvers.module import Module


class Constraints(Module):
    """Constraints on disc electrodes: each disc lies wholly inside `outline` and wholly outside every domain of
    `keep_out`, the centres are at least `minimum_spacing` metres apart, and no two discs overlap.

    Raises `ValueError` for a negative spacing.
    """

    outline: Domain
    minimum_spacing: float
    keep_out: tuple[Domain, ...] = ()

    def __check_init__(self):
        if not 0 <= self.minimum_spacing < np.inf:
            raise ValueError(f"minimum_spacing must be in metres, not negative; it is {self.minimum_spacing!r}.")

    def check_room(self, radii) -> None:
        """Raise `ValueError` if L discs of `radii` (L,), metres, are more than the densest packing of circles in the
        outline's bounding box allows."""
        x_min, x_max, y_min, y_max = self.outline.extent
        min_electrode_radius = float(np.min(radii))
        min_centre_distance = max(self.minimum_spacing, 2 * min_electrode_radius)
        # Circles of radius `min_centre_distance` / 2 around the discs' centres do not overlap. The circles extend by
        # this radius beyond the region in which the centres may lie.
        available_area = (x_max - x_min - 2 * min_electrode_radius + min_centre_distance) * (
            y_max - y_min - 2 * min_electrode_radius + min_centre_distance
        )
        if len(radii) * min_centre_distance**2 > 2 / np.sqrt(3) * available_area:
            raise ValueError(
                f"minimum_spacing: {len(radii)} electrodes {1e3 * min_centre_distance:.3g} mm apart do not fit the "
                f"outline, {1e3 * (x_max - x_min):.3g} × {1e3 * (y_max - y_min):.3g} mm; give less, or fewer "
                "electrodes."
            )

    def violations(self, centres: Float[Array, "L 2"], radii: Float[Array, " L"]) -> Float[Array, " q"]:
        """Violation (q,) of each of q constraints, metres: positive if the constraint is violated, otherwise zero or
        negative. The violation is differentiable almost everywhere."""
        return jnp.concatenate(list(self.violations_by_name(centres, radii).values()))

    def violations_by_name(
        self, centres: Float[Array, "L 2"], radii: Float[Array, " L"]
    ) -> dict[str, Float[Array, " q"]]:
        """Violations of the constraints on L discs, metres, by the name of the constraint: "minimum_spacing", "outline"
        and "keep_out"."""
        first_electrodes, second_electrodes = np.triu_indices(len(radii), 1)
        centre_distances = jnp.sqrt(
            jnp.sum((centres[first_electrodes] - centres[second_electrodes]) ** 2, axis=1) + 1e-24
        )
        keep_out_violations = [radii + keep_out_domain.signed_distance(centres) for keep_out_domain in self.keep_out]
        return {
            "minimum_spacing": jnp.maximum(self.minimum_spacing, radii[first_electrodes] + radii[second_electrodes])
            - centre_distances,
            "outline": radii - self.outline.signed_distance(centres),
            "keep_out": jnp.concatenate(keep_out_violations) if keep_out_violations else jnp.zeros(0),
        }


class DesignSpace(Module):
    """The layouts allowed in a layout optimisation, and the quantities that are varied.

    **Fields**

    - `outline`: domain that contains all electrodes, by default the outline of the skin.
    - `minimum_spacing`: minimum distance between the electrodes' centres, metres; electrodes never overlap, even if
      this distance is 0.
    - `keep_out`: domains of the skin that no electrode may overlap.
    - `symmetry`: symmetry of the layout about the middle of the outline's bounding box. Every half (x or y below or
      above the middle) or quarter must contain the same number of electrodes. The electrodes of the first half or
      quarter are optimised, and the other electrodes are replaced by their images. Use several starts, since a
      symmetric layout has fewer ways to improve.
    - `sizes`: whether the electrodes' diameters are varied: True for half to twice the initial diameters, or two
      limits, metres.
    - `contact_impedance`: two limits, ohm·m², between which the contact impedances are varied; None if the impedances
      are not varied.
    - `thickness`: two limits, metres, between which the thickness of the sheet is varied, starting from the thickness
      of the skin; the sheet conductivity is proportional to the thickness. None if the thickness is not varied.

    **Example:**

    ```python
    space = DesignSpace(minimum_spacing=0.012, symmetry="rotate-2")
    optimised = optimise_layout(sheet, objective, space, steps=1)
    ```
    """

    outline: Domain | None
    minimum_spacing: float
    keep_out: tuple[Domain, ...]
    symmetry: Symmetry | None = eqx.field(static=True)
    sizes: bool | tuple[float, float] = eqx.field(static=True)
    contact_impedance: tuple[float, float] | None = eqx.field(static=True)
    thickness: tuple[float, float] | None = eqx.field(static=True)

    def __init__(
        self,
        *,
        outline: Domain | None = None,
        minimum_spacing: float = 0.0,
        keep_out: Sequence[Domain] = (),
        symmetry: Symmetry | None = None,
        sizes: bool | tuple[float, float] = False,
        contact_impedance: tuple[float, float] | None = None,
        thickness: tuple[float, float] | None = None,
    ):
        """Raises `ValueError` for an outline, spacing or regions of the wrong type. Other arguments are checked when
        the design space is used for a skin."""
        if outline is not None:
            check_kind("outline", outline, Domain, "an outline, such as Rectangle(0.2, 0.2)")
        if not is_number(minimum_spacing):
            raise ValueError(f"minimum_spacing must be a length in metres; it is {describe(minimum_spacing)}.")
        keep_out_requirement = "a list of domains, such as [Disk(0.01, (0.02, 0.0))]"
        check_kind("keep_out", keep_out, Sequence, keep_out_requirement)
        for keep_out_domain in keep_out:
            check_kind("keep_out", keep_out_domain, Domain, keep_out_requirement)
        self.outline, self.minimum_spacing, self.keep_out = outline, float(minimum_spacing), tuple(keep_out)
        self.symmetry, self.sizes = symmetry, sizes
        self.contact_impedance, self.thickness = contact_impedance, thickness

    def constraints(self, skin: Skin) -> Constraints:
        """Constraints on the electrode layouts of a `skin`. Raises `ValueError` if neither the design space nor the
        skin has an outline, for a curved skin, and for an invalid spacing."""
        if isinstance(skin.layout, SurfaceLayout):
            raise ValueError("skin is curved; move its electrodes with jeit.design.optimise_surface_layout.")
        outline = skin.layout.outline if self.outline is None else self.outline
        if outline is None:
            raise ValueError(
                "outline: the layout does not know that of its skin; give one, such as Rectangle(0.2, 0.2)."
            )
        return Constraints(outline, self.minimum_spacing, self.keep_out)

    def variables(self, skin: Skin, constraints: Constraints, depth: float) -> Variables:
        """Design variables of the layouts, starting from the layout of a `skin` whose touches are `depth` metres deep.
        Raises `ValueError` for settings of the design space that no layout can satisfy."""
        variable_options = {"sizes": self.sizes, "contacts": self.contact_impedance, "thickness": self.thickness}
        outline = constraints.outline
        design_variables = Variables.create(
            outline, layout_parameters(skin), symmetry=self.symmetry, **variable_options
        )
        if self.thickness is not None:
            _check_thickness(self.thickness, depth, outline)
        constraints.check_room(design_variables.min_radii)
        return design_variables


def layout_parameters(skin: Skin) -> LayoutParameters:
    """Current positions, radii and contact impedances of a skin's electrodes and its thickness: the quantities that a
    layout optimisation may vary."""
    disc_electrodes = skin.model.electrodes
    contact_impedance = disc_electrodes.contact_impedance  # pyright: ignore[reportAttributeAccessIssue]
    return LayoutParameters(
        skin.layout.centres, skin.layout.diameters / 2, contact_impedance, jnp.asarray(skin.thickness, float)
    )


def _check_thickness(thickness_limits: tuple[float, float], touch_depth: float, outline: Domain) -> None:
    if np.min(thickness_limits) <= touch_depth:
        raise ValueError(f"thickness: the touches are {1e3 * touch_depth:.3g} mm deep; let the sheet be thicker.")
    check_metres("thickness", np.max(thickness_limits), longer_side(outline), "the skin is wide")


# The minimisation has converged if the relative decrease of the cost in a step is below this value.
_COST_TOLERANCE = 1e-5


class OptimisationHistory:
    """History of an optimisation of v variables from S starts: the variables (S, v) and scores (S,) initially and after
    every step. `callback` is called with each step's number, 0 for the initial layouts, and the scores."""

    def __init__(self, callback: Callable[[int, Float[np.ndarray, " S"]], None] | None = None):
        self.variables: list[np.ndarray] = []
        self.scores: list[np.ndarray] = []
        self._callback = callback

    def add(self, variables, scores) -> None:
        """Append the variables (S, v) and the scores (S,) of all starts after a step."""
        self.variables.append(np.array(variables))
        self.scores.append(np.array(scores))
        if self._callback is not None:
            self._callback(len(self.scores) - 1, self.scores[-1])


def minimise_from_starts(
    cost,
    variables: Float[Array, "S v"],
    steps: int,
    history: OptimisationHistory,
    *,
    tolerance: float = _COST_TOLERANCE,
) -> tuple[Float[Array, "S v"], Status]:
    """Minimise the sum of the costs of S starts over v variables between 0 and 1 by L-BFGS. Returns the final variables
    (S, v) and the status: converged, step limit, or stalled if no step along the gradient lowers the cost.

    `cost`: function of the variables (S, v) that returns the costs (S,), the scores (S,) for the `history`, and the
    gradient (S, v) of the costs.
    """
    last_cost_evaluation = {}

    def value_and_gradient(variables):
        costs_of_starts, scores_of_starts, cost_gradients = cost(variables)
        last_cost_evaluation.update(variables=np.asarray(variables), score=np.asarray(scores_of_starts))
        return np.asarray(costs_of_starts).sum(), cost_gradients

    def record_step(variables):
        is_last_evaluation = np.array_equal(last_cost_evaluation["variables"], variables)
        history.add(variables, last_cost_evaluation["score"] if is_last_evaluation else cost(variables)[1])

    final_variables, _, optimiser_status = scipy_lbfgsb(
        value_and_gradient, variables, 0.0, 1.0, tolerance=tolerance, max_steps=steps, callback=record_step
    )
    return jnp.asarray(final_variables), optimiser_status
