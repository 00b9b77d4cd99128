"""`LearntSkin`: a model learnt from recorded presses that estimates where, how hard and by what a skin is touched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, check_name, counted
from jeit.arguments.extras import need_extra
from jeit.forward import ForwardModel
from jeit.touch.learnt import labels as label_methods
from jeit.touch.learnt import numbers as number_methods
from jeit.touch.learnt.answers import METHODS, Standing, learn_quantities, places_and_folds
from jeit.touch.learnt.channels import Channels, choose_channels
from jeit.touch.learnt.extras import apply_over_threads, one_thread
from jeit.touch.learnt.imaged import ImageReconstruction, check_imaged
from jeit.touch.learnt.labels import LearntKeys, LearntLabels
from jeit.touch.learnt.numbers import LearntNumbers
from jeit.touch.learnt.presses import (
    NO_TOUCH,
    Presses,
    Touches,
    aligned_slices,
    changes_from_reference,
    check_frames,
    check_reference,
    estimate_lag,
    mean_reference,
    reference_used,
    standardise_sessions,
)

# A frame is unlike the training set above this novelty, which is 1 for the farthest frame in it, or below this fraction
# of channels that are alive.
_UNLIKE, _FEWEST = 2.0, 0.66
_AT_ONCE = 256
# Number of principal directions of the error of predicted readings that are propagated to predictions; number of random
# errors of all readings that are.
_UNSURE, _DRAWS = 4, 4
# Minimum number of touched frames for the detection of stuck channels.
_MANY = 20
# Minimum cosine similarity of a reference to that of the training set; maximum ratio of their norms. Beyond these
# limits, it is taken for the reference of another skin.
_ALIKE, _SIZES = 0.8, 5.0


@dataclass(frozen=True)
class LearntSkin:
    """Models learnt from presses by `LearntSkin.fit`; a model is None if the presses lack its quantity.

    **Fields**

    - `channels`: joint model of the channels.
    - `mean_reference` (M,): mean reference of the training set.
    - `place`, `force`, `label`, `keys`: model of each quantity.
    - `quiet`: root mean square of the changes, in the channels' scales, below which the skin counts as untouched.
    - `lag`: number of rows by which frames lagged behind their presses.
    - `per_session`: whether changes are standardised by session.
    - `name`: name of the presses.
    - `notes`: corrections that were made.
    - `standing`: accuracy of each model on held-out presses.

    **Example:**

    ```python
    learnt = LearntSkin.fit(presses, method="neighbours")
    print(learnt.predict(presses.frames, reference).position)
    ```
    """

    channels: Channels
    mean_reference: Float[np.ndarray, " M"] | None
    place: LearntNumbers | None
    force: LearntNumbers | None
    label: LearntLabels | None
    keys: LearntKeys | None
    quiet: float
    lag: int
    per_session: bool
    name: str
    notes: list[str]
    standing: dict[str, Standing] = field(default_factory=dict)

    @classmethod
    def fit(
        cls,
        presses: Presses,
        *,
        method: str = "auto",
        model: ForwardModel | None = None,
        num_channels: int | None = None,
        per_session: bool = False,
        progress: Callable[[str], None] | None = None,
    ) -> "LearntSkin":
        """Fit models to recorded presses.

        `method`: one of `METHODS`, which applies to the quantities it can learn; "auto" chooses the method with the
        lowest error on presses held out in intervals of time. `model`: a forward model of the skin, if one is known,
        with some hundred nodes; its images of the changes, and the contacts in them, are used as additional features.
        `num_channels`: number of channels to use, the most informative; by default all. `per_session`: standardise the
        changes of each `group` separately, against drift. `progress`: is called with a description of each step.
        Raises `ValueError` for an unknown method, a method that can learn none of the presses' quantities, presses from
        which nothing can be learnt, and a model with another number of channels.
        """
        _check_fit(presses, method, model, num_channels, per_session)
        with one_thread():
            report = progress or (lambda said: None)
            return cls._fit(presses, method, model, num_channels, per_session, report)

    @classmethod
    def _fit(cls, presses: Presses, method, model, num_channels, per_session, progress) -> "LearntSkin":
        notes = list(presses.notes)
        presses, dropped = _usable_presses(presses)
        notes += dropped
        changes = changes_from_reference(presses.frames, presses.reference)
        if per_session:
            changes = standardise_sessions(changes, presses.group)
        progress("channels")
        channels = Channels.learn(changes)
        if num_channels is not None:
            channels, said = _reduce_channels(channels, changes, presses, num_channels)
            notes.append(said)
        elif not channels.used.all():
            silent = np.flatnonzero(~channels.used)
            notes.append(
                f"{counted(len(silent), 'channel')} of {len(channels.used)} without changes, not used: "
                f"{_list_briefly(silent)}."
            )
        whole, alive, *_ = channels.complete(changes)
        if not alive.all():
            notes.append(
                f"{100 * (1 - alive.mean()):.2g} % of the readings disagree with the prediction from the other "
                f"channels and were replaced by it."
            )
        whole, presses, lag, said = _align_frames(whole, presses)
        quiet = _quiet_threshold(whole / channels.scale, presses)
        mean = None if presses.reference is None else mean_reference(presses.reference)
        imaged = None
        if model is not None:
            progress("images")
            imaged, remarks = ImageReconstruction.create(model, whole, channels.used, mean)
            said += remarks
        ours = None if mean is None else reference_used(presses.reference, mean, channels.used, len(whole))
        found, standing, remarks = learn_quantities(whole, ours, presses, method, imaged, progress)
        notes = list(dict.fromkeys([*notes, *said, *remarks]))
        return cls(
            channels,
            mean,
            **found,
            quiet=quiet,
            lag=lag,
            per_session=per_session,
            name=presses.name,
            notes=notes,
            standing=standing,
        )

    def predict(self, frames: ArrayLike, reference: ArrayLike | None = None, group: ArrayLike | None = None) -> Touches:
        """Predict the touches of frames (n, M).

        `reference` (M,) or (n, M) is required if the training presses had a reference; `group` (n,) is the session of
        each frame, if the skin was learnt `per_session`. Channels that no longer work are detected, and their readings
        replaced; frames unlike the training set are marked, and have no other prediction. Raises `ValueError` for
        frames with another number of channels, and for a reference that is missing, superfluous, or of another skin.
        """
        frames = self._check_frames(frames)
        reference = self._check_reference(frames, reference)
        changes = changes_from_reference(frames, reference)
        if self.per_session:
            changes = standardise_sessions(changes, group)
        changes = np.where(self._stuck_channels(frames, changes), np.nan, changes)
        found = apply_over_threads(
            self._predict,
            changes,
            reference_used(reference, self.mean_reference, self.channels.used, len(changes)),
            at_once=_AT_ONCE,
        )
        said: dict[str, Any] = {one.name: found.get(one.name) for one in fields(Touches) if one.name != "notes"}
        return Touches(**said, notes=self._prediction_notes(found["alive"], found["unlike"]))

    def _stuck_channels(self, frames: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Detect stuck channels (M,), whose readings are the same in all frames although many frames are touched.

        Only touched frames count, since a coarse converter may give the same readings of an untouched skin for a long
        time.
        """
        same = (frames == frames[0]).all(axis=0)
        if same.all() or not same.any() or len(frames) < _MANY:
            return np.zeros_like(same)
        scaled = np.where(same, 0.0, np.nan_to_num(changes))[:, self.channels.used] / self.channels.scale
        return same & (np.count_nonzero(np.sqrt(np.mean(scaled**2, axis=1)) > self.quiet) >= _MANY)

    def _predict(self, changes: Float[np.ndarray, "n M"], reference: Float[np.ndarray, "n m"]) -> dict[str, np.ndarray]:
        """Predict the fields of `Touches` that were learnt, for frames with these changes."""
        whole, alive, novelty, excess = self.channels.complete(changes)
        touching = np.sqrt(np.mean((whole / self.channels.scale) ** 2, axis=1)) > self.quiet
        # Small changes mean that the skin is untouched, but frames with too many missing channels always count as
        # unlike.
        unlike = (novelty > _UNLIKE) & touching | (alive.mean(axis=1) < _FEWEST)
        found = {"novelty": novelty, "unlike": unlike, "alive": np.zeros(changes.shape, bool)}
        found["alive"][:, self.channels.used] = alive
        if self.label is not None:
            label, probability = self.label.predict(whole, reference)
            found["label"] = np.where(unlike, "", np.where(touching, label, NO_TOUCH))
            found["probability"] = np.where(unlike | (~touching & (label != NO_TOUCH)), np.nan, probability)
            touching &= label != NO_TOUCH
        shown = (touching & ~unlike)[:, None]
        if self.place is not None:
            said, std = self._predict_targets(self.place, whole, reference, alive, excess)
            found |= {"position": np.where(shown, said, np.nan), "position_std": np.where(shown, std, np.nan)}
        if self.force is not None:
            said, std = self._predict_targets(self.force, whole, reference, alive, excess)
            still = ~touching & ~unlike
            pressed = np.where(shown, np.maximum(said, 0.0), np.nan)[:, 0]
            found |= {"force": np.where(still, 0.0, pressed), "force_std": np.where(shown, std, np.nan)[:, 0]}
        if self.keys is not None:
            touched, probability = self.keys.predict(whole, reference)
            found["touched"] = touched & shown
            found["key_probability"] = np.where(unlike[:, None], np.nan, np.where(touching[:, None], probability, 0.0))
        return found

    def _predict_targets(
        self, learnt: LearntNumbers, changes, reference, alive, excess
    ) -> tuple[np.ndarray, np.ndarray]:
        """Predict targets (n, d) and their standard deviations.

        The standard deviations include the uncertainty of the readings predicted for dead channels, and errors of all
        readings, where these deviate more from the patterns of the training set than its presses do.
        """
        noisy = np.flatnonzero(excess.any(axis=1))
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (_DRAWS, 1, changes.shape[1]))
        moved = (changes[noisy] + signs * excess[noisy]).reshape(-1, changes.shape[1])
        # One call for all: with few frames, calls take longer than predictions.
        every = np.concatenate([changes, moved]), np.concatenate([reference, np.tile(reference[noisy], (_DRAWS, 1))])
        said, off = np.split(learnt.predict(*every), [len(changes)])
        std = learnt.spread(said, changes)
        off = off.reshape(_DRAWS, len(noisy), said.shape[1]) - said[noisy]
        std[noisy] = np.hypot(std[noisy], np.sqrt(np.mean(off**2, axis=0)))
        lacking = np.flatnonzero(~alive.all(axis=1))
        if not lacking.size:
            return said, std
        for moved in self.channels.prediction_errors(alive[lacking], _UNSURE):
            off = learnt.predict(changes[lacking] + moved, reference[lacking]) - said[lacking]
            std[lacking] = np.hypot(std[lacking], off)
        return said, std

    def _check_frames(self, frames) -> np.ndarray:
        frames = np.asarray(frames)
        frames = check_frames("frames", frames[None] if frames.ndim == 1 else frames)
        number = len(self.channels.used)
        if not len(frames):
            raise ValueError("frames: the array is empty; give at least one frame.")
        if frames.shape[1] != number:
            raise ValueError(f"frames have {frames.shape[1]} channels, and the skin that was learnt has {number}.")
        return frames

    def _check_reference(self, frames, given) -> np.ndarray | None:
        if self.mean_reference is None:
            if given is not None:
                raise ValueError("reference: the skin was learnt from changes, without a reference; leave it out.")
            return None
        if given is None:
            raise ValueError(
                "reference is missing: the training presses had one; give a frame (channels,), or one for each frame."
            )
        reference = check_reference(given, frames)
        there = np.isfinite(reference).any(axis=0) & self.channels.used
        own, learnt = mean_reference(reference)[there], self.mean_reference[there]
        if not there.any():
            raise ValueError(
                "reference has no finite reading in any channel that is used; give a frame of the untouched skin."
            )
        if not learnt.any():  # the frames of the training set were changes already
            return reference
        alike = float(own @ learnt / np.sqrt((own @ own) * (learnt @ learnt))) if own.any() else 0.0
        size = np.sqrt((own @ own) / (learnt @ learnt))
        if alike < _ALIKE or not 1 / _SIZES < size < _SIZES:
            raise ValueError(
                f"reference is unlike that of the training set (cosine {alike:.2f}, {size:.3g} times as large): "
                f"is it of "
                "this skin, with its channels in the same order and units?"
            )
        return reference

    def _prediction_notes(self, alive: np.ndarray, unlike: np.ndarray) -> tuple[str, ...]:
        notes = []
        numbers = np.flatnonzero(self.channels.used)
        alive = alive[:, numbers]
        lost = np.mean(~alive, axis=0)
        dead = numbers[lost > 0.5]
        if dead.size:
            notes.append(
                f"channels that disagree with the prediction from the others and are not used: {_list_briefly(dead)}."
            )
        elif lost.any():
            notes.append(
                f"{100 * np.mean(~alive):.2g} % of the readings disagree with the prediction from the other "
                f"channels and were replaced by it."
            )
        if unlike.any():
            notes.append(
                f"{int(unlike.sum())} of {len(unlike)} frames are unlike all frames of the training set: they have no "
                "prediction."
            )
        return tuple(notes)


