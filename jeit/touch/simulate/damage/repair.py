"""Repair: a cut that conducts again, about as well as before, in a material with more hysteresis."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, describe, is_number
from jeit.forward.assembly import check_conductivity
from jeit.mesh import Mesh
from jeit.touch.simulate.contact import Material
from jeit.touch.simulate.damage.cut import Cut

# Park et al. (2022), figure S13, show more hysteresis after repair, without a figure: chosen, half as much again.
_MORE = 1.5


def mended(
    mesh: Mesh, conductivity: ArrayLike, cut: Cut, material: Material, share: float = 1.0
) -> tuple[Float[np.ndarray, " m"], Material]:
    """Conductivity (m,) of a skin whose cut was glued, S/m (2-D: S), and its material.

    `conductivity` of the skin before the cut, of which what was cut has `share` again, about 0.9 to 1.1; the material
    has half as much hysteresis again. Raises `ValueError` for what is no cut, material or share, and as `Cut.cells`.
    """
    check_kind("cut", cut, Cut, "the Cut that was mended")
    check_kind("material", material, Material, 'a Material, such as material("hydrogel")')
    if not (is_number(share) and share > 0):
        raise ValueError(f"share must be positive, about 0.9 to 1.1; it is {describe(share)}.")
    values = np.array(np.broadcast_to(np.asarray(check_conductivity(mesh, conductivity)), mesh.num_cells), float)
    values[cut.cells(mesh)] *= share
    return values, dataclasses.replace(material, hysteresis=min(0.9, _MORE * material.hysteresis))
