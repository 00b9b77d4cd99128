"""Learn places, forces, labels and keys from recorded presses, and compare methods by cross-validation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from jeit.touch.learnt import labels as label_methods
from jeit.touch.learnt import regression
from jeit.touch.learnt.features import ImageReconstruction
from jeit.touch.learnt.labels import learn_keys, learn_labels
from jeit.touch.learnt.recorded_presses import Presses
from jeit.touch.learnt.regression import LearntNumbers, learn_numbers

NUM_FOLDS = 5
# Maximum mean distance of the held-out presses of a fold from the nearest press of another fold, relative to the same
# distance for random folds.
_MAX_DISTANCE_RATIO = 2.0
# Places count as repeated if the number of different places, divided by the number of presses, is lower than this.
_MAX_UNIQUE_SHARE = 0.7


def time_folds(
    frames: np.ndarray,
    group: np.ndarray | None = None,
    time: np.ndarray | None = None,
    *,
    positions: Float[np.ndarray, "N d"] | None = None,
    kinds: np.ndarray | None = None,
    num_folds: int = NUM_FOLDS,
) -> tuple[Int[np.ndarray, " N"], tuple[str, ...]]:
    """Assign presses to folds for cross-validation; returns the fold of each press, and notes on the assignment as
    text.

    The presses, ordered by `time` or else as recorded, are cut into `num_folds` intervals of time, one for each fold.
    The training set of a fold may lack places (`positions`) or classes (`kinds`: one class for each press, or true and
    false for each key) if these were pressed one after the other. In this case, the presses are cut into more and
    shorter intervals, which are assigned to the folds in turn. All presses of a `group` are in one fold; groups are
    ordered by their mean time. Presses with equal frames are in one fold. If places of two or three coordinates are
    repeated, presses at the same place are also in one fold. Otherwise, the training set would contain copies of
    held-out presses.
    """
    num_presses = len(frames)
    time_order = np.arange(num_presses) if time is None else np.argsort(time, kind="stable")
    rank = np.empty(num_presses, int)
    rank[time_order] = np.arange(num_presses)
    notes = []
    unit = np.arange(num_presses)
    groups = unit if group is None else np.unique(group, return_inverse=True)[1]
    is_grouped = group is not None and groups.max() > 0
    if is_grouped:
        unit = groups
        num_folds = min(num_folds, int(unit.max()) + 1)
    elif group is not None:
        notes.append("all presses are of one group: folds are intervals of time.")
    frame_indices = np.unique(np.nan_to_num(frames), axis=0, return_inverse=True)[1].ravel()
    num_repeated_frames = num_presses - frame_indices.max() - 1
    if num_repeated_frames:
        notes.append(f"{num_repeated_frames} frames are copies of others: kept in one fold with them.")
        unit = _number_connected_sets(unit, frame_indices)
    has_repeated_places = False
    if positions is not None and positions.shape[1] > 1 and not is_grouped:
        place_indices = np.unique(positions, axis=0, return_inverse=True)[1].ravel()
        has_repeated_places = num_folds <= place_indices.max() + 1 < _MAX_UNIQUE_SHARE * num_presses
        if has_repeated_places:
            notes.append(f"{place_indices.max() + 1} places were repeated: held out with all of their presses.")
            unit = _number_connected_sets(unit, place_indices)
    num_intervals = num_folds
    fold = _assign_to_folds(unit, rank, num_folds, num_intervals)
    while not is_grouped and num_intervals < num_presses / 4 and not _training_sets_cover(fold, positions, kinds):
        num_intervals *= 2
        fold = _assign_to_folds(unit, rank, num_folds, num_intervals)
    if kinds is not None and kinds.ndim == 1 and not is_grouped and not _training_sets_cover(fold, None, kinds):
        fold = _assign_by_class(rank, kinds, num_folds)
    if num_intervals > num_folds and not has_repeated_places:
        description = "labels or keys were given" if positions is None else "places were pressed"
        notes.append(
            f"{description} one after the other: held out in {num_intervals} short intervals of time; drift between "
            "presses may improve these results."
        )
    return fold, tuple(notes)


def _assign_to_folds(unit: np.ndarray, rank: np.ndarray, num_folds: int, num_intervals: int) -> Int[np.ndarray, " N"]:
    """Assign presses to folds: `num_intervals` intervals of presses, in order of their `rank` in time, are assigned to
    the folds in turn; presses with the same `unit` are in one fold."""
    sizes = np.bincount(unit)
    order_of_units = np.argsort(np.bincount(unit, rank) / sizes, kind="stable")
    middle_positions = np.cumsum(sizes[order_of_units]) - sizes[order_of_units] / 2
    fold_of_unit = np.empty(len(sizes), int)
    fold_of_unit[order_of_units] = (
        np.minimum((middle_positions * num_intervals / len(unit)).astype(int), num_intervals - 1) % num_folds
    )
    return np.unique(fold_of_unit, return_inverse=True)[1][unit]


def _assign_by_class(rank: np.ndarray, kinds: np.ndarray, num_folds: int) -> Int[np.ndarray, " N"]:
    """Assign the presses of each class in `kinds` to the folds in turn, for data in which some classes are rare."""
    fold = np.empty(len(kinds), int)
    for kind in np.unique(kinds):
        rows_of_class = np.flatnonzero(kinds == kind)
        fold[rows_of_class[np.argsort(rank[rows_of_class])]] = np.arange(len(rows_of_class)) % num_folds
    return fold


def _training_sets_cover(fold_of_press: np.ndarray, positions: np.ndarray | None, kinds: np.ndarray | None) -> bool:
    """Whether each fold's training set contains the classes of the held-out presses, or places near theirs."""
    if kinds is not None and kinds.ndim == 2:
        return all(_training_sets_cover(fold_of_press, None, column) for column in kinds.T)
    if kinds is not None:
        return all(
            set(kinds[fold_of_press == fold_index]) <= set(kinds[fold_of_press != fold_index])
            for fold_index in np.unique(fold_of_press)
        )
    if positions is None:
        return True
    random_folds = np.random.default_rng(0).permutation(fold_of_press)
    return _largest_distance(positions, fold_of_press) <= _MAX_DISTANCE_RATIO * _largest_distance(
        positions, random_folds
    )