def _check_fit(presses: Presses, method: str, model, num_channels: int | None, per_session: bool) -> None:
    need_extra("learn", "learning a skin")
    check_kind("presses", presses, Presses, "Presses, as of read_presses(path)")
    check_name("method", method, METHODS)
    numbers = presses.positions is not None or presses.force is not None
    if method != "auto" and not (
        (numbers and method in number_methods.METHODS)
        or (presses.label is not None and method in label_methods.METHODS)
    ):
        learnt = "labels" if method in label_methods.METHODS else "places and forces"
        raise ValueError(f"method: {method!r} learns {learnt}, and the presses have none; leave method to 'auto'.")
    whole = isinstance(num_channels, int | np.integer) and not isinstance(num_channels, bool)
    most = presses.frames.shape[1]
    if num_channels is not None and not (whole and 2 <= num_channels <= most):
        raise ValueError(f"num_channels must be from 2 to {most}, those there are; it is {num_channels}.")
    if model is not None:
        check_imaged(model, most)
    if model is not None and per_session:
        raise ValueError("model: images are of changes in volts, and per_session takes their unit away; leave one out.")
    if per_session and presses.group is None:
        raise ValueError("per_session: presses have no group that says the session of each.")


def _usable_presses(presses: Presses) -> tuple[Presses, list[str]]:
    """Select the presses that have readings of at least two thirds of the channels.

    Channels without a reading in any press do not count.
    """
    changes = changes_from_reference(presses.frames, presses.reference)
    there = np.isfinite(changes)
    ever = there.any(axis=0)
    notes = []
    if not ever.all():
        silent = np.flatnonzero(~ever)
        notes.append(f"{counted(len(silent), 'channel')} without any reading: {_list_briefly(silent)}.")
    fair = there[:, ever].mean(axis=1) >= _FEWEST if ever.any() else np.zeros(len(there), bool)
    if fair.sum() < 10:
        raise ValueError(f"frames: only {int(fair.sum())} have readings of two thirds of the channels; 10 are needed.")
    if not fair.all():
        notes.append(f"{int((~fair).sum())} presses lack more than a third of their readings, and are not used.")
    return presses.rows(fair), notes


