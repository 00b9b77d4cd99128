"""A trained skin: its errors, its estimated uncertainty, and its behaviour where it has no information.

Against places, forces, labels and keys of new presses on a simulated skin, which were not in the training data.
"""

import re

import numpy as np
import pytest
from made_skins import CHANNELS, off, record

from jeit.touch import LearntSkin, Presses
from jeit.touch.learnt import labels
from jeit.touch.learnt.methods import REGRESSORS

FRESH = record(120, seed=1)
ASK = {key: FRESH[key] for key in ("frames", "reference")}


def test_places_and_forces_of_fresh_presses(skin):
    prediction = skin.predict(**ASK)
    assert off(prediction, FRESH["positions"]).mean() < 4e-3
    assert np.abs(prediction.force - FRESH["force"]).mean() < 0.25
    assert not prediction.unlike.any()
    assert prediction.alive.mean() > 0.999


@pytest.mark.usefixtures("few_seconds_for_all_methods")
def test_a_blend_predicts_the_mean_of_the_best_methods():
    recorded = {**record(80), "force": None}
    skin = LearntSkin.fit(Presses.create(**recorded), method="blend")
    standing, place = skin.standing["place"], skin.place
    assert standing.method.startswith("blend: gaussian-process on ")
    assert standing.tried[0][0] == standing.method
    assert len(place.members) == standing.method.count(" on ") >= 2
    changes = FRESH["frames"] - FRESH["reference"]
    each = [model.predict(features(changes, FRESH["reference"])) for features, model in place.members]
    expected = place.mean + place.scale * np.mean(each, axis=0)
    np.testing.assert_allclose(skin.predict(**ASK).position, expected, atol=1e-9)
    assert off(skin.predict(**ASK), FRESH["positions"]).mean() < 4e-3


@pytest.mark.slow
def test_places_by_the_actual_methods():
    """None of them is replaced by the mean."""
    skin = LearntSkin.fit(Presses.create(**{**record(100), "force": None}))
    assert off(skin.predict(**ASK), FRESH["positions"]).mean() < 4e-3
    place = skin.standing["place"]
    spread = np.linalg.norm(place.right - place.right.mean(axis=0), axis=1).mean()
    assert all(error < 0.7 * spread for _, error in place.tried)


def test_the_best_method_is_selected(skin):
    """Among all methods, and much better than linear ones, since nothing is linear."""
    place = skin.standing["place"]
    errors = dict(place.tried)
    assert {name.partition(" on ")[0] for name in errors} >= set(REGRESSORS)
    assert place.method == min(errors, key=errors.get)
    assert errors[place.method] < 0.5 * errors["ridge on differences"]
    assert place.held_out.shape == (140, 2)


def test_deviations_are_calibrated(skin):
    many = record(600, seed=2)
    prediction = skin.predict(many["frames"], many["reference"])
    ratio = np.abs(prediction.position - many["positions"]) / prediction.position_std
    assert 0.6 < np.mean(ratio < 1) < 0.82  # by chance a few frames look as if their readings were noisier
    assert abs(np.mean(ratio < 1.96) - 0.95) < 0.05


def test_frames_one_by_one_equal_frames_together(skin):
    together = skin.predict(**ASK)
    alone = skin.predict(FRESH["frames"][7], FRESH["reference"][7])
    np.testing.assert_allclose(alone.position[0], together.position[7], rtol=1e-9)
    np.testing.assert_allclose(alone.position_std[0], together.position_std[7], rtol=1e-9)


@pytest.mark.parametrize("reading", [0.0, np.nan, 5.0])
def test_a_dead_channel_costs_little_accuracy(quick, reading):
    sound = off(quick.predict(**ASK), FRESH["positions"]).mean()
    for channel in (3, 17, 30):
        frames = FRESH["frames"].copy()
        frames[:, channel] = reading
        prediction = quick.predict(frames, FRESH["reference"])
        assert off(prediction, FRESH["positions"]).mean() < 2 * sound
        assert not prediction.alive[:, channel].any() or np.isfinite(reading)
        assert any(f" {channel}" in note for note in prediction.notes)
    frames = FRESH["frames"].copy()
    frames[:12, 3] = reading
    notes = [note for note in quick.predict(frames, FRESH["reference"]).notes if "of the readings disagree" in note]
    assert [0.2 < float(note.split(" %")[0]) < 0.5 for note in notes] == [True]  # 12 of 4,800 and a few others


def few_channels(number, seed):
    """Changes of eight channels, each with information that no other has, and places."""
    rng, centres = np.random.default_rng(seed), np.random.default_rng(3).uniform(-0.06, 0.06, (8, 2))
    place, force = rng.uniform(-0.05, 0.05, (number, 2)), rng.uniform(0.5, 4.0, number)
    near = np.exp(-((np.linalg.norm(place[:, None] - centres, axis=2) / 0.035) ** 2))
    return near * (force / (force + 2))[:, None] + 2e-3 * rng.normal(size=near.shape), place


