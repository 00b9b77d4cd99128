"""Current patterns that are stored in the data file, beside voltages indexed by electrode, pattern and frame.

Systems that drive all electrodes at once publish a matrix of the measured currents, with one column per pattern, and an
array of the potentials of all electrodes. A description declares this with `[protocol] kind = "measured"`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Inexact

from jeit.arguments import listed
from jeit.files import check_electrodes, check_memory, matlab, npz_arrays
from jeit.protocol import Protocol, from_matrices, measurement_patterns

if TYPE_CHECKING:
    from jeit.data.description_tables import MeasuredTable

AXES = ("electrodes", "patterns", "frames")
"""Names of the axes of an array of voltages, in their default order; a description can state another order."""
# Maximum mean of the potentials of a pattern that counts as removed, relative to the largest potential.
_MOST_MEAN = 0.01
_UNITS = {"A": 1.0, "mA": 1e-3, "uA": 1e-6, "µA": 1e-6}


def protocol_of_file(table: MeasuredTable, path: Path) -> Protocol:
    """The protocol whose currents, and measurement patterns if named, are stored in the .mat or .npz file at `path`.

    Raises `ValueError` if the file or a variable does not exist, and if the matrices are not a valid protocol.
    """
    keys = (table.drive_key,) if table.measurement_key is None else (table.drive_key, table.measurement_key)
    drive, *own = (_matrix(one, key, path) for one, key in zip(_read(path, keys), keys, strict=True))
    turned = table.patterns_in == "columns"
    drive, own = (drive.T, [one.T for one in own]) if turned else (drive, own)
    check_electrodes(path.name, drive.shape[1])
    rows = own[0] if own else measurement_patterns(drive.shape[1], table.measurement, table.reference)
    check_memory(f"{path.name}: the protocol", 64 * len(drive) * len(rows))
    # Currents measured by an instrument sum to zero only within its errors.
    drive = _balanced(drive, table.drive_key, path) * _UNITS[table.current_unit]
    read = table.measurement_key or table.measurement
    name = table.name or f"{len(drive)} measured currents, {read}, {drive.shape[1]} electrodes"
    return from_matrices(drive, rows, name=name)


def frames_of(values: np.ndarray, axes: tuple[str, ...], name: str) -> Inexact[np.ndarray, "F M"]:
    """Frames (F, M) of voltages with the given axes, channels ordered drive by drive; an array of two axes is one
    frame.

    Raises `ValueError` for another number of axes.
    """
    named = tuple(axes or AXES)
    if values.ndim == len(named) - 1:
        values = np.expand_dims(values, named.index("frames"))  # MATLAB drops a last axis of length one
    if values.ndim != len(named):
        raise ValueError(f"{name}: the voltages have shape {values.shape}; {', '.join(named)} are {len(named)} axes.")
    ordered = np.transpose(values, [named.index(one) for one in ("frames", "patterns", "electrodes")])
    return ordered.reshape(len(ordered), -1)


def less_their_mean(frames: Inexact[np.ndarray, "F M"], count: int) -> tuple[Inexact[np.ndarray, "F M"], float]:
    """Subtract from the potentials of `count` electrodes the mean of each pattern, if any mean exceeds noise: the
    potentials were then measured against ground or an electrode. Returns the frames and the largest mean, 0 if nothing
    is subtracted. Patterns with NaN are not changed."""
    potentials = frames.reshape(len(frames), -1, count)
    mean = potentials.mean(axis=2, keepdims=True)
    mean = np.where(np.isfinite(mean), mean, 0)
    rest = potentials - mean
    if not (np.abs(mean) > _MOST_MEAN * np.abs(rest).max(axis=2, keepdims=True)).any():
        return frames, 0.0
    return rest.reshape(frames.shape), float(np.abs(mean).max())


def _read(path: Path, keys: tuple[str, ...]) -> list[np.ndarray]:
    if not path.is_file() or path.suffix.lower() not in (".mat", ".npz"):
        raise ValueError(f"kind = 'measured' takes the currents from a .mat or .npz file; {path.name[:60]!r} is none.")
    if path.suffix.lower() == ".mat":
        content = matlab.load(path, *keys)
        return [matlab.numbers(content, key, path) for key in keys]
    arrays = npz_arrays(path, *keys)
    missing = [key for key in keys if key not in arrays]
    if missing:
        raise ValueError(f"{path.name}: there is no array '{missing[0][:60]}'; the file has {listed(arrays[''])}.")
    return [arrays[key] for key in keys]


def _matrix(values: np.ndarray, key: str, path: Path) -> np.ndarray:
    if values.ndim != 2 or values.dtype.kind not in "fiu" or not np.isfinite(values).all():
        raise ValueError(
            f"{path.name}: '{key[:60]}' must be a matrix of real numbers, without NaN, a column for every pattern; it "
            f"is {values.dtype} of shape {values.shape}."
        )
    return values.astype(float)


def _balanced(drive: np.ndarray, key: str, path: Path) -> np.ndarray:
    """Currents minus their mean; raises `ValueError` if the mean is not small."""
    excess, size = np.abs(drive.sum(axis=1)), np.abs(drive).max(axis=1)
    worst = int(np.argmax(excess - 0.05 * size))
    if excess[worst] > 0.05 * size[worst]:
        raise ValueError(
            f"{path.name}: pattern {worst} of '{key[:60]}' sums to {excess[worst]:.3g}, and its largest current is "
            f"{size[worst]:.3g}: current that goes in must come out. Is there a pattern in every column? Else say "
            "patterns_in = 'rows'."
        )
    return drive - drive.mean(axis=1, keepdims=True)
