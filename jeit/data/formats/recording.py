"""A measurement from an instrument's file and, where there is one, a description of the body.

The frame of 16 electrodes that the Göttingen, Dräger and Carefusion systems have: 208 adjacent voltages.

Drive 1-2 is read at 3-4, 4-5, … 15-16; drive 2-3 at 4-5, … 16-1; and so on. Voltages are read in the sense that makes
them positive on every body: the opposite of `jeit.protocol.adjacent`'s.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Inexact

from jeit.data.description import Description, load_description, parse_description
from jeit.data.formats.table import find_description, frames_from, measurement_from, part_of
from jeit.data.measurement import Measurement
from jeit.files import check_memory
from jeit.protocol import Protocol, adjacent

# Bytes in memory for one of the file, at most: numbers of half the length, twice.
_IN_MEMORY = 4


@dataclass(frozen=True)
class Recording:
    """Content of an instrument's file.

    - `voltages` (F, M), real or complex; `protocol` of M channels; `usable` (M,), None for all.
    - `times` (F,) seconds, or None; `frame_names`, empty or one a frame; `notes`: what the format leaves open.
    """

    voltages: Inexact[np.ndarray, "F M"]
    protocol: Protocol
    usable: Bool[np.ndarray, " M"] | None = None
    times: Float[np.ndarray, " F"] | None = None
    frame_names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def content_of(path: Path) -> bytes:
    """Content of a file whose size fits in memory. Raises `TooLarge`."""
    check_memory(path.name, _IN_MEMORY * path.stat().st_size)
    return path.read_bytes()


def description_of(path: Path, description: str | Path | None) -> Description:
    """The description given, or the one beside the file, or none. Raises `ValueError`."""
    which = find_description(path) if description is None else description
    return parse_description({}, path.name) if which is None else load_description(which)


def measurement_of(path: Path, recording: Recording, described: Description) -> Measurement:
    """A recording as a measurement of the body described; its protocol, times and names unless those are described.

    Raises `ValueError` where protocol and channels, or names and frames, do not fit.
    """
    layout = described.layout
    notes = (*recording.notes, *part_of(recording.voltages, layout))
    layout = replace(layout, frames_in="rows", complex_pairs=False)
    if recording.frame_names and not layout.frame_names:
        layout = replace(layout, frame_names=recording.frame_names)
    described = replace(described, layout=layout, notes=(*described.notes, *notes))
    # Currents that lie in the file are those that it is read with.
    own = described.protocol_section is None or described.patterns_measured
    frames = frames_from(recording.voltages, layout, path.name)
    mask = None if recording.usable is None or not own else recording.usable
    measurement = measurement_from(path, described, frames, recording.protocol if own else None, mask)
    if recording.times is None or layout.averaged or layout.frame_rate is not None:
        return measurement
    if (np.diff(recording.times) <= 0).any():
        note = "the times in the file do not rise, and are left out."
        return replace(measurement, notes=(*measurement.notes, note))
    return replace(measurement, times=recording.times)


def frame_at(content: bytes, start: int, size: int, path: Path) -> tuple[int, int]:
    """Number of whole frames of `size` bytes that follow `start`, and number of bytes left over.

    Raises `ValueError` where there is none.
    """
    if not 0 <= start <= len(content):
        raise ValueError(f"{path.name}: its header says that frames begin at byte {start}, beyond its end.")
    number, left = divmod(len(content) - start, size)
    if not number:
        raise ValueError(f"{path.name} holds no whole frame; is it cut off?")
    return number, left


def cut_off(left: int) -> tuple[str, ...]:
    """A note on bytes that are left over after the last frame."""
    return (f"the last frame is cut off, and left out ({left} bytes).",) if left else ()


CHANNELS = 208
# Amperes; what all of these systems are said to drive at most.
_CURRENT = 5e-3
_CURRENT_NOTE = "a current of 5 mA is assumed; the file does not say it."


def adjacent_recording(
    values: Float[np.ndarray, "F 208"], times: Float[np.ndarray, " F"] | None, notes: tuple[str, ...]
) -> Recording:
    """Recording of positive voltages in that order. Channels that are zero in every frame were not measured."""
    usable = (values != 0).any(axis=0)
    if not usable.all() and usable.any():
        notes = (*notes, f"{int((~usable).sum())} of {CHANNELS} channels were not measured (zero in every frame).")
    with np.errstate(invalid="ignore"):  # a NaN of four bytes may be a signal
        voltages = -values.astype(float)
    return Recording(voltages, adjacent(16, current=_CURRENT), usable, times, notes=(*notes, _CURRENT_NOTE))
