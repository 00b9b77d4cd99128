"""`Skin`: electrodes in a sheet or on the bottom of a layer, flat or curved, with the mesh and the touches."""

from __future__ import annotations

import math
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.arguments import MILLIMETRE_HINT, check_kind, check_metres, object_html, object_text, picture
from jeit.design.defaults import CELL_SIZE, CONDUCTIVITY, CONTACT_IMPEDANCE, CONTRAST, NUM_LAYERS, THICKNESS
from jeit.design.skin.names import skin_protocol
from jeit.design.skin.sheet_touches import SheetTouches, sheet_touches
from jeit.design.skin.touch_shapes import AbstractIndentation, Bell
from jeit.design.skin.touched_cells import TouchedCells, touched_cells, touched_surface
from jeit.design.skin.voltage_changes import touch_changes
from jeit.electrodes import FaceDiscs, SheetDiscs, SurfaceDiscs
from jeit.forward import ForwardModel
from jeit.forward.system import check_conductivity
from jeit.layout import Layout, SurfaceLayout
from jeit.layout.surface_layout import check_layout, flat_layout
from jeit.mesh import Domain, Mesh, Rectangle, layer, shell
from jeit.mesh.generate.unstructured import MAX_POINTS
from jeit.mesh.geodesic import Triangles
from jeit.protocol import Protocol
from jeit_solvers.engines import host, on_host, values_at_once
from jeit_solvers.module import Module

# Number of nodes of a plane mesh times (cell size)² / area: 1.155 for equilateral cells, and slightly more due to the
# nodes on the edge.
_NUM_NODES_PER_CELL_AREA = 1.2
# Maximum cell size, relative to the smallest electrode diameter.
_MAX_CELL_SIZE_RATIO = 1.5

# Maximum thickness of a layer of cells, relative to the depth of a touch: the uppermost centroids are a quarter of the
# layer's thickness below the surface.
_MAX_LAYER_THICKNESS_RATIO = 3.0


