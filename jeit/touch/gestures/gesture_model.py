"""`GestureModel`: a gesture classifier, its features, and a description of the frames that it was trained on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, check_name, describe, is_number
from jeit.arguments.extras import require_extra
from jeit.touch.gestures.features import course_features
from jeit.touch.gestures.gesture_classifiers import (
    FEATURE_FORMS,
    GESTURE_CLASSIFIERS,
    Scale,
    feature_forms,
    held_out_odds,
    person_folds,
    random_folds,
)
from jeit.touch.gestures.segmentation import StreamTouch
from jeit.touch.learnt.learn_from_presses import Standing
from jeit.touch.learnt.methods import fit_sharpness, log_odds, probabilities
from jeit.touch.learnt.resource_limits import apply_in_parts
from jeit.touch.learnt.skin_file import read_fields, write_fields

# Minimum ratio of the conductivities of two skins that are considered different, or to have different units.
_MIN_CONDUCTIVITY_RATIO = 5.0


@dataclass(frozen=True)
class Reading:
    """How the frames that a gesture model was trained on were acquired.

    **Fields**: `level`: change of conductivity that a touch exceeds, S; `background`: conductivity of the untouched
    skin, S; `sign`: 1 if a touch raises the conductivity, −1 if it lowers it; `rate`: frame rate, frames/s;
    `num_channels`: number of channels of a frame; `protocol`: name of the drive and measurement protocol.
    """

    level: float
    background: float
    sign: int
    rate: float
    num_channels: int
    protocol: str

    def __post_init__(self):
        """Check the fields.

        Raises `ValueError` if `level`, `background` or `rate` is not positive, `sign` is neither 1 nor −1, or
        `num_channels` is not a positive integer.
        """
        for name in ("level", "background", "rate"):
            if not (is_number(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} must be positive; it is {describe(getattr(self, name))}.")
        if self.sign not in (-1, 1):
            raise ValueError(f"sign must be 1 or -1; it is {describe(self.sign)}.")
        if not (isinstance(self.num_channels, int) and self.num_channels > 0):
            raise ValueError(f"num_channels must be a positive number; it is {describe(self.num_channels)}.")

    def check_same_skin(self, num_channels: int, protocol: str, background: float) -> None:
        """Check that frames are from a skin like the one on which gestures were learnt.

        Raises `ValueError` if the number of channels or the protocol differs, or if the untouched skin's conductivity
        `background`, S, differs by a factor of 5 or more.
        """
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
        conductivity_ratio = background / self.background
        if not 1 / _MIN_CONDUCTIVITY_RATIO < conductivity_ratio < _MIN_CONDUCTIVITY_RATIO:
            raise ValueError(
                f"the untouched skin has {conductivity_ratio:.3g} times the conductivity of that which gestures "
                "were learnt on: is "
                "it the same, and are voltages in the unit and at the current that its description says?"
            )


METHODS = ("auto", *GESTURE_CLASSIFIERS)
# Maximum number of folds of the cross-validation of classifiers.
_MAX_FOLDS = 10
# Fraction of held-out touches that are accepted as similar to the training set.
_KNOWN_DISTANCE_QUANTILE = 0.99
# Number of touches whose distances from the training set are computed at once.
_NUM_CHUNK_ROWS = 1000
GESTURE_FILE = "gestures.skops"
"""Name of the model's file in the output folder of `jeit touch gestures`."""
_FILE_KIND, _FILE_VERSION = "a jeit gesture model", 3


