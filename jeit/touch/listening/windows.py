"""Windows of labelled clips, and cross-validation folds of their groups.

A long recording, such as of many taps one after the other, is cut into pieces where it is quiet; each piece counts as a
clip.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Array, Float, Int

from jeit.arguments import counted
from jeit.touch.listening.feature_images import LENGTH, SoundImages, sound_images
from jeit.touch.listening.labelled_clips import LabelledClips
from jeit.touch.listening.learners import TrainingSet


def held_out_folds(
    clip_classes: Int[np.ndarray, " N"], groups: Int[np.ndarray, " N"], max_folds: int
) -> Int[np.ndarray, " N"]:
    """Assign each of N clips to the fold (N,) in which it is held out, together with all clips of its group.

    `clip_classes`, `groups`: class and group of each clip. The fold is -1 for clips that are always in the training
    set, since their class has no other group. Groups are assigned to at most `max_folds` folds in turn, class by class,
    the largest first, so that every training set contains all classes.
    """
    fold = np.full(len(clip_classes), -1)
    of_group: dict[int, int] = {}
    counts = np.zeros(max_folds, int)
    classes = [np.unique(groups[clip_classes == one]) for one in np.unique(clip_classes)]
    for own in sorted(classes, key=len):
        if len(own) < 2:
            continue
        for group in sorted(own.tolist(), key=lambda one: -int((groups == one).sum())):
            if group not in of_group:
                taken = [sum(of_group.get(other) == number for other in own.tolist()) for number in range(max_folds)]
                of_group[group] = min(range(max_folds), key=lambda number: (taken[number], counts[number], number))
                counts[of_group[group]] += int((groups == group).sum())
    for group, number in of_group.items():
        fold[groups == group] = number
    # If all groups of a class were in one fold, the class would be tested without having been learnt.
    for one in np.unique(clip_classes):
        own = clip_classes == one
        if len(np.unique(fold[own])) < 2:
            fold[own] = -1
    used = np.unique(fold[fold >= 0])
    return np.where(fold >= 0, np.searchsorted(used, fold), -1)


LOUD = 0.01
"""Minimum loudness of a window that is used, relative to the power of the recording's loudest frame."""
# Maximum number of training windows of one piece, evenly spaced: more windows of one sound add little.
_OF_A_PIECE = 40
# Duration beyond which a clip is cut into pieces; duration of the pieces of an uninterrupted sound; seconds.
_LONG, _PIECE = 4.0, 2.0
# Maximum number of pieces of one clip; maximum number of groups of pieces that are held out in turn, if a class has
# clips of one group only.
_PIECES, _PARTS = 60, 6


