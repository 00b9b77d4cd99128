"""`LearntSkin`: a model learnt from recorded presses that estimates where, how hard and by what a skin is touched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, check_name, counted
from jeit.arguments.extras import require_extra
from jeit.forward import ForwardModel
from jeit.touch.learnt import labels as label_methods
from jeit.touch.learnt import regression
from jeit.touch.learnt.channels import Channels, choose_channels
from jeit.touch.learnt.features import ImageReconstruction, check_imaged
from jeit.touch.learnt.labels import LearntKeys, LearntLabels
from jeit.touch.learnt.learn_from_presses import METHODS, Standing, learn_quantities, places_and_folds
from jeit.touch.learnt.recorded_presses import (
    NO_TOUCH,
    Presses,
    Touches,
    aligned_slices,
    changes_from_reference,
    check_frames,
    check_reference,
    estimate_lag,
    fill_reference,
    mean_reference,
    standardise_sessions,
)
from jeit.touch.learnt.regression import LearntNumbers
from jeit.touch.learnt.resource_limits import apply_over_threads, limit_to_one_thread

# A frame is unlike the training set above this novelty (about 1 for the farthest training frames), or below this
# fraction of alive channels.
_MAX_NOVELTY, _MIN_ALIVE_FRACTION = 2.0, 0.66
_CHUNK_SIZE = 256
# Number of principal directions of the error of readings that are predicted for dead channels. These errors are
# propagated to predictions.
_MAX_ERROR_DIRECTIONS = 4
# Number of random draws of the errors of all readings, which are propagated to predictions.
_NUM_DRAWS = 4
# Minimum number of touched frames for the detection of stuck channels.
_MIN_TOUCHED_FRAMES = 20
# Minimum cosine similarity of a reference frame to that of the training set; maximum ratio of their norms. A reference
# beyond either limit is rejected as that of another skin.
_MIN_COSINE_SIMILARITY, _MAX_NORM_RATIO = 0.8, 5.0


@dataclass(frozen=True)
class LearntSkin:
    """Models learnt from presses by `LearntSkin.fit`; the model of a quantity is None if the presses lack the quantity.

    **Fields**

    - `channels`: joint model of the readings of the measurement channels.
    - `mean_reference` (channels,): mean reference frame of the training set.
    - `place`, `force`, `label`, `keys`: model that predicts each quantity of a touch.
    - `quiet`: root mean square of the changes, in standard deviations of the channels, below which a skin counts as
      untouched.
    - `lag`: number of rows by which frames of the training set lagged behind their presses.
    - `per_session`: whether voltage changes are standardised separately for each session.
    - `name`: name of the training presses.
    - `notes`: corrections that were made to the training presses, as text.
    - `standing`: accuracy on held-out presses, by quantity.

    **Example:**

    ```python
    learnt = LearntSkin.fit(presses, method="neighbours")
    print(learnt.predict(presses.frames, reference).position)
    ```
    """

    channels: Channels
    mean_reference: Float[np.ndarray, " M"] | None
    place: LearntNumbers | None
    force: LearntNumbers | None
    label: LearntLabels | None
    keys: LearntKeys | None
    quiet: float
    lag: int
    per_session: bool
    name: str
    notes: list[str]
    standing: dict[str, Standing] = field(default_factory=dict)

    @classmethod
    def fit(
        cls,
        presses: Presses,
        *,
        method: str = "auto",
        model: ForwardModel | None = None,
        num_channels: int | None = None,
        per_session: bool = False,
        progress: Callable[[str], None] | None = None,
    ) -> "LearntSkin":
        """Fit models of place, force, label and keys to recorded presses.

        `method`: one of `METHODS`, used for the quantities that the method can learn; "auto" chooses the method with
        the lowest error on presses held out in intervals of time. `model`: optional forward model of the skin, with a
        few hundred nodes; images reconstructed with the model, and the contacts in the images, are additional features.
        `num_channels`: number of channels to use, of which the most informative are selected; by default all.
        `per_session`: standardise the changes of each `group` separately, against drift. `progress`: function that is
        called with a description of each step. Raises `ValueError` for an unknown method, a method that can learn no
        quantity of the presses, presses from which nothing can be learnt, and a model whose number of channels differs
        from that of the frames.
        """
        _check_fit(presses, method, model, num_channels, per_session)
        with limit_to_one_thread():
            report = progress or (lambda message: None)
            return cls._fit(presses, method, model, num_channels, per_session, report)

    @classmethod
    def _fit(cls, presses: Presses, method, model, num_channels, per_session, progress) -> "LearntSkin":
        notes = list(presses.notes)
        presses, usability_notes = _usable_presses(presses)
        notes += usability_notes
        changes = changes_from_reference(presses.frames, presses.reference)
        if per_session:
            changes = standardise_sessions(changes, presses.group)
        progress("channels")
        channels = Channels.learn(changes)
        if num_channels is not None:
            channels, reduction_note = _reduce_channels(channels, changes, presses, num_channels)
            notes.append(reduction_note)
        elif not channels.used.all():
            silent_channels = np.flatnonzero(~channels.used)
            notes.append(
                f"{counted(len(silent_channels), 'channel')} of {len(channels.used)} without changes, not used: "
                f"{_list_briefly(silent_channels)}."
            )
        changes, alive, *_ = channels.complete(changes)
        if not alive.all():
            notes.append(
                f"{100 * (1 - alive.mean()):.2g} % of the readings disagree with the prediction from the other "
                f"channels and were replaced by it."
            )
        changes, presses, lag, model_notes = _align_frames(changes, presses)
        quiet = _quiet_threshold(changes / channels.scale, presses)
        mean = None if presses.reference is None else mean_reference(presses.reference)
        imaged = None
        if model is not None:
            progress("images")
            imaged, image_notes = ImageReconstruction.create(model, changes, channels.used, mean)
            model_notes += image_notes
        references = None if mean is None else fill_reference(presses.reference, mean, channels.used, len(changes))
        models, standing, fit_notes = learn_quantities(changes, references, presses, method, imaged, progress)
        notes = list(dict.fromkeys([*notes, *model_notes, *fit_notes]))
        return cls(
            channels,
            mean,
            **models,
            quiet=quiet,
            lag=lag,
            per_session=per_session,
            name=presses.name,
            notes=notes,
            standing=standing,
        )

    def predict(self, frames: ArrayLike, reference: ArrayLike | None = None, group: ArrayLike | None = None) -> Touches:
        """Predict place, force, label and keys of touches from frames (frames, channels).

        `reference`, one frame or one for each frame, is required if the training presses had a reference; `group` is
        the session of each frame, if the skin was learnt `per_session`. Dead channels are detected, and their readings
        replaced; frames unlike the training set are marked, and have no predicted touch. Raises `ValueError` if the
        number of channels differs from that of the skin, or the reference is missing, superfluous, or of another skin.
        """
        frames = self._check_frames(frames)
        reference = self._check_reference(frames, reference)
        changes = changes_from_reference(frames, reference)
        if self.per_session:
            changes = standardise_sessions(changes, group)
        changes = np.where(self._stuck_channels(frames, changes), np.nan, changes)
        predictions = apply_over_threads(
            self._predict_frames,
            changes,
            fill_reference(reference, self.mean_reference, self.channels.used, len(changes)),
            chunk_size=_CHUNK_SIZE,
        )
        names = [field.name for field in fields(Touches) if field.name != "notes"]
        touch_fields: dict[str, Any] = {name: predictions.get(name) for name in names}
        return Touches(**touch_fields, notes=self._prediction_notes(predictions["alive"], predictions["unlike"]))

    def _stuck_channels(self, frames: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Detect stuck channels, whose readings are the same in all frames although many frames are touched.

        Only touched frames count: a coarse A/D converter may give constant readings of an untouched skin.
        """
        is_constant = (frames == frames[0]).all(axis=0)
        if is_constant.all() or not is_constant.any() or len(frames) < _MIN_TOUCHED_FRAMES:
            return np.zeros_like(is_constant)
        scaled_changes = np.where(is_constant, 0.0, np.nan_to_num(changes))[:, self.channels.used] / self.channels.scale
        return is_constant & (
            np.count_nonzero(np.sqrt(np.mean(scaled_changes**2, axis=1)) > self.quiet) >= _MIN_TOUCHED_FRAMES
        )

    def _predict_frames(
        self, changes: Float[np.ndarray, "n M"], reference: Float[np.ndarray, "n m"]
    ) -> dict[str, np.ndarray]:
        """Predict the learnt fields of `Touches`, by name, from the voltage changes of frames."""
        completed_changes, alive, novelty, excess_mean_square = self.channels.complete(changes)
        is_touched = np.sqrt(np.mean((completed_changes / self.channels.scale) ** 2, axis=1)) > self.quiet
        # Frames with small changes count as untouched, not as unlike; frames with too many missing channels are always
        # unlike.
        is_unlike = (novelty > _MAX_NOVELTY) & is_touched | (alive.mean(axis=1) < _MIN_ALIVE_FRACTION)
        predictions = {"novelty": novelty, "unlike": is_unlike, "alive": np.zeros(changes.shape, bool)}
        predictions["alive"][:, self.channels.used] = alive
        if self.label is not None:
            label, probability = self.label.predict(completed_changes, reference)
            predictions["label"] = np.where(is_unlike, "", np.where(is_touched, label, NO_TOUCH))
            predictions["probability"] = np.where(is_unlike | (~is_touched & (label != NO_TOUCH)), np.nan, probability)
            is_touched &= label != NO_TOUCH
        has_prediction = (is_touched & ~is_unlike)[:, None]
        if self.place is not None:
            targets, std = self._predict_targets(self.place, completed_changes, reference, alive, excess_mean_square)
            predictions |= {
                "position": np.where(has_prediction, targets, np.nan),
                "position_std": np.where(has_prediction, std, np.nan),
            }
        if self.force is not None:
            targets, std = self._predict_targets(self.force, completed_changes, reference, alive, excess_mean_square)
            is_untouched = ~is_touched & ~is_unlike
            forces = np.where(has_prediction, np.maximum(targets, 0.0), np.nan)[:, 0]
            predictions |= {
                "force": np.where(is_untouched, 0.0, forces),
                "force_std": np.where(has_prediction, std, np.nan)[:, 0],
            }
        if self.keys is not None:
            pressed_keys, probability = self.keys.predict(completed_changes, reference)
            predictions["touched"] = pressed_keys & has_prediction
            probability = np.where(is_touched[:, None], probability, 0.0)
            predictions["key_probability"] = np.where(is_unlike[:, None], np.nan, probability)
        return predictions

    def _predict_targets(
        self, model: LearntNumbers, changes, reference, alive, excess_mean_square
    ) -> tuple[np.ndarray, np.ndarray]:
        """Predict places or forces (frames, targets) and their standard deviations.

        The standard deviations include the errors of the readings that are predicted for dead channels. If a frame
        deviates more from the channel patterns than training presses do, they also include errors of all its readings.
        """
        noisy_rows = np.flatnonzero(excess_mean_square.any(axis=1))
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (_NUM_DRAWS, 1, changes.shape[1]))
        perturbed_changes = (changes[noisy_rows] + signs * excess_mean_square[noisy_rows]).reshape(-1, changes.shape[1])
        # Predict for all inputs in one call, since for few frames the overhead of a call exceeds the computing time.
        repeated_references = np.tile(reference[noisy_rows], (_NUM_DRAWS, 1))
        inputs = np.concatenate([changes, perturbed_changes]), np.concatenate([reference, repeated_references])
        predictions, errors = np.split(model.predict(*inputs), [len(changes)])
        std = model.spread(predictions, changes)
        errors = errors.reshape(_NUM_DRAWS, len(noisy_rows), predictions.shape[1]) - predictions[noisy_rows]
        std[noisy_rows] = np.hypot(std[noisy_rows], np.sqrt(np.mean(errors**2, axis=0)))
        rows_with_dead_channels = np.flatnonzero(~alive.all(axis=1))
        if not rows_with_dead_channels.size:
            return predictions, std
        for reading_errors in self.channels.prediction_errors(alive[rows_with_dead_channels], _MAX_ERROR_DIRECTIONS):
            errors = (
                model.predict(changes[rows_with_dead_channels] + reading_errors, reference[rows_with_dead_channels])
                - predictions[rows_with_dead_channels]
            )
            std[rows_with_dead_channels] = np.hypot(std[rows_with_dead_channels], errors)
        return predictions, std

    def _check_frames(self, frames) -> np.ndarray:
        frames = np.asarray(frames)
        frames = check_frames("frames", frames[None] if frames.ndim == 1 else frames)
        num_channels = len(self.channels.used)
        if not len(frames):
            raise ValueError("frames: the array is empty; give at least one frame.")
        if frames.shape[1] != num_channels:
            raise ValueError(
                f"frames have {frames.shape[1]} channels, and the skin that was learnt has {num_channels}."
            )
        return frames

    def _check_reference(self, frames, values) -> np.ndarray | None:
        if self.mean_reference is None:
            if values is not None:
                raise ValueError("reference: the skin was learnt from changes, without a reference; leave it out.")
            return None
        if values is None:
            raise ValueError(
                "reference is missing: the training presses had one; give a frame (channels,), or one for each frame."
            )
        reference = check_reference(values, frames)
        is_read_channel = np.isfinite(reference).any(axis=0) & self.channels.used
        # Means of the frames, and of the training frames.
        a, b = mean_reference(reference)[is_read_channel], self.mean_reference[is_read_channel]
        if not is_read_channel.any():
            raise ValueError(
                "reference has no finite reading in any channel that is used; give a frame of the untouched skin."
            )
        if not b.any():  # the frames of the training set were voltage changes
            return reference
        similarity = float(a @ b / np.sqrt((a @ a) * (b @ b))) if a.any() else 0.0
        norm_ratio = np.sqrt((a @ a) / (b @ b))
        if similarity < _MIN_COSINE_SIMILARITY or not 1 / _MAX_NORM_RATIO < norm_ratio < _MAX_NORM_RATIO:
            raise ValueError(
                f"reference is unlike that of the training set (cosine {similarity:.2f}, {norm_ratio:.3g} "
                "times as large): is it of this skin, with its channels in the same order and units?"
            )
        return reference

    def _prediction_notes(self, alive: np.ndarray, is_unlike: np.ndarray) -> tuple[str, ...]:
        notes = []
        used_channels = np.flatnonzero(self.channels.used)
        alive = alive[:, used_channels]
        dead_fractions = np.mean(~alive, axis=0)
        dead_channels = used_channels[dead_fractions > 0.5]
        if dead_channels.size:
            notes.append(
                "channels that disagree with the prediction from the others and are not used: "
                f"{_list_briefly(dead_channels)}."
            )
        elif dead_fractions.any():
            notes.append(
                f"{100 * np.mean(~alive):.2g} % of the readings disagree with the prediction from the other "
                f"channels and were replaced by it."
            )
        if is_unlike.any():
            notes.append(
                f"{int(is_unlike.sum())} of {len(is_unlike)} frames are unlike all frames of the training set: they "
                "have no prediction."
            )
        return tuple(notes)


