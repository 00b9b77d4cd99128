"""Learn places, forces, labels and keys from the changes of recorded presses, and estimate the error of each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from jeit.touch.learnt import labels as label_methods
from jeit.touch.learnt import numbers as number_methods
from jeit.touch.learnt.folds import time_folds
from jeit.touch.learnt.imaged import Imaged
from jeit.touch.learnt.keys import learn_keys
from jeit.touch.learnt.labels import learn_labels
from jeit.touch.learnt.numbers import LearntNumbers, learn_numbers
from jeit.touch.learnt.presses import Presses

METHODS = tuple(dict.fromkeys((*number_methods.METHODS, *label_methods.METHODS)))


@dataclass(frozen=True)
class Standing:
    """How well a quantity was learnt.

    The `method` chosen, the errors on held-out presses of all that were `tried`, and the chosen method's prediction for
    each press when it was held out; in the units of the quantity.
    """

    method: str
    tried: list[tuple[str, float]]
    held_out: np.ndarray
    right: np.ndarray
    std: np.ndarray | None = None


def learn_answers(
    whole: Float[np.ndarray, "N m"],
    reference: Float[np.ndarray, "N m"] | None,
    presses: Presses,
    method: str,
    imaged: Imaged | None,
    progress,
) -> tuple[dict[str, Any], dict[str, Standing], list[str]]:
    """Learn `place`, `force`, `label` and `keys`, each None if the presses do not have it.

    Returns the models, how well each was learnt, and notes.
    """
    notes, standing = [], {}
    found: dict[str, Any] = dict.fromkeys(("place", "force", "label", "keys"))
    every = np.arange(len(whole))
    if presses.positions is not None:
        rows, folds, remarks = places_and_folds(presses)
        notes += remarks
        places = presses.positions[rows]
        found["place"], standing["place"] = _numbers(whole, reference, places, rows, folds, method, imaged, progress)
    if presses.force is not None:
        known = presses.positions is not None and np.isfinite(presses.positions).all()
        alike = presses.positions if known else presses.force[:, None]
        folds, _ = time_folds(presses.frames, *_when(presses, every), alike=alike)
        force = presses.force[:, None]
        found["force"], standing["force"] = _numbers(whole, reference, force, every, folds, method, imaged, progress)
    if presses.label is not None:
        folds, remarks = time_folds(presses.frames, *_when(presses, every), kinds=presses.label)
        learnt, tried = learn_labels(
            whole,
            reference,
            presses.label,
            folds,
            method=_asked(method, label_methods),
            imaged=imaged,
            progress=progress,
        )
        notes += [*remarks, *learnt.notes]
        found["label"] = learnt
        methods = [(f"{one.method} on {one.form}", one.error) for one in tried]
        standing["label"] = Standing(methods[0][0], methods, learnt.classes[tried[0].held_out], presses.label)
    if presses.touched is not None:
        folds, remarks = time_folds(presses.frames, *_when(presses, every), kinds=presses.touched)
        notes += remarks
        if presses.touched.sum(axis=1).max() < 2:
            notes.append("no two keys were pressed together: what is said of keys pressed together is a guess.")
        found["keys"], tried = learn_keys(whole, reference, presses.touched, folds, progress=progress)
        pairs = zip(tried.methods, tried.errors.tolist(), strict=True)
        methods = [(f"key {key}: {name}", error) for key, (name, error) in enumerate(pairs)]
        standing["keys"] = Standing("for each key its own", methods, tried.held_out, presses.touched)
    return found, standing, notes


def places_and_folds(presses: Presses) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Rows of presses that have a place, their cross-validation folds, and notes."""
    positions = np.asarray(presses.positions)
    rows = np.flatnonzero(~np.isnan(positions).any(axis=1))
    folds, remarks = time_folds(presses.frames[rows], *_when(presses, rows), alike=positions[rows])
    return rows, folds, remarks


def _numbers(whole, reference, targets, rows, folds, method, imaged, progress) -> tuple[LearntNumbers, Standing]:
    """Learn numbers (n, d) from the changes of some rows; returns the model and how well it was learnt."""
    own, asked = None if reference is None else reference[rows], _asked(method, number_methods)
    learnt, tried = learn_numbers(whole[rows], own, targets, folds, method=asked, imaged=imaged, progress=progress)
    methods = [(one.name, one.error) for one in tried]
    said = tried[0].held_out
    return learnt, Standing(methods[0][0], methods, said, targets, learnt.spread.held_out(said, whole[rows]))


def _asked(method: str, methods) -> str:
    return method if method in methods.METHODS else "auto"


def _when(presses: Presses, rows: np.ndarray) -> tuple:
    return tuple(None if values is None else values[rows] for values in (presses.group, presses.time))
