"""Classify a lasting change of a skin: failing electrodes, a cut, or a touch that is held. `ImagedSkin` is a calibrated
model of a monitored skin that computes images from the working channels and fits cuts."""

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
from jeit.touch.health.event import EventKind
from jeit.touch.health.healthy import HealthyState
from jeit_solvers.engines import as_array

# Maximum factor between the gain of a channel and the common gain of all channels; if the factor is larger, the common
# gain is used.
_MAX_CHANNEL_GAIN_RATIO = 3.0
# Maximum factor between readings and modelled voltages that model errors explain; a larger factor is due to units or
# polarity.
_MAX_MODEL_GAIN_RATIO = 10.0
# Fraction of an image's peak; the centroid of the cells above this level is the starting point of the fit of a cut.
_LOSS_PEAK_FRACTION = 0.5
# Thresholds for accepting a fitted line as a cut: maximum misfit, and maximum ratio of the misfits of line and spot.
_MAX_MISFIT, _MAX_MISFIT_RATIO = 0.4, 0.6
# Minimum distance of the fit's second starting point from the first, divided by the skin's side.
_MIN_START_DISTANCE = 0.05
# Maximum fraction of a change's energy (sum of squares over channels) that failing electrodes may leave unexplained.
_MAX_UNEXPLAINED_FRACTION = 0.1
# Minimum fraction of a failing electrode's channels that have changed.
_MIN_CHANGED_FRACTION = 0.75
# Minimum change of a changed channel, divided by its reading.
_MIN_RELATIVE_CHANGE = 0.12
# Maximum fraction of electrodes that may fail at once.
_MAX_FAULTY_FRACTION = 0.25
# Maximum ratio of readings to reference readings for a torn wire.
_MAX_TORN_READING_RATIO = 0.2
# Minimum ratio of noise to healthy noise for a loose contact.
_MIN_LOOSE_NOISE_RATIO = 5.0
# Ratio of the standard deviation of a normal variable to the median magnitude of the difference of two independent
# values.
_DEVIATION_PER_MEDIAN_DIFFERENCE = 1.0484
# Maximum of a voltage change divided by the reading; larger ratios are clipped.
_MAX_RELATIVE_CHANGE = 10.0


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
        cell_conductivity = np.asarray(check_conductivity(model.mesh, conductivity))
        if (
            cell_conductivity.ndim > 1
            or np.iscomplexobj(cell_conductivity)
            or cell_conductivity.size not in (1, model.mesh.num_cells)
        ):
            raise ValueError("conductivity must be real, one number or one for each cell.")
        if model.protocol.num_measurements != reference.size:
            raise ValueError(
                f"healthy has {reference.size} channels, and the model {model.protocol.num_measurements}; give frames "
                "and model of one skin."
            )
        cell_conductivity = np.broadcast_to(cell_conductivity, model.mesh.num_cells).astype(float)
        predicted_voltages = np.asarray(model.voltages(cell_conductivity))
        is_used_channel = np.isfinite(noise)
        model_gain = (
            reference[is_used_channel]
            @ predicted_voltages[is_used_channel]
            / (predicted_voltages[is_used_channel] @ predicted_voltages[is_used_channel])
        )
        if not 1 / _MAX_MODEL_GAIN_RATIO < model_gain < _MAX_MODEL_GAIN_RATIO:
            raise ValueError(
                f"healthy: it is {model_gain:.2g} times what the model predicts; are both in SI units, "
                "and the signs right?"
            )
        channel_gain_ratios = reference / np.where(predicted_voltages == 0, np.inf, predicted_voltages)
        channel_gains = np.where(
            is_used_channel
            & (channel_gain_ratios > model_gain / _MAX_CHANNEL_GAIN_RATIO)
            & (channel_gain_ratios < model_gain * _MAX_CHANNEL_GAIN_RATIO),
            channel_gain_ratios,
            model_gain,
        )
        return cls(model, cell_conductivity, cell_conductivity, channel_gains, noise, int(sign))

    def linear_reconstruction(self, usable: Bool[np.ndarray, " M"]) -> LinearReconstruction:
        """Return the one-step reconstruction from the `usable` channels, linearised at the present conductivity of the
        skin."""
        noise = np.where(np.isfinite(self.noise), self.noise / np.abs(self.gain), 1.0)
        return one_step(self.model, self.conductivity, noise=as_array(noise), mask=as_array(usable))

    def images(self, changes: Float[np.ndarray, "F M"], usable: Bool[np.ndarray, " M"]) -> Float[np.ndarray, "F m"]:
        """Reconstruct conductivity changes (frames, cells), S/m (2-D: S), from voltage changes (frames, channels),
        volts.

        Missing readings are NaN; the image of a frame without any reading is NaN. `usable`: whether each channel is
        used.
        """
        has_reading = np.isfinite(changes) & usable
        calibrated_changes = np.where(has_reading, changes / self.gain, 0.0)
        images = np.full((len(changes), self.model.mesh.num_cells), np.nan)
        reading_patterns, reading_pattern_indices = np.unique(has_reading, axis=0, return_inverse=True)
        for pattern_index, reading_pattern in enumerate(reading_patterns):
            if reading_pattern.any():
                has_reading_pattern = reading_pattern_indices.ravel() == pattern_index
                images[has_reading_pattern] = np.asarray(
                    self.linear_reconstruction(reading_pattern).image(as_array(calibrated_changes[has_reading_pattern]))
                )
        return images

    def fit_cut(
        self, change: Float[np.ndarray, " M"], usable: Bool[np.ndarray, " M"], noise: Float[np.ndarray, " M"]
    ) -> FittedLoss | None:
        """Fit a cut to a voltage change, volts; return None if no cut explains the change, or a press explains it about
        as well.

        `usable`: whether each channel is used; `noise`: noise of each channel's change, volts.
        """
        is_used_channel = usable & np.isfinite(change)
        calibrated_change = np.where(is_used_channel, change / self.gain, 0.0)
        image = np.asarray(self.linear_reconstruction(is_used_channel).image(as_array(calibrated_change)))
        conductivity_losses = np.maximum(-image, 0.0)
        if not conductivity_losses.max() > 0:
            return None
        cell_centres = np.asarray(centroids(self.model.mesh))[:, :2]
        cell_weights = np.asarray(measures(self.model.mesh)) * np.where(
            conductivity_losses > _LOSS_PEAK_FRACTION * conductivity_losses.max(), conductivity_losses, 0.0
        )
        loss_centroid = cell_weights @ cell_centres / cell_weights.sum()
        used_channels = np.flatnonzero(is_used_channel)
        channel_noise = noise[used_channels] / np.abs(self.gain[used_channels])
        loss_fit = LossFit(
            self.model, self.conductivity, calibrated_change[used_channels], used_channels, channel_noise, loss_centroid
        )
        spot_fit = loss_fit.fit_spot(loss_centroid)
        initial_cut_places = [loss_centroid]
        if np.linalg.norm(spot_fit.path[0] - loss_centroid) > _MIN_START_DISTANCE * loss_fit.skin_size:
            initial_cut_places.append(spot_fit.path[0])
        line_fit = loss_fit.fit_line(initial_cut_places)
        if line_fit.misfit > _MAX_MISFIT or line_fit.misfit > _MAX_MISFIT_RATIO * spot_fit.misfit:
            return None
        return line_fit

    def with_cut(self, loss: FittedLoss) -> "ImagedSkin":
        """Return the skin model with the conductivity after a fitted cut."""
        return replace(self, conductivity=loss.conductivity)

    def without_cuts(self) -> "ImagedSkin":
        """Return the skin model with the conductivity of the healthy skin, without cuts."""
        return replace(self, conductivity=self.healthy)


