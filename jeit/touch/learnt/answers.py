"""Learn the quantities of recorded presses: folds of held-out presses, and the comparison of methods on them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from jeit.touch.learnt import labels as label_methods
from jeit.touch.learnt import numbers as number_methods
from jeit.touch.learnt.imaged import ImageReconstruction
from jeit.touch.learnt.labels import learn_keys, learn_labels
from jeit.touch.learnt.numbers import LearntNumbers, learn_numbers
from jeit.touch.learnt.presses import Presses

NUM_FOLDS = 5
# Maximum distance of held-out presses from the nearest other press, relative to the same distance for random folds.
_FARTHER = 2.0
# Places count as repeated if the number of different places, divided by the number of presses, is lower than this.
_REPEATED = 0.7


def time_folds(
    frames: np.ndarray,
    group: np.ndarray | None = None,
    time: np.ndarray | None = None,
    *,
    positions: Float[np.ndarray, "N d"] | None = None,
    kinds: np.ndarray | None = None,
    num_folds: int = NUM_FOLDS,
) -> tuple[Int[np.ndarray, " N"], tuple[str, ...]]:
    """Assign each press to the fold (N,) in which it is held out; returns folds and notes.

    Presses, in order of `time` or as recorded, are cut into `num_folds` intervals, one for each fold. If a training set
    would lack places (`positions`, (N, d)) or classes (`kinds`, (N,) or (N, K)), because these were pressed one after
    the other, presses are cut into more and shorter intervals, which are assigned to the folds in turn. Each `group`
    stays in one fold; groups are ordered by their mean time. Presses with the same frame stay in one fold, and if
    places (d > 1) are repeated, so do presses at the same place: otherwise the training set would contain copies of
    held-out presses.
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
        num_folds = min(num_folds, int(unit.max()) + 1)
    elif group is not None:
        notes.append("all presses are of one group: folds are intervals of time.")
    same = np.unique(np.nan_to_num(frames), axis=0, return_inverse=True)[1].ravel()
    copies = count - same.max() - 1
    if copies:
        notes.append(f"{copies} frames are copies of others: kept in one fold with them.")
        unit = _connected_sets(unit, same)
    repeated = False
    if positions is not None and positions.shape[1] > 1 and not grouped:
        places = np.unique(positions, axis=0, return_inverse=True)[1].ravel()
        repeated = num_folds <= places.max() + 1 < _REPEATED * count
        if repeated:
            notes.append(f"{places.max() + 1} places were repeated: held out with all of their presses.")
            unit = _connected_sets(unit, places)
    num_intervals = num_folds
    fold = _assign_to_folds(unit, rank, num_folds, num_intervals)
    while not grouped and num_intervals < count / 4 and not _training_sets_cover(fold, positions, kinds):
        num_intervals *= 2
        fold = _assign_to_folds(unit, rank, num_folds, num_intervals)
    if kinds is not None and kinds.ndim == 1 and not grouped and not _training_sets_cover(fold, None, kinds):
        fold = _assign_by_class(rank, kinds, num_folds)
    if num_intervals > num_folds and not repeated:
        what = "labels or keys were given" if positions is None else "places were pressed"
        notes.append(
            f"{what} one after the other: held out in {num_intervals} short intervals of time; drift between presses "
            "may improve these results."
        )
    return fold, tuple(notes)


def _assign_to_folds(unit: np.ndarray, rank: np.ndarray, num_folds: int, num_intervals: int) -> Int[np.ndarray, " N"]:
    """Assign units of presses to folds: their order is cut into intervals, which are assigned to the folds in turn."""
    sizes = np.bincount(unit)
    by_time = np.argsort(np.bincount(unit, rank) / sizes, kind="stable")
    middles = np.cumsum(sizes[by_time]) - sizes[by_time] / 2
    fold = np.empty(len(sizes), int)
    fold[by_time] = np.minimum((middles * num_intervals / len(unit)).astype(int), num_intervals - 1) % num_folds
    return np.unique(fold, return_inverse=True)[1][unit]


def _assign_by_class(rank: np.ndarray, kinds: np.ndarray, num_folds: int) -> Int[np.ndarray, " N"]:
    """Assign the presses of each class to the folds in turn, for data in which some classes are rare."""
    fold = np.empty(len(kinds), int)
    for kind in np.unique(kinds):
        own = np.flatnonzero(kinds == kind)
        fold[own[np.argsort(rank[own])]] = np.arange(len(own)) % num_folds
    return fold


def _training_sets_cover(fold: np.ndarray, positions: np.ndarray | None, kinds: np.ndarray | None) -> bool:
    """Whether the training set of each fold contains places and classes like those of the held-out presses."""
    if kinds is not None and kinds.ndim == 2:
        return all(_training_sets_cover(fold, None, column) for column in kinds.T)
    if kinds is not None:
        return all(set(kinds[fold == one]) <= set(kinds[fold != one]) for one in np.unique(fold))
    if positions is None:
        return True
    dealt = np.random.default_rng(0).permutation(fold)
    return _largest_distance(positions, fold) <= _FARTHER * _largest_distance(positions, dealt)