def _check_fit(presses: Presses, method: str, model, num_channels: int | None, per_session: bool) -> None:
    require_extra("learn", "learning a skin")
    check_kind("presses", presses, Presses, "Presses, as of read_presses(path)")
    check_name("method", method, METHODS)
    has_targets = presses.positions is not None or presses.force is not None
    if method != "auto" and not (
        (has_targets and method in regression.METHODS)
        or (presses.label is not None and method in label_methods.METHODS)
    ):
        quantities = "labels" if method in label_methods.METHODS else "places and forces"
        raise ValueError(f"method: {method!r} learns {quantities}, and the presses have none; leave method to 'auto'.")
    is_whole_number = isinstance(num_channels, int | np.integer) and not isinstance(num_channels, bool)
    max_channels = presses.frames.shape[1]
    if num_channels is not None and not (is_whole_number and 2 <= num_channels <= max_channels):
        raise ValueError(f"num_channels must be from 2 to {max_channels}, those there are; it is {num_channels}.")
    if model is not None:
        check_imaged(model, max_channels)
    if model is not None and per_session:
        raise ValueError("model: images are of changes in volts, and per_session takes their unit away; leave one out.")
    if per_session and presses.group is None:
        raise ValueError("per_session: presses have no group that says the session of each.")


def _usable_presses(presses: Presses) -> tuple[Presses, list[str]]:
    """Select the presses that have readings of at least two thirds of the channels.

    Channels that have no reading in any press are left out of the count.
    """
    changes = changes_from_reference(presses.frames, presses.reference)
    has_reading = np.isfinite(changes)
    has_readings = has_reading.any(axis=0)
    notes = []
    if not has_readings.all():
        channels = np.flatnonzero(~has_readings)
        notes.append(f"{counted(len(channels), 'channel')} without any reading: {_list_briefly(channels)}.")
    is_usable = (
        has_reading[:, has_readings].mean(axis=1) >= _MIN_ALIVE_FRACTION
        if has_readings.any()
        else np.zeros(len(has_reading), bool)
    )
    if is_usable.sum() < 10:
        raise ValueError(
            f"frames: only {int(is_usable.sum())} have readings of two thirds of the channels; 10 are needed."
        )
    if not is_usable.all():
        notes.append(f"{int((~is_usable).sum())} presses lack more than a third of their readings, and are not used.")
    return presses.rows(is_usable), notes