class Skin(Module):
    """A tactile skin: disc electrodes in a sheet, or on the bottom of a layer that is touched on its top.

    With a `SurfaceLayout` the sheet or the layer is curved, and touched positions are points (n, 3) on its surface.

    **Fields**

    - `layout`: layout of the electrodes, with the outline of a flat skin, or the surface of a curved skin.
    - `model`: forward model of the skin, with mesh, electrodes and protocol.
    - `thickness`: thickness of the skin, metres; for a sheet, thickness of the layer that the sheet represents.
    - `conductivity`: conductivity of the material, S/m, one value or one for each cell.
    - `num_layers`: number of layers of mesh cells; 0 for a sheet.
    - `cell_size`: cell size of the plane mesh, metres; None if no size was specified.

    Create a skin with `Skin.create`, which checks the arguments and creates the mesh, or from a custom `model` with
    electrodes of class `SheetDiscs` (`SurfaceDiscs` on a curved sheet) or `FaceDiscs`.

    **Example:**

    ```python
    skin = Skin.create(layout, thickness=0.01, num_layers=2, cell_size=0.008)
    changes = skin.voltage_changes(skin.touched_cells([(0.0, 0.0)], Bell(2e-3)))
    ```
    """

    layout: Layout | SurfaceLayout
    model: ForwardModel
    thickness: float
    conductivity: Float[Array, "..."]
    num_layers: int = eqx.field(static=True)
    cell_size: float | None = eqx.field(static=True)

    def __init__(
        self,
        layout: Layout | SurfaceLayout,
        model: ForwardModel,
        *,
        thickness: float,
        conductivity: ArrayLike,
        num_layers: int = 0,
        cell_size: float | None = None,
    ):
        """Raises `ValueError` for a model whose electrodes have the wrong class or number, and for an invalid thickness
        or conductivity."""
        sheet_class = SurfaceDiscs if isinstance(layout, SurfaceLayout) else SheetDiscs
        electrode_class = FaceDiscs if num_layers else sheet_class
        if not isinstance(model.electrodes, electrode_class):
            raise ValueError(
                f"model has {type(model.electrodes).__name__}; a {'layer' if num_layers else 'sheet'} has "
                f"{electrode_class.__name__}, such as those of Skin.create."
            )
        if model.electrodes.num_electrodes != layout.num_electrodes:
            raise ValueError(
                f"layout has {layout.num_electrodes} electrodes and the model {model.electrodes.num_electrodes}; their "
                "number cannot change."
            )
        check_metres("thickness", thickness)
        self.layout, self.model, self.thickness = layout, model, thickness
        self.num_layers, self.cell_size = num_layers, cell_size
        checked_conductivity = check_conductivity(model.mesh, conductivity)
        self.conductivity = jnp.asarray(conductivity, checked_conductivity.dtype)

    def __repr__(self) -> str:
        return object_text(
            lambda: f"Skin({self.layout!r},\n  {self.model!r})",
            self,
        )

    def _repr_png_(self) -> bytes | None:
        return picture(self)

    def _repr_html_(self) -> str | None:
        return object_html(self)

    @classmethod
    def create(
        cls,
        layout: Layout | SurfaceLayout,
        *,
        thickness: float = THICKNESS,
        conductivity: ArrayLike = CONDUCTIVITY,
        contact_impedance: ArrayLike | None = None,
        num_layers: int = NUM_LAYERS,
        cell_size: float | None = None,
        num_points: int | None = None,
        protocol: Protocol | None = None,
    ) -> "Skin":
        """Create a skin with electrodes of `layout`: check the arguments and create the mesh.

        - `thickness`: thickness of the skin, metres; `conductivity`: conductivity of the material, S/m.
        - `contact_impedance`: contact impedance of the electrodes, ohm·m²; by default that of the layout, or 1e-4 if
          the layout has none.
        - `num_layers`: number of layers of cells, 0 for a sheet.
        - `cell_size`: cell size of the plane mesh, metres (default 4.5e-3), or `num_points`: approximate number of
          nodes of the mesh. Neither is given for a `SurfaceLayout`, whose surface is a mesh already.
        - `protocol`: measurement protocol, by default `skin_protocol(layout)`.

        Raises `ValueError` for a layout without an outline, a skin that is thicker than wide, cells so small that the
        mesh would have too many nodes, electrodes too small for the cells, and a curved skin that is thicker than its
        radius of curvature.
        """
        check_layout("layout", layout)
        if isinstance(layout, SurfaceLayout):
            if cell_size is not None or num_points is not None:
                raise ValueError(
                    "cell_size and num_points are of flat skins; a SurfaceLayout's surface is a mesh already."
                )
            model = curved_model(layout, thickness, num_layers, contact_impedance, protocol)
            return cls(layout, model, thickness=thickness, conductivity=conductivity, num_layers=num_layers)
        outline = plain_outline(layout.known_outline)
        check_metres("thickness", thickness, longer_side(outline), "the skin is wide")
        if cell_size is None and num_points is None:
            cell_size = CELL_SIZE
        if cell_size is not None:
            check_cell_size("cell_size", cell_size, layout, float(outline.area), num_layers)
        electrodes = skin_electrodes(layout, num_layers, contact_impedance)
        plane_mesh = outline.mesh(num_points=num_points, cell_size=cell_size)
        mesh = layer(plane_mesh, thickness, num_layers) if num_layers else plane_mesh
        _check_electrodes(layout, electrodes, mesh, cell_size, num_points)
        model = ForwardModel(mesh, electrodes, skin_protocol(layout) if protocol is None else protocol)
        layout = eqx.tree_at(lambda layout_to_change: layout_to_change.outline, layout, outline)
        skin_options = {"num_layers": num_layers, "cell_size": cell_size}
        return cls(layout, model, thickness=thickness, conductivity=conductivity, **skin_options)

    @property
    def outline(self) -> Domain | Triangles:
        """Outline of the skin, metres; for a curved skin, the touched surface."""
        if isinstance(self.layout, SurfaceLayout):
            return touched_surface(self.model.mesh, self.touched_face)
        return self.layout.known_outline

    @property
    def flat_outline(self) -> Domain:
        """Outline of a flat skin, metres. Raises `ValueError` for a curved skin."""
        return flat_layout(self.layout).known_outline

    @property
    def touched_face(self) -> str:
        """The touched face of a curved layer: "outer", or "inner" if the electrodes are on the outer face."""
        is_touched_on_inside = isinstance(self.layout, SurfaceLayout) and not self.layout.outward
        return "inner" if is_touched_on_inside else "outer"

    @property
    def model_conductivity(self) -> Float[Array, "..."]:
        """Conductivity for the forward model: conductivity of the material in S/m for a layer, sheet conductivity in
        siemens for a sheet."""
        return model_conductivity(self.conductivity, self.thickness, self.num_layers)

    def with_layout(self, layout: Layout | SurfaceLayout, contact_impedance: ArrayLike | None = None) -> "Skin":
        """Return the skin with the electrodes of a different `layout`, which has the same number of electrodes; mesh
        and protocol are unchanged.

        `contact_impedance` as in `create`. Raises `ValueError` for electrodes outside the mesh or too small for its
        cells.
        """
        electrodes, mesh = skin_electrodes(layout, self.num_layers, contact_impedance), self.model.mesh
        if self.cell_size is None or isinstance(layout, SurfaceLayout):
            electrodes.check(mesh)
        else:
            outline = layout.known_outline
            check_cell_size("cell_size", self.cell_size, layout, float(outline.area), self.num_layers)
            _check_electrodes(layout, electrodes, mesh, self.cell_size, None)
        return eqx.tree_at(
            lambda skin_to_change: (skin_to_change.layout, skin_to_change.model),
            self,
            (layout, self.model.with_electrodes(electrodes)),
        )

    def touched_cells(
        self, places: ArrayLike, indentation: AbstractIndentation | None = None, *, contrast: float = CONTRAST
    ) -> TouchedCells:
        """Compute the conductivity changes due to single touches at `places` (n, 2), on a curved skin (n, 3), metres.

        `indentation`: shape of the touches, by default `Bell()`; `contrast`: as in the function `touched_cells`. Raises
        `ValueError` for touches as deep as the skin, for a touch that changes no cell (for instance with too few layers
        of cells), and for a contrast of 1, which changes no conductivity.
        """
        indentation = Bell() if indentation is None else indentation
        if not self.num_layers:
            return touched_cells(
                self.model.mesh, indentation, places, thickness=float(self.thickness), contrast=contrast
            )
        max_depth = float(indentation.depth_at(host.zeros(())))
        max_meshed_thickness = _MAX_LAYER_THICKNESS_RATIO * self.num_layers * max_depth
        thickness_text = (
            f"thickness is {1e3 * self.thickness:g} mm; give more than the {1e3 * max_depth:g} mm that a touch is "
            f"deep, and no more than {1e3 * max_meshed_thickness:g} mm, where {self.num_layers} layers of cells become "
            "too coarse for it"
        )
        if max_depth >= self.thickness:
            raise ValueError(f"{thickness_text}.")
        try:
            return touched_cells(self.model.mesh, indentation, places, contrast=contrast, face=self.touched_face)
        except ValueError as error:
            if self.thickness > max_meshed_thickness:
                raise ValueError(f"{thickness_text}: {error}") from None
            raise

    def sheet_touches(
        self, places: ArrayLike, indentation: AbstractIndentation | None = None, *, contrast: float = CONTRAST
    ) -> SheetTouches:
        """Compute touches of a sheet, with derivatives with respect to the touched positions; arguments as in
        `touched_cells`. Raises `ValueError` as the function `sheet_touches` does."""
        indentation = Bell() if indentation is None else indentation
        return sheet_touches(self.model.mesh, indentation, places, thickness=float(self.thickness), contrast=contrast)

    def voltage_changes(self, touched: TouchedCells, *, linear: bool = False) -> Float[Array, "n M"]:
        """Compute the voltage changes (n, M) of M channels due to n touches, volts: exact, or linearised if `linear`.
        Errors and limits are those of `touch_changes`."""
        return touch_changes(self.model, self.model_conductivity, touched, linear=linear)


