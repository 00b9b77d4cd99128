"""Shapes of touches (depth of the indentation as a function of the distance from the centre), and grids of touched
positions (centres of equal rectangles over a skin)."""

from __future__ import annotations

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jeit.arguments import check_kind, describe
from jeit.design.defaults import BALL_DIAMETER, DEPTH, DEVIATION, NUM_PLACES_PER_SIDE
from jeit.layout import spread
from jeit.mesh import Domain
from jeit.mesh.geodesic import Triangles
from jeit.mesh.outline.domain import check_length
from jeit_solvers.engines import namespace, numpy_or_compiled
from jeit_solvers.module import Module


class AbstractIndentation(Module):
    """Base class of indentations of a skin; a new indentation is a subclass."""

    @abc.abstractmethod
    def depth_at(self, distance: Float[Array | np.ndarray, "..."]) -> Float[Array | np.ndarray, "..."]:
        """Depth in metres at horizontal distances (metres) from the centre."""

    @property
    @abc.abstractmethod
    def reach(self) -> float:
        """Distance in metres from the centre beyond which the depth is 0."""


class Bell(AbstractIndentation):
    """Gaussian indentation depth · exp(−r² / (2 deviation²)) at distance r; with the default values, the unit
    deformation of Park et al. 2022, text S4.

    The indentation is set to 0 beyond r = 3 deviation, where the depth has dropped to about a hundredth of `depth`.

    **Fields**: `depth`: largest depth, metres; `deviation`: standard deviation of the Gaussian, metres.

    **Example:**

    ```python
    touched = skin.touched_cells([(0.0, 0.0)], Bell(depth=2e-3, deviation=6e-3))
    changes = skin.voltage_changes(touched)
    ```
    """

    depth: float
    deviation: float

    def __init__(self, depth: float = DEPTH, deviation: float = DEVIATION):
        """`depth`: maximum depth, metres; `deviation`: standard deviation of the Gaussian, metres."""
        self.depth = check_length("depth", depth)
        self.deviation = check_length("deviation", deviation)

    @numpy_or_compiled
    def depth_at(self, distance):
        """Depth in metres at horizontal distances (metres) from the centre."""
        xp = namespace(self, distance)
        distance = xp.asarray(distance)
        return xp.where(distance < self.reach, self.depth * xp.exp(-0.5 * (distance / self.deviation) ** 2), 0.0)

    @property
    def reach(self) -> float:
        """Distance from the centre beyond which the depth is 0: three times the standard deviation, metres."""
        return 3 * self.deviation


class Hemisphere(AbstractIndentation):
    """Indentation by a rigid ball of radius R: depth − (R − √(R² − r²)) at distance r where this difference is
    positive, otherwise 0.

    The default diameter is that of the ball in the experiments of Park et al. 2022.

    **Fields**: `depth`: depth of the lowest point, metres; `diameter`: diameter 2R of the ball, metres.

    **Example:**

    ```python
    touched = skin.touched_cells([(0.0, 0.0)], Hemisphere(depth=2e-3, diameter=0.01))
    changes = skin.voltage_changes(touched)
    ```
    """

    depth: float
    diameter: float

    def __init__(self, depth: float = DEPTH, diameter: float = BALL_DIAMETER):
        """`depth`: maximum depth, metres; `diameter`: diameter of the ball, metres. Raises `ValueError` for a depth
        greater than the radius of the ball."""
        self.depth = check_length("depth", depth)
        self.diameter = check_length("diameter", diameter)
        if self.depth > self.diameter / 2:
            raise ValueError(
                f"depth is {1e3 * self.depth:g} mm, but a hemisphere {1e3 * self.diameter:g} mm across goes in no "
                f"deeper than {5e2 * self.diameter:g} mm; give less depth, or a larger one."
            )

    @numpy_or_compiled
    def depth_at(self, distance):
        """Depth in metres at horizontal distances (metres) from the centre of the ball."""
        xp, ball_radius = namespace(self, distance), self.diameter / 2
        sphere_height = xp.sqrt(xp.maximum(ball_radius**2 - xp.asarray(distance) ** 2, 0.0))
        return xp.maximum(self.depth - ball_radius + sphere_height, 0.0)

    @property
    def reach(self) -> float:
        """Distance from the centre beyond which the depth is 0: the radius of the contact area, metres."""
        return float((self.depth * (self.diameter - self.depth)) ** 0.5)