def _largest_distance(positions: np.ndarray, fold_of_press: np.ndarray) -> float:
    """Compute, for each fold, the mean distance of its presses from the nearest press of the other folds; returns the
    maximum over the folds."""
    unit = positions.std(axis=0).max() or 1.0
    return max(
        KDTree(positions[fold_of_press != fold_index]).query(positions[fold_of_press == fold_index])[0].mean()
        + 1e-3 * unit
        for fold_index in np.unique(fold_of_press)
    )


def _number_connected_sets(first_labels: np.ndarray, second_labels: np.ndarray) -> np.ndarray:
    """Number the connected sets of elements; two elements are connected if they have the same number in `first_labels`
    or in `second_labels`."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    offset = first_labels.max() + 1
    size = offset + second_labels.max() + 1
    graph = coo_array((np.ones(len(first_labels)), (first_labels, offset + second_labels)), shape=(size, size))
    return np.unique(connected_components(graph, directed=False)[1][first_labels], return_inverse=True)[1]


METHODS = tuple(dict.fromkeys((*regression.METHODS, *label_methods.METHODS)))


@dataclass(frozen=True)
class Standing:
    """Accuracy of a learnt model of one quantity on held-out presses, in the unit of the quantity.

    **Fields**

    - `method`: name of the chosen learning method.
    - `tried`: names of all methods that were tried, and their errors on held-out presses.
    - `held_out`: predictions of the chosen method for held-out presses.
    - `right`: the true values of the quantity for these presses.
    - `std`: estimated standard deviations of these predictions, or None.

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
    """Learn models that predict the `place`, `force`, `label` and `keys` of presses; a model is None if the presses
    lack its quantity.

    Returns the models and the accuracies for held-out presses, both by the names of the quantities, and notes on the
    data for the user.
    """
    notes, standing = [], {}
    models: dict[str, Any] = dict.fromkeys(("place", "force", "label", "keys"))
    row_indices = np.arange(len(changes))
    if presses.positions is not None:
        rows, folds, fold_notes = places_and_folds(presses)
        notes += fold_notes
        places = presses.positions[rows]
        models["place"], standing["place"] = _learn_targets(
            changes, reference, places, rows, folds, method, imaged, progress
        )
    if presses.force is not None:
        has_all_places = presses.positions is not None and np.isfinite(presses.positions).all()
        grouping_values = presses.positions if has_all_places else presses.force[:, None]
        folds, _ = time_folds(presses.frames, *_groups_and_times(presses, row_indices), positions=grouping_values)
        force = presses.force[:, None]
        models["force"], standing["force"] = _learn_targets(
            changes, reference, force, row_indices, folds, method, imaged, progress
        )
    if presses.label is not None:
        folds, fold_notes = time_folds(presses.frames, *_groups_and_times(presses, row_indices), kinds=presses.label)
        learnt, results = learn_labels(
            changes,
            reference,
            presses.label,
            folds,
            method=_method_or_auto(method, label_methods),
            imaged=imaged,
            progress=progress,
        )
        notes += [*fold_notes, *learnt.notes]
        models["label"] = learnt
        methods = [(f"{result.method} on {result.form}", result.error) for result in results]
        standing["label"] = Standing(methods[0][0], methods, learnt.classes[results[0].held_out], presses.label)
    if presses.touched is not None:
        folds, fold_notes = time_folds(presses.frames, *_groups_and_times(presses, row_indices), kinds=presses.touched)
        notes += fold_notes
        if presses.touched.sum(axis=1).max() < 2:
            notes.append("no two keys were pressed together: predictions of keys pressed together are unreliable.")
        models["keys"], results = learn_keys(changes, reference, presses.touched, folds, progress=progress)
        pairs = zip(results.methods, results.errors.tolist(), strict=True)
        methods = [(f"key {key}: {name}", error) for key, (name, error) in enumerate(pairs)]
        standing["keys"] = Standing("for each key its own", methods, results.held_out, presses.touched)
    return models, standing, notes


