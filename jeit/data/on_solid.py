"""Whether described electrodes lie on the solid that is described with them, and are no larger than it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jeit.electrodes import AbstractElectrodes, FaceDiscs, FacePatches
from jeit.electrodes.placing import check_apart, check_on_surface, check_size
from jeit.mesh import Disk, Rectangle, Solid

# Of an electrode's smaller size: how far off the surface it may be, and of its height: how far out above the wall.
_MOST_OFF = 0.1
_MOST_OUT = 0.02


def check_on_solid(electrodes: AbstractElectrodes, body: Solid) -> None:
    """Raise `ValueError` for the first electrode off the surface, the first two at one place, the first patch wider
    than the body, and the first partly above or below a wall."""
    if isinstance(electrodes, FacePatches):
        height = np.asarray(electrodes.height)
        smaller = np.minimum(electrodes.width, height)
    elif isinstance(electrodes, FaceDiscs):
        smaller, height = 2 * np.asarray(electrodes.radius), np.zeros(electrodes.num_electrodes)
    else:
        return
    place = np.asarray(electrodes.position)
    check_on_surface(place, _MOST_OFF * smaller, lambda places: _off(body, places)[0])
    check_apart(place, smaller)
    if isinstance(electrodes, FacePatches):
        x_min, x_max, y_min, y_max = body.extent
        sides = x_max - x_min, y_max - y_min
        across = max(sides) if isinstance(body.outline, Disk | Rectangle) else float(np.hypot(*sides))
        check_size("width", np.asarray(electrodes.width), across, "the body")
    z, top = place[:, 2], body.thickness
    out, on_wall = np.maximum(height / 2 - z, z + height / 2 - top), _off(body, place)[1]
    for number in np.flatnonzero(on_wall & (out > _MOST_OUT * height))[:1]:
        low, high = z[number] - height[number] / 2, z[number] + height[number] / 2
        key = "height: " if height[number] > top else ""
        raise ValueError(
            f"{key}electrode {number + 1} reaches from {low:.4g} to {high:.4g} m, and its wall from 0 to {top:.4g} m: "
            "give the size of what lies on the wall, and its middle."
        )


def _off(body: Solid, place: Float[np.ndarray, "L 3"]):
    """How far places are off the surface, metres, and whether its wall is nearer than its lids."""
    z = place[:, 2]
    within, between = np.asarray(body.outline.signed_distance(place[:, :2])), np.minimum(z, body.thickness - z)
    off_wall, off_lid = np.abs(within), np.abs(between)
    # Outside, beyond the wall and beyond the lid are two sides of a right angle.
    outside = np.hypot(np.minimum(within, 0), np.minimum(between, 0))
    return np.where(outside > 0, outside, np.minimum(off_wall, off_lid)), off_wall <= off_lid
