"""Windows of labelled clips of sound, and cross-validation folds of groups of clips.

A long recording, for example of many successive taps, is cut into pieces at its quiet parts; each piece counts as a
clip.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Array, Float, Int

from jeit.arguments import counted
from jeit.touch.listening.feature_images import WINDOW_DURATION, SoundImages, sound_images
from jeit.touch.listening.labelled_clips import LabelledClips
from jeit.touch.listening.learners import TrainingSet


def held_out_folds(
    clip_classes: Int[np.ndarray, " N"], groups: Int[np.ndarray, " N"], max_folds: int
) -> Int[np.ndarray, " N"]:
    """Return the cross-validation fold (N,) in which each of N clips is held out, with all clips of its group.

    `clip_classes`, `groups`: class and group of each clip. The fold is -1 for clips that are always in the training
    set, since no other group has clips of their class. The groups of each class, the largest groups first, are assigned
    in turn to at most `max_folds` folds, so that every training set contains all classes.
    """
    clip_folds = np.full(len(clip_classes), -1)
    fold_of_group: dict[int, int] = {}
    fold_clip_counts = np.zeros(max_folds, int)
    groups_by_class = [np.unique(groups[clip_classes == class_label]) for class_label in np.unique(clip_classes)]
    for class_groups in sorted(groups_by_class, key=len):
        if len(class_groups) < 2:
            continue
        for clip_group in sorted(class_groups.tolist(), key=lambda clip_group: -int((groups == clip_group).sum())):
            if clip_group not in fold_of_group:
                num_groups_per_fold = [
                    sum(fold_of_group.get(other_group) == fold_index for other_group in class_groups.tolist())
                    for fold_index in range(max_folds)
                ]
                fold_of_group[clip_group] = min(
                    range(max_folds),
                    key=lambda fold_index: (num_groups_per_fold[fold_index], fold_clip_counts[fold_index], fold_index),
                )
                fold_clip_counts[fold_of_group[clip_group]] += int((groups == clip_group).sum())
    for clip_group, fold_index in fold_of_group.items():
        clip_folds[groups == clip_group] = fold_index
    # If all groups of a class were in one fold, the class would be tested while it is absent from the training set.
    for class_label in np.unique(clip_classes):
        is_in_class = clip_classes == class_label
        if len(np.unique(clip_folds[is_in_class])) < 2:
            clip_folds[is_in_class] = -1
    used_folds = np.unique(clip_folds[clip_folds >= 0])
    return np.where(clip_folds >= 0, np.searchsorted(used_folds, clip_folds), -1)


MIN_RELATIVE_LOUDNESS = 0.01
"""Minimum loudness of a window that is used, relative to the power of the recording's loudest frame."""
# Maximum number of training windows of one piece of a clip, evenly spaced: more windows of one sound add little.
_MAX_PIECE_WINDOWS = 40
# Duration beyond which a clip is cut into pieces; duration of the pieces of an uninterrupted sound; seconds.
_MAX_CLIP_DURATION, _PIECE_DURATION = 4.0, 2.0
# Maximum number of pieces of one clip.
_MAX_PIECES = 60
# Maximum number of groups of pieces that are held out in turn, if a class has clips of one group only.
_MAX_PIECE_GROUPS = 6


