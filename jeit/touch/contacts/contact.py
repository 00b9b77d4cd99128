"""`Contact`: a region of an image where something touches the skin."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Float


class Contact(eqx.Module):
    """A contact in an image.

    **Fields**: `centroid` (x, y), metres, on a surface in space (x, y, z); `area`, m², of the region; `peak`, the
    strongest change in it, in the unit of the image and with its sign; `integral` of the change over the region, that
    unit times m²; `contour` (k, d), metres, the region's outline, open (the last point is not the first again);
    `deviation`, metres: the root mean square distance by which noise of the image moves the centroid, to first order
    (`ImageNoise` describes the noise). It includes neither the blur of the image nor its errors without noise.
    """

    centroid: Float[np.ndarray, " d"]
    area: float
    peak: float
    integral: float
    contour: Float[np.ndarray, "k d"]
    deviation: float
