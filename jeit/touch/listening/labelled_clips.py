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
from jeit.touch.listening.feature_images import MIN_HIGHEST

# Maximum number of unreadable files that are described in a note.
_MAX_DESCRIBED_FILES = 4
# Relative difference of sampling rates below which they are considered equal.
_RATE_TOLERANCE = 1e-3


class _RecordingFiles(Sequence):
    """Recordings read from files on access, so that they need not all fit into memory at once."""

    def __init__(self, clip_paths: list[Path]):
        self.clip_paths = clip_paths

    def __len__(self) -> int:
        return len(self.clip_paths)

    def __getitem__(self, clip_index: Any) -> Any:
        return read_recording(self.clip_paths[clip_index])


@dataclass(frozen=True)
class LabelledClips:
    """Clips of sound, each with its class, created by `LabelledClips.from_recordings`.

    **Fields**

    - `recordings`: sequence of n clips, each a `jeit.acoustic.Recording`.
    - `labels` (n,): class of each clip.
    - `groups` (n,): name of each clip's group, such as the person or object that makes the sound; clips of a group are
      held out together.
    - `channels`: number of channels of all clips, 1 if they are mixed.
    - `highest`: frequency up to which all clips have sound, Hz.
    - `notes`: remarks on the clips.
    - `name`: name of the set of clips.

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
        channels are mixed to one channel. `notes` are stored together with remarks on mixed channels and on sampling
        rates that differ. Raises `ValueError` if the numbers of recordings, labels and groups differ, for recordings
        that are not recordings of samples, and for fewer than two classes.
        """
        check_kind("recordings", recordings, Sequence, "a list of Recording, as of read_recording(path)")
        class_names = np.asarray(labels)
        group_names = np.arange(len(recordings)).astype(str) if groups is None else np.asarray(groups).astype(str)
        if not (class_names.shape == group_names.shape == (len(recordings),)) or (
            class_names.size and class_names.dtype.kind not in "UT"
        ):
            raise ValueError(f"labels and groups must be one name for each of the {len(recordings)} recordings.")
        classes = np.unique(class_names)
        if len(classes) < 2:
            raise ValueError(
                f"labels: there {'is one class only, ' + repr(str(classes[0])) if len(classes) else 'are no clips'}; "
                "give clips of two classes or more."
            )
        clip_channel_counts, clip_rates = [], []
        for clip_index in range(len(recordings)):
            recording = recordings[clip_index]
            check_kind(
                f"recordings[{clip_index}]", recording, Recording, "a Recording of samples, as of read_recording(path)"
            )
            clip_channel_counts.append(len(recording.samples))
            clip_rates.append(recording.rate)
        all_notes, channel_counts = list(notes), sorted(set(clip_channel_counts))
        if len(channel_counts) > 1:
            all_notes.append(f"clips have {' or '.join(map(str, channel_counts))} channels: all were mixed to one.")
        lowest_rate, highest_rate = min(clip_rates), max(clip_rates)
        if highest_rate > lowest_rate * (1 + _RATE_TOLERANCE):
            num_lower_rates = sum(clip_rate < highest_rate * (1 - _RATE_TOLERANCE) for clip_rate in clip_rates)
            all_notes.append(
                f"{num_lower_rates} of {counted(len(clip_rates), 'clip')} have fewer than {highest_rate:g} samples a "
                f"second, the fewest '{recordings[int(np.argmin(clip_rates))].name}': nothing above "
                f"{lowest_rate / 2:g} Hz is used, which all of them have."
            )
        num_channels = channel_counts[0] if len(channel_counts) == 1 else 1
        return cls(
            recordings, class_names.astype(str), group_names, num_channels, lowest_rate / 2, tuple(all_notes), name
        )

    @classmethod
    def of(cls, *arguments: Any, **keywords: Any) -> "LabelledClips":
        """Former name of `from_recordings`; the next version no longer has this name."""
        warning_text = "LabelledClips.of is now LabelledClips.from_recordings; the old name goes with the next version."
        warnings.warn(warning_text, DeprecationWarning, stacklevel=2)
        return cls.from_recordings(*arguments, **keywords)

    def clip(self, number: int) -> Recording:
        """Return the clip with index `number`; its channels are mixed to one if `channels` is 1."""
        return self.recordings[number] if self.channels > 1 else mix_channels(self.recordings[number])

    def __len__(self) -> int:
        """Number of clips."""
        return len(self.recordings)


