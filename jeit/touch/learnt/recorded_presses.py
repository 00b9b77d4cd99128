"""Recorded presses: frames with known places and forces, changes from the untouched skin, and the lag of frames behind
their presses."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jeit.arguments import measurable_values
from jeit.files import npz_arrays, require_arrays
from jeit.touch.learnt.features import Features

# Minimum number of frames of a session whose voltage changes are standardised separately.
_MIN_SESSION_FRAMES = 20


def changes_from_reference(frames: Float[np.ndarray, "n M"], reference: np.ndarray | None) -> Float[np.ndarray, "n M"]:
    """Subtract the reference frames of the untouched skin from frames; without a reference, return the frames."""
    return frames if reference is None else frames - reference


def standardise_sessions(changes: np.ndarray, group) -> np.ndarray:
    """Standardise voltage changes: subtract each channel's median over a session, and divide by its standard deviation.

    `group` (frames,): the session of each frame; None if all frames are of one session. Raises `ValueError` for
    sessions of fewer than 20 frames, and for a `group` that is not of shape (frames,).
    """
    group = np.zeros(len(changes), int) if group is None else np.asarray(group)
    if group.shape != (len(changes),):
        raise ValueError(f"group has shape {group.shape}; give ({len(changes)},), the session of each frame.")
    standardised = np.empty_like(changes)
    for session in np.unique(group):
        session_changes = changes[group == session]
        if len(session_changes) < _MIN_SESSION_FRAMES:
            raise ValueError(
                f"group: session {session} has {len(session_changes)} frames; {_MIN_SESSION_FRAMES} are needed to "
                "standardise one."
            )
        deviations = np.nanstd(session_changes, axis=0)
        standardised[group == session] = (session_changes - np.nanmedian(session_changes, axis=0)) / np.where(
            deviations > 0, deviations, np.inf
        )
    return standardised


def mean_reference(reference: np.ndarray) -> np.ndarray:
    """Compute the mean of each channel over reference frames; 0 for channels without any reading."""
    has_reading = np.isfinite(reference)
    return np.where(has_reading, reference, 0.0).sum(axis=0) / np.maximum(has_reading.sum(axis=0), 1)


def fill_reference(
    reference: np.ndarray | None, mean: np.ndarray | None, is_used: Bool[np.ndarray, " M"], num_frames: int
) -> Float[np.ndarray, "n m"]:
    """Return reference frames (frames, channels) of the used channels; zeros if there is no reference.

    Missing readings are replaced by the `mean` reference frame of the training set.
    """
    if reference is None or mean is None:
        return np.zeros((num_frames, int(is_used.sum())))
    return np.where(np.isnan(reference), mean, reference)[:, is_used]


# Maximum extent of the positions of presses. Positions with a larger extent are refused, as probably in millimetres.
_MAX_EXTENT = 5.0  # m
# Maximum force of a press. Larger forces are refused, as probably in grams or millinewtons.
_MAX_FORCE = 2000.0  # N
_MIN_PRESSES, _MIN_PRESSES_PER_CLASS = 10, 4
# Label of a frame of the untouched skin.
NO_TOUCH = "none"
_NO_TOUCH_SYNONYMS = ("none", "no touch", "no-touch", "no_touch", "notouch")
_OPTIONAL_FIELDS = ("positions", "force", "label", "touched", "group", "time")


@dataclass(frozen=True)
class Presses:
    """Recorded presses on a skin, created by `Presses.create`; quantities that were not recorded are None.

    **Fields**

    - `frames`: (presses, channels), readings in any unit; NaN where a reading is missing.
    - `reference`: (presses, channels), the frame of the untouched skin for each frame; None if `frames` are voltage
      changes.
    - `positions`: (presses, 2) or (presses, 3), metres, NaN where nothing touched; `force`: newtons; `label`: text,
      "none" where nothing touched; `touched`: (presses, keys), whether each key was pressed.
    - `group`: session or person of each press; cross-validation never splits a group. `time`: time of each press,
      seconds.
    - `name`: name of the recording in errors and reports; `notes`: corrections made to the recording, as text.

    **Example:**

    ```python
    presses = Presses.create(map_frames, positions=map_positions, reference=reference)
    learnt = LearntSkin.fit(presses, method="neighbours")
    ```
    """

    frames: Float[np.ndarray, "N M"]
    reference: Float[np.ndarray, "N M"] | None = None
    positions: Float[np.ndarray, "N d"] | None = None
    force: Float[np.ndarray, " N"] | None = None
    label: np.ndarray | None = None
    touched: Bool[np.ndarray, "N K"] | None = None
    group: np.ndarray | None = None
    time: Float[np.ndarray, " N"] | None = None
    name: str = "presses"
    notes: tuple[str, ...] = ()

    @classmethod
    def create(
        cls,
        frames: ArrayLike,
        *,
        reference: ArrayLike | None = None,
        positions: ArrayLike | None = None,
        force: ArrayLike | None = None,
        label: ArrayLike | None = None,
        touched: ArrayLike | None = None,
        group: ArrayLike | None = None,
        time: ArrayLike | None = None,
        name: str = "presses",
    ) -> "Presses":
        """Create presses from recorded arrays, and validate the arrays.

        Shapes and units are those of the fields of `Presses`; `reference` may also be one frame for all presses. Raises
        `ValueError` for inconsistent shapes, fewer than ten presses, positions that seem to be in millimetres, presses
        without any quantity to learn, and invalid values.
        """
        frames = check_frames("frames", frames)
        if len(frames) < _MIN_PRESSES:
            raise ValueError(
                f"frames: {len(frames)} presses are too few to learn from and to validate on; give {_MIN_PRESSES} or "
                "more."
            )
        optional_arrays = {
            "positions": None if positions is None else _check_positions(positions),
            "force": None if force is None else _check_force(force),
            "label": None if label is None else _check_label(label),
            "touched": None if touched is None else _check_touched(touched),
            "group": None if group is None else _one_dimensional("group", group),
            "time": None if time is None else _check_time(time),
        }
        for field_name, values in optional_arrays.items():
            if values is not None and len(values) != len(frames):
                raise ValueError(
                    f"{field_name} has {len(values)} rows and frames {len(frames)}; give one for each press."
                )
        if all(optional_arrays[field_name] is None for field_name in ("positions", "force", "label", "touched")):
            raise ValueError("frames: there is nothing to learn from them; give positions, force, label or touched.")
        reference = None if reference is None else check_reference(reference, frames)
        return replace(cls(frames, reference, name=name), **optional_arrays)

    def rows(self, index: ArrayLike | slice) -> "Presses":
        """Select presses by index or by slice."""
        arrays = {field_name: getattr(self, field_name) for field_name in ("frames", "reference", *_OPTIONAL_FIELDS)}
        return replace(
            self, **{field_name: None if values is None else values[index] for field_name, values in arrays.items()}
        )


def read_presses(path: str | Path) -> Presses:
    """Read recorded presses from an NPZ file with arrays named as the fields of `Presses`; only `frames` is required.

    **Arguments:**

    - `path`: path of the file.

    Raises `FileNotFoundError` if `path` does not exist, and `ValueError` if the file is no NPZ file of valid presses.

    **Example:**

    ```python
    np.savez("presses.npz", frames=map_frames, positions=map_positions, reference=reference)
    learnt = LearntSkin.fit(read_presses("presses.npz"), method="neighbours")
    ```
    """
    with _with_file_name(path):
        return Presses.create(**_read_arrays(path, "frames", "reference", *_OPTIONAL_FIELDS), name=Path(path).name)


def read_frames(path: str | Path) -> dict[str, np.ndarray]:
    """Read the arguments of `LearntSkin.predict` from an NPZ file: `frames`, and optionally `reference` and `group`.

    **Arguments:**

    - `path`: path of the file.

    Raises `FileNotFoundError` if `path` does not exist, and `ValueError` if the file is no NPZ file with `frames`.

    **Example:**

    ```python
    np.savez("frames.npz", frames=map_frames, reference=reference)
    found = learnt.predict(**read_frames("frames.npz"))
    ```
    """
    with _with_file_name(path):
        arrays = _read_arrays(path, "frames", "reference", "group")
        return arrays | {"frames": check_frames("frames", arrays["frames"])}


def _read_arrays(path: str | Path, *array_names: str) -> dict[str, np.ndarray]:
    """Read the arrays named `array_names` from an NPZ file: `frames`, which is required, and the others if present."""
    if Path(path).is_dir():
        raise ValueError("it is a folder; give an NPZ file.")
    if not Path(path).is_file():
        raise FileNotFoundError(f"'{path}': there is no such file.")
    arrays = npz_arrays(Path(path), *array_names)
    require_arrays(arrays, "frames")
    return {array_name: array for array_name, array in arrays.items() if array_name}


@contextmanager
def _with_file_name(path: str | Path) -> Iterator[None]:
    """Return a context manager that adds the name of the file to any `ValueError` raised within it."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"'{path}': {error}") from None


