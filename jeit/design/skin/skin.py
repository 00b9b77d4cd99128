"""`Skin`: a layout of electrodes in a sheet or on the bottom of a layer, flat or curved, with its mesh and touches."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, check_metres
from jeit.design.defaults import CELL_SIZE, CONDUCTIVITY, CONTACT_IMPEDANCE, CONTRAST, NUM_LAYERS, THICKNESS
from jeit.design.skin.cell_size import check_cell_size, smallest_diameter
from jeit.design.skin.indentation import AbstractIndentation, Bell
from jeit.design.skin.protocol import skin_protocol
from jeit.design.skin.reached_cells import touched_surface
from jeit.design.skin.sheet_touches import SheetTouches, sheet_touches
from jeit.design.skin.touched_cells import TouchedCells, touched_cells
from jeit.design.skin.voltage_changes import touch_changes
from jeit.electrodes import FaceDiscs, SheetDiscs, SurfaceDiscs
from jeit.forward import ForwardModel
from jeit.forward.system import check_conductivity
from jeit.layout import Layout, SurfaceLayout
from jeit.layout.surface_layout import check_layout, flat_layout
from jeit.mesh import Domain, Mesh, Rectangle, layer, shell
from jeit.mesh.geodesic import Triangles
from jeit.protocol import Protocol
from jeit_solvers.engines import host

# Thickness of a layer of cells, relative to a touch's depth: centroids of the uppermost are a quarter of it deep.
_THICKEST = 3.0


class Skin(eqx.Module):
    """A skin of one layout: disc electrodes in a sheet, or on the bottom of a layer that is touched on its top.

    With a `SurfaceLayout` the sheet or the layer is curved; touched positions are (n, 3), on its surface, and all else
    is the same.

    **Fields**

    - `layout`: of the electrodes, with the skin's outline, or its surface.
    - `model`: its forward model: mesh, electrodes and protocol.
    - `thickness`: metres; for a sheet, that of the layer which it represents.
    - `conductivity`: of the material, S/m, one number or one for each cell.
    - `num_layers`: number of layers of cells; 0 for a sheet.
    - `cell_size`: metres, of the plane mesh, if it was given.

    Create it with `Skin.create`, which checks the arguments and makes the mesh; or from a custom `model` of
    `SheetDiscs` (`SurfaceDiscs` on a curved sheet) or `FaceDiscs`.
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
        """Raises `ValueError` for a model of other electrodes, or of another dimension."""
        sheet = SurfaceDiscs if isinstance(layout, SurfaceLayout) else SheetDiscs
        wanted = FaceDiscs if num_layers else sheet
        if not isinstance(model.electrodes, wanted):
            raise ValueError(
                f"model has {type(model.electrodes).__name__}; a {'layer' if num_layers else 'sheet'} has "
                f"{wanted.__name__}, such as those of Skin.create."
            )
        if model.electrodes.num_electrodes != layout.num_electrodes:
            raise ValueError(
                f"layout has {layout.num_electrodes} electrodes and the model {model.electrodes.num_electrodes}; their "
                "number cannot change."
            )
        check_metres("thickness", thickness)
        self.layout, self.model, self.thickness = layout, model, thickness
        self.num_layers, self.cell_size = num_layers, cell_size
        checked = check_conductivity(model.mesh, conductivity)
        self.conductivity = jnp.asarray(conductivity, checked.dtype)

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
        """Create a skin with electrodes of `layout`: check the arguments and make the mesh.

        `thickness` in metres, `conductivity` in S/m. `contact_impedance` of the electrodes, ohm·m²: the layout's unless
        given, and 1e-4 where it does not say. `num_layers` of cells, 0 for a sheet. `cell_size`, metres (4.5e-3), or
        `num_points`, about, of the plane mesh; a `SurfaceLayout` has its own. `protocol`: that of
        `skin_protocol(layout)` unless given.

        Raises `ValueError` for a layout without an outline, a skin thicker than wide, cells too small for any mesh,
        electrodes too small for them, and as `jeit.mesh.shell` does, for a skin thicker than it is curved.
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
        plane = outline.mesh(num_points=num_points, cell_size=cell_size)
        mesh = layer(plane, thickness, num_layers) if num_layers else plane
        _check_electrodes(layout, electrodes, mesh, cell_size, num_points)
        model = ForwardModel(mesh, electrodes, skin_protocol(layout) if protocol is None else protocol)
        layout = eqx.tree_at(lambda one: one.outline, layout, outline)
        options = {"num_layers": num_layers, "cell_size": cell_size}
        return cls(layout, model, thickness=thickness, conductivity=conductivity, **options)

    @property
    def outline(self) -> Domain | Triangles:
        """Outline of the skin, metres; for a curved one the touched surface."""
        if isinstance(self.layout, SurfaceLayout):
            return touched_surface(self.model.mesh, self.touched_face)
        return self.layout.known_outline

    @property
    def flat_outline(self) -> Domain:
        """Outline of a flat skin, metres. Raises `ValueError` for a curved one, which has none."""
        return flat_layout(self.layout).known_outline

    @property
    def touched_face(self) -> str:
        """The touched face of a curved layer: "outer", or "inner" where its electrodes are on the outer one."""
        inward = isinstance(self.layout, SurfaceLayout) and not self.layout.outward
        return "inner" if inward else "outer"

    @property
    def model_conductivity(self) -> Float[Array, "..."]:
        """Conductivity for the forward model: the material's in S/m for a layer, a sheet's in siemens."""
        return model_conductivity(self.conductivity, self.thickness, self.num_layers)

    def with_layout(self, layout: Layout | SurfaceLayout, contact_impedance: ArrayLike | None = None) -> "Skin":
        """The same skin, on the same mesh and with the same protocol, with as many electrodes of another layout.

        `contact_impedance` as in `create`. Raises `ValueError` for electrodes off the mesh or too small for it.
        """
        electrodes, mesh = skin_electrodes(layout, self.num_layers, contact_impedance), self.model.mesh
        if self.cell_size is None or isinstance(layout, SurfaceLayout):
            electrodes.check(mesh)
        else:
            outline = layout.known_outline
            check_cell_size("cell_size", self.cell_size, layout, float(outline.area), self.num_layers)
            _check_electrodes(layout, electrodes, mesh, self.cell_size, None)
        return eqx.tree_at(lambda one: (one.layout, one.model), self, (layout, self.model.with_electrodes(electrodes)))

    def touched_cells(
        self, places: ArrayLike, indentation: AbstractIndentation | None = None, *, contrast: float = CONTRAST
    ) -> TouchedCells:
        """Conductivity changes by single touches at `places` (n, 2), on a curved skin (n, 3), metres; the indentation
        is `Bell` unless given, as in `touched_cells`.

        Raises `ValueError` for touches as deep as the skin, for a touch that changes no cell, as where a layer has too
        few layers of cells, and for a contrast that changes nothing.
        """
        indentation = Bell() if indentation is None else indentation
        if not self.num_layers:
            return touched_cells(
                self.model.mesh, indentation, places, thickness=float(self.thickness), contrast=contrast
            )
        deepest = float(indentation.depth_at(host.zeros(())))
        most = _THICKEST * self.num_layers * deepest
        said = (
            f"thickness is {1e3 * self.thickness:g} mm; give more than the {1e3 * deepest:g} mm that a touch is deep, "
            f"and no more than {1e3 * most:g} mm, where {self.num_layers} layers of cells become too coarse for it"
        )
        if deepest >= self.thickness:
            raise ValueError(f"{said}.")
        try:
            return touched_cells(self.model.mesh, indentation, places, contrast=contrast, face=self.touched_face)
        except ValueError as error:
            if self.thickness > most:
                raise ValueError(f"{said}: {error}") from None
            raise

    def sheet_touches(
        self, places: ArrayLike, indentation: AbstractIndentation | None = None, *, contrast: float = CONTRAST
    ) -> SheetTouches:
        """Touches of a sheet, with derivatives in the positions. Raises `ValueError` as `sheet_touches` does."""
        indentation = Bell() if indentation is None else indentation
        return sheet_touches(self.model.mesh, indentation, places, thickness=float(self.thickness), contrast=contrast)

    def voltage_changes(self, touched: TouchedCells, *, linear: bool = False) -> Float[Array, "n M"]:
        """Changes (n, M) of the voltages by touches, volts: exact, or linear; errors and limits as in
        `touch_changes`."""
        return touch_changes(self.model, self.model_conductivity, touched, linear=linear)


def skins_of(layouts: Sequence[Layout | SurfaceLayout], protocols: Sequence[Protocol], **options) -> list[Skin]:
    """Create skins from layouts and their protocols, with `options` of `Skin.create`, whose errors it raises.
    Consecutive layouts with the same outline and number of electrodes share one mesh and the plan of its
    factorisation."""
    made: list[Skin] = []
    for layout, protocol in zip(layouts, protocols, strict=True):
        if made and _serves(made[-1], layout):
            moved = made[-1].with_layout(layout, options.get("contact_impedance"))
            made.append(eqx.tree_at(lambda one: one.model, moved, moved.model.with_protocol(protocol)))
        else:
            made.append(Skin.create(layout, protocol=protocol, **options))
    return made


def _serves(skin: Skin, layout: Layout | SurfaceLayout) -> bool:
    """Whether the mesh of a skin can be used for a layout too."""
    if isinstance(layout, SurfaceLayout):
        own = skin.layout
        if not isinstance(own, SurfaceLayout) or own.outward != layout.outward or not _as_many(skin, layout):
            return False
        return bool(eqx.tree_equal(own.surface, layout.surface))
    if isinstance(skin.layout, SurfaceLayout):
        return False
    same = eqx.tree_equal(skin.outline, plain_outline(layout.known_outline))
    return bool(same) and _as_many(skin, layout)


def _as_many(skin: Skin, layout: Layout | SurfaceLayout) -> bool:
    return layout.num_electrodes == skin.layout.num_electrodes


def check_skin(name: str, given) -> None:
    """Raise `ValueError`, about the argument `name`, for what is no `Skin`."""
    check_kind(name, given, Skin, "a Skin, as of Skin.create(named_layout('park-inner'))")


def longer_side(outline: Domain | Triangles) -> float:
    """The longer side of an outline's bounding box, metres."""
    if isinstance(outline, Triangles):
        return float(np.ptp(outline.points, axis=0).max())
    low_x, high_x, low_y, high_y = outline.extent
    return float(max(high_x - low_x, high_y - low_y))


