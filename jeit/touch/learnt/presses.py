"""Recorded presses: frames with known places and forces, changes from rest, and the lag between the two."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jeit.arguments import readings
from jeit.files import need, npz_arrays
from jeit.touch.learnt.features import Features

# The least number of frames of a session that can be standardised by itself.
_SESSION = 20


def changes_of(frames: Float[np.ndarray, "n M"], reference: np.ndarray | None) -> Float[np.ndarray, "n M"]:
    """Subtract the reference from frames, if there is one."""
    return frames if reference is None else frames - reference


def standardised(changes: np.ndarray, group) -> np.ndarray:
    """Standardise changes (n, M): subtract their session's median, and divide by their session's deviation.

    All are one session unless `group` (n,) is given. Raises `ValueError` for sessions of fewer than 20 frames.
    """
    group = np.zeros(len(changes), int) if group is None else np.asarray(group)
    if group.shape != (len(changes),):
        raise ValueError(f"group has shape {group.shape}; give ({len(changes)},), the session of each frame.")
    result = np.empty_like(changes)
    for session in np.unique(group):
        own = changes[group == session]
        if len(own) < _SESSION:
            raise ValueError(
                f"group: session {session} has {len(own)} frames; {_SESSION} are needed to standardise one."
            )
        deviation = np.nanstd(own, axis=0)
        result[group == session] = (own - np.nanmedian(own, axis=0)) / np.where(deviation > 0, deviation, np.inf)
    return result


def mean_reference(reference: np.ndarray) -> np.ndarray:
    """Mean reference of every channel; 0 where it has no reading at all."""
    there = np.isfinite(reference)
    return np.where(there, reference, 0.0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)


def reference_used(
    reference: np.ndarray | None, mean: np.ndarray | None, used: Bool[np.ndarray, " M"], number: int
) -> Float[np.ndarray, "n m"]:
    """Reference (n, M) of the channels `used`; zeros if there is none.

    Where it has no reading, the `mean` (M,) of the training set is used.
    """
    if reference is None or mean is None:
        return np.zeros((number, int(used.sum())))
    return np.where(np.isnan(reference), mean, reference)[:, used]


# No known skin is longer: its coordinates would be in millimetres.
_LONGEST = 5.0  # m
# No press is harder: forces would be in grams or millinewtons.
_HARDEST = 2000.0  # N
_FEWEST, _FEWEST_OF_A_KIND = 10, 4
# The label of a frame of an untouched skin.
NO_TOUCH = "none"
_NO_TOUCH = ("none", "no touch", "no-touch", "no_touch", "notouch")
_ROWS = ("positions", "force", "label", "touched", "group", "time")


@dataclass(frozen=True)
class Presses:
    """N presses on a skin of M channels; what is None was not recorded. Make them with `Presses.create`.

    **Fields**

    - `frames`: (N, M), in any unit; NaN where there is no reading.
    - `reference`: (N, M), the untouched skin's frame that goes with each, None if frames are changes already.
    - `positions`: (N, 2 or 3) metres, NaN where nothing touched; `force`: (N,) N; `label`: (N,) text, "none" where
      nothing touched; `touched`: (N, K), which of K keys were pressed.
    - `group`: (N,), the session or person of each: cross-validation never splits one; `time`: (N,) s.
    - `name`, for errors and reports; `notes`: what was mended.
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
        """Validate recorded presses; shapes and units as of the fields, `reference` also (M,) for all.

        Raises `ValueError` for shapes that disagree, fewer than ten presses, positions in millimetres, nothing to
        learn, and values that cannot be.
        """
        frames = check_frames("frames", frames)
        if len(frames) < _FEWEST:
            raise ValueError(
                f"frames: {len(frames)} presses are too few to learn from and to validate on; give {_FEWEST} or more."
            )
        given = {
            "positions": None if positions is None else _check_positions(positions),
            "force": None if force is None else _check_force(force),
            "label": None if label is None else _check_label(label),
            "touched": None if touched is None else _check_touched(touched),
            "group": None if group is None else _one_dimensional("group", group),
            "time": None if time is None else _check_time(time),
        }
        for key, values in given.items():
            if values is not None and len(values) != len(frames):
                raise ValueError(f"{key} has {len(values)} rows and frames {len(frames)}; give one for each press.")
        if all(given[key] is None for key in ("positions", "force", "label", "touched")):
            raise ValueError("frames: there is nothing to learn from them; give positions, force, label or touched.")
        reference = None if reference is None else check_reference(reference, frames)
        return replace(cls(frames, reference, name=name), **given)

    def rows(self, index: ArrayLike | slice) -> "Presses":
        """Select presses by number, or by a slice."""
        kept = {key: getattr(self, key) for key in ("frames", "reference", *_ROWS)}
        return replace(self, **{key: None if values is None else values[index] for key, values in kept.items()})