def check_frames(name: str, values) -> Float[np.ndarray, "N M"]:
    """Convert frames (frames, channels) to floats; readings that are infinite or impossibly large become NaN.

    Raises `ValueError` if `values` are not a two-dimensional array of real numbers.
    """
    try:
        frames = np.asarray(values)
    except ValueError:
        raise ValueError(f"{name}: rows differ in length; give one array (frames, channels).") from None
    if frames.dtype.kind not in "fiu" or frames.ndim != 2 or not frames.shape[1]:
        raise ValueError(
            f"{name} is {frames.dtype} of shape {frames.shape}; give real numbers, (frames, channels), one row for "
            "each frame."
        )
    return measurable_values(frames.astype(float))


def check_reference(values, frames) -> Float[np.ndarray, "N M"]:
    """Return the reference with one row (channels,) for each of the `frames`; infinite readings become NaN.

    Raises `ValueError` if the reference is not one frame, or one for each frame, of real numbers.
    """
    reference = np.asarray(values)
    if reference.dtype.kind not in "fiu" or reference.shape not in (frames.shape, frames.shape[1:]):
        raise ValueError(
            f"reference is {reference.dtype} of shape {reference.shape}; give ({frames.shape[1]},) for all frames, or "
            f"{frames.shape}, one for each."
        )
    reference = np.broadcast_to(reference.astype(float), frames.shape)
    return np.where(np.isfinite(reference), reference, np.nan)


