"""`Listener`: a sound classifier, trained on labelled clips, that classifies the sound of a recording every 0.1 s."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from jeit.acoustic import Calibration, Recording, locate_touches
from jeit.arguments import check_key, check_kind, check_name, counted
from jeit.arguments.extras import require_extra
from jeit.files import error_text
from jeit.touch.learnt.learn_from_presses import Standing
from jeit.touch.learnt.methods import fit_sharpness, probabilities
from jeit.touch.listening.feature_images import NUM_BANDS, WINDOW_INTERVAL, image_blocks
from jeit.touch.listening.labelled_clips import LabelledClips, mix_channels
from jeit.touch.listening.learners import LEARNERS, MAX_TRAINING_BATCHES
from jeit.touch.listening.sound_labels import SoundLabels
from jeit.touch.listening.windows import MIN_RELATIVE_LOUDNESS, Windows, held_out_folds
from jeit.touch.training import read_model, write_model

METHODS = ("auto", *LEARNERS)
# Methods that "auto" tries. The network with the training schedule of the paper is left out, since the schedule of this
# library gives an equally good network in fewer batches.
_AUTO_METHODS = tuple(name for name in LEARNERS if name != "paper-network")
# Maximum number of folds in which clips are held out.
_MAX_FOLDS = 3
# Power below which a window counts as quiet, relative to the power of the quietest training window.
_MAX_QUIET_POWER_RATIO = 0.25
# Minimum ratio of a recording's loudness to that of the softest training clip that is attributed to a lower gain.
_MIN_RECORDING_GAIN = 1 / 16
# Minimum number of windows for which a network is tried.
_MIN_NETWORK_WINDOWS = 3000
# Number of samples within which the readings of a working microphone change.
_MAX_CHECKED_SAMPLES = 100_000
_FILE_KIND, _FILE_VERSION = "a jeit listener", 2


@dataclass(frozen=True)
class Listener:
    """A trained classifier of sounds, such as the sounds of touches of a skin with microphones.

    **Fields**: `names` (C,): names of the classes; `method`: name of the method; `model`: trained classifier;
    `channels`: number of microphones, 1 if they are mixed; `highest`: maximum frequency of sound that is used, Hz;
    `loudness`: whether loudness is a feature, otherwise all windows are scaled to equal loudness; `quietest`: minimum
    loudness of a training window; `clips_loudness`: loudness of the softest and of the loudest clip; `sharpness`:
    factor by which log-odds are multiplied before probabilities are computed; `doubt`: fraction of the probability that
    is spread evenly over all classes, 1 / (n + 2) for n held-out clips, since n clips support no higher confidence.
    `standing`: predictions for the held-out clips, and error rates of all methods that were tried, the best first; None
    for a listener that was read from a file; `notes`: remarks on the training; `name`: name of the clips.

    **Example:**

    ```python
    listener = Listener.fit(clips, method="linear")
    print(listener.classify(recordings[0]).whole)
    ```
    """

    names: tuple[str, ...]
    method: str
    model: Any
    channels: int
    highest: float
    loudness: bool
    quietest: float
    clips_loudness: tuple[float, float]
    sharpness: float
    doubt: float
    standing: Standing | None = None
    notes: tuple[str, ...] = ()
    name: str = "clips"

    @classmethod
    def fit(
        cls,
        clips: LabelledClips,
        *,
        method: str = "auto",
        loudness: bool | None = None,
        key: Array | None = None,
        batches: int = MAX_TRAINING_BATCHES,
        folder: str | Path | None = None,
        progress: Callable[[str], None] | None = None,
    ) -> "Listener":
        """Train a classifier of sounds on labelled clips.

        `method`: one of `METHODS`; "auto" chooses the method that classifies the most held-out clips correctly, where
        the windows of a clip are classified together. Clips are held out in three folds, together with all clips of
        their group. The training windows of a clip are those at most 20 dB below its loudest frame, since the label
        does not describe the rest; in clips longer than 4 s, every single sound counts as a clip. "auto" does not try
        the network if there are few windows. `loudness`: whether loudness is used as a feature; by default, it is used
        if it increases the number of held-out clips that a linear discriminant classifies correctly by more than
        chance. `key`: random key that draws the initial weights of the networks, each trained on at most `batches`
        batches; `folder`: folder for checkpoints, from which an interrupted training can resume; `progress`: function
        that is called with a description of the progress. Raises `ValueError` for invalid clips, key or method;
        `ImportError` without the extra `learn`.
        """
        require_extra("learn", "learning to classify sounds")
        check_kind("clips", clips, LabelledClips, "clips as of read_clips(folder)")
        check_name("method", method, METHODS)
        key = jax.random.key(0) if key is None else key
        check_key(key)
        report_progress = progress or (lambda message: None)
        windows = Windows.from_clips(clips, report_progress)
        clip_folds = held_out_folds(windows.clip_labels, windows.clip_groups, _MAX_FOLDS)
        notes = [*clips.notes, *windows.notes]
        untested_classes = np.array(windows.names)[np.unique(windows.clip_labels[clip_folds < 0])]
        if untested_classes.size:
            notes.append(
                f"{', '.join(untested_classes)}: clips of one group only, which are never held out; their accuracy is "
                "not known."
            )
        candidate_methods = _AUTO_METHODS if method == "auto" else (method,)
        if method == "auto" and len(windows.clip) < _MIN_NETWORK_WINDOWS:
            candidate_methods = tuple(method_name for method_name in candidate_methods if method_name != "network")
            notes.append(
                f"no network was tried: {len(windows.clip)} windows are few for one, and {_MIN_NETWORK_WINDOWS} would "
                "not be."
            )
        window_loudness = windows.images.loudness
        clip_loudness = np.maximum.reduceat(window_loudness, np.flatnonzero(np.diff(windows.clip, prepend=-1)))
        if loudness is None:
            loudness = _is_loudness_useful(windows, clip_folds, key, report_progress)
        if not loudness:
            windows = windows.normalised
        log_odds_of_methods = []
        for method_name in candidate_methods:
            log_odds_of_methods.append(
                (method_name, _held_out_odds(method_name, windows, clip_folds, key, batches, folder, report_progress))
            )
        ranked_methods = [
            (windows.errors(window_log_odds), method_order, method_name, window_log_odds)
            for method_order, (method_name, window_log_odds) in enumerate(log_odds_of_methods)
        ]
        # Methods are listed with the simplest last, which is chosen among methods with equal errors.
        ranked_methods.sort(key=lambda ranked_method: (*ranked_method[0], -ranked_method[1]))
        (_, _, best_method, window_log_odds) = ranked_methods[0]
        report_progress(f"{best_method}, all clips")
        full_training_set = windows.training_set(
            np.ones(len(windows.clip), bool), key, batches, _checkpoint_path(folder, best_method), report_progress
        )
        trained_learner = LEARNERS[best_method].learn(full_training_set)
        is_held_out = np.isfinite(window_log_odds).all(axis=1)
        standing = None
        if is_held_out.any():
            predicted_classes, true_classes = windows.predict_clips(window_log_odds)
            method_errors = [(method_name, error_rates[0]) for error_rates, _, method_name, _ in ranked_methods]
            standing = Standing(
                best_method,
                method_errors,
                np.array(windows.names)[predicted_classes],
                np.array(windows.names)[true_classes],
            )
        else:
            notes.append(
                "no class has clips of two groups: nothing could be held out, and nobody knows how good it is."
            )
        # If all of a few held-out clips are classified correctly, the likelihood alone does not limit the confidence;
        # `doubt`, from the rule of succession, does.
        sharpness = (
            min(1.0, fit_sharpness(window_log_odds[is_held_out], windows.labels[is_held_out]))
            if is_held_out.any()
            else 1.0
        )
        num_held_out = 0 if standing is None else len(standing.right)
        return cls(
            windows.names,
            best_method,
            trained_learner,
            clips.channels,
            clips.highest,
            loudness,
            float(window_loudness.min()),
            (float(clip_loudness.min()), float(clip_loudness.max())),
            sharpness,
            1 / (num_held_out + 2),
            standing,
            tuple(notes),
            clips.name,
        )

    def classify(self, recording: Recording, *, calibration: Calibration | None = None) -> SoundLabels:
        """Classify every window of a recording; windows are 0.5 s long and begin every 0.1 s.

        A recording shorter than a window is padded with silence. With a `calibration` of the microphones, the places of
        touches are estimated too, by `locate_touches`. If the listener has one channel, the channels of the recording
        are mixed. Raises `ValueError` if `recording` is not a `Recording`, differs from the training clips in the
        number of microphones, or has no sound up to the frequency `highest`, and as `locate_touches` does.
        """
        check_kind("recording", recording, Recording, "a Recording of samples, as of read_recording(path)")
        notes = []
        original_recording = recording
        if self.channels == 1 and len(recording.samples) > 1:
            recording = mix_channels(recording)
            notes.append(f"{len(original_recording.samples)} channels were mixed to one, as the listener has it.")
        if len(recording.samples) != self.channels:
            raise ValueError(
                f"{recording.name} has {counted(len(recording.samples), 'microphone')}, and the listener was learnt "
                f"from clips of {self.channels}; record with as many, or train a listener on clips of this array."
            )
        if recording.rate < 2 * self.highest * (1 - 1e-3):
            raise ValueError(
                f"{recording.name} has {recording.rate:g} samples a second, sound up to {recording.rate / 2:g} Hz, and "
                f"the listener uses sound up to {self.highest:g} Hz; record {2 * self.highest:g} a second or more, "
                "or train a listener on clips of this rate."
            )
        num_not_finite = int((~np.isfinite(recording.samples)).sum())
        if num_not_finite:
            notes.append(f"{counted(num_not_finite, 'sample')} not finite: taken for silence.")
        dead_channels = np.flatnonzero(
            [
                len(np.unique(channel_samples[np.isfinite(channel_samples)][:_MAX_CHECKED_SAMPLES])) < 2
                for channel_samples in original_recording.samples
            ]
        )
        if dead_channels.size:
            notes.append(f"microphones that never move: {', '.join(map(str, dead_channels))}.")
        block_results = [
            (
                image_block.times,
                image_block.loudness,
                image_block.known,
                image_block.strongest,
                self.model.log_odds(image_block if self.loudness else image_block.normalised),
            )
            for image_block in image_blocks(recording, self.highest)
        ]
        window_times, loudness, is_known, strongest_microphones, window_log_odds = (
            np.concatenate(result_columns) for result_columns in zip(*block_results, strict=True)
        )
        is_quiet = loudness < self._quiet_threshold(float(loudness.max()))
        if is_quiet.all() and loudness.max() > 0:
            notes.append("all of it is quieter than anything learnt from: is the gain another?")
        touch_positions, position_deviations = (
            (None, None) if calibration is None else _estimate_positions(original_recording, calibration, window_times)
        )
        class_probabilities = probabilities(window_log_odds, self.sharpness)
        return SoundLabels(
            window_times,
            (1 - self.doubt) * class_probabilities + self.doubt / class_probabilities.shape[1],
            self.names,
            is_quiet,
            is_known,
            strongest_microphones,
            (loudness >= MIN_RELATIVE_LOUDNESS * loudness.max()) & (loudness > 0),
            recording.name,
            tuple(notes),
            touch_positions,
            position_deviations,
        )

    def _quiet_threshold(self, max_loudness: float) -> float:
        """Compute the loudness below which windows count as quiet; `max_loudness`: loudness of the recording's loudest
        window.

        If loudness is not a feature, the recording's gain may differ from that of the training clips: up to 12 dB
        lower, or any amount higher.
        """
        softest_clip, loudest_clip = self.clips_loudness
        recording_gain = (
            1.0
            if self.loudness
            else float(np.clip(max_loudness / softest_clip, _MIN_RECORDING_GAIN, 1))
            * max(1.0, max_loudness / loudest_clip)
        )
        return _MAX_QUIET_POWER_RATIO * self.quietest * recording_gain

    def write(self, path: str | Path) -> None:
        """Write the listener, without its `standing`, to one file that consists of a JSON header and arrays.

        Raises `ValueError` if `path` is a folder.
        """
        model_header, arrays = self.model.to_stored()
        header = {
            "names": list(self.names),
            "method": self.method,
            "channels": self.channels,
            "highest_Hz": self.highest,
            "loudness_counts": self.loudness,
            "quietest": self.quietest,
            "clips_loudness": list(self.clips_loudness),
            "sharpness": self.sharpness,
            "doubt": self.doubt,
            "notes": list(self.notes),
            "name": self.name,
            "model": model_header,
        }
        write_model(path, _FILE_KIND, _FILE_VERSION, header, arrays)

    @classmethod
    def read(cls, path: str | Path) -> "Listener":
        """Read a listener from a file that `write` wrote, or from the folder that `jeit listen fit` wrote.

        Nothing in the file is executed. Raises `FileNotFoundError` without a file, and `ValueError` for a file that is
        not of a listener.
        """
        path = Path(path)
        if path.is_dir():
            path = path / "listener.jeit"
        if not path.is_file():
            raise FileNotFoundError(f"'{path}': there is no such file; `jeit listen fit` makes one.")

        def create_arrays(header: dict[str, Any]) -> Any:
            check_name("its method", header["method"], tuple(LEARNERS))
            return LEARNERS[header["method"]].stored_shapes(
                header["model"], len(header["names"]), header["channels"] + NUM_BANDS
            )

        header, stored_arrays = read_model(path, _FILE_KIND, _FILE_VERSION, create_arrays)
        try:
            stored_learner = LEARNERS[header["method"]].from_stored(header["model"], stored_arrays)
            header_numbers = (float(header[name]) for name in ("highest_Hz", "quietest", "sharpness", "doubt"))
            highest, quietest, sharpness, doubt = header_numbers
            softest_clip, loudest_clip = map(float, header["clips_loudness"])
            names, notes, name = tuple(map(str, header["names"])), tuple(map(str, header["notes"])), str(header["name"])
            channels, loudness = int(header["channels"]), bool(header["loudness_counts"])
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise ValueError(f"'{path}' is not {_FILE_KIND} that can be read: {error_text(error)}.") from None
        return cls(
            names,
            header["method"],
            stored_learner,
            channels,
            highest,
            loudness,
            quietest,
            (softest_clip, loudest_clip),
            sharpness,
            doubt,
            notes=notes,
            name=name,
        )


def _held_out_odds(
    method_name: str,
    windows: Windows,
    clip_folds: np.ndarray,
    key: Array,
    max_batches: int,
    checkpoint_folder,
    report_progress,
) -> np.ndarray:
    """Compute the log-odds (W, C) of windows by classifiers that are fitted without the fold of the window's clip; NaN
    for windows that are never held out."""
    window_log_odds = np.full((len(windows.images), windows.classes), np.nan)
    for fold_index in range(int(clip_folds.max()) + 1):
        report_progress(f"{method_name}, fold {fold_index + 1} of {int(clip_folds.max()) + 1}")
        is_held_out = (clip_folds == fold_index)[windows.clip]
        training_set = windows.training_set(
            ~is_held_out,
            key,
            max_batches,
            _checkpoint_path(checkpoint_folder, f"{method_name}-{fold_index}"),
            report_progress,
        )
        window_log_odds[is_held_out] = LEARNERS[method_name].learn(training_set).log_odds(windows.images[is_held_out])
    return window_log_odds


def _is_loudness_useful(windows: Windows, clip_folds: np.ndarray, key: Array, report_progress) -> bool:
    """Determine whether loudness as a feature increases the number of clips that a linear discriminant classifies
    correctly, by more than one standard deviation.

    If no clip can be held out, loudness is used if there are several microphones, which share one gain.
    """
    if clip_folds.max() < 0:
        return windows.images.intensity.shape[1] > 1
    is_correct = []
    for window_set in (windows, windows.normalised):
        predicted_classes, true_classes = window_set.predict_clips(
            _held_out_odds("linear", window_set, clip_folds, key, 1, None, report_progress)
        )
        is_correct.append(predicted_classes == true_classes)
    num_improved, num_worsened = (is_correct[0] & ~is_correct[1]).sum(), (is_correct[1] & ~is_correct[0]).sum()
    return bool(num_improved - num_worsened > np.sqrt(num_improved + num_worsened))


def _checkpoint_path(folder: str | Path | None, training_name: str) -> Path | None:
    return None if folder is None else Path(folder) / f"{training_name}.training"


def _estimate_positions(
    recording: Recording, calibration: Calibration, window_times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the touched position in each of W windows, (W, d), and its standard deviations (W, d), metres.

    Positions and standard deviations are means over the frames of the smoothed track that are at most 0.05 s from the
    middle of the window; NaN without such frames.
    """
    located_touches = locate_touches(recording, calibration)
    track_positions, track_deviations = (
        located_touches.track.position,
        np.sqrt(np.diagonal(located_touches.track.covariance, axis1=1, axis2=2)),
    )
    is_in_window = np.abs(located_touches.locations.times - window_times[:, None]) <= WINDOW_INTERVAL / 2
    is_in_window &= np.isfinite(track_positions).all(axis=1)
    num_located_frames = is_in_window.sum(axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        return (is_in_window @ np.nan_to_num(track_positions)) / np.where(
            num_located_frames, num_located_frames, np.nan
        ), (is_in_window @ np.nan_to_num(track_deviations)) / np.where(num_located_frames, num_located_frames, np.nan)
