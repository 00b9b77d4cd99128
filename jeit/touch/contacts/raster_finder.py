"""Find contacts on a raster with OpenCV: region of interest, grey levels, threshold, opening, contours, centroids.

The steps are those of Chen et al., "New flexible tactile sensor based on electrical impedance tomography",
Micromachines 13 (2022) 185. The paper does not state sizes. Those used here give smaller errors on simulated skins than
a constant of 10, an opening of 5 pixels and no smoothing (`python -m benchmarks contacts`).
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import sparse
from scipy.special import ndtr

from jeit.arguments import describe, is_number
from jeit.arguments.extras import optional
from jeit.image import Raster
from jeit.mesh import Mesh
from jeit.touch.contacts.cell_finder import gaussian_means
from jeit.touch.contacts.finder import (
    AbstractFinder,
    Contact,
    check_finder,
    noise_or_estimate,
    restore_sign,
    signed_image,
)
from jeit.touch.contacts.image_noise import ImageNoise
from jeit_solvers.module import Module

# Width in pixels of the band along a contact's edge in which cells may join or leave the contact.
_EDGE = 15
# Maximum number of pixels along a side: more would need much memory, and no image has as many cells.
_MOST_PIXELS = 4096


class RasterStages(Module):
    """Results of the steps of `RasterFinder`; arrays are (rows, columns), with row 0 at the top.

    **Fields**: `region`: change on the pixels of the skin, NaN beside the skin; `grey`: grey levels, 0 to 255;
    `threshold`: whether each pixel is above the adaptive threshold; `opened`: whether it remains after opening;
    `contacts`: the contacts found; `extent`: (x_min, x_max, y_min, y_max), metres.
    """

    region: Float[np.ndarray, "rows columns"]
    grey: UInt8[np.ndarray, "rows columns"]
    threshold: Bool[np.ndarray, "rows columns"]
    opened: Bool[np.ndarray, "rows columns"]
    contacts: list[Contact]
    extent: tuple[float, float, float, float]


class RasterFinder(AbstractFinder):
    """Finds contacts by an adaptive threshold on a raster.

    Grey levels are proportional to the change, up to 255 for the image's maximum; pixels below the noise floor are
    black. Pixels are kept if they are some levels above the Gaussian mean of the block around them. They are then
    opened with an ellipse. Each external contour is a contact, whose centroid is that of the enclosed pixels.

    **Arguments:**

    - `mesh`: mesh of the images.
    - `pixels`: number of pixels along a side of the raster.
    - `smoothing`: standard deviation of the Gaussian that smooths images first, metres; see `CellFinder`.
    - `block`: width of the block, an odd number of pixels.
    - `constant`: number of grey levels.
    - `opening`: width of the ellipse, an odd number of pixels.
    - `floor`: number of standard deviations of the noise that a cell must exceed to belong to a contact; without a
      floor, contacts would be found in images without any.
    - `sign`: 1 if touched skin conducts better, -1 if it conducts worse.

    **Fields**: the settings; `raster`: raster of the mesh; `smoothing` (m, m): matrix that smooths images.

    **Example:**

    ```python
    raster_finder = RasterFinder(model.mesh, pixels=128)
    contacts = find_contacts(raster_finder, image, noise)
    ```
    """

    raster: Raster
    smoothing: sparse.csr_array
    block: int
    constant: float
    opening: int
    floor: float
    sign: int

    def __init__(
        self,
        mesh: Mesh,
        *,
        pixels: int = 256,
        smoothing: float | None = None,
        block: int = 101,
        constant: float = 20.0,
        opening: int = 9,
        floor: float = 5.0,
        sign: int = 1,
    ):
        """Create a finder for images on a mesh.

        `pixels`: number of pixels along a side of the raster; `smoothing`: metres, see `CellFinder`. Raises
        `ImportError` without OpenCV, and `ValueError` for a three-dimensional mesh and sizes that are not odd numbers
        of pixels.
        """
        _import_opencv()
        check_finder(mesh, sign, floor)
        for name, value, least in (("block", block, 3), ("opening", opening, 1)):
            if not (isinstance(value, int) and value >= least and value % 2):
                raise ValueError(f"{name} must be an odd number of pixels from {least} up; it is {describe(value)}.")
        if not (isinstance(pixels, int) and 16 <= pixels <= _MOST_PIXELS):
            raise ValueError(f"pixels must be a whole number from 16 to {_MOST_PIXELS}; it is {describe(pixels)}.")
        if not (is_number(constant) and abs(constant) < 255):
            raise ValueError(f"constant must be grey levels, between −255 and 255; it is {describe(constant)}.")
        self.raster = Raster.create(mesh, shape=(pixels, pixels))
        self.smoothing = gaussian_means(mesh, smoothing)
        self.block, self.constant, self.opening = block, float(constant), opening
        self.floor, self.sign = float(floor), int(sign)

    def find(self, change, noise):
        """See `find_contacts`."""
        _, clear = self.above_noise(change, noise)
        return self._stages(change, noise).contacts if clear.any() else []

    def stages(self, image: Float[np.ndarray, " m"], noise: ImageNoise | None = None) -> RasterStages:
        """Compute the results of all steps for an image (m,) and its noise; arguments and errors are those of
        `find_contacts`."""
        change = signed_image(self, image)
        found = self._stages(change, noise_or_estimate(change, noise))
        own = self.sign * found.region, restore_sign(self, found.contacts)
        return eqx.tree_at(lambda stages: (stages.region, stages.contacts), found, own)

    def _stages(self, change: Float[np.ndarray, " m"], noise: ImageNoise) -> RasterStages:
        """Compute the results of all steps for a `change` (m,) whose sign makes contacts positive."""
        opencv = _import_opencv()
        cell = np.asarray(self.raster.cell)
        inside = cell >= 0
        change, clear = self.above_noise(change, noise)
        region, clear = np.where(inside, change[cell], np.nan), np.where(inside, clear[cell], 0.0)
        highest = clear.max()
        grey = np.rint(255 * clear / (highest or 1.0)).astype(np.uint8)
        # OpenCV keeps pixels above the local mean minus its constant, so that a negative constant is passed. Pixels
        # beside the skin are set to the mean of the skin's pixels nearby: if they were black, the whole rim of the skin
        # would exceed the local mean.
        size = (self.block, self.block)
        weight = np.maximum(opencv.GaussianBlur(inside * 1.0, size, 0), 1e-12)
        near = opencv.GaussianBlur(grey * 1.0, size, 0) / weight
        threshold = opencv.adaptiveThreshold(
            np.where(inside, grey, near).astype(np.uint8),
            255,
            opencv.ADAPTIVE_THRESH_GAUSSIAN_C,
            opencv.THRESH_BINARY,
            self.block,
            -self.constant,
        ) * inside.astype(np.uint8)
        ellipse = opencv.getStructuringElement(opencv.MORPH_ELLIPSE, (self.opening, self.opening))
        opened = opencv.morphologyEx(threshold, opencv.MORPH_OPEN, ellipse)
        contours, _ = opencv.findContours(opened, opencv.RETR_EXTERNAL, opencv.CHAIN_APPROX_NONE)
        stray = self._membership_noise(cell[inside], (grey - near - self.constant)[inside] * highest / 255, noise)
        contacts = [
            self._contact(opencv, region, contour[:, 0], stray, weight, clear > 0, noise) for contour in contours
        ]
        kept = sorted((one for one in contacts if one is not None), key=lambda one: -one.peak)
        return RasterStages(region, grey, threshold > 0, opened > 0, kept, self.raster.extent)

    def _contact(
        self, opencv, region, contour: np.ndarray, stray: tuple, weight, clear, noise: ImageNoise
    ) -> Contact | None:
        """Describe the contact that a contour (k, 2) of columns and rows encloses.

        Returns None if the contour encloses no pixel of the skin. `stray`: see `_membership_noise`; `weight` (rows,
        columns): weight of the skin's pixels in the local means; `clear` (rows, columns): whether pixels are above the
        noise floor.
        """
        filled = np.zeros(region.shape, np.uint8)
        opencv.drawContours(filled, [contour[:, None]], -1, 1, opencv.FILLED)
        within = (filled > 0) & np.isfinite(region)
        if not within.any():
            return None
        place = self.raster.pixel_centres()
        centroid, area = place[within].mean(axis=0), float(self.raster.pixel_area * within.sum())
        (together, alone), size = stray, (self.block, self.block)
        # Cells join and leave a contact only at its edge: everything inside the contour counts, whatever its grey
        # level.
        ellipse = opencv.getStructuringElement(opencv.MORPH_ELLIPSE, (_EDGE, _EDGE))
        edge = (opencv.dilate(filled, ellipse) > opencv.erode(filled, ellipse)) & np.isfinite(region)
        cell = np.asarray(self.raster.cell)
        lever = np.where(edge[..., None], (place - centroid) * self.raster.pixel_area / area, 0.0)
        follows = np.where(edge, together[cell], 0.0)[..., None] * lever
        # Noise moves the threshold too, through the local mean of the pixels.
        spread = opencv.GaussianBlur((follows / weight[..., None]).astype(np.float32), size, 0)
        slope = self._sum_over_cells(follows - spread * clear[..., None])
        moved = noise.distance(self.smoothing.T @ slope), np.linalg.norm(alone[:, None] * self._sum_over_cells(lever))
        column, row = contour.T
        change = region[within]
        integral = float(self.raster.pixel_area * change.sum())
        return Contact(centroid, area, float(change.max()), integral, place[row, column], float(np.hypot(*moved)))

    def _sum_over_cells(self, values: Float[np.ndarray, "rows columns 2"]) -> Float[np.ndarray, "m 2"]:
        """Sum values of pixels over the pixels of each cell."""
        cell = np.asarray(self.raster.cell)
        own, weights = cell[cell >= 0], values[cell >= 0].T
        return np.stack([np.bincount(own, one, minlength=self.num_cells) for one in weights], axis=-1)

    def _membership_noise(
        self, cell: np.ndarray, above: np.ndarray, noise: ImageNoise
    ) -> tuple[np.ndarray, np.ndarray]:
        """Uncertainty of the membership of every cell: slope (m,) with respect to its value, and independent part (m,).

        Whole cells are inside or outside a contact. A cell whose smoothed value exceeds the threshold by `above` on
        average, with standard deviation σ, is inside with probability p = Φ(z), z = above / σ. On average, its
        membership changes with its value at the rate φ(z) / σ; the rest has the standard deviation √(p (1 − p) −
        φ(z)²), independently for each cell.
        """
        number = np.bincount(cell, minlength=self.num_cells)
        mean = np.bincount(cell, above, minlength=self.num_cells) / np.maximum(number, 1)
        deviation = np.maximum(noise.smoothed(self.smoothing), np.finfo(float).tiny)
        off = mean / deviation
        chance, density = ndtr(off), np.exp(-(off**2) / 2) / np.sqrt(2 * np.pi)
        return density / deviation, np.sqrt(np.maximum(chance * (1 - chance) - density**2, 0.0))


def _import_opencv() -> Any:
    return optional("cv2", "RasterFinder", "CellFinder needs nothing more.")