class TouchGrid(Module):
    """Grid of touched positions: the centres of equal rectangles that cover a skin.

    **Fields**

    - `places`: touched positions (n, 2), on a curved skin (n, 3), metres.
    - `rows`, `columns` (n,): row and column of each position in the raster; row 0 has the smallest y.
    - `shape`: numbers of rows and columns of the raster; `pitch`: width and height of a rectangle of the grid, metres.
    """

    places: Float[np.ndarray, "n d"]
    rows: np.ndarray
    columns: np.ndarray
    shape: tuple[int, int] = eqx.field(static=True)
    pitch: tuple[float, float] = eqx.field(static=True)

    @property
    def cell_area(self) -> float:
        """Area of the rectangle around a touched position, m²."""
        return self.pitch[0] * self.pitch[1]

    def raster(self, values) -> Float[np.ndarray, "rows columns"]:
        """Arrange `values` (n,) at the touched positions as an image (rows, columns), with NaN outside the skin."""
        raster_image = np.full(self.shape, np.nan)
        raster_image[self.rows, self.columns] = np.asarray(values)
        return raster_image


class SurfaceGrid(TouchGrid):
    """Touched positions of a curved skin, spread evenly over its surface by distances along the surface.

    The raster has a single row. **Fields**: those of `TouchGrid`, and `areas` (n,): area that each position represents,
    m².
    """

    areas: Float[np.ndarray, " n"]

    @classmethod
    def spread(cls, surface: Triangles, number: int, margin: float = 0.0) -> "SurfaceGrid":
        """Spread `number` touched positions evenly over a surface, at least `margin` metres from its edge. Raises
        `ValueError` if the margin leaves no room."""
        places = spread(surface, number, margin=margin)
        allowed_areas = surface.node_areas * (surface.distance_to_border(surface.points) >= margin)
        area_per_place = float(allowed_areas.sum()) / number
        rows_and_columns = np.zeros(number, int), np.arange(number)
        return cls(
            places,
            *rows_and_columns,
            (1, number),
            (area_per_place**0.5, area_per_place**0.5),
            np.full(number, area_per_place),
        )

    def on(self, surface: Triangles, face: Triangles) -> "SurfaceGrid":
        """Map the touched positions from `surface` to another surface `face` with the same triangulation. The nearest
        point of `surface` is mapped to the point of `face` with the same coordinates within the same triangle. Areas
        are scaled accordingly."""
        nearest_points = surface.nearest(self.places)
        mapped_areas = self.areas * nearest_points.of_nodes(surface, face.node_areas / surface.node_areas)
        mean_triangle_area = float(mapped_areas.mean())
        return SurfaceGrid(
            nearest_points.of_nodes(surface, face.points),
            self.rows,
            self.columns,
            self.shape,
            (mean_triangle_area**0.5, mean_triangle_area**0.5),
            mapped_areas,
        )

    def raster(self, values) -> Float[np.ndarray, "rows columns"]:
        """Raises `ValueError`, since positions on a curved skin form no rows and columns."""
        raise ValueError(
            "grid is of a curved skin, whose places are in no raster; draw it with jeit.design.plots.plot_unrolled."
        )