@pytest.fixture(scope="module")
def skin_of_few_channels():
    changes, place = few_channels(240, 0)
    return LearntSkin.fit(Presses.create(changes, positions=place), method="gaussian-process")


@pytest.mark.parametrize("dead", [[2], [1, 6]])
def test_deviations_are_calibrated_where_channels_are_dead(skin_of_few_channels, dead):
    skin = skin_of_few_channels
    fresh, right = few_channels(300, 1)
    sound = skin.predict(fresh)
    fresh[:, dead] = np.nan
    prediction = skin.predict(fresh)
    assert np.nanmean(off(prediction, right)) > 2 * np.nanmean(off(sound, right))
    ratio = (np.abs(prediction.position - right) / prediction.position_std)[
        np.isfinite(prediction.position).all(axis=1)
    ]
    assert len(ratio) > 250
    assert 0.55 < np.mean(ratio < 1) < 0.9
    assert np.mean(ratio < 1.96) > 0.88


def test_a_stuck_channel_is_left_out(quick):
    """At a plausible value: only its constancy reveals it."""
    frames = FRESH["frames"].copy()
    frames[:, 9] = np.median(frames[:, 9])
    prediction = quick.predict(frames, FRESH["reference"])
    assert not prediction.alive[:, 9].any()
    assert prediction.alive.mean() > 0.97
    still = quick.predict(np.repeat(frames[:1], 30, axis=0), FRESH["reference"][0])
    assert still.alive.all()
    coarse = np.round(FRESH["reference"][:40], 2)  # untouched: nearly all channels read the same
    coarse[::7, 3] += 0.01
    assert quick.predict(coarse, FRESH["reference"][0]).alive.all()
    frames[:, :25] = frames[0, :25]  # most of the skin
    assert quick.predict(frames, FRESH["reference"]).unlike.all()


def test_unusual_frames_are_reported(quick):
    frames = FRESH["frames"].copy()
    frames[:5] = np.random.default_rng(0).normal(size=(5, CHANNELS))
    prediction = quick.predict(frames, FRESH["reference"])
    np.testing.assert_array_equal(np.flatnonzero(prediction.unlike), range(5))
    assert np.isnan(prediction.position[:5]).all()
    assert np.isnan(prediction.force[:5]).all()
    assert "5 of 120 frames are unlike" in prediction.notes[-1]


def test_untouched_frames_have_no_place():
    recorded = record(200, untouched=40, noise=0.002)
    skin = LearntSkin.fit(Presses.create(**recorded), method="neighbours")
    fresh = record(100, seed=3, untouched=30, noise=0.002)
    prediction = skin.predict(fresh["frames"], fresh["reference"])
    still = np.isnan(prediction.position).any(axis=1)
    assert still[70:].mean() > 0.9
    assert still[:70].mean() < 0.1
    assert (prediction.force[still] == 0).all()


def test_a_touch_unlike_the_training_data_is_reported(quick):
    """With the opposite sign it consists of learnt patterns, but resembles no press."""
    prediction = quick.predict(2 * FRESH["reference"] - FRESH["frames"], FRESH["reference"])
    assert prediction.unlike.all()
    assert quick.predict(**ASK).unlike.mean() < 0.02


@pytest.mark.parametrize("readings", [0, 10])
def test_frames_without_most_readings_are_not_reported_as_untouched(quick, readings):
    frames = FRESH["frames"].copy()
    frames[:, readings:] = np.nan
    prediction = quick.predict(frames, FRESH["reference"])
    assert prediction.unlike.all()
    assert np.isnan(prediction.force).all()


def test_an_untouched_skin_has_no_place(quick):
    """Although no untouched frame was recorded."""
    noise = 1e-3 * np.random.default_rng(0).normal(size=FRESH["frames"].shape)
    prediction = quick.predict(FRESH["reference"] + noise, FRESH["reference"])
    assert np.isnan(prediction.position).all()
    assert not prediction.unlike.any()
    assert (prediction.force == 0).all()


def test_places_pressed_repeatedly_are_held_out_together():
    """The predicted error is that between them, not at them."""
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-0.045, 0.045, 7)]), axis=-1).reshape(-1, 2)
    recorded = record(245, places=np.tile(grid, (5, 1)), noise=0.002)
    skin = LearntSkin.fit(Presses.create(**{**recorded, "force": None}), method="neighbours")
    fresh = off(skin.predict(**ASK), FRESH["positions"])
    forecast = dict(skin.standing["place"].tried)[skin.standing["place"].method]
    assert 0.6 * np.nanmean(fresh) < forecast < 3 * np.nanmean(fresh)
    assert "49 places were repeated" in skin.notes[0]


