"""Images computed from voltage changes by linear reconstruction with a model of the skin, and the strongest contact in
each image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jeit.arguments import check_kind
from jeit.forward import ForwardModel
from jeit.inverse import calibrate, one_step
from jeit.mesh import centroids, measures
from jeit.touch.learnt.extras import apply_in_parts
from jeit_solvers.engines import as_array

# A contact is the region of an image above this fraction of its peak, among the cells nearest to the peak; fraction of
# all cells that count as nearest.
_CONTACT_LEVEL, _NEIGHBOUR_FRACTION = 0.7, 0.2
# Weight of each feature of the contact among image features, relative to one cell of the image.
_CONTACT_WEIGHT = 3.0
_CHUNK_SIZE = 128


@dataclass(frozen=True)
class ImageReconstruction:
    """Linear reconstruction of images from voltage changes; touches are positive in the images.

    `matrix` (channels, cells): voltage changes times this matrix give an image; `centres` (cells, coordinates):
    centroids of the image cells, metres; `sizes`: areas or volumes of the cells; `around` (cells, neighbours): indices
    of the cells nearest to each cell.
    """

    matrix: Float[np.ndarray, "m c"]
    centres: Float[np.ndarray, "c d"]
    sizes: Float[np.ndarray, " c"]
    around: Int[np.ndarray, "c k"]

    @classmethod
    def create(
        cls, model: ForwardModel, changes: Float[np.ndarray, "N m"], used: Bool[np.ndarray, " M"], reference
    ) -> tuple["ImageReconstruction", list[str]]:
        """Create a one-step linear reconstruction from the channels that are `used`.

        If a `reference` frame is given, the forward model is calibrated on this frame. The sign of touches in images is
        determined from the voltage `changes` of presses. Also returns notes on the calibration as text.
        """
        notes, conductivity, mask = [], 1.0, as_array(used)
        if reference is not None and np.abs(reference[used]).max() > 0:
            polarity = np.sign(
                np.where(used, model.voltages(1.0), 0.0) @ reference
            )  # -1 where the polarity of a channel is reversed
            calibration = calibrate(model, as_array(polarity * reference), mask=mask, contact="fixed")
            if np.isfinite(calibration.misfit):
                model, conductivity = calibration.model, calibration.conductivity
                notes += [calibration.note] if calibration.note else []
        matrix = np.asarray(one_step(model, conductivity, mask=mask).matrix).T[used]
        centres, sizes = np.asarray(centroids(model.mesh)), np.asarray(measures(model.mesh))
        around = KDTree(centres).query(centres, max(1, int(_NEIGHBOUR_FRACTION * len(centres))))[1]
        image = changes @ matrix
        sign = np.sign(np.median(image.max(axis=1) + image.min(axis=1))) or 1.0
        return cls(sign * matrix, centres, sizes, np.reshape(around, (len(centres), -1))), notes

    def contacts(self, images: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n d+3"]:
        """Compute features of the strongest contact of each image: the centroid, and the logarithms of the peak, the
        integral and the area or volume."""
        row_indices = np.arange(len(images))[:, None]
        cells = self.around[images.argmax(axis=1)]
        neighbour_values, sizes = images[row_indices, cells], self.sizes[cells]
        peak = np.maximum(images.max(axis=1), 1e-300)[:, None]
        weights_above_level = sizes * np.maximum(neighbour_values - _CONTACT_LEVEL * peak, 0.0)
        total_weight = np.maximum(weights_above_level.sum(axis=1, keepdims=True), 1e-300)
        centroid = np.einsum("nk,nkd->nd", weights_above_level / total_weight, self.centres[cells])
        integral, area = (
            (sizes * np.maximum(neighbour_values, 0.0)).sum(axis=1),
            (sizes * (weights_above_level > 0)).sum(axis=1),
        )
        return np.column_stack([centroid, np.log(np.maximum(np.column_stack([peak, integral, area]), 1e-300))])


@dataclass(frozen=True)
class ContactFeatures:
    """Features of voltage changes: centroid, peak, integral and size of the strongest contact in the reconstructed
    image."""

    imaged: ImageReconstruction

    def __call__(self, changes: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n p"]:
        """Compute the features (frames, features) of voltage changes (frames, channels)."""
        return apply_in_parts(lambda rows: self.imaged.contacts(rows @ self.imaged.matrix), changes, _CHUNK_SIZE)

    def deviation(self, values: Float[np.ndarray, "N p"]) -> Float[np.ndarray, " p"]:
        """Return the unit by which each feature is divided: its standard deviation over the presses."""
        return values.std(axis=0)


@dataclass(frozen=True)
class ImageFeatures:
    """Features of voltage changes: the strongest contact in the reconstructed image, and the values of the image.

    The image is divided by its root mean square; the logarithm of the root mean square is another feature.
    """

    imaged: ImageReconstruction

    def __call__(self, changes: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n p"]:
        """Compute the features (frames, features) of voltage changes (frames, channels)."""

        def features(rows: np.ndarray) -> np.ndarray:
            image = rows @ self.imaged.matrix
            size = np.maximum(np.sqrt(np.mean(image**2, axis=1, keepdims=True)), 1e-300)
            return np.hstack([self.imaged.contacts(image), np.log(size), image / size])

        return apply_in_parts(features, changes, _CHUNK_SIZE)

    def deviation(self, values: Float[np.ndarray, "N p"]) -> Float[np.ndarray, " p"]:
        """Return the unit by which each feature is divided.

        For the contact and the logarithm, the unit is a fraction of the feature's standard deviation; for all cells of
        the image, the unit is the root mean square of their standard deviations.
        """
        num_other_features = values.shape[1] - len(self.imaged.sizes)
        deviations = values.std(axis=0)
        return np.concatenate(
            [
                deviations[:num_other_features] / _CONTACT_WEIGHT,
                np.full(len(deviations) - num_other_features, np.sqrt(np.mean(deviations[num_other_features:] ** 2))),
            ]
        )


def check_imaged(model: ForwardModel, num_channels: int) -> None:
    """Check the forward model of a skin. Raises `ValueError` if `model` is no forward model, or its number of channels
    is not `num_channels`."""
    check_kind("model", model, ForwardModel, "a ForwardModel(mesh, electrodes, protocol)")
    num_model_channels = model.protocol.num_measurements
    if num_model_channels != num_channels:
        raise ValueError(
            f"model: its protocol has {num_model_channels} channels, and frames have {num_channels}; give the skin's."
        )
