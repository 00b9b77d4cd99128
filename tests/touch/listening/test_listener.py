"""Listeners: trained on clips, saved in a file, and applied to recordings. Held-out groups, and refused input."""

from itertools import pairwise

import jax
import numpy as np
import pytest
from made_clips import MATERIALS, struck

from jeit.acoustic import Recording
from jeit.touch.learnt.methods import CLASSIFIERS
from jeit.touch.listening import LabelledClips, Listener
from jeit.touch.listening.feature_images import WINDOW_DURATION, SoundImages
from jeit.touch.listening.learners import LEARNERS, LinearLearner, TrainingSet, select_early_stopping_windows
from jeit.touch.listening.windows import _split_pieces, held_out_folds

KEY = jax.random.key(0)
QUICK = tuple(method for method in LEARNERS if "network" not in method)


def clips(each: int, seed: int = 0, **options) -> LabelledClips:
    random = np.random.default_rng(seed)
    labels = [name for name in MATERIALS for _ in range(each)]
    return LabelledClips.from_recordings([struck(random, name, **options) for name in labels], labels)


@pytest.fixture(scope="module")
def learnt() -> dict[str, Listener]:
    """A listener by each quick method, trained on five clips of each class."""
    few = clips(5)
    return {method: Listener.fit(few, method=method) for method in QUICK}


@pytest.mark.parametrize("method", QUICK)
def test_materials_are_classified_and_listeners_are_saved(method, learnt, tmp_path):
    """For clips of other seeds most are right, a saved listener gives the same result, and probabilities sum to one."""
    listener = learnt[method]
    assert listener.standing is not None
    assert (listener.standing.held_out == listener.standing.right).mean() > 0.7
    listener.write(tmp_path / "listener.jeit")
    again = Listener.read(tmp_path)
    others, right = clips(6, seed=1), 0
    for number in range(len(others)):
        sound_labels = listener.classify(others.clip(number))
        same = again.classify(others.clip(number))
        np.testing.assert_allclose(same.probabilities, sound_labels.probabilities, rtol=1e-4, atol=1e-7)
        np.testing.assert_allclose(sound_labels.probabilities.sum(axis=1), 1)
        right += sound_labels.whole[0] == others.labels[number]
    assert right >= 0.75 * len(others)


@pytest.mark.slow
def test_the_best_method_on_held_out_clips_is_selected(learnt, tmp_path, monkeypatch):
    """All methods are tried, with a network where there are enough windows. After a kill before its last fold, the same
    call continues to the same bits.
    """
    few = clips(5)
    monkeypatch.setattr("jeit.touch.listening.listener._MIN_NETWORK_WINDOWS", 0)

    class Killed(Exception):
        pass

    def kill(message: str) -> None:
        if message.startswith("network, fold 3"):
            raise Killed

    with pytest.raises(Killed):
        Listener.fit(few, key=KEY, batches=10, folder=tmp_path, progress=kill)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["network-0.training", "network-1.training"]
    on = Listener.fit(few, key=KEY, batches=10, folder=tmp_path)
    through = Listener.fit(few, key=KEY, batches=10)
    assert on.standing is not None
    assert through.standing is not None
    tried = dict(on.standing.tried)
    assert tried == dict(through.standing.tried)
    assert set(tried) == {*QUICK, "network"}
    assert tried[on.method] == min(tried.values())
    for method, listener in learnt.items():
        assert listener.standing is not None
        assert listener.standing.tried == [(method, tried[method])]
    sound_labels, same = (one.classify(few.clip(0)) for one in (on, through))
    np.testing.assert_array_equal(sound_labels.probabilities, same.probabilities)


def test_silent_windows_are_quiet(learnt):
    """One tap a second: it is classified where it sounds, with silence between."""
    random = np.random.default_rng(3)
    tap = struck(random, "metal")
    long = np.zeros((1, 4 * 44_100))
    for second in (0, 2):
        long[:, second * 44_100 + 22_050 :][:, : tap.samples.shape[1]] += tap.samples
    sound_labels = learnt["linear"].classify(Recording(long, 44_100.0, name="long"))
    assert sound_labels.whole[0] == "metal"
    # At its edges a window contains little of a tap, and may be assigned to another class.
    assert np.mean(sound_labels.named[sound_labels.loud] == "metal") > 0.6
    assert sound_labels.quiet.sum() > 10
    assert [event.name for event in sound_labels.events].count("") >= 2
    nothing = learnt["linear"].classify(Recording(np.zeros((1, 44_100)), 44_100.0))
    assert set(nothing.named) == {""}
    assert nothing.whole == ("", 0.0)
    faint = learnt["linear"].classify(Recording(1e-6 * tap.samples, 44_100.0))
    assert "quieter than anything" in faint.notes[0]
    assert faint.whole == ("", 0.0)