def test_places_where_a_press_was_recorded_late():
    recorded = record(200)
    late = {key: recorded[key][:-1] for key in ("frames", "reference")}
    skin = LearntSkin.fit(Presses.create(**late, positions=recorded["positions"][1:]), method="neighbours")
    assert skin.lag == 1
    assert "frames seem to be of the press 1 row before" in skin.notes[0]
    aligned, recorded = map(float, re.findall(r"(\S+) mm", skin.notes[0]))
    assert aligned < 20 < recorded < 70  # on a square of 100 mm
    assert off(skin.predict(**ASK), FRESH["positions"]).mean() < 8e-3


def test_few_channels(recorded):
    skin = LearntSkin.fit(Presses.create(**recorded), method="neighbours", num_channels=12)
    assert skin.channels.used.sum() == 12
    assert "12 of 40 channels are used" in skin.notes[0]
    assert off(skin.predict(**ASK), FRESH["positions"]).mean() < 0.012


def test_labels_and_no_touch():
    recorded = record(240, untouched=60, noise=0.003)
    x = recorded["positions"][:, 0]
    label = np.where(np.isnan(x), "none", np.where(x > 0, "right", "left"))
    skin = LearntSkin.fit(Presses.create(recorded["frames"], reference=recorded["reference"], label=label))
    fresh = record(200, seed=4, untouched=50, noise=0.003)
    prediction = skin.predict(fresh["frames"], fresh["reference"])
    x = fresh["positions"][:, 0]
    right = np.where(np.isnan(x), "none", np.where(x > 0, "right", "left"))
    assert np.mean(prediction.label == right) > 0.93
    assert abs(prediction.probability.mean() - np.mean(prediction.label == right)) < 0.06
    assert len(skin.standing["label"].tried) >= 9


@pytest.fixture
def few_trees(monkeypatch):
    """Fifteen for each key, where a hundred and fifty take ten times as long."""
    monkeypatch.setattr(labels, "_NUM_TREES", 15)


@pytest.mark.slow
@pytest.mark.usefixtures("few_trees")
def test_keys_pressed_together():
    """Six keys, each with its own pattern, which saturate together."""
    rng = np.random.default_rng(0)
    patterns = rng.normal(size=(6, CHANNELS))

    def press(number, seed):
        rng = np.random.default_rng(seed)
        touched = rng.random((number, 6)) < 0.5
        return np.tanh(touched @ patterns / 3) + 0.08 * rng.normal(size=(number, CHANNELS)), touched

    frames, touched = press(150, 1)
    skin = LearntSkin.fit(Presses.create(frames, touched=touched))
    fresh, right = press(200, 2)
    prediction = skin.predict(fresh)
    assert np.mean(prediction.touched == right) > 0.97
    assert np.mean((prediction.touched == right).all(axis=1)) > 0.85
    assert np.mean((prediction.key_probability > 0.5) == prediction.touched) == 1


@pytest.mark.usefixtures("few_trees")
@pytest.mark.parametrize("group", [None, np.repeat(np.arange(3), 16)])
def test_keys_pressed_in_sequence(group):
    """Where each person pressed one key only, the held-out data have a key without training data."""
    rng = np.random.default_rng(0)
    touched = np.repeat(np.eye(3, dtype=bool), 16, axis=0)
    frames = touched @ rng.normal(size=(3, 12)) + 0.1 * rng.normal(size=(48, 12))
    reports = []
    skin = LearntSkin.fit(Presses.create(frames, touched=touched, group=group), progress=reports.append)
    folds = 5 if group is None else 3  # finished in any order
    expected = ["channels", *(f"keys, fold {one} of {folds}" for one in range(1, folds + 1))]
    assert sorted(reports) == sorted([*expected, "key 1 of 3", "key 2 of 3", "key 3 of 3"])
    wrong = np.mean(skin.standing["keys"].held_out != touched)
    assert wrong < 0.01 if group is None else wrong >= 0.2
    assert group is not None or np.array_equal(skin.predict(frames).touched, touched)


def test_sessions_that_drift_are_standardised():
    parts = [record(100, seed=seed) for seed in range(3)]
    drift = 0.1 * np.random.default_rng(1).normal(size=(4, CHANNELS))
    changes = [one["frames"] - one["reference"] + own for own, one in zip(drift, parts, strict=False)]
    group = np.repeat(["mon", "tue", "wed"], 100)
    presses = Presses.create(
        np.concatenate(changes), positions=np.concatenate([one["positions"] for one in parts]), group=group
    )
    fresh = record(100, seed=8)
    asked = fresh["frames"] - fresh["reference"] + drift[3]
    with_it, without = (
        off(LearntSkin.fit(presses, method="neighbours", per_session=one).predict(asked), fresh["positions"])
        for one in (True, False)
    )
    assert np.nanmean(with_it) < 6e-3
    assert np.isnan(with_it).mean() < 0.1
    assert np.isnan(without).mean() > 0.9  # unlike all training data, and reported as such


