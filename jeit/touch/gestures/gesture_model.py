"""A model of gestures: the frames it reads, its features and its classifier."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, check_name, describe, is_number
from jeit.arguments.extras import need_extra
from jeit.touch.gestures.features import course_features
from jeit.touch.gestures.gesture_classifiers import (
    FORMS,
    GESTURE_CLASSIFIERS,
    Scale,
    forms_of,
    held_out_odds,
    person_folds,
    random_folds,
)
from jeit.touch.gestures.segmentation import StreamTouch
from jeit.touch.learnt.answers import Standing
from jeit.touch.learnt.extras import in_parts
from jeit.touch.learnt.file import read_plain, write_plain
from jeit.touch.learnt.methods import log_odds, probabilities, sharpness_of

# A conductivity that differs by this factor is of another skin, or in another unit.
_OTHER_SKIN = 5.0


@dataclass(frozen=True)
class Reading:
    """How a skin was read.

    **Fields**: the `level` that a touch exceeds, and the `background`, the untouched skin's conductivity, both S;
    `sign`, 1 where a touch raises conductivity, -1 where it lowers it; the frame `rate`, frames/s; `num_channels`, and
    the `protocol`'s name.
    """

    level: float
    background: float
    sign: int
    rate: float
    num_channels: int
    protocol: str

    def __post_init__(self):
        """Raises `ValueError` for levels and rates that are not positive, and what is no sign or number."""
        for name in ("level", "background", "rate"):
            if not (is_number(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} must be positive; it is {describe(getattr(self, name))}.")
        if self.sign not in (-1, 1):
            raise ValueError(f"sign must be 1 or -1; it is {describe(self.sign)}.")
        if not (isinstance(self.num_channels, int) and self.num_channels > 0):
            raise ValueError(f"num_channels must be a positive number; it is {describe(self.num_channels)}.")

    def check_same_skin(self, num_channels: int, protocol: str, background: float) -> None:
        """Raise `ValueError` for frames of another number of channels, by another protocol, or of a skin of another
        `background`, S."""
        if num_channels != self.num_channels:
            raise ValueError(
                f"gestures were learnt from frames of {self.num_channels} channels, and this skin has {num_channels}: "
                "learn them on this skin."
            )
        if protocol != self.protocol:
            raise ValueError(
                f"gestures were learnt from a skin driven by '{self.protocol}', and this one is by '{protocol}': learn "
                "them on this skin."
            )
        ratio = background / self.background
        if not 1 / _OTHER_SKIN < ratio < _OTHER_SKIN:
            raise ValueError(
                f"the untouched skin has {ratio:.3g} times the conductivity of that which gestures were learnt on: is "
                "it the same, and are voltages in the unit and at the current that its description says?"
            )


METHODS = ("auto", *GESTURE_CLASSIFIERS)
# The greatest number of folds by which the method is chosen; and the share of touches like those learnt that are
# accepted as such.
_FOLDS, _LIKE = 10, 0.99
# The number of touches whose distances from the training set are computed at once.
_AT_ONCE = 1000
GESTURE_FILE = "gestures.skops"
"""Name of a model's file in the folder of `jeit touch gestures`."""
_KIND, _VERSION = "a jeit gesture model", 3


@dataclass(frozen=True)
class Gestures:
    """Predictions for n touches.

    `gesture` (n,): the likeliest name; `probability` (n,) of it; `probabilities` (n, C) of all C `names`; `unlike`
    (n,): whether a touch is unlike any in the training set, where the prediction does not count.
    """

    gesture: np.ndarray
    probability: Float[np.ndarray, " n"]
    probabilities: Float[np.ndarray, "n C"]
    names: tuple[str, ...]
    unlike: Bool[np.ndarray, " n"]

    def __len__(self) -> int:
        """Number of touches."""
        return len(self.gesture)