def _reduce_channels(
    channels: Channels, changes: np.ndarray, presses: Presses, num_channels: int
) -> tuple[Channels, str]:
    scaled = np.where(np.isnan(changes), 0.0, changes)[:, channels.used] / channels.scale
    chosen = np.flatnonzero(channels.used)[choose_channels(scaled, _standardised_targets(presses), num_channels)]
    kept = np.full(changes.shape, np.nan)
    kept[:, chosen] = changes[:, chosen]
    return Channels.learn(
        kept
    ), f"{len(chosen)} of {changes.shape[1]} channels are used: {_list_briefly(np.sort(chosen), 200)}."


def _standardised_targets(presses: Presses) -> np.ndarray:
    """Return all quantities of the presses as standardised columns (N, q); 0 where unknown."""
    columns = []
    if presses.positions is not None:
        columns.append(presses.positions)
    if presses.force is not None:
        columns.append(presses.force[:, None])
    if presses.label is not None:
        columns.append(presses.label[:, None] == np.unique(presses.label))
    if presses.touched is not None:
        columns.append(presses.touched)
    values = np.column_stack(columns).astype(float)
    deviation = np.nanstd(values, axis=0)
    return np.nan_to_num((values - np.nanmean(values, axis=0)) / np.where(deviation > 0, deviation, 1.0))


