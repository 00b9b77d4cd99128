"""Hand-written files with keys replaced, removed and added: each is read, or one sentence names the faulty key."""

import copy
import datetime
import functools
import inspect
import json
import math
import subprocess
import sys
import warnings
from typing import Annotated, get_args

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, given, settings

from jeit import protocol
from jeit.acoustic import Calibration
from jeit.acoustic.calibration.calibration_tables import CalibrationTable, MicrophoneTable
from jeit.acoustic.decay import DECAY_MODELS
from jeit.data import description_tables, load_description
from jeit.data.described_body import ELECTRODES, SHAPES
from jeit.design import read_described_skin
from jeit.design.study import read_study
from jeit.files.limits import faults_message
from jeit.files.schema import Number, Table, Word, validated

DESCRIPTIONS = {
    "disk": {
        "geometry": {"shape": "disk", "radius": 0.1, "centre": [0.0, 0.0]},
        "electrodes": {"layout": "ring", "number": 8, "clockwise": True, "width": 0.005, "contact_impedance": 0.01},
        "protocol": {"kind": "adjacent", "current_from_name": "*_{current}uA*", "current_unit": "uA"},
        "data": {"frames_in": "columns", "gain": 10, "frame_names": ["reference"], "delimiter": ";", "saturation": 1.0},
        "notes": {"text": ["a note"]},
    },
    "polygon": {
        "geometry": {
            "shape": "polygon",
            "vertices": [[0, 0], [1, 0], [1, 1]],
            "holes": [[[0.6, 0.5], [0.7, 0.5], [0.7, 0.6]]],
        },
        "electrodes": {"kind": "point", "positions": [[0, 0], [0.5, 0], [1, 0], [1, 1]]},
        "protocol": {"kind": "bipolar", "current": 1e-3, "drive_pairs": [[0, 1]], "measurement_pairs": [[2, 3]]},
    },
    "cylinder": {
        "geometry": {"shape": "cylinder", "radius": 0.05, "height": 0.04},
        "electrodes": {
            "kind": "disc",
            "layout": "perimeter",
            "number": 4,
            "levels": [0.01, 0.03],
            "radius": 0.005,
            "contact_impedance": [1e-3] * 8,
        },
        "protocol": {
            "kind": "all_against_one",
            "current": 1,
            "current_unit": "mA",
            "common": 3,
            "measurement": "adjacent",
        },
    },
    "box": {
        "geometry": {"shape": "box", "width": 0.05, "depth": 0.05, "height": 0.04},
        "electrodes": {
            "kind": "patch",
            "layout": "perimeter",
            "number": 4,
            "start": 0.02,
            "levels": 0.01,
            "width": 0.005,
            "height": 0.004,
            "contact_impedance": 1e-3,
        },
        "protocol": {"kind": "skip", "current": 1e-3, "number": 8, "skipped": 1, "reciprocal": "half"},
    },
    "matrices": {
        "protocol": {
            "kind": "matrices",
            "drive": [[1e-3, -1e-3, 0]],
            "measurement": [[0, 1, -1], [1, 0, -1]],
            "select": [[True, False]],
        },
    },
    "channels": {
        "protocol": {
            "kind": "channels",
            "drive": [[1e-3, -1e-3, 0]],
            "measurement": [[0, 1, -1], [1, 0, -1]],
            "drive_index": [0, 0],
            "measurement_index": [1, 0],
        },
    },
    "pairs": {
        "protocol": {
            "kind": "two_terminal",
            "number": 8,
            "current": 1e-3,
            "pairs": [[0, 1], [2, 3]],
            "name": "my pairs",
        }
    },
}