def create_skins(layouts: Sequence[Layout | SurfaceLayout], protocols: Sequence[Protocol], **options) -> list[Skin]:
    """Create one skin for each layout and its protocol, with `options` of `Skin.create`. Consecutive layouts with the
    same outline and number of electrodes share one mesh and the symbolic factorisation of its system matrix. Raises the
    errors of `Skin.create`."""
    skins: list[Skin] = []
    for layout, protocol in zip(layouts, protocols, strict=True):
        if skins and _can_share_mesh(skins[-1], layout):
            skin_with_layout = skins[-1].with_layout(layout, options.get("contact_impedance"))
            skins.append(
                eqx.tree_at(
                    lambda skin_to_change: skin_to_change.model,
                    skin_with_layout,
                    skin_with_layout.model.with_protocol(protocol),
                )
            )
        else:
            skins.append(Skin.create(layout, protocol=protocol, **options))
    return skins


def _can_share_mesh(skin: Skin, layout: Layout | SurfaceLayout) -> bool:
    """Whether the mesh of a skin can also be used for `layout`."""
    skin_layout = skin.layout
    if skin_layout.num_electrodes != layout.num_electrodes:
        return False
    if isinstance(layout, SurfaceLayout):
        return (
            isinstance(skin_layout, SurfaceLayout)
            and skin_layout.outward == layout.outward
            and bool(eqx.tree_equal(on_host(skin_layout.surface), on_host(layout.surface)))
        )
    # The outline of a curved skin is another kind of object, which equals no outline of a flat skin.
    return bool(eqx.tree_equal(on_host(skin.outline), on_host(plain_outline(layout.known_outline))))