@dataclass(frozen=True)
class Gestures:
    """Predicted gestures of n touches.

    **Fields**: `gesture` (n,): most probable gesture of each touch; `probability` (n,): probability of this gesture;
    `probabilities` (n, C): probabilities of all C gestures; `names`: names of the C gestures; `unlike` (n,): whether
    the touch is unlike all touches of the training set, so that its prediction is not valid.
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
    """Classifier that predicts the gesture of a touch, such as "stroke".

    **Fields**: `names` (C,): names of the gestures; `method`: name of the classifier; `form`: name of its features,
    "seven" (`touch_features`), "course" (also features of the time course) or "sequence" (also the sampled time
    course); `scale`: transform of the features; `model`: fitted classifier; `sharpness`: factor by which the
    classifier's log-odds are multiplied before they become probabilities; `known` (N, k): scaled course features of the
    N touches of the training set; `known_scale`: transform of these features; `farthest`: distance from the nearest
    touch of the training set beyond which a touch is unlike all of the set; `reading`: how the frames were acquired,
    None if unknown; `standing`: predictions for held-out touches, and error rates of all classifiers tried, best first,
    None if the model was read from a file; `notes`: remarks on the training.

    **Example:**

    ```python
    gestures = GestureModel.fit(touches, made.gesture, method="linear-svm", form="seven")
    print(gestures.predict(touches).gesture)
    ```
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
        """Fit a classifier to touches and their `labels` (n,), the names of gestures.

        `people` (n,): names or numbers of the people who touched the skin. `method`: one of `METHODS`; `form`: "seven",
        "course", "sequence" (only for `method` "temporal-network") or "auto". "auto" selects the classifier and
        features that are most accurate on held-out people. Each person is held out in turn, or a tenth of the people if
        there are more than ten. Without `people`, or with only one person, touches are held out at random, which does
        not measure the accuracy for other people. `reading` and `notes` are stored in the model. `progress` is called
        with the names of each classifier and its features, before they are tried. Raises `ValueError` if the numbers of
        labels, people and touches differ, for empty labels, fewer than two gestures, gestures with fewer than two
        touches, and unknown names of methods and forms; `ImportError` without the extra `learn`.
        """
        require_extra("learn", "learning gestures")
        check_name("method", method, METHODS)
        check_name("form", form, ("auto", *FEATURE_FORMS))
        label_array, people_array = _check_labels_and_people(touches, labels, people)
        names, class_indices = np.unique(label_array, return_inverse=True)
        model_notes = list(notes)
        if people_array is not None and len(np.unique(people_array)) > 1:
            touch_folds = person_folds(people_array, _MAX_FOLDS)
        else:
            touch_folds = random_folds(class_indices, _MAX_FOLDS)
            model_notes.append("one person, or nobody, is named: chosen on touches held out at random, not on people.")
        candidate_results = []
        for feature_form in FEATURE_FORMS:
            feature_values = FEATURE_FORMS[feature_form](touches).values
            for name in GESTURE_CLASSIFIERS:
                if (
                    method not in ("auto", name)
                    or form not in ("auto", feature_form)
                    or feature_form not in feature_forms(name)
                ):
                    continue
                if progress is not None:
                    progress(f"{name} on {feature_form}")
                held_out_log_odds = held_out_odds(name, feature_values, class_indices, touch_folds)
                candidate_results.append(
                    (
                        float(np.mean(held_out_log_odds.argmax(axis=1) != class_indices)),
                        name,
                        feature_form,
                        held_out_log_odds,
                    )
                )
        if not candidate_results:
            raise ValueError(f"form: '{method}' takes {' or '.join(feature_forms(method))}; '{form}' was requested.")
        candidate_results.sort(key=lambda candidate_result: candidate_result[0])
        _, chosen_method, feature_form, held_out_log_odds = candidate_results[0]
        feature_values, course_values = FEATURE_FORMS[feature_form](touches).values, course_features(touches).values
        method_errors = [
            (f"{name} on {feature_form}", error_rate) for error_rate, name, feature_form, _ in candidate_results
        ]
        feature_scale, known_scale = Scale.from_features(feature_values), Scale.from_features(course_values)
        scaled_courses = known_scale(course_values)
        return cls(
            names=tuple(str(name) for name in names),
            method=chosen_method,
            form=feature_form,
            scale=feature_scale,
            model=GESTURE_CLASSIFIERS[chosen_method](feature_scale(feature_values), class_indices),
            sharpness=fit_sharpness(held_out_log_odds, class_indices),
            known=scaled_courses,
            known_scale=known_scale,
            farthest=_max_held_out_distance(scaled_courses, touch_folds),
            reading=reading,
            standing=Standing(method_errors[0][0], method_errors, names[held_out_log_odds.argmax(axis=1)], label_array),
            notes=tuple(model_notes),
        )

    def predict(self, touches: list[StreamTouch]) -> Gestures:
        """Predict the gestures of touches.

        Predictions are less certain for touches that are cut off, because only a part of the touch is known. Raises
        `ValueError` if `touches` is not a list of touches.
        """
        feature_values = FEATURE_FORMS[self.form](touches).values
        if not len(feature_values):
            no_values = np.empty(0)
            return Gestures(
                no_values.astype(str),
                no_values,
                np.empty((0, len(self.names))),
                self.names,
                no_values.astype(bool),
            )
        class_log_odds = np.full((len(feature_values), len(self.names)), -1e3)
        class_log_odds[:, self.model.classes_] = log_odds(self.model, self.scale(feature_values))
        class_probabilities = probabilities(class_log_odds, self.sharpness)
        distances_from_known = _nearest_distance(self.known, self.known_scale(course_features(touches).values))
        gestures = np.array(self.names)[class_probabilities.argmax(axis=1)]
        return Gestures(
            gestures,
            class_probabilities.max(axis=1),
            class_probabilities,
            self.names,
            distances_from_known > self.farthest,
        )

    def write(self, path: str | Path) -> None:
        """Write the model, without its `standing`, to one file. Raises `ValueError` if `path` is a folder."""
        field_values = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "standing"}
        for name in ("scale", "known_scale"):
            field_values[name] = {field.name: getattr(field_values[name], field.name) for field in fields(Scale)}
        field_values["reading"] = None if self.reading is None else vars(self.reading)
        write_fields(path, _FILE_KIND, _FILE_VERSION, field_values, GESTURE_FILE)

    @classmethod
    def read(cls, path: str | Path) -> "GestureModel":
        """Read a model from a file written by `write`, or from the output folder of `jeit touch gestures`.

        Nothing in the file is executed. Raises `FileNotFoundError` without a file, and `ValueError` if the file is not
        of a gesture model, or contains anything but numbers and estimators of scikit-learn.
        """
        path = Path(path) / GESTURE_FILE if Path(path).is_dir() else Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"'{path}': there is no such file; `jeit touch gestures` makes one.")

        def make_model(field_values: dict[str, Any]) -> "GestureModel":
            converted_values: dict[str, Any] = {name: Scale(**field_values[name]) for name in ("scale", "known_scale")}
            converted_values["reading"] = (
                None if field_values["reading"] is None else Reading(**field_values["reading"])
            )
            all_values: Any = (
                field_values
                | converted_values
                | {"names": tuple(field_values["names"]), "notes": tuple(field_values["notes"])}
            )
            return cls(**all_values)

        return read_fields(path, _FILE_KIND, _FILE_VERSION, "gesture model", make_model)


