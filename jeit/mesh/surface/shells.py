"""Shells of a given thickness on surfaces in space; bending of sheets; and surfaces of solids."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array

from jeit.arguments import check_name, describe
from jeit.mesh._surface import first_crossing
from jeit.mesh.checks import size_checked
from jeit.mesh.generate import unstructured
from jeit.mesh.geometry import normals
from jeit.mesh.mesh import Mesh
from jeit.mesh.outline.domain import check_length
from jeit.mesh.solids import stacked_cells, stacked_wall
from jeit.mesh.topology import odd_permutation


def surface_of(mesh: Mesh, tag: str | None = None) -> Mesh:
    """Extract the boundary triangles of a solid as a surface in space that faces outward.

    **Arguments:**

    - `mesh`: a mesh of tetrahedra.
    - `tag`: name in `mesh.tags` of the triangles to extract, by default all of the boundary.

    Raises `ValueError` for a mesh that is not a solid, an unknown tag, and triangles that do not form one surface: for
    a shell, choose 'inner' or 'outer'.

    **Example:**

    ```python
    top = surface_of(solid, "top")
    ```
    """
    if mesh.dimension != 3:
        raise ValueError("mesh: only solids have a boundary surface; this one consists of triangles.")
    facets = np.asarray(mesh.facets)
    if tag is not None:
        check_name("tag", tag, mesh.tags)
        facets = facets[np.asarray(mesh.tags[tag])]
    used, cells = np.unique(facets, return_inverse=True)
    with size_checked():
        return Mesh.create(np.asarray(mesh.points)[used], cells.reshape(facets.shape))


# Minimum cosine of the angle between the mean normal at a node and those of its triangles: below it, the node lies on a
# crease, which is not smoothed.
_MIN_CREASE_COSINE = np.cos(np.radians(50.0))
# Number of coefficients of the quadratic surface fitted to neighbours, and minimum ratio of the smallest to the largest
# eigenvalue of its normal equations.
_NUM_COEFFICIENTS, _MIN_EIGENVALUE_RATIO = 5, 1e-6


def node_normals(mesh: Mesh) -> np.ndarray:
    """Unit normals (n, 3) at the nodes of a surface in space.

    A quadratic surface is fitted to the first and second neighbours of each node; on a smooth surface its normal is
    accurate to second order in the cell size, also at the border. At creases, and where there are too few neighbours,
    the normal is the angle-weighted mean of the normals of the triangles. Computed with NumPy, without derivatives.
    Raises `ValueError` for a solid.

    **Arguments:**

    - `mesh`: a surface in space, or a plane mesh.

    **Example:**

    ```python
    outward = node_normals(sleeve)
    ```
    """
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    facing = np.asarray(normals(mesh))
    if not mesh.is_surface:
        return np.broadcast_to(facing[:1], (mesh.num_points, 3)).copy()
    corners = points[cells]
    before, after = np.roll(corners, 1, axis=1) - corners, np.roll(corners, -1, axis=1) - corners
    lengths = np.linalg.norm(before, axis=2) * np.linalg.norm(after, axis=2)
    angle = np.arccos(np.clip((before * after).sum(axis=2) / lengths, -1, 1))
    mean = np.zeros_like(points)
    np.add.at(mean, cells, angle[..., None] * facing[:, None])
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    least = np.ones(len(points))
    np.minimum.at(least, cells, (mean[cells] * facing[:, None]).sum(axis=2))
    slope, determined = _fit_slopes(points, cells, mean)
    smooth = (least > _MIN_CREASE_COSINE) & determined
    fitted = mean - np.where(smooth[:, None], slope, 0)
    return fitted / np.linalg.norm(fitted, axis=1, keepdims=True)


def _fit_slopes(points: np.ndarray, cells: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit a quadratic surface to the first and second neighbours of each node, as a height above the plane
    perpendicular to `normal`. Returns its slopes (n, 3) at the nodes, and whether the neighbours determine it."""
    count = len(points)
    pairs = np.concatenate([cells[:, [a, b]] for a in range(3) for b in range(3)])
    near = coo_array((np.ones(len(pairs)), pairs.T), shape=(count, count)).tocsr()
    within_two = coo_array(near @ near)
    one, other = within_two.row, within_two.col
    apart = one != other
    one, other = one[apart], other[apart]
    helper = np.eye(3)[np.abs(normal).argmin(axis=1)]
    across = np.cross(normal, helper)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    axes = np.stack([across, np.cross(normal, across), normal], axis=1)  # (n, 3, 3)
    offset = np.einsum("pij,pj->pi", axes[one], points[other] - points[one])
    scale = np.sqrt(np.bincount(one, (offset**2).sum(axis=1), count) / np.bincount(one, minlength=count))
    u, v, height = (offset / scale[one][:, None]).T
    terms = np.stack([u, v, u * u / 2, u * v, v * v / 2], axis=1)
    matrix, right = np.zeros((count, _NUM_COEFFICIENTS, _NUM_COEFFICIENTS)), np.zeros((count, _NUM_COEFFICIENTS))
    for k in range(_NUM_COEFFICIENTS):
        right[:, k] = np.bincount(one, terms[:, k] * height, count)
        for j in range(_NUM_COEFFICIENTS):
            matrix[:, k, j] = np.bincount(one, terms[:, k] * terms[:, j], count)
    values = np.linalg.eigvalsh(matrix)
    determined = values[:, 0] > _MIN_EIGENVALUE_RATIO * values[:, -1]
    matrix[~determined] = np.eye(_NUM_COEFFICIENTS)
    found = np.linalg.solve(matrix, right[..., None])[:, :2, 0]
    return np.einsum("ni,nij->nj", found, axes[:, :2]), determined