STUDY = {
    "name": "a study",
    "chunk_points": 4,
    "skin": {
        "model": "sheet",
        "width_mm": 100,
        "height_mm": 100.0,
        "thickness_mm": [5, 10],
        "conductivity_S_per_m": 1.0,
    },
    "electrodes": {
        "layouts": ["grid-4x4", "perimeter-8"],
        "diameter_mm": [6, 8],
        "contact_impedance_ohm_m2": 1e-3,
        "minimum_gap_mm": 1,
    },
    "measurement": {"protocol": ["two-terminal"], "pairs": [0, 20], "current_mA": 1, "noise_V": [1e-5, 1e-6]},
    "touch": {"indentation": "bell", "depth_mm": 2, "deviation_mm": 7.5, "contrast": 0, "columns": 10, "rows": 10},
    "mesh": {"cell_mm": 4.5},
    "scores": {"wanted": ["minimum", "taxels", "information"], "num_taxels": 9, "threshold": 0.7, "seed": 1},
}
SKIN = {
    "skin": {"model": "sheet", "width_mm": 100, "height_mm": 100.0, "thickness_mm": 10, "conductivity_S_per_m": 1.0},
    "electrodes": {"layout": "grid-4x4", "diameter_mm": 6, "contact_impedance_ohm_m2": 1e-3},
    "measurement": {"protocol": "two-terminal", "pairs": 20, "current_mA": 1},
    "mesh": {"cell_mm": 6, "layers": 3},
}

NOISE = {
    "relative_noise": 0.1,
    "noise_floor": 1e-9,
    "noise_deviation": 1e-9,
    "noise_cross": 0,
    "usable": True,
    "reason": "",
}
PLANE = {
    "format": "jeit microphone calibration",
    "version": 1,
    "units": {"length": "m", "intensity": "square of the samples' unit"},
    "scale": "strength 1 is a typical one",
    "name": "taps of Friday",
    "decay": "inverse-square",
    "surface": {"outline": [[0, 0], [0.2, 0], [0.2, 0.2]], "holes": [[[0.1, 0.05], [0.11, 0.05], [0.11, 0.06]]]},
    "intensity": {"low": 50, "high": 1000.0, "window": 0.05, "hop": 0.0125},
    "strengths": [0.1, 2],
    "widening": 1.5,
    "microphones": [
        {"position": place, "a": 1e-3, "b": 0.5, "relative_standard_error": {"a": 0.01, "b": None}, **NOISE}
        for place in ([0.0, 0.0], [0.2, 0.0], [0.2, 0.2])
    ],
}
CURVE = {"origin": [0, 0, 0], "axes": [[1, 0], [0, 1], [0, 0]], "normal": [0, 0, 1]}
CURVE |= {"knots": [[0, 0], [0.2, 0], [0, 0.2]], "weights": [0, 0, 0], "affine": [0.01, 0, 0]}
CURVED = PLANE | {
    "decay": "attenuated",
    "surface": {"outline": [[0, 0], [0.2, 0], [0.2, 0.2]], "holes": [], "curve": CURVE},
    "microphones": [
        {
            **one,
            "position": [*one["position"], 0.01],
            "length": 0.1,
            "relative_standard_error": dict.fromkeys(("a", "b", "length")),
        }
        for one in PLANE["microphones"]
    ],
}

# Values that users may write by mistake, and values that an attacker may write.
NUMBERS = [0, 1, 2, 3, -1, 7, 1000, 10**6, 2**63, 10**400, -(10**400), b"ff" * 2500]
REALS = [0.0, -0.0, 0.5, -1.5, 1e-300, 1e308, 30.0, 0.02, math.nan, math.inf, -math.inf]
TEXTS = ["", "adjacent", "disk", "sheet", "a", "[red]x[/red]", "é\n\t\x00", "x" * 5_000, "../../etc/passwd", "(a+)+$"]
DATES = (datetime.date(2020, 2, 29), datetime.datetime(2020, 1, 1, 12), datetime.time(7, 30))
KEYS = ["colour", "number", "radius", "a b", "", "x" * 5000, "[red]", "positions", "kind", "wanted", "rows"]


@functools.cache  # Hypothesis takes milliseconds to validate a new strategy
def values(dates):
    plain = st.sampled_from([*NUMBERS, *REALS, *TEXTS, True, False, *dates])
    return st.recursive(
        plain,
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(KEYS), inner, max_size=3),
        max_leaves=6,
    )


def places(table, before=()):
    """The path of every key and every item of a table."""
    items = table.items() if isinstance(table, dict) else enumerate(table) if isinstance(table, list) else ()
    return [place for step, inner in items for place in ((*before, step), *places(inner, (*before, step)))]


