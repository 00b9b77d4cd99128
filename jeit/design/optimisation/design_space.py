"""`DesignSpace`: the layouts allowed in an optimisation, and the parameters varied besides the positions."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jeit.arguments import check_kind, check_metres, describe, is_number
from jeit.design.optimisation.constraints import Constraints
from jeit.design.optimisation.variables import Symmetry, Variables, Varied
from jeit.design.skin.skin import Skin, longer_side
from jeit.layout import SurfaceLayout
from jeit.mesh import Domain


class DesignSpace(eqx.Module):
    """The layouts of a skin allowed in an optimisation.

    **Fields**

    - `outline`: contains all electrodes; the skin's unless given. `minimum_spacing`: of centres, metres; electrodes
      never overlap. `keep_out`: domains that no electrode may overlap.
    - `symmetry`: about the middle of the outline's box. The layout must have an equal share of its electrodes in every
      half (x or y below the middle) or quarter; those of the first are kept, and the others become their images. Take
      several starts: there are fewer ways out of a poor layout.
    - `sizes`: whether to vary the electrodes' sizes too, between half and twice their own, or between two diameters,
      metres.
    - `contact_impedance`: electrodes' are varied too, between two values, ohm·m². `thickness`: that of the sheet is
      varied too, between two values, metres, from the skin's on; its conductance grows with it.
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
        """Raises `ValueError` for an outline, spacing or regions of the wrong type; other checks need a skin."""
        if outline is not None:
            check_kind("outline", outline, Domain, "an outline, such as Rectangle(0.2, 0.2)")
        if not is_number(minimum_spacing):
            raise ValueError(f"minimum_spacing must be a length in metres; it is {describe(minimum_spacing)}.")
        wanted = "a list of domains, such as [Disk(0.01, (0.02, 0.0))]"
        check_kind("keep_out", keep_out, Sequence, wanted)
        for one in keep_out:
            check_kind("keep_out", one, Domain, wanted)
        self.outline, self.minimum_spacing, self.keep_out = outline, float(minimum_spacing), tuple(keep_out)
        self.symmetry, self.sizes = symmetry, sizes
        self.contact_impedance, self.thickness = contact_impedance, thickness

    def constraints(self, skin: Skin) -> Constraints:
        """Constraints on the layouts of a `skin`. Raises `ValueError` where neither has an outline, and for an invalid
        spacing."""
        if isinstance(skin.layout, SurfaceLayout):
            raise ValueError("skin is curved; move its electrodes with jeit.design.optimise_surface_layout.")
        outline = skin.layout.outline if self.outline is None else self.outline
        if outline is None:
            raise ValueError(
                "outline: the layout does not know that of its skin; give one, such as Rectangle(0.2, 0.2)."
            )
        return Constraints(outline, self.minimum_spacing, self.keep_out)

    def variables(self, skin: Skin, constraints: Constraints, depth: float) -> Variables:
        """Variables of the layouts, starting from that of a `skin`, whose touches are `depth` metres deep. Raises
        `ValueError` for impossible settings."""
        options = {"sizes": self.sizes, "contacts": self.contact_impedance, "thickness": self.thickness}
        outline = constraints.outline
        variables = Variables.create(outline, varied_of(skin), symmetry=self.symmetry, **options)
        if self.thickness is not None:
            _check_thickness(self.thickness, depth, outline)
        constraints.check_room(variables.smallest)
        return variables


def varied_of(skin: Skin) -> Varied:
    """The parameters of a sheet that an optimisation may vary, with their present values."""
    discs = skin.model.electrodes
    contact_impedance = discs.contact_impedance  # pyright: ignore[reportAttributeAccessIssue]
    return Varied(skin.layout.centres, skin.layout.diameters / 2, contact_impedance, jnp.asarray(skin.thickness, float))


def _check_thickness(thickness: tuple[float, float], depth: float, outline: Domain) -> None:
    if np.min(thickness) <= depth:
        raise ValueError(f"thickness: the touches are {1e3 * depth:.3g} mm deep; let the sheet be thicker.")
    check_metres("thickness", np.max(thickness), longer_side(outline), "the skin is wide")