def faulty_electrodes(
    change: Float[np.ndarray, " M"], reference: Float[np.ndarray, " M"], uses_electrode: Bool[np.ndarray, "L M"]
) -> list[int]:
    """Find the electrodes whose failure alone explains a change of the channels from their `reference`, volts.

    Returns the numbers of the failing electrodes, or an empty list if the skin must have changed too. `uses_electrode`
    (electrodes, channels): whether each channel uses each electrode.
    """
    rms_reading = np.sqrt(np.mean(reference[np.isfinite(reference)] ** 2))
    relative_changes = np.abs(np.nan_to_num(change)) / np.maximum(np.abs(reference), 0.1 * rms_reading)
    relative_changes = np.minimum(relative_changes, _MAX_RELATIVE_CHANGE)
    # The change of a channel with a weak reading is relative to the root mean square reading, not to the channel's own
    # reading.
    channel_energies = np.minimum(np.abs(np.nan_to_num(change)) / rms_reading, relative_changes) ** 2
    total_energy, is_unexplained_channel, found_faulty_electrodes = (
        channel_energies.sum(),
        np.ones(len(channel_energies), bool),
        [],
    )
    while (
        total_energy > 0
        and channel_energies[is_unexplained_channel].sum() > _MAX_UNEXPLAINED_FRACTION * total_energy
        and len(found_faulty_electrodes) < max(1, _MAX_FAULTY_FRACTION * len(uses_electrode))
    ):
        electrode_scores = np.array(
            [
                channel_energies[is_unexplained_channel & electrode_channels].sum()
                / max(1, (is_unexplained_channel & electrode_channels).sum()) ** 0.5
                for electrode_channels in uses_electrode
            ]
        )
        best_electrode = int(electrode_scores.argmax())
        unexplained_channels = uses_electrode[best_electrode] & is_unexplained_channel
        if (
            not unexplained_channels.any()
            or np.mean(relative_changes[unexplained_channels] > _MIN_RELATIVE_CHANGE) < _MIN_CHANGED_FRACTION
        ):
            return []
        found_faulty_electrodes.append(best_electrode)
        is_unexplained_channel &= ~uses_electrode[best_electrode]
    return (
        found_faulty_electrodes
        if total_energy > 0
        and channel_energies[is_unexplained_channel].sum() <= _MAX_UNEXPLAINED_FRACTION * total_energy
        else []
    )


