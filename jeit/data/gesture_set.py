"""Recordings of gestures, one after the other, and as a file: simulated ones, and those of one's own skin."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jeit.files import need, npz_arrays, written_whole

_ARRAYS = ("gesture", "person", "start", "seconds", "voltages", "reference", "untouched")


@dataclass(frozen=True)
class GestureSet:
    """n recordings of one gesture each, one after the other: frames F in all, M channels.

    **Fields**: `gesture` (n,), names, and `person` (n,), a name or number for each; `start` (n + 1,), where each
    recording's frames begin, and the last one's end; `seconds` (F,), of each recording from 0; `voltages` (F, M),
    volts, NaN where there is no reading; `reference` (M,), volts, the mean of frames of the untouched skin before;
    `untouched` (u, M), frames of the untouched skin, over as long as recordings last.
    """

    gesture: np.ndarray
    person: np.ndarray
    start: Int[np.ndarray, " s"]
    seconds: Float[np.ndarray, " F"]
    voltages: Float[np.ndarray, "F M"]
    reference: Float[np.ndarray, " M"]
    untouched: Float[np.ndarray, "u M"]

    def __post_init__(self):
        """Raises `ValueError` for arrays that do not belong together, and what is no text, number or time."""
        for name, kinds, said in (
            ("gesture", "U", "text"),
            ("person", "iuU", "whole numbers or text"),
            ("start", "iu", "whole numbers"),
        ):
            own = getattr(self, name)
            if own.dtype.kind not in kinds:
                raise ValueError(f"{name} is {own.dtype}; give {said}.")
        for name in ("seconds", "voltages", "reference", "untouched"):
            if getattr(self, name).dtype.kind not in "fiu":
                raise ValueError(f"{name} is {getattr(self, name).dtype}; give real numbers.")
        if self.gesture.ndim != 1 or self.voltages.ndim != 2:
            raise ValueError("gesture must be (n,) and voltages (F, M), one row for each frame.")
        number, (frames, channels) = len(self.gesture), self.voltages.shape
        wanted = {"person": (number,), "start": (number + 1,), "seconds": (frames,), "reference": (channels,)}
        for name, shape in wanted.items():
            if getattr(self, name).shape != shape:
                raise ValueError(
                    f"{name} has shape {getattr(self, name).shape}; with {number} gestures and voltages ({frames}, "
                    f"{channels}) it is {shape}."
                )
        if self.untouched.shape[1:] != (channels,):
            raise ValueError(f"untouched has shape {self.untouched.shape}; give (u, {channels}), as the voltages have.")
        if (np.diff(self.start) < 0).any():
            raise ValueError("start falls: give where each recording begins among the frames, in their order.")
        if self.start[0] or self.start[-1] != frames:
            raise ValueError(
                f"start goes from {self.start[0]} to {self.start[-1]}; give 0 first, and last the number of frames, "
                f"{frames}."
            )
        if not np.isfinite(self.seconds).all():
            raise ValueError("seconds must be finite.")

    def __len__(self) -> int:
        """Number of recordings."""
        return len(self.gesture)

    def recording(self, number: int) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, "T M"]]:
        """Times (T,), seconds, and voltages (T, M) of one recording."""
        own = slice(self.start[number], self.start[number + 1])
        return self.seconds[own], self.voltages[own].astype(float)

    def changes(self, number: int) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, "T M"]]:
        """Times (T,), seconds, and changes (T, M) from the reference, volts, of one recording."""
        seconds, voltages = self.recording(number)
        return seconds, voltages - self.reference

    def write(self, path: str | Path) -> None:
        """Write it to an NPZ file. Raises `OSError` where it cannot be written."""
        with written_whole(path) as file:
            np.savez_compressed(file, **{name: getattr(self, name) for name in _ARRAYS})

    @classmethod
    def read(cls, path: str | Path) -> "GestureSet":
        """Undo `write`; without `person`, all are of one. Raises `OSError` where there is no file, `ValueError` for one
        of another kind; nothing in it is executed."""
        try:
            arrays = npz_arrays(Path(path), *_ARRAYS, otherwise="not a set of gestures")
            if "gesture" in arrays:
                arrays.setdefault("person", np.zeros(arrays["gesture"].shape, int))
            need(arrays, *_ARRAYS)
            return cls(**{name: arrays[name] for name in _ARRAYS})
        except ValueError as error:
            raise ValueError(f"'{path}': {error}") from None
