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
    off_wall = np.abs(np.asarray(body.outline.signed_distance(place[:, :2])))
    off_lid = np.minimum(np.abs(z), np.abs(z - top))
    for number in np.flatnonzero(np.minimum(off_wall, off_lid) > _MOST_OFF * smaller)[:1]:
        raise ValueError(
            f"positions: electrode {number + 1} at {np.round(place[number], 6).tolist()} m lies "
            f"{1e3 * min(off_wall[number], off_lid[number]):.3g} mm off the body's surface; give a place on it."
        )
    out = np.maximum(height / 2 - z, z + height / 2 - top)
    for number in np.flatnonzero((off_wall <= off_lid) & (out > _MOST_OUT * height))[:1]:
        low, high = z[number] - height[number] / 2, z[number] + height[number] / 2
        raise ValueError(
            f"electrode {number + 1} reaches from {low:.4g} to {high:.4g} m, and its wall from 0 to {top:.4g} m: give "
            "the size of what lies on the wall, and its middle."
        )