def _reduce_channels(
    channels: Channels, changes: np.ndarray, presses: Presses, num_channels: int
) -> tuple[Channels, str]:
    scaled = np.where(np.isnan(changes), 0.0, changes)[:, channels.used] / channels.scale
    selected_channels = np.flatnonzero(channels.used)[
        choose_channels(scaled, _standardised_targets(presses), num_channels)
    ]
    selected_changes = np.full(changes.shape, np.nan)
    selected_changes[:, selected_channels] = changes[:, selected_channels]
    channel_list = _list_briefly(np.sort(selected_channels), 200)
    return Channels.learn(
        selected_changes
    ), f"{len(selected_channels)} of {changes.shape[1]} channels are used: {channel_list}."


def _standardised_targets(presses: Presses) -> np.ndarray:
    """Return all quantities of the presses as standardised columns (presses, columns); 0 where a quantity is
    unknown."""
    target_columns = []
    if presses.positions is not None:
        target_columns.append(presses.positions)
    if presses.force is not None:
        target_columns.append(presses.force[:, None])
    if presses.label is not None:
        target_columns.append(presses.label[:, None] == np.unique(presses.label))
    if presses.touched is not None:
        target_columns.append(presses.touched)
    targets = np.column_stack(target_columns).astype(float)
    deviations = np.nanstd(targets, axis=0)
    return np.nan_to_num((targets - np.nanmean(targets, axis=0)) / np.where(deviations > 0, deviations, 1.0))


