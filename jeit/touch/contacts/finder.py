"""Common interface of finders of contacts, and the noise of images: standard deviations and covariance of the cells.
A contact must exceed this noise."""

from abc import abstractmethod

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy import sparse

from jeit.arguments import check_kind, counted, describe, is_number, real_array
from jeit.inverse.linear.one_step import LinearReconstruction
from jeit.mesh import Mesh, check_flat
from jeit_solvers.module import Module

# Minimum number of frames for estimating the standard deviation.
_MIN_NUM_FRAMES = 10
# Ratio of the standard deviation of normal noise to its median absolute value.
_DEVIATION_PER_MEDIAN_MAGNITUDE = 1.4826
# Number of standard deviations beyond which cells are removed.
_CLIPPING_DEVIATIONS = 3.0
# Ratio of the standard deviation of all cells to that of the cells that remain, for normal noise.
_CLIPPING_CORRECTION = 1.0136
# Maximum number of rounds of clipping.
_MAX_CLIPPING_ROUNDS = 20


class ImageNoise(Module):
    """Noise of linear images.

    **Fields**: `deviation` (m,): standard deviation of every cell, in the unit of the image; `factor` (r, m): matrix
    whose product factorᵀ factor is the covariance of the cells, None if the covariance is unknown.

    **Example:**

    ```python
    noise = ImageNoise.of_frames(linear, empty)
    contacts = find_contacts(finder, image, noise)
    ```
    """

    deviation: Float[np.ndarray, " m"]
    factor: Float[np.ndarray, "r m"] | None = None

    def __check_init__(self):
        """Check the fields.

        Raises `ValueError` for deviations that are negative or not finite, and a factor with a different number of
        cells.
        """
        requirement_text = "an array (m,), one number a cell, zero or more and finite, in the unit of the image"
        check_kind("deviation", self.deviation, (np.ndarray, jax.Array), requirement_text)
        deviation = real_array("deviation", self.deviation, requirement_text)
        if deviation.ndim != 1:
            raise ValueError(f"deviation must be {requirement_text}; it has shape {deviation.shape}.")
        if not (np.isfinite(deviation).all() and (deviation >= 0).all()):
            raise ValueError(f"deviation must be {requirement_text}; some of it is negative or not finite.")
        if self.factor is not None and np.shape(self.factor)[1:] != deviation.shape:
            factor_shape = np.shape(self.factor)
            raise ValueError(f"factor has shape {factor_shape}; give (r, {deviation.size}), a column for each cell.")

    @classmethod
    def of_frames(cls, reconstruction: LinearReconstruction, frames: Float[np.ndarray, "n M"]) -> "ImageNoise":
        """Estimate the noise from at least ten repeated frames (n, M), volts, of the untouched skin.

        The noise is that of images reconstructed from the deviations of the frames from their mean. The noise includes
        drift only if the frames span as long a time as later readings. Raises `ValueError` for fewer than ten frames, a
        number of channels that is not that of the reconstruction, NaN, and frames that are all the same.
        """
        check_kind("reconstruction", reconstruction, LinearReconstruction, "a linear one, such as of one_step(...)")
        frames = real_array("frames", frames, "voltages (n, M)")
        if frames.ndim != 2 or len(frames) < _MIN_NUM_FRAMES:
            raise ValueError(
                f"frames has shape {frames.shape}; give (n, {reconstruction.num_measurements}) volts of an untouched "
                f"skin, {counted(_MIN_NUM_FRAMES, 'frame')} or more."
            )
        if (frames == frames[0]).all():
            raise ValueError("frames are all the same and show no noise. Give what was read, not copies of a frame.")
        noise_images = np.asarray(reconstruction.image(frames - frames.mean(axis=0)))
        return cls._from_covariance_factor(noise_images / np.sqrt(len(frames) - 1))

    @classmethod
    def of_images(cls, images: Float[np.ndarray, "n m"]) -> "ImageNoise":
        """Estimate the noise from at least ten images (n, m) of the untouched skin. Raises `ValueError` for fewer than
        ten images, NaN, and images that are all the same."""
        images = real_array("images", images, "changes of conductivity (n, m)")
        if images.ndim != 2 or len(images) < _MIN_NUM_FRAMES or not np.isfinite(images).all():
            raise ValueError(
                f"images has shape {images.shape}; give {counted(_MIN_NUM_FRAMES, 'image')} or more of the untouched "
                "skin, (n, m), without NaN."
            )
        if (images == images[0]).all():
            raise ValueError("images are all the same and show no noise. Give those of frames that were read.")
        return cls._from_covariance_factor((images - images.mean(axis=0)) / np.sqrt(len(images) - 1))

    @classmethod
    def of_channels(cls, reconstruction: LinearReconstruction, deviation: ArrayLike) -> "ImageNoise":
        """Compute the noise from the standard deviations of independent channels, (M,) or one number for all, volts.

        The difference of two frames has √2 times the standard deviation of one frame. Raises `ValueError` for
        deviations that are negative, not finite, all zero, or for a different number of channels.
        """
        check_kind("reconstruction", reconstruction, LinearReconstruction, "a linear one, such as of one_step(...)")
        num_channels = reconstruction.num_measurements
        deviation = real_array("deviation", deviation, f"one number, or ({num_channels},), volts")
        if deviation.shape not in ((), (num_channels,)):
            raise ValueError(f"deviation has shape {deviation.shape}; give one number, or ({num_channels},), volts.")
        if not (np.isfinite(deviation).all() and (deviation >= 0).all() and deviation.any()):
            raise ValueError("deviation must be finite, zero or more, and not zero for all channels, in volts.")
        return cls._from_covariance_factor(
            np.broadcast_to(deviation, num_channels)[:, None] * np.asarray(reconstruction.matrix).T
        )

    @classmethod
    def of_image(cls, image: Float[np.ndarray, " m"]) -> "ImageNoise":
        """Estimate the noise from an image (m,) alone, with or without contacts, by sigma clipping.

        Cells more than three standard deviations from the median are removed, repeatedly. The standard deviation of the
        remaining cells is taken as that of every cell. Ringing, and artefacts of a contact all over the image, count as
        noise; weak contacts beside strong contacts are therefore missed. Cells that are noisier than most are mistaken
        for contacts. Raises `ValueError` for an image that is not (m,), finite and real.
        """
        image_values = np.asarray(image)
        if (
            image_values.ndim != 1
            or not image_values.size
            or image_values.dtype.kind not in "iuf"
            or not np.isfinite(image_values).all()
        ):
            raise ValueError("image must be real and finite, one value a cell (m,).")
        return cls(np.full(image_values.shape, _clipped_deviation(image_values)))

    @classmethod
    def _from_covariance_factor(cls, covariance_factor: np.ndarray) -> "ImageNoise":
        return cls(np.sqrt((covariance_factor**2).sum(axis=0)), covariance_factor)

    def distance(self, slope: Float[np.ndarray, "m 2"]) -> float:
        """Compute the root mean square displacement, metres, of a position that is computed from a noisy image.

        `slope` (m, 2): derivative of the position with respect to the image, metres per unit of the image. If the
        covariance of the cells is unknown, the result is an upper bound.
        """
        if self.factor is None:
            return float(np.linalg.norm(self.deviation @ np.abs(slope)))
        return float(np.linalg.norm(self.factor @ slope))

    def smoothed(self, smoothing: sparse.csr_array) -> Float[np.ndarray, " m"]:
        """Compute the standard deviation (m,) of every cell of an image after smoothing by a matrix (m, m).

        If the covariance of the cells is unknown, the result is an upper bound.
        """
        if self.factor is None:
            return smoothing @ self.deviation
        return np.sqrt(((smoothing @ self.factor.T) ** 2).sum(axis=1))