@dataclass(frozen=True)
class GestureModel:
    """A classifier of touches.

    **Fields**: `names` (C,) of the gestures; the `method` and the `form` of its features ("seven": the paper's,
    "course": those and more of the course, "sequence": all of it); their `scale`, the `model` of the classifier and the
    `sharpness` of its probabilities; `known` (N, k), scaled course features of the training set, their `known_scale`,
    and `farthest`, the distance from the nearest of them beyond which a touch is unlike all. `reading`: how the skin
    was read, None where it is not known. `standing`: the predictions for held-out touches, and the errors of all that
    was tried, the best first, None of a model read from a file; `notes` on it.
    """

    names: tuple[str, ...]
    method: str
    form: str
    scale: Scale
    model: Any
    sharpness: float
    known: Float[np.ndarray, "N k"]
    known_scale: Scale
    farthest: float
    reading: Reading | None = None
    standing: Standing | None = None
    notes: tuple[str, ...] = ()

    @classmethod
    def fit(
        cls,
        touches: list[StreamTouch],
        labels: ArrayLike,
        *,
        people: ArrayLike | None = None,
        method: str = "auto",
        form: str = "auto",
        reading: Reading | None = None,
        notes: tuple[str, ...] = (),
        progress: Callable[[str], None] | None = None,
    ) -> "GestureModel":
        """Learn the `labels` (n,), names of gestures, of touches, made by `people` (n,), names or numbers.

        `method`: one of `METHODS`; `form`: "seven", "course", "sequence" (the network's) or "auto". "auto" chooses what
        is most accurate on touches of held-out people, one after the other, or a tenth of them where there are more
        than ten; without people, or of one person, on touches held out at random, which is no estimate of the accuracy
        for other people. `reading`, and `notes` on the touches, are kept with it. `progress` is called with what is
        tried. Raises `ValueError` for labels and people that are not as many, gestures of fewer than two touches, fewer
        than two gestures, and names of methods and forms that there are not; `ImportError` without the extra `learn`.
        """
        need_extra("learn", "learning gestures")
        check_name("method", method, METHODS)
        check_name("form", form, ("auto", *FORMS))
        named, people_of = _checked(touches, labels, people)
        names, right = np.unique(named, return_inverse=True)
        remarks = list(notes)
        if people_of is not None and len(np.unique(people_of)) > 1:
            folds = person_folds(people_of, _FOLDS)
        else:
            folds = random_folds(right, _FOLDS)
            remarks.append("one person, or nobody, is named: chosen on touches held out at random, not on people.")
        found = []
        for shape in FORMS:
            values = FORMS[shape](touches).values
            for name in GESTURE_CLASSIFIERS:
                if method not in ("auto", name) or form not in ("auto", shape) or shape not in forms_of(name):
                    continue
                if progress is not None:
                    progress(f"{name} on {shape}")
                odds = held_out_odds(name, values, right, folds)
                found.append((float(np.mean(odds.argmax(axis=1) != right)), name, shape, odds))
        if not found:
            raise ValueError(f"form: '{method}' takes {' or '.join(forms_of(method))}; '{form}' was asked for.")
        found.sort(key=lambda one: one[0])
        _, chosen, shape, odds = found[0]
        values, courses = FORMS[shape](touches).values, course_features(touches).values
        tried = [(f"{name} on {shape}", error) for error, name, shape, _ in found]
        scale, known_scale = Scale.of(values), Scale.of(courses)
        known = known_scale(courses)
        return cls(
            names=tuple(str(one) for one in names),
            method=chosen,
            form=shape,
            scale=scale,
            model=GESTURE_CLASSIFIERS[chosen](scale(values), right),
            sharpness=sharpness_of(odds, right),
            known=known,
            known_scale=known_scale,
            farthest=_farthest(known, folds),
            reading=reading,
            standing=Standing(tried[0][0], tried, names[odds.argmax(axis=1)], named),
            notes=tuple(remarks),
        )

    def predict(self, touches: list[StreamTouch]) -> Gestures:
        """Predict gestures of touches; for those that are cut off, less is known than for those in the training set.

        Raises `ValueError` for what is no list of touches.
        """
        values = FORMS[self.form](touches).values
        if not len(values):
            nothing = np.empty(0)
            return Gestures(
                nothing.astype(str), nothing, np.empty((0, len(self.names))), self.names, nothing.astype(bool)
            )
        odds = np.full((len(values), len(self.names)), -1e3)
        odds[:, self.model.classes_] = log_odds(self.model, self.scale(values))
        shares = probabilities(odds, self.sharpness)
        distance = _nearest(self.known, self.known_scale(course_features(touches).values))
        said = np.array(self.names)[shares.argmax(axis=1)]
        return Gestures(said, shares.max(axis=1), shares, self.names, distance > self.farthest)

    def write(self, path: str | Path) -> None:
        """Write the model to one file, without its `standing`. Raises `ValueError` for a folder."""
        own = {one.name: getattr(self, one.name) for one in fields(self) if one.name != "standing"}
        for name in ("scale", "known_scale"):
            own[name] = {one.name: getattr(own[name], one.name) for one in fields(Scale)}
        own["reading"] = None if self.reading is None else vars(self.reading)
        write_plain(path, _KIND, _VERSION, own, GESTURE_FILE)

    @classmethod
    def read(cls, path: str | Path) -> "GestureModel":
        """Read a model that `write` wrote, also from the folder of `jeit touch gestures`; nothing in the file is
        executed.

        Raises `FileNotFoundError`, and `ValueError` for files of another kind, and such as hold anything else than
        numbers and estimators of scikit-learn.
        """
        path = Path(path) / GESTURE_FILE if Path(path).is_dir() else Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"'{path}': there is no such file; `jeit touch gestures` makes one.")

        def make(own: dict[str, Any]) -> "GestureModel":
            parts: dict[str, Any] = {name: Scale(**own[name]) for name in ("scale", "known_scale")}
            parts["reading"] = None if own["reading"] is None else Reading(**own["reading"])
            whole: Any = own | parts | {"names": tuple(own["names"]), "notes": tuple(own["notes"])}
            return cls(**whole)

        return read_plain(path, _KIND, _VERSION, "gesture model", make)