def _check_labels_and_people(touches, labels, people) -> tuple[np.ndarray, np.ndarray | None]:
    """Convert the labels and people of touches to arrays (n,). Raises `ValueError` if they do not match the touches."""
    check_kind("touches", touches, (list, tuple), "a list of touches, such as of find_touches")
    label_array = np.asarray(labels)
    if label_array.shape != (len(touches),) or label_array.dtype.kind not in "UT":
        raise ValueError(
            f"labels must be the names of {len(touches)} gestures; they are {label_array.dtype} {label_array.shape}."
        )
    people_array = None if people is None else np.asarray(people)
    if people_array is not None and people_array.shape != label_array.shape:
        raise ValueError(f"people must be {len(touches)}, one for each touch; they have shape {people_array.shape}.")
    check_labels(label_array)
    return label_array.astype(str), people_array


def check_labels(labels: np.ndarray) -> None:
    """Check the names (n,) of gestures.

    Raises `ValueError` if a name is empty, if there are fewer than two gestures, or if a gesture occurs only once.
    """
    gesture_names, touch_counts = np.unique(labels, return_counts=True)
    if any(not str(name).strip() for name in gesture_names):
        raise ValueError("labels: some are empty; give every touch the name of a gesture.")
    if len(gesture_names) < 2:
        raise ValueError("labels: give touches of two gestures, or more.")
    if touch_counts.min() < 2:
        raise ValueError(
            f"labels: there is only one touch of '{gesture_names[touch_counts.argmin()]}'; give two of each, or more."
        )


def _nearest_distance(training_features: np.ndarray, features: np.ndarray) -> Float[np.ndarray, " n"]:
    """Compute the distance (n,) of each row of `features` (n, k) from the nearest row of `training_features` (N, k)."""
    from scipy.spatial.distance import cdist

    return apply_in_parts(
        lambda feature_rows: cdist(feature_rows, training_features).min(axis=1), features, _NUM_CHUNK_ROWS
    )


def _max_held_out_distance(training_features: Float[np.ndarray, "N k"], folds: Int[np.ndarray, " N"]) -> float:
    """Compute the 99 % quantile of the distance of a fold's touches from the nearest touch of the other folds."""
    held_out_distances = [
        _nearest_distance(training_features[folds != fold_index], training_features[folds == fold_index])
        for fold_index in np.unique(folds)
    ]
    return float(np.quantile(np.concatenate(held_out_distances), _KNOWN_DISTANCE_QUANTILE))
