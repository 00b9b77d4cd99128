"""Windows of labelled clips, with which clip and class each is of, and what is told of whole clips."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Array, Float

from jeit.arguments import counted
from jeit.touch.listening.feature_images import SoundImages, sound_images
from jeit.touch.listening.labelled_clips import LabelledClips
from jeit.touch.listening.learners import Lesson

LOUD = 0.01
"""A recording sounds like those of its windows whose loudest frame has this share of its loudest one's power."""
# Windows of one clip that are learnt from, at most, spread evenly: more of one recording teach little.
_OF_A_CLIP = 40


@dataclass(frozen=True)
class Windows:
    """Windows that are learnt from: `images`, of which `clip` (W,) each, and `right` (W,), numbers of the `names`; of
    each clip the class, `right_of_clip`, and the group, `group_of_clip`."""

    images: SoundImages
    clip: np.ndarray
    right: np.ndarray
    names: tuple[str, ...]
    right_of_clip: np.ndarray
    group_of_clip: np.ndarray

    @classmethod
    def of(cls, clips: LabelledClips, tell: Callable[[str], None]) -> "Windows":
        """Of clips: those near the loudest of each. Raises `ValueError` for clips without numbers."""
        names, right = np.unique(clips.labels, return_inverse=True)
        group = np.unique(clips.groups, return_inverse=True)[1]
        parts = []
        for number in range(len(clips)):
            images = sound_images(clips.clip(number), clips.highest)
            loud = np.flatnonzero(images.known & (images.loudness >= LOUD * images.loudness.max()))
            some = np.linspace(0, len(loud) - 1, min(len(loud), _OF_A_CLIP)).round().astype(int)
            parts.append(images[loud[some]])
            tell(f"{counted(number + 1, 'clip')} of {len(clips)}")
        if not all(map(len, parts)):
            empty = next(number for number, one in enumerate(parts) if not len(one))
            raise ValueError(f"recordings[{empty}], {clips.recordings[empty].name}: it holds no numbers.")
        clip = np.repeat(np.arange(len(parts)), [len(one) for one in parts])
        return cls(SoundImages.joined(parts), clip, right[clip], tuple(map(str, names)), right, group)

    @property
    def classes(self) -> int:
        """C."""
        return len(self.names)

    def lesson(self, rows: np.ndarray, key: Array, batches: int, checkpoint: Path | None, tell) -> Lesson:
        """What some windows (W,) teach."""
        groups = self.group_of_clip[self.clip[rows]]
        return Lesson(self.images[rows], self.right[rows], groups, self.classes, key, batches, checkpoint, tell)

    def told(self, odds: Float[np.ndarray, "W C"]) -> tuple[np.ndarray, np.ndarray]:
        """What is said of every clip that was held out, as a whole, and its class."""
        out = np.isfinite(odds).all(axis=1)
        share = odds[out] - np.logaddexp.reduce(odds[out], axis=1, keepdims=True)
        clips, own = np.unique(self.clip[out], return_inverse=True)
        total = np.zeros((len(clips), self.classes))
        np.add.at(total, own, share)
        return total.argmax(axis=1), self.right_of_clip[clips]

    def errors(self, odds: Float[np.ndarray, "W C"]) -> tuple[float, float]:
        """Shares of clips, and of windows, that were held out and named wrong."""
        out = np.isfinite(odds).all(axis=1)
        if not out.any():
            return 0.0, 0.0
        said, right = self.told(odds)
        return float(np.mean(said != right)), float(np.mean(odds[out].argmax(axis=1) != self.right[out]))