@st.composite
def changed(draw, tables, dates=DATES):
    """One of the tables with one to three changes, and the set of its keys."""
    table = copy.deepcopy(draw(st.sampled_from([*tables])))
    names = {step for place in places(table) for step in place if isinstance(step, str)}
    for _ in range(draw(st.integers(1, 3))):
        *above, last = draw(st.sampled_from(places(table) or [("colour",)]))
        inner = table
        for step in above:
            inner = inner[step]
        match draw(st.sampled_from(["replace", "replace", "leave out", "add"])):
            case "leave out" if isinstance(inner, dict) or len(inner) > 1:
                inner.pop(last, None) if isinstance(inner, dict) else inner.pop(last)
            case "add" if isinstance(inner, dict):
                key = draw(st.sampled_from(KEYS))
                names.add(key)
                inner[key] = draw(values(dates))
            case _:
                inner[last] = draw(values(dates))
    return table, names | {step for place in places(table) for step in place if isinstance(step, str)}


def toml(value):
    """Format a value as TOML."""
    match value:
        case bool():
            return str(value).lower()
        case int():
            return str(value)
        case bytes():  # an integer too long for Python to format
            return f"0x{value.decode()}"
        case float():
            return repr(value)
        case str():
            return json.dumps(value)
        case list():
            return f"[{', '.join(map(toml, value))}]"
        case dict():
            return f"{{{', '.join(f'{json.dumps(key)} = {toml(inner)}' for key, inner in value.items())}}}"
    return value.isoformat()