def _clipped_deviation(cell_values: Float[np.ndarray, " m"]) -> float:
    """Compute the standard deviation of values (m,) without outliers, beyond three standard deviations of the median.

    To identify outliers, the standard deviation is estimated from the median absolute deviation.
    """
    remaining_values = cell_values
    for _ in range(_MAX_CLIPPING_ROUNDS):
        median_value = np.median(remaining_values)
        robust_deviation = _DEVIATION_PER_MEDIAN_MAGNITUDE * np.median(np.abs(remaining_values - median_value))
        unclipped_values = cell_values[np.abs(cell_values - median_value) <= _CLIPPING_DEVIATIONS * robust_deviation]
        if len(unclipped_values) == len(remaining_values):
            break
        remaining_values = unclipped_values
    return float(_CLIPPING_CORRECTION * remaining_values.std())


class Contact(Module):
    """A contact in an image.

    **Fields**: `centroid`: (x, y), or (x, y, z) on a surface in space, metres; `area`: area of the region, m²; `peak`:
    strongest change in the region, with its sign, in the unit of the image; `integral`: integral of the change over the
    region, in the unit of the image times m²; `contour` (k, d): k points of the region's outline, metres, without
    repetition of the first point at the end; `deviation`: root mean square displacement of the centroid by noise of the
    image (see `ImageNoise`), to first order, metres. The deviation includes neither the blur of the image nor
    systematic errors.

    **Example:**

    ```python
    contact = find_contacts(finder, image, noise)[0]
    print(isinstance(contact, Contact), contact.centroid, contact.area)
    ```
    """

    centroid: Float[np.ndarray, " d"]
    area: float
    peak: float
    integral: float
    contour: Float[np.ndarray, "k d"]
    deviation: float


