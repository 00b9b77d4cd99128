"""Labelled clips of sound, read from a folder with one sub-folder for each class."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jeit.acoustic import Intensities, Recording, read_recording
from jeit.arguments import check_kind, counted
from jeit.touch.listening.feature_images import LOWEST

# Maximum number of unread files that a note describes.
_NAMED = 4
# Relative difference of sampling rates below which they count as equal.
_SAME_RATE = 1e-3


class _Files(Sequence):
    """Recordings read from files on access, so that they need not all fit into memory at once."""

    def __init__(self, paths: list[Path]):
        self.paths = paths

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: Any) -> Any:
        return read_recording(self.paths[index])


@dataclass(frozen=True)
class LabelledClips:
    """n labelled clips of sound, created by `LabelledClips.from_recordings`.

    **Fields**

    - `recordings`: sequence of n `jeit.acoustic.Recording`.
    - `labels` (n,): their classes.
    - `groups` (n,): names of the groups, such as of people or things, in which clips are held out together.
    - `channels`: number of channels of all clips, 1 if they are mixed.
    - `highest`: frequency up to which all clips have sound, Hz.
    - `notes`: remarks on the clips.
    - `name`: their name.

    **Example:**

    ```python
    clips = LabelledClips.from_recordings(recordings, labels)
    listener = Listener.fit(clips, method="linear")
    ```
    """

    recordings: Sequence[Recording]
    labels: np.ndarray
    groups: np.ndarray
    channels: int
    highest: float
    notes: tuple[str, ...] = ()
    name: str = "clips"

    @classmethod
    def from_recordings(
        cls,
        recordings: Sequence[Recording],
        labels: ArrayLike,
        groups: ArrayLike | None = None,
        *,
        notes: Sequence[str] = (),
        name: str = "clips",
    ) -> "LabelledClips":
        """Create labelled clips from `recordings` and their classes `labels`.

        `groups`: the group of each clip; by default each clip is a group of its own. Clips with different numbers of
        channels are mixed to one channel. `notes` are stored together with those made here. Raises `ValueError` if
        there is not one label and group for each recording, for anything but recordings of samples, and for fewer than
        two classes.
        """
        check_kind("recordings", recordings, Sequence, "a list of Recording, as of read_recording(path)")
        named = np.asarray(labels)
        own = np.arange(len(recordings)).astype(str) if groups is None else np.asarray(groups).astype(str)
        if not (named.shape == own.shape == (len(recordings),)) or (named.size and named.dtype.kind not in "UT"):
            raise ValueError(f"labels and groups must be one name for each of the {len(recordings)} recordings.")
        classes = np.unique(named)
        if len(classes) < 2:
            raise ValueError(
                f"labels: there {'is one class only, ' + repr(str(classes[0])) if len(classes) else 'are no clips'}; "
                "give clips of two classes or more."
            )
        channels, rates = [], []
        for number in range(len(recordings)):
            one = recordings[number]
            check_kind(f"recordings[{number}]", one, Recording, "a Recording of samples, as of read_recording(path)")
            channels.append(len(one.samples))
            rates.append(one.rate)
        said, several = list(notes), sorted(set(channels))
        if len(several) > 1:
            said.append(f"clips have {' or '.join(map(str, several))} channels: all were mixed to one.")
        low, high = min(rates), max(rates)
        if high > low * (1 + _SAME_RATE):
            few = sum(rate < high * (1 - _SAME_RATE) for rate in rates)
            said.append(
                f"{few} of {counted(len(rates), 'clip')} have fewer than {high:g} samples a second, the fewest "
                f"'{recordings[int(np.argmin(rates))].name}': nothing above {low / 2:g} Hz is used, which all of them "
                "have."
            )
        width = several[0] if len(several) == 1 else 1
        return cls(recordings, named.astype(str), own, width, low / 2, tuple(said), name)

    @classmethod
    def of(cls, *arguments: Any, **keywords: Any) -> "LabelledClips":
        """Former name of `from_recordings`, which goes with the next version."""
        text = "LabelledClips.of is now LabelledClips.from_recordings; the old name goes with the next version."
        warnings.warn(text, DeprecationWarning, stacklevel=2)
        return cls.from_recordings(*arguments, **keywords)

    def clip(self, number: int) -> Recording:
        """Return the clip with this index, mixed to one channel if all clips are."""
        return self.recordings[number] if self.channels > 1 else mix_channels(self.recordings[number])

    def __len__(self) -> int:
        """Number of clips."""
        return len(self.recordings)


def read_clips(folder: str | Path, *, progress: Callable[[str], None] | None = None) -> LabelledClips:
    """Read labelled clips: every sub-folder of a folder is a class, and every file in it a clip of that class.

    Files are WAV, NPZ, or any format that `soundfile` reads if it is installed. Clips in a folder within the folder of
    a class, such as of one person or day, are one group, together with the clips of other classes in a folder of the
    same name; any other file is a group of its own. Files that cannot be read are left out and listed in `notes`;
    hidden files are ignored.

    **Arguments:**

    - `folder`: the folder.
    - `progress`: called with a description of the progress.

    Raises `ValueError` if there is no such folder, there are fewer than two classes, or no clip of a class can be read.

    **Example:**

    ```python
    for number, (recording, label) in enumerate(zip(recordings, labels, strict=True)):
        Path("clips", label).mkdir(parents=True, exist_ok=True)
        write_recording(f"clips/{label}/{number}.npz", recording)
    clips = read_clips("clips")
    ```
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"'{folder}' is no folder; give one with a sub-folder of clips for each class.")
    classes = sorted(one for one in folder.iterdir() if one.is_dir() and not one.name.startswith("."))
    if len(classes) < 2:
        held = f"only '{classes[0].name}'" if classes else "none"
        raise ValueError(f"'{folder}' must have a sub-folder of clips for each of two classes or more; it has {held}.")
    beside = [one.name for one in folder.iterdir() if one.is_file() and not one.name.startswith(".")]
    read, labels, groups, failed = [], [], [], []
    for one in classes:
        files = sorted(path for path in one.rglob("*") if path.is_file() and not _is_hidden(path.relative_to(folder)))
        before = len(read)
        for path in files:
            try:
                _check_clip(read_recording(path), path.name)
            except (ValueError, OSError) as error:
                failed.append((path.suffix.lower() or "no suffix", str(error).rstrip(".")))
                continue
            within = path.relative_to(one).parts[:-1]
            read.append(path)
            labels.append(one.name)
            groups.append("/".join(within) if within else f"{one.name}/{path.name}")
            if progress is not None:
                progress(f"{counted(len(read), 'clip')}")
        if len(read) == before:
            why = failed[-1][1] if files else "it is empty"
            raise ValueError(f"'{one}': there is no clip in it that can be read ({why}).")
    notes = [_describe_unread(failed)] if failed else []
    if beside:
        notes.append(f"{counted(len(beside), 'file')} of no class, beside their folders, left out ('{min(beside)}').")
    return LabelledClips.from_recordings(_Files(read), labels, groups, notes=notes, name=folder.name or str(folder))