@dataclass(frozen=True)
class Windows:
    """Windows of a training set.

    `images`: the windows; `clip` (W,): index of the clip, or piece of a longer clip, of each window; `right` (W,): its
    class, an index of `names`; `right_of_clip` and `group_of_clip`: class and group of each clip; `notes`: remarks on
    the clips.
    """

    images: SoundImages
    clip: np.ndarray
    right: np.ndarray
    names: tuple[str, ...]
    right_of_clip: np.ndarray
    group_of_clip: np.ndarray
    notes: tuple[str, ...] = ()

    @classmethod
    def from_clips(cls, clips: LabelledClips, report: Callable[[str], None]) -> "Windows":
        """Select the loud windows of each clip. Raises `ValueError` for clips without finite samples."""
        names, right = np.unique(clips.labels, return_inverse=True)
        group = np.unique(clips.groups, return_inverse=True)[1]
        alone = {one for one in range(len(names)) if len(np.unique(group[right == one])) < 2}
        parts, of_piece, group_of_piece, cut = [], [], [], set()
        for number in range(len(clips)):
            images = sound_images(clips.clip(number), clips.highest)
            loud = np.flatnonzero(images.known & (images.loudness >= LOUD * images.loudness.max()))
            if not len(loud):
                raise ValueError(f"recordings[{number}], {clips.recordings[number].name}: it holds no numbers.")
            only = right[number] in alone
            long = images.times[-1] - images.times[0] > _LONG
            pieces = _split_pieces(images.times[loud]) if long or only else [np.arange(len(loud))]
            for place, piece in enumerate(pieces):
                some = piece[np.linspace(0, len(piece) - 1, min(len(piece), _OF_A_PIECE)).round().astype(int)]
                parts.append(images[loud[some]])
                of_piece.append(number)
                group_of_piece.append((group[number], place * _PARTS // max(len(pieces), _PARTS) if only else 0))
            if only and len(pieces) > 1:
                cut.add(str(names[right[number]]))
            report(f"{counted(number + 1, 'clip')} of {len(clips)}")
        clip = np.repeat(np.arange(len(parts)), [len(one) for one in parts])
        right_of_clip = right[of_piece]
        notes = ()
        if cut:
            notes = (
                f"{', '.join(sorted(cut))}: one recording only, cut into the sounds in it, which are held out in turn; "
                "accuracy on another recording is not known, and likely lower.",
            )
        named = tuple(map(str, names))
        own_group = np.unique(group_of_piece, axis=0, return_inverse=True)[1].ravel()
        return cls(SoundImages.joined(parts), clip, right_of_clip[clip], named, right_of_clip, own_group, notes)

    @property
    def levelled(self) -> "Windows":
        """The same windows, scaled to equal loudness."""
        return replace(self, images=self.images.levelled)

    @property
    def classes(self) -> int:
        """The number of classes, C."""
        return len(self.names)

    def training_set(self, rows: np.ndarray, key: Array, batches: int, checkpoint: Path | None, report) -> TrainingSet:
        """Create a training set from the selected windows, `rows` (W,)."""
        groups = self.group_of_clip[self.clip[rows]]
        return TrainingSet(self.images[rows], self.right[rows], groups, self.classes, key, batches, checkpoint, report)

    def predict_clips(self, odds: Float[np.ndarray, "W C"]) -> tuple[np.ndarray, np.ndarray]:
        """Predict the class of every held-out clip from the log-odds of its windows; also returns its true class."""
        out = np.isfinite(odds).all(axis=1)
        share = odds[out] - np.logaddexp.reduce(odds[out], axis=1, keepdims=True)
        clips, own = np.unique(self.clip[out], return_inverse=True)
        total = np.zeros((len(clips), self.classes))
        np.add.at(total, own, share)
        return total.argmax(axis=1), self.right_of_clip[clips]

    def errors(self, odds: Float[np.ndarray, "W C"]) -> tuple[float, float]:
        """Compute the error rate of held-out clips, and that of held-out windows."""
        out = np.isfinite(odds).all(axis=1)
        if not out.any():
            return 0.0, 0.0
        said, right = self.predict_clips(odds)
        return float(np.mean(said != right)), float(np.mean(odds[out].argmax(axis=1) != self.right[out]))


def _split_pieces(times: Float[np.ndarray, " n"]) -> list[np.ndarray]:
    """Split the loud windows, at `times`, into pieces that share no samples.

    Windows belong to one sound if no gap between them exceeds the length of a window. A longer sound is cut every 2 s;
    windows that extend over a cut are left out.
    """
    pieces, every = [], _PIECE + LENGTH
    for sound in np.split(np.arange(len(times)), np.flatnonzero(np.diff(times) > LENGTH) + 1):
        since = times[sound] - times[sound[0]]
        if since[-1] <= every:
            pieces.append(sound)
            continue
        number, within = np.divmod(since, every)
        inside = sound[within <= _PIECE]
        pieces += np.split(inside, np.flatnonzero(np.diff(number[within <= _PIECE])) + 1)
    if len(pieces) > _PIECES:
        pieces = [pieces[place] for place in np.linspace(0, len(pieces) - 1, _PIECES).round().astype(int)]
    return pieces
