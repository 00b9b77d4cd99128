"""Find contacts on a raster with OpenCV: region of interest, grey levels, threshold, opening, contours, centroids.

The steps are those of Chen et al., "New flexible tactile sensor based on electrical impedance tomography",
Micromachines 13 (2022) 185. The paper does not state the parameters of these steps. The defaults of `RasterFinder` give
smaller errors on simulated skins than a constant of 10 grey levels, an opening of 5 pixels and no smoothing (`python -m
benchmarks contacts`).
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import sparse
from scipy.special import ndtr

from jeit.arguments import describe, is_number
from jeit.arguments.extras import import_optional
from jeit.image import Raster
from jeit.mesh import Mesh
from jeit.touch.contacts.cell_finder import gaussian_means
from jeit.touch.contacts.finder import (
    AbstractFinder,
    Contact,
    ImageNoise,
    check_finder,
    noise_or_estimate,
    restore_sign,
    signed_image,
)
from jeit_solvers.module import Module

# Width in pixels of the band along a contact's edge in which noise may add cells to the contact, or remove them.
_CONTOUR_BAND_WIDTH = 15
# Maximum number of pixels along a side: more would need much memory, and no image has as many cells.
_MAX_PIXELS = 4096


class RasterStages(Module):
    """Results of the steps by which `RasterFinder` finds contacts; arrays are (rows, columns), with row 0 at the top.

    **Fields**: `region`: change on the pixels of the skin, NaN outside the skin; `grey`: grey levels, 0 to 255;
    `threshold`: whether each pixel is above the adaptive threshold; `opened`: whether the pixel remains after opening;
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
    black. A pixel is above the threshold if it exceeds the Gaussian mean of the block of pixels around it by `constant`
    grey levels. A morphological opening with an ellipse then removes small spots. Each external contour of the
    remaining pixels is the outline of a contact; the contact's centroid is that of the enclosed pixels.

    **Arguments:**

    - `mesh`: mesh of the images.
    - `pixels`: number of pixels along a side of the raster.
    - `smoothing`: standard deviation of the Gaussian that smooths images before the other steps, metres; see
      `CellFinder`.
    - `block`: width of the block of pixels around a pixel, an odd number of pixels.
    - `constant`: number of grey levels by which a pixel must exceed the mean of its block.
    - `opening`: width of the ellipse of the opening, an odd number of pixels.
    - `floor`: number of standard deviations of the noise that a cell must exceed to belong to a contact; without a
      floor, noise would be detected as contacts.
    - `sign`: 1 if touched skin conducts better, -1 if it conducts worse.

    **Fields**: `block`, `constant`, `opening`, `floor`, `sign`: as given; `raster`: raster of the mesh; `smoothing` (m,
    m): matrix that smooths images.

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
        for option_name, option_value, min_width in (("block", block, 3), ("opening", opening, 1)):
            if not (isinstance(option_value, int) and option_value >= min_width and option_value % 2):
                raise ValueError(
                    f"{option_name} must be an odd number of pixels from {min_width} up; it is "
                    f"{describe(option_value)}."
                )
        if not (isinstance(pixels, int) and 16 <= pixels <= _MAX_PIXELS):
            raise ValueError(f"pixels must be a whole number from 16 to {_MAX_PIXELS}; it is {describe(pixels)}.")
        if not (is_number(constant) and abs(constant) < 255):
            raise ValueError(f"constant must be grey levels, between −255 and 255; it is {describe(constant)}.")
        self.raster = Raster.create(mesh, shape=(pixels, pixels))
        self.smoothing = gaussian_means(mesh, smoothing)
        self.block, self.constant, self.opening = block, float(constant), opening
        self.floor, self.sign = float(floor), int(sign)

    def find(self, change, noise):
        """Find the contacts in an image; see `find_contacts`."""
        _, clear_change = self.above_noise(change, noise)
        return self._compute_stages(change, noise).contacts if clear_change.any() else []

    def stages(self, image: Float[np.ndarray, " m"], noise: ImageNoise | None = None) -> RasterStages:
        """Compute the grey levels, threshold, opening and contacts of an image (m,); arguments and errors: see
        `find_contacts`."""
        change = signed_image(self, image)
        raster_stages = self._compute_stages(change, noise_or_estimate(change, noise))
        region_and_contacts = self.sign * raster_stages.region, restore_sign(self, raster_stages.contacts)
        return eqx.tree_at(
            lambda shown_stages: (shown_stages.region, shown_stages.contacts), raster_stages, region_and_contacts
        )

    def _compute_stages(self, change: Float[np.ndarray, " m"], noise: ImageNoise) -> RasterStages:
        """Compute the results of all steps for a `change` (m,) whose sign makes contacts positive."""
        opencv = _import_opencv()
        cell_indices = np.asarray(self.raster.cell)
        is_on_skin = cell_indices >= 0
        change, clear_change = self.above_noise(change, noise)
        region_changes, clear_change = (
            np.where(is_on_skin, change[cell_indices], np.nan),
            np.where(is_on_skin, clear_change[cell_indices], 0.0),
        )
        max_change = clear_change.max()
        grey_levels = np.rint(255 * clear_change / (max_change or 1.0)).astype(np.uint8)
        # OpenCV selects pixels above the local mean minus its constant, so that a negative constant is passed. Pixels
        # outside the skin are set to the local mean of the skin's pixels: if they were black, the whole rim of the skin
        # would exceed the local mean.
        block_size = (self.block, self.block)
        skin_weights = np.maximum(opencv.GaussianBlur(is_on_skin * 1.0, block_size, 0), 1e-12)
        local_means = opencv.GaussianBlur(grey_levels * 1.0, block_size, 0) / skin_weights
        threshold_mask = opencv.adaptiveThreshold(
            np.where(is_on_skin, grey_levels, local_means).astype(np.uint8),
            255,
            opencv.ADAPTIVE_THRESH_GAUSSIAN_C,
            opencv.THRESH_BINARY,
            self.block,
            -self.constant,
        ) * is_on_skin.astype(np.uint8)
        opening_kernel = opencv.getStructuringElement(opencv.MORPH_ELLIPSE, (self.opening, self.opening))
        opened_mask = opencv.morphologyEx(threshold_mask, opencv.MORPH_OPEN, opening_kernel)
        contours, _ = opencv.findContours(opened_mask, opencv.RETR_EXTERNAL, opencv.CHAIN_APPROX_NONE)
        membership_noise = self._membership_noise(
            cell_indices[is_on_skin], (grey_levels - local_means - self.constant)[is_on_skin] * max_change / 255, noise
        )
        contacts = [
            self._describe_contact(
                opencv, region_changes, contour[:, 0], membership_noise, skin_weights, clear_change > 0, noise
            )
            for contour in contours
        ]
        sorted_contacts = sorted(
            (contact for contact in contacts if contact is not None), key=lambda contact: -contact.peak
        )
        return RasterStages(
            region_changes, grey_levels, threshold_mask > 0, opened_mask > 0, sorted_contacts, self.raster.extent
        )

    def _describe_contact(
        self,
        opencv,
        region_changes,
        contour: np.ndarray,
        membership_noise: tuple,
        skin_weights,
        is_above_noise,
        noise: ImageNoise,
    ) -> Contact | None:
        """Describe the contact that a contour (k, 2) of columns and rows encloses.

        Returns None if the contour encloses no pixel of the skin. `membership_noise`: see `_membership_noise`;
        `skin_weights` (rows, columns): weight of the skin's pixels in the local means; `is_above_noise` (rows,
        columns): whether pixels are above the noise floor.
        """
        filled_contour = np.zeros(region_changes.shape, np.uint8)
        opencv.drawContours(filled_contour, [contour[:, None]], -1, 1, opencv.FILLED)
        is_inside_contour = (filled_contour > 0) & np.isfinite(region_changes)
        if not is_inside_contour.any():
            return None
        pixel_centres = self.raster.pixel_centres()
        centroid, contact_area = (
            pixel_centres[is_inside_contour].mean(axis=0),
            float(self.raster.pixel_area * is_inside_contour.sum()),
        )
        (membership_slopes, independent_deviations), block_size = membership_noise, (self.block, self.block)
        # Cells join and leave a contact only at its edge: all pixels inside the contour belong to the contact, whatever
        # their grey levels.
        band_kernel = opencv.getStructuringElement(opencv.MORPH_ELLIPSE, (_CONTOUR_BAND_WIDTH, _CONTOUR_BAND_WIDTH))
        is_near_contour = (
            opencv.dilate(filled_contour, band_kernel) > opencv.erode(filled_contour, band_kernel)
        ) & np.isfinite(region_changes)
        cell_indices = np.asarray(self.raster.cell)
        centroid_shifts = np.where(
            is_near_contour[..., None], (pixel_centres - centroid) * self.raster.pixel_area / contact_area, 0.0
        )
        dependent_shifts = np.where(is_near_contour, membership_slopes[cell_indices], 0.0)[..., None] * centroid_shifts
        # Noise also shifts the threshold, which depends on the local mean of the pixels.
        mean_shifts = opencv.GaussianBlur(
            (dependent_shifts / skin_weights[..., None]).astype(np.float32), block_size, 0
        )
        centroid_derivative = self._sum_over_cells(dependent_shifts - mean_shifts * is_above_noise[..., None])
        centroid_displacements = (
            noise.distance(self.smoothing.T @ centroid_derivative),
            np.linalg.norm(independent_deviations[:, None] * self._sum_over_cells(centroid_shifts)),
        )
        contour_columns, contour_rows = contour.T
        contact_changes = region_changes[is_inside_contour]
        contact_integral = float(self.raster.pixel_area * contact_changes.sum())
        return Contact(
            centroid,
            contact_area,
            float(contact_changes.max()),
            contact_integral,
            pixel_centres[contour_rows, contour_columns],
            float(np.hypot(*centroid_displacements)),
        )

    def _sum_over_cells(self, pixel_pairs: Float[np.ndarray, "rows columns 2"]) -> Float[np.ndarray, "m 2"]:
        """Sum values of pixels over the pixels of each cell."""
        cell_indices = np.asarray(self.raster.cell)
        pixel_cells, pixel_values = cell_indices[cell_indices >= 0], pixel_pairs[cell_indices >= 0].T
        return np.stack(
            [np.bincount(pixel_cells, component_values, minlength=self.num_cells) for component_values in pixel_values],
            axis=-1,
        )

    def _membership_noise(
        self, cell_indices: np.ndarray, pixel_excess: np.ndarray, noise: ImageNoise
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the uncertainty of cells' membership in a contact: slope (m,) against the cell's value, and standard
        deviation (m,) of the independent part.

        A cell is wholly inside or outside a contact (membership 1 or 0). Suppose that the smoothed value of a cell
        exceeds the threshold by `pixel_excess` on average, with standard deviation σ. The cell is then inside with
        probability p = Φ(z), z = excess / σ, where Φ and φ are the normal distribution and its density. On average, the
        cell's membership changes with its value at the rate φ(z) / σ. The remaining part of the membership has the
        standard deviation √(p (1 − p) − φ(z)²), independently for each cell.
        """
        num_pixels = np.bincount(cell_indices, minlength=self.num_cells)
        mean_excess = np.bincount(cell_indices, pixel_excess, minlength=self.num_cells) / np.maximum(num_pixels, 1)
        cell_deviations = np.maximum(noise.smoothed(self.smoothing), np.finfo(float).tiny)
        normalised_excess = mean_excess / cell_deviations
        membership_probability, normal_density = (
            ndtr(normalised_excess),
            np.exp(-(normalised_excess**2) / 2) / np.sqrt(2 * np.pi),
        )
        return normal_density / cell_deviations, np.sqrt(
            np.maximum(membership_probability * (1 - membership_probability) - normal_density**2, 0.0)
        )


def _import_opencv() -> Any:
    return import_optional("cv2", "RasterFinder", "CellFinder needs nothing more.")