def touch_grid(
    outline: Domain | Triangles, columns: int = NUM_PLACES_PER_SIDE, rows: int = NUM_PLACES_PER_SIDE
) -> TouchGrid:
    """Create a grid of touched positions: the bounding box of a skin's outline is divided into equal rectangles, and
    the positions are the centres that lie inside the outline.

    The default is 48 × 48 rectangles, as in Park et al. 2022. On a curved skin, whose outline is its surface, rows ×
    columns positions are spread evenly over the surface.

    **Arguments:**

    - `outline`: outline of the skin, or the surface of a curved skin.
    - `columns`, `rows`: numbers of columns and rows.

    Raises `ValueError` for fewer than one row or column, and if `outline` is not an outline.

    **Example:**

    ```python
    touches = touch_grid(skin.outline, 6, 5)
    print(touches.places.shape)  # (30, 2)
    ```
    """
    check_kind("outline", outline, (Domain, Triangles), "an outline, such as skin.outline or Rectangle(0.2, 0.2)")
    if columns < 1 or rows < 1:
        raise ValueError(
            f"a grid needs one column and one row at least; {columns} columns and {rows} rows were asked for."
        )
    if isinstance(outline, Triangles):
        return SurfaceGrid.spread(outline, columns * rows)
    low_x, high_x, low_y, high_y = outline.extent
    cell_width, cell_height = (high_x - low_x) / columns, (high_y - low_y) / rows
    x, y = low_x + cell_width * (np.arange(columns) + 0.5), low_y + cell_height * (np.arange(rows) + 0.5)
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    is_inside_outline = np.asarray(outline.contains(places))
    row_indices, column_indices = np.divmod(np.flatnonzero(is_inside_outline), columns)
    return TouchGrid(
        places[is_inside_outline], row_indices, column_indices, (rows, columns), (float(cell_width), float(cell_height))
    )


def touches_away_from_the_edge(
    outline: Domain | Triangles, margin: float, columns: int = NUM_PLACES_PER_SIDE, rows: int = NUM_PLACES_PER_SIDE
) -> TouchGrid:
    """The touched positions of `touch_grid` that are farther than a `margin` from the outline, so that touches do not
    reach beyond the edge.

    **Arguments:**

    - `outline`: outline of the skin, or the surface of a curved skin.
    - `margin`: minimum distance from the edge, metres.
    - `columns`, `rows`: numbers of columns and rows of the grid.

    Raises `ValueError` if no position is farther from the edge than `margin`.

    **Example:**

    ```python
    touches = touches_away_from_the_edge(skin.outline, 0.01, 6, 5)
    print(touches.places)
    ```
    """
    if isinstance(outline, Triangles):
        return SurfaceGrid.spread(outline, columns * rows, margin)
    grid = touch_grid(outline, columns, rows)
    margin_offsets = margin * np.array(
        [[np.cos(offset_angle), np.sin(offset_angle)] for offset_angle in np.linspace(0, 2 * np.pi, 16, endpoint=False)]
    )
    is_away_from_edge = np.all(
        [np.asarray(outline.contains(grid.places + margin_offset)) for margin_offset in margin_offsets], axis=0
    )
    if not is_away_from_edge.any():
        raise ValueError(f"margin is {1e3 * margin:g} mm: no place of the skin is so far from its edge; give less.")
    return TouchGrid(
        grid.places[is_away_from_edge],
        grid.rows[is_away_from_edge],
        grid.columns[is_away_from_edge],
        grid.shape,
        grid.pitch,
    )


def check_grid(grid: TouchGrid) -> None:
    """Raise `ValueError` unless `grid` is a `TouchGrid`, not only an array of positions."""
    check_kind("grid", grid, TouchGrid, "a TouchGrid, as of touch_grid(skin.outline)")


def check_places(places, dimension: int = 2) -> Float[np.ndarray, "n d"]:
    """Convert touched positions (n, `dimension`), metres, to an array. Raises `ValueError` for arguments that are not
    positions, such as a whole `TouchGrid`, and for values that are not finite."""
    places_requirement = (
        f"places must be (n, {dimension}), one or more, in metres, such as touch_grid(skin.outline).places"
    )
    try:
        touched_positions = np.asarray(places, float)
    except (TypeError, ValueError):
        raise ValueError(f"{places_requirement}; it is {describe(places)}.") from None
    if touched_positions.ndim != 2 or touched_positions.shape[1] != dimension or not len(touched_positions):
        raise ValueError(f"{places_requirement}; they have shape {touched_positions.shape}.")
    invalid_positions = np.flatnonzero(~np.isfinite(touched_positions).all(axis=1))
    if invalid_positions.size:
        raise ValueError(
            f"places: {invalid_positions.size} of {len(touched_positions)} are not finite, the first is number "
            f"{invalid_positions[0]}."
        )
    return touched_positions
