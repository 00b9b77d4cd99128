"""The mesh of a body for electrodes on it, fine at their edges, where the current density is unbounded."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jeit.electrodes.electrodes import AbstractElectrodes
from jeit.mesh import Body, Mesh, OwnMesh, Rectangle, Solid
from jeit.mesh.sizes import size_checked

# Distance from a face within which a position lies on it, relative to the body's size; as in the check of electrodes.
_ON = 1e-3
# Places round a patch on a lid that say where it ends.
_ROUND = 16


@size_checked()
def body_mesh(body: Body, electrodes: AbstractElectrodes, num_points: int | None = None) -> Mesh:
    """A mesh of about `num_points` nodes, finer where electrodes are, their edges in faces of its cells where they are
    rectangles on a box, or on the wall of a cylinder; of a body that comes as a mesh, that. Raises `ValueError` where
    `num_points` is missing, and where it has no effect."""
    if isinstance(body, OwnMesh):
        if num_points is not None:
            raise ValueError(
                f"num_points has no effect: the body is a mesh of your own, of {body.given.num_points} nodes, and is "
                "taken as it is; leave it out, or give a finer or coarser mesh."
            )
        return body.given
    if num_points is None:
        raise ValueError(
            "num_points is missing: give about how many nodes the mesh is to have, such as 2000, or 10000 of a solid."
        )
    if not isinstance(body, Solid):
        return body.mesh(num_points=num_points, refine=electrodes.refinement(body) or None)
    from jeit.electrodes.patches import FacePatches
    from jeit.mesh.graded import graded_box, graded_layers

    if not isinstance(electrodes, FacePatches):
        return body.mesh(num_points=num_points, refine=electrodes.refinement(body) or None)
    outline, height = body.outline, float(body.thickness)
    place = np.asarray(electrodes.position)
    half = np.stack([np.asarray(electrodes.width), np.asarray(electrodes.height)], axis=1) / 2
    x_min, x_max, y_min, y_max = outline.extent
    near = _ON * max(x_max - x_min, y_max - y_min, height)
    flat = (np.abs(place[:, 2]) < near) | (np.abs(place[:, 2] - height) < near)
    upright = place[~flat, 2, None] + half[~flat, 1:] * np.array([-1.0, 1.0])
    if isinstance(outline, Rectangle):
        across = (np.abs(place[:, 0] - x_min) < near) | (np.abs(place[:, 0] - x_max) < near)
        ends_x = _ends(place[:, 0], half[:, 0], flat | ~across)
        ends_y = np.concatenate([_ends(place[:, 1], half[:, 1], flat), _ends(place[:, 1], half[:, 0], across & ~flat)])
        return graded_box(outline, height, (ends_x, ends_y, upright.ravel()), num_points)
    rims = [np.zeros((0, 2)), *(_rim(outline, *one) for one in zip(place, half, flat, strict=True))]
    return graded_layers(outline, height, upright.ravel(), np.concatenate(rims), num_points)


def _ends(place: Float[np.ndarray, " L"], half: Float[np.ndarray, " L"], some) -> Float[np.ndarray, " e"]:
    """Places where some electrodes begin and end along an axis."""
    return np.concatenate([(place - half)[some], (place + half)[some]])


def _rim(outline, place, half, flat: bool) -> Float[np.ndarray, "p 2"]:
    """Places where an electrode ends, seen from above: all round on a horizontal face, at its two ends on the wall."""
    if flat:
        angle = 2 * np.pi * np.arange(_ROUND) / _ROUND
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        # For a rectangle, the points where rays meet its sides.
        return place[:2] + circle * half / np.abs(circle).max(axis=1, keepdims=True)
    nearest = np.asarray(outline.nearest(place[None, :2]))[0]
    step = 1e-3 * half[0]
    ahead = np.asarray(outline.nearest(nearest + step * np.eye(2)))
    tangent = (ahead - nearest)[np.argmax(np.linalg.norm(ahead - nearest, axis=1))]
    tangent = tangent / np.linalg.norm(tangent)
    return np.asarray(outline.nearest(np.stack([place[:2] - half[0] * tangent, place[:2] + half[0] * tangent])))
