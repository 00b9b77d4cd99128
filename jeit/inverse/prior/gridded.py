"""A Gaussian covariance between many places without a matrix of pairs of them, by way of a regular grid.

Γ = P G Pᵀ: G is the covariance on a grid of a third of the correlation length, which is a product of one along x, one
along y and one along z and is applied axis by axis; P is cubic interpolation from four grid points along each axis,
which is off by some thousandths at that spacing.
"""

import numpy as np
import scipy.sparse
from jaxtyping import Float

# Grid points per correlation length, and points of a cubic along an axis.
_PER_LENGTH, _CUBIC = 3, 4
# Grid points beyond which a grid is no gain.
_MOST = 500_000


class GriddedGaussian:
    """Γ_ij = exp(-|x_i - x_j|² / 2 length²) between `places` (m, d), metres; `length` in metres."""

    def __init__(self, places: Float[np.ndarray, "m d"], length: float):
        spacing = length / _PER_LENGTH
        low = places.min(axis=0) - 1.5 * spacing
        self._shape = tuple(int(count) for count in np.ceil((places.max(axis=0) - low) / spacing) + 2)
        steps = [np.arange(count) for count in self._shape]
        self._along = [np.exp(-((one[:, None] - one) ** 2) / (2 * _PER_LENGTH**2)) for one in steps]
        self._interpolation = _cubic((places - low) / spacing, self._shape)

    @staticmethod
    def suits(places: Float[np.ndarray, "m d"], length: float) -> bool:
        """Whether the grid would have fewer points than there are places."""
        extent = np.ptp(places, axis=0) / length * _PER_LENGTH + 5
        return bool(np.prod(extent) < min(len(places), _MOST))

    def product(self, columns: Float[np.ndarray, "m k"]) -> Float[np.ndarray, "m k"]:
        """Γ times columns."""
        grid = (self._interpolation.T @ columns).reshape(*self._shape, -1)
        for axis, along in enumerate(self._along):
            grid = np.moveaxis(np.tensordot(along, grid, axes=(1, axis)), 0, axis)
        return self._interpolation @ grid.reshape(-1, columns.shape[1])


def _cubic(place: Float[np.ndarray, "m d"], shape: tuple[int, ...]) -> scipy.sparse.csr_array:
    """Weights (m, grid points) of Lagrange's cubics at places in units of the grid."""
    first = np.floor(place).astype(int) - 1
    t = place - first  # from 1 to 2
    nodes = np.arange(_CUBIC)
    along = np.stack(
        [np.prod([(t - j) / (i - j) for j in nodes if j != i], axis=0) for i in nodes], axis=-1
    )  # (m, d, 4)
    weight, index = np.ones((len(place), 1)), np.zeros((len(place), 1), int)
    for axis, count in enumerate(shape):
        weight = (weight[:, :, None] * along[:, axis, None, :]).reshape(len(place), -1)
        index = (index[:, :, None] * count + (first[:, axis, None] + nodes)[:, None, :]).reshape(len(place), -1)
    ends = np.arange(0, weight.size + 1, weight.shape[1])
    return scipy.sparse.csr_array((weight.ravel(), index.ravel(), ends), shape=(len(place), int(np.prod(shape))))