def model_conductivity(conductivity, thickness, num_layers: int):
    """Conductivity for a forward model: the material's `conductivity`, S/m, for a layer, a sheet's in siemens."""
    return conductivity if num_layers else conductivity * thickness


def plain_outline(outline: Domain) -> Domain:
    """Replace an outline of four corners by a rectangle if it is one, so that it is meshed as such."""
    if [len(loop) for loop in outline.loops()] != [4]:
        return outline
    low_x, high_x, low_y, high_y = outline.extent
    width, height = high_x - low_x, high_y - low_y
    if abs(width * height - outline.area) > 1e-6 * width * height:
        return outline
    return Rectangle(width, height, ((low_x + high_x) / 2, (low_y + high_y) / 2))


def curved_model(
    layout: SurfaceLayout, thickness: float, num_layers: int, contact_impedance, protocol: Protocol | None
) -> ForwardModel:
    """Create the forward model of a sheet that is the layout's surface, or of a shell of it. Raises `ValueError` as
    `Skin.create` does."""
    surface = layout.surface
    check_metres("thickness", thickness, longer_side(Triangles.of(surface)), "the skin is wide")
    mesh = shell(surface, thickness, num_layers, outward=layout.outward) if num_layers else surface
    electrodes = skin_electrodes(layout, num_layers, contact_impedance)
    return ForwardModel(mesh, electrodes, skin_protocol(layout) if protocol is None else protocol)