def check_skin(name: str, skin) -> None:
    """Raise `ValueError` unless `skin` is a `Skin`; `name` is the argument's name in the message."""
    check_kind(name, skin, Skin, "a Skin, as of Skin.create(named_layout('park-inner'))")


def longer_side(outline: Domain | Triangles) -> float:
    """Longest side of the bounding box of an outline, metres."""
    if isinstance(outline, Triangles):
        return float(np.ptp(outline.points, axis=0).max())
    low_x, high_x, low_y, high_y = outline.extent
    return float(max(high_x - low_x, high_y - low_y))


@values_at_once
def model_conductivity(conductivity, thickness, num_layers: int):
    """Conductivity for a forward model: for a layer the `conductivity` of the material, S/m; for a sheet this
    conductivity times the thickness, in siemens."""
    return conductivity if num_layers else conductivity * thickness


def plain_outline(outline: Domain) -> Domain:
    """Convert an outline that is an axis-parallel rectangle to a `Rectangle`, so that it is meshed as a rectangle;
    return other outlines unchanged."""
    if [len(boundary_loop) for boundary_loop in outline.loops()] != [4]:
        return outline
    low_x, high_x, low_y, high_y = outline.extent
    outline_width, outline_height = high_x - low_x, high_y - low_y
    if abs(outline_width * outline_height - float(outline.area)) > 1e-6 * outline_width * outline_height:
        return outline
    return Rectangle(outline_width, outline_height, ((low_x + high_x) / 2, (low_y + high_y) / 2))