def _quiet_threshold(scaled: np.ndarray, presses: Presses) -> float:
    """Compute the root mean square change that separates untouched from touched frames.

    With fewer than five untouched frames, it is half of the 1 % quantile of the touched frames.
    """
    still = np.zeros(len(scaled), bool)
    if presses.positions is not None:
        still |= np.isnan(presses.positions).any(axis=1)
    if presses.label is not None:
        still |= presses.label == NO_TOUCH
    if presses.touched is not None:
        still |= ~presses.touched.any(axis=1)
    size = np.sqrt(np.mean(scaled**2, axis=1))
    if still.sum() < 5:
        return 0.5 * float(np.quantile(size[~still], 0.01))
    sizes = np.sort(size)
    # Choose the threshold with the lowest sum of the error rates of untouched and of touched frames.
    wrong = [np.mean(size[still] > at) + np.mean(size[~still] <= at) for at in sizes]
    return float(sizes[int(np.argmin(wrong))])


def _align_frames(changes: np.ndarray, presses: Presses) -> tuple[np.ndarray, Presses, int, list[str]]:
    """Align frames with their presses if the recording clearly has a lag.

    Returns changes, presses, the lag in rows, and notes.
    """
    if presses.positions is None:
        return changes, presses, 0, []
    rows, folds, _ = places_and_folds(presses)
    lag, straight, late = estimate_lag(changes[rows], presses.positions[rows], folds)
    if not lag:
        return changes, presses, 0, []
    frames, answers = aligned_slices(len(changes), lag)
    reference = None if presses.reference is None else presses.reference[frames]
    moved = replace(presses.rows(answers), frames=presses.frames[frames], reference=reference)
    said = (
        f"frames seem to be of the press {counted(abs(lag), 'row')} {'before' if lag > 0 else 'after'} (places "
        f"estimated {1e3 * late:.3g} mm off, as recorded {1e3 * straight:.3g} mm): learnt so; check the recording."
    )
    return changes[frames], moved, lag, [said]


def _list_briefly(numbers: np.ndarray, max_listed: int = 12) -> str:
    said = ", ".join(str(one) for one in numbers[:max_listed])
    return said if len(numbers) <= max_listed else f"{said}, … ({len(numbers)} in all)"
