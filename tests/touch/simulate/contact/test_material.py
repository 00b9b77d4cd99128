"""Materials: saturation, hysteresis, creep and drift against their closed forms."""

import dataclasses

import jax
import numpy as np
import pytest

from jeit.touch.simulate.contact import Foundation, Material, material
from jeit.touch.simulate.contact.materials import MATERIALS, advance_state, creep_pressure, unloaded_state
from jeit.touch.simulate.contact.pressed_skin import draw_gains, random_walk, split_keys, standard_normal, white_noise

PLAIN = Material(0.2, 1e-4, Foundation(1e6, 2e-3), saturation=1.5, half_pressure=20e3)
HYSTERETIC = dataclasses.replace(PLAIN, hysteresis=0.2)
CREEPING = dataclasses.replace(PLAIN, creep=((0.2, 0.5), (0.1, 30.0)))
BOTH = dataclasses.replace(CREEPING, hysteresis=0.2)
KEY = jax.random.key(0)


def follow(made, pressures, seconds):
    """Effective pressure at one place over time."""
    strain, found, before = unloaded_state(made, 1), [], seconds[0]
    for pressure, now in zip(pressures, seconds, strict=True):
        strain, effective = advance_state(made, strain, np.array([pressure]), now - before)
        found.append(effective[0])
        before = now
    return np.array(found)


def test_conductivity_saturates():
    assert PLAIN.change(0.0) == 0
    assert PLAIN.change(20e3) == pytest.approx(0.75)
    assert PLAIN.change(1e9) == pytest.approx(1.5, rel=1e-4)
    change = PLAIN.change(np.linspace(0, 1e5, 50))
    assert (np.diff(change) > 0).all()
    assert (np.diff(change, 2) < 0).all()


def test_the_width_of_hysteresis_does_not_depend_on_the_rate():
    up, down = np.linspace(0, 1e4, 101), np.linspace(1e4, 0, 101)
    for pace in (1e-3, 1e3):
        found = follow(HYSTERETIC, [*up, *down], pace * np.arange(202))
        np.testing.assert_allclose(found[:101], up)
        assert (found[101:] - down).max() == pytest.approx(0.2 * 1e4)
        assert found[-1] == 0


def test_a_minor_loop_is_forgotten_within_a_major_one():
    seconds = np.arange(6.0)
    small = follow(HYSTERETIC, [0, 5e3, 3e3, 8e3, 2e3, 4e3], seconds)
    np.testing.assert_allclose(small[[3, 4, 5]], follow(HYSTERETIC, [0, 0, 0, 8e3, 2e3, 4e3], seconds)[[3, 4, 5]])
    assert small[2] == pytest.approx(3e3 / 0.8)


def test_creep_of_a_step_is_exponential():
    seconds = np.array([0.0, 0.1, 1.0, 10.0, 300.0])
    found = follow(CREEPING, np.full(5, 1e4), seconds)
    late = 0.2 * np.exp(-seconds / 0.5) + 0.1 * np.exp(-seconds / 30.0)
    np.testing.assert_allclose(found, 1e4 * (1 - late), rtol=1e-12)
    for now, effective in zip(seconds, found, strict=True):
        assert creep_pressure(CREEPING, 1e4, now) == pytest.approx(effective, rel=1e-12)


@pytest.mark.parametrize("made", [CREEPING, BOTH])
def test_time_steps_do_not_matter_while_load_is_linear(made):
    fine = np.linspace(0, 4, 4001)
    load = np.interp(fine, [0, 1, 2, 4], [0, 1e4, 1e4, 2e4])
    coarse = np.array([0, 1000, 2000, 4000])
    np.testing.assert_allclose(follow(made, load[coarse], fine[coarse]), follow(made, load, fine)[coarse], rtol=1e-10)


def test_creep_recovers_at_rest():
    found = follow(BOTH, [1e4, 1e4, 0, 0, 0], [0.0, 100.0, 100.01, 110.0, 1000.0])
    assert 0.05e4 < found[3] < found[2] < 0.31e4
    assert abs(found[4]) < 1e-6


