"""Conversion of the content of an instrument's file to a measurement, with a description of the body if there is one.

The systems of Göttingen, Dräger and Carefusion measure the same frame of 208 voltages with 16 electrodes (adjacent
protocol). Drive 1-2 is measured at 3-4, 4-5, … 15-16; drive 2-3 at 4-5, … 16-1; and so on. The voltages are positive on
every body; their sign is opposite to that of `jeit.protocol.adjacent`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Inexact

from jeit.data.description import Description, load_description, parse_description
from jeit.data.formats.table import arrange_frames, component_notes, find_description, scale_to_volts
from jeit.data.measurement import Measurement
from jeit.files import check_memory
from jeit.protocol import Protocol, adjacent

# Maximum bytes of memory per byte of the file: two copies of the numbers, each number twice as long as in the file.
_MEMORY_PER_FILE_BYTE = 4


@dataclass(frozen=True)
class Recording:
    """Content of an instrument's file.

    - `voltages`: (F, M), real or complex, of F frames and M channels; `protocol`: protocol of the channels; `usable`:
      (M,) mask, None if all channels are usable.
    - `times`: (F,) seconds, or None; `frame_names`: one name per frame, or empty; `notes`: properties that the format
      does not define.
    """

    voltages: Inexact[np.ndarray, "F M"]
    protocol: Protocol
    usable: Bool[np.ndarray, " M"] | None = None
    times: Float[np.ndarray, " F"] | None = None
    frame_names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def read_file_bytes(path: Path) -> bytes:
    """Content of a file. Raises `FileTooLargeError` if the file exceeds the memory limit."""
    check_memory(path.name, _MEMORY_PER_FILE_BYTE * path.stat().st_size)
    return path.read_bytes()


def find_or_load_description(path: Path, description: str | Path | None) -> Description:
    """Return the specified description, else the description beside the file, else an empty description. Raises
    `ValueError` if the description is not valid."""
    description_source = find_description(path) if description is None else description
    return parse_description({}, path.name) if description_source is None else load_description(description_source)


def create_measurement(path: Path, recording: Recording, sensor_description: Description) -> Measurement:
    """Convert a recording to a measurement of the described body. Protocol, times and frame names of the description
    take precedence over the protocol, times and frame names of the recording.

    Raises `ValueError` if the protocol has a different number of channels, or if the number of names is not the number
    of frames.
    """
    described_layout = sensor_description.layout
    recording_notes = (*recording.notes, *component_notes(recording.voltages, described_layout))
    described_layout = replace(described_layout, frames_in="rows", complex_pairs=False)
    if recording.frame_names and not described_layout.frame_names:
        described_layout = replace(described_layout, frame_names=recording.frame_names)
    sensor_description = replace(
        sensor_description, layout=described_layout, notes=(*sensor_description.notes, *recording_notes)
    )
    # Current patterns in the file have already been read as part of the recording.
    is_own_protocol_used = sensor_description.protocol_section is None or sensor_description.patterns_measured
    frames = arrange_frames(recording.voltages, described_layout, path.name)
    usable_mask = None if recording.usable is None or not is_own_protocol_used else recording.usable
    measurement = scale_to_volts(
        path, sensor_description, frames, recording.protocol if is_own_protocol_used else None, usable_mask
    )
    if recording.times is None or described_layout.averaged or described_layout.frame_rate is not None:
        return measurement
    if (np.diff(recording.times) <= 0).any():
        time_note = "the times in the file do not rise, and are left out."
        return replace(measurement, notes=(*measurement.notes, time_note))
    return replace(measurement, times=recording.times)


def count_frames(data: bytes, frames_start: int, frame_size: int, path: Path) -> tuple[int, int]:
    """Number of complete frames of `frame_size` bytes after byte `frames_start`, and number of remaining bytes.

    Raises `ValueError` if there is no complete frame.
    """
    if not 0 <= frames_start <= len(data):
        raise ValueError(f"{path.name}: its header says that frames begin at byte {frames_start}, beyond its end.")
    num_frames, num_leftover_bytes = divmod(len(data) - frames_start, frame_size)
    if not num_frames:
        raise ValueError(f"{path.name} holds no whole frame; is it cut off?")
    return num_frames, num_leftover_bytes


def truncation_notes(num_bytes: int) -> tuple[str, ...]:
    """A note about `num_bytes` bytes after the last complete frame; empty for none."""
    return (f"the last frame is cut off, and left out ({num_bytes} bytes).",) if num_bytes else ()


CHANNELS = 208
# Drive current in amperes: the maximum current that is stated for the systems of Göttingen, Dräger and Carefusion.
_ASSUMED_CURRENT = 5e-3
_CURRENT_NOTE = "a current of 5 mA is assumed; the file does not say it."


def adjacent_recording(
    values: Float[np.ndarray, "F 208"], times: Float[np.ndarray, " F"] | None, notes: tuple[str, ...]
) -> Recording:
    """Recording of 208 positive voltages in the channel order of the systems of Göttingen, Dräger and Carefusion.
    Channels that are zero in every frame are marked as not measured."""
    usable_channels = (values != 0).any(axis=0)
    if not usable_channels.all() and usable_channels.any():
        notes = (
            *notes,
            f"{int((~usable_channels).sum())} of {CHANNELS} channels were not measured (zero in every frame).",
        )
    with np.errstate(invalid="ignore"):  # a signalling NaN of single precision would warn
        voltages = -values.astype(float)
    return Recording(
        voltages, adjacent(16, current=_ASSUMED_CURRENT), usable_channels, times, notes=(*notes, _CURRENT_NOTE)
    )