def _check_positions(values) -> np.ndarray:
    positions = np.asarray(values)
    if positions.dtype.kind not in "fiu" or positions.ndim != 2 or positions.shape[1] not in (2, 3):
        raise ValueError(
            f"positions is {positions.dtype} of shape {positions.shape}; give numbers, (presses, 2) or (presses, 3), "
            "in metres."
        )
    positions = positions.astype(float)
    is_invalid = np.isinf(positions).any(axis=1) | (np.isnan(positions).any(axis=1) & ~np.isnan(positions).all(axis=1))
    if is_invalid.any():
        row = int(np.flatnonzero(is_invalid)[0])
        raise ValueError(
            f"positions: row {row} is {positions[row].tolist()}; give numbers, or NaN throughout where nothing touched."
        )
    known_positions = positions[~np.isnan(positions).any(axis=1)]
    if len(known_positions) < _MIN_PRESSES:
        raise ValueError(
            f"positions: {len(known_positions)} presses have one; give {_MIN_PRESSES} or more, or leave positions out."
        )
    largest_range = np.ptp(known_positions, axis=0).max()
    if largest_range > _MAX_EXTENT:
        raise ValueError(
            f"positions spread over {largest_range:.4g}: are these metres? Divide millimetres by 1000; no side may be "
            f"longer than {_MAX_EXTENT:g} m."
        )
    if largest_range == 0:
        raise ValueError("positions are all the same: there is nothing to learn.")
    return positions


