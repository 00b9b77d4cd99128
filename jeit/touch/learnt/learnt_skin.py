"""A skin that has learnt, from recorded presses, to tell where, how hard and by what it is touched."""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jeit.arguments import check_kind, check_name, counted
from jeit.forward import ForwardModel
from jeit.touch.learnt import labels as label_methods
from jeit.touch.learnt import numbers as number_methods
from jeit.touch.learnt.channel_choice import choose_channels
from jeit.touch.learnt.channels import Channels
from jeit.touch.learnt.extras import need_learning, one_thread, over_threads
from jeit.touch.learnt.folds import time_folds
from jeit.touch.learnt.imaged import Imaged, check_imaged
from jeit.touch.learnt.keys import LearntKeys, learn_keys
from jeit.touch.learnt.labels import LearntLabels, learn_labels
from jeit.touch.learnt.lag import lag_of, shifted
from jeit.touch.learnt.numbers import LearntNumbers, learn_numbers
from jeit.touch.learnt.presses import NO_TOUCH, Presses, check_frames, check_reference
from jeit.touch.learnt.touches import Touches

# A frame is unlike any learnt from beyond so many times the novelty of the farthest of them, or with fewer channels.
_UNLIKE, _FEWEST = 2.0, 0.66
_AT_ONCE = 256
# Frames in which a channel that is alive does not read the same.
_MANY = 20
# A reference is another skin's if it is less like those learnt from than this, or of another size.
_ALIKE, _SIZES = 0.8, 5.0
# Frames of a session, before it can be standardised by itself.
_SESSION = 20
METHODS = tuple(dict.fromkeys((*number_methods.METHODS, *label_methods.METHODS)))


@dataclass(frozen=True)
class Standing:
    """How well something was learnt: the `method` chosen, errors of all that were `tried` on presses held out, and what
    the chosen one said of each press when it was held out; in the units of what was learnt."""

    method: str
    tried: list[tuple[str, float]]
    held_out: np.ndarray
    right: np.ndarray
    std: np.ndarray | None = None