def test_a_reference_with_missing_readings():
    """They are replaced by the mean, in training and in prediction: no form of the features is lost."""
    recorded = record(80)
    reference = recorded["reference"].copy()
    reference[::7, 4] = np.nan
    skin = LearntSkin.fit(Presses.create(**{**recorded, "reference": reference}), method="ridge")
    assert "ridge on ratios" in dict(skin.standing["place"].tried)
    lacking = FRESH["reference"].copy()
    lacking[:, 9] = np.nan
    assert off(skin.predict(FRESH["frames"], lacking), FRESH["positions"]).mean() < 0.03


def test_a_reference_of_zeros_is_accepted_again():
    """As from devices that subtract it themselves."""
    changes = FRESH["frames"] - FRESH["reference"]
    skin = LearntSkin.fit(
        Presses.create(changes, reference=np.zeros(CHANNELS), force=FRESH["force"]), method="neighbours"
    )
    again = skin.predict(changes, np.zeros(CHANNELS))
    assert np.nanmean(np.abs(again.force - FRESH["force"])) < 1.0


def test_frames_recorded_late_carry_their_own_reference():
    """Their own press determines whether they were touched."""
    recorded = record(240, untouched=40, noise=0.002)
    order = np.random.default_rng(3).permutation(240)
    recorded = {key: values[order] for key, values in recorded.items()}
    late = {key: recorded[key][:-1] for key in ("frames", "reference")}
    skin = LearntSkin.fit(Presses.create(**late, positions=recorded["positions"][1:]), method="neighbours")
    straight = LearntSkin.fit(
        Presses.create(**{key: recorded[key] for key in ("frames", "reference", "positions")}), method="neighbours"
    )
    assert skin.lag == 1
    assert 0.5 * straight.quiet < skin.quiet < 2 * straight.quiet


def test_forces_of_a_few_weights_are_held_out_by_time():
    recorded = record(120)
    force = np.round(recorded["force"])
    skin = LearntSkin.fit(
        Presses.create(recorded["frames"], reference=recorded["reference"], force=force), method="ridge"
    )
    assert not any("repeated" in note for note in skin.notes)


def test_constant_frames_are_refused():
    frames, reference = np.full((20, 6), 0.1), np.linspace(0.3, 1, 6)
    with pytest.raises(ValueError, match="no channel changes"):
        LearntSkin.fit(Presses.create(frames, reference=reference, force=np.arange(20.0)))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda skin: skin.predict(FRESH["frames"][:, :30], FRESH["reference"][:, :30]), "frames have 30 channels"),
        (lambda skin: skin.predict(FRESH["frames"]), "reference is missing"),
        (
            lambda skin: skin.predict(FRESH["frames"], FRESH["reference"][0, ::-1] ** 3),
            "unlike that of the training set",
        ),
        (lambda skin: skin.predict(FRESH["frames"], 1e3 * FRESH["reference"]), "1e\\+03 times as large"),
        (lambda skin: skin.predict("frames"), "give real numbers"),
        (lambda skin: LearntSkin.fit(FRESH), "presses must be Presses"),
        (lambda skin: LearntSkin.fit(Presses.create(**FRESH), method="magic"), "method"),
        (lambda skin: LearntSkin.fit(Presses.create(**FRESH), method="linear-svm"), "the presses have none"),
        (lambda skin: LearntSkin.fit(Presses.create(**FRESH), num_channels=1), "num_channels must be from 2 to 40"),
        (lambda skin: LearntSkin.fit(Presses.create(**FRESH), per_session=True), "no group"),
        (lambda skin: LearntSkin.fit(Presses.create(0 * FRESH["frames"], force=FRESH["force"])), "no channel changes"),
    ],
)
def test_bad_arguments_are_refused(quick, call, message):
    with pytest.raises(ValueError, match=message):
        call(quick)


def test_presses_without_most_readings_are_left_out():
    recorded = record(60)
    frames = recorded["frames"].copy()
    frames[:4, ::2] = np.nan
    frames[:, 5] = np.nan
    frames[4:12, 6] = np.nan
    skin = LearntSkin.fit(Presses.create(**{**recorded, "frames": frames}), method="ridge")
    (share,) = (float(note.split(" %")[0]) for note in skin.notes if "of the readings disagree" in note)
    assert 0.3 < share < 0.6  # 8 of 2,184 and a few others
    assert "1 channel without any reading: 5." in skin.notes
    assert any("4 presses lack more than a third" in note for note in skin.notes)
    frames[:, ::2] = np.nan
    frames[:55] = np.nan
    with pytest.raises(ValueError, match="have readings of two thirds"):
        LearntSkin.fit(Presses.create(**{**recorded, "frames": frames}))