def places_and_folds(presses: Presses) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Return the indices of the presses that have a place, their cross-validation folds, and notes on the folds as
    text."""
    positions = np.asarray(presses.positions)
    rows = np.flatnonzero(~np.isnan(positions).any(axis=1))
    folds, fold_notes = time_folds(presses.frames[rows], *_groups_and_times(presses, rows), positions=positions[rows])
    return rows, folds, fold_notes


def _learn_targets(
    changes, reference, targets, rows, folds, method, imaged, progress
) -> tuple[LearntNumbers, Standing]:
    """Learn places or forces, the targets, from the voltage changes of presses; returns the model and its accuracy."""
    selected_reference, number_method = (
        None if reference is None else reference[rows],
        _method_or_auto(method, regression),
    )
    learnt, results = learn_numbers(
        changes[rows], selected_reference, targets, folds, method=number_method, imaged=imaged, progress=progress
    )
    methods = [(result.name, result.error) for result in results]
    predictions = results[0].held_out
    return learnt, Standing(
        methods[0][0], methods, predictions, targets, learnt.spread.held_out(predictions, changes[rows])
    )


def _method_or_auto(method: str, methods) -> str:
    return method if method in methods.METHODS else "auto"


def _groups_and_times(presses: Presses, rows: np.ndarray) -> tuple:
    return tuple(None if values is None else values[rows] for values in (presses.group, presses.time))