@dataclass(frozen=True)
class Windows:
    """W sound windows of a training set, and the clips to which the windows belong.

    `images`: feature images of the windows; `clip` (W,): index of the clip, or piece of a longer clip, of each window;
    `labels` (W,): class of each window, an index of `names`; `names`: names of the classes; `clip_labels`,
    `clip_groups`: class and group of each clip or piece; `notes`: remarks on the clips.
    """

    images: SoundImages
    clip: np.ndarray
    labels: np.ndarray
    names: tuple[str, ...]
    clip_labels: np.ndarray
    clip_groups: np.ndarray
    notes: tuple[str, ...] = ()

    @classmethod
    def from_clips(cls, clips: LabelledClips, report: Callable[[str], None]) -> "Windows":
        """Select the windows of each clip that are at most 20 dB below its loudest frame.

        Raises `ValueError` for clips without finite samples.
        """
        unique_labels, clip_labels = np.unique(clips.labels, return_inverse=True)
        clip_groups = np.unique(clips.groups, return_inverse=True)[1]
        single_group_labels = {
            label_index
            for label_index in range(len(unique_labels))
            if len(np.unique(clip_groups[clip_labels == label_index])) < 2
        }
        image_blocks, clip_of_piece, group_of_piece, cut_classes = [], [], [], set()
        for clip_index in range(len(clips)):
            clip_images = sound_images(clips.clip(clip_index), clips.highest)
            loud_windows = np.flatnonzero(
                clip_images.known & (clip_images.loudness >= MIN_RELATIVE_LOUDNESS * clip_images.loudness.max())
            )
            if not len(loud_windows):
                raise ValueError(f"recordings[{clip_index}], {clips.recordings[clip_index].name}: it holds no numbers.")
            has_single_group = clip_labels[clip_index] in single_group_labels
            is_long = clip_images.times[-1] - clip_images.times[0] > _MAX_CLIP_DURATION
            clip_pieces = (
                _split_pieces(clip_images.times[loud_windows])
                if is_long or has_single_group
                else [np.arange(len(loud_windows))]
            )
            for piece_index, piece_windows in enumerate(clip_pieces):
                selected_windows = piece_windows[
                    np.linspace(0, len(piece_windows) - 1, min(len(piece_windows), _MAX_PIECE_WINDOWS))
                    .round()
                    .astype(int)
                ]
                image_blocks.append(clip_images[loud_windows[selected_windows]])
                clip_of_piece.append(clip_index)
                group_of_piece.append(
                    (
                        clip_groups[clip_index],
                        piece_index * _MAX_PIECE_GROUPS // max(len(clip_pieces), _MAX_PIECE_GROUPS)
                        if has_single_group
                        else 0,
                    )
                )
            if has_single_group and len(clip_pieces) > 1:
                cut_classes.add(str(unique_labels[clip_labels[clip_index]]))
            report(f"{counted(clip_index + 1, 'clip')} of {len(clips)}")
        clip_of_window = np.repeat(np.arange(len(image_blocks)), [len(image_block) for image_block in image_blocks])
        piece_labels = clip_labels[clip_of_piece]
        notes = ()
        if cut_classes:
            notes = (
                f"{', '.join(sorted(cut_classes))}: one recording only, cut into the sounds in it, which are held out "
                "in turn; "
                "accuracy on another recording is not known, and likely lower.",
            )
        class_names = tuple(map(str, unique_labels))
        piece_groups = np.unique(group_of_piece, axis=0, return_inverse=True)[1].ravel()
        return cls(
            SoundImages.concatenate(image_blocks),
            clip_of_window,
            piece_labels[clip_of_window],
            class_names,
            piece_labels,
            piece_groups,
            notes,
        )

    @property
    def normalised(self) -> "Windows":
        """The same windows, scaled to equal loudness."""
        return replace(self, images=self.images.normalised)

    @property
    def classes(self) -> int:
        """Number C of classes."""
        return len(self.names)

    def training_set(self, rows: np.ndarray, key: Array, batches: int, checkpoint: Path | None, report) -> TrainingSet:
        """Create a training set from the windows that the mask `rows` (W,) selects."""
        groups = self.clip_groups[self.clip[rows]]
        return TrainingSet(self.images[rows], self.labels[rows], groups, self.classes, key, batches, checkpoint, report)

    def predict_clips(self, odds: Float[np.ndarray, "W C"]) -> tuple[np.ndarray, np.ndarray]:
        """Predict the class of each held-out clip from the log-odds of its windows; returns the predicted and true
        classes."""
        is_held_out = np.isfinite(odds).all(axis=1)
        log_probabilities = odds[is_held_out] - np.logaddexp.reduce(odds[is_held_out], axis=1, keepdims=True)
        held_out_clips, clip_row_of_window = np.unique(self.clip[is_held_out], return_inverse=True)
        clip_log_probabilities = np.zeros((len(held_out_clips), self.classes))
        np.add.at(clip_log_probabilities, clip_row_of_window, log_probabilities)
        return clip_log_probabilities.argmax(axis=1), self.clip_labels[held_out_clips]

    def errors(self, odds: Float[np.ndarray, "W C"]) -> tuple[float, float]:
        """Compute the error rates of held-out clips and of held-out windows from the log-odds (W, C) of windows."""
        is_held_out = np.isfinite(odds).all(axis=1)
        if not is_held_out.any():
            return 0.0, 0.0
        predicted_classes, true_classes = self.predict_clips(odds)
        return float(np.mean(predicted_classes != true_classes)), float(
            np.mean(odds[is_held_out].argmax(axis=1) != self.labels[is_held_out])
        )


def _split_pieces(times: Float[np.ndarray, " n"]) -> list[np.ndarray]:
    """Split the loud windows of a clip into pieces that share no samples; returns the indices of the windows of each
    piece.

    `times`: middles of the windows, seconds. Consecutive windows belong to one sound if the time between them does not
    exceed the duration of a window. A long sound is cut every 2 s; windows that extend over a cut are left out.
    """
    window_pieces, piece_period = [], _PIECE_DURATION + WINDOW_DURATION
    for sound_windows in np.split(np.arange(len(times)), np.flatnonzero(np.diff(times) > WINDOW_DURATION) + 1):
        elapsed_times = times[sound_windows] - times[sound_windows[0]]
        if elapsed_times[-1] <= piece_period:
            window_pieces.append(sound_windows)
            continue
        piece_number, time_in_piece = np.divmod(elapsed_times, piece_period)
        kept_windows = sound_windows[time_in_piece <= _PIECE_DURATION]
        window_pieces += np.split(
            kept_windows, np.flatnonzero(np.diff(piece_number[time_in_piece <= _PIECE_DURATION])) + 1
        )
    if len(window_pieces) > _MAX_PIECES:
        window_pieces = [
            window_pieces[interval_index]
            for interval_index in np.linspace(0, len(window_pieces) - 1, _MAX_PIECES).round().astype(int)
        ]
    return window_pieces
