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
    step = (-1 if clockwise else 1) * 2 * np.pi / num_electrodes
    angle = start_angle + step * np.arange(num_electrodes)
    position = np.asarray(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return position if height is None else np.column_stack([position, np.full(num_electrodes, float(height))])


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
    position = ring(radius, num_electrodes, **options)
    return np.vstack([position, position.mean(axis=0)])


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
    spacing = np.sqrt((x_max - x_min) * (y_max - y_min) / max(20_000, 200 * num_electrodes))
    x, y = np.arange(x_min + spacing / 2, x_max, spacing), np.arange(y_min + spacing / 2, y_max, spacing)
    samples = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    samples = samples[np.asarray(domain.contains(samples))]
    if margin > 0:
        edge = domain.boundary(np.linspace(0, domain.perimeter, int(4 * domain.perimeter / spacing), endpoint=False))
        samples = samples[KDTree(edge).query(samples)[0] >= margin]
    if len(samples) < num_electrodes:
        raise ValueError(f"margin: {margin} m leaves no room for {num_electrodes} electrodes inside the outline.")
    position = samples[[np.argmin(np.sum((samples - samples.mean(axis=0)) ** 2, axis=1))]]
    distance = np.full(len(samples), np.inf)
    while len(position) < num_electrodes:
        distance = np.minimum(distance, np.sum((samples - position[-1]) ** 2, axis=1))
        position = np.vstack([position, samples[distance.argmax()]])
    for _ in range(iterations):
        nearest_electrodes = KDTree(position).query(samples)[1]
        count = np.bincount(nearest_electrodes, minlength=num_electrodes)
        total = np.stack([np.bincount(nearest_electrodes, samples[:, k], num_electrodes) for k in range(2)], axis=1)
        moved_positions = np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], position)
        if np.abs(moved_positions - position).max() < 1e-3 * spacing:
            break
        position = moved_positions
    return position


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
        centres = _park_centres(name)
    elif grid_match is not None:
        centres = _grid_centres(name, outline, diameter, int(grid_match[1]), int(grid_match[2]))
    elif spread_match is not None:
        number = int(spread_match[2])
        if number > _MAX_ELECTRODES:
            raise ValueError(f"name: {name!r} has {number} electrodes; give {_MAX_ELECTRODES} or fewer.")
        centres = (
            _inner_centres(outline, number, diameter)
            if spread_match[1] == "inner"
            else _perimeter_centres(name, outline, diameter, number)
        )
    else:
        suggestion = did_you_mean(name, [*_PARK_NAMES, *NAMES[2:]])
        raise ValueError(
            f"name: there is no layout {name!r}{suggestion}; take {', '.join(BUILT_IN)} (or another grid-CxR), "
            "perimeter-N, inner-N, or a file's."
        )
    return Layout(centres, diameter, outline=outline, name=name)


def same_outline(outline: Domain | None, other_outline: Domain) -> bool:
    """Whether two outlines have the same bounding box and area, except for rounding of their lengths in millimetres."""
    return (
        outline is not None
        and np.allclose(outline.extent, other_outline.extent, atol=1e-6)
        and math.isclose(other_outline.area, outline.area, rel_tol=1e-3)
    )


@lru_cache(maxsize=2)
def _park_centres(name: str) -> np.ndarray:
    if name == "park-inner":
        return quasi_uniform(Rectangle(_PARK_SIDE, _PARK_SIDE), 32)
    edge_distance = DIAMETER + 2 * _PARK_EDGE_DISTANCE
    track = Rectangle(_PARK_SIDE - edge_distance, _PARK_SIDE - edge_distance)
    pitch = track.perimeter / 32
    return np.asarray(track.boundary(pitch * (np.arange(32) + 0.5)))


def _check_park(name: str, outline: Domain) -> None:
    if not same_outline(outline, Rectangle(_PARK_SIDE, _PARK_SIDE)):
        span_text = f"{-5e2 * _PARK_SIDE:g} to {5e2 * _PARK_SIDE:g} mm"
        alternative = "inner-32" if name == "park-inner" else "perimeter-32"
        raise ValueError(f"name: its skin spans {span_text} by {span_text}; on another take {alternative}.")


def _grid_centres(name: str, outline: Domain, diameter: float, columns: int, rows: int) -> np.ndarray:
    if min(columns, rows) < 1:
        raise ValueError(f"name: {name!r} has no electrodes; give at least one column and one row.")
    if columns * rows > _MAX_ELECTRODES:
        raise ValueError(f"name: {name!r} has {columns * rows} electrodes; give {_MAX_ELECTRODES} or fewer.")
    x_min, x_max, y_min, y_max = outline.extent
    pitches = (x_max - x_min) / columns, (y_max - y_min) / rows
    if min(pitches) < diameter:
        raise ValueError(
            f"name: the electrodes of {name!r} would be {1e3 * min(pitches):.3g} mm apart, and they are "
            f"{1e3 * diameter:g} mm across: they would overlap by {1e3 * (diameter - min(pitches)):.3g} mm; give "
            "fewer, or move them apart."
        )
    centre = (x_min + x_max) / 2, (y_min + y_max) / 2
    return grid(x_max - x_min - pitches[0], y_max - y_min - pitches[1], columns, rows, centre=centre)


def _perimeter_centres(name: str, outline: Domain, diameter: float, number: int) -> np.ndarray:
    if not isinstance(outline, Disk | Rectangle):
        raise ValueError(f"name: {name!r} is of rectangles and disks, and this skin is neither; take inner-N.")
    x_min, x_max, y_min, y_max = outline.extent
    width, height, edge_distance = x_max - x_min, y_max - y_min, diameter + 2 * _PARK_EDGE_DISTANCE
    if edge_distance >= min(width, height):
        raise ValueError(
            f"name: electrodes {1e3 * diameter:g} mm across do not fit around the edge; make them smaller."
        )
    if isinstance(outline, Disk):
        return perimeter(Disk(outline.radius - edge_distance / 2, outline.centre), number)
    track = Rectangle(width - edge_distance, height - edge_distance, outline.centre)
    return perimeter(track, number, start=track.perimeter / number / 2 if number else 0.0)


def _inner_centres(outline: Domain, number: int, diameter: float) -> np.ndarray:
    """Centres of `number` electrodes spread evenly inside an outline. The centres in rectangles are cached, since a
    study needs the same centres for many parameters."""
    if isinstance(outline, Rectangle):
        return _spread_centres(outline, number, diameter)
    return quasi_uniform(outline, number, margin=diameter / 2)


@lru_cache(maxsize=256)
def _spread_centres(outline: Rectangle, number: int, diameter: float) -> np.ndarray:
    return quasi_uniform(outline, number, margin=diameter / 2)
