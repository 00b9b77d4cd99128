"""Limits of descriptions: sizes are checked before memory is allocated, and currents in file names are found
quickly."""

import time
import tracemalloc

import pytest

from jeit.data.described_protocol import number_in_name
from jeit.data.description import parse_description

CURRENT = {"current": 1e-3}
MANY = {
    "electrodes": ({"kind": "adjacent", "number": 10**8}, r"protocol\.number is 100000000, and must be from 2 to 1024"),
    "all pairs": ({"kind": "two_terminal", "number": 1024}, r"protocol would take 25.8 GB in memory.*JEIT_FILE_GB=26"),
    "crossed pairs": (
        {"kind": "bipolar", "number": 4, "drive_pairs": [[0, 1]] * 20_000, "measurement_pairs": [[2, 3]] * 20_000},
        r"protocol would take 51\.2 GB",
    ),
    "an electrode that does not exist": (
        {"kind": "bipolar", "number": 4, "drive_pairs": [[0, 1]], "measurement_pairs": [[2, 4]] * 20_000},
        r"protocol\.measurement_pairs has electrode 4, and there are 4, numbered from 0 to 3",
    ),
    "an unknown option": ({"kind": "adjacent", "number": 8, "colour": 1}, r"protocol\.colour is no key"),
}
MATRICES = {
    "patterns": (
        {"drive": [[1e-3, -1e-3]] * 20_000, "measurement": [[1, -1]] * 20_000},
        r"protocol would take 38\.4 GB",
    ),
    "ragged": (
        {"drive": [[1e-3, -1e-3], [1]], "measurement": [[1, -1]]},
        r"protocol\.drive must be .*; it has 1 in a row",
    ),
    "one and a half": (
        {"drive": [[1e-3, -1e-3, 0], [1e-3, -1e-3]], "measurement": [[1, -1]]},
        r"protocol\.drive must be .*; it has rows of 3 and of 2",
    ),
    "not finite": (
        {"drive": [[1e-3, -1e-3]], "measurement": [[1, float("nan")]]},
        r"protocol\.measurement must be .* nan in it",
    ),
    "text": ({"drive": [["a", -1e-3]], "measurement": [[1, -1]]}, r"protocol\.drive must be .* 'a' in it"),
}


@pytest.mark.parametrize(
    ("protocol", "message"),
    [(CURRENT | protocol, message) for protocol, message in MANY.values()]
    + [({"kind": "matrices"} | protocol, message) for protocol, message in MATRICES.values()],
    ids=[*MANY, *MATRICES],
)
def test_refused_before_memory_is_allocated(protocol, message):
    parse_description({}, "d.toml")  # keeps the first import, which is slow, out of the timing
    tracemalloc.start()
    start = time.process_time()
    try:
        with pytest.raises(ValueError, match=f"^d.toml: {message}") as caught:
            parse_description({"protocol": protocol}, "d.toml").protocol("a.csv")
        assert tracemalloc.get_traced_memory()[1] < 50e6
        assert time.process_time() - start < 2
    finally:
        tracemalloc.stop()
    assert len(str(caught.value)) <= 400


@pytest.mark.parametrize(
    ("pattern", "name", "number"),
    [
        ("*{current}uA*", "t_1_10.00_30uA_500Hz.csv", 30),
        ("*_{current}uA_*", "t_1_10.00_0.5uA_500Hz.csv", 0.5),
        ("{current}.csv", "30.csv", 30),
        ("*-{current}.csv", "1.5-2.25.csv", 2.25),
        ("tank*_{current}mA*.csv", "tank 3_7mA.csv", 7),
        ("*{current}*", "a1b2", 1),
        ("*_{current}uA*", "x30uA.csv", None),
        ("*{current}uA", "30uA.csv", None),
        ("[0-9]{current}uA*", "30uA.csv", None),
        ("*{current}uA*", "uA.csv", None),
        ("a*a{current}", "a1", None),
        ("*aa*aa*{current}", "aaa1", None),
        ("*aa*aa*{current}", "aaaa1", 1),
    ],
)
def test_current_in_a_file_name(pattern, name, number):
    assert number_in_name(pattern, name) == number


def test_a_pattern_of_many_parts_is_fast():
    start = time.process_time()
    assert number_in_name("*a" * 90 + "{current}b", "1" + "a1" * 125) is None
    assert time.process_time() - start < 0.5


@pytest.mark.parametrize("pattern", ["([0-9.]+)uA", "(a+)+$", "*uA*", "{current}{current}"])
def test_error_for_a_regular_expression_shows_a_pattern(pattern):
    protocol = {"kind": "adjacent", "number": 8, "current_from_name": pattern}
    with pytest.raises(ValueError, match=r"protocol\.current_from_name must be .* '\*_\{current\}uA_\*'"):
        parse_description({"protocol": protocol}, "d.toml")