def _check_force(values) -> np.ndarray:
    force = _one_dimensional("force", values)
    if force.dtype.kind not in "fiu" or not np.isfinite(force).all():
        raise ValueError("force must be finite numbers, in newtons; 0 where nothing touched.")
    if np.abs(force).max() > _MAX_FORCE:
        raise ValueError(f"force is up to {np.abs(force).max():.4g}: are these newtons? 100 g weigh 0.981 N.")
    if np.ptp(force) == 0:
        raise ValueError("force is the same in all presses: there is nothing to learn.")
    return force.astype(float)


def _check_label(values) -> np.ndarray:
    label = np.asarray(values)
    if label.dtype.kind == "O":
        type_names = sorted({type(element).__name__ for element in label.ravel()})
        if type_names != ["str"]:
            raise ValueError(f"label mixes {' and '.join(type_names)}; give text throughout.")
        label = label.astype(str)
    label = _one_dimensional("label", label)
    if label.dtype.kind not in "Uiub":
        raise ValueError(f"label is {label.dtype}; give text, or whole numbers.")
    label = label.astype(str)
    if any(not text.strip() for text in label):
        raise ValueError("label: some are empty; give every press one, and 'none' where nothing touched.")
    label = np.array([NO_TOUCH if text.strip().lower() in _NO_TOUCH_SYNONYMS else text.strip() for text in label])
    classes, class_counts = np.unique(label, return_counts=True)
    if len(classes) < 2:
        raise ValueError(f"label: all presses are '{classes[0]}'; give two kinds or more, or leave label out.")
    if class_counts.min() < _MIN_PRESSES_PER_CLASS:
        rarest_class = classes[class_counts.argmin()]
        raise ValueError(
            f"label: '{rarest_class}' has {class_counts.min()} of the presses; give {_MIN_PRESSES_PER_CLASS} or "
            "more of each kind, better twenty."
        )
    return label


def _check_touched(values) -> np.ndarray:
    touched = np.asarray(values)
    if touched.ndim != 2 or touched.dtype.kind not in "biuf" or not np.isin(touched, (0, 1)).all():
        raise ValueError(
            f"touched is {touched.dtype} of shape {touched.shape}; give (presses, keys), true where a key was pressed."
        )
    touched = touched.astype(bool)
    constant_keys = np.flatnonzero(touched.all(axis=0) | ~touched.any(axis=0))
    if constant_keys.size:
        raise ValueError(f"touched: key {constant_keys[0]} is the same in all presses; leave its column out.")
    num_rarer = np.minimum(touched.sum(axis=0), (~touched).sum(axis=0))
    if num_rarer.min() < _MIN_PRESSES_PER_CLASS:
        raise ValueError(
            f"touched: key {num_rarer.argmin()} differs in {num_rarer.min()} of the presses only; "
            f"give {_MIN_PRESSES_PER_CLASS} or more with it and without, better twenty."
        )
    return touched


def _check_time(values) -> np.ndarray:
    time = _one_dimensional("time", values)
    if time.dtype.kind not in "fiu" or not np.isfinite(time).all():
        raise ValueError("time must be finite numbers, in seconds.")
    return time.astype(float)


def _one_dimensional(name: str, values: ArrayLike) -> np.ndarray:
    flat_values = np.asarray(values)
    if flat_values.ndim == 2 and 1 in flat_values.shape:
        flat_values = flat_values.ravel()
    if flat_values.ndim != 1 or flat_values.dtype.kind == "O":
        raise ValueError(
            f"{name} is {flat_values.dtype} of shape {flat_values.shape}; give one plain value for each press."
        )
    return flat_values


# Maximum lag of frames, in rows.
_MAX_LAG = 2
# Number of similar frames whose places are averaged.
_NUM_NEIGHBOURS = 8
# Number of principal components by which frames are compared.
_NUM_COMPONENTS = 12
# A lag is clear under three conditions: the mean error of places estimated with the lag is below this fraction of the
# error of guessing the mean place; the mean error without lag is above this fraction; and with any other lag, the mean
# error is larger by more than this number of standard errors.
_MAX_GUESS_ERROR_RATIO, _MIN_STANDARD_ERRORS = 0.95, 4.0