def kind_of_fault(
    frames: Float[np.ndarray, "n M"],
    reference: Float[np.ndarray, " M"],
    noise: Float[np.ndarray, " M"],
    electrode_channels: Bool[np.ndarray, " M"],
) -> EventKind:
    """Classify the fault of a failing electrode from the latest `frames`; `electrode_channels`: whether each channel
    uses this electrode."""
    electrode_frames = frames[:, electrode_channels]
    median_voltages = np.nanmedian(electrode_frames, axis=0)
    rms_reading = np.sqrt(np.mean(reference[electrode_channels] ** 2))
    are_readings_constant = (
        len(median_voltages) > 1
        and np.ptp(median_voltages) <= 0.02 * np.abs(median_voltages).max()
        and np.ptp(reference[electrode_channels]) > 0.1 * rms_reading
    )
    if are_readings_constant or np.median(np.abs(median_voltages)) < _MAX_TORN_READING_RATIO * np.median(
        np.abs(reference[electrode_channels])
    ):
        return EventKind.TORN
    # Touches hardly affect the median difference from frame to frame.
    frame_differences = np.diff(electrode_frames, axis=0)
    has_differences = np.isfinite(frame_differences).any(axis=0)
    noise_ratios = np.zeros(len(median_voltages))
    if has_differences.any():
        noise_ratios[has_differences] = _DEVIATION_PER_MEDIAN_DIFFERENCE * np.nanmedian(
            np.abs(frame_differences[:, has_differences]), axis=0
        )
    noise_ratios /= np.minimum(noise[electrode_channels], rms_reading)
    if np.median(noise_ratios) > _MIN_LOOSE_NOISE_RATIO and np.median(
        np.abs(median_voltages)
    ) < _MAX_RELATIVE_CHANGE * np.median(np.abs(reference[electrode_channels])):
        return EventKind.LOOSE
    return EventKind.DEAD