def _largest_distance(positions: np.ndarray, fold: np.ndarray) -> float:
    """Mean distance of held-out presses from the nearest other press, in the fold in which it is largest."""
    unit = positions.std(axis=0).max() or 1.0
    return max(
        KDTree(positions[fold != one]).query(positions[fold == one])[0].mean() + 1e-3 * unit for one in np.unique(fold)
    )


def _connected_sets(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Number the connected sets of n elements; elements with equal `first` (n,) or equal `second` (n,) are
    connected."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    offset = first.max() + 1
    size = offset + second.max() + 1
    graph = coo_array((np.ones(len(first)), (first, offset + second)), shape=(size, size))
    return np.unique(connected_components(graph, directed=False)[1][first], return_inverse=True)[1]


METHODS = tuple(dict.fromkeys((*number_methods.METHODS, *label_methods.METHODS)))


@dataclass(frozen=True)
class Standing:
    """Accuracy with which a quantity was learnt, in the units of the quantity.

    **Fields**

    - `method`: the chosen method.
    - `tried`: all methods that were tried, and their errors on held-out presses.
    - `held_out`: predictions of the chosen method for held-out presses.
    - `right`: the true values.
    - `std`: standard deviations of the predictions.

    **Example:**

    ```python
    standing = learnt.standing["place"]
    print(isinstance(standing, Standing), standing.tried)
    ```
    """

    method: str
    tried: list[tuple[str, float]]
    held_out: np.ndarray
    right: np.ndarray
    std: np.ndarray | None = None


def learn_quantities(
    changes: Float[np.ndarray, "N m"],
    reference: Float[np.ndarray, "N m"] | None,
    presses: Presses,
    method: str,
    imaged: ImageReconstruction | None,
    progress,
) -> tuple[dict[str, Any], dict[str, Standing], list[str]]:
    """Learn models of `place`, `force`, `label` and `keys`, each None if the presses lack its quantity.

    Returns the models, their accuracies, and notes.
    """
    notes, standing = [], {}
    found: dict[str, Any] = dict.fromkeys(("place", "force", "label", "keys"))
    every = np.arange(len(changes))
    if presses.positions is not None:
        rows, folds, remarks = places_and_folds(presses)
        notes += remarks
        places = presses.positions[rows]
        found["place"], standing["place"] = _learn_targets(
            changes, reference, places, rows, folds, method, imaged, progress
        )
    if presses.force is not None:
        known = presses.positions is not None and np.isfinite(presses.positions).all()
        alike = presses.positions if known else presses.force[:, None]
        folds, _ = time_folds(presses.frames, *_groups_and_times(presses, every), positions=alike)
        force = presses.force[:, None]
        found["force"], standing["force"] = _learn_targets(
            changes, reference, force, every, folds, method, imaged, progress
        )
    if presses.label is not None:
        folds, remarks = time_folds(presses.frames, *_groups_and_times(presses, every), kinds=presses.label)
        learnt, tried = learn_labels(
            changes,
            reference,
            presses.label,
            folds,
            method=_method_or_auto(method, label_methods),
            imaged=imaged,
            progress=progress,
        )
        notes += [*remarks, *learnt.notes]
        found["label"] = learnt
        methods = [(f"{one.method} on {one.form}", one.error) for one in tried]
        standing["label"] = Standing(methods[0][0], methods, learnt.classes[tried[0].held_out], presses.label)
    if presses.touched is not None:
        folds, remarks = time_folds(presses.frames, *_groups_and_times(presses, every), kinds=presses.touched)
        notes += remarks
        if presses.touched.sum(axis=1).max() < 2:
            notes.append("no two keys were pressed together: what is said of keys pressed together is a guess.")
        found["keys"], tried = learn_keys(changes, reference, presses.touched, folds, progress=progress)
        pairs = zip(tried.methods, tried.errors.tolist(), strict=True)
        methods = [(f"key {key}: {name}", error) for key, (name, error) in enumerate(pairs)]
        standing["keys"] = Standing("for each key its own", methods, tried.held_out, presses.touched)
    return found, standing, notes


def places_and_folds(presses: Presses) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Rows of presses that have a place, their cross-validation folds, and notes."""
    positions = np.asarray(presses.positions)
    rows = np.flatnonzero(~np.isnan(positions).any(axis=1))
    folds, remarks = time_folds(presses.frames[rows], *_groups_and_times(presses, rows), positions=positions[rows])
    return rows, folds, remarks


def _learn_targets(
    changes, reference, targets, rows, folds, method, imaged, progress
) -> tuple[LearntNumbers, Standing]:
    """Learn targets (n, d) from the changes of the given rows; returns the model and its accuracy."""
    own, asked = None if reference is None else reference[rows], _method_or_auto(method, number_methods)
    learnt, tried = learn_numbers(changes[rows], own, targets, folds, method=asked, imaged=imaged, progress=progress)
    methods = [(one.name, one.error) for one in tried]
    said = tried[0].held_out
    return learnt, Standing(methods[0][0], methods, said, targets, learnt.spread.held_out(said, changes[rows]))


def _method_or_auto(method: str, methods) -> str:
    return method if method in methods.METHODS else "auto"


def _groups_and_times(presses: Presses, rows: np.ndarray) -> tuple:
    return tuple(None if values is None else values[rows] for values in (presses.group, presses.time))
