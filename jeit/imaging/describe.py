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
# Unexplained share of the empty body's voltages above which the best protocol is refused. The second value applies if
# the kind of the protocol is known, or if the order of the channels matters (`Candidate.depends_on_channel_order`).
_MAX_UNEXPLAINED_SHARE, _MAX_UNEXPLAINED_SHARE_IF_KNOWN = 0.25, 0.5
# Maximum deviation of the frames of an empty body from their mean, relative to the frames.
_MAX_FRAME_SPREAD = 0.2
# Maximum number of candidate protocols whose misfit is computed. A candidate is ruled out if its unexplained share is
# at least `_EXCLUSION_RATIO` times that of the best candidate plus `_EXCLUSION_MARGIN`.
_MAX_COMPARED_PROTOCOLS, _EXCLUSION_RATIO, _EXCLUSION_MARGIN = 12, 1.3, 0.01
# Minimum reciprocity error for which gains of the measurement patterns are estimated.
_MIN_RECIPROCITY_ERROR = 0.03
# Maximum ratio of the reciprocity error after the correction by estimated gains to the error before.
_MAX_CORRECTED_ERROR_RATIO = 0.4
# Contact impedance of a new description, times conductivity, divided by the size of the body.
_RELATIVE_CONTACT_IMPEDANCE = 0.01