def read_presses(path: str | Path) -> Presses:
    """Read presses from an NPZ file with arrays named as the fields of `Presses`: `frames`, and any of the others.

    Raises `FileNotFoundError`, and `ValueError` for what is no such file and as `Presses.create` does.
    """
    with _naming(path):
        return Presses.create(**_arrays(path, "frames", "reference", *_ROWS), name=Path(path).name)


def read_frames(path: str | Path) -> dict[str, np.ndarray]:
    """Read the arguments of `LearntSkin.predict` from an NPZ file: `frames`, and `reference` and `group` if it has
    them.

    Raises `FileNotFoundError`, and `ValueError` for what is no such file.
    """
    with _naming(path):
        arrays = _arrays(path, "frames", "reference", "group")
        return arrays | {"frames": check_frames("frames", arrays["frames"])}


def _arrays(path: str | Path, *keys: str) -> dict[str, np.ndarray]:
    """Read the named arrays that a file has, `frames` at least."""
    if Path(path).is_dir():
        raise ValueError("it is a folder; give an NPZ file.")
    if not Path(path).is_file():
        raise FileNotFoundError(f"'{path}': there is no such file.")
    arrays = npz_arrays(Path(path), *keys)
    need(arrays, "frames")
    return {key: array for key, array in arrays.items() if key}


