"""The file of a calibration: a saved calibration is read again bit by bit, and other files are refused."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from microphone_arrays import MICROPHONES, OUTLINE, array

from jeit.acoustic import Calibration, IntensitySettings, MicrophoneArray
from jeit.acoustic.decay import AttenuatedInverseSquare, Exponential
from jeit.acoustic.microphones import IntensityNoise
from jeit.acoustic.surface import make_surface
from jeit.mesh import Polygon

HOLE = [[0.01, 0.01], [0.01, 0.03], [0.03, 0.03], [0.03, 0.01]]


def calibration(microphone_array, intensity=None):
    count = len(microphone_array.microphones)
    errors = np.abs(np.random.default_rng(0).normal(size=(len(microphone_array.decay.parameters), count)))
    errors[:, 2] = np.nan
    usable = np.arange(count) != 2
    reasons = tuple("" if good else "dead: every intensity is 0" for good in usable)
    return Calibration(microphone_array, usable, reasons, errors, intensity, "taps of Friday – Ü", (0.25, 8.0))


def curved():
    height = np.array([[0.0], [0.0], [0.01], [0.02]])
    bowl = np.random.default_rng(1).uniform(-0.09, 0.09, (30, 2))
    points = np.column_stack([bowl, 0.3 * bowl[:, 0] ** 2 - bowl[:, 0] * bowl[:, 1]])
    surface = make_surface(np.hstack([OUTLINE, height]), points)
    flat = array(9)
    place = np.column_stack([MICROPHONES[9], np.full(9, -0.01)])
    return MicrophoneArray(jnp.asarray(place), surface, flat.decay, flat.noise)


def other_decay(kind, *values):
    flat = array(9, relative=0.05, floor=0.3, freedom=12.0)
    return MicrophoneArray(flat.microphones, flat.surface, kind(*(jnp.asarray(value) for value in values)), flat.noise)


RNG = np.random.default_rng(3)
NINE = RNG.random((3, 9)) + 0.01
CASES = {
    "plane": lambda: calibration(array(9, relative=0.1)),
    "with a band": lambda: calibration(array(9, floor=1e-9, freedom=7.0), IntensitySettings(high=900.0)),
    "with a hole": lambda: calibration(array(9, outline=Polygon(OUTLINE, [HOLE]))),
    "curved": lambda: calibration(curved()),
    "exponential": lambda: calibration(other_decay(Exponential, *NINE[:2])),
    "attenuated": lambda: calibration(other_decay(AttenuatedInverseSquare, *NINE)),
    "huge and tiny": lambda: calibration(array(9, deviation=np.geomspace(1e-300, 1e300, 9))),
}


@pytest.mark.parametrize("name", CASES)
def test_there_and_back(name, tmp_path):
    """Every array agrees to the last bit."""
    one = CASES[name]()
    one.save(tmp_path / "array.json")
    again = Calibration.load(tmp_path / "array.json")
    leaves, structure = jax.tree.flatten(one.microphone_array)
    assert jax.tree.structure(again.microphone_array) == structure
    for saved, read in zip(leaves, jax.tree.leaves(again.microphone_array), strict=True):
        assert np.asarray(saved).dtype == np.asarray(read).dtype
        np.testing.assert_array_equal(read, saved)
    assert type(again.microphone_array.surface) is type(one.microphone_array.surface)
    assert type(again.microphone_array.decay) is type(one.microphone_array.decay)
    np.testing.assert_array_equal(again.usable, one.usable)
    np.testing.assert_array_equal(again.standard_errors, one.standard_errors)
    assert (again.reasons, again.name, again.num_microphones) == (one.reasons, one.name, 9)
    assert again.strengths == one.strengths == (0.25, 8.0)
    assert eqx.tree_equal(again.intensity, one.intensity)
    again.save(str(tmp_path / "again.json"))
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "array.json").read_bytes()


def test_the_file_describes_its_content(tmp_path):
    """Units, version and scale in plain JSON that other programs read: NaN is null."""
    CASES["with a band"]().save(tmp_path / "array.json")
    text = (tmp_path / "array.json").read_text("utf-8")
    content = json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    assert content["units"]["length"] == "m"
    assert content["version"] == 1
    assert "geometric mean 1" in content["scale"]
    assert content["microphones"][2]["relative_standard_error"] == {"a": None, "b": None}
    assert content["intensity"] == {"low": 50.0, "high": 900.0, "window": 0.05, "hop": 0.0125}
    assert len(content["microphones"]) == 9
    assert content["strengths"] == [0.25, 8.0]


def test_values_that_no_file_can_hold_are_refused(tmp_path):
    flat = array(9)
    noise = IntensityNoise(
        flat.noise.floor.at[0].set(jnp.nan), flat.noise.deviation, flat.noise.cross, flat.noise.relative
    )
    with pytest.raises(ValueError, match="JSON"):
        calibration(MicrophoneArray(flat.microphones, flat.surface, flat.decay, noise)).save(tmp_path / "array.json")


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    path = tmp_path_factory.mktemp("file") / "array.json"
    CASES["with a hole"]().save(path)
    return path.read_text("utf-8")


def load(tmp_path, written):
    path = tmp_path / "array.json"
    path.write_bytes(written if isinstance(written, bytes) else written.encode())
    return Calibration.load(path)


def put(*where):
    """Change of the content: the last argument is stored under the keys given before it, and `del` removes the key."""
    *keys, last, value = where

    def change(content):
        for key in keys:
            content = content[key]
        if value is del_:
            del content[last]
        else:
            content[last] = value

    return change


def del_():
    """Marker for removal."""


EDITED = {
    "another version": (put("version", 2), "version 2 .* reads version 1"),
    "no version": (put("version", del_), "version None"),
    "millimetres": (put("units", "length", "mm"), r"units\.length must be one of m; it is 'mm'"),
    "no units": (put("units", del_), "units is missing"),
    "another format": (put("format", "something else"), "no calibration"),
    "another model": (put("decay", "linear"), "decay must be one of .*; it is 'linear'"),
    "model not a word": (put("decay", ["inverse-square"]), "decay must be one of .*; it is a list"),
    "negative b": (put("microphones", 3, "b", -1e-3), r"microphones\[3\]\.b is -0\.001, and must be above 0"),
    "zero a": (put("microphones", 0, "a", 0), r"microphones\[0\]\.a is 0, and must be above 0"),
    "NaN": (put("microphones", 3, "b", float("nan")), r"microphones\[3\]\.b must be a number, above 0; it is nan"),
    "infinite": (
        put("microphones", 3, "noise_floor", float("inf")),
        r"microphones\[3\]\.noise_floor must be a number, from 0 up; it is inf",
    ),
    "text for a number": (
        put("microphones", 3, "a", "0.001"),
        r"microphones\[3\]\.a must be a number, above 0; it is '0\.001'",
    ),
    "yes for a number": (
        put("microphones", 3, "a", True),
        r"microphones\[3\]\.a must be a number, above 0; it is True",
    ),
    "null": (put("microphones", 3, "a", None), r"microphones\[3\]\.a is missing; decay is 'inverse-square'"),
    "negative noise": (
        put("microphones", 1, "relative_noise", -0.1),
        r"microphones\[1\]\.relative_noise is -0\.1, and must be from 0 up",
    ),
    "missing key": (put("microphones", 4, "b", del_), r"microphones\[4\]\.b is missing"),
    "no microphones": (put("microphones", []), "microphones has 0 things in it; give 1 at least"),
    "microphones no list": (put("microphones", 7), "microphones must be a list; it is 7"),
    "a microphone no dictionary": (put("microphones", 3, 5), r"microphones\[3\] must be a table, .*; it is 5"),
    "no surface": (put("surface", del_), "surface is missing"),
    "outline of two": (
        put("surface", "outline", [[0, 0], [1, 0]]),
        r"surface\.outline must be 3 to 4096 × 2 numbers, .*; it has 2\.",
    ),
    "outline of text": (put("surface", "outline", "square"), r"surface\.outline must be .*; it is 'square'"),
    "outline in space": (
        put("surface", "outline", [[0, 0, 0], [1, 0, 0], [0, 1, 0]]),
        r"surface\.outline must be .*; it has 3 in a row",
    ),
    "outline NaN": (
        put("surface", "outline", [[0, 0], [1, 0], [0, float("nan")]]),
        r"surface\.outline must be .*; it has nan in it",
    ),
    "outline in millimetres": (put("surface", "outline", [[0, 0], [100, 0], [0, 100]]), "are these metres"),
    "a strip too long": (put("surface", "outline", [[0, 0], [5.1, 0], [0, 0.2]]), r"over 5\.1: are these metres"),
    "hole of text": (put("surface", "holes", ["round"]), r"surface\.holes\[0\] must be .*; it is 'round'"),
    "position of one more": (
        put("microphones", 3, "position", [0.0, 0.0, 0.0]),
        r"microphones\[3\]\.position must be 2 coordinates in metres; it has 3",
    ),
    "position in millimetres": (put("microphones", 3, "position", [-70.0, 0.0]), "number 3 .* Divide millimetres"),
    "position twice": (put("microphones", 3, "position", [-0.07, -0.07]), "numbers 0 and 3 are at the same place"),
    "positions in space": (
        lambda content: [one.update(position=[*one["position"], 0.0]) for one in content["microphones"]],
        r"microphones\[0\]\.position must be 2 coordinates",
    ),
    "position NaN": (
        put("microphones", 3, "position", [0.0, float("nan")]),
        r"microphones\[3\]\.position must be .*; it has nan in it",
    ),
    "position of text": (
        put("microphones", 3, "position", ["a", "b"]),
        r"microphones\[3\]\.position must be .*; it has 'a' in it",
    ),
    "position a number": (put("microphones", 3, "position", 0.1), r"microphones\[3\]\.position must be .*; it is 0\.1"),
    "usable in words": (
        put("microphones", 3, "usable", "yes"),
        r"microphones\[3\]\.usable must be true or false, without quotes; it is 'yes'",
    ),
    "usable as a number": (
        put("microphones", 3, "usable", 1),
        r"microphones\[3\]\.usable must be true or false.*; it is 1",
    ),
    "no strengths": (put("strengths", del_), "strengths is missing"),
    "strengths not known": (put("strengths", None), None),
    "one strength": (put("strengths", [1.0]), "strengths must be 2 numbers, above 0; it has 1"),
    "strength of nothing": (put("strengths", [0.0, 1.0]), r"strengths must be 2 numbers, above 0; it has 0\.0 in it"),
    "strengths upside down": (put("strengths", [2.0, 1.0]), "the weaker first"),
    "strength of text": (put("strengths", ["a", 1.0]), "strengths must be .* 'a' in it"),
    "a number without end": (
        put("microphones", 3, "b", 10**400),
        r"microphones\[3\]\.b is 1000.*…, beyond double precision",
    ),
    "band without a window": (put("intensity", {"low": 50.0}), None),  # The defaults replace what is missing.
    "band upside down": (put("intensity", {"low": 500.0, "high": 50.0, "window": 0.05, "hop": 0.01}), "low= and high="),
    "band of another kind": (
        put("intensity", {"lowest": 500.0}),
        r"intensity\.lowest is no key of intensity \(did you mean 'low'\?\)",
    ),
    "error of text": (
        put("microphones", 3, "relative_standard_error", {"a": "x", "b": 0.1}),
        r"microphones\[3\]\.relative_standard_error\.a must be a number.*; it is 'x'",
    ),
    "error missing": (
        put("microphones", 3, "relative_standard_error", {"a": 0.1}),
        r"microphones\[3\]\.relative_standard_error\.b is missing",
    ),
}


@pytest.mark.parametrize("name", EDITED)
def test_content_edited_by_hand_is_refused(name, content, tmp_path):
    """The message has the file's name and the error in it."""
    change, message = EDITED[name]
    edited = json.loads(content)
    change(edited)
    if message is None:
        read = load(tmp_path, json.dumps(edited))
        assert read.intensity in (None, IntensitySettings())
        assert read.strengths in (None, (0.25, 8.0))
        return
    with pytest.raises(ValueError, match=message) as caught:
        load(tmp_path, json.dumps(edited))
    assert "array.json" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("knots", [[0.0, 0.0, 0.0]], r"surface\.curve\.knots must be 1 to 4096 × 2 numbers; it has 3 in a row"),
        ("weights", [1.0], "knots and 1 weights"),
        ("normal", [0.0, 1.0], r"surface\.curve\.normal must be 3 numbers; it has 2"),
        ("axes", "flat", r"surface\.curve\.axes must be 3 × 2 numbers; it is 'flat'"),
        ("origin", [0.0, 0.0, float("inf")], r"surface\.curve\.origin must be 3 numbers; it has inf in it"),
    ],
)
def test_a_curve_edited_by_hand_is_refused(key, value, message, tmp_path):
    CASES["curved"]().save(tmp_path / "array.json")
    edited = json.loads((tmp_path / "array.json").read_text("utf-8"))
    edited["surface"]["curve"][key] = value
    with pytest.raises(ValueError, match=message):
        load(tmp_path, json.dumps(edited))


