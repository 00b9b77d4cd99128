"""Features of frames for learning: several forms of the voltage changes, standardised, and their principal components.
Some features are images, computed by linear reconstruction with a model of the skin, and properties of the strongest
contact in each image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jeit.arguments import check_kind
from jeit.forward import ForwardModel
from jeit.inverse import calibrate, one_step
from jeit.mesh import centroids, measures
from jeit.touch.learnt.resource_limits import apply_in_parts
from jeit_solvers.engines import as_array

# A contact is the region of an image above this fraction of its peak, among the cells nearest to the peak.
_CONTACT_LEVEL = 0.7
# Fraction of all cells that count as nearest to a peak.
_NEIGHBOUR_FRACTION = 0.2
# Weight of each feature of the contact among image features, relative to one cell of the image.
_CONTACT_WEIGHT = 3.0
_CHUNK_SIZE = 128
# Minimum number of repeated frames (frames with the same targets as another frame) for estimating the noise of frames.
_MIN_REPEATED_FRAMES = 20


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
        cls, model: ForwardModel, changes: Float[np.ndarray, "N m"], is_used: Bool[np.ndarray, " M"], reference
    ) -> tuple["ImageReconstruction", list[str]]:
        """Create a one-step linear reconstruction from the channels that are used (`is_used`).

        If a `reference` frame is given, the forward model is calibrated on this frame. The sign of the images is
        determined from the voltage `changes` of presses. Also returns notes on the calibration as text.
        """
        notes, conductivity, channel_mask = [], 1.0, as_array(is_used)
        if reference is not None and np.abs(reference[is_used]).max() > 0:
            # -1 if the polarity of the channels is reversed.
            polarity_sign = np.sign(np.where(is_used, model.voltages(1.0), 0.0) @ reference)
            calibration = calibrate(model, as_array(polarity_sign * reference), mask=channel_mask, contact="fixed")
            if np.isfinite(calibration.misfit):
                model, conductivity = calibration.model, calibration.conductivity
                notes += [calibration.note] if calibration.note else []
        reconstruction_matrix = np.asarray(one_step(model, conductivity, mask=channel_mask).matrix).T[is_used]
        cell_centres, cell_sizes = np.asarray(centroids(model.mesh)), np.asarray(measures(model.mesh))
        neighbour_indices = KDTree(cell_centres).query(
            cell_centres, max(1, int(_NEIGHBOUR_FRACTION * len(cell_centres)))
        )[1]
        press_images = changes @ reconstruction_matrix
        touch_sign = np.sign(np.median(press_images.max(axis=1) + press_images.min(axis=1))) or 1.0
        return cls(
            touch_sign * reconstruction_matrix,
            cell_centres,
            cell_sizes,
            np.reshape(neighbour_indices, (len(cell_centres), -1)),
        ), notes

    def contacts(self, images: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n d+3"]:
        """Compute features of the strongest contact of each image: the centroid, and the logarithms of the peak, the
        integral and the area or volume."""
        row_indices = np.arange(len(images))[:, None]
        neighbour_cells = self.around[images.argmax(axis=1)]
        neighbour_values, neighbour_sizes = images[row_indices, neighbour_cells], self.sizes[neighbour_cells]
        image_peaks = np.maximum(images.max(axis=1), 1e-300)[:, None]
        weights_above_level = neighbour_sizes * np.maximum(neighbour_values - _CONTACT_LEVEL * image_peaks, 0.0)
        total_weight = np.maximum(weights_above_level.sum(axis=1, keepdims=True), 1e-300)
        contact_centroids = np.einsum("nk,nkd->nd", weights_above_level / total_weight, self.centres[neighbour_cells])
        contact_integrals, contact_areas = (
            (neighbour_sizes * np.maximum(neighbour_values, 0.0)).sum(axis=1),
            (neighbour_sizes * (weights_above_level > 0)).sum(axis=1),
        )
        return np.column_stack(
            [
                contact_centroids,
                np.log(np.maximum(np.column_stack([image_peaks, contact_integrals, contact_areas]), 1e-300)),
            ]
        )


@dataclass(frozen=True)
class ContactFeatures:
    """Features of voltage changes: centroid, peak, integral and size of the strongest contact in the reconstructed
    image."""

    imaged: ImageReconstruction

    def __call__(self, changes: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n p"]:
        """Compute the features (frames, features) of voltage changes (frames, channels)."""
        return apply_in_parts(
            lambda change_rows: self.imaged.contacts(change_rows @ self.imaged.matrix), changes, _CHUNK_SIZE
        )

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

        def image_features(change_rows: np.ndarray) -> np.ndarray:
            image_rows = change_rows @ self.imaged.matrix
            rms_values = np.maximum(np.sqrt(np.mean(image_rows**2, axis=1, keepdims=True)), 1e-300)
            return np.hstack([self.imaged.contacts(image_rows), np.log(rms_values), image_rows / rms_values])

        return apply_in_parts(image_features, changes, _CHUNK_SIZE)

    def deviation(self, values: Float[np.ndarray, "N p"]) -> Float[np.ndarray, " p"]:
        """Return the unit by which each feature is divided.

        For the contact and the logarithm, the unit is a fraction of the feature's standard deviation. For the cells of
        the image, the unit is the root mean square of the standard deviations of all cells.
        """
        num_other_features = values.shape[1] - len(self.imaged.sizes)
        feature_deviations = values.std(axis=0)
        return np.concatenate(
            [
                feature_deviations[:num_other_features] / _CONTACT_WEIGHT,
                np.full(
                    len(feature_deviations) - num_other_features,
                    np.sqrt(np.mean(feature_deviations[num_other_features:] ** 2)),
                ),
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


@dataclass(frozen=True)
class WhitenedChanges:
    """Whitened features: voltage changes times the matrix `root`, such that the variation between frames with the same
    target has unit covariance."""

    root: Float[np.ndarray, "m m"]

    @classmethod
    def learn(cls, changes: Float[np.ndarray, "N m"], targets: Float[np.ndarray, "N d"]) -> "WhitenedChanges":
        """Fit the whitening matrix to frames, of which some have the same `targets`.

        The covariance between frames with the same targets is shrunk as in Ledoit and Wolf (2004).
        """
        from sklearn.covariance import ledoit_wolf

        channel_deviations = np.maximum(changes.std(axis=0), 1e-300)
        group_indices, group_sizes = _group_equal_rows(targets)
        mean_changes = np.zeros((len(group_sizes), changes.shape[1]))
        np.add.at(mean_changes, group_indices, changes / group_sizes[group_indices, None])
        group_residuals = ((changes - mean_changes[group_indices]) / channel_deviations)[group_sizes[group_indices] > 1]
        if not group_residuals.any():
            return cls(np.diag(1 / channel_deviations))
        degrees_of_freedom = len(group_residuals) - np.sum(group_sizes > 1)
        eigenvalues, eigenvectors = np.linalg.eigh(
            len(group_residuals) / degrees_of_freedom * ledoit_wolf(group_residuals, assume_centered=True)[0]
        )
        eigenvalues = np.maximum(eigenvalues, 1e-12 * eigenvalues.max())
        return cls((eigenvectors / np.sqrt(eigenvalues)) @ eigenvectors.T / channel_deviations[:, None])

    def __call__(self, changes: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        """Compute the whitened features of voltage changes, both (frames, channels)."""
        return changes @ self.root

    def deviation(self, values: Float[np.ndarray, "N m"]) -> Float[np.ndarray, " m"]:
        """Return the unit of each feature, the same for all: the root mean square of the features' standard
        deviations."""
        return np.full(values.shape[1], np.sqrt(np.mean(values.var(axis=0))))


def are_repeated(targets: Float[np.ndarray, "N d"]) -> bool:
    """Whether enough frames have the same `targets` as another frame to estimate the noise of frames."""
    return int(np.sum(_group_equal_rows(targets)[1] - 1)) >= _MIN_REPEATED_FRAMES


def _group_equal_rows(targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number the groups of frames with equal `targets`; returns the group of each frame and the size of each group."""
    group_indices, group_sizes = np.unique(targets, axis=0, return_inverse=True, return_counts=True)[1:]
    return group_indices.ravel(), group_sizes