class AbstractFinder(Module):
    """Finds contacts in images on one mesh; everything that does not depend on the image is computed in advance.

    **Fields**: `smoothing` (m, m): matrix that smooths an image before contacts are found; `sign`: 1 if touched skin
    conducts better, -1 if it conducts worse; `floor`: number of standard deviations of the noise that a cell must
    exceed to belong to a contact.
    """

    smoothing: eqx.AbstractVar[sparse.csr_array]
    sign: eqx.AbstractVar[int]
    floor: eqx.AbstractVar[float]

    @property
    def num_cells(self) -> int:
        """Number m of cells of an image."""
        return self.smoothing.indptr.size - 1

    @abstractmethod
    def find(self, change: Float[np.ndarray, " m"], noise: ImageNoise) -> list[Contact]:
        """Find contacts in an image of changes `change` (m cells,), whose sign makes contacts positive."""

    def above_noise(
        self, change: Float[np.ndarray, " m"], noise: ImageNoise
    ) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """Return the smoothed image of changes (m,), and a copy of this image that is zero below the noise floor."""
        change = self.smoothing @ change
        # Upper bound of the standard deviation of a cell of the smoothed image, for any correlation of the cells.
        return change, np.where(change > self.floor * (self.smoothing @ noise.deviation), change, 0.0)


def find_contacts(
    finder: AbstractFinder, image: Float[np.ndarray, " m"], noise: ImageNoise | None = None
) -> list[Contact]:
    """Find the contacts in an image, strongest first. Changes of the sign opposite to the finder's are ignored.

    **Arguments:**

    - `finder`: `CellFinder(mesh)` or `RasterFinder(mesh)` for the mesh of the image.
    - `image`: change of conductivity (m,) in every cell, S (3-D: S/m), as `LinearReconstruction.image` computes it.
    - `noise`: noise of images on this mesh, by default estimated from the image itself (see `ImageNoise.of_image`).

    Raises `ValueError` for an image or noise whose mesh is not the finder's, and for NaN.

    **Example:**

    ```python
    for contact in find_contacts(finder, image, noise):
        print(contact.centroid, contact.deviation, contact.area)
    ```
    """
    check_kind("finder", finder, AbstractFinder, "a finder, such as CellFinder(mesh)")
    change = signed_image(finder, image)
    return restore_sign(finder, finder.find(change, noise_or_estimate(change, noise)))


def restore_sign(finder: AbstractFinder, contacts: list[Contact]) -> list[Contact]:
    """Multiply the peaks and integrals of contacts by the finder's sign; return the contacts sorted, strongest
    first."""
    if finder.sign < 0:
        contacts = [
            eqx.tree_at(lambda contact: (contact.peak, contact.integral), contact, (-contact.peak, -contact.integral))
            for contact in contacts
        ]
    return sorted(contacts, key=lambda contact: -abs(contact.peak))


def noise_or_estimate(change: Float[np.ndarray, " m"], noise: ImageNoise | None) -> ImageNoise:
    """Return the noise of an image `change` (m,): `noise` itself, or an estimate from the image if `noise` is None.

    Raises `ValueError` unless `noise` is None or an `ImageNoise` of as many cells as the image.
    """
    if noise is None:
        return ImageNoise.of_image(change)
    check_kind("noise", noise, ImageNoise, "ImageNoise, such as ImageNoise.of_frames(reconstruction, frames)")
    if noise.deviation.shape != change.shape:
        raise ValueError(
            f"noise is of {noise.deviation.size} cells, and the image of {change.size}; give both on the same mesh."
        )
    return noise


def signed_image(finder: AbstractFinder, image) -> Float[np.ndarray, " m"]:
    """Return an image multiplied by the finder's sign, so that contacts are positive.

    Raises `ValueError` unless the image is real, finite, and on the finder's mesh.
    """
    image_values = np.asarray(image)
    if image_values.shape != (finder.num_cells,):
        raise ValueError(
            f"image has shape {image_values.shape}; give one value for each of the {finder.num_cells} cells of the "
            "finder's mesh. Was it reconstructed on another?"
        )
    if image_values.dtype.kind not in "iuf":
        raise ValueError(f"image must be real; it is {image_values.dtype}.")
    if not np.isfinite(image_values).all():
        raise ValueError("image has NaN or infinite values; reconstruct it from unmasked channels first.")
    return finder.sign * image_values


def check_finder(mesh: Mesh, sign: int, floor: float, *, flat: bool = True) -> None:
    """Check the arguments of a finder.

    Raises `ValueError` for a mesh that is not two-dimensional, for a surface in space if `flat`, for a sign other than
    1 and -1, and for a negative floor.
    """
    check_kind("mesh", mesh, Mesh, "a Mesh, that of the images")
    if flat:
        check_flat(mesh, "contacts on a raster")
    if mesh.dimension != 2:
        raise ValueError("mesh has three dimensions; contacts are found on sheets: reconstruct on a 2-D mesh.")
    if not (is_number(sign) and sign in (1, -1)):
        raise ValueError(
            f"sign must be 1, if touched skin conducts better, or -1, if it conducts worse; it is {describe(sign)}."
        )
    if not (is_number(floor) and floor >= 0):
        raise ValueError(f"floor must be zero or more, in standard deviations; it is {describe(floor)}.")


def check_share(name: str, value) -> None:
    """Check that a value is a fraction, from 0 to below 1. Raises `ValueError` otherwise."""
    if not (is_number(value) and 0 <= value < 1):
        raise ValueError(f"{name} must be a fraction, from 0 to below 1; it is {describe(value)}.")