def test_unlike_recordings_are_refused_with_the_difference(learnt):
    tap = struck(np.random.default_rng(4), "glass")
    mono = learnt["linear"]
    both = mono.classify(Recording(tap.samples.repeat(2, axis=0), tap.rate))
    assert "2 channels were mixed" in both.notes[0]
    np.testing.assert_allclose(both.probabilities, mono.classify(tap).probabilities)
    with pytest.raises(ValueError, match=r"has 8000 samples a second, sound up to 4000 Hz, and.* up to 22050 Hz"):
        mono.classify(Recording(tap.samples[:, :8000], 8000.0))
    stereo = LabelledClips.from_recordings(
        [Recording(one.samples.repeat(2, axis=0), one.rate) for one in clips(3).recordings], clips(3).labels
    )
    two = Listener.fit(stereo, method="linear")
    assert two.channels == 2
    with pytest.raises(ValueError, match="has 1 microphone, and the listener was learnt from clips of 2"):
        two.classify(tap)
    holes = tap.samples.copy()
    holes[:, 10:20] = np.nan
    assert "10 samples not finite" in mono.classify(Recording(holes, tap.rate)).notes[0]


def test_few_clips_are_enough_and_the_unknown_error_is_reported():
    one = clips(1)
    listener = Listener.fit(one, method="linear")
    assert listener.standing is None
    assert any("nobody knows" in note for note in listener.notes)
    several = LabelledClips.from_recordings(
        [*clips(3).recordings, struck(np.random.default_rng(9), "wood")], [*clips(3).labels, "cork"]
    )
    listener = Listener.fit(several, method="linear")
    assert any(note.startswith("cork: clips of one group only") for note in listener.notes)
    assert listener.standing is not None
    assert "cork" not in listener.standing.right


def _at(gain: float, one: Recording) -> Recording:
    return Recording(gain * one.samples, one.rate, name=one.name)


@pytest.mark.parametrize("method", ["linear", "spectrum", "trees"])
def test_gain_does_not_matter_unless_loudness_is_a_feature(method):
    """Clips of one gain, classified at another: probabilities are the same, and a sound is not quiet."""
    listener = Listener.fit(clips(4), method=method)
    assert not listener.loudness
    others = clips(2, seed=1)
    for number in range(len(others)):
        sound_labels, softer = (listener.classify(_at(gain, others.clip(number))) for gain in (1.0, 0.2))
        np.testing.assert_allclose(softer.probabilities, sound_labels.probabilities, atol=1e-3)
        assert not softer.quiet[softer.loud].any()
    soft = [_at(gain, one) for gain in (0.05, 1.0) for one in clips(4).recordings]
    listener = Listener.fit(LabelledClips.from_recordings(soft, ["soft"] * 12 + ["hard"] * 12), method=method)
    assert listener.loudness
    assert listener.classify(_at(0.05, others.clip(0))).whole[0] == "soft"
    assert listener.classify(others.clip(0)).whole[0] == "hard"


def test_one_recording_of_many_taps_is_split_into_clips():
    """One file for each class, with 15 taps in each: they are held out in turn, and no tap is on both sides."""
    random = np.random.default_rng(6)
    labels, long = list(MATERIALS), []
    for name in labels:
        taps = [np.pad(struck(random, name).samples, ((0, 0), (20_000, 30_000))) for _ in range(15)]
        long.append(Recording(np.hstack(taps), 44_100.0, name=name))
    listener = Listener.fit(LabelledClips.from_recordings(long, labels), method="linear")
    assert listener.standing is not None
    assert len(listener.standing.right) == 45
    assert (listener.standing.held_out == listener.standing.right).mean() > 0.8
    assert any(note.startswith("glass, metal, wood: one recording only") for note in listener.notes)
    several = LabelledClips.from_recordings([*long, *clips(2).recordings], [*labels, *clips(2).labels])
    assert not any("one recording" in note for note in Listener.fit(several, method="linear").notes)


def test_a_continuous_sound_is_split_without_samples_on_both_sides():
    times = np.arange(0.25, 20, 0.1)
    pieces = _split_pieces(times)
    assert len(pieces) == 8
    for one, other in pairwise(pieces):
        assert times[other[0]] - times[one[-1]] > WINDOW_DURATION - 1e-9
    two = np.concatenate([times[:5], times[30:40]])
    assert [len(piece) for piece in _split_pieces(two)] == [5, 10]


def test_a_class_of_few_clips_is_predicted_as_often():
    """Three clips of one class beside thirty of another."""
    random = np.random.default_rng(7)
    labels = ["wood"] * 30 + ["glass"] * 3
    listener = Listener.fit(
        LabelledClips.from_recordings([struck(random, name) for name in labels], labels), method="linear"
    )
    assert all(listener.classify(struck(random, "glass")).whole[0] == "glass" for _ in range(10))