# Maximum misfit of a fitted cut, as a fraction of the change's sum of squares, for a change of only one electrode's
# channels to be attributed to a cut beside the electrode. For a failing contact, the misfit is larger.
_MAX_CUT_MISFIT = 0.1


@dataclass(frozen=True)
class LastingChange:
    """A lasting change of a skin's voltages.

    **Fields**: `vector`: change of each channel, volts; `size`: size of the change relative to healthy changes; `time`,
    `frame`: time and frame number at which the change began; `detection_time`: time at which the change was detected.
    """

    vector: Float[np.ndarray, " M"]
    size: float
    time: float
    frame: int
    detection_time: float


@dataclass(frozen=True)
class Finding:
    """Classification of a lasting change of a skin: what caused the change.

    **Fields**: `kind`: kind of event; `reason`: a sentence that explains the kind; `is_certain`: False if a press may
    cause the same change; `electrode`: number of the failing electrode, or None; `loss`: fitted cut, or None;
    `channels`: whether each channel is affected, None if all are.
    """

    kind: EventKind
    reason: str
    is_certain: bool
    electrode: int | None = None
    loss: FittedLoss | None = None
    channels: Bool[np.ndarray, " M"] | None = None


def classify_change(
    change: np.ndarray,
    frames: Float[np.ndarray, "n M"],
    reference: np.ndarray,
    healthy: HealthyState,
    touching: Bool[np.ndarray, "L M"] | None,
    skin: ImagedSkin | None,
) -> list[Finding]:
    """Classify a lasting change of the channels from their `reference`, volts, with the `frames` after the change."""
    is_usable_channel = healthy.used & np.isfinite(change)
    electrodes_at_fault = [] if touching is None else faulty_electrodes(change, reference, touching & healthy.used)
    electrode_findings = []
    for electrode in electrodes_at_fault:
        electrode_channels = touching[electrode] & healthy.used  # pyright: ignore[reportOptionalSubscript]
        fault_kind = kind_of_fault(frames, reference, healthy.noise, electrode_channels)
        fault_reason = (
            f"Nearly all of the change is in the {int(electrode_channels.sum())} channels of electrode {electrode + 1}."
        )
        electrode_findings.append(
            Finding(fault_kind, fault_reason, True, electrode=electrode, channels=electrode_channels)
        )
    # A cut right beside an electrode also changes almost only that electrode's channels. But readings beside a cut do
    # not fluctuate, and a cut does not increase the current at the electrode.
    if electrode_findings and (
        skin is None or any(electrode_finding.kind != EventKind.DEAD for electrode_finding in electrode_findings)
    ):
        return electrode_findings
    fitted_cut = None if skin is None else skin.fit_cut(change, is_usable_channel, healthy.scale)
    if electrode_findings and (fitted_cut is None or fitted_cut.misfit > _MAX_CUT_MISFIT):
        return electrode_findings
    fraction_outside = healthy.fraction_outside(change)
    is_unlike_touches = fraction_outside > healthy.max_fraction_outside
    reason_text = (
        f"{100 * fraction_outside:.0f} % of it is in no direction of touches; of those, "
        f"{100 * healthy.max_fraction_outside:.0f} % at most."
        if is_unlike_touches
        else "A press that is held looks the same: wait, or check the skin."
    )
    if fitted_cut is not None:
        depth_text = "through the whole skin" if fitted_cut.through else "perhaps through a part of its depth"
        reason_text = f"Conductivity is lost along a line, {depth_text}. {reason_text}"
        return [
            Finding(EventKind.CUT, reason_text, is_unlike_touches or _loss_is_opposite_to_touch(skin), loss=fitted_cut)
        ]
    return [Finding(EventKind.CHANGED, reason_text, is_unlike_touches)]


def _loss_is_opposite_to_touch(skin: ImagedSkin | None) -> bool:
    """Return whether touches raise the skin's conductivity, so that a loss of conductivity cannot be a touch."""
    return skin is not None and skin.sign > 0
