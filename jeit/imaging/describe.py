"""Search for the protocol of a file of voltages that has no description, with the evidence for each protocol.

Protocols of common kinds whose number of channels fits the file are compared: by reciprocity, which needs no model, and
by the misfit of a uniform body of the described shape to a frame of the empty body (`jeit.imaging.wiring`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from jeit.arguments import counted, names_text, percent
from jeit.data import read
from jeit.data.description import parse_description
from jeit.data.exchange import assignments
from jeit.data.formats import quadrupoles
from jeit.data.formats.boards import OpenEit
from jeit.data.inferred_properties import channel_gains, correct_signs
from jeit.data.quality import reciprocity_error
from jeit.data.registry import format_with_protocol
from jeit.electrodes.face_patches import body_mesh
from jeit.forward import ForwardModel
from jeit.imaging.possible_protocols import (
    MAX_ELECTRODES,
    MIN_ELECTRODES,
    Candidate,
    FileNumbers,
    channel_counts,
    fitting_candidates,
    relative_deviation,
)
from jeit.imaging.wiring import find_wiring, uniform_impedances
from jeit.mesh import Solid

# Number of nodes of the mesh on which protocols are compared, for a sheet and for a solid.
_NUM_NODES_BY_DIMENSION = {2: 700, 3: 4000}
# Unexplained share of the empty body's voltages above which the best protocol is refused: in general; and if its kind
# is known, or if the order of the channels matters (`Candidate.ordered`).
_MAX_UNEXPLAINED_SHARE, _MAX_UNEXPLAINED_SHARE_IF_KNOWN = 0.25, 0.5
# Maximum spread of the frames of an empty body.
_MAX_SHAPE_DEVIATION = 0.2
# Maximum number of candidate protocols whose misfit is computed. A candidate is ruled out if its unexplained share is
# at least `_EXCLUSION_RATIO` times that of the best candidate plus `_EXCLUSION_MARGIN`.
_MAX_COMPARED_CANDIDATES, _EXCLUSION_RATIO, _EXCLUSION_MARGIN = 12, 1.3, 0.01
# Minimum reciprocity error for which gains are estimated.
_MIN_GAIN_ERROR = 0.03
# Maximum ratio of the reciprocity error after the correction by estimated gains to the error before.
_MAX_GAIN_RATIO = 0.4
# Contact impedance of a new description, times conductivity, divided by the size of the body.
_RELATIVE_CONTACT_IMPEDANCE = 0.01

# For each number of electrodes: the model of the empty body, and its impedances (`uniform_impedances`).
_Models = dict[int, tuple[ForwardModel, list[np.ndarray]]]


@dataclass(frozen=True)
class Findings:
    """Result of `find_description`. **Fields**: `candidates`: protocols, the best first; `undecided`: other protocols
    that fit the file about as well as the best; `text`: commented description in TOML with the best protocol; `known`:
    whether the kind of protocol was known."""

    candidates: tuple[Candidate, ...]
    undecided: tuple[Candidate, ...]
    text: str
    known: bool = False

    @property
    def fault(self) -> str:
        """Reason why the best protocol explains the file too poorly to be used; empty if it explains the file well
        enough."""
        best = self.candidates[0]
        max_unexplained = (
            _MAX_UNEXPLAINED_SHARE_IF_KNOWN if self.known or best.depends_on_channel_order else _MAX_UNEXPLAINED_SHARE
        )
        if best.unexplained < max_unexplained and best.spread < _MAX_SHAPE_DEVIATION:
            return ""
        if best.spread >= _MAX_SHAPE_DEVIATION:
            remedy = " If its two columns are real and imaginary parts, keep one of them." if best.frames == 2 else ""
            return (
                f"the best explanation, {best.name}, makes frames of the empty body differ by {percent(best.spread)}: "
                "that is not good enough to go on. Are there columns of other things than voltages, or is the "
                f"reference one of another sensor? Name the protocol if you know it.{remedy}"
            )
        reciprocity_text = "" if best.reciprocity is None else f" and breaks reciprocity by {percent(best.reciprocity)}"
        wiring_hint = best.wiring.explanation if best.wiring is not None else ""
        remedy = wiring_hint or "Are body and electrodes as given? Name the protocol if you know it."
        return (
            f"the best explanation, {best.name}, misses {percent(best.misfit)} of the empty body{reciprocity_text}: "
            f"that is not good enough to go on. {remedy}"
        )


def find_description(
    path: Path,
    geometry: dict[str, Any],
    electrodes: dict[str, Any],
    *,
    reference: Path | None = None,
    keys: tuple[str | None, str | None] = (None, None),
    known: dict[str, Any] | None = None,
    current: float = 1e-3,
    progress: Callable[[str], None] = lambda step: None,
) -> Findings:
    """Compare the protocols that fit a file of voltages, and write a description with the best protocol.

    **Arguments:**

    - `path`: file of the voltages.
    - `geometry`, `electrodes`: tables of a description, metres, without the number of electrodes. The contact
      impedance, ohm·m (on a solid ohm·m²), is estimated roughly unless it is in `electrodes`.
    - `reference`: file of frames of the empty body; by default, the mean of all frames replaces them.
    - `keys`: names of the arrays of frames in the file and in the reference, for files with several arrays.
    - `known`: known entries of the table `[protocol]`, such as the kind or the number of electrodes.
    - `current`: amplitude of the driven current, amperes.
    - `progress`: function called with the name of each step when the step begins.

    Raises `ValueError` for files that cannot be read, for several arrays if none is named, and if no protocol fits.

    **Example:**

    ```python
    geometry, electrodes = {"shape": "disk", "radius": 0.05}, {"layout": "ring", "kind": "boundary", "width": 0.008}
    print(find_description(file, geometry, electrodes).text)
    ```
    """
    if (format_name := format_with_protocol(path)) is not None:
        progress("read")
        return _described_body(path, format_name, geometry, electrodes, reference or path, known or {})
    if not known and OpenEit.recognises(path):
        known = OpenEit.protocol_table(path)
    number = (known or {}).get("number")
    if number is not None and not MIN_ELECTRODES <= number <= MAX_ELECTRODES:
        raise ValueError(f"number must be from {MIN_ELECTRODES} to {MAX_ELECTRODES} electrodes; it is {number}.")
    progress("read")
    numbers = FileNumbers.read(path, keys[0], excluded=keys[1] if reference is None else None)
    reference_numbers = (
        numbers if reference is None and keys[1] is None else FileNumbers.read(reference or path, keys[1])
    )
    progress("protocols that fit")
    candidates = list(fitting_candidates(numbers, reference_numbers, geometry, electrodes, known or {}, current))
    if not candidates:
        counts = channel_counts(known or {})
        count_text = f" (of what is known: {names_text(counts)})" if counts else ""
        raise ValueError(
            f"{path.name}: no protocol of common kinds has as many channels{count_text} as there are numbers: "
            f"{numbers.shape}. Are there columns of other things? Otherwise write a description with your own "
            "[protocol], see docs/reference/description.md."
        )
    if any(item.explains_zeros for item in candidates):
        candidates = [item for item in candidates if item.num_unread_channels == 0]
    candidates.sort(key=lambda item: np.hypot(item.spread, 0.3 if item.reciprocity is None else item.reciprocity))
    progress("uniform body")
    models: _Models = {}
    compared_candidates: list[Candidate] = []
    for candidate in candidates[:_MAX_COMPARED_CANDIDATES]:
        min_exclusion_share = min((_exclusion_share(item) for item in compared_candidates), default=np.inf)
        is_excluded = candidate.least_unexplained >= min_exclusion_share
        compared_candidates.append(candidate if is_excluded else _compute_misfit(candidate, models))
    compared_candidates.sort(key=lambda item: (round(item.unexplained, 3), len(item.protocol)))
    best_candidate = compared_candidates[0]
    rival_candidates = [item for item in compared_candidates[1:] if item.unexplained < _exclusion_share(best_candidate)]
    if not best_candidate.is_cut_off:
        rival_candidates = [item for item in rival_candidates if not item.is_cut_off]
    best_candidate = _fit_gains(best_candidate, models)
    compared_candidates[0] = best_candidate
    contact = {"contact_impedance": _contact_impedance(best_candidate, models[best_candidate.protocol["number"]][0])}
    tables = {
        "geometry": geometry,
        "electrodes": {**contact, **electrodes, "number": best_candidate.protocol["number"]},
    }
    tables["protocol"] = {**best_candidate.protocol, "current": current}
    text = _description_text(path, numbers.shape, numbers.data, best_candidate, rival_candidates, tables)
    return Findings(
        (*compared_candidates, *candidates[_MAX_COMPARED_CANDIDATES:]),
        tuple(rival_candidates),
        text,
        known="kind" in (known or {}),
    )


def _exclusion_share(candidate: Candidate) -> float:
    """Unexplained share above which other candidates are ruled out by this one."""
    return _EXCLUSION_RATIO * candidate.unexplained + _EXCLUSION_MARGIN


def _described_body(
    path: Path,
    format: str,
    geometry: dict[str, Any],
    electrodes: dict[str, Any],
    reference: Path,
    known_options: dict[str, Any],
) -> Findings:
    """Findings for a file that contains its protocol; the description states only the body and its electrodes."""
    data, reference_measurement = read(path, format), read(reference, format)
    number = data.protocol.num_electrodes
    if known_options.get("number", number) != number or "kind" in known_options or "order" in known_options:
        raise ValueError(
            f"number: {path.name} is of format '{format}', and states its protocol, of {number} electrodes: leave out "
            "what is said of it."
        )
    placements, electrode_entries = {**electrodes, "number": number}, {**electrodes, "number": number}
    if format == "quadrupoles" and (places := quadrupoles.electrode_positions(path)) is not None:
        sizes = {key: value for key, value in electrodes.items() if key not in ("layout", "levels")}
        placements, electrode_entries = {**sizes, "positions": places.tolist()}, sizes
    tables = {"geometry": geometry, "electrodes": {"contact_impedance": 1.0, **placements}}
    description = parse_description(tables, "the description")
    empty_frame = replace(
        reference_measurement.mean_frame(), domain=description.domain, electrodes=description.electrodes
    )
    empty_frame = correct_signs(replace(empty_frame, voltages=np.real(np.asarray(empty_frame.voltages))))
    deviation_of_frames = relative_deviation(np.real(np.asarray(reference_measurement.filled())))
    models: _Models = {}
    protocol = {"kind": format, "number": number}
    candidate = Candidate(protocol, data.num_frames, deviation_of_frames, reciprocity_error(empty_frame), empty_frame)
    candidate = _compute_misfit(candidate, models)
    contact = {"contact_impedance": _contact_impedance(candidate, models[number][0])}
    shape = f"{counted(data.num_frames, 'frame')} of {data.num_channels}"
    text = _description_text(
        path, shape, {}, candidate, (), {"geometry": geometry, "electrodes": {**contact, **electrode_entries}}
    )
    return Findings((candidate,), (), text, known=True)


def _compute_misfit(candidate: Candidate, models: _Models) -> Candidate:
    """The candidate with the wiring that explains the empty body best. Candidates with equally many electrodes share a
    mesh and its impedances."""
    number, empty_frame = candidate.protocol["number"], candidate.measurement
    assert empty_frame.domain is not None
    assert empty_frame.electrodes is not None
    if number not in models:
        is_solid = isinstance(empty_frame.domain, Solid)
        mesh = body_mesh(empty_frame.domain, empty_frame.electrodes, _NUM_NODES_BY_DIMENSION[3 if is_solid else 2])
        model = ForwardModel(mesh, empty_frame.electrodes, empty_frame.protocol)
        models[number] = model, uniform_impedances(model)
    model, impedances = models[number]
    wiring = find_wiring(model.with_protocol(empty_frame.protocol), empty_frame, impedances)
    return replace(candidate, wiring=wiring)


def _fit_gains(candidate: Candidate, models: _Models) -> Candidate:
    """The candidate with gains of its measurement patterns, if they explain most of the reciprocity error."""
    if candidate.reciprocity is None or candidate.reciprocity < _MIN_GAIN_ERROR:
        return candidate
    gains, error = channel_gains(candidate.measurement)
    if gains is None or error is None or error > _MAX_GAIN_RATIO * candidate.reciprocity:
        return candidate
    values = (
        np.asarray(candidate.measurement.voltages) / gains[np.asarray(candidate.measurement.protocol.measurement_index)]
    )
    corrected_frame = replace(
        candidate, measurement=replace(candidate.measurement, voltages=values), reciprocity=error, gains=gains
    )
    return _compute_misfit(corrected_frame, models)


def _contact_impedance(best_candidate: Candidate, model: ForwardModel) -> float:
    """Initial contact impedance: a hundredth of the size of the body, divided by the conductivity that explains the
    empty body."""
    size = float(np.ptp(np.asarray(model.mesh.points), axis=0).max())
    winner_model = model.with_protocol(best_candidate.measurement.protocol)
    contacts = np.full(best_candidate.protocol["number"], _RELATIVE_CONTACT_IMPEDANCE * size)
    winner_model = winner_model.with_electrodes(winner_model.electrodes.with_contact_impedance(contacts))
    is_used = np.asarray(best_candidate.measurement.mask)[0]
    expected_voltages, measured = (
        np.asarray(winner_model.voltages(1.0))[is_used],
        np.asarray(best_candidate.measurement.voltages)[0][is_used],
    )
    resistivity = abs(np.vdot(expected_voltages, measured)) / np.vdot(expected_voltages, expected_voltages).real
    return float(f"{_RELATIVE_CONTACT_IMPEDANCE * size * resistivity:.2g}")


def _description_text(
    path: Path,
    shape: str,
    data: dict[str, Any],
    best_candidate: Candidate,
    rival_candidates: Sequence[Candidate],
    tables: dict[str, dict[str, Any]],
) -> str:
    """The file's description in TOML, with the evidence as comments. `shape`: shape of the numbers in words; `data`:
    entries of the table `[data]`, which describe the arrangement of the numbers."""
    notes = [note for note in best_candidate.measurement.notes if not note.startswith("[protocol]")]
    reversed_signs = best_candidate.reversed_signs or any("polarity" in note for note in notes)
    reciprocity_text = (
        "no two channels are reciprocal"
        if best_candidate.reciprocity is None
        else f"broken by {percent(best_candidate.reciprocity)}"
    )
    explanation = (
        best_candidate.wiring.explanation
        if best_candidate.wiring is not None and not best_candidate.reversed_signs
        else ""
    )
    lines = [
        f"Written by `jeit describe {path.name}` ({shape} numbers). Lengths in metres, currents in amperes.",
        f"{best_candidate.name}: a uniform body misses {percent(best_candidate.misfit)} of the empty one; "
        f"reciprocity: {reciprocity_text}.",
        *(f"It may as well be {candidate.name}: {percent(candidate.misfit)}." for candidate in rival_candidates),
        *notes,
        *([explanation] if explanation else []),
    ]
    data = {**data, **({"polarity": "reversed"} if reversed_signs else {})}
    if best_candidate.gains is not None:
        lines.append(
            f"Gains of the measurements differ by {percent(float(np.std(best_candidate.gains)))}, found by reciprocity."
        )
        data["gains"] = [round(float(gain), 4) for gain in best_candidate.gains]
    placement_text = "Electrodes are where the file places them."
    if "layout" in tables["electrodes"]:
        placement_text = (
            "No voltage says where electrode 1 is, nor which way round: taken at 12 o'clock, counter-clockwise."
        )
    scale = "The current, and the unit of voltages, scale conductivities alone."
    sections = [
        [f"# {line}" for line in lines],
        ["[geometry]", *assignments(tables["geometry"])],
        [f"# {placement_text}", "[electrodes]", *assignments(tables["electrodes"])],
        *([[f"# {scale}", "[protocol]", *assignments(tables["protocol"])]] if "protocol" in tables else []),
        *([["[data]", *assignments(data)]] if data else []),
    ]
    return "\n\n".join("\n".join(section) for section in sections) + "\n"
