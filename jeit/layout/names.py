"""Arrangements of electrodes (rings, grids and others), and built-in layouts by name."""

from __future__ import annotations

import math
import re
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from jeit.arguments import describe, did_you_mean, is_number
from jeit.layout.layout import Layout
from jeit.mesh import Disk, Domain, Rectangle


def ring(
    radius: float,
    num_electrodes: int,
    *,
    start_angle: float = np.pi / 2,
    clockwise: bool = False,
    centre: tuple[float, float] = (0.0, 0.0),
    height: float | None = None,
) -> np.ndarray:
    """Positions evenly spaced on a circle: (L, 2) metres, or (L, 3) if `height` is specified (3-D tanks).

    **Arguments:**

    - `radius`: radius of the circle, metres.
    - `num_electrodes`: number L of electrodes.
    - `start_angle`: angle of the first electrode, radians counter-clockwise from +x (default: 12 o'clock).
    - `clockwise`: whether the electrodes follow each other clockwise.
    - `centre` (x, y): centre of the circle, metres.
    - `height`: z coordinate of all electrodes, metres.

    Raises `ValueError` for a radius that is not positive or fewer than two electrodes.

    **Example:**

    ```python
    positions = ring(0.1, 16)
    ```
    """
    check_count(num_electrodes, 2)
    if not radius > 0:
        raise ValueError(f"radius must be positive, in metres; it is {radius}.")
    angle_step = (-1 if clockwise else 1) * 2 * np.pi / num_electrodes
    electrode_angles = start_angle + angle_step * np.arange(num_electrodes)
    electrode_positions = np.asarray(centre) + radius * np.stack(
        [np.cos(electrode_angles), np.sin(electrode_angles)], axis=1
    )
    return (
        electrode_positions
        if height is None
        else np.column_stack([electrode_positions, np.full(num_electrodes, float(height))])
    )


def ring_and_centre(radius: float, num_electrodes: int, **options: Any) -> np.ndarray:
    """Positions of a `ring` of electrodes and, last, of one electrode at its centre: (num_electrodes + 1, d) metres.
    See `jeit.protocol.reference_electrode` for the use of the central electrode.

    **Arguments:**

    - `radius`, `num_electrodes`, `options`: as in `ring`.

    Raises `ValueError` as `ring` does.

    **Example:**

    ```python
    positions = ring_and_centre(0.1, 16, clockwise=True)
    ```
    """
    ring_positions = ring(radius, num_electrodes, **options)
    return np.vstack([ring_positions, ring_positions.mean(axis=0)])


def perimeter(domain: Domain, num_electrodes: int, *, start: float = 0.0) -> np.ndarray:
    """Positions evenly spaced along the edge of an outline, counter-clockwise: (L, 2) metres.

    **Arguments:**

    - `domain`: the outline.
    - `num_electrodes`: number L of electrodes.
    - `start`: arc length of the first electrode along `domain.boundary`, metres. The boundary of a rectangle begins at
      its lower left corner; a start of half the electrode spacing keeps the electrodes of a square away from its
      corners if L is a multiple of four.

    Raises `ValueError` for fewer than two electrodes.

    **Example:**

    ```python
    positions = perimeter(Rectangle(0.2, 0.2), 16, start=0.025)
    ```
    """
    check_count(num_electrodes, 2)
    arc_length = start + domain.perimeter * np.arange(num_electrodes) / num_electrodes
    return np.asarray(domain.boundary(arc_length % domain.perimeter))