def _checked(touches, labels, people) -> tuple[np.ndarray, np.ndarray | None]:
    check_kind("touches", touches, (list, tuple), "a list of touches, such as of find_touches")
    named = np.asarray(labels)
    if named.shape != (len(touches),) or named.dtype.kind not in "UT":
        raise ValueError(f"labels must be the names of {len(touches)} gestures; they are {named.dtype} {named.shape}.")
    given = None if people is None else np.asarray(people)
    if given is not None and given.shape != named.shape:
        raise ValueError(f"people must be {len(touches)}, one for each touch; they have shape {given.shape}.")
    check_labels(named)
    return named.astype(str), given


def check_labels(labels: np.ndarray) -> None:
    """Raise `ValueError` for names (n,) of fewer than two gestures, empty ones, and gestures that are there once."""
    names, count = np.unique(labels, return_counts=True)
    if any(not str(one).strip() for one in names):
        raise ValueError("labels: some are empty; give every touch the name of a gesture.")
    if len(names) < 2:
        raise ValueError("labels: give touches of two gestures, or more.")
    if count.min() < 2:
        raise ValueError(f"labels: there is only one touch of '{names[count.argmin()]}'; give two of each, or more.")


def _nearest(known: np.ndarray, values: np.ndarray) -> Float[np.ndarray, " n"]:
    """Distances from the nearest of the known features (N, k)."""
    from scipy.spatial.distance import cdist

    return in_parts(lambda some: cdist(some, known).min(axis=1), values, _AT_ONCE)


def _farthest(known: Float[np.ndarray, "N k"], folds: Int[np.ndarray, " N"]) -> float:
    """Distance from the nearest other touch that all but a hundredth of held-out touches do not exceed."""
    apart = [_nearest(known[folds != one], known[folds == one]) for one in np.unique(folds)]
    return float(np.quantile(np.concatenate(apart), _LIKE))