def curved_model(
    layout: SurfaceLayout, thickness: float, num_layers: int, contact_impedance, protocol: Protocol | None
) -> ForwardModel:
    """Create the forward model of a curved skin: a sheet on the surface of the layout, or a shell if `num_layers` > 0.
    Raises `ValueError` as `Skin.create` does."""
    surface = layout.surface
    check_metres("thickness", thickness, longer_side(Triangles.of(surface)), "the skin is wide")
    mesh = shell(surface, thickness, num_layers, outward=layout.outward) if num_layers else surface
    electrodes = skin_electrodes(layout, num_layers, contact_impedance)
    return ForwardModel(mesh, electrodes, skin_protocol(layout) if protocol is None else protocol)


def skin_electrodes(
    layout: Layout | SurfaceLayout, num_layers: int, contact_impedance=None
) -> SheetDiscs | SurfaceDiscs | FaceDiscs:
    """Create the disc electrodes of a `layout` in a sheet (`num_layers` = 0), or on the bottom of a layer.
    `contact_impedance`: contact impedance in ohm·m², by default that of the layout, or 1e-4 if the layout has none."""
    if contact_impedance is None and layout.contact_impedance is None:
        contact_impedance = CONTACT_IMPEDANCE
    if isinstance(layout, SurfaceLayout):
        return layout.discs(contact_impedance, sheet=not num_layers)
    disc_electrodes = layout.sheet_discs(contact_impedance)
    if not num_layers:
        return disc_electrodes
    electrode_centres = np.asarray(disc_electrodes.position)
    return FaceDiscs(
        np.column_stack([electrode_centres, np.zeros(len(electrode_centres))]),
        disc_electrodes.radius,
        disc_electrodes.contact_impedance,
    )


def _check_electrodes(layout: Layout, electrodes, mesh: Mesh, cell_size: float | None, num_points: int | None) -> None:
    try:
        electrodes.check(mesh)
    except ValueError:
        diameter_text = f"{1e3 * smallest_diameter(layout):.3g} mm across"
        if num_points is not None:
            error_message = f"num_points {num_points} makes cells too coarse for electrodes {diameter_text}; give more."
        else:
            error_message = (
                f"cell_size is {1e3 * (cell_size or 0):g} mm, too large: electrodes of '{layout.name}' are "
                f"{diameter_text}; give less."
            )
        raise ValueError(error_message) from None


def check_cell_size(
    name: str, cell_size: float, layout: Layout | SurfaceLayout, area: float, num_layers: int = 0
) -> None:
    """Raise `ValueError` if cells of size `cell_size` (metres) are too large for the electrodes of `layout`, or if
    there would be too many cells.

    `name`: name of the cell size in the error message; `area`: area of the skin, m²; `num_layers`: number of layers of
    cells, 0 for a sheet.
    """
    check_metres(name, cell_size)
    min_diameter = smallest_diameter(layout)
    max_cell_size = _MAX_CELL_SIZE_RATIO * min_diameter
    if cell_size > (1 + 1e-9) * max_cell_size:
        unit_hint = f"; {MILLIMETRE_HINT}" if cell_size**2 > area else "."
        raise ValueError(
            f"{name} is {1e3 * cell_size:g} mm; give no more than {1e3 * max_cell_size:.3g} mm, as electrodes of "
            f"'{layout.name}' are {1e3 * min_diameter:.3g} mm across{unit_hint}"
        )
    scaled_area = _NUM_NODES_PER_CELL_AREA * area * (num_layers + 1)
    num_nodes = scaled_area / cell_size**2
    if num_nodes > MAX_POINTS:
        min_size_mm = 1.05e3 * math.sqrt(scaled_area / MAX_POINTS)
        raise ValueError(
            f"{name} is {1e3 * cell_size:g} mm, which makes about {num_nodes:.2g} nodes; give {min_size_mm:.2g} mm or "
            "more."
        )


def smallest_diameter(layout: Layout | SurfaceLayout) -> float:
    """Smallest electrode diameter of a layout, metres."""
    return float(np.asarray(layout.diameters).min())
