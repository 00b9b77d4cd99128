"""Simulated people who touch: each with personal traits, as in Table I. Sets of the skin's readings, generated and
saved.
"""

from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest

from jeit.data import GestureSet
from jeit.electrodes import PointElectrodes
from jeit.forward import ForwardModel
from jeit.layout import perimeter
from jeit.mesh import Disk, Rectangle
from jeit.protocol import reference_electrode
from jeit.touch.simulate import DiscIndenter, MovingPress, PressedSkin, material
from jeit.touch.simulate.contact.pressed_skin import split_keys
from jeit.touch.simulate.people import GESTURES, MANNERS, TRAITS, Person, simulate_gestures

KEY = jax.random.key(0)
SHEET = Rectangle(0.32, 0.2)
STILL = replace(
    material("conductive fabric"),
    noise=0.0, conductivity_trend=0.0, conductivity_walk=0.0, contact_trend=0.0, contact_walk=0.0,
)  # fmt: skip


def skin(own=STILL):
    places = np.vstack([perimeter(Rectangle(0.3, 0.18), 8, start=0.06), [[0.0, 0.0]]])
    electrodes = PointElectrodes(places)
    return PressedSkin(KEY, ForwardModel(SHEET.mesh(num_points=100), electrodes, reference_electrode(8)), own)


@cache
def still_skin():
    """One skin for all tests that do not change it."""
    return skin()


def motions(gesture, number=40):
    return [Person.draw(key).touch(key, gesture, SHEET) for key in split_keys(KEY, number)]


def test_people_are_log_normally_distributed_about_a_gesture():
    medians = np.stack([Person.draw(key).medians for key in split_keys(KEY, 500)])
    for row, name in enumerate(GESTURES):
        own = MANNERS[name]
        moving = slice(0, 5 if own.moves else 3)
        logs = np.log(medians[:, row, moving])
        np.testing.assert_allclose(logs.mean(axis=0), np.log(own.medians[moving]), atol=0.08)
        np.testing.assert_allclose(logs.std(axis=0), own.spread[moving], rtol=0.12)
    assert len(TRAITS) == medians.shape[2]


def test_one_person_varies_less_than_many():
    one = Person.draw(KEY)
    own = [one.touch(key, "push", SHEET)[0].load.max() for key in split_keys(KEY, 40)]
    many = [motion.load.max() for motion, _ in motions("push")]
    assert np.std(np.log(own)) < np.std(np.log(many))


def test_gestures_agree_with_the_table():
    """Low and high loads, small and large contacts, short and long, still and moving."""
    found = {}
    for name in GESTURES:
        rows = []
        for motion, seconds in motions(name):
            there = motion.load > 0
            area = 3 * motion.indenter.parts[0].indenter.reach ** 2 if name == "scratch" else motion.indenter.reach**2
            travelled = np.linalg.norm(np.diff(motion.position[there], axis=0), axis=1).sum()
            rows.append([motion.load.max(), np.pi * area, np.ptp(seconds[there]), travelled])
        found[name] = np.median(rows, axis=0)
    force, area, duration, path = (
        dict(zip(found, column, strict=True)) for column in zip(*found.values(), strict=True)
    )
    assert force["tap"] < force["pat"] < force["scratch"] < force["slap"]
    assert force["push"] == pytest.approx(force["slap"], rel=0.3)
    assert area["tap"] < 0.5 * min(area[name] for name in ("pat", "stroke", "slap"))
    assert max(duration[name] for name in ("tap", "pat", "slap")) < 0.3 < duration["push"]
    assert (
        max(path[name] for name in ("tap", "pat", "push", "slap")) < 0.01 < 0.05 < min(path["stroke"], path["scratch"])
    )


