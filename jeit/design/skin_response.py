"""What a skin of one layout feels, as in text S4 of Park et al. 2022: sensitivity and virtual taxels."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.design.measurements.selection import nearest_pairs
from jeit.design.sensitivity import SensitivityMap
from jeit.design.skin.cell_size import check_cell_size
from jeit.design.skin.indentation import AbstractIndentation, Bell
from jeit.design.skin.touch_grid import TouchGrid
from jeit.design.skin.touched_cells import TouchedCells, touched_cells
from jeit.design.skin.voltage_changes import touch_changes
from jeit.design.taxels import Taxels, find_taxels
from jeit.electrodes import FaceDiscs
from jeit.forward import ForwardModel
from jeit.forward.assembly import check_conductivity
from jeit.layout import Layout
from jeit.mesh import Disk, Domain, Mesh, Rectangle, disk, layer, polygon, rectangle
from jeit.protocol import two_terminal

# Of a hydrogel's electrodes, ohm·m², where a layout does not say.
_CONTACT_IMPEDANCE = 1e-4
# Of a layer of cells, times a touch's depth: the middle of its uppermost cells is a quarter of it below the surface.
_THICKEST = 3.0
# Of cells, times the smallest diameter of electrodes.
_COARSEST = 1.5


class SkinResponse(eqx.Module):
    """What a skin of one `layout` feels: its `sensitivity`, and its `taxels`."""

    layout: Layout
    sensitivity: SensitivityMap
    taxels: Taxels


class TouchedSkin(eqx.Module):
    """A layer with a layout on its bottom, checked and meshed, to be touched at every place of a grid.

    **Fields**: `layout`; `grid`; `model`; `conductivity` of its cells, S/m; `touched`, what the touches change;
    `num_taxels` and `threshold`, as in `find_taxels`. Make it with `TouchedSkin.create`.
    """

    layout: Layout
    grid: TouchGrid
    model: ForwardModel
    conductivity: Float[Array, "..."]
    touched: TouchedCells
    num_taxels: int = eqx.field(static=True)
    threshold: float = eqx.field(static=True)

    @classmethod
    def create(
        cls,
        layout: Layout,
        grid: TouchGrid,
        *,
        thickness: float = 10e-3,
        conductivity: float = 1.0,
        cell_size: float = 4.5e-3,
        num_layers: int = 5,
        num_pairs: int | None = 94,
        current: float = 1e-3,
        indentation: AbstractIndentation | None = None,
        contrast: float = 0.0,
        num_taxels: int = 90,
        threshold: float = 0.7,
    ) -> "TouchedSkin":
        """Check and mesh a layer with `layout` on its bottom.

        `thickness` and `cell_size` in metres, `conductivity` in S/m, `current` in amperes. `contrast`: of the indented
        part's conductivity, as in `touched_cells`: 0 for an insulator, above 1 for a conductor. `num_pairs`:
        two-terminal measurements, of the electrodes nearest to each other; None for all pairs.

        Raises `ValueError` for a layout without an outline, more pairs or taxels than there are pairs or places, a
        layer that is thinner than touches are deep or so thick that they change no cell, a contrast that changes
        nothing, cells too small for any mesh, and electrodes too small for them.
        """
        outline = layout.known_outline
        indentation = Bell() if indentation is None else indentation
        number = _number_of_pairs(layout, num_pairs)
        if not 1 <= num_taxels <= len(grid.places):
            raise ValueError(f"num_taxels is {num_taxels}; give from 1 to the {len(grid.places)} places touched.")
        _check_thickness(thickness, num_layers, indentation)
        smallest = 1e3 * float(np.min(layout.diameters))
        across = f"electrodes of '{layout.name}' are {smallest:.3g} mm across"
        if not 0 < 1e3 * cell_size <= (1 + 1e-9) * _COARSEST * smallest:
            raise ValueError(
                f"cell_size is {1e3 * cell_size:g} mm; give no more than {_COARSEST * smallest:.3g} mm, as {across}."
            )
        check_cell_size("cell_size", cell_size, float(outline.area), num_layers)
        mesh = layer(_plane(outline, cell_size), thickness, num_layers)
        centres = np.asarray(layout.centres)
        impedance = _CONTACT_IMPEDANCE if layout.contact_impedance is None else layout.contact_impedance
        electrodes = FaceDiscs(np.column_stack([centres, np.zeros(len(centres))]), layout.diameters / 2, impedance)
        try:
            electrodes.check(mesh)
        except ValueError:
            raise ValueError(f"cell_size is {1e3 * cell_size:g} mm, too large: {across}; give less.") from None
        everything = two_terminal(layout.num_electrodes, current=current)
        model = ForwardModel(mesh, electrodes, everything.subset(np.sort(nearest_pairs(centres, number))))
        touched = touched_cells(mesh, indentation, grid.places, contrast=contrast)
        return cls(layout, grid, model, check_conductivity(mesh, conductivity), touched, num_taxels, threshold)

    def feel(self, key: Array) -> SkinResponse:
        """Touch it, one place at a time; `key`: for the taxels' k-means."""
        sensitivity = SensitivityMap(self.grid, touch_changes(self.model, self.conductivity, self.touched))
        taxels = find_taxels(
            sensitivity.changes,
            self.grid.places,
            self.grid.cell_area,
            num_taxels=self.num_taxels,
            threshold=self.threshold,
            key=key,
        )
        return SkinResponse(self.layout, sensitivity, taxels)


def feel(layout: Layout, grid: TouchGrid, *, key: Array, **options: Any) -> SkinResponse:
    """Touch a layer with `layout` on its bottom, at every place of `grid`, one at a time.

    `key`: for the taxels' k-means. `options`, with their units and errors: those of `TouchedSkin.create`.
    """
    return TouchedSkin.create(layout, grid, **options).feel(key)


def _number_of_pairs(layout: Layout, num_pairs: int | None) -> int:
    pairs = layout.num_electrodes * (layout.num_electrodes - 1) // 2
    number = pairs if num_pairs is None else num_pairs
    if not 1 <= number <= pairs:
        raise ValueError(
            f"num_pairs is {number}; '{layout.name}' has {layout.num_electrodes} electrodes, and they make {pairs} "
            "pairs; give so many or fewer."
        )
    return number


def _check_thickness(thickness: float, num_layers: int, indentation: AbstractIndentation) -> None:
    deepest = float(indentation.depth_at(jnp.asarray(0.0)))
    most = _THICKEST * num_layers * deepest
    if not deepest < thickness <= most:
        raise ValueError(
            f"thickness is {1e3 * thickness:g} mm; give more than the {1e3 * deepest:g} mm that a touch is deep, and "
            f"no more than {1e3 * most:g} mm, where {num_layers} layers of cells become too coarse for it."
        )


def _plane(outline: Domain, cell_size: float) -> Mesh:
    if isinstance(outline, Disk):
        return disk(outline.radius, cell_size=cell_size, centre=outline.centre)
    if isinstance(outline, Rectangle):
        return rectangle(outline.width, outline.height, cell_size=cell_size, centre=outline.centre)
    return polygon(outline.vertices, holes=getattr(outline, "holes", ()), cell_size=cell_size)