def test_drift_is_a_trend_and_a_random_walk():
    seconds = np.array([100.0, 400.0, 400.0, 2500.0])
    logs = random_walk(KEY, seconds, 1e-3, 0.01, 20_000)
    np.testing.assert_allclose(logs.mean(axis=1), 1e-3 * seconds, rtol=0.05)
    np.testing.assert_allclose(logs.std(axis=1), 0.01 * np.sqrt(seconds), rtol=0.03)
    np.testing.assert_array_equal(logs[1], logs[2])
    # Increments are independent: cov(B(100), B(2500)) is var B(100).
    assert np.cov(logs[0], logs[3])[0, 1] == pytest.approx(1e-4 * 100, rel=0.15)


def test_gains_and_noise():
    assert np.log(draw_gains(KEY, 0.05, 20_000)).std() == pytest.approx(0.05, rel=0.03)
    assert white_noise(KEY, 2e-3, (100, 200)).std() == pytest.approx(2e-3, rel=0.03)
    np.testing.assert_array_equal(draw_gains(KEY, 0.05, 9), draw_gains(KEY, 0.05, 9))


def test_materials_have_the_published_values():
    assert 1 / (material("velostat").conductivity * 1e-4) == pytest.approx(50e3)  # 500 Ω cm, 0.1 mm: Ω per square
    fabric = material("conductive fabric")
    assert fabric.conductivity * fabric.thickness == pytest.approx(12.5e-3)
    assert material("hydrogel").thickness == 0.01
    assert material("hydrogel").hysteresis <= 0.03
    assert material("hydrogel").change(1e4) < 0 < material("velostat").change(1e4) <= 1
    assert len(MATERIALS) == 3


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: material("velost"), r"name must be one of velostat, .*did you mean 'velostat'"),
        (lambda: dataclasses.replace(PLAIN, conductivity=0.0), "conductivity must be positive"),
        (lambda: dataclasses.replace(PLAIN, thickness=-1.0), "thickness must be"),
        (lambda: dataclasses.replace(PLAIN, saturation=-1.0), "saturation must be above −1"),
        (lambda: dataclasses.replace(PLAIN, half_pressure=np.nan), "half_pressure must be positive"),
        (lambda: dataclasses.replace(PLAIN, hysteresis=1.0), "hysteresis must be from 0"),
        (lambda: dataclasses.replace(PLAIN, creep=((0.5, 1.0), (0.6, 2.0))), "shares of sum below 1"),
        (lambda: dataclasses.replace(PLAIN, creep=((0.5, 0.0),)), "creep: give"),
        (lambda: dataclasses.replace(PLAIN, creep=(0.5, 1.0)), "creep: give"),
        (lambda: dataclasses.replace(PLAIN, creep=None), "creep: give"),
        (lambda: dataclasses.replace(PLAIN, creep=(("0.5", 1.0),)), "creep: give"),
        (lambda: dataclasses.replace(PLAIN, conductivity="0.2"), "conductivity must be positive; it is '0.2'"),
        (lambda: dataclasses.replace(PLAIN, hysteresis=None), "hysteresis must be from 0"),
        (lambda: dataclasses.replace(PLAIN, noise=-1.0), "noise must be zero or more"),
        (lambda: dataclasses.replace(PLAIN, contact_trend=np.inf), "contact_trend must be a number"),
        (lambda: dataclasses.replace(PLAIN, support=1e6), "support must be a support"),
    ],
)
def test_impossible_materials_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("shape", [(), (1,), (5, 7), (2, 3, 11), (0, 4)])
def test_draws_are_those_of_jax_for_any_number(shape):
    drawn = standard_normal(KEY, shape)
    assert drawn.shape == shape
    np.testing.assert_allclose(drawn, jax.random.normal(KEY, shape), rtol=1e-14)


def test_keys_are_those_of_jax():
    keys = [jax.random.key_data(key) for key in split_keys(KEY, 3)]
    np.testing.assert_array_equal(keys, jax.random.key_data(jax.random.split(KEY, 3)))
