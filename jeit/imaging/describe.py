"""Description of a file of voltages that nobody has described: what it may be, with the evidence.

Protocols of common kinds whose number of channels fits the file are compared: by reciprocity, which needs no model, and
by the misfit of a uniform body of the given shape (`jeit.imaging.wiring`), in a frame of the empty body.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from jeit.arguments import counted, did_you_mean, listed, percent
from jeit.data import Measurement, read
from jeit.data.description import Description, TableLayout, parse_description
from jeit.data.exchange import assignments
from jeit.data.formats import openeit, quadrupoles
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

# Fewest and most electrodes of the protocols that are tried; nodes of the mesh on which these are compared, of a sheet
# and a solid.
_FEWEST, _MOST, _NODES = 4, 64, {2: 700, 3: 4000}
# Unexplained share of the empty body above which an explanation is not good enough to go on; and that above which it is
# not although the kind of protocol is known, or any other order of the channels leaves `_ORDERED` times as much.
_HOPELESS, _HOPELESS_EVEN_SO, _ORDERED = 0.25, 0.5, 2.0
# Spread of the frames of the empty body above which they are none of one; channels needed for each electrode: a few fit
# anything.
_UNLIKE, _LEAST_CHANNELS = 0.2, 2
# Candidates whose misfit is computed, and how much more than the best an explanation must leave to be ruled out.
_FEW, _UNDECIDED, _SMALL = 12, 1.3, 0.01
# Reciprocity error from which gains are estimated, and ratio of the error that they may leave to it.
_ACCURATE, _GAINED = 0.03, 0.4
# An arrangement of which nothing is stated.
_FOUND_OUT = TableLayout()
# Contact impedance that a description starts from, times conductivity over the size of the body.
_CONTACT = 0.01


@dataclass(frozen=True)
class Candidate:
    """What a file may be. **Fields**: `protocol`: the table `[protocol]` of a description, without the current;
    `frames`: number of frames; `spread`: deviation of the frames of the empty body from their mean, relative;
    `reciprocity`: error of the mean, None if no two channels are reciprocal; `measurement`: the mean, so read;
    `wiring`: how a uniform body explains it; `gains`: of its measurement patterns, where these explain what breaks
    reciprocity."""

    protocol: dict[str, Any]
    frames: int
    spread: float
    reciprocity: float | None
    measurement: Measurement
    wiring: Wiring | None = None
    gains: np.ndarray | None = None

    @property
    def misfit(self) -> float:
        """Relative misfit of a uniform body to the mean; infinite if it was not computed."""
        if self.wiring is None:
            return np.inf
        return self.wiring.misfit if self.reversed_signs else self.wiring.described

    @property
    def reversed_signs(self) -> bool:
        """Whether a uniform body explains the voltages with the opposite sign, and as they are otherwise."""
        return self.wiring is not None and self.wiring == Wiring(tuple(range(len(self.wiring.places))), "", True)

    @property
    def unexplained(self) -> float:
        """What the explanation leaves of all frames, relative: misfit and spread, and the reciprocity error, which has
        twice the variance of its noise."""
        return float(np.sqrt(self.misfit**2 + self.spread**2 + (self.reciprocity or 0) ** 2 / 2))

    @property
    def ordered(self) -> bool:
        """Whether the same voltages in another order of the channels would be explained far worse: a share of
        √(1 - r²) would be left on the average, with r the square of their mean over the mean of their squares."""
        values = np.asarray(self.measurement.voltages)[np.asarray(self.measurement.mask)]
        alike = abs(values.mean()) ** 2 / np.mean(np.abs(values) ** 2)
        return bool(_ORDERED * self.unexplained < np.sqrt(1 - alike**2))

    @property
    def name(self) -> str:
        """The protocol in words."""
        options = {key: value for key, value in self.protocol.items() if key not in ("kind", "number")}
        said = ", ".join(f"{key} {str(value).lower()}" for key, value in options.items())
        return f"{self.protocol['kind']}, {self.protocol['number']} electrodes{said and ', ' + said}"


@dataclass(frozen=True)
class Findings:
    """What was found out of a file. **Fields**: `candidates`: the best first; `undecided`: others that explain it as
    well; `text`: a commented description, TOML, of the best; `known`: whether the kind of the protocol was known."""

    candidates: tuple[Candidate, ...]
    undecided: tuple[Candidate, ...]
    text: str
    known: bool = False

    @property
    def fault(self) -> str:
        """Why the best explanation is not good enough to go on; empty if it is."""
        best = self.candidates[0]
        bound = _HOPELESS_EVEN_SO if self.known or best.ordered else _HOPELESS
        if best.unexplained < bound and best.spread < _UNLIKE:
            return ""
        if best.spread >= _UNLIKE:
            parts = " If its two columns are real and imaginary parts, keep one of them." if best.frames == 2 else ""
            return (
                f"the best explanation, {best.name}, makes frames of the empty body differ by {percent(best.spread)}: "
                "that is not good enough to go on. Are there columns of other things than voltages, or is the "
                f"reference one of another sensor? Name the protocol if you know it.{parts}"
            )
        broken = "" if best.reciprocity is None else f" and breaks reciprocity by {percent(best.reciprocity)}"
        wired = best.wiring.explanation if best.wiring is not None else ""
        return (
            f"the best explanation, {best.name}, misses {percent(best.misfit)} of the empty body{broken}: that is not "
            f"good enough to go on. {wired or 'Are body and electrodes as given? Name the protocol if you know it.'}"
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
    """Find out what a file of voltages may be: compare the protocols that fit it, and describe the best.

    **Arguments:**

    - `path`: file of the voltages.
    - `geometry`, `electrodes`: tables of a description, metres, the second without the number of electrodes and without
      the contact impedance, ohm·m (on a solid ohm·m²), which is estimated roughly unless given.
    - `reference`: file of the empty body; without it, the mean of all frames stands for it.
    - `keys`: arrays of the file and of the reference, where files hold several.
    - `known`: what is known of `[protocol]`, such as its kind or number.
    - `current`: amplitude, amperes.
    - `progress`: called with the name of each step when it begins.

    Raises `ValueError` for files that cannot be read, several arrays and none named, and if no protocol fits.

    **Example:**

    ```python
    geometry, electrodes = {"shape": "disk", "radius": 0.05}, {"layout": "ring", "kind": "boundary", "width": 0.008}
    print(find_description(file, geometry, electrodes).text)
    ```
    """
    if (own := format_with_protocol(path)) is not None:
        progress("read")
        return _described_body(path, own, geometry, electrodes, reference or path, known or {})
    if not known and openeit.recognises(path):
        known = openeit.protocol_table(path)
    number = (known or {}).get("number")
    if number is not None and not _FEWEST <= number <= _MOST:
        raise ValueError(f"number must be from {_FEWEST} to {_MOST} electrodes; it is {number}.")
    progress("read")
    numbers = _Numbers.read(path, keys[0], other=keys[1] if reference is None else None)
    rest = numbers if reference is None and keys[1] is None else _Numbers.read(reference or path, keys[1])
    progress("protocols that fit")
    found = list(_fitting(numbers, rest, geometry, electrodes, known or {}, current))
    if not found:
        counts = _channel_counts(known or {})
        wanted = f" (of what is known: {listed(counts)})" if counts else ""
        raise ValueError(
            f"{path.name}: no protocol of common kinds has as many channels{wanted} as there are numbers: "
            f"{numbers.shape}. Are there columns of other things? Otherwise write a description with your own "
            "[protocol], see docs/reference/description.md."
        )
    found.sort(key=lambda one: np.hypot(one.spread, 0.3 if one.reciprocity is None else one.reciprocity))
    progress("uniform body")
    models: dict[int, ForwardModel] = {}
    compared = [_with_misfit(one, models) for one in found[:_FEW]]
    compared.sort(key=lambda one: (round(one.unexplained, 3), len(one.protocol)))
    best = compared[0]
    near = [one for one in compared[1:] if one.unexplained < _UNDECIDED * best.unexplained + _SMALL]
    best = _with_gains(best, models)
    compared[0] = best
    contact = {"contact_impedance": _contact_impedance(best, models[best.protocol["number"]])}
    tables = {"geometry": geometry, "electrodes": {**contact, **electrodes, "number": best.protocol["number"]}}
    tables["protocol"] = {**best.protocol, "current": current}
    text = _text(path, numbers.shape, numbers.data, best, near, tables)
    return Findings((*compared, *found[_FEW:]), tuple(near), text, known="kind" in (known or {}))


def _described_body(
    path: Path,
    format: str,
    geometry: dict[str, Any],
    electrodes: dict[str, Any],
    reference: Path,
    known: dict[str, Any],
) -> Findings:
    """Findings of a file that states its protocol: a description of the body alone."""
    measured, rest = read(path, format), read(reference, format)
    number = measured.protocol.num_electrodes
    if known.get("number", number) != number or "kind" in known or "order" in known:
        raise ValueError(
            f"number: {path.name} is of format '{format}', and states its protocol, of {number} electrodes: leave out "
            "what is said of it."
        )
    placed, written = {**electrodes, "number": number}, {**electrodes, "number": number}
    if format == "quadrupoles" and (places := quadrupoles.electrode_positions(path)) is not None:
        sizes = {key: value for key, value in electrodes.items() if key not in ("layout", "levels")}
        placed, written = {**sizes, "positions": places.tolist()}, sizes
    tables = {"geometry": geometry, "electrodes": {"contact_impedance": 1.0, **placed}}
    body = parse_description(tables, "the description")
    empty = replace(rest.mean_frame(), domain=body.domain, electrodes=body.electrodes)
    empty = with_signs(replace(empty, voltages=np.real(np.asarray(empty.voltages))))
    spread = _spread(np.real(np.asarray(rest.filled())))
    models: dict[int, ForwardModel] = {}
    protocol = {"kind": format, "number": number}
    found = Candidate(protocol, measured.num_frames, spread, reciprocity_error(empty), empty)
    found = _with_misfit(found, models)
    contact = {"contact_impedance": _contact_impedance(found, models[number])}
    shape = f"{counted(measured.num_frames, 'frame')} of {measured.num_channels}"
    text = _text(path, shape, {}, found, (), {"geometry": geometry, "electrodes": {**contact, **written}})
    return Findings((found,), (), text, known=True)


@dataclass(frozen=True)
class _Numbers:
    """The numbers of a file: a function that arranges them in frames of one of several numbers of channels, their shape
    in words, numbers that a frame may have, and what a description has to say of their arrangement."""

    path: Path
    frames: Callable[[Sequence[int]], Frames]
    shape: str
    sizes: tuple[int, ...]
    data: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path, key: str | None, other: str | None = None) -> _Numbers:
        """Read a file; `key`: name of its array; `other`: array that is not the one."""
        if path.suffix.lower() in (".mat", ".npz", ".npy"):
            table, usual = _array(path, key, other)
            said = " × ".join(map(str, table.shape))
            sizes = tuple(sorted({*table.shape, table.size}, reverse=True))
            return cls(path, lambda counts: frames_in_table(table, counts, _FOUND_OUT, default_axis=usual), said, sizes)
        if key is not None:
            raise ValueError(f"key: {path.name} has no arrays to choose from; leave it out.")
        if openeit.recognises(path):
            table = openeit.numbers(path)[0]
            said, sizes = f"{counted(len(table), 'line')} of {table.shape[1]}", table.shape[1:]
            return cls(path, lambda counts: frames_in_table(table, counts, _FOUND_OUT), said, sizes)
        text = read_text(path)
        length, lines = int(text.lengths[0]), len(text.lengths)
        total, said = len(text.values), f"{counted(lines, 'line')} of {length}"
        parts = {total // k for k in range(1, 1 + total // max(length, 1)) if length < total // k}
        table = text.values.reshape(lines, length) if total == lines * length else np.zeros((0, 0))
        sizes = tuple({length, length - 1, lines, *parts})
        if lines == length == len(table) and _spread(table.T) < _spread(table):  # alike are the columns
            data = {"frames_in": "columns"}
            return cls(path, lambda counts: frames_in_table(table.T, counts, _FOUND_OUT), said, sizes, data)
        return cls(path, lambda counts: frames_in_text(text, counts, _FOUND_OUT, path.name), said, sizes)


def _spread(rows: np.ndarray) -> float:
    """Deviation of rows from their mean, relative."""
    known = np.where(np.isfinite(rows), rows, 0)
    size = float(np.linalg.norm(known))
    return float(np.linalg.norm(known - known.mean(axis=0))) / size if size else 0.0


def _array(path: Path, key: str | None, other: str | None) -> tuple[np.ndarray, str]:
    """The array of frames in a file, and where its frames usually are."""
    if path.suffix.lower() == ".npy":
        return np.atleast_2d(npy_array(path)), "rows"
    if path.suffix.lower() == ".mat":
        held, usual = matlab.shapes(path), "columns"
    else:
        arrays = npz_arrays(path, *([key] if key else ["voltages"]))
        held, usual = {one: np.shape(arrays[one]) if one in arrays else () for one in np.ravel(arrays[""])}, "rows"
    name = key
    if name is None:
        long = [one for one, shape in held.items() if one != other and int(np.prod(shape)) > 3]
        if len(long) != 1:
            shown = listed([f"{one} ({' × '.join(map(str, held[one]))})" for one in long]) if long else "none"
            raise ValueError(f"{path.name}: arrays of numbers are {shown}. Name that of the frames by key=.")
        name = long[0]
    if name not in held:
        raise ValueError(f"key: {path.name} has no array {name!r}{did_you_mean(name, held)}; it has {listed(held)}.")
    if path.suffix.lower() == ".npz":
        return np.atleast_2d(npz_arrays(path, name)[name]), usual
    table = matlab.numbers(matlab.load(path, name), name, path)
    return table.reshape(-1, 1) if 1 in table.shape else table, usual


def _protocols(number: int) -> Iterator[dict[str, Any]]:
    """Tables of the protocols of common kinds of so many electrodes."""
    plain = {"driven_electrodes": (False, True), "order": ("rotating", "fixed")}
    for kind, options in (
        ("adjacent", {**plain, "reciprocal": ("all", "half")}),
        ("two_terminal", {}),
        ("opposite", {**plain, "drives": ("distinct", "all")}),
        *(("skip", {"skipped": (skipped,), **plain}) for skipped in range(1, number // 2)),
    ):
        for values in product(*options.values()):
            usual = {"driven_electrodes": False, "reciprocal": "all", "drives": "distinct"}
            given = {key: value for key, value in zip(options, values, strict=True) if usual.get(key) != value}
            yield {"kind": kind, "number": number, **given}


def _fitting(
    numbers: _Numbers, rest: _Numbers, geometry: dict, electrodes: dict, known: dict, current: float
) -> Iterator[Candidate]:
    """Candidates whose frames fit both files, without those that are the same in another order."""
    counts, seen = set(numbers.sizes), set()
    for number in [known["number"]] if "number" in known else range(_FEWEST, _MOST + 1):
        if not any(number * (number - 4) / 4 <= count <= number**2 for count in counts):
            continue
        for table in _protocols(number):
            if any(table.get(key, value) != value for key, value in known.items()):
                continue
            protocol = _protocol({**table, "current": current}, numbers.path)
            if protocol is None or protocol.num_measurements not in counts:
                continue
            if protocol.num_measurements < _LEAST_CHANNELS * number:
                continue
            same = number, protocol.drive_index.tobytes(), protocol.channel_measurement.tobytes()
            if same in seen:
                continue
            seen.add(same)
            described = _described(geometry, electrodes, table, current)
            read = [_measured(one, described, protocol) for one in (numbers, rest)]
            if read[0] is not None and read[1] is not None:
                empty = read[1].mean_frame()
                spread = _spread(np.asarray(read[1].filled()))
                yield Candidate(table, read[0].num_frames, spread, reciprocity_error(empty), empty)


def _channel_counts(known: dict) -> list[int]:
    """Numbers of channels of the protocols that agree with what is known, if the number of electrodes is."""
    tables = _protocols(known["number"]) if "number" in known else ()
    fitting = [one for one in tables if all(one.get(key, value) == value for key, value in known.items())]
    made = [_protocol({**one, "current": 1.0}, Path("a")) for one in fitting]
    return sorted({one.num_measurements for one in made if one is not None})


def _described(geometry: dict, electrodes: dict, protocol: dict, current: float) -> Description:
    places = {"contact_impedance": 1.0, **electrodes, "number": protocol["number"]}
    tables = {"geometry": geometry, "electrodes": places, "protocol": {**protocol, "current": current}}
    return parse_description(tables, "the description")


def _protocol(table: dict, path: Path) -> Protocol | None:
    """The protocol of a table; None if it has no channels."""
    try:
        return parse_description({"protocol": table}, "the description").protocol(path)
    except ValueError:  # none of its channels is left, or there are too few electrodes
        return None


def _measured(numbers: _Numbers, described: Description, protocol: Protocol) -> Measurement | None:
    """The measurement of numbers that are of this protocol; None if they do not fit it."""
    try:
        found = numbers.frames([protocol.num_measurements])
        if found.table.shape[1] != protocol.num_measurements:
            return None
        return measurement_in(numbers.path, described, found, [(protocol, "")])
    except ValueError:
        return None


def _with_misfit(one: Candidate, models: dict[int, ForwardModel]) -> Candidate:
    """The candidate with the wiring that explains the empty body best, on a mesh that candidates of as many electrodes
    share."""
    number, empty = one.protocol["number"], one.measurement
    assert empty.domain is not None
    assert empty.electrodes is not None
    if number not in models:
        solid = isinstance(empty.domain, Solid)
        mesh = body_mesh(empty.domain, empty.electrodes, _NODES[3 if solid else 2])
        models[number] = ForwardModel(mesh, empty.electrodes, empty.protocol)
    return replace(one, wiring=find_wiring(models[number].with_protocol(empty.protocol), empty))


def _with_gains(one: Candidate, models: dict[int, ForwardModel]) -> Candidate:
    """The candidate with gains of its measurements, if they explain most of what breaks reciprocity."""
    if one.reciprocity is None or one.reciprocity < _ACCURATE:
        return one
    gains, left = channel_gains(one.measurement)
    if gains is None or left is None or left > _GAINED * one.reciprocity:
        return one
    values = np.asarray(one.measurement.voltages) / gains[np.asarray(one.measurement.protocol.measurement_index)]
    corrected = replace(one, measurement=replace(one.measurement, voltages=values), reciprocity=left, gains=gains)
    return _with_misfit(corrected, models)


def _contact_impedance(best: Candidate, model: ForwardModel) -> float:
    """A contact impedance to begin with: a hundredth of the size of the body over the conductivity that explains the
    empty body."""
    size = float(np.ptp(np.asarray(model.mesh.points), axis=0).max())
    there = model.with_protocol(best.measurement.protocol)
    each = np.full(best.protocol["number"], _CONTACT * size)
    there = there.with_electrodes(there.electrodes.with_contact_impedance(each))
    used = np.asarray(best.measurement.mask)[0]
    expected, measured = np.asarray(there.voltages(1.0))[used], np.asarray(best.measurement.voltages)[0][used]
    resistivity = abs(np.vdot(expected, measured)) / np.vdot(expected, expected).real
    return float(f"{_CONTACT * size * resistivity:.2g}")


def _text(
    path: Path,
    shape: str,
    data: dict[str, Any],
    best: Candidate,
    near: Sequence[Candidate],
    tables: dict[str, dict[str, Any]],
) -> str:
    """The description in TOML, with the evidence as comments. `shape` of the numbers in words; `data`: what `[data]`
    has to say of their arrangement."""
    notes = [note for note in best.measurement.notes if not note.startswith("[protocol]")]
    reversed_signs = best.reversed_signs or any("polarity" in note for note in notes)
    broken = "no two channels are reciprocal" if best.reciprocity is None else f"broken by {percent(best.reciprocity)}"
    explained = best.wiring.explanation if best.wiring is not None and not best.reversed_signs else ""
    lines = [
        f"Written by `jeit describe {path.name}` ({shape} numbers). Lengths in metres, currents in amperes.",
        f"{best.name}: a uniform body misses {percent(best.misfit)} of the empty one; reciprocity: {broken}.",
        *(f"It may as well be {one.name}: {percent(one.misfit)}." for one in near),
        *notes,
        *([explained] if explained else []),
    ]
    data = {**data, **({"polarity": "reversed"} if reversed_signs else {})}
    if best.gains is not None:
        lines.append(f"Gains of the measurements differ by {percent(float(np.std(best.gains)))}, found by reciprocity.")
        data["gains"] = [round(float(one), 4) for one in best.gains]
    places = "Electrodes are where the file places them."
    if "layout" in tables["electrodes"]:
        places = "No voltage says where electrode 1 is, nor which way round: taken at 12 o'clock, counter-clockwise."
    scale = "The current, and the unit of voltages, scale conductivities alone."
    parts = [
        [f"# {line}" for line in lines],
        ["[geometry]", *assignments(tables["geometry"])],
        [f"# {places}", "[electrodes]", *assignments(tables["electrodes"])],
        *([[f"# {scale}", "[protocol]", *assignments(tables["protocol"])]] if "protocol" in tables else []),
        *([["[data]", *assignments(data)]] if data else []),
    ]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"