def _describe_unread(failed: list[tuple[str, str]]) -> str:
    """Describe how many files were not read, and why; reasons for files of different formats come first."""
    seen: dict[str, int] = {}
    order = []
    for place, (kind, why) in enumerate(failed):
        seen[kind] = seen.get(kind, -1) + 1
        order.append((seen[kind], place, why))
    said = [why for *_, why in sorted(order)]
    more = f"; and {len(said) - _NAMED} more" if len(said) > _NAMED else ""
    return f"{counted(len(said), 'file')} not read: {'; '.join(said[:_NAMED])}{more}"


def _check_clip(clip: Recording | Intensities, name: str) -> None:
    """Raise `ValueError` for a clip that is of no use for training."""
    if not isinstance(clip, Recording):
        raise ValueError(f"{name}: it holds intensities, not samples.")
    known = clip.samples[np.isfinite(clip.samples)]
    if not known.size:
        raise ValueError(f"{name}: none of its samples is a number.")
    if clip.rate < 2 * LOWEST:
        raise ValueError(f"{name}: {clip.rate:g} samples a second are too few; give {2 * LOWEST:g} or more.")
    if known.min() == known.max():
        raise ValueError(f"{name}: it is silent, all of its samples are {known[0]:g}.")


def mix_channels(recording: Recording) -> Recording:
    """Mix all channels of a recording to one channel, their mean."""
    if len(recording.samples) == 1:
        return recording
    mean = recording.samples.mean(axis=0, keepdims=True)
    return Recording(mean, recording.rate, full_scale=recording.full_scale, name=recording.name)


def _is_hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)