# Distance from a fold to a node, divided by the distance between folds, below which the fold is moved onto the node, to
# avoid slivers.
_FOLD_SNAP_DISTANCE = 0.1
# Distance from a node to a line, divided by the width of the sheet, below which the node lies on the line.
_LINE_TOLERANCE = 1e-12


def bend(mesh: Mesh, radius: float, *, axis: str = "y", num_folds: int | None = None) -> Mesh:
    """Bend a flat sheet around a cylinder that touches the sheet from below along its middle.

    Like paper, the sheet is not stretched: it is folded along straight lines parallel to the cylinder's axis and stays
    flat between them, so all lengths and all voltages are preserved. The folds run along the rows of nodes if the mesh
    has rows (`jeit.mesh.rectangle` has them for axis "x"). Otherwise there are `num_folds` strips, and cells are cut
    where folds cross them; `bend(mesh, numpy.inf)` is the flat sheet with the same cells. Fold lines lie on the
    cylinder. The upper side becomes the outer one. Tags are kept.

    **Arguments:**

    - `mesh`: a plane mesh.
    - `radius`: radius of the cylinder in metres; a negative one bends the sheet upward.
    - `axis`: direction of the cylinder, "x" or "y".
    - `num_folds`: number of strips, by default about one per cell across.

    Raises `ValueError` for a mesh that is not a flat sheet, a radius of zero, and a sheet so wide that it would overlap
    itself.

    **Example:**

    ```python
    bent = bend(sheet, 0.1)
    bent.space_dimension
    ```
    """
    if mesh.dimension != 2 or mesh.is_surface:
        raise ValueError("mesh: only a flat (2-D) sheet bends without stretching; this one is not flat.")
    if axis not in ("x", "y"):
        raise ValueError(f"axis: the cylinder's axis is 'x' or 'y', not {describe(axis)}.")
    if isinstance(radius, bool) or not isinstance(radius, float | int | np.floating) or not abs(radius) > 0:
        raise ValueError(f"radius: expected a length in metres that is not zero, got {describe(radius)}.")
    if num_folds is not None and (isinstance(num_folds, bool) or not isinstance(num_folds, int) or num_folds < 1):
        raise ValueError(f"num_folds: expected a whole number of at least 1, got {describe(num_folds)}.")
    across = 0 if axis == "y" else 1
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    folds = _fold_positions(points[:, across], points[cells], across, num_folds)
    edges = {name: np.asarray(mesh.facets)[np.asarray(index)] for name, index in mesh.tags.items()}
    for line in folds[1:-1]:
        points, cells, edges = _cut_cells(points, cells, edges, points[:, across] - line)
    out, up = _roll_coordinates(points[:, across], folds, float(radius))
    columns = [out, points[:, 1], up] if across == 0 else [points[:, 0], out, up]
    return Mesh.create(np.stack(columns, axis=1), cells, tags=edges)


def _fold_positions(places: np.ndarray, corners: np.ndarray, across: int, num_folds: int | None) -> np.ndarray:
    """Coordinates in metres, across the sheet, of the lines along which it is bent, its two borders included."""
    width = np.ptp(places)
    ordered = np.sort(places)
    rows = ordered[np.concatenate([[True], np.diff(ordered) > _LINE_TOLERANCE * width])]
    own = corners[..., across]
    low, high = (np.searchsorted(rows, side - _LINE_TOLERANCE * width) for side in (own.min(axis=1), own.max(axis=1)))
    if num_folds is None and (high - low <= 1).all():
        return rows
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean()
    lines = np.linspace(rows[0], rows[-1], 1 + (num_folds or max(1, round(width / edge))))
    nearest = ordered[np.abs(ordered - lines[:, None]).argmin(axis=1)]
    near = np.abs(nearest - lines) < _FOLD_SNAP_DISTANCE * (lines[1] - lines[0])
    return np.where(near, nearest, lines)


