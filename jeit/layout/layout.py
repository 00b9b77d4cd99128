"""`Layout`: where round electrodes sit on a flat skin, and the layouts that have a name."""

import re
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jeit.electrodes.discs import SheetDiscs
from jeit.electrodes.electrodes import as_electrode_values, as_positions, is_concrete
from jeit.layout.arrangements import grid, quasi_uniform
from jeit.mesh import Disk, Domain, Rectangle
from jeit.mesh.loops import distance, inside

# A skin outside these is not known to exist: its lengths would be in millimetres, or have been divided by 1000 twice.
SMALLEST, LARGEST = 1e-3, 5.0  # m
# Lengths come and go as decimal millimetres; a disc may miss its bounds by so much.
_ROUNDING = 1e-9  # m


class Layout(eqx.Module):
    """Round electrodes on a flat skin: what a designer compares, optimises, and sends to the laser cutter.

    **Fields**

    - `centres`: (L, 2) metres.
    - `diameters`: (L,) metres.
    - `contact_impedance`: (L,) ohm·m², or None if it is not known.
    - `outline`: of the skin, metres; None if it is not known.
    - `labels`: (L,) names of the electrodes, all different, on one line each; "1", "2", … if not given.
    - `name`: of the layout, for reports.
    """

    centres: Float[Array, "L 2"]
    diameters: Float[Array, " L"]
    contact_impedance: Float[Array, " L"] | None
    outline: Domain | None
    labels: tuple[str, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __init__(
        self,
        centres,
        diameters,
        *,
        contact_impedance=None,
        outline: Domain | None = None,
        labels: Sequence[str] | None = None,
        name: str = "layout",
    ):
        """`diameters` and `contact_impedance` may be one number for all electrodes.

        Raises `ValueError` for electrodes that overlap or are not wholly inside the outline, for labels that are not
        one for each and different, and for a skin so small or so large that its lengths cannot be metres.
        """
        self.centres = as_positions(centres, (2,))
        number = self.num_electrodes
        self.diameters = as_electrode_values("diameters", diameters, number, unit="metres")
        self.contact_impedance = (
            None
            if contact_impedance is None
            else as_electrode_values("contact_impedance", contact_impedance, number, unit="ohm·m²")
        )
        self.outline = outline
        self.labels = _check_labels(labels, number)
        self.name = name
        if is_concrete(*jax.tree.leaves((self.centres, self.diameters, outline))):
            called = [f"electrode {index + 1} ('{label}')" for index, label in enumerate(self.labels)]
            check_discs_fit(np.asarray(self.centres), np.asarray(self.diameters), outline, called)

    @property
    def num_electrodes(self) -> int:
        """Number of electrodes L."""
        return self.centres.shape[0]

    @property
    def known_outline(self) -> Domain:
        """The outline, for what cannot do without. Raises `ValueError` if it is not known."""
        if self.outline is None:
            raise ValueError(
                f"outline: '{self.name}' does not say the skin's; give it, as in read_layout(…, outline=…)."
            )
        return self.outline

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box (x_min, x_max, y_min, y_max) in metres: of the outline, or of the discs if there is none."""
        if self.outline is not None:
            return self.outline.extent
        return bounds(np.asarray(self.centres), np.asarray(self.diameters))

    def sheet_discs(self, contact_impedance=None) -> SheetDiscs:
        """The electrodes for a forward model on a sheet; `contact_impedance` in ohm·m² replaces the layout's.

        Raises `ValueError` if neither is known.
        """
        chosen = self.contact_impedance if contact_impedance is None else contact_impedance
        if chosen is None:
            raise ValueError(f"contact_impedance: '{self.name}' does not say it; give it in ohm·m².")
        return SheetDiscs(self.centres, self.diameters / 2, chosen)


# The paper's skin and the electrodes of its Fig. S4, in metres. It does not say how far the electrodes of its
# conventional layout sit from the edge: here they leave 2 mm of hydrogel outside them.
_SIDE, _DIAMETER, _FROM_EDGE = 0.2, 6e-3, 5e-3

BUILT_IN = {
    "park-inner": "32 electrodes spread evenly inside 200 × 200 mm (Park et al. 2022, the proposed design)",
    "park-boundary": "32 electrodes evenly along the edge of 200 × 200 mm (Park et al. 2022, the conventional design)",
    "grid-8x4": "a regular grid of 8 columns and 4 rows on 200 × 200 mm; any other counts likewise",
}


def named_layout(name: str) -> Layout:
    """One of the layouts in `BUILT_IN`, on a 200 × 200 mm skin centred at the origin, electrodes 6 mm across.

    - "park-inner" and "park-boundary": the two designs that text S4 of Park et al., Science Robotics 7, eabm7187 (2022)
      compares. Its coordinates are not published, only "as evenly as possible in a square area" and "about 40 mm"
      apart: here a centroidal Voronoi tessellation, nearest neighbours 31 to 38 mm apart. Around the edge, electrodes
      lie 5 mm from it, 23.75 mm apart, none in a corner, counter-clockwise from the lower left.
    - "grid-CxR": C columns and R rows, each electrode in the middle of an equal rectangle.

    Raises `ValueError` for another name, and for a grid whose electrodes would overlap.
    """
    outline = Rectangle(_SIDE, _SIDE)
    if name == "park-inner":
        return Layout(quasi_uniform(outline, 32), _DIAMETER, outline=outline, name=name)
    if name == "park-boundary":
        track = Rectangle(_SIDE - 2 * _FROM_EDGE, _SIDE - 2 * _FROM_EDGE)
        pitch = track.perimeter / 32
        return Layout(track.boundary(pitch * (np.arange(32) + 0.5)), _DIAMETER, outline=outline, name=name)
    counts = re.fullmatch(r"grid-(\d{1,4})x(\d{1,4})", name) if isinstance(name, str) else None
    if counts is None:
        raise ValueError(
            f"name: there is no layout {name!r}; take {', '.join(BUILT_IN)} (or another grid-CxR), or a file's."
        )
    columns, rows = (int(count) for count in counts.groups())
    if min(columns, rows) < 1:
        raise ValueError(f"name: {name!r} has no electrodes; give at least one column and one row.")
    pitches = _SIDE / columns, _SIDE / rows
    if min(pitches) < _DIAMETER:
        raise ValueError(
            f"name: the electrodes of {name!r} would be {1e3 * min(pitches):.3g} mm apart, and they are "
            f"{1e3 * _DIAMETER:g} mm across; give fewer."
        )
    centres = grid(_SIDE - pitches[0], _SIDE - pitches[1], columns, rows)
    return Layout(centres, _DIAMETER, outline=outline, name=name)


def check_discs_fit(centres: np.ndarray, diameters: np.ndarray, outline: Domain | None, called: Sequence[str]) -> None:
    """Raise `ValueError` unless discs lie apart and inside `outline`, all in metres; `called` (L,) names them."""
    x_min, x_max, y_min, y_max = bounds(centres, diameters) if outline is None else outline.extent
    size = max(x_max - x_min, y_max - y_min)
    if not SMALLEST - _ROUNDING <= size <= LARGEST + _ROUNDING:
        raise ValueError(
            f"centres: the skin would be {_told(size)} across; are millimetres taken for metres, or metres for "
            "millimetres? Lengths differ by a factor of 1000."
        )
    gap = np.linalg.norm(centres[:, None] - centres, axis=-1) - (diameters[:, None] + diameters) / 2
    np.fill_diagonal(gap, np.inf)
    if gap.min() < -_ROUNDING:
        first, second = np.unravel_index(gap.argmin(), gap.shape)
        same = np.linalg.norm(centres[first] - centres[second]) < _ROUNDING
        how = "are at the same place" if same else f"overlap by {-1e3 * gap.min():.3g} mm"
        raise ValueError(f"centres: {called[first]} and {called[second]} {how}; remove one or move them apart.")
    if outline is None:
        return
    room = _room(centres, outline) - diameters / 2
    worst = int(room.argmin())
    if room[worst] < -_ROUNDING:
        hint = ""
        if (np.abs(centres) > LARGEST).any() and (_room(centres / 1000, outline) > 0).all():
            hint = " Are they in millimetres? Divide by 1000."
        elif diameters[worst] > size:
            hint = " Is its diameter in metres?"
        x, y = 1e3 * centres[worst]
        raise ValueError(
            f"centres: {called[worst]}, {1e3 * diameters[worst]:g} mm across at ({x:g}, {y:g}) mm, reaches "
            f"{-1e3 * room[worst]:.3g} mm beyond the outline, which spans {1e3 * x_min:g} to {1e3 * x_max:g} mm by "
            f"{1e3 * y_min:g} to {1e3 * y_max:g} mm.{hint}"
        )


def _told(length: float) -> str:
    return f"{length:.3g} m" if length > LARGEST else f"{1e3 * length:.3g} mm"


def bounds(centres: np.ndarray, diameters: np.ndarray) -> tuple[float, float, float, float]:
    """Box (x_min, x_max, y_min, y_max) round discs, in the unit of their centres (L, 2) and diameters (L,)."""
    low = (centres - diameters[:, None] / 2).min(axis=0)
    high = (centres + diameters[:, None] / 2).max(axis=0)
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _room(points: np.ndarray, outline: Domain) -> np.ndarray:
    """Distance (p,) of points (p, 2) from the outline, in metres; negative outside."""
    if isinstance(outline, Disk):
        return outline.radius - np.linalg.norm(points - np.asarray(outline.centre), axis=1)
    loops = [np.asarray(loop) for loop in (outline.vertices, *getattr(outline, "holes", ()))]
    nearest = np.min([distance(points, loop, np.roll(loop, -1, axis=0)).min(axis=1) for loop in loops], axis=0)
    return np.where(inside(points, loops), nearest, -nearest)


def _check_labels(labels: Sequence[str] | None, number: int) -> tuple[str, ...]:
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