def _quiet_threshold(scaled: np.ndarray, presses: Presses) -> float:
    """Compute the threshold of the root mean square change that separates untouched from touched frames.

    With fewer than five untouched frames, the threshold is half of the 1 % quantile of the root mean square change of
    touched frames.
    """
    is_untouched = np.zeros(len(scaled), bool)
    if presses.positions is not None:
        is_untouched |= np.isnan(presses.positions).any(axis=1)
    if presses.label is not None:
        is_untouched |= presses.label == NO_TOUCH
    if presses.touched is not None:
        is_untouched |= ~presses.touched.any(axis=1)
    rms_size = np.sqrt(np.mean(scaled**2, axis=1))
    if is_untouched.sum() < 5:
        return 0.5 * float(np.quantile(rms_size[~is_untouched], 0.01))
    thresholds = np.sort(rms_size)
    # Choose the threshold with the lowest sum of the error rates for untouched and for touched frames.
    error_sums = [
        np.mean(rms_size[is_untouched] > threshold) + np.mean(rms_size[~is_untouched] <= threshold)
        for threshold in thresholds
    ]
    return float(thresholds[int(np.argmin(error_sums))])


def _align_frames(changes: np.ndarray, presses: Presses) -> tuple[np.ndarray, Presses, int, list[str]]:
    """Align frames with their presses if the frames of the recording clearly lag behind the presses or precede them.

    Returns the aligned changes and presses, the lag in rows, and a note on the lag as text.
    """
    if presses.positions is None:
        return changes, presses, 0, []
    placed, folds, _ = places_and_folds(presses)
    lag, error_without_lag, error_with_lag = estimate_lag(changes[placed], presses.positions[placed], folds)
    if not lag:
        return changes, presses, 0, []
    frame_rows, press_rows = aligned_slices(len(changes), lag)
    reference = None if presses.reference is None else presses.reference[frame_rows]
    aligned_presses = replace(presses.rows(press_rows), frames=presses.frames[frame_rows], reference=reference)
    alignment_note = (
        f"frames seem to be of the press {counted(abs(lag), 'row')} {'before' if lag > 0 else 'after'} (places "
        f"estimated {1e3 * error_with_lag:.3g} mm off, as recorded {1e3 * error_without_lag:.3g} mm): learnt so; "
        "check the recording."
    )
    return changes[frame_rows], aligned_presses, lag, [alignment_note]


def _list_briefly(channel_numbers: np.ndarray, max_listed: int = 12) -> str:
    listed_text = ", ".join(str(channel_number) for channel_number in channel_numbers[:max_listed])
    return listed_text if len(channel_numbers) <= max_listed else f"{listed_text}, … ({len(channel_numbers)} in all)"