def _cut_cells(
    points: np.ndarray, cells: np.ndarray, edges: dict[str, np.ndarray], height: np.ndarray
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Cut cells and named edges along a line; `height` (n,) are the signed distances of the nodes from it."""
    side = np.where(np.abs(height) <= _LINE_TOLERANCE * np.ptp(height), 0, np.sign(height)).astype(int)
    sides = side[cells]
    crossed = (sides.min(axis=1) < 0) & (sides.max(axis=1) > 0)
    if not crossed.any():
        return points, cells, edges
    pairs = np.sort(cells[crossed][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    pairs = np.unique(pairs[side[pairs].prod(axis=1) < 0], axis=0)
    share = (height[pairs[:, 0]] / (height[pairs[:, 0]] - height[pairs[:, 1]]))[:, None]
    middles = {(a, b): len(points) + k for k, (a, b) in enumerate(map(tuple, pairs.tolist()))}
    points = np.concatenate([points, (1 - share) * points[pairs[:, 0]] + share * points[pairs[:, 1]]])

    def middle(a: int, b: int) -> int:
        return middles[min(a, b), max(a, b)]

    pieces = []
    for corners in cells[crossed].tolist():
        signs = side[corners].tolist()
        if 0 in signs:
            k = signs.index(0)
            a, b, c = corners[k:] + corners[:k]
            d = middle(b, c)
            pieces += [(a, b, d), (a, d, c)]
        else:
            k = signs.index(-sum(signs))
            a, b, c = corners[k:] + corners[:k]
            d, e = middle(a, b), middle(a, c)
            pieces.append((a, d, e))
            shorter = np.linalg.norm(points[d] - points[c]) < np.linalg.norm(points[b] - points[e])
            pieces += [(d, b, c), (d, c, e)] if shorter else [(d, b, e), (b, c, e)]
    named = {}
    for name, ends in edges.items():
        through = side[ends].prod(axis=1) < 0
        halves = [[(a, middle(a, b)), (middle(a, b), b)] for a, b in ends[through].tolist()]
        named[name] = np.concatenate([ends[~through], np.array(halves, int).reshape(-1, 2)])
    return points, np.concatenate([cells[~crossed], np.array(pieces)]), named


def _roll_coordinates(places: np.ndarray, folds: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Horizontal and vertical coordinates of positions (n,) on the sheet after bending. The `folds` lie on a circle;
    the middle of the sheet stays at 0."""
    middle = (folds[0] + folds[-1]) / 2
    if np.isinf(radius):
        return places - middle, np.zeros_like(places)
    strips = np.diff(folds)
    size = abs(radius)
    too_wide = strips.max() > 2 * size
    turned = 2 * np.arcsin(np.minimum(strips / (2 * size), 1))
    if too_wide or turned.sum() >= 2 * np.pi:
        width = folds[-1] - folds[0]
        raise ValueError(
            f"radius: a sheet {width:.4g} m wide would overlap itself on a cylinder of radius {size:.4g} m. It needs "
            f"more than {width / (2 * np.pi):.4g} m, and finer cells where these are large; a closed sleeve is a "
            "jeit.mesh.tube."
        )
    angle = np.concatenate([[0.0], np.cumsum(turned)])
    angle -= np.interp(middle, folds, angle)
    out, up = size * np.sin(angle), size * (np.cos(angle) - 1) * np.sign(radius)
    return np.interp(places, folds, out), np.interp(places, folds, up)


_SHELL_TAGS = ("inner", "outer", "side")
# Number of bisection steps to find the maximum thickness.
_BISECTION_STEPS = 40


def shell(
    surface: Mesh,
    thickness: float,
    num_layers: int = 1,
    *,
    outward: bool = True,
    normals: ArrayLike | None = None,
) -> Mesh:
    """Mesh a skin on a surface in space: prisms along the normals at the nodes, divided into tetrahedra.

    Node k · n + i is node i of the surface displaced by k · thickness / num_layers. Tags: 'inner', 'outer' and, unless
    the surface is closed, 'side', and the tags of the surface for the parts of the side.

    **Arguments:**

    - `surface`: a surface in space.
    - `thickness`: in metres.
    - `num_layers`: number of layers of prisms.
    - `outward`: whether the skin extends outward from the surface, or else inward.
    - `normals` (n, 3): unit vectors at the nodes, if more accurate ones than those of `jeit.mesh.node_normals` are
      known.

    Raises `ValueError` for a mesh that is not a surface in space, a thickness that is not positive, no layers, a shell
    that intersects itself, and a thickness at which prisms turn inside out, as they do beyond the radius of curvature;
    the message then states the position and the maximum thickness.

    **Example:**

    ```python
    skin = shell(sleeve, 0.005)
    skin.tags["outer"]
    ```
    """
    if not surface.is_surface:
        raise ValueError("surface: this mesh is flat, and a shell needs a surface in space; use jeit.mesh.layer.")
    thickness = check_length("thickness", thickness)
    num_layers = unstructured.check_count("num_layers", num_layers, 1)
    points, cells, facets = (np.asarray(array) for array in (surface.points, surface.cells, surface.facets))
    count = len(points)
    unstructured.check_total(count * (num_layers + 1), "num_layers")
    away = node_normals(surface) if normals is None else _check_normals(normals, count)
    away = away if outward else -away
    solid = stacked_cells(cells, count, num_layers)
    # Sorting the corners inverted some prisms, and the second of the three tetrahedra has the opposite orientation.
    upright = np.where(odd_permutation(cells) ^ (not outward), -1.0, 1.0)
    turned = np.tile(np.outer(upright, (1, -1, 1)).ravel(), num_layers)

    def stacked(height: float) -> np.ndarray:
        return np.concatenate([points + k * height / num_layers * away for k in range(num_layers + 1)])

    _check_upright(stacked, solid, turned, thickness, len(cells))
    tags: dict[str, ArrayLike] = {"inner": cells, "outer": cells + num_layers * count}
    if not outward:
        tags = {"outer": tags["inner"], "inner": tags["outer"]}
    if len(facets):
        tags["side"] = stacked_wall(facets, count, num_layers)
    for name, index in surface.tags.items():
        if name in _SHELL_TAGS:
            raise ValueError(f"surface: its tag {name!r} is taken in a shell. Rename it.")
        tags[name] = stacked_wall(facets[np.asarray(index)], count, num_layers)
    mesh = Mesh.create(stacked(thickness), solid, tags=tags)
    _check_apart(mesh, thickness)
    return mesh


def _check_normals(normals: ArrayLike, count: int) -> np.ndarray:
    away = np.asarray(normals, dtype=float)
    if away.shape != (count, 3) or not np.allclose(np.linalg.norm(away, axis=1), 1, atol=1e-6):
        raise ValueError(f"normals: expected unit vectors at the nodes, shape ({count}, 3), got shape {away.shape}.")
    return away


def _volumes(points: np.ndarray, solid: np.ndarray, turned: np.ndarray) -> np.ndarray:
    edges = points[solid[:, 1:]] - points[solid[:, :1]]
    return turned * np.linalg.det(edges) / 6


def _check_upright(stacked, solid: np.ndarray, turned: np.ndarray, thickness: float, count: int) -> None:
    volume = _volumes(stacked(thickness), solid, turned)
    if volume.min() > 0:
        return
    if thickness > (size := float(np.ptp(stacked(0.0), axis=0).max())):
        raise ValueError(
            f"thickness: {thickness:.4g} m is more than the surface is large, {size:.4g} m. Are both in metres? If the "
            f"thickness is millimetres, give {1e-3 * thickness:.4g}; if the surface came from a file of another unit, "
            "read it with that: jeit.mesh.read(..., scale=1e-3) for millimetres, 0.0254 for inches, 1 for metres."
        )
    low, high = 0.0, thickness
    for _ in range(_BISECTION_STEPS):
        middle = (low + high) / 2
        upright = _volumes(stacked(middle), solid, turned).min() > 0
        low, high = (middle, high) if upright else (low, middle)
    worst = int(np.argmin(_volumes(stacked(high), solid, turned)))
    triangle = worst // 3 % count
    place = stacked(0.0)[solid[worst, 0]].round(6).tolist()
    most = (1 - 5e-4) * low  # does not exceed `low` after rounding to four digits
    raise ValueError(
        f"thickness: {thickness:.4g} m is more than the radius of curvature of the surface at triangle {triangle}, "
        f"near {place} m: the skin turns inside out there. It can be {most:.4g} m thick at most; or let it grow to the "
        "other side, or smooth the surface."
    )


def _check_apart(mesh: Mesh, thickness: float) -> None:
    points, boundary = np.asarray(mesh.points), np.asarray(mesh.facets)
    if (pair := first_crossing(points, boundary)) is not None:
        place = points[boundary[pair[0]]].mean(axis=0).round(6).tolist()
        raise ValueError(
            f"thickness: a skin {thickness:.4g} m thick grows into itself near {place} m, where parts of the surface "
            "lie closer together than that. Make it thinner."
        )