OTHERS = {
    "other JSON": '{"name": "something"}',
    "a list": "[1, 2, 3]",
    "a number": "7",
    "null": "null",
    "empty": "",
    "text": "Dear reader,",
    "binary": bytes(range(256)) * 20,
    "UTF-16": '{"format": "x"}'.encode("utf-16"),
    "an archive": b"PK\x03\x04" + bytes(100),
    "a number of many digits": "1" * 5000,
    "very deep": "[" * 100_000,
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_files_are_refused(name, tmp_path):
    with pytest.raises(ValueError, match=r"array\.json is no calibration"):
        load(tmp_path, OTHERS[name])


def test_a_truncated_file_is_refused(content, tmp_path):
    """At any length."""
    for part in (0.01, 0.3, 0.9, 0.999):
        with pytest.raises(ValueError, match=r"array\.json is no calibration"):
            load(tmp_path, content[: int(part * len(content))])


def test_no_file(tmp_path):
    with pytest.raises(FileNotFoundError):
        Calibration.load(tmp_path / "nothing.json")
    (tmp_path / "array").mkdir()
    with pytest.raises(OSError, match="array"):
        Calibration.load(tmp_path / "array")
    with pytest.raises(OSError, match="folder"):
        CASES["plane"]().save(tmp_path / "no folder" / "array.json")