def grid(
    width: float, height: float, columns: int, rows: int, *, centre: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """Positions of a regular grid of electrodes: (L, 2) metres, row by row from the lower left.

    **Arguments:**

    - `width`, `height`: distances between the outermost electrodes, metres.
    - `columns`, `rows`: numbers of electrodes along x and along y.
    - `centre` (x, y): centre of the grid, metres.

    Raises `ValueError` for sides that are not positive, and for fewer than one row or column.

    **Example:**

    ```python
    positions = grid(0.15, 0.1, columns=4, rows=3)
    ```
    """
    check_count(columns, 1)
    check_count(rows, 1)
    if not (width > 0 or columns == 1) or not (height > 0 or rows == 1):
        raise ValueError(f"width and height must be positive, in metres; they are {width} and {height}.")
    x = centre[0] + (np.linspace(-width / 2, width / 2, columns) if columns > 1 else np.zeros(1))
    y = centre[1] + (np.linspace(-height / 2, height / 2, rows) if rows > 1 else np.zeros(1))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def quasi_uniform(domain: Domain, num_electrodes: int, *, margin: float = 0.0, iterations: int = 200) -> np.ndarray:
    """Positions spread evenly inside any outline: (L, 2) metres.

    The positions are the centroids of a centroidal Voronoi tessellation, so that the area around every electrode is
    about the same. The tessellation is computed by Lloyd's algorithm on a fine grid of sample points, starting from
    farthest-point sampling, and is deterministic.

    **Arguments:**

    - `domain`: the outline.
    - `num_electrodes`: number L of electrodes.
    - `margin`: minimum distance of positions from the outline, metres.
    - `iterations`: maximum number of iterations.

    Raises `ValueError` if the margin leaves no room for electrodes.

    **Example:**

    ```python
    positions = quasi_uniform(Disk(0.1), 16, margin=0.01)
    ```
    """
    check_count(num_electrodes, 1)
    x_min, x_max, y_min, y_max = domain.extent
    sample_spacing = np.sqrt((x_max - x_min) * (y_max - y_min) / max(20_000, 200 * num_electrodes))
    x, y = (
        np.arange(x_min + sample_spacing / 2, x_max, sample_spacing),
        np.arange(y_min + sample_spacing / 2, y_max, sample_spacing),
    )
    sample_points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    sample_points = sample_points[np.asarray(domain.contains(sample_points))]
    if margin > 0:
        edge_points = domain.boundary(
            np.linspace(0, domain.perimeter, int(4 * domain.perimeter / sample_spacing), endpoint=False)
        )
        sample_points = sample_points[KDTree(edge_points).query(sample_points)[0] >= margin]
    if len(sample_points) < num_electrodes:
        raise ValueError(f"margin: {margin} m leaves no room for {num_electrodes} electrodes inside the outline.")
    electrode_positions = sample_points[[np.argmin(np.sum((sample_points - sample_points.mean(axis=0)) ** 2, axis=1))]]
    squared_distances = np.full(len(sample_points), np.inf)
    while len(electrode_positions) < num_electrodes:
        squared_distances = np.minimum(
            squared_distances, np.sum((sample_points - electrode_positions[-1]) ** 2, axis=1)
        )
        electrode_positions = np.vstack([electrode_positions, sample_points[squared_distances.argmax()]])
    for _ in range(iterations):
        nearest_electrodes = KDTree(electrode_positions).query(sample_points)[1]
        samples_per_electrode = np.bincount(nearest_electrodes, minlength=num_electrodes)
        sample_sums = np.stack(
            [np.bincount(nearest_electrodes, sample_points[:, k], num_electrodes) for k in range(2)], axis=1
        )
        moved_positions = np.where(
            samples_per_electrode[:, None] > 0,
            sample_sums / np.maximum(samples_per_electrode, 1)[:, None],
            electrode_positions,
        )
        if np.abs(moved_positions - electrode_positions).max() < 1e-3 * sample_spacing:
            break
        electrode_positions = moved_positions
    return electrode_positions


def check_count(num_electrodes: int, minimum: int) -> None:
    """Raise `ValueError` unless `num_electrodes` is a whole number of at least `minimum`."""
    if not is_number(num_electrodes) or int(num_electrodes) != num_electrodes or num_electrodes < minimum:
        raise ValueError(f"Give a whole number of electrodes, at least {minimum}; got {describe(num_electrodes)}.")


# Side of the skin in the paper of Park et al., diameter of the electrodes in its Fig. S4, and distance of electrodes
# from the edge in the conventional layout, metres. The paper does not state this distance: here 2 mm of hydrogel remain
# outside the electrodes.
_PARK_SIDE, DIAMETER, _PARK_EDGE_DISTANCE = 0.2, 6e-3, 2e-3
_PARK_NAMES = ("park-inner", "park-boundary")
# Maximum number of electrodes of a built-in layout, since the distances between all pairs are checked.
_MAX_ELECTRODES = 1024

BUILT_IN = {
    "park-inner": "32 electrodes spread evenly inside 200 × 200 mm (Park et al. 2022, the proposed design)",
    "park-boundary": "32 electrodes evenly along the edge of 200 × 200 mm (Park et al. 2022, the conventional design)",
    "grid-8x4": "a regular grid of 8 columns and 4 rows; any other counts likewise, and any rectangular skin",
}
NAMES = (*_PARK_NAMES, "grid-CxR", "perimeter-N", "inner-N")


def named_layout(name: str, outline: Domain | None = None, *, diameter: float = DIAMETER) -> Layout:
    """Create a built-in layout by its name, on a skin with this `outline`, by default 200 × 200 mm about the origin.

    - "park-inner" and "park-boundary": the two designs compared in text S4 of Park et al., Science Robotics 7, eabm7187
      (2022), for the default outline only. The coordinates of "park-inner" are not published; the paper states "as
      evenly as possible in a square area" and "about 40 mm" apart. Here the electrodes of "park-inner" form a
      centroidal Voronoi tessellation with nearest neighbours 31 to 38 mm apart. The centres of "park-boundary" are 5 mm
      from the edge and 23.75 mm apart, none in a corner, counter-clockwise from the lower left.
    - "grid-CxR": C columns and R rows; each electrode is in the centre of one of C × R equal rectangles that fill the
      bounding box of the skin.
    - "perimeter-N": N electrodes along the edge of a rectangle or a disk, with 2 mm of skin between the electrodes and
      the edge.
    - "inner-N": N electrodes spread evenly inside any outline.

    **Arguments:**

    - `name`: one of the names above.
    - `outline`: outline of the skin, by default 200 × 200 mm about the origin.
    - `diameter`: diameter of the electrodes, metres.

    Raises `ValueError` for an unknown name, for an outline for which the layout does not exist, and for electrodes that
    would overlap.

    **Example:**

    ```python
    layout = named_layout("perimeter-16", Disk(0.1))
    ```
    """
    outline = Rectangle(_PARK_SIDE, _PARK_SIDE) if outline is None else outline
    spread_match = re.fullmatch(r"(perimeter|inner)-(\d{1,4})", name) if isinstance(name, str) else None
    grid_match = re.fullmatch(r"grid-(\d{1,4})x(\d{1,4})", name) if isinstance(name, str) else None
    if name in _PARK_NAMES:
        _check_park(name, outline)
        electrode_centres = _park_centres(name)
    elif grid_match is not None:
        electrode_centres = _grid_centres(name, outline, diameter, int(grid_match[1]), int(grid_match[2]))
    elif spread_match is not None:
        num_electrodes = int(spread_match[2])
        if num_electrodes > _MAX_ELECTRODES:
            raise ValueError(f"name: {name!r} has {num_electrodes} electrodes; give {_MAX_ELECTRODES} or fewer.")
        electrode_centres = (
            _inner_centres(outline, num_electrodes, diameter)
            if spread_match[1] == "inner"
            else _perimeter_centres(name, outline, diameter, num_electrodes)
        )
    else:
        name_suggestion = did_you_mean(name, [*_PARK_NAMES, *NAMES[2:]])
        raise ValueError(
            f"name: there is no layout {name!r}{name_suggestion}; take {', '.join(BUILT_IN)} (or another grid-CxR), "
            "perimeter-N, inner-N, or a file's."
        )
    return Layout(electrode_centres, diameter, outline=outline, name=name)


def same_outline(outline: Domain | None, other_outline: Domain) -> bool:
    """Whether two outlines have the same bounding box and area, except for rounding of their lengths in millimetres."""
    return (
        outline is not None
        and np.allclose(outline.extent, other_outline.extent, atol=1e-6)
        and math.isclose(other_outline.area, outline.area, rel_tol=1e-3)
    )


@lru_cache(maxsize=2)
def _park_centres(layout_name: str) -> np.ndarray:
    if layout_name == "park-inner":
        return quasi_uniform(Rectangle(_PARK_SIDE, _PARK_SIDE), 32)
    edge_distance = DIAMETER + 2 * _PARK_EDGE_DISTANCE
    electrode_track = Rectangle(_PARK_SIDE - edge_distance, _PARK_SIDE - edge_distance)
    electrode_pitch = electrode_track.perimeter / 32
    return np.asarray(electrode_track.boundary(electrode_pitch * (np.arange(32) + 0.5)))


def _check_park(layout_name: str, outline: Domain) -> None:
    if not same_outline(outline, Rectangle(_PARK_SIDE, _PARK_SIDE)):
        span_text = f"{-5e2 * _PARK_SIDE:g} to {5e2 * _PARK_SIDE:g} mm"
        alternative_name = "inner-32" if layout_name == "park-inner" else "perimeter-32"
        raise ValueError(f"name: its skin spans {span_text} by {span_text}; on another take {alternative_name}.")


def _grid_centres(layout_name: str, outline: Domain, diameter: float, num_columns: int, num_rows: int) -> np.ndarray:
    if min(num_columns, num_rows) < 1:
        raise ValueError(f"name: {layout_name!r} has no electrodes; give at least one column and one row.")
    if num_columns * num_rows > _MAX_ELECTRODES:
        raise ValueError(
            f"name: {layout_name!r} has {num_columns * num_rows} electrodes; give {_MAX_ELECTRODES} or fewer."
        )
    x_min, x_max, y_min, y_max = outline.extent
    grid_pitches = (x_max - x_min) / num_columns, (y_max - y_min) / num_rows
    if min(grid_pitches) < diameter:
        raise ValueError(
            f"name: the electrodes of {layout_name!r} would be {1e3 * min(grid_pitches):.3g} mm apart, and they are "
            f"{1e3 * diameter:g} mm across: they would overlap by {1e3 * (diameter - min(grid_pitches)):.3g} mm; give "
            "fewer, or move them apart."
        )
    grid_centre = (x_min + x_max) / 2, (y_min + y_max) / 2
    return grid(
        x_max - x_min - grid_pitches[0], y_max - y_min - grid_pitches[1], num_columns, num_rows, centre=grid_centre
    )


def _perimeter_centres(layout_name: str, outline: Domain, diameter: float, num_electrodes: int) -> np.ndarray:
    if not isinstance(outline, Disk | Rectangle):
        raise ValueError(f"name: {layout_name!r} is of rectangles and disks, and this skin is neither; take inner-N.")
    x_min, x_max, y_min, y_max = outline.extent
    outline_width, outline_height, edge_distance = x_max - x_min, y_max - y_min, diameter + 2 * _PARK_EDGE_DISTANCE
    if edge_distance >= min(outline_width, outline_height):
        raise ValueError(
            f"name: electrodes {1e3 * diameter:g} mm across do not fit around the edge; make them smaller."
        )
    if isinstance(outline, Disk):
        return perimeter(Disk(outline.radius - edge_distance / 2, outline.centre), num_electrodes)
    electrode_track = Rectangle(outline_width - edge_distance, outline_height - edge_distance, outline.centre)
    return perimeter(
        electrode_track, num_electrodes, start=electrode_track.perimeter / num_electrodes / 2 if num_electrodes else 0.0
    )


def _inner_centres(outline: Domain, num_electrodes: int, diameter: float) -> np.ndarray:
    """Centres of `num_electrodes` electrodes spread evenly inside an outline. The centres in rectangles are cached,
    since a study needs the same centres for many parameters."""
    if isinstance(outline, Rectangle):
        return _spread_centres(outline, num_electrodes, diameter)
    return quasi_uniform(outline, num_electrodes, margin=diameter / 2)


@lru_cache(maxsize=256)
def _spread_centres(outline: Rectangle, num_electrodes: int, diameter: float) -> np.ndarray:
    return quasi_uniform(outline, num_electrodes, margin=diameter / 2)
