"""Answers of learnt skins: folds of held-out presses, and the methods compared on them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from jeit.touch.learnt import labels as label_methods
from jeit.touch.learnt import numbers as number_methods
from jeit.touch.learnt.imaged import Imaged
from jeit.touch.learnt.labels import learn_keys, learn_labels
from jeit.touch.learnt.numbers import LearntNumbers, learn_numbers
from jeit.touch.learnt.presses import Presses

NUM_FOLDS = 5
# The greatest ratio of the distance of held-out presses from the others' places to that of a random fold.
_FARTHER = 2.0
# Places are repeated if the ratio of their number to that of the presses is lower.
_REPEATED = 0.7


def time_folds(
    frames: np.ndarray,
    group: np.ndarray | None = None,
    time: np.ndarray | None = None,
    *,
    alike: Float[np.ndarray, "N d"] | None = None,
    kinds: np.ndarray | None = None,
    number: int = NUM_FOLDS,
) -> tuple[Int[np.ndarray, " N"], tuple[str, ...]]:
    """Assign each press to the fold (N,) in which it is held out; returns folds and notes.

    Presses in order of `time`, or as recorded, are cut into `number` intervals. If these leave out places (`alike`,
    numbers (N, d)) or `kinds` (N,) or (N, K) altogether, as when one was pressed after the other, presses are cut into
    more and shorter intervals, which are assigned to the folds in turn. With a `group`, groups are taken in order of
    their mean time. Presses with the same frame, and at the same place (d > 1), are in one fold: otherwise the answer
    of one would be known from the other, as is never the case for presses between places.
    """
    count = len(frames)
    order = np.arange(count) if time is None else np.argsort(time, kind="stable")
    rank = np.empty(count, int)
    rank[order] = np.arange(count)
    notes = []
    unit = np.arange(count)
    groups = unit if group is None else np.unique(group, return_inverse=True)[1]
    grouped = group is not None and groups.max() > 0
    if grouped:
        unit = groups
        number = min(number, int(unit.max()) + 1)
    elif group is not None:
        notes.append("all presses are of one group: folds are stretches of time.")
    same = np.unique(np.nan_to_num(frames), axis=0, return_inverse=True)[1].ravel()
    copies = count - same.max() - 1
    if copies:
        notes.append(f"{copies} frames are copies of others: kept in one fold with them.")
        unit = _joined(unit, same)
    repeated = False
    if alike is not None and alike.shape[1] > 1 and not grouped:
        places = np.unique(alike, axis=0, return_inverse=True)[1].ravel()
        repeated = number <= places.max() + 1 < _REPEATED * count
        if repeated:
            notes.append(f"{places.max() + 1} places were repeated: held out with all of their presses.")
            unit = _joined(unit, places)
    stretches = number
    fold = _dealt(unit, rank, number, stretches)
    while not grouped and stretches < count / 4 and not _covered(fold, alike, kinds):
        stretches *= 2
        fold = _dealt(unit, rank, number, stretches)
    if kinds is not None and kinds.ndim == 1 and not grouped and not _covered(fold, None, kinds):
        fold = _dealt_by_kind(rank, kinds, number)
    if stretches > number and not repeated:
        what = "labels or keys were given" if alike is None else "places were pressed"
        notes.append(
            f"{what} one after the other: held out in {stretches} short stretches of time, in which drift may pass for "
            "what was learnt."
        )
    return fold, tuple(notes)


def _dealt(unit: np.ndarray, rank: np.ndarray, number: int, stretches: int) -> Int[np.ndarray, " N"]:
    """Assign units of presses to folds: intervals of their order, in turn."""
    sizes = np.bincount(unit)
    by_time = np.argsort(np.bincount(unit, rank) / sizes, kind="stable")
    middles = np.cumsum(sizes[by_time]) - sizes[by_time] / 2
    fold = np.empty(len(sizes), int)
    fold[by_time] = np.minimum((middles * stretches / len(unit)).astype(int), stretches - 1) % number
    return np.unique(fold, return_inverse=True)[1][unit]


def _dealt_by_kind(rank: np.ndarray, kinds: np.ndarray, number: int) -> Int[np.ndarray, " N"]:
    """Assign presses of each kind to folds in turn, where some kinds are rare."""
    fold = np.empty(len(kinds), int)
    for kind in np.unique(kinds):
        own = np.flatnonzero(kinds == kind)
        fold[own[np.argsort(rank[own])]] = np.arange(len(own)) % number
    return fold


def _covered(fold: np.ndarray, alike: np.ndarray | None, kinds: np.ndarray | None) -> bool:
    """Whether held-out presses are similar to those in the training set."""
    if kinds is not None and kinds.ndim == 2:
        return all(_covered(fold, None, column) for column in kinds.T)
    if kinds is not None:
        return all(set(kinds[fold == one]) <= set(kinds[fold != one]) for one in np.unique(fold))
    if alike is None:
        return True
    dealt = np.random.default_rng(0).permutation(fold)
    return _farthest(alike, fold) <= _FARTHER * _farthest(alike, dealt)


def _farthest(alike: np.ndarray, fold: np.ndarray) -> float:
    """Mean distance of held-out presses from the others, in the fold where it is greatest."""
    unit = alike.std(axis=0).max() or 1.0
    return max(KDTree(alike[fold != one]).query(alike[fold == one])[0].mean() + 1e-3 * unit for one in np.unique(fold))


def _joined(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Number the connected sets, where two elements are connected if they share either number."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    first = one.max() + 1
    size = first + other.max() + 1
    graph = coo_array((np.ones(len(one)), (one, first + other)), shape=(size, size))
    return np.unique(connected_components(graph, directed=False)[1][one], return_inverse=True)[1]


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
