"""`Layout`: round electrodes on a flat skin, with their labels."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.arguments import object_html, object_text, picture
from jeit.electrodes.discs import SheetDiscs
from jeit.electrodes.electrodes import as_electrode_values, as_positions
from jeit.mesh import Domain
from jeit_solvers.engines import has_values
from jeit_solvers.module import Module


def check_labels(labels: Sequence[str] | None, num_electrodes: int) -> tuple[str, ...]:
    """Check the labels of `num_electrodes` electrodes and return them as a tuple; by default "1", "2", … Raises
    `ValueError` for a wrong number of labels, for invalid labels, and for labels that are repeated."""
    if labels is None:
        return tuple(str(electrode_index + 1) for electrode_index in range(num_electrodes))
    labels = list(labels)
    if len(labels) != num_electrodes:
        raise ValueError(f"labels: there are {len(labels)}; give one for each of the {num_electrodes} electrodes.")
    for label in labels:
        if not isinstance(label, str) or not label or label != label.strip() or not label.isprintable():
            raise ValueError(
                f"labels: {label!r} is no label; give text on one line, without blanks before or after it."
            )
    repeated_labels = sorted({label for label in labels if labels.count(label) > 1})
    if repeated_labels:
        raise ValueError(f"labels: {repeated_labels[0]!r} is the label of several electrodes; give each its own.")
    return tuple(labels)


# Minimum and maximum size of a skin: outside this range, lengths are probably in millimetres, or have been divided by
# 1000 twice.
MIN_SKIN_SIZE, MAX_SKIN_SIZE = 1e-3, 5.0  # m
# Tolerance for discs that overlap or extend beyond the outline, since lengths are rounded to decimal millimetres in
# files.
_ROUNDING_TOLERANCE = 1e-9  # m


class Layout(Module):
    """Round electrodes on a flat skin: a design that can be compared, optimised, and written to a file for a laser
    cutter.

    **Fields**

    - `centres`: centres of the electrodes (L, 2), metres.
    - `diameters`: diameters (L,), metres.
    - `contact_impedance`: contact impedances (L,), ohm·m², or None if not known.
    - `outline`: outline of the skin, metres, or None if not known.
    - `labels`: labels of the electrodes (L,), all different and on one line each; by default "1", "2", …
    - `name`: name of the layout, for reports.

    **Example:**

    ```python
    layout = Layout([[-0.05, 0.0], [0.05, 0.0]], 0.01, outline=Rectangle(0.2, 0.1))
    layout.sheet_discs(contact_impedance=1e-4)
    ```
    """

    centres: Float[Array, "L 2"]
    diameters: Float[Array, " L"]
    contact_impedance: Float[Array, " L"] | None
    outline: Domain | None
    labels: tuple[str, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __repr__(self) -> str:
        return object_text(
            lambda: f"Layout({self.name!r}: {len(self.centres)} electrodes)",
            self,
        )

    def _repr_png_(self) -> bytes | None:
        return picture(self)

    def _repr_html_(self) -> str | None:
        return object_html(self)

    def __init__(
        self,
        centres: ArrayLike,
        diameters: ArrayLike,
        *,
        contact_impedance: ArrayLike | None = None,
        outline: Domain | None = None,
        labels: Sequence[str] | None = None,
        name: str = "layout",
    ):
        """`diameters` and `contact_impedance` may be one value for all electrodes.

        Raises `ValueError` for electrodes that overlap or are not wholly inside the outline, if labels are repeated or
        not one for each electrode, and for a skin so small or so large that its lengths cannot be in metres.
        """
        self.centres = as_positions(centres, (2,))
        num_electrodes = self.num_electrodes
        self.diameters = as_electrode_values("diameters", diameters, num_electrodes, unit="metres")
        self.contact_impedance = (
            None
            if contact_impedance is None
            else as_electrode_values("contact_impedance", contact_impedance, num_electrodes, unit="ohm·m²")
        )
        self.outline = outline
        self.labels = check_labels(labels, num_electrodes)
        self.name = name
        if has_values(self.centres, self.diameters, outline):
            electrode_texts = [
                f"electrode {electrode_index + 1} ('{label}')" for electrode_index, label in enumerate(self.labels)
            ]
            check_discs_fit(np.asarray(self.centres), np.asarray(self.diameters), outline, electrode_texts)

    @property
    def num_electrodes(self) -> int:
        """Number of electrodes L."""
        return self.centres.shape[0]

    @property
    def known_outline(self) -> Domain:
        """Outline of the skin, metres. Raises `ValueError` if the outline is not known, so that the result is never
        None."""
        if self.outline is None:
            raise ValueError(
                f"outline: '{self.name}' does not say the skin's; give it, as in read_layout(…, outline=…)."
            )
        return self.outline

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box (x_min, x_max, y_min, y_max) of the outline, or of the electrodes if the outline is not known,
        metres."""
        if self.outline is not None:
            return self.outline.extent
        return bounds(np.asarray(self.centres), np.asarray(self.diameters))

    def lengths(self) -> Float[np.ndarray, "L L"]:
        """Distances (L, L) between the centres of the electrodes, metres."""
        electrode_centres = np.asarray(self.centres)
        return np.linalg.norm(electrode_centres[:, None] - electrode_centres, axis=-1)

    def sheet_discs(self, contact_impedance: ArrayLike | None = None) -> SheetDiscs:
        """Create the electrodes for a forward model on a sheet.

        `contact_impedance`: contact impedance, ohm·m², by default the layout's. Raises `ValueError` if the contact
        impedance is neither specified nor known from the layout.
        """
        disc_impedance = self.contact_impedance if contact_impedance is None else contact_impedance
        if disc_impedance is None:
            raise ValueError(f"contact_impedance: '{self.name}' does not say it; give it in ohm·m².")
        return SheetDiscs(self.centres, self.diameters / 2, disc_impedance)


