"""Whether described electrodes lie on the solid that is described with them, and do not stick out above its walls."""

import numpy as np

from jeit.electrodes import AbstractElectrodes, FaceDiscs, FacePatches
from jeit.mesh import Solid

# Of an electrode's smaller size: how far off the surface it may be, and of its height: how far out above the wall.
_MOST_OFF = 0.1
_MOST_OUT = 0.02


def check_on_solid(electrodes: AbstractElectrodes, body: Solid) -> None:
    """Raise `ValueError` for the first electrode off the surface, and the first patch partly above or below a wall."""
    if isinstance(electrodes, FacePatches):
        height = np.asarray(electrodes.height)
        smaller = np.minimum(electrodes.width, height)
    elif isinstance(electrodes, FaceDiscs):
        smaller, height = 2 * np.asarray(electrodes.radius), np.zeros(electrodes.num_electrodes)
    else:
        return
    place = np.asarray(electrodes.position)
    z, top = place[:, 2], body.thickness
    within, between = np.asarray(body.outline.signed_distance(place[:, :2])), np.minimum(z, top - z)
    off_wall, off_lid = np.abs(within), np.abs(between)
    # Outside, beyond the wall and beyond the lid are two sides of a right angle.
    outside = np.hypot(np.minimum(within, 0), np.minimum(between, 0))
    off = np.where(outside > 0, outside, np.minimum(off_wall, off_lid))
    for number in np.flatnonzero(off > _MOST_OFF * smaller)[:1]:
        raise ValueError(
            f"positions: electrode {number + 1} at {np.round(place[number], 6).tolist()} m lies "
            f"{_distance(float(off[number]))} off the body's surface; give a place on it."
        )
    out = np.maximum(height / 2 - z, z + height / 2 - top)
    for number in np.flatnonzero((off_wall <= off_lid) & (out > _MOST_OUT * height))[:1]:
        low, high = z[number] - height[number] / 2, z[number] + height[number] / 2
        raise ValueError(
            f"electrode {number + 1} reaches from {low:.4g} to {high:.4g} m, and its wall from 0 to {top:.4g} m: give "
            "the size of what lies on the wall, and its middle."
        )


def _distance(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm" if metres < 1 else f"{metres:.3g} m"
