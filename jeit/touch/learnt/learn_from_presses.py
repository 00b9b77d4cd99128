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
    time_ranks = np.empty(num_presses, int)
    time_ranks[time_order] = np.arange(num_presses)
    notes = []
    unit_of_press = np.arange(num_presses)
    group_indices = unit_of_press if group is None else np.unique(group, return_inverse=True)[1]
    is_grouped = group is not None and group_indices.max() > 0
    if is_grouped:
        unit_of_press = group_indices
        num_folds = min(num_folds, int(unit_of_press.max()) + 1)
    elif group is not None:
        notes.append("all presses are of one group: folds are intervals of time.")
    frame_indices = np.unique(np.nan_to_num(frames), axis=0, return_inverse=True)[1].ravel()
    num_repeated_frames = num_presses - frame_indices.max() - 1
    if num_repeated_frames:
        notes.append(f"{num_repeated_frames} frames are copies of others: kept in one fold with them.")
        unit_of_press = _number_connected_sets(unit_of_press, frame_indices)
    has_repeated_places = False
    if positions is not None and positions.shape[1] > 1 and not is_grouped:
        place_indices = np.unique(positions, axis=0, return_inverse=True)[1].ravel()
        has_repeated_places = num_folds <= place_indices.max() + 1 < _MAX_UNIQUE_SHARE * num_presses
        if has_repeated_places:
            notes.append(f"{place_indices.max() + 1} places were repeated: held out with all of their presses.")
            unit_of_press = _number_connected_sets(unit_of_press, place_indices)
    num_intervals = num_folds
    fold_of_press = _assign_to_folds(unit_of_press, time_ranks, num_folds, num_intervals)
    while (
        not is_grouped and num_intervals < num_presses / 4 and not _training_sets_cover(fold_of_press, positions, kinds)
    ):
        num_intervals *= 2
        fold_of_press = _assign_to_folds(unit_of_press, time_ranks, num_folds, num_intervals)
    if (
        kinds is not None
        and kinds.ndim == 1
        and not is_grouped
        and not _training_sets_cover(fold_of_press, None, kinds)
    ):
        fold_of_press = _assign_by_class(time_ranks, kinds, num_folds)
    if num_intervals > num_folds and not has_repeated_places:
        target_text = "labels or keys were given" if positions is None else "places were pressed"
        notes.append(
            f"{target_text} one after the other: held out in {num_intervals} short intervals of time; drift between "
            "presses may improve these results."
        )
    return fold_of_press, tuple(notes)


def _assign_to_folds(
    unit_of_press: np.ndarray, time_ranks: np.ndarray, num_folds: int, num_intervals: int
) -> Int[np.ndarray, " N"]:
    """Assign presses to folds: `num_intervals` intervals of presses, in order of their `time_ranks`, are
    assigned to the folds in turn; presses with the same `unit_of_press` are in one fold."""
    unit_sizes = np.bincount(unit_of_press)
    order_of_units = np.argsort(np.bincount(unit_of_press, time_ranks) / unit_sizes, kind="stable")
    middle_positions = np.cumsum(unit_sizes[order_of_units]) - unit_sizes[order_of_units] / 2
    fold_of_unit = np.empty(len(unit_sizes), int)
    fold_of_unit[order_of_units] = (
        np.minimum((middle_positions * num_intervals / len(unit_of_press)).astype(int), num_intervals - 1) % num_folds
    )
    return np.unique(fold_of_unit, return_inverse=True)[1][unit_of_press]


def _assign_by_class(time_ranks: np.ndarray, press_classes: np.ndarray, num_folds: int) -> Int[np.ndarray, " N"]:
    """Assign the presses of each class in `press_classes` to the folds in turn, for data in which some are rare."""
    fold_of_press = np.empty(len(press_classes), int)
    for press_class in np.unique(press_classes):
        rows_of_class = np.flatnonzero(press_classes == press_class)
        fold_of_press[rows_of_class[np.argsort(time_ranks[rows_of_class])]] = np.arange(len(rows_of_class)) % num_folds
    return fold_of_press


