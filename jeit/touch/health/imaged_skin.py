"""`ImagedSkin`: a calibrated model of a monitored skin that computes images from the working channels and fits cuts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jeit.forward import ForwardModel
from jeit.forward.system import check_conductivity
from jeit.inverse import one_step
from jeit.inverse.linear.one_step import LinearReconstruction
from jeit.mesh import centroids, measures
from jeit.touch.health.cut_path import FittedLoss, LossFit
from jeit_solvers.engines import as_array

# Maximum factor between the gain of a channel and the common gain of all channels; if the factor is larger, the common
# gain is used.
_MAX_GAIN_FACTOR = 3.0
# Maximum factor between readings and modelled voltages that model errors explain; a larger factor is due to units or
# polarity.
_MAX_MODEL_FACTOR = 10.0
# Fraction of an image's peak; the centroid of the cells above this level is the starting point of the fit of a cut.
_PEAK_FRACTION = 0.5
# Thresholds for accepting a fitted line as a cut: maximum misfit, and maximum ratio of the misfits of line and spot.
_MAX_MISFIT, _MAX_MISFIT_RATIO = 0.4, 0.6
# Minimum distance of the fit's second starting point from the first, divided by the skin's side.
_MIN_START_DISTANCE = 0.05


@dataclass(frozen=True)
class ImagedSkin:
    """A calibrated model of a monitored skin, with its cuts.

    **Fields**: `model`: forward model; `conductivity` (cells,): present conductivity with all cuts, S/m (2-D: S);
    `healthy` (cells,): conductivity of the healthy skin, S/m (2-D: S); `gain`: ratio of each channel's reading to the
    model's voltage; `noise`: noise of each channel's readings, volts; `sign`: 1 if touched skin conducts better, -1 if
    touched skin conducts worse.
    """

    model: ForwardModel
    conductivity: Float[np.ndarray, " m"]
    healthy: Float[np.ndarray, " m"]
    gain: Float[np.ndarray, " M"]
    noise: Float[np.ndarray, " M"]
    sign: int

    @classmethod
    def create(
        cls, model: ForwardModel, conductivity: ArrayLike, reference: np.ndarray, noise: np.ndarray, sign: int
    ) -> "ImagedSkin":
        """Calibrate a forward model on the `reference` voltages of a healthy, untouched skin, volts.

        Raises `ValueError` for an invalid conductivity, a reference unlike the model's voltages, and a sign other than
        1 and -1.
        """
        if sign not in (1, -1):
            raise ValueError(f"sign must be 1, where touched skin conducts better, or -1, where worse; it is {sign!r}.")
        values = np.asarray(check_conductivity(model.mesh, conductivity))
        if values.ndim > 1 or np.iscomplexobj(values) or values.size not in (1, model.mesh.num_cells):
            raise ValueError("conductivity must be real, one number or one for each cell.")
        if model.protocol.num_measurements != reference.size:
            raise ValueError(
                f"healthy has {reference.size} channels, and the model {model.protocol.num_measurements}; give frames "
                "and model of one skin."
            )
        values = np.broadcast_to(values, model.mesh.num_cells).astype(float)
        predicted = np.asarray(model.voltages(values))
        used = np.isfinite(noise)
        ratio = reference[used] @ predicted[used] / (predicted[used] @ predicted[used])
        if not 1 / _MAX_MODEL_FACTOR < ratio < _MAX_MODEL_FACTOR:
            raise ValueError(
                f"healthy: it is {ratio:.2g} times what the model predicts; are both in SI units, and the signs right?"
            )
        channel_ratios = reference / np.where(predicted == 0, np.inf, predicted)
        gain = np.where(
            used & (channel_ratios > ratio / _MAX_GAIN_FACTOR) & (channel_ratios < ratio * _MAX_GAIN_FACTOR),
            channel_ratios,
            ratio,
        )
        return cls(model, values, values, gain, noise, int(sign))

    def linear_reconstruction(self, usable: Bool[np.ndarray, " M"]) -> LinearReconstruction:
        """One-step reconstruction from voltages of the `usable` channels, linearised at the present conductivity of the
        skin."""
        noise = np.where(np.isfinite(self.noise), self.noise / np.abs(self.gain), 1.0)
        return one_step(self.model, self.conductivity, noise=as_array(noise), mask=as_array(usable))

    def images(self, changes: Float[np.ndarray, "F M"], usable: Bool[np.ndarray, " M"]) -> Float[np.ndarray, "F m"]:
        """Reconstruct conductivity changes (frames, cells), S/m (2-D: S), from voltage changes (frames, channels),
        volts.

        Missing readings are NaN; the image of a frame without any reading is NaN. `usable`: channels that are used.
        """
        has_reading = np.isfinite(changes) & usable
        volts = np.where(has_reading, changes / self.gain, 0.0)
        images = np.full((len(changes), self.model.mesh.num_cells), np.nan)
        patterns, pattern_indices = np.unique(has_reading, axis=0, return_inverse=True)
        for pattern_index, pattern in enumerate(patterns):
            if pattern.any():
                is_pattern = pattern_indices.ravel() == pattern_index
                images[is_pattern] = np.asarray(self.linear_reconstruction(pattern).image(as_array(volts[is_pattern])))
        return images

    def fit_cut(
        self, change: Float[np.ndarray, " M"], usable: Bool[np.ndarray, " M"], noise: Float[np.ndarray, " M"]
    ) -> FittedLoss | None:
        """Fit a cut to a voltage change, volts; returns None if no cut explains the change, or a press explains the
        change as well.

        `usable`: channels that are used; `noise`: noise of each channel's change, volts.
        """
        is_used = usable & np.isfinite(change)
        volts = np.where(is_used, change / self.gain, 0.0)
        image = np.asarray(self.linear_reconstruction(is_used).image(as_array(volts)))
        losses = np.maximum(-image, 0.0)
        if not losses.max() > 0:
            return None
        centres = np.asarray(centroids(self.model.mesh))[:, :2]
        weights = np.asarray(measures(self.model.mesh)) * np.where(losses > _PEAK_FRACTION * losses.max(), losses, 0.0)
        start = weights @ centres / weights.sum()
        channels = np.flatnonzero(is_used)
        channel_noise = noise[channels] / np.abs(self.gain[channels])
        loss_fit = LossFit(self.model, self.conductivity, volts[channels], channels, channel_noise, start)
        spot_fit = loss_fit.fit_spot(start)
        starts = [start]
        if np.linalg.norm(spot_fit.path[0] - start) > _MIN_START_DISTANCE * loss_fit.skin_size:
            starts.append(spot_fit.path[0])
        line_fit = loss_fit.fit_line(starts)
        if line_fit.misfit > _MAX_MISFIT or line_fit.misfit > _MAX_MISFIT_RATIO * spot_fit.misfit:
            return None
        return line_fit

    def with_cut(self, loss: FittedLoss) -> "ImagedSkin":
        """Return the skin model with the conductivity after a fitted cut."""
        return replace(self, conductivity=loss.conductivity)

    def without_cuts(self) -> "ImagedSkin":
        """Return the skin model with the conductivity of the healthy skin, without cuts."""
        return replace(self, conductivity=self.healthy)