def test_no_group_is_on_both_sides_and_every_class_is_in_training():
    random = np.random.default_rng(0)
    for _ in range(50):
        groups = random.integers(0, random.integers(2, 12), 40)
        right = random.integers(0, 4, 40)
        fold = held_out_folds(right, groups, 3)
        for number in range(int(fold.max()) + 1):
            out = fold == number
            assert not set(groups[out]) & set(groups[~out])
            assert set(right[out]) <= set(right[~out])
        held = select_early_stopping_windows(right, groups)
        assert not set(groups[held]) & set(groups[~held])
        assert set(right[~held]) == set(right)


def test_different_rates_and_channels_are_reported():
    random = np.random.default_rng(5)
    mixed = [struck(random, "wood"), struck(random, "metal", rate=16_000.0)]
    mixed += [Recording(struck(random, name).samples.repeat(2, axis=0), 44_100.0) for name in ("wood", "metal")]
    labelled = LabelledClips.from_recordings(mixed, ["wood", "metal", "wood", "metal"])
    assert labelled.highest == 8000
    assert labelled.channels == 1
    assert "1 or 2 channels" in labelled.notes[0]
    assert "1 of 4 clips have fewer than 44100" in labelled.notes[1]
    listener = Listener.fit(labelled, method="linear")
    assert listener.classify(mixed[1]).names == ("metal", "wood")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: LabelledClips.from_recordings([], []), "there are no clips"),
        (
            lambda: LabelledClips.from_recordings([struck(np.random.default_rng(0), "wood")], ["wood"]),
            "one class only, 'wood'",
        ),
        (
            lambda: LabelledClips.from_recordings([struck(np.random.default_rng(0), "wood")], ["wood", "metal"]),
            "one name for each",
        ),
        (
            lambda: LabelledClips.from_recordings([np.zeros(9), np.zeros(9)], ["a", "b"]),
            r"recordings\[0\] must be a Recording",
        ),
        (lambda: Listener.fit([1, 2]), "clips must be"),
        (lambda: Listener.fit(clips(2), method="magic"), "method"),
        (lambda: Listener.fit(clips(2), key=3), "key"),
    ],
)
def test_bad_input_is_explained(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_files_of_another_kind_are_refused(learnt, tmp_path):
    with pytest.raises(FileNotFoundError, match="jeit listen fit"):
        Listener.read(tmp_path)
    path = tmp_path / "listener.jeit"
    path.write_text("no listener", "utf-8")
    with pytest.raises(ValueError, match="another kind"):
        Listener.read(path)
    learnt["trees"].write(path)
    whole = path.read_bytes()
    path.write_bytes(whole[:-20])
    with pytest.raises(ValueError, match=r"truncated|fewer than|EOF"):
        Listener.read(path)
    path.write_bytes(whole.replace(b'"method": "trees"', b'"method": "magic"'))
    with pytest.raises(ValueError, match="magic"):
        Listener.read(path)
    path.write_bytes(whole.replace(b'"depth": ', b'"depth": -'))
    with pytest.raises(ValueError, match="do not exist"):
        Listener.read(path)


def test_constant_features_have_no_effect():
    """Their covariance is singular, for which least squares may fail."""
    random = np.random.default_rng(0)
    informative = random.normal(size=(30, 3)) + np.repeat(np.eye(3), 10, axis=0)
    given = np.concatenate([informative, np.full((30, 2), 7.0)], axis=1)
    nothing = SoundImages(
        np.zeros(30), np.zeros((30, 1, 41)), np.zeros((30, 64, 41)), np.zeros(30, int), np.ones(30, bool)
    )
    right = np.repeat(np.arange(3), 10)
    lesson = TrainingSet(nothing, right, np.arange(30), 3, jax.random.key(0))
    found, plain = (LinearLearner(lambda _, own=own: own).learn(lesson) for own in (given, informative))
    assert not found.weights[3:].any()
    np.testing.assert_allclose(found.weights[:3], plain.weights, atol=1e-9)


def test_a_covariance_for_which_least_squares_fails(monkeypatch):
    """It is inverted by its eigenvectors: the odds are the same."""
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis as Discriminant

    random = np.random.default_rng(0)
    right = np.repeat(np.arange(3), 10)
    features = random.normal(size=(30, 4)) + np.eye(4)[right]
    usual = CLASSIFIERS["linear-discriminant"](features, right)

    def fails(self, *arguments, **more):
        raise np.linalg.LinAlgError("SVD did not converge")

    monkeypatch.setattr(Discriminant, "_solve_lstsq", fails)
    other = CLASSIFIERS["linear-discriminant"](features, right)
    odds = [one.decision_function(features) for one in (usual, other)]
    np.testing.assert_allclose(*[one - one[:, :1] for one in odds], atol=1e-9)