@contextmanager
def _naming(path: str | Path) -> Iterator[None]:
    """Add the name of the file to errors."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"'{path}': {error}") from None


def check_frames(name: str, given) -> Float[np.ndarray, "N M"]:
    """Convert frames (N, M) to numbers; infinite ones and those beyond any instrument become NaN.

    Raises `ValueError` for what is none.
    """
    try:
        frames = np.asarray(given)
    except ValueError:
        raise ValueError(f"{name}: rows differ in length; give one array (frames, channels).") from None
    if frames.dtype.kind not in "fiu" or frames.ndim != 2 or not frames.shape[1]:
        raise ValueError(
            f"{name} is {frames.dtype} of shape {frames.shape}; give real numbers, (frames, channels), one row for "
            "each frame."
        )
    return readings(frames.astype(float))


def check_reference(given, frames) -> Float[np.ndarray, "N M"]:
    """Return a reference (N, M) for each of the `frames`; raises `ValueError` for other shapes, and where it is not
    finite."""
    reference = np.asarray(given)
    if reference.dtype.kind not in "fiu" or reference.shape not in (frames.shape, frames.shape[1:]):
        raise ValueError(
            f"reference is {reference.dtype} of shape {reference.shape}; give ({frames.shape[1]},) for all frames, or "
            f"{frames.shape}, one for each."
        )
    reference = np.broadcast_to(reference.astype(float), frames.shape)
    return np.where(np.isfinite(reference), reference, np.nan)


def _check_positions(given) -> np.ndarray:
    positions = np.asarray(given)
    if positions.dtype.kind not in "fiu" or positions.ndim != 2 or positions.shape[1] not in (2, 3):
        raise ValueError(
            f"positions is {positions.dtype} of shape {positions.shape}; give numbers, (presses, 2) or (presses, 3), "
            "in metres."
        )
    positions = positions.astype(float)
    bad = np.isinf(positions).any(axis=1) | (np.isnan(positions).any(axis=1) & ~np.isnan(positions).all(axis=1))
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise ValueError(
            f"positions: row {row} is {positions[row].tolist()}; give numbers, or NaN throughout where nothing touched."
        )
    there = positions[~np.isnan(positions).any(axis=1)]
    if len(there) < _FEWEST:
        raise ValueError(f"positions: {len(there)} presses have one; give {_FEWEST} or more, or leave positions out.")
    extent = np.ptp(there, axis=0).max()
    if extent > _LONGEST:
        raise ValueError(
            f"positions spread over {extent:.4g}: are these metres? Divide millimetres by 1000; no side may be longer "
            f"than {_LONGEST:g} m."
        )
    if extent == 0:
        raise ValueError("positions are all the same: there is nothing to learn.")
    return positions


def _check_force(given) -> np.ndarray:
    force = _one_dimensional("force", given)
    if force.dtype.kind not in "fiu" or not np.isfinite(force).all():
        raise ValueError("force must be finite numbers, in newtons; 0 where nothing touched.")
    if np.abs(force).max() > _HARDEST:
        raise ValueError(f"force is up to {np.abs(force).max():.4g}: are these newtons? 100 g weigh 0.981 N.")
    if np.ptp(force) == 0:
        raise ValueError("force is the same in all presses: there is nothing to learn.")
    return force.astype(float)


def _check_label(given) -> np.ndarray:
    label = np.asarray(given)
    if label.dtype.kind == "O":
        kinds = sorted({type(one).__name__ for one in label.ravel()})
        if kinds != ["str"]:
            raise ValueError(f"label mixes {' and '.join(kinds)}; give text throughout.")
        label = label.astype(str)
    label = _one_dimensional("label", label)
    if label.dtype.kind not in "Uiub":
        raise ValueError(f"label is {label.dtype}; give text, or whole numbers.")
    label = label.astype(str)
    if any(not one.strip() for one in label):
        raise ValueError("label: some are empty; give every press one, and 'none' where nothing touched.")
    label = np.array([NO_TOUCH if one.strip().lower() in _NO_TOUCH else one.strip() for one in label])
    kinds, counts = np.unique(label, return_counts=True)
    if len(kinds) < 2:
        raise ValueError(f"label: all presses are '{kinds[0]}'; give two kinds or more, or leave label out.")
    if counts.min() < _FEWEST_OF_A_KIND:
        rare = kinds[counts.argmin()]
        raise ValueError(
            f"label: '{rare}' has {counts.min()} of the presses; give {_FEWEST_OF_A_KIND} or more of each kind, better "
            "twenty."
        )
    return label


def _check_touched(given) -> np.ndarray:
    touched = np.asarray(given)
    if touched.ndim != 2 or touched.dtype.kind not in "biuf" or not np.isin(touched, (0, 1)).all():
        raise ValueError(
            f"touched is {touched.dtype} of shape {touched.shape}; give (presses, keys), true where a key was pressed."
        )
    touched = touched.astype(bool)
    fixed = np.flatnonzero(touched.all(axis=0) | ~touched.any(axis=0))
    if fixed.size:
        raise ValueError(f"touched: key {fixed[0]} is the same in all presses; leave its column out.")
    count = np.minimum(touched.sum(axis=0), (~touched).sum(axis=0))
    if count.min() < _FEWEST_OF_A_KIND:
        raise ValueError(
            f"touched: key {count.argmin()} differs in {count.min()} of the presses only; give {_FEWEST_OF_A_KIND} or "
            "more with it and without, better twenty."
        )
    return touched


def _check_time(given) -> np.ndarray:
    time = _one_dimensional("time", given)
    if time.dtype.kind not in "fiu" or not np.isfinite(time).all():
        raise ValueError("time must be finite numbers, in seconds.")
    return time.astype(float)


def _one_dimensional(name: str, given: ArrayLike) -> np.ndarray:
    values = np.asarray(given)
    if values.ndim == 2 and 1 in values.shape:
        values = values.ravel()
    if values.ndim != 1 or values.dtype.kind == "O":
        raise ValueError(f"{name} is {values.dtype} of shape {values.shape}; give one plain value for each press.")
    return values


_MOST, _NEIGHBOURS, _COMPONENTS = 2, 8, 12
# A lag is found if the error of places estimated without one is at least this share of that of a guess, that with the
# lag is less, and that with any other lag is greater by this many standard errors.
_GUESS, _STANDARD_ERRORS = 0.95, 4.0


def lag_of(changes: np.ndarray, positions: np.ndarray, folds: np.ndarray) -> tuple[int, float, float]:
    """Estimate by how many rows frames come after their presses, 0 unless there is clear evidence.

    Also returns the mean error of places estimated from the nearest frames without a lag and with it, metres.
    """
    features = Features.learn("normalised", changes, np.zeros_like(changes))
    scores = features(changes, np.zeros_like(changes))[:, :_COMPONENTS]
    errors = {lag: _errors(scores, positions, folds, lag) for lag in range(-_MOST, _MOST + 1)}
    guess = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).mean())
    means = {lag: float(off.mean()) for lag, off in errors.items()}
    best, second = sorted(means, key=lambda lag: means[lag])[:2]
    enough = _STANDARD_ERRORS * float(errors[best].std()) / np.sqrt(len(positions))
    plain = means[0] > _GUESS * guess > means[best] and means[second] - means[best] > enough
    best = best if plain else 0
    return best, means[0], means[best]


def shifted(number: int, lag: int) -> tuple[slice, slice]:
    """Rows of frames, and of their presses, among `number` rows that were recorded with a lag."""
    return slice(max(lag, 0), number + min(lag, 0)), slice(max(-lag, 0), number - max(lag, 0))


def _errors(scores: np.ndarray, positions: np.ndarray, folds: np.ndarray, lag: int) -> np.ndarray:
    frames, presses = shifted(len(scores), lag)
    scores, positions, folds = scores[frames], positions[presses], folds[presses]
    off = np.empty(len(scores))
    for fold in np.unique(folds):
        out = folds == fold
        learnt = positions[~out]
        near = KDTree(scores[~out]).query(scores[out], min(_NEIGHBOURS, len(learnt)))[1].reshape(out.sum(), -1)
        off[out] = np.linalg.norm(learnt[near].mean(axis=1) - positions[out], axis=1)
    return off


@dataclass(frozen=True)
class Touches:
    """Predictions for n frames; what was not learnt is None.

    **Fields**

    - `position` (n, 2 or 3) metres with standard deviations `position_std`; `force` (n,) N with `force_std`; `label`
      (n,) text with `probability`; `touched` (n, K), which keys are pressed, with `key_probability`. NaN, "" and false
      where nothing touches, and in frames that are unlike the training set.
    - `unlike` (n,): frames unlike the training set, by their `novelty` (n,), 1 for the farthest frame in it.
    - `alive` (n, M): channels that were used.
    - `notes`: what was corrected.
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