def estimate_lag(changes: np.ndarray, positions: np.ndarray, folds: np.ndarray) -> tuple[int, float, float]:
    """Estimate by how many rows of a recording frames lag behind their presses; 0 without clear evidence of a lag.

    Also returns the mean errors, metres, of places estimated from the most similar frames, without and with the lag.
    """
    features = Features.learn("normalised", changes, np.zeros_like(changes))
    scores = features(changes, np.zeros_like(changes))[:, :_NUM_COMPONENTS]
    lag_errors = {lag: _place_errors(scores, positions, folds, lag) for lag in range(-_MAX_LAG, _MAX_LAG + 1)}
    error_of_mean_position = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).mean())
    mean_errors = {lag: float(place_errors.mean()) for lag, place_errors in lag_errors.items()}
    best_lag, second_best_lag = sorted(mean_errors, key=lambda lag: mean_errors[lag])[:2]
    min_difference = _MIN_STANDARD_ERRORS * float(lag_errors[best_lag].std()) / np.sqrt(len(positions))
    is_clear_lag = (
        mean_errors[0] > _MAX_GUESS_ERROR_RATIO * error_of_mean_position > mean_errors[best_lag]
        and mean_errors[second_best_lag] - mean_errors[best_lag] > min_difference
    )
    best_lag = best_lag if is_clear_lag else 0
    return best_lag, mean_errors[0], mean_errors[best_lag]


def aligned_slices(num_rows: int, lag: int) -> tuple[slice, slice]:
    """Return slices of the frames and of the corresponding presses of a recording in which frames lag by `lag` rows."""
    return slice(max(lag, 0), num_rows + min(lag, 0)), slice(max(-lag, 0), num_rows - max(lag, 0))


def _place_errors(scores: np.ndarray, positions: np.ndarray, folds: np.ndarray, lag: int) -> np.ndarray:
    """Compute the errors, metres, of places estimated as the mean place of the frames with the most similar `scores` in
    other folds."""
    frame_rows, press_rows = aligned_slices(len(scores), lag)
    scores, positions, folds = scores[frame_rows], positions[press_rows], folds[press_rows]
    place_errors = np.empty(len(scores))
    for fold_index in np.unique(folds):
        is_held_out = folds == fold_index
        training_positions = positions[~is_held_out]
        neighbours = (
            KDTree(scores[~is_held_out])
            .query(scores[is_held_out], min(_NUM_NEIGHBOURS, len(training_positions)))[1]
            .reshape(is_held_out.sum(), -1)
        )
        place_errors[is_held_out] = np.linalg.norm(
            training_positions[neighbours].mean(axis=1) - positions[is_held_out], axis=1
        )
    return place_errors


@dataclass(frozen=True)
class Touches:
    """Predicted touches of frames; quantities that were not learnt are None.

    **Fields**

    - `position` (frames, 2) or (frames, 3), metres, with standard deviations `position_std`; `force`, newtons, with
      `force_std`; `label`, text, with its `probability`; `touched` (frames, keys), whether each key is pressed, with
      `key_probability`. In frames unlike the training set, these numbers are NaN, labels "" and keys false. In frames
      of the untouched skin, positions are NaN, forces 0, labels "none" and keys false.
    - `unlike`: whether a frame is unlike the training set; `novelty`: distance of a frame from the training set, about
      1 for the farthest training frames.
    - `alive` (frames, channels): whether the channel is alive, so that its reading was used.
    - `notes`: corrections made to the frames, as text.

    **Example:**

    ```python
    found = learnt.predict(presses.frames[:3], reference)
    print(isinstance(found, Touches), found.position, found.position_std)
    ```
    """

    position: Float[np.ndarray, "n d"] | None
    position_std: Float[np.ndarray, "n d"] | None
    force: Float[np.ndarray, " n"] | None
    force_std: Float[np.ndarray, " n"] | None
    label: np.ndarray | None
    probability: Float[np.ndarray, " n"] | None
    touched: Bool[np.ndarray, "n K"] | None
    key_probability: Float[np.ndarray, "n K"] | None
    unlike: Bool[np.ndarray, " n"]
    novelty: Float[np.ndarray, " n"]
    alive: Bool[np.ndarray, "n M"]
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.unlike)
