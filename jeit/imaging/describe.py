"""Search for the protocol of a file of voltages that has no description, with the evidence for each protocol.

Protocols of common kinds whose number of channels fits the file are compared: by reciprocity, which needs no model, and
by the misfit of a uniform body of the described shape to a frame of the empty body (`jeit.imaging.wiring`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from jeit.arguments import counted, did_you_mean, names_text, percent
from jeit.data import Measurement, read
from jeit.data.description import Description, TableLayout, parse_description
from jeit.data.exchange import assignments
from jeit.data.formats import quadrupoles
from jeit.data.formats.boards import OpenEit
from jeit.data.formats.table import measurement_in
from jeit.data.formats.text import Frames, frames_in_table, frames_in_text, read_text
from jeit.data.quality import reciprocity_error
from jeit.data.registry import format_with_protocol
from jeit.data.unstated import channel_gains, with_signs
from jeit.electrodes.face_patches import body_mesh
from jeit.files import matlab, npy_array, npz_arrays
from jeit.forward import ForwardModel
from jeit.imaging.wiring import Wiring, find_wiring
from jeit.mesh import Solid
from jeit.protocol import Protocol

# Minimum and maximum number of electrodes of the protocols that are tried; number of nodes of the mesh on which the
# protocols are compared, for a sheet and for a solid.
_MIN_ELECTRODES, _MAX_ELECTRODES, _NODES = 4, 64, {2: 700, 3: 4000}
# Unexplained share of the empty body's voltages above which the best protocol is refused: in general; and if its kind
# is known, or if the channels in a different order would leave `_MIN_ORDER_RATIO` times as much unexplained.
_MAX_UNEXPLAINED, _MAX_UNEXPLAINED_KNOWN, _MIN_ORDER_RATIO = 0.25, 0.5, 2.0
# Maximum spread of the frames of an empty body.
_MAX_SPREAD = 0.2
# Minimum number of channels for each electrode.
_MIN_CHANNELS = 2
# Maximum number of candidate protocols whose misfit is computed. A candidate is ruled out if its unexplained share is
# at least `_RIVAL_RATIO` times that of the best candidate plus `_RIVAL_MARGIN`.
_MAX_COMPARED, _RIVAL_RATIO, _RIVAL_MARGIN = 12, 1.3, 0.01
# Maximum number of frames of a file with which protocols are compared; of more frames, some at regular intervals.
_MAX_FRAMES = 32
# Minimum reciprocity error for which gains are estimated.
_MIN_GAIN_ERROR = 0.03
# Maximum ratio of the reciprocity error after the correction by estimated gains to the error before.
_MAX_GAIN_RATIO = 0.4
# Layout of a table of numbers about which nothing is known.
_UNKNOWN_LAYOUT = TableLayout()
# Contact impedance of a new description, times conductivity, divided by the size of the body.
_RELATIVE_CONTACT = 0.01


@dataclass(frozen=True)
class Candidate:
    """Candidate for the protocol of a file. **Fields**: `protocol`: table `[protocol]` of a description, without the
    current; `frames`: number of frames; `spread`: relative deviation of the empty body's frames from their mean;
    `reciprocity`: reciprocity error of the mean frame, None if no two channels are reciprocal; `measurement`: the mean
    frame, read with this protocol; `wiring`: the wiring with which a uniform body explains this frame; `gains`: gains
    of the measurement patterns, if they explain the reciprocity error."""

    protocol: dict[str, Any]
    frames: int
    spread: float
    reciprocity: float | None
    measurement: Measurement
    wiring: Wiring | None = None
    gains: np.ndarray | None = None

    @property
    def is_cut_off(self) -> bool:
        """Whether the last frame of the file, or of its reference, is incomplete."""
        return any("is cut off after" in note for note in self.measurement.notes)

    @property
    def misfit(self) -> float:
        """Relative misfit of a uniform body to the mean frame; infinite if the misfit was not computed."""
        if self.wiring is None:
            return np.inf
        return self.wiring.misfit if self.reversed_signs else self.wiring.described

    @property
    def reversed_signs(self) -> bool:
        """Whether a uniform body explains the voltages with the opposite sign and an otherwise unchanged wiring."""
        return self.wiring is not None and self.wiring == Wiring(tuple(range(len(self.wiring.places))), "", True)

    @property
    def unexplained(self) -> float:
        """Relative error with which this protocol explains all frames: root of the sum of squares of misfit, spread,
        and 1/√2 of the reciprocity error, which has twice the variance of the noise."""
        return float(np.sqrt(self.misfit**2 + self.spread**2 + (self.reciprocity or 0) ** 2 / 2))

    @property
    def ordered(self) -> bool:
        """Whether a uniform body would explain the voltages far worse if the channels were in a different order. On
        average, a share √(1 - r²) would then be unexplained, where r is the squared mean of the voltages divided by
        their mean square."""
        values = np.asarray(self.measurement.voltages)[np.asarray(self.measurement.mask)]
        mean_ratio = abs(values.mean()) ** 2 / np.mean(np.abs(values) ** 2)
        return bool(_MIN_ORDER_RATIO * self.unexplained < np.sqrt(1 - mean_ratio**2))

    @property
    def name(self) -> str:
        """Kind, number of electrodes and options of the protocol, in words."""
        options = {key: value for key, value in self.protocol.items() if key not in ("kind", "number")}
        option_text = ", ".join(f"{key} {str(value).lower()}" for key, value in options.items())
        return f"{self.protocol['kind']}, {self.protocol['number']} electrodes{option_text and ', ' + option_text}"


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
        limit = _MAX_UNEXPLAINED_KNOWN if self.known or best.ordered else _MAX_UNEXPLAINED
        if best.unexplained < limit and best.spread < _MAX_SPREAD:
            return ""
        if best.spread >= _MAX_SPREAD:
            advice = " If its two columns are real and imaginary parts, keep one of them." if best.frames == 2 else ""
            return (
                f"the best explanation, {best.name}, makes frames of the empty body differ by {percent(best.spread)}: "
                "that is not good enough to go on. Are there columns of other things than voltages, or is the "
                f"reference one of another sensor? Name the protocol if you know it.{advice}"
            )
        remark = "" if best.reciprocity is None else f" and breaks reciprocity by {percent(best.reciprocity)}"
        hint = best.wiring.explanation if best.wiring is not None else ""
        return (
            f"the best explanation, {best.name}, misses {percent(best.misfit)} of the empty body{remark}: that is not "
            f"good enough to go on. {hint or 'Are body and electrodes as given? Name the protocol if you know it.'}"
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
    if number is not None and not _MIN_ELECTRODES <= number <= _MAX_ELECTRODES:
        raise ValueError(f"number must be from {_MIN_ELECTRODES} to {_MAX_ELECTRODES} electrodes; it is {number}.")
    progress("read")
    numbers = _Numbers.read(path, keys[0], excluded=keys[1] if reference is None else None)
    base_numbers = numbers if reference is None and keys[1] is None else _Numbers.read(reference or path, keys[1])
    progress("protocols that fit")
    candidates = list(_fitting(numbers, base_numbers, geometry, electrodes, known or {}, current))
    if not candidates:
        counts = _channel_counts(known or {})
        count_text = f" (of what is known: {names_text(counts)})" if counts else ""
        raise ValueError(
            f"{path.name}: no protocol of common kinds has as many channels{count_text} as there are numbers: "
            f"{numbers.shape}. Are there columns of other things? Otherwise write a description with your own "
            "[protocol], see docs/reference/description.md."
        )
    candidates.sort(key=lambda item: np.hypot(item.spread, 0.3 if item.reciprocity is None else item.reciprocity))
    progress("uniform body")
    models: dict[int, ForwardModel] = {}
    compared = [_with_misfit(item, models) for item in candidates[:_MAX_COMPARED]]
    compared.sort(key=lambda item: (round(item.unexplained, 3), len(item.protocol)))
    winner = compared[0]
    rivals = [item for item in compared[1:] if item.unexplained < _RIVAL_RATIO * winner.unexplained + _RIVAL_MARGIN]
    if not winner.is_cut_off:
        rivals = [item for item in rivals if not item.is_cut_off]
    winner = _with_gains(winner, models)
    compared[0] = winner
    contact = {"contact_impedance": _contact_impedance(winner, models[winner.protocol["number"]])}
    tables = {"geometry": geometry, "electrodes": {**contact, **electrodes, "number": winner.protocol["number"]}}
    tables["protocol"] = {**winner.protocol, "current": current}
    text = _text(path, numbers.shape, numbers.data, winner, rivals, tables)
    return Findings((*compared, *candidates[_MAX_COMPARED:]), tuple(rivals), text, known="kind" in (known or {}))


def _described_body(
    path: Path,
    format: str,
    geometry: dict[str, Any],
    electrodes: dict[str, Any],
    reference: Path,
    known: dict[str, Any],
) -> Findings:
    """Findings for a file that contains its protocol; the description states only the body and its electrodes."""
    data, base = read(path, format), read(reference, format)
    number = data.protocol.num_electrodes
    if known.get("number", number) != number or "kind" in known or "order" in known:
        raise ValueError(
            f"number: {path.name} is of format '{format}', and states its protocol, of {number} electrodes: leave out "
            "what is said of it."
        )
    placements, entries = {**electrodes, "number": number}, {**electrodes, "number": number}
    if format == "quadrupoles" and (places := quadrupoles.electrode_positions(path)) is not None:
        sizes = {key: value for key, value in electrodes.items() if key not in ("layout", "levels")}
        placements, entries = {**sizes, "positions": places.tolist()}, sizes
    tables = {"geometry": geometry, "electrodes": {"contact_impedance": 1.0, **placements}}
    description = parse_description(tables, "the description")
    empty_frame = replace(base.mean_frame(), domain=description.domain, electrodes=description.electrodes)
    empty_frame = with_signs(replace(empty_frame, voltages=np.real(np.asarray(empty_frame.voltages))))
    spread = _spread(np.real(np.asarray(base.filled())))
    models: dict[int, ForwardModel] = {}
    protocol = {"kind": format, "number": number}
    candidate = Candidate(protocol, data.num_frames, spread, reciprocity_error(empty_frame), empty_frame)
    candidate = _with_misfit(candidate, models)
    contact = {"contact_impedance": _contact_impedance(candidate, models[number])}
    shape = f"{counted(data.num_frames, 'frame')} of {data.num_channels}"
    text = _text(path, shape, {}, candidate, (), {"geometry": geometry, "electrodes": {**contact, **entries}})
    return Findings((candidate,), (), text, known=True)


@dataclass(frozen=True)
class _Numbers:
    """The numbers in a file. **Fields**: `frames`: function that arranges the numbers in frames, for given possible
    numbers of channels; `shape`: their shape in words; `sizes`: possible numbers of values in a frame; `data`: entries
    of a description's table `[data]` for this arrangement."""

    path: Path
    frames: Callable[[Sequence[int]], Frames]
    shape: str
    sizes: tuple[int, ...]
    data: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path, key: str | None, excluded: str | None = None) -> _Numbers:
        """Read the numbers in a file; `key`: name of the array of frames; `excluded`: an array without frames."""
        if path.suffix.lower() in (".mat", ".npz", ".npy"):
            table, axis = _array(path, key, excluded)
            shape = " × ".join(map(str, table.shape))
            sizes = tuple(sorted({*table.shape, table.size}, reverse=True))
            return cls(
                path, lambda counts: frames_in_table(table, counts, _UNKNOWN_LAYOUT, default_axis=axis), shape, sizes
            )
        if key is not None:
            raise ValueError(f"key: {path.name} has no arrays to choose from; leave it out.")
        if OpenEit.recognises(path):
            table = OpenEit.numbers(path)[0]
            shape, sizes = f"{counted(len(table), 'line')} of {table.shape[1]}", table.shape[1:]
            return cls(path, lambda counts: frames_in_table(table, counts, _UNKNOWN_LAYOUT), shape, sizes)
        text = read_text(path)
        length, lines = int(text.lengths[0]), len(text.lengths)
        total, shape = len(text.values), f"{counted(lines, 'line')} of {length}"
        # A frame that is wrapped over several lines ends with a line.
        wrapped = {total // k for k in range(1, 1 + total // max(length, 1)) if length < total // k}
        wrapped.intersection_update(np.cumsum(text.lengths).tolist())
        table = text.values.reshape(lines, length) if total == lines * length else np.zeros((0, 0))
        sizes = tuple({length, length - 1, lines, *wrapped})
        if text.part_size:  # a separator begins a frame or a part of one
            sizes = tuple(size for size in sizes if size % text.part_size == 0)
        if lines == length == len(table) and _spread(table.T) < _spread(table):  # columns resemble each other more
            data = {"frames_in": "columns"}
            return cls(path, lambda counts: frames_in_table(table.T, counts, _UNKNOWN_LAYOUT), shape, sizes, data)
        return cls(path, lambda counts: frames_in_text(text, counts, _UNKNOWN_LAYOUT, path.name), shape, sizes)


def _spread(rows: np.ndarray) -> float:
    """Norm of the deviations of rows from their mean, divided by the norm of the rows."""
    values = np.where(np.isfinite(rows), rows, 0)
    norm = float(np.linalg.norm(values))
    return float(np.linalg.norm(values - values.mean(axis=0))) / norm if norm else 0.0


def _array(path: Path, key: str | None, excluded: str | None) -> tuple[np.ndarray, str]:
    """The array of frames in a file, and whether its frames are usually its "rows" or its "columns"."""
    if path.suffix.lower() == ".npy":
        return np.atleast_2d(npy_array(path)), "rows"
    if path.suffix.lower() == ".mat":
        sizes, axis = matlab.shapes(path), "columns"
    else:
        arrays = npz_arrays(path, *([key] if key else ["voltages"]))
        sizes, axis = {item: np.shape(arrays[item]) if item in arrays else () for item in np.ravel(arrays[""])}, "rows"
    name = key
    if name is None:
        tables = [item for item, shape in sizes.items() if item != excluded and int(np.prod(shape)) > 3]
        if len(tables) != 1:
            names = (
                names_text([f"{item} ({' × '.join(map(str, sizes[item]))})" for item in tables]) if tables else "none"
            )
            raise ValueError(f"{path.name}: arrays of numbers are {names}. Name that of the frames by key=.")
        name = tables[0]
    if name not in sizes:
        raise ValueError(
            f"key: {path.name} has no array {name!r}{did_you_mean(name, sizes)}; it has {names_text(sizes)}."
        )
    if path.suffix.lower() == ".npz":
        return np.atleast_2d(npz_arrays(path, name)[name]), axis
    table = matlab.numbers(matlab.load(path, name), name, path)
    return table.reshape(-1, 1) if 1 in table.shape else table, axis


def _protocols(number: int) -> Iterator[dict[str, Any]]:
    """Yield the table `[protocol]` of every common protocol for `number` electrodes."""
    common_options = {"driven_electrodes": (False, True), "order": ("rotating", "fixed")}
    for kind, options in (
        ("adjacent", {**common_options, "reciprocal": ("all", "half")}),
        ("two_terminal", {}),
        ("opposite", {**common_options, "drives": ("distinct", "all")}),
        *(("skip", {"skipped": (skipped,), **common_options}) for skipped in range(1, number // 2)),
    ):
        for values in product(*options.values()):
            defaults = {"driven_electrodes": False, "reciprocal": "all", "drives": "distinct"}
            entries = {key: value for key, value in zip(options, values, strict=True) if defaults.get(key) != value}
            yield {"kind": kind, "number": number, **entries}


def _fitting(
    numbers: _Numbers, base_numbers: _Numbers, geometry: dict, electrodes: dict, known: dict, current: float
) -> Iterator[Candidate]:
    """Yield candidates whose number of channels fits the file and its reference; of equal protocols, only the first."""
    counts, found_protocols = set(numbers.sizes), set()
    for number in [known["number"]] if "number" in known else range(_MIN_ELECTRODES, _MAX_ELECTRODES + 1):
        if not any(number * (number - 4) / 4 <= count <= number**2 for count in counts):
            continue
        for table in _protocols(number):
            if any(table.get(key, value) != value for key, value in known.items()):
                continue
            protocol = _protocol({**table, "current": current}, numbers.path)
            if protocol is None or protocol.num_measurements not in counts:
                continue
            if protocol.num_measurements < _MIN_CHANNELS * number:
                continue
            protocol_key = number, protocol.drive_index.tobytes(), protocol.channel_measurement.tobytes()
            if protocol_key in found_protocols:
                continue
            found_protocols.add(protocol_key)
            description = _describe_body(geometry, electrodes, table, current)
            num_frames, measurement = _measurement_of(numbers, description, protocol)
            base = measurement if base_numbers is numbers else _measurement_of(base_numbers, description, protocol)[1]
            if measurement is not None and base is not None:
                empty_frame = base.mean_frame()
                spread = _spread(np.asarray(base.filled()))
                yield Candidate(table, num_frames, spread, reciprocity_error(empty_frame), empty_frame)


def _channel_counts(known: dict) -> list[int]:
    """Numbers of channels of protocols that have the `known` entries; empty without the number of electrodes."""
    tables = _protocols(known["number"]) if "number" in known else ()
    fitting = [table for table in tables if all(table.get(key, value) == value for key, value in known.items())]
    protocols = [_protocol({**table, "current": 1.0}, Path("a")) for table in fitting]
    return sorted({protocol.num_measurements for protocol in protocols if protocol is not None})


def _describe_body(geometry: dict, electrodes: dict, protocol: dict, current: float) -> Description:
    places = {"contact_impedance": 1.0, **electrodes, "number": protocol["number"]}
    tables = {"geometry": geometry, "electrodes": places, "protocol": {**protocol, "current": current}}
    return parse_description(tables, "the description")


def _protocol(table: dict, path: Path) -> Protocol | None:
    """The protocol of a description's table `[protocol]`; None if the protocol has no channels."""
    try:
        return parse_description({"protocol": table}, "the description").protocol(path)
    except ValueError:  # none of its channels is left, or there are too few electrodes
        return None


def _measurement_of(numbers: _Numbers, description: Description, protocol: Protocol) -> tuple[int, Measurement | None]:
    """Number of frames of a file with `protocol`, and at most `_MAX_FRAMES` of them as a measurement; None if the
    numbers do not fit the protocol."""
    try:
        frames = numbers.frames([protocol.num_measurements])
        if frames.table.shape[1] != protocol.num_measurements:
            return 0, None
        num_frames = len(frames.table)
        chosen = np.unique(np.linspace(0, num_frames - 1, _MAX_FRAMES).round().astype(int))
        some_frames = frames._replace(table=frames.table[chosen], times=None)
        return num_frames, measurement_in(numbers.path, description, some_frames, [(protocol, "")])
    except ValueError:
        return 0, None


def _with_misfit(candidate: Candidate, models: dict[int, ForwardModel]) -> Candidate:
    """The candidate with the wiring that explains the empty body best. Candidates with equally many electrodes share a
    mesh."""
    number, empty_frame = candidate.protocol["number"], candidate.measurement
    assert empty_frame.domain is not None
    assert empty_frame.electrodes is not None
    if number not in models:
        is_solid = isinstance(empty_frame.domain, Solid)
        mesh = body_mesh(empty_frame.domain, empty_frame.electrodes, _NODES[3 if is_solid else 2])
        models[number] = ForwardModel(mesh, empty_frame.electrodes, empty_frame.protocol)
    return replace(candidate, wiring=find_wiring(models[number].with_protocol(empty_frame.protocol), empty_frame))


def _with_gains(candidate: Candidate, models: dict[int, ForwardModel]) -> Candidate:
    """The candidate with gains of its measurement patterns, if they explain most of the reciprocity error."""
    if candidate.reciprocity is None or candidate.reciprocity < _MIN_GAIN_ERROR:
        return candidate
    gains, error = channel_gains(candidate.measurement)
    if gains is None or error is None or error > _MAX_GAIN_RATIO * candidate.reciprocity:
        return candidate
    values = (
        np.asarray(candidate.measurement.voltages) / gains[np.asarray(candidate.measurement.protocol.measurement_index)]
    )
    corrected = replace(
        candidate, measurement=replace(candidate.measurement, voltages=values), reciprocity=error, gains=gains
    )
    return _with_misfit(corrected, models)


def _contact_impedance(winner: Candidate, model: ForwardModel) -> float:
    """Initial contact impedance: a hundredth of the size of the body, divided by the conductivity that explains the
    empty body."""
    size = float(np.ptp(np.asarray(model.mesh.points), axis=0).max())
    winner_model = model.with_protocol(winner.measurement.protocol)
    contacts = np.full(winner.protocol["number"], _RELATIVE_CONTACT * size)
    winner_model = winner_model.with_electrodes(winner_model.electrodes.with_contact_impedance(contacts))
    used = np.asarray(winner.measurement.mask)[0]
    expected, measured = np.asarray(winner_model.voltages(1.0))[used], np.asarray(winner.measurement.voltages)[0][used]
    resistivity = abs(np.vdot(expected, measured)) / np.vdot(expected, expected).real
    return float(f"{_RELATIVE_CONTACT * size * resistivity:.2g}")


def _text(
    path: Path,
    shape: str,
    data: dict[str, Any],
    best: Candidate,
    rivals: Sequence[Candidate],
    tables: dict[str, dict[str, Any]],
) -> str:
    """The file's description in TOML, with the evidence as comments. `shape`: shape of the numbers in words; `data`:
    entries of the table `[data]`, which describe the arrangement of the numbers."""
    notes = [note for note in best.measurement.notes if not note.startswith("[protocol]")]
    reversed_signs = best.reversed_signs or any("polarity" in note for note in notes)
    remark = "no two channels are reciprocal" if best.reciprocity is None else f"broken by {percent(best.reciprocity)}"
    explanation = best.wiring.explanation if best.wiring is not None and not best.reversed_signs else ""
    lines = [
        f"Written by `jeit describe {path.name}` ({shape} numbers). Lengths in metres, currents in amperes.",
        f"{best.name}: a uniform body misses {percent(best.misfit)} of the empty one; reciprocity: {remark}.",
        *(f"It may as well be {rival.name}: {percent(rival.misfit)}." for rival in rivals),
        *notes,
        *([explanation] if explanation else []),
    ]
    data = {**data, **({"polarity": "reversed"} if reversed_signs else {})}
    if best.gains is not None:
        lines.append(f"Gains of the measurements differ by {percent(float(np.std(best.gains)))}, found by reciprocity.")
        data["gains"] = [round(float(gain), 4) for gain in best.gains]
    places = "Electrodes are where the file places them."
    if "layout" in tables["electrodes"]:
        places = "No voltage says where electrode 1 is, nor which way round: taken at 12 o'clock, counter-clockwise."
    scale = "The current, and the unit of voltages, scale conductivities alone."
    sections = [
        [f"# {line}" for line in lines],
        ["[geometry]", *assignments(tables["geometry"])],
        [f"# {places}", "[electrodes]", *assignments(tables["electrodes"])],
        *([[f"# {scale}", "[protocol]", *assignments(tables["protocol"])]] if "protocol" in tables else []),
        *([["[data]", *assignments(data)]] if data else []),
    ]
    return "\n\n".join("\n".join(section) for section in sections) + "\n"
