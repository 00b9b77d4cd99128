"""Two layouts of a skin side by side, as in text S4 of Park et al. 2022: sensitivity, blind spots, virtual taxels."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jeit.design.indentation import AbstractIndentation, Bell
from jeit.design.selection import nearest_pairs
from jeit.design.sensitivity import SensitivityMap, TouchGrid, sensitivity_map, touch_grid
from jeit.design.taxels import Taxels, find_taxels
from jeit.electrodes import FaceDiscs, Layout
from jeit.forward import ForwardModel
from jeit.mesh import Disk, Domain, Mesh, Rectangle, disk, layer, polygon, rectangle
from jeit.protocol import two_terminal

# Of a hydrogel's electrodes, ohm·m², where a layout does not say.
_CONTACT_IMPEDANCE = 1e-4
# Of a layer of cells, times a touch's depth: the middle of its uppermost cells is a quarter of it below the surface.
_THICKEST = 3.0
# Of cells, times the smallest diameter of electrodes.
_COARSEST = 1.5


class Felt(eqx.Module):
    """What a skin of one `layout` feels: its `sensitivity`, and its `taxels`."""

    layout: Layout
    sensitivity: SensitivityMap
    taxels: Taxels


def touches_away_from_the_edge(outline: Domain, margin: float, columns: int = 48, rows: int = 48) -> TouchGrid:
    """The places of `touch_grid` whose touches reach over no edge: farther than `margin` (metres) from the outline."""
    grid = touch_grid(outline, columns, rows)
    offsets = margin * np.array([[np.cos(a), np.sin(a)] for a in np.linspace(0, 2 * np.pi, 16, endpoint=False)])
    kept = np.all([np.asarray(outline.contains(grid.places + offset)) for offset in offsets], axis=0)
    if not kept.any():
        raise ValueError(f"margin is {1e3 * margin:g} mm: no place of the skin is so far from its edge; give less.")
    return TouchGrid(grid.places[kept], grid.rows[kept], grid.columns[kept], grid.shape, grid.pitch)


def feel(
    layout: Layout,
    grid: TouchGrid,
    *,
    key: Array,
    thickness: float = 10e-3,
    conductivity: float = 1.0,
    cell_size: float = 4.5e-3,
    num_layers: int = 5,
    num_pairs: int | None = 94,
    current: float = 1e-3,
    indentation: AbstractIndentation | None = None,
    num_taxels: int = 90,
    threshold: float = 0.7,
) -> Felt:
    """Touch a layer with `layout` on its bottom, at every place of `grid`, insulating and one at a time.

    `thickness` and `cell_size` in metres, `conductivity` in S/m, `current` in amperes. `num_pairs`: two-terminal
    measurements, of the electrodes nearest to each other; None for all pairs. `key`: for the taxels' k-means.
    Raises `ValueError` for a layout without an outline, more pairs or taxels than there are pairs or places, a layer
    that is thinner than touches are deep or so thick that they change no cell, and electrodes too small for the mesh.
    """
    outline = layout.skin
    indentation = Bell() if indentation is None else indentation
    pairs = layout.num_electrodes * (layout.num_electrodes - 1) // 2
    number = pairs if num_pairs is None else num_pairs
    if not 1 <= number <= pairs:
        raise ValueError(
            f"num_pairs is {number}; '{layout.name}' has {layout.num_electrodes} electrodes, and they make {pairs} "
            "pairs; give so many or fewer."
        )
    if not 1 <= num_taxels <= len(grid.places):
        raise ValueError(f"num_taxels is {num_taxels}; give from 1 to the {len(grid.places)} places touched.")
    deepest = float(indentation.depth_at(jnp.asarray(0.0)))
    most = _THICKEST * num_layers * deepest
    if not deepest < thickness <= most:
        raise ValueError(
            f"thickness is {1e3 * thickness:g} mm; give more than the {1e3 * deepest:g} mm that a touch is deep, and "
            f"no more than {1e3 * most:g} mm, where {num_layers} layers of cells become too coarse for it."
        )
    smallest = float(np.min(layout.diameters))
    if not 0 < cell_size <= _COARSEST * smallest:
        raise ValueError(
            f"cell_size is {1e3 * cell_size:g} mm; give no more than {1e3 * _COARSEST * smallest:.3g} mm, as "
            f"electrodes of '{layout.name}' are {1e3 * smallest:.3g} mm across."
        )
    mesh = layer(_plane(outline, cell_size), thickness, num_layers)
    centres = np.asarray(layout.centres)
    impedance = _CONTACT_IMPEDANCE if layout.contact_impedance is None else layout.contact_impedance
    electrodes = FaceDiscs(np.column_stack([centres, np.zeros(len(centres))]), layout.diameters / 2, impedance)
    everything = two_terminal(layout.num_electrodes, current=current)
    model = ForwardModel(mesh, electrodes, everything.subset(np.sort(nearest_pairs(centres, number))))
    sensitivity = sensitivity_map(model, conductivity, grid, indentation=indentation)
    taxels = find_taxels(
        sensitivity.changes,
        grid.places,
        grid.cell_area,
        num_taxels=num_taxels,
        threshold=threshold,
        key=key,
    )
    return Felt(layout, sensitivity, taxels)


def comparison(one: Felt, other: Felt) -> list[dict]:
    """What is told of each of two layouts, as plain numbers.

    `sensitivity_…_V`; `blind_spot_fraction`, the share of the area that is less sensitive than the other's least
    sensitive place; `taxel_count`, those of any area, and `taxel_area_cm2`; `taxel_overlap`, how many cover a place in
    the mean; `two_point_mm`, their mean diameter.
    """
    return [_told(*pair) for pair in ((one, other), (other, one))]


def _told(felt: Felt, other: Felt) -> dict:
    theta, taxels = felt.sensitivity, felt.taxels
    areas = 1e4 * np.asarray(taxels.areas)
    return {
        "layout": felt.layout.name,
        "electrodes": felt.layout.num_electrodes,
        "measurements": theta.changes.shape[1],
        "sensitivity_min_V": float(theta.minimum),
        "sensitivity_mean_V": float(theta.mean),
        "sensitivity_uniformity": float(theta.uniformity),
        "blind_spot_fraction": float(theta.blind_spot(other.sensitivity.minimum)),
        "taxel_count": int((areas > 0).sum()),
        "taxel_area_cm2": {"mean": float(areas.mean()), "std": float(areas.std()), "max": float(areas.max())},
        "taxel_overlap": float(taxels.overlap),
        "two_point_mm": 1e3 * float(taxels.two_point_discrimination),
    }


def _plane(outline: Domain, cell_size: float) -> Mesh:
    if isinstance(outline, Disk):
        return disk(outline.radius, cell_size=cell_size, centre=outline.centre)
    if isinstance(outline, Rectangle):
        return rectangle(outline.width, outline.height, cell_size=cell_size, centre=outline.centre)
    return polygon(outline.vertices, holes=getattr(outline, "holes", ()), cell_size=cell_size)