def refusal(read):
    """Return the error message if a file is refused and None if it is read. Any exception but `ValueError` is
    raised."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            read()
        except ValueError as error:
            return str(error)
    return None


def check(message, names):
    if message is not None:
        assert 0 < len(message) <= 400, message
        assert "should not have happened" not in message
        assert any(name[:20] in message for name in names if name), message


def jsoned(value):
    """Format a value as JSON; an integer too long for Python is written as a one with 5,000 zeros."""
    if isinstance(value, dict):
        return f"{{{', '.join(f'{json.dumps(key)}: {jsoned(inner)}' for key, inner in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(jsoned, value))}]"
    return f"1{'0' * 5000}" if isinstance(value, bytes) else json.dumps(value)


quick = settings(max_examples=100, deadline=None, derandomize=True, database=None, suppress_health_check=[*HealthCheck])


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tmp_path_factory.mktemp("files") / "a_30uA.toml"


def write(file, table):
    file.write_text("\n".join(f"{json.dumps(key)} = {toml(value)}" for key, value in table.items()), "utf-8")


@given(case=changed(DESCRIPTIONS.values()))
@quick
def test_descriptions(file, case):
    write(file, case[0])
    check(refusal(lambda: load_description(file).protocol(file)), case[1])


@given(case=changed([STUDY]))
@quick
def test_studies(file, case):
    write(file, case[0])
    check(refusal(lambda: read_study(file)), case[1])


@given(case=changed([SKIN]))
@settings(quick, max_examples=60)
def test_skins(file, case):
    write(file, case[0])
    check(refusal(lambda: read_described_skin(file)), case[1])


@given(case=changed([PLANE, CURVED], dates=(None,)))
@quick
def test_calibrations(file, case):
    file.write_text(jsoned(case[0]), "utf-8")
    check(refusal(lambda: Calibration.load(file)), case[1] | {"calibration"})


@pytest.mark.parametrize("name", DESCRIPTIONS)
def test_unchanged_descriptions_are_read(file, name):
    write(file, DESCRIPTIONS[name])
    assert load_description(file).protocol(file).num_measurements > 0


def test_unchanged_studies_and_skins_are_read(file):
    write(file, STUDY)
    assert len(read_study(file).points) == 32
    write(file, SKIN)
    assert read_described_skin(file).model.protocol.num_measurements == 20


def test_unchanged_calibrations_are_read(file):
    for one in (PLANE, CURVED):
        file.write_text(jsoned(one), "utf-8")
        assert Calibration.load(file).num_microphones == 3


def test_tables_cover_all_kinds_and_options():
    assert {*get_args(CalibrationTable.model_fields["decay"].annotation)} == {*DECAY_MODELS}
    assert {name for kind in DECAY_MODELS.values() for name in kind.parameters} <= {*MicrophoneTable.model_fields}
    assert {*kinds(description_tables.GeometryTable, "shape")} == {*SHAPES}
    assert {*kinds(description_tables.ElectrodesTable, "kind")} == {*ELECTRODES, "facets"}
    constructed = kinds(description_tables.ConstructedTable, "kind")
    no_kinds = {"Protocol", "from_channels", "from_matrices", "measurement_patterns"}
    assert {*constructed, "optimal"} == {*protocol.__all__} - no_kinds
    assert "optimal" in kinds(description_tables.ProtocolTable, "kind")
    for kind, table in constructed.items():
        options = {*inspect.signature(getattr(protocol, kind)).parameters} - {"num_electrodes", "num_boundary"}
        assert options <= {*table.model_fields}, kind


def kinds(tables, key):
    """The tables of a union by the value of their discriminating key."""
    keyed = [table for table in get_args(tables) if key in table.model_fields]
    return {word: table for table in keyed for word in get_args(table.model_fields[key].annotation)}


def test_faults_are_named_by_their_path():
    with pytest.raises(ValueError, match=r"^a\.json: microphones\[1\]\.a is -1, and must be above 0\. strengths"):
        validated(Small, {"microphones": [{"a": 1}, {"a": -1}], "strengths": 3}, "a.json")
    with pytest.raises(ValueError, match=r"^a\.json: 'a b' is no key of a list; there are microphones, strengths\.$"):
        validated(Small, {"microphones": [], "strengths": [], "a b": 1}, "a.json")
    with pytest.raises(ValueError, match=r" Wrong too: 2, 3, 4, .*, 11\. And 88 more\.$"):
        validated(Small, {str(key): 1 for key in range(999)}, "a" * 1000)


def test_faults_beyond_the_length_limit_are_named_by_their_key():
    """Up to ten are named. The list of all keys is omitted in favour of other faults if a similar key is suggested."""
    eight = {name * 9: 1 for name in "abcdefgh"}
    with pytest.raises(ValueError, match=r"^a\.json: ") as caught:
        validated(Small, {"microphones": [], "strengths": [], **eight}, "a.json")
    assert all(name in str(caught.value) for name in eight)
    assert "more" not in str(caught.value)
    there = ", ".join("x" * 30 for _ in range(10))
    sentences = ["a is missing; give it.", f"b is no key (did you mean 'c'?); there are {there}.", "d is bad."]
    message = faults_message("a.json", sentences, ["a", "b", "d"])
    assert message == "a.json: a is missing; give it. b is no key (did you mean 'c'?). d is bad."
    assert faults_message("a.json", [f"{there}."] * 3, ["a", "b", "d"]) == f"a.json: {there}. Wrong too: b, d."
    assert len(faults_message("a.json", [there] * 30, ["k" * 40] * 30)) <= 400


class One(Table):
    """A row of the table."""

    a: Annotated[float, Number(5e-324, math.inf)]


class Small(Table):
    """A table of tables."""

    name_in_messages = "a list"
    microphones: list[One]
    strengths: list[float]


class Named(Table):
    """A table of one word."""

    name_in_messages = "a name"
    word: Word


def test_empty_text_is_refused():
    with pytest.raises(ValueError, match=r"^a\.json: word is empty text"):
        validated(Named, {"word": ""}, "a.json")


def test_large_packages_are_imported_on_use():
    """This keeps the import time, which is a benchmark, short; pydantic is imported with the first file that is
    read."""
    program = (
        "import sys, jeit\n"
        "print([m for m in ('matplotlib', 'optimistix', 'meshio', 'scipy.io') if m in sys.modules])\n"
        "import jeit.acoustic, jeit.data, jeit.design, jeit.design.study, jeit.cli\n"
        "print('pydantic' in sys.modules)\n"
        "from jeit.data.description import parse_description\n"
        "parse_description({}, 'a.toml')\n"
        "print('pydantic' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.stdout.split() == ["[]", "False", "True"], done.stderr