def check_discs_fit(
    centres: np.ndarray, diameters: np.ndarray, outline: Domain | None, disc_names: Sequence[str]
) -> None:
    """Raise `ValueError` if discs overlap or extend beyond `outline`; lengths in metres. `disc_names` (L,): names of
    the discs in the error message."""
    x_min, x_max, y_min, y_max = bounds(centres, diameters) if outline is None else outline.extent
    skin_size = max(x_max - x_min, y_max - y_min)
    check_size(skin_size)
    electrode_gaps = np.linalg.norm(centres[:, None] - centres, axis=-1) - (diameters[:, None] + diameters) / 2
    np.fill_diagonal(electrode_gaps, np.inf)
    if electrode_gaps.min() < -_ROUNDING_TOLERANCE:
        first_electrode, second_electrode = map(int, np.unravel_index(electrode_gaps.argmin(), electrode_gaps.shape))
        is_same_place = np.linalg.norm(centres[first_electrode] - centres[second_electrode]) < _ROUNDING_TOLERANCE
        fault_text = "are at the same place" if is_same_place else f"overlap by {-1e3 * electrode_gaps.min():.3g} mm"
        raise ValueError(
            f"centres: {disc_names[first_electrode]} and {disc_names[second_electrode]} {fault_text}; remove one or "
            "move them apart."
        )
    if outline is None:
        return
    edge_clearances = np.asarray(outline.signed_distance(centres)) - diameters / 2
    electrode_index = int(edge_clearances.argmin())
    if edge_clearances[electrode_index] < -_ROUNDING_TOLERANCE:
        unit_hint = ""
        if (np.abs(centres) > MAX_SKIN_SIZE).any() and bool((outline.signed_distance(centres / 1000) > 0).all()):
            unit_hint = " Are they in millimetres? Divide by 1000."
        elif diameters[electrode_index] > skin_size:
            unit_hint = " Is its diameter in metres?"
        x, y = 1e3 * centres[electrode_index]
        raise ValueError(
            f"centres: {disc_names[electrode_index]}, {1e3 * diameters[electrode_index]:g} mm across at ({x:g}, {y:g}) "
            f"mm, reaches {-1e3 * edge_clearances[electrode_index]:.3g} mm beyond the outline, which spans "
            f"{1e3 * x_min:g} to {1e3 * x_max:g} mm by {1e3 * y_min:g} to {1e3 * y_max:g} mm.{unit_hint}"
        )


def check_size(size: float) -> None:
    """Raise `ValueError` for an implausible `size` of a skin, metres."""
    if not MIN_SKIN_SIZE - _ROUNDING_TOLERANCE <= size <= MAX_SKIN_SIZE + _ROUNDING_TOLERANCE:
        raise ValueError(
            f"centres: the skin would be {_length_text(size)} across; are millimetres taken for metres, or metres for "
            "millimetres? Lengths differ by a factor of 1000."
        )


def _length_text(length_metres: float) -> str:
    return f"{length_metres:.3g} m" if length_metres > MAX_SKIN_SIZE else f"{1e3 * length_metres:.3g} mm"


def bounds(centres: np.ndarray, diameters: np.ndarray) -> tuple[float, float, float, float]:
    """Bounding box (x_min, x_max, y_min, y_max) of discs, in the unit of their centres (L, 2) and diameters (L,)."""
    lower_corner = (centres - diameters[:, None] / 2).min(axis=0)
    upper_corner = (centres + diameters[:, None] / 2).max(axis=0)
    return float(lower_corner[0]), float(upper_corner[0]), float(lower_corner[1]), float(upper_corner[1])
