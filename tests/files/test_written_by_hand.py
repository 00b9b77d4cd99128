"""Files that a person writes, each key of them replaced, left out and added: read, or one sentence that names a key."""

import copy
import datetime
import json
import math
import warnings

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, given, settings

from jeit.data import load_description
from jeit.design import read_described_skin
from jeit.design.study import read_study

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

# What a person may write, and what somebody may who means no good.
NUMBERS = [0, 1, 2, 3, -1, 7, 1000, 10**6, 2**63, 10**400, -(10**400), b"ff" * 2500]
REALS = [0.0, -0.0, 0.5, -1.5, 1e-300, 1e308, 30.0, 0.02, math.nan, math.inf, -math.inf]
TEXTS = ["", "adjacent", "disk", "sheet", "a", "[red]x[/red]", "é\n\t\x00", "x" * 5_000, "../../etc/passwd", "(a+)+$"]
DATES = [datetime.date(2020, 2, 29), datetime.datetime(2020, 1, 1, 12), datetime.time(7, 30)]
KEYS = ["colour", "number", "radius", "a b", "", "x" * 5000, "[red]", "positions", "kind", "wanted", "rows"]


def values(dates):
    plain = st.sampled_from([*NUMBERS, *REALS, *TEXTS, True, False, *dates])
    return st.recursive(
        plain,
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(KEYS), inner, max_size=3),
        max_leaves=6,
    )


def places(table, before=()):
    """Every key and every item of a table, as the steps that lead to it."""
    items = table.items() if isinstance(table, dict) else enumerate(table) if isinstance(table, list) else ()
    return [place for step, inner in items for place in ((*before, step), *places(inner, (*before, step)))]


@st.composite
def changed(draw, tables, dates=DATES):
    """One of the tables with one to three changes, and the keys of it."""
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
    """A value as TOML writes it."""
    match value:
        case bool():
            return str(value).lower()
        case int():
            return str(value)
        case bytes():  # a number that Python reads and does not write
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


def told(read):
    """What is said where a file is refused, None where it is read. Anything but a `ValueError` is raised."""
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


quick = settings(max_examples=200, deadline=None, derandomize=True, database=None, suppress_health_check=[*HealthCheck])


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tmp_path_factory.mktemp("files") / "a_30uA.toml"


def write(file, table):
    file.write_text("\n".join(f"{json.dumps(key)} = {toml(value)}" for key, value in table.items()), "utf-8")


@given(case=changed(DESCRIPTIONS.values()))
@quick
def test_descriptions(file, case):
    write(file, case[0])
    check(told(lambda: load_description(file).protocol(file)), case[1])


@given(case=changed([STUDY]))
@quick
def test_studies(file, case):
    write(file, case[0])
    check(told(lambda: read_study(file)), case[1])


@given(case=changed([SKIN]))
@quick
def test_skins(file, case):
    write(file, case[0])
    check(told(lambda: read_described_skin(file)), case[1])


@pytest.mark.parametrize("name", DESCRIPTIONS)
def test_descriptions_that_changes_begin_with_are_read(file, name):
    write(file, DESCRIPTIONS[name])
    assert load_description(file).protocol(file).num_measurements > 0


def test_studies_and_skins_that_changes_begin_with_are_read(file):
    write(file, STUDY)
    assert len(read_study(file).points) == 32
    write(file, SKIN)
    assert read_described_skin(file).model.protocol.num_measurements == 20