def skin_electrodes(
    layout: Layout | SurfaceLayout, num_layers: int, contact_impedance=None
) -> SheetDiscs | SurfaceDiscs | FaceDiscs:
    """Create disc electrodes in a sheet (`num_layers` 0), or on the bottom of a layer. Contact impedance in ohm·m²: the
    layout's unless given, and 1e-4 where it does not say."""
    if contact_impedance is None and layout.contact_impedance is None:
        contact_impedance = CONTACT_IMPEDANCE
    if isinstance(layout, SurfaceLayout):
        return layout.discs(contact_impedance, sheet=not num_layers)
    discs = layout.sheet_discs(contact_impedance)
    if not num_layers:
        return discs
    centres = np.asarray(discs.position)
    return FaceDiscs(np.column_stack([centres, np.zeros(len(centres))]), discs.radius, discs.contact_impedance)


def _check_electrodes(layout: Layout, electrodes, mesh: Mesh, cell_size: float | None, num_points: int | None) -> None:
    try:
        electrodes.check(mesh)
    except ValueError:
        across = f"{1e3 * smallest_diameter(layout):.3g} mm across"
        if num_points is not None:
            said = f"num_points {num_points} makes cells too coarse for electrodes {across}; give more."
        else:
            said = (
                f"cell_size is {1e3 * (cell_size or 0):g} mm, too large: electrodes of '{layout.name}' are {across}; "
                "give less."
            )
        raise ValueError(said) from None