def _training_sets_cover(
    fold_of_press: np.ndarray, positions: np.ndarray | None, press_classes: np.ndarray | None
) -> bool:
    """Whether each fold's training set contains the classes of the held-out presses, or places near theirs."""
    if press_classes is not None and press_classes.ndim == 2:
        return all(_training_sets_cover(fold_of_press, None, key_column) for key_column in press_classes.T)
    if press_classes is not None:
        return all(
            set(press_classes[fold_of_press == fold_index]) <= set(press_classes[fold_of_press != fold_index])
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
    length_unit = positions.std(axis=0).max() or 1.0
    return max(
        KDTree(positions[fold_of_press != fold_index]).query(positions[fold_of_press == fold_index])[0].mean()
        + 1e-3 * length_unit
        for fold_index in np.unique(fold_of_press)
    )


def _number_connected_sets(first_labels: np.ndarray, second_labels: np.ndarray) -> np.ndarray:
    """Number the connected sets of elements; two elements are connected if they have the same number in `first_labels`
    or in `second_labels`."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    second_offset = first_labels.max() + 1
    num_graph_nodes = second_offset + second_labels.max() + 1
    label_graph = coo_array(
        (np.ones(len(first_labels)), (first_labels, second_offset + second_labels)),
        shape=(num_graph_nodes, num_graph_nodes),
    )
    return np.unique(connected_components(label_graph, directed=False)[1][first_labels], return_inverse=True)[1]


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
    """Learn models that predict the `place`, `force`, `label` and `keys` of presses; a model is None if the
    presses lack its quantity.

    Returns the models and the accuracies for held-out presses, both by the names of the quantities, and notes on the
    data for the user.
    """
    notes, standings = [], {}
    models: dict[str, Any] = dict.fromkeys(("place", "force", "label", "keys"))
    row_indices = np.arange(len(changes))
    if presses.positions is not None:
        placed_presses, folds, fold_notes = places_and_folds(presses)
        notes += fold_notes
        places = presses.positions[placed_presses]
        models["place"], standings["place"] = _learn_targets(
            changes, reference, places, placed_presses, folds, method, imaged, progress
        )
    if presses.force is not None:
        has_all_places = presses.positions is not None and np.isfinite(presses.positions).all()
        grouping_values = presses.positions if has_all_places else presses.force[:, None]
        folds, _ = time_folds(presses.frames, *_groups_and_times(presses, row_indices), positions=grouping_values)
        press_forces = presses.force[:, None]
        models["force"], standings["force"] = _learn_targets(
            changes, reference, press_forces, row_indices, folds, method, imaged, progress
        )
    if presses.label is not None:
        folds, fold_notes = time_folds(presses.frames, *_groups_and_times(presses, row_indices), kinds=presses.label)
        learnt_labels, method_results = learn_labels(
            changes,
            reference,
            presses.label,
            folds,
            method=_method_or_auto(method, label_methods),
            imaged=imaged,
            progress=progress,
        )
        notes += [*fold_notes, *learnt_labels.notes]
        models["label"] = learnt_labels
        method_errors = [
            (f"{method_result.method} on {method_result.form}", method_result.error) for method_result in method_results
        ]
        standings["label"] = Standing(
            method_errors[0][0], method_errors, learnt_labels.classes[method_results[0].held_out], presses.label
        )
    if presses.touched is not None:
        folds, fold_notes = time_folds(presses.frames, *_groups_and_times(presses, row_indices), kinds=presses.touched)
        notes += fold_notes
        if presses.touched.sum(axis=1).max() < 2:
            notes.append("no two keys were pressed together: predictions of keys pressed together are unreliable.")
        models["keys"], method_results = learn_keys(changes, reference, presses.touched, folds, progress=progress)
        key_methods = zip(method_results.methods, method_results.errors.tolist(), strict=True)
        method_errors = [
            (f"key {key_index}: {method_name}", error_rate)
            for key_index, (method_name, error_rate) in enumerate(key_methods)
        ]
        standings["keys"] = Standing("for each key its own", method_errors, method_results.held_out, presses.touched)
    return models, standings, notes


def places_and_folds(presses: Presses) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Return the indices of the presses that have a place, their cross-validation folds, and notes on the folds as
    text."""
    positions = np.asarray(presses.positions)
    placed_presses = np.flatnonzero(~np.isnan(positions).any(axis=1))
    folds, fold_notes = time_folds(
        presses.frames[placed_presses], *_groups_and_times(presses, placed_presses), positions=positions[placed_presses]
    )
    return placed_presses, folds, fold_notes


def _learn_targets(
    changes, reference, targets, press_indices, folds, method, imaged, progress
) -> tuple[LearntNumbers, Standing]:
    """Learn places or forces, the targets, from the voltage changes of presses; returns the model and its accuracy."""
    selected_reference, number_method = (
        None if reference is None else reference[press_indices],
        _method_or_auto(method, regression),
    )
    learnt_numbers, method_results = learn_numbers(
        changes[press_indices],
        selected_reference,
        targets,
        folds,
        method=number_method,
        imaged=imaged,
        progress=progress,
    )
    method_errors = [(method_result.name, method_result.error) for method_result in method_results]
    predictions = method_results[0].held_out
    return learnt_numbers, Standing(
        method_errors[0][0],
        method_errors,
        predictions,
        targets,
        learnt_numbers.spread.held_out(predictions, changes[press_indices]),
    )


def _method_or_auto(method: str, methods_module) -> str:
    return method if method in methods_module.METHODS else "auto"


def _groups_and_times(presses: Presses, press_indices: np.ndarray) -> tuple:
    return tuple(
        None if press_values is None else press_values[press_indices] for press_values in (presses.group, presses.time)
    )
