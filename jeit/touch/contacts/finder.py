"""Find contacts in images."""

from abc import abstractmethod

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy import sparse

from jeit.arguments import check_kind, describe, is_number
from jeit.mesh import Mesh, check_flat
from jeit.touch.contacts.image_noise import ImageNoise
from jeit_solvers.module import Module


class Contact(Module):
    """A contact in an image.

    **Fields**: `centroid`: (x, y), or (x, y, z) on a surface in space, metres; `area`: area of the region, m²; `peak`:
    strongest change in the region, with its sign, in the unit of the image; `integral`: integral of the change over the
    region, in the unit of the image times m²; `contour` (k, d): k points of the region's outline, metres, of which the
    first is not repeated at the end; `deviation`: root mean square displacement of the centroid by noise of the image
    (see `ImageNoise`), to first order, metres. The deviation includes neither the blur of the image nor systematic
    errors.

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

    **Fields**: `smoothing` (m, m): matrix that smooths images first; `sign`: 1 if touched skin conducts better, -1 if
    it conducts worse; `floor`: number of standard deviations of the noise that a cell must exceed to belong to a
    contact.
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
        # Upper bound of the standard deviation of a cell of the smoothed image, however cells are correlated.
        return change, np.where(change > self.floor * (self.smoothing @ noise.deviation), change, 0.0)


def find_contacts(
    finder: AbstractFinder, image: Float[np.ndarray, " m"], noise: ImageNoise | None = None
) -> list[Contact]:
    """Find the contacts in an image, strongest first. Changes of the sign opposite to the finder's are ignored.

    **Arguments:**

    - `finder`: `CellFinder(mesh)` or `RasterFinder(mesh)` for the mesh of the image.
    - `image`: change of conductivity (m,) in every cell, S (3-D: S/m), as `LinearReconstruction.image` computes it.
    - `noise`: noise of images on this mesh, by default estimated from the image itself (see `ImageNoise.of_image`).

    Raises `ValueError` for an image or noise of another mesh than the finder's, and for NaN.

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
    """Give contacts found in a sign-changed image the sign of the original image; sort them, strongest first."""
    if finder.sign < 0:
        contacts = [
            eqx.tree_at(lambda contact: (contact.peak, contact.integral), contact, (-contact.peak, -contact.integral))
            for contact in contacts
        ]
    return sorted(contacts, key=lambda contact: -abs(contact.peak))


def noise_or_estimate(change: Float[np.ndarray, " m"], noise: ImageNoise | None) -> ImageNoise:
    """Return the noise of an image `change` (m,): `noise` as given, or estimated from the image if it is None.

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
    values = np.asarray(image)
    if values.shape != (finder.num_cells,):
        raise ValueError(
            f"image has shape {values.shape}; give one value for each of the {finder.num_cells} cells of the finder's "
            "mesh. Was it reconstructed on another?"
        )
    if values.dtype.kind not in "iuf":
        raise ValueError(f"image must be real; it is {values.dtype}.")
    if not np.isfinite(values).all():
        raise ValueError("image has NaN or infinite values; reconstruct it from unmasked channels first.")
    return finder.sign * values


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
