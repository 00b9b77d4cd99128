"""Checks of arguments: valid values pass, and each invalid value is described in the error message."""

import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.arguments import (
    check_key,
    check_kind,
    check_metres,
    check_name,
    counted,
    describe,
    did_you_mean,
    interval_text,
    is_number,
    names_text,
    real_array,
    signed_percent,
)
from jeit.mesh import Disk


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("laplace", "'laplace'"),
        ("a" * 100, f"'{'a' * 58}…"),
        (None, "None"),
        pytest.param(10**5000, "a number without end", id="10**5000"),
        (float("nan"), "nan"),
        (np.float64(0.5), "0.5"),
        (jnp.asarray(3), "3"),
        ([1, 2], "a list"),
        (Disk(0.05), "a Disk"),
        (OSError(), "an OSError"),
        (Disk, "the class Disk itself"),
        (np.zeros((3, 2)), "an array of float64 of shape (3, 2)"),
        (jnp.zeros(3, bool), "an array of bool of shape (3,)"),
        (jax.random.key(0), "an array of key<fry> of shape ()"),
    ],
)
def test_describe_value(given, message):
    assert describe(given) == message


@pytest.mark.parametrize("given", [0, -1.5, np.float32(2), np.asarray(1), jnp.asarray(0.5)])
def test_is_number_accepts_finite_scalars(given):
    assert is_number(given)


@pytest.mark.parametrize(
    "given", [True, "1", None, [1.0], np.ones(1), 1j, math.nan, math.inf, {}, jax.random.key(0), jnp.ones(2)]
)
def test_is_number_rejects_other_values(given):
    assert not is_number(given)


@pytest.mark.parametrize("given", [[1, 2], np.arange(2.0), jnp.ones(2), 3, [[1.0], [2.0]], []])
def test_real_array_accepts_arrays_of_numbers(given):
    values = real_array("load", given, "newtons")
    assert values.dtype == float
    np.testing.assert_array_equal(values, np.asarray(given))


@pytest.mark.parametrize("given", ["1", ["1", "2"], None, [[1.0], [2.0, 3.0]], np.ones(2) * 1j, [True], {}])
def test_real_array_rejects_other_values(given):
    with pytest.raises(ValueError, match=r"^load must be newtons"):
        real_array("load", given, "newtons")


def test_check_kind():
    check_kind("outline", Disk(0.05), Disk, "a Disk")
    check_kind("path", "a", (str, Path), "a path")
    with pytest.raises(ValueError, match=r"^outline must be a Disk, such as Disk\(0\.05\); it is 'disk'\.$"):
        check_kind("outline", "disk", Disk, "a Disk, such as Disk(0.05)")


@pytest.mark.parametrize(
    "key", [jax.random.key(0), jax.random.PRNGKey(0), np.asarray(jax.random.PRNGKey(1)), jax.random.key(0, impl="rbg")]
)
def test_check_key_accepts_random_keys(key):
    check_key(key)
    jax.random.normal(key)


def test_check_key_accepts_traced_keys():
    def draw(key):
        check_key(key)
        return jax.random.normal(key)

    keys = jax.random.split(jax.random.key(0), 3)
    assert jax.jit(jax.vmap(draw))(keys).shape == (3,)


@pytest.mark.parametrize(
    ("key", "message"),
    [
        (None, r"such as jax.random.key\(0\); it is None"),
        (7, r"such as jax.random.key\(7\); it is 7"),
        (True, r"such as jax.random.key\(0\); it is True"),
        ("seed", "it is 'seed'"),
        (np.zeros(2), r"an array of float64 of shape \(2,\)"),
        (jax.random.split(jax.random.key(0)), r"an array of key<fry> of shape \(2,\)"),
    ],
)
def test_check_key_rejects_other_values(key, message):
    with pytest.raises(ValueError, match=f"^seed must be one random key, .*{message}"):
        check_key(key, "seed")


def test_names_text_states_how_many_names_it_leaves_out():
    assert names_text([]) == "nothing"
    assert names_text(range(8)) == "0, 1, 2, 3, 4, 5, 6, 7"
    assert names_text("abcde", max_names=2) == "a, b and 3 more"
    assert names_text(["a" * 24, "b" * 25]) == f"{'a' * 24}, {'b' * 23}…"


def test_check_name():
    names = {"gcv": 1, "l-curve": 2}
    check_name("rule", "gcv", names)
    with pytest.raises(ValueError, match=r"^rule must be one of gcv, l-curve; it is 'gvc' \(did you mean 'gcv'\?\)\.$"):
        check_name("rule", "gvc", names)
    with pytest.raises(ValueError, match=r"^rule must be one of gcv, l-curve, or a number; it is 'luck'\.$"):
        check_name("rule", "luck", names, ", or a number")
    with pytest.raises(ValueError, match=r"^rule must be one of gcv, l-curve; it is a list\.$"):
        check_name("rule", ["gcv"], names)


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("GCV", "gcv"),
        ("gauss", "gauss-newton"),
        ("l_curve", "l-curve"),
        ("luck", ""),
        ("", ""),
        (None, ""),
        (["gcv"], ""),
    ],
)
def test_did_you_mean_suggests_similar_names(given, meant):
    message = did_you_mean(given, ["gcv", "l-curve", "gauss-newton"])
    assert message == (f" (did you mean '{meant}'?)" if meant else "")


def test_check_metres():
    check_metres("thickness", 0.2, 0.2, "the skin is wide")
    check_metres("thickness", jnp.asarray(0.01))
    with pytest.raises(
        ValueError,
        match=r"^thickness is 10000 mm, more than the skin is wide, 200 mm; were millimetres given for metres\?",
    ):
        check_metres("thickness", 10, 0.2, "the skin is wide")


@pytest.mark.parametrize("value", [0, -0.01, math.nan, math.inf, "0.01", None, [0.01], True, np.zeros(2)])
def test_check_metres_rejects_values_that_are_no_lengths(value):
    with pytest.raises(ValueError, match=r"^thickness must be a positive length in metres; it is "):
        check_metres("thickness", value)


def test_open_intervals_name_the_known_end():
    """A decrease beyond its limit: "at most -90" might mean a smaller one."""
    texts = {(1.0, 2.0): "1 to 2", (1.0, None): "at least 1", (None, 2.0): "at most 2", (None, -90.0): "beyond -90"}
    texts |= {(None, 0.0): "at most 0"}
    assert {ends: interval_text(ends, lambda value: f"{value:g}") for ends in texts} == texts
    assert interval_text((None, None), str) == "not determined"


def test_changes_in_per_cent_have_a_sign_and_two_digits():
    said = {0.0: "+0 %", 0.01234: "+1.2 %", -0.904: "-90 %", 1.5: "+150 %", -0.9949: "-99 %", 7.94: "+790 %"}
    assert {change: signed_percent(change) for change in said} == said


def test_numbers_have_their_noun_in_the_plural():
    said = {(1, "frame"): "1 frame", (0, "frame"): "0 frames", (1000, "touch"): "1,000 touches", (2, "box"): "2 boxes"}
    assert {given: counted(*given) for given in said} == said