# For each number of electrodes: the model of the empty body, and its impedances (`uniform_impedances`).
_EmptyBodyModels = dict[int, tuple[ForwardModel, list[np.ndarray]]]


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
        best_candidate = self.candidates[0]
        max_unexplained = (
            _MAX_UNEXPLAINED_SHARE_IF_KNOWN
            if self.known or best_candidate.depends_on_channel_order
            else _MAX_UNEXPLAINED_SHARE
        )
        if best_candidate.unexplained < max_unexplained and best_candidate.spread < _MAX_FRAME_SPREAD:
            return ""
        if best_candidate.spread >= _MAX_FRAME_SPREAD:
            suggested_remedy = (
                " If its two columns are real and imaginary parts, keep one of them."
                if best_candidate.frames == 2
                else ""
            )
            return (
                f"the best explanation, {best_candidate.name}, makes frames of the empty body differ by "
                f"{percent(best_candidate.spread)}: that is not good enough to go on. Are there columns of other "
                "things than voltages, or is the reference one of another sensor? Name the protocol if you know "
                f"it.{suggested_remedy}"
            )
        reciprocity_text = (
            ""
            if best_candidate.reciprocity is None
            else f" and breaks reciprocity by {percent(best_candidate.reciprocity)}"
        )
        wiring_hint = best_candidate.wiring.explanation if best_candidate.wiring is not None else ""
        suggested_remedy = wiring_hint or "Are body and electrodes as given? Name the protocol if you know it."
        return (
            f"the best explanation, {best_candidate.name}, misses {percent(best_candidate.misfit)} of the empty "
            f"body{reciprocity_text}: that is not good enough to go on. {suggested_remedy}"
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
        return _findings_with_own_protocol(path, format_name, geometry, electrodes, reference or path, known or {})
    if not known and OpenEit.recognises(path):
        known = OpenEit.protocol_table(path)
    num_electrodes = (known or {}).get("number")
    if num_electrodes is not None and not MIN_ELECTRODES <= num_electrodes <= MAX_ELECTRODES:
        raise ValueError(
            f"number must be from {MIN_ELECTRODES} to {MAX_ELECTRODES} electrodes; it is {num_electrodes}."
        )
    progress("read")
    file_numbers = FileNumbers.read(path, keys[0], excluded=keys[1] if reference is None else None)
    reference_numbers = (
        file_numbers if reference is None and keys[1] is None else FileNumbers.read(reference or path, keys[1])
    )
    progress("protocols that fit")
    candidates = list(fitting_candidates(file_numbers, reference_numbers, geometry, electrodes, known or {}, current))
    if not candidates:
        possible_channel_counts = channel_counts(known or {})
        channel_counts_text = (
            f" (of what is known: {names_text(possible_channel_counts)})" if possible_channel_counts else ""
        )
        raise ValueError(
            f"{path.name}: no protocol of common kinds has as many channels{channel_counts_text} as there are numbers: "
            f"{file_numbers.shape}. Are there columns of other things? Otherwise write a description with your own "
            "[protocol], see docs/reference/description.md."
        )
    if any(compared_candidate.explains_zeros for compared_candidate in candidates):
        candidates = [
            compared_candidate for compared_candidate in candidates if compared_candidate.num_unread_channels == 0
        ]
    candidates.sort(
        key=lambda compared_candidate: np.hypot(
            compared_candidate.spread, 0.3 if compared_candidate.reciprocity is None else compared_candidate.reciprocity
        )
    )
    progress("uniform body")
    empty_body_models: _EmptyBodyModels = {}
    compared_candidates: list[Candidate] = []
    for candidate in candidates[:_MAX_COMPARED_PROTOCOLS]:
        min_exclusion_share = min(
            (_exclusion_share(compared_candidate) for compared_candidate in compared_candidates), default=np.inf
        )
        is_excluded = candidate.least_unexplained >= min_exclusion_share
        compared_candidates.append(candidate if is_excluded else _fit_wiring(candidate, empty_body_models))
    compared_candidates.sort(
        key=lambda compared_candidate: (round(compared_candidate.unexplained, 3), len(compared_candidate.protocol))
    )
    best_candidate = compared_candidates[0]
    rival_candidates = [
        compared_candidate
        for compared_candidate in compared_candidates[1:]
        if compared_candidate.unexplained < _exclusion_share(best_candidate)
    ]
    if not best_candidate.is_cut_off:
        rival_candidates = [
            compared_candidate for compared_candidate in rival_candidates if not compared_candidate.is_cut_off
        ]
    best_candidate = _fit_gains(best_candidate, empty_body_models)
    compared_candidates[0] = best_candidate
    contact_entry = {
        "contact_impedance": _initial_contact_impedance(
            best_candidate, empty_body_models[best_candidate.protocol["number"]][0]
        )
    }
    description_tables = {
        "geometry": geometry,
        "electrodes": {**contact_entry, **electrodes, "number": best_candidate.protocol["number"]},
    }
    description_tables["protocol"] = {**best_candidate.protocol, "current": current}
    description_text = _commented_description(
        path, file_numbers.shape, file_numbers.data, best_candidate, rival_candidates, description_tables
    )
    return Findings(
        (*compared_candidates, *candidates[_MAX_COMPARED_PROTOCOLS:]),
        tuple(rival_candidates),
        description_text,
        known="kind" in (known or {}),
    )


def _exclusion_share(candidate: Candidate) -> float:
    """Return the unexplained share at or above which this candidate rules out other candidates."""
    return _EXCLUSION_RATIO * candidate.unexplained + _EXCLUSION_MARGIN


def _findings_with_own_protocol(
    path: Path,
    format_name: str,
    geometry: dict[str, Any],
    electrodes: dict[str, Any],
    reference: Path,
    known_options: dict[str, Any],
) -> Findings:
    """Findings for a file that contains its protocol; the description states only the body and its electrodes."""
    file_measurement, reference_measurement = read(path, format_name), read(reference, format_name)
    num_electrodes = file_measurement.protocol.num_electrodes
    if (
        known_options.get("number", num_electrodes) != num_electrodes
        or "kind" in known_options
        or "order" in known_options
    ):
        raise ValueError(
            f"number: {path.name} is of format '{format_name}', and states its protocol, of {num_electrodes} "
            "electrodes: leave out what is said of it."
        )
    parsed_electrode_entries, written_electrode_entries = (
        {**electrodes, "number": num_electrodes},
        {**electrodes, "number": num_electrodes},
    )
    if format_name == "quadrupoles" and (electrode_positions := quadrupoles.electrode_positions(path)) is not None:
        entries_without_layout = {key: value for key, value in electrodes.items() if key not in ("layout", "levels")}
        parsed_electrode_entries, written_electrode_entries = (
            {**entries_without_layout, "positions": electrode_positions.tolist()},
            entries_without_layout,
        )
    description_tables = {"geometry": geometry, "electrodes": {"contact_impedance": 1.0, **parsed_electrode_entries}}
    description = parse_description(description_tables, "the description")
    empty_frame = replace(
        reference_measurement.mean_frame(), domain=description.domain, electrodes=description.electrodes
    )
    empty_frame = correct_signs(replace(empty_frame, voltages=np.real(np.asarray(empty_frame.voltages))))
    deviation_of_frames = relative_deviation(np.real(np.asarray(reference_measurement.filled())))
    empty_body_models: _EmptyBodyModels = {}
    protocol_entries = {"kind": format_name, "number": num_electrodes}
    candidate = Candidate(
        protocol_entries, file_measurement.num_frames, deviation_of_frames, reciprocity_error(empty_frame), empty_frame
    )
    candidate = _fit_wiring(candidate, empty_body_models)
    contact_entry = {"contact_impedance": _initial_contact_impedance(candidate, empty_body_models[num_electrodes][0])}
    shape_text = f"{counted(file_measurement.num_frames, 'frame')} of {file_measurement.num_channels}"
    description_text = _commented_description(
        path,
        shape_text,
        {},
        candidate,
        (),
        {"geometry": geometry, "electrodes": {**contact_entry, **written_electrode_entries}},
    )
    return Findings((candidate,), (), description_text, known=True)


def _fit_wiring(candidate: Candidate, empty_body_models: _EmptyBodyModels) -> Candidate:
    """Return the candidate with the wiring that explains the empty body best. Candidates with the same number of
    electrodes share a mesh and its transfer impedances."""
    num_electrodes, empty_frame = candidate.protocol["number"], candidate.measurement
    assert empty_frame.domain is not None
    assert empty_frame.electrodes is not None
    if num_electrodes not in empty_body_models:
        is_solid = isinstance(empty_frame.domain, Solid)
        mesh = body_mesh(empty_frame.domain, empty_frame.electrodes, _NUM_NODES_BY_DIMENSION[3 if is_solid else 2])
        model = ForwardModel(mesh, empty_frame.electrodes, empty_frame.protocol)
        empty_body_models[num_electrodes] = model, uniform_impedances(model)
    model, transfer_impedances = empty_body_models[num_electrodes]
    wiring = find_wiring(model.with_protocol(empty_frame.protocol), empty_frame, transfer_impedances)
    return replace(candidate, wiring=wiring)


def _fit_gains(candidate: Candidate, empty_body_models: _EmptyBodyModels) -> Candidate:
    """Return the candidate with estimated gains of its measurement patterns if they explain most of the reciprocity
    error; otherwise the unchanged candidate."""
    if candidate.reciprocity is None or candidate.reciprocity < _MIN_RECIPROCITY_ERROR:
        return candidate
    pattern_gains, corrected_error = channel_gains(candidate.measurement)
    if (
        pattern_gains is None
        or corrected_error is None
        or corrected_error > _MAX_CORRECTED_ERROR_RATIO * candidate.reciprocity
    ):
        return candidate
    corrected_voltages = (
        np.asarray(candidate.measurement.voltages)
        / pattern_gains[np.asarray(candidate.measurement.protocol.measurement_index)]
    )
    corrected_candidate = replace(
        candidate,
        measurement=replace(candidate.measurement, voltages=corrected_voltages),
        reciprocity=corrected_error,
        gains=pattern_gains,
    )
    return _fit_wiring(corrected_candidate, empty_body_models)


def _initial_contact_impedance(best_candidate: Candidate, model: ForwardModel) -> float:
    """Return an initial contact impedance: a hundredth of the size of the body, divided by the conductivity that
    explains the voltages of the empty body."""
    body_size = float(np.ptp(np.asarray(model.mesh.points), axis=0).max())
    candidate_model = model.with_protocol(best_candidate.measurement.protocol)
    contact_impedances = np.full(best_candidate.protocol["number"], _RELATIVE_CONTACT_IMPEDANCE * body_size)
    candidate_model = candidate_model.with_electrodes(
        candidate_model.electrodes.with_contact_impedance(contact_impedances)
    )
    usable_channels = np.asarray(best_candidate.measurement.mask)[0]
    expected_voltages, measured_voltages = (
        np.asarray(candidate_model.voltages(1.0))[usable_channels],
        np.asarray(best_candidate.measurement.voltages)[0][usable_channels],
    )
    resistivity = (
        abs(np.vdot(expected_voltages, measured_voltages)) / np.vdot(expected_voltages, expected_voltages).real
    )
    return float(f"{_RELATIVE_CONTACT_IMPEDANCE * body_size * resistivity:.2g}")


def _commented_description(
    path: Path,
    shape_text: str,
    data_entries: dict[str, Any],
    best_candidate: Candidate,
    rival_candidates: Sequence[Candidate],
    description_tables: dict[str, dict[str, Any]],
) -> str:
    """Return the description of a file in TOML, with the evidence as comments. `shape_text`: shape of the numbers in
    words; `data_entries`: entries of the table `[data]`, which describe the arrangement of the numbers."""
    measurement_notes = [note for note in best_candidate.measurement.notes if not note.startswith("[protocol]")]
    reversed_signs = best_candidate.reversed_signs or any("polarity" in note for note in measurement_notes)
    reciprocity_text = (
        "no two channels are reciprocal"
        if best_candidate.reciprocity is None
        else f"broken by {percent(best_candidate.reciprocity)}"
    )
    wiring_explanation = (
        best_candidate.wiring.explanation
        if best_candidate.wiring is not None and not best_candidate.reversed_signs
        else ""
    )
    comment_lines = [
        f"Written by `jeit describe {path.name}` ({shape_text} numbers). Lengths in metres, currents in amperes.",
        f"{best_candidate.name}: a uniform body misses {percent(best_candidate.misfit)} of the empty one; "
        f"reciprocity: {reciprocity_text}.",
        *(f"It may as well be {candidate.name}: {percent(candidate.misfit)}." for candidate in rival_candidates),
        *measurement_notes,
        *([wiring_explanation] if wiring_explanation else []),
    ]
    data_entries = {**data_entries, **({"polarity": "reversed"} if reversed_signs else {})}
    if best_candidate.gains is not None:
        comment_lines.append(
            f"Gains of the measurements differ by {percent(float(np.std(best_candidate.gains)))}, found by reciprocity."
        )
        data_entries["gains"] = [round(float(gain), 4) for gain in best_candidate.gains]
    placement_comment = "Electrodes are where the file places them."
    if "layout" in description_tables["electrodes"]:
        placement_comment = (
            "No voltage says where electrode 1 is, nor which way round: taken at 12 o'clock, counter-clockwise."
        )
    scale_comment = "The current, and the unit of voltages, scale conductivities alone."
    toml_sections = [
        [f"# {comment_line}" for comment_line in comment_lines],
        ["[geometry]", *assignments(description_tables["geometry"])],
        [f"# {placement_comment}", "[electrodes]", *assignments(description_tables["electrodes"])],
        *(
            [[f"# {scale_comment}", "[protocol]", *assignments(description_tables["protocol"])]]
            if "protocol" in description_tables
            else []
        ),
        *([["[data]", *assignments(data_entries)]] if data_entries else []),
    ]
    return "\n\n".join("\n".join(section_lines) for section_lines in toml_sections) + "\n"
