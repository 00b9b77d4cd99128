"""Assign clips to cross-validation folds: all windows of a clip, and all clips of a person where known, together."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int


def held_out_folds(right: Int[np.ndarray, " N"], groups: Int[np.ndarray, " N"], most: int) -> Int[np.ndarray, " N"]:
    """Assign each of N clips to the fold (N,) in which it is held out, together with all of its group.

    The fold is -1 for clips that are always in the training set, since their class has no other group. Groups are
    assigned in turn, class by class, the largest first, to at most `most` folds, so that every class is in the training
    set of each.
    """
    fold = np.full(len(right), -1)
    of_group: dict[int, int] = {}
    counts = np.zeros(most, int)
    classes = [np.unique(groups[right == one]) for one in np.unique(right)]
    for own in sorted(classes, key=len):
        if len(own) < 2:
            continue
        for group in sorted(own.tolist(), key=lambda one: -int((groups == one).sum())):
            if group not in of_group:
                taken = [sum(of_group.get(other) == number for other in own.tolist()) for number in range(most)]
                of_group[group] = min(range(most), key=lambda number: (taken[number], counts[number], number))
                counts[of_group[group]] += int((groups == group).sum())
    for group, number in of_group.items():
        fold[groups == group] = number
    # A class all of whose groups are in one fold would be tested where it was never learnt.
    for one in np.unique(right):
        own = right == one
        if len(np.unique(fold[own])) < 2:
            fold[own] = -1
    used = np.unique(fold[fold >= 0])
    return np.where(fold >= 0, np.searchsorted(used, fold), -1)