# Maximum number of principal components.
_MAX_COMPONENTS = 60
# Number of presses required for each component.
_PRESSES_PER_COMPONENT = 3


def _divide_by_unit(changes, reference, channel_units):
    """Compute features (frames, channels): voltage changes divided by the `channel_units` of each channel."""
    return changes / channel_units


def _divide_by_reference(changes, reference, channel_units):
    """Compute features (frames, channels): voltage changes relative to the reference voltages."""
    reference_magnitudes = np.maximum(np.abs(reference), 1e-3 * np.sqrt(np.mean(reference**2, axis=1, keepdims=True)))
    return changes / np.where(reference_magnitudes > 0, reference_magnitudes, 1.0)


def _compress_changes(changes, reference, channel_units):
    """Compute features (frames, channels): sign(u) log(1 + |u|) of the voltage changes u in the `channel_units` of each
    channel."""
    return np.sign(changes) * np.log1p(np.abs(changes) / channel_units)


def _normalise_scaled_changes(changes, reference, channel_units):
    """Compute features: voltage changes in the `channel_units` of each channel, divided by their root mean square in
    the frame, and the logarithm of this root mean square."""
    rms_changes = np.sqrt(np.mean((changes / channel_units) ** 2, axis=1, keepdims=True))
    rms_changes = np.where(rms_changes > 0, rms_changes, 1.0)
    return np.hstack([changes / channel_units / rms_changes, np.log(rms_changes)])