@pytest.mark.parametrize("gesture", GESTURES)
def test_touches_lie_on_the_skin_and_end(gesture):
    for motion, seconds in motions(gesture, 10):
        assert (np.asarray(SHEET.signed_distance(motion.position)) > 0).all()
        assert motion.load[0] == motion.load[-1] == 0 < motion.load.max()
        assert (motion.load >= 0).all()
        assert len(seconds) == len(motion.load) == len(motion.position)
        np.testing.assert_allclose(np.diff(seconds), 1 / 60)
    small = Person.draw(KEY).touch(KEY, gesture, Disk(0.035))[0]
    assert np.linalg.norm(small.position, axis=1).max() < 0.035


def test_the_same_key_is_the_same_touch():
    person = Person.draw(KEY)
    first, again, other = (person.touch(jax.random.key(seed), "stroke", SHEET)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.position, again.position)
    assert first.load.shape != other.load.shape or not np.allclose(first.load, other.load)


@pytest.mark.slow
def test_recordings_together_are_those_of_each():
    """Without noise and drift, which have their own keys."""
    still = still_skin()
    seconds = np.arange(6) / 60
    press = MovingPress(DiscIndenter(0.03), [0, 1, 2, 2, 1, 0], (0.05, 0.02))
    two = [press, MovingPress(DiscIndenter(0.02), [0, 0, 1, 1, 0, 0], (-0.06, 0.0))]
    recordings = [(press, seconds), ([], seconds[:3]), (two, seconds + 5.0)]
    for one, (motion, times) in zip(still.record_each(KEY, recordings), recordings, strict=True):
        scale = np.abs(still.rest()).max()
        np.testing.assert_allclose(one, still.record(KEY, motion, times), atol=1e-7 * scale)
    assert still.record_each(KEY, []) == []


def test_a_set_is_generated_and_saved(tmp_path):
    people = [Person.draw(key) for key in split_keys(KEY, 2)]
    noisy = skin(material("conductive fabric"))
    made = simulate_gestures(KEY, noisy, SHEET, people, 1, gestures=("tap", "slap"))
    assert made.gesture.tolist() == ["tap", "slap"] * 2
    assert made.person.tolist() == [0, 0, 1, 1]
    strength = []
    for number in range(len(made)):
        seconds, changes = made.changes(number)
        assert changes.shape == (len(seconds), len(made.reference))
        assert seconds[0] == 0
        strength.append(np.abs(changes).max() / np.abs(made.untouched - made.reference).max())
    assert min(strength[1], strength[3]) > max(strength[0], strength[2]) > 1
    made.write(tmp_path / "set.npz")
    again = GestureSet.read(tmp_path / "set.npz")
    for name in ("gesture", "person", "start", "seconds", "voltages", "reference", "untouched"):
        np.testing.assert_array_equal(getattr(again, name), getattr(made, name))


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (lambda: Person.draw(0), "key must be one random key"),
        (lambda: Person(np.zeros((6, 4))), "medians have shape"),
        (lambda: Person(np.full((6, 5), np.nan)), "must be finite"),
        (lambda: Person.draw(KEY).touch(KEY, "poke", SHEET), "gesture must be one of"),
        (lambda: Person.draw(KEY).touch(KEY, "tap", None), "outline must be an outline"),
        (lambda: Person.draw(KEY).touch(KEY, "tap", Disk(0.02)), "60 mm wide"),
        (lambda: Person.draw(KEY).touch(KEY, "tap", SHEET, rate=0), "rate must be"),
        (lambda: simulate_gestures(KEY, None, SHEET, [Person.draw(KEY)], 1), "skin must be"),
        (lambda: simulate_gestures(KEY, still_skin(), SHEET, [], 1), "people: give one"),
        (lambda: simulate_gestures(KEY, still_skin(), SHEET, [Person.draw(KEY)], 0), "each must be"),
        (
            lambda: simulate_gestures(KEY, still_skin(), SHEET, [Person.draw(KEY)], 1, gestures=["poke"]),
            r"gestures\[0\]",
        ),
        (lambda: simulate_gestures(KEY, still_skin(), SHEET, [None], 1), r"people\[0\] must be"),
        (lambda: still_skin().record_each(KEY, [1]), r"recordings\[0\]"),
    ],
)
def test_bad_arguments(action, message):
    with pytest.raises(ValueError, match=message):
        action()