def read_clips(folder: str | Path, *, progress: Callable[[str], None] | None = None) -> LabelledClips:
    """Read labelled clips of sound: every sub-folder of a folder is a class, and every file in it a clip of the class.

    Files are WAV, NPZ, or any format that `soundfile` reads if it is installed. The clips in a folder within the folder
    of a class, for example those of one person or day, form one group, to which the clips of other classes in folders
    of the same name also belong. A file directly in the folder of a class is a group of its own. Files that cannot be
    read are left out and listed in `notes`; hidden files are ignored.

    **Arguments:**

    - `folder`: the folder of classes.
    - `progress`: function that is called with a description of the progress.

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
    class_folders = sorted(
        folder_entry
        for folder_entry in folder.iterdir()
        if folder_entry.is_dir() and not folder_entry.name.startswith(".")
    )
    if len(class_folders) < 2:
        class_folder_text = f"only '{class_folders[0].name}'" if class_folders else "none"
        raise ValueError(
            f"'{folder}' must have a sub-folder of clips for each of two classes or more; it has {class_folder_text}."
        )
    outside_files = [
        folder_entry.name
        for folder_entry in folder.iterdir()
        if folder_entry.is_file() and not folder_entry.name.startswith(".")
    ]
    clip_paths, class_labels, group_names, unread_files = [], [], [], []
    for class_folder in class_folders:
        class_files = sorted(
            clip_path
            for clip_path in class_folder.rglob("*")
            if clip_path.is_file() and not _is_hidden(clip_path.relative_to(folder))
        )
        num_earlier_files = len(clip_paths)
        for clip_path in class_files:
            try:
                _check_clip(read_recording(clip_path), clip_path.name)
            except (ValueError, OSError) as error:
                unread_files.append((clip_path.suffix.lower() or "no suffix", str(error).rstrip(".")))
                continue
            group_parts = clip_path.relative_to(class_folder).parts[:-1]
            clip_paths.append(clip_path)
            class_labels.append(class_folder.name)
            group_names.append("/".join(group_parts) if group_parts else f"{class_folder.name}/{clip_path.name}")
            if progress is not None:
                progress(f"{counted(len(clip_paths), 'clip')}")
        if len(clip_paths) == num_earlier_files:
            failure_reason = unread_files[-1][1] if class_files else "it is empty"
            raise ValueError(f"'{class_folder}': there is no clip in it that can be read ({failure_reason}).")
    notes = [_describe_unread(unread_files)] if unread_files else []
    if outside_files:
        notes.append(
            f"{counted(len(outside_files), 'file')} of no class, beside their folders, left out "
            f"('{min(outside_files)}')."
        )
    return LabelledClips.from_recordings(
        _RecordingFiles(clip_paths), class_labels, group_names, notes=notes, name=folder.name or str(folder)
    )


def _describe_unread(unread_files: list[tuple[str, str]]) -> str:
    """Describe how many files could not be read, and for which reasons. One file of each format is described first."""
    num_previous: dict[str, int] = {}
    sort_keys = []
    for failure_index, (file_suffix, failure_reason) in enumerate(unread_files):
        num_previous[file_suffix] = num_previous.get(file_suffix, -1) + 1
        sort_keys.append((num_previous[file_suffix], failure_index, failure_reason))
    reasons = [failure_reason for *_, failure_reason in sorted(sort_keys)]
    number_of_omitted_text = (
        f"; and {len(reasons) - _MAX_DESCRIBED_FILES} more" if len(reasons) > _MAX_DESCRIBED_FILES else ""
    )
    return (
        f"{counted(len(reasons), 'file')} not read: {'; '.join(reasons[:_MAX_DESCRIBED_FILES])}{number_of_omitted_text}"
    )


def _check_clip(clip: Recording | Intensities, clip_name: str) -> None:
    """Raise `ValueError` for a clip that cannot be used for training: intensities, silence, or a low sampling rate."""
    if not isinstance(clip, Recording):
        raise ValueError(f"{clip_name}: it holds intensities, not samples.")
    finite_samples = clip.samples[np.isfinite(clip.samples)]
    if not finite_samples.size:
        raise ValueError(f"{clip_name}: none of its samples is a number.")
    if clip.rate < 2 * MIN_HIGHEST:
        raise ValueError(f"{clip_name}: {clip.rate:g} samples a second are too few; give {2 * MIN_HIGHEST:g} or more.")
    if finite_samples.min() == finite_samples.max():
        raise ValueError(f"{clip_name}: it is silent, all of its samples are {finite_samples[0]:g}.")


def mix_channels(recording: Recording) -> Recording:
    """Mix all channels of a recording to one channel by averaging."""
    if len(recording.samples) == 1:
        return recording
    mean_samples = recording.samples.mean(axis=0, keepdims=True)
    return Recording(mean_samples, recording.rate, full_scale=recording.full_scale, name=recording.name)


def _is_hidden(path: Path) -> bool:
    return any(path_part.startswith(".") for path_part in path.parts)