def _normalise_changes(changes, reference, channel_units):
    """Compute features: voltage changes divided by their root mean square in the frame, and the logarithm of this root
    mean square, without `channel_units`."""
    rms_changes = np.sqrt(np.mean(changes**2, axis=1, keepdims=True))
    rms_changes = np.where(rms_changes > 0, rms_changes, 1.0)
    return np.hstack([changes / rms_changes, np.log(rms_changes)])


# Forms of features: functions of changes and reference, both (frames, channels), and of the unit of each channel.
FORMS = {
    "differences": _divide_by_unit,
    "ratios": _divide_by_reference,
    "compressed": _compress_changes,
    "normalised": _normalise_scaled_changes,
    "shapes": _normalise_changes,
}
# Functions that fit a learnt form of features to changes (presses, channels) and targets (presses, targets).
FeatureMaker = Callable[[np.ndarray, np.ndarray], WhitenedChanges | ContactFeatures | ImageFeatures]


@dataclass(frozen=True)
class Features:
    """Features of voltage changes in one `form`, standardised, and optionally reduced to principal components.

    `mean` and `deviation` standardise each feature; `components` (features, components): the principal components, or
    None. `made`: function that computes the features of a learnt form, None for other forms; `unit`: unit of each
    channel for the forms that are not learnt.
    """

    form: str
    unit: Float[np.ndarray, " m"]
    mean: Float[np.ndarray, " p"]
    deviation: Float[np.ndarray, " p"]
    components: Float[np.ndarray, "p k"] | None
    made: WhitenedChanges | ContactFeatures | ImageFeatures | None = None

    @classmethod
    def learn(
        cls,
        form: str,
        changes: Float[np.ndarray, "N m"],
        reference: Float[np.ndarray, "N m"],
        *,
        learnt_function: WhitenedChanges | ContactFeatures | ImageFeatures | None = None,
        rotated: bool = True,
    ) -> "Features":
        """Fit the scaling and the principal components of features to voltage changes and reference voltages.

        If `rotated`, features are reduced to principal components, except for the few features of a contact in an
        image.
        """
        if learnt_function is None:
            channel_units, feature_values, feature_means, feature_deviations = standardisation(form, changes, reference)
        else:
            channel_units, feature_values = np.ones(changes.shape[1]), learnt_function(changes)
            feature_means, feature_deviations = (
                feature_values.mean(axis=0),
                _replace_zeros_by_infinity(learnt_function.deviation(feature_values)),
            )
        if not rotated or isinstance(learnt_function, ContactFeatures):
            return cls(form, channel_units, feature_means, feature_deviations, None, learnt_function)
        principal_axes = np.linalg.svd((feature_values - feature_means) / feature_deviations, full_matrices=False)[2]
        components = principal_axes[: max(2, min(_MAX_COMPONENTS, len(feature_values) // _PRESSES_PER_COMPONENT))].T
        return cls(form, channel_units, feature_means, feature_deviations, components, learnt_function)

    def __call__(self, changes: np.ndarray, reference: np.ndarray) -> Float[np.ndarray, "n k"]:
        """Compute the features (frames, features) of changes and reference voltages (frames, channels)."""
        feature_values = FORMS[self.form](changes, reference, self.unit) if self.made is None else self.made(changes)
        standardised_values = (feature_values - self.mean) / self.deviation
        return standardised_values if self.components is None else standardised_values @ self.components


def standardisation(form: str, changes: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, ...]:
    """Compute features of a `form` from voltage changes (presses, channels), and their mean and standard deviation.

    Returns the unit of each channel, which is its median absolute change, or its mean absolute change if the median is
    0; the features (presses, features); the mean of each feature; and the standard deviation of each feature, infinite
    for a constant feature.
    """
    change_magnitudes = np.abs(changes)
    channel_units = np.median(change_magnitudes, axis=0)
    channel_units = np.where(channel_units > 0, channel_units, np.mean(change_magnitudes, axis=0))
    feature_values = FORMS[form](changes, reference, np.where(channel_units > 0, channel_units, 1.0))
    return (
        np.where(channel_units > 0, channel_units, 1.0),
        feature_values,
        feature_values.mean(axis=0),
        _replace_zeros_by_infinity(feature_values.std(axis=0)),
    )


def _replace_zeros_by_infinity(feature_deviations: np.ndarray) -> np.ndarray:
    """Replace standard deviations of features by infinity if they are negligible compared with the largest."""
    is_nonzero_deviation = feature_deviations > 1e-9 * max(feature_deviations.max(), 1e-300)
    return np.where(is_nonzero_deviation, feature_deviations, np.inf)


@dataclass(frozen=True)
class Forms:
    """The forms of features that can be computed from a set of presses.

    `names`: names of all forms; `makers`: by name, the functions that fit learnt forms, which need repeated frames or
    images.
    """

    names: tuple[str, ...]
    makers: dict[str, FeatureMaker]

    @classmethod
    def available(
        cls, targets: Float[np.ndarray, "N d"], imaged: ImageReconstruction | None, *, has_reference: bool
    ) -> "Forms":
        """Return the forms of features that the data allow: reference voltages, if `has_reference`, repeated targets in
        `targets`, and images."""
        makers: dict[str, FeatureMaker] = {"whitened": WhitenedChanges.learn} if are_repeated(targets) else {}
        if imaged is not None:
            makers |= {"contacts": lambda changes, targets: ContactFeatures(imaged)}
            makers |= {"images": lambda changes, targets: ImageFeatures(imaged)}
        unlearnt_forms = [form for form in FORMS if has_reference or form != "ratios"]
        return cls((*unlearnt_forms, *makers), makers)

    def learn(self, form: str, changes, reference, targets, *, rotated: bool = True) -> Features:
        """Fit features of one form to voltage changes, as `Features.learn` does."""
        learnt_function = self.makers[form](changes, targets) if form in self.makers else None
        return Features.learn(form, changes, reference, learnt_function=learnt_function, rotated=rotated)
