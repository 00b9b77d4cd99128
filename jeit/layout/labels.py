"""Names of electrodes."""

from __future__ import annotations

from collections.abc import Sequence


def check_labels(labels: Sequence[str] | None, number: int) -> tuple[str, ...]:
    """Labels of so many electrodes, "1", "2", … if None are given. Raises `ValueError` for others than one for each."""
    if labels is None:
        return tuple(str(index + 1) for index in range(number))
    labels = list(labels)
    if len(labels) != number:
        raise ValueError(f"labels: there are {len(labels)}; give one for each of the {number} electrodes.")
    for label in labels:
        if not isinstance(label, str) or not label or label != label.strip() or not label.isprintable():
            raise ValueError(
                f"labels: {label!r} is no label; give text on one line, without blanks before or after it."
            )
    repeated = sorted({label for label in labels if labels.count(label) > 1})
    if repeated:
        raise ValueError(f"labels: {repeated[0]!r} is the label of several electrodes; give each its own.")
    return tuple(labels)