@dataclass(frozen=True)
class LearntSkin:
    """What was learnt, each None if presses did not say it; make it with `LearntSkin.fit`.

    `channels`: what they do together. `place`, `force`, `label`, `keys`: what tells each. `quiet`: frames whose changes
    are smaller, of the channels' scales, are of an untouched skin. `mean_reference` (M,). `lag`: rows by which frames
    came after their presses in the recording. `per_session`: changes are standardised by session. `standing`: how well
    each was learnt, on presses held out; `notes`: what was mended.
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
        progress: Callable[[str], None] = lambda said: None,
    ) -> "LearntSkin":
        """Learn from recorded presses.

        `method`: "auto" takes what errs least on presses held out, in stretches of time; or one of `METHODS`, for what
        it can learn. `model` of the skin, if one is known, of some hundred nodes: its images of the changes, and the
        contacts in them, are learnt from too. `num_channels`: only so many, those that tell most, are used.
        `per_session`: changes of each `group` are standardised by themselves, against drift. Raises `ValueError` for
        another method, one that cannot learn what the presses say, presses that nothing can be learnt from, and a model
        of another number of channels.
        """
        _check_fit(presses, method, model, num_channels, per_session)
        with one_thread():
            return cls._fit(presses, method, model, num_channels, per_session, progress)

    @classmethod
    def _fit(cls, presses: Presses, method, model, num_channels, per_session, progress) -> "LearntSkin":
        notes = list(presses.notes)
        presses, dropped = _usable(presses)
        notes += dropped
        changes = _changes(presses.frames, presses.reference)
        if per_session:
            changes = standardised(changes, presses.group)
        progress("channels")
        channels = Channels.learn(changes)
        if num_channels is not None:
            channels, said = _fewer(channels, changes, presses, num_channels)
            notes.append(said)
        elif not channels.used.all():
            silent = np.flatnonzero(~channels.used)
            notes.append(
                f"{counted(len(silent), 'channel')} of {len(channels.used)} without changes, not used: {_few(silent)}."
            )
        whole, alive, _ = channels.complete(changes)
        if not alive.all():
            notes.append(
                f"{100 * (1 - alive.mean()):.2g} % of the readings were not borne out by the others: replaced."
            )
        whole, presses, lag, said = _in_step(whole, presses)
        quiet = _quiet(whole / channels.scale, presses)
        mean = None if presses.reference is None else _mean_reference(presses.reference)
        imaged = None
        if model is not None:
            progress("images")
            imaged, told = Imaged.create(model, whole, channels.used, mean)
            said += told
        name, notes = presses.name, notes + said
        skin = cls(channels, mean, None, None, None, None, quiet, lag, per_session, name, notes)
        return _learn_all(skin, whole, presses, method, imaged, progress)

    def predict(self, frames, reference=None, group=None) -> Touches:
        """Touches of frames (n, M), with the `reference` (M,) or (n, M) if there was one in the presses learnt from,
        and the session of each (`group`) if sessions are standardised.

        Channels that have died since are found and done without; frames unlike any learnt from are said to be, and
        nothing else of them. Raises `ValueError` for frames of another number of channels, a reference that is missing,
        superfluous or another skin's.
        """
        frames = self._check(frames)
        reference = self._reference(frames, reference)
        changes = _changes(np.where(_stuck(frames), np.nan, frames), reference)
        if self.per_session:
            changes = standardised(changes, group)
        found = over_threads(self._tell, changes, self._used(reference, changes), at_once=_AT_ONCE)
        said: dict[str, Any] = {one.name: found.get(one.name) for one in fields(Touches) if one.name != "notes"}
        return Touches(**said, notes=self._told(found["alive"], found["unlike"]))

    def _tell(self, changes: Float[np.ndarray, "n M"], reference: Float[np.ndarray, "n m"]) -> dict[str, np.ndarray]:
        """What `Touches` say of some frames, as far as it was learnt."""
        whole, alive, novelty = self.channels.complete(changes)
        touching = np.sqrt(np.mean((whole / self.channels.scale) ** 2, axis=1)) > self.quiet
        # Small changes are no touch, but missing ones may be any.
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
            said, std = self.place.predict(whole, reference)
            found |= {"position": np.where(shown, said, np.nan), "position_std": np.where(shown, std, np.nan)}
        if self.force is not None:
            said, std = self.force.predict(whole, reference)
            still = ~touching & ~unlike
            pressed = np.where(shown, np.maximum(said, 0.0), np.nan)[:, 0]
            found |= {"force": np.where(still, 0.0, pressed), "force_std": np.where(shown, std, np.nan)[:, 0]}
        if self.keys is not None:
            touched, probability = self.keys.predict(whole, reference)
            found["touched"] = touched & shown
            found["key_probability"] = np.where(unlike[:, None], np.nan, np.where(touching[:, None], probability, 0.0))
        return found

    def _check(self, frames) -> np.ndarray:
        frames = np.asarray(frames)
        frames = check_frames("frames", frames[None] if frames.ndim == 1 else frames)
        number = len(self.channels.used)
        if not len(frames):
            raise ValueError("frames: there are none.")
        if frames.shape[1] != number:
            raise ValueError(f"frames have {frames.shape[1]} channels, and the skin that was learnt has {number}.")
        return frames

    def _reference(self, frames, given) -> np.ndarray | None:
        if self.mean_reference is None:
            if given is not None:
                raise ValueError("reference: the skin was learnt from changes, without a reference; leave it out.")
            return None
        if given is None:
            raise ValueError(
                "reference is missing: the skin was learnt from frames with one; give (channels,) or one each."
            )
        reference = check_reference(given, frames)
        there = np.isfinite(reference).any(axis=0) & self.channels.used
        own, learnt = _mean_reference(reference)[there], self.mean_reference[there]
        if not there.any():
            raise ValueError(
                "reference has no finite reading of a channel that is used; give that of the untouched skin."
            )
        if not learnt.any():  # frames that were learnt from were changes already
            return reference
        alike = float(own @ learnt / np.sqrt((own @ own) * (learnt @ learnt))) if own.any() else 0.0
        size = np.sqrt((own @ own) / (learnt @ learnt))
        if alike < _ALIKE or not 1 / _SIZES < size < _SIZES:
            raise ValueError(
                f"reference is unlike those that were learnt from (cosine {alike:.2f}, {size:.3g} times as large): is "
                "it of this skin, its channels in the same order and units?"
            )
        return reference

    def _used(self, reference: np.ndarray | None, changes: np.ndarray) -> Float[np.ndarray, "n m"]:
        """The reference of the channels used, the mean of those learnt from where it has no reading; zeros where there
        is none."""
        if reference is None or self.mean_reference is None:
            return np.zeros((len(changes), int(self.channels.used.sum())))
        return np.where(np.isnan(reference), self.mean_reference, reference)[:, self.channels.used]

    def _told(self, alive: np.ndarray, unlike: np.ndarray) -> tuple[str, ...]:
        notes = []
        numbers = np.flatnonzero(self.channels.used)
        alive = alive[:, numbers]
        lost = np.mean(~alive, axis=0)
        dead = numbers[lost > 0.5]
        if dead.size:
            notes.append(f"channels that the others do not bear out, done without: {_few(dead)}.")
        elif lost.any():
            notes.append(f"{100 * np.mean(~alive):.2g} % of the readings were not borne out by the others: replaced.")
        if unlike.any():
            notes.append(
                f"{int(unlike.sum())} of {len(unlike)} frames are unlike any that were learnt from: nothing is said of "
                "them."
            )
        return tuple(notes)


def _stuck(frames: Float[np.ndarray, "n M"]) -> Bool[np.ndarray, " M"]:
    """Channels that read the same in all of many frames, while most others change."""
    same = (frames == frames[0]).all(axis=0)
    return same & (len(frames) >= _MANY) & (same.mean() < 0.5)


def standardised(changes: np.ndarray, group) -> np.ndarray:
    """Changes (n, M) less their session's median, over their session's deviation; one session unless `group` (n,) says
    otherwise. Raises `ValueError` for sessions of fewer than 20 frames."""
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


def _check_fit(presses: Presses, method: str, model, num_channels: int | None, per_session: bool) -> None:
    need_learning()
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


def _usable(presses: Presses) -> tuple[Presses, list[str]]:
    """Presses of which at least two thirds of the channels that ever have readings have one."""
    changes = _changes(presses.frames, presses.reference)
    there = np.isfinite(changes)
    ever = there.any(axis=0)
    notes = []
    if not ever.all():
        silent = np.flatnonzero(~ever)
        notes.append(f"{counted(len(silent), 'channel')} without any reading: {_few(silent)}.")
    fair = there[:, ever].mean(axis=1) >= _FEWEST if ever.any() else np.zeros(len(there), bool)
    if fair.sum() < 10:
        raise ValueError(f"frames: only {int(fair.sum())} have readings of two thirds of the channels; 10 are needed.")
    if not fair.all():
        notes.append(f"{int((~fair).sum())} presses lack more than a third of their readings, and are not used.")
    return presses.rows(fair), notes


def _changes(frames: np.ndarray, reference: np.ndarray | None) -> np.ndarray:
    return frames if reference is None else frames - reference


def _fewer(channels: Channels, changes: np.ndarray, presses: Presses, number: int) -> tuple[Channels, str]:
    scaled = np.where(np.isnan(changes), 0.0, changes)[:, channels.used] / channels.scale
    chosen = np.flatnonzero(channels.used)[choose_channels(scaled, _answers(presses), number)]
    kept = np.full(changes.shape, np.nan)
    kept[:, chosen] = changes[:, chosen]
    return Channels.learn(kept), f"{len(chosen)} of {changes.shape[1]} channels are used: {_few(np.sort(chosen), 200)}."


def _answers(presses: Presses) -> np.ndarray:
    """All that presses say (N, q), standardised; 0 where it is not known."""
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


def _quiet(scaled: np.ndarray, presses: Presses) -> float:
    """Between the sizes of changes of untouched frames and of touched ones; half of the least size of a touch where
    none was untouched."""
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
    # The threshold with the fewest mistakes, each kind counted by its share.
    wrong = [np.mean(size[still] > at) + np.mean(size[~still] <= at) for at in sizes]
    return float(sizes[int(np.argmin(wrong))])


def _mean_reference(reference: np.ndarray) -> np.ndarray:
    """Of every channel; 0 where it has no reading at all."""
    there = np.isfinite(reference)
    return np.where(there, reference, 0.0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)


def _in_step(whole: np.ndarray, presses: Presses) -> tuple[np.ndarray, Presses, int, list[str]]:
    """Frames with the presses that they are of, where they were plainly recorded some rows late; by how many; notes."""
    if presses.positions is None:
        return whole, presses, 0, []
    rows, folds, _ = _placed(presses)
    lag, straight, late = lag_of(whole[rows], presses.positions[rows], folds)
    if not lag:
        return whole, presses, 0, []
    frames, answers = shifted(len(whole), lag)
    reference = None if presses.reference is None else presses.reference[frames]
    moved = replace(presses.rows(answers), frames=presses.frames[frames], reference=reference)
    said = (
        f"frames seem to be of the press {counted(abs(lag), 'row')} {'before' if lag > 0 else 'after'} (places told "
        f"{1e3 * late:.3g} mm off, as recorded {1e3 * straight:.3g} mm): learnt so; check the recording."
    )
    return whole[frames], moved, lag, [said]


def _learn_all(skin: LearntSkin, whole, presses: Presses, method: str, imaged: Imaged | None, progress) -> LearntSkin:
    """The skin with all that presses say learnt from their changes (N, m)."""
    notes, standing, found = list(skin.notes), {}, {}
    reference = None if presses.reference is None else skin._used(presses.reference, whole)
    every = np.arange(len(whole))
    if presses.positions is not None:
        rows, folds, told = _placed(presses)
        notes += told
        places = presses.positions[rows]
        found["place"], standing["place"] = _numbers(whole, reference, places, rows, folds, method, imaged, progress)
    if presses.force is not None:
        known = presses.positions is not None and np.isfinite(presses.positions).all()
        alike = presses.positions if known else presses.force[:, None]
        folds, _ = time_folds(presses.frames, *_when(presses, every), alike=alike)
        force = presses.force[:, None]
        found["force"], standing["force"] = _numbers(whole, reference, force, every, folds, method, imaged, progress)
    if presses.label is not None:
        folds, told = time_folds(presses.frames, *_when(presses, every), kinds=presses.label)
        learnt, tried = learn_labels(
            whole,
            reference,
            presses.label,
            folds,
            method=_asked(method, label_methods),
            imaged=imaged,
            progress=progress,
        )
        notes += [*told, *learnt.notes]
        found["label"] = learnt
        methods = [(f"{one.method} on {one.form}", one.error) for one in tried]
        standing["label"] = Standing(methods[0][0], methods, learnt.classes[tried[0].held_out], presses.label)
    if presses.touched is not None:
        folds, told = time_folds(presses.frames, *_when(presses, every), kinds=presses.touched)
        notes += told
        if presses.touched.sum(axis=1).max() < 2:
            notes.append("no two keys were pressed together: what is said of keys pressed together is a guess.")
        found["keys"], tried = learn_keys(whole, reference, presses.touched, folds, progress=progress)
        pairs = zip(tried.methods, tried.errors.tolist(), strict=True)
        methods = [(f"key {key}: {name}", error) for key, (name, error) in enumerate(pairs)]
        standing["keys"] = Standing("for each key its own", methods, tried.held_out, presses.touched)
    return replace(skin, **found, notes=list(dict.fromkeys(notes)), standing=standing)


def _placed(presses: Presses) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Rows of presses that have a place, the folds of those, and notes."""
    positions = np.asarray(presses.positions)
    rows = np.flatnonzero(~np.isnan(positions).any(axis=1))
    folds, told = time_folds(presses.frames[rows], *_when(presses, rows), alike=positions[rows])
    return rows, folds, told


def _numbers(whole, reference, targets, rows, folds, method, imaged, progress) -> tuple[LearntNumbers, Standing]:
    """Numbers (n, d) learnt from the changes of some rows, and how well."""
    own, asked = None if reference is None else reference[rows], _asked(method, number_methods)
    learnt, tried = learn_numbers(whole[rows], own, targets, folds, method=asked, imaged=imaged, progress=progress)
    methods = [(one.name, one.error) for one in tried]
    said = tried[0].held_out
    return learnt, Standing(methods[0][0], methods, said, targets, learnt.spread.held_out(said, whole[rows]))


def _asked(method: str, methods) -> str:
    return method if method in methods.METHODS else "auto"


def _when(presses: Presses, rows: np.ndarray) -> tuple:
    return tuple(None if values is None else values[rows] for values in (presses.group, presses.time))


def _few(numbers: np.ndarray, most: int = 12) -> str:
    said = ", ".join(str(one) for one in numbers[:most])
    return said if len(numbers) <= most else f"{said}, … ({len(numbers)} in all)"
