"""The network: its layers, its outputs in NumPy, and people distinguished from no touch after a small training."""

import jax
import numpy as np
import pytest

from jeit.acoustic import Recording
from jeit.acoustic.simulate import SoundingPerson, SoundingSkin, microphone_grid, simulate_sound_clips
from jeit.acoustic.simulate.people import MODALITIES
from jeit.acoustic.simulate.sounding_skin import MicrophoneModel
from jeit.touch.listening import Levels, Listener, ModalityNetwork, SoundImages, sound_images
from jeit.touch.listening.learners import LEARNERS, NetworkListener, TrainingSet
from jeit.touch.listening.modality_network import NetworkAnswers, library_plan, paper_plan

KEY = jax.random.key(1)
METHODS = ModalityNetwork.log_odds_in_training, ModalityNetwork.log_odds


def test_outputs_in_numpy_equal_those_of_the_network():
    """With other running means and variances than initially. In training those of the batch are used."""
    random = np.random.default_rng(0)
    network = ModalityNetwork.draw(KEY, 89, 41, 5)
    images = (3 + 2 * random.standard_normal((4, 89, 41))).astype(np.float32)
    learn, answer = (jax.jit(lambda one, method=method: method(one, images)) for method in METHODS)
    answers, moved = learn(network)
    np.testing.assert_array_equal(answers, learn(network)[0])
    for _ in range(200):
        moved = learn(moved)[1]
    np.testing.assert_allclose(answer(moved), answers, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(NetworkAnswers(moved).log_odds(images), answer(moved), rtol=1e-3, atol=1e-4)
    assert network.dense.shape[0] == 13 * 5 * 64
    assert NetworkAnswers(network).log_odds(images[:0]).shape == (0, 5)


def test_the_plan_is_the_papers():
    plan = paper_plan(20_000, batches=20_000)
    assert (plan.rate, plan.batch, plan.decay, plan.patience, plan.look_every) == (2e-4, 64, 0.1, 20, 50)
    # Five epochs of five noisy copies each.
    assert plan.decay_epochs == 25
    assert paper_plan(10, batches=1).batch == 10
    own = library_plan(20_000, batches=20_000)
    assert (own.rate, own.patience, own.decay_epochs) == (1e-3, 20, round(2 * own.epochs / 3))


def test_a_network_is_saved_with_its_levels(tmp_path):
    images = sound_images(Recording(np.random.default_rng(0).standard_normal((4, 9000)), 10_000.0))
    own = NetworkListener.from_network(ModalityNetwork.draw(KEY, 68, 41, 3), Levels.from_images(images))
    listener = Listener(("a", "b", "c"), "network", own, 4, 5000.0, True, 0.0, (1.0, 2.0), 1.0, 0.0)
    listener.write(tmp_path / "listener.jeit")
    again = Listener.read(tmp_path)
    np.testing.assert_array_equal(again.model.log_odds(images), own.log_odds(images))


@pytest.mark.slow(first=True)
def test_a_small_training_generalises_to_a_new_person():
    """The small preset: trained on four people and tested on a fifth, on a skin with sensitive microphones. One in five
    is right by chance. A network that is not trained is far below the bound, and so is one trained on shuffled labels.
    """
    skin = SoundingSkin(jax.random.key(0), microphone_grid(3), microphone_model=MicrophoneModel(snr_db=12.0))
    people = [SoundingPerson.draw(key) for key in jax.random.split(KEY, 5)]
    parts, right, person = [], [], []
    for clip in simulate_sound_clips(KEY, skin, people, 3, duration=1.6):
        parts.append(sound_images(Recording(clip.samples, skin.rate))[::2])
        right += [MODALITIES.index(clip.modality)] * len(parts[-1])
        person += [clip.person] * len(parts[-1])
    images, right, person = SoundImages.concatenate(parts), np.array(right), np.array(person)
    out = person == 4

    def share(method: str) -> float:
        lesson = TrainingSet(images[~out], right[~out], person[~out], 5, KEY, batches=100)
        return float(np.mean(LEARNERS[method].learn(lesson).log_odds(images[out]).argmax(axis=1) == right[out]))

    untrained = NetworkListener.from_network(ModalityNetwork.draw(KEY, 73, 41, 5), Levels.from_images(images)).log_odds(
        images
    )
    found = {method: share(method) for method in ("network", "trees", "linear")}
    assert np.mean(untrained.argmax(axis=1) == right) < 0.4
    assert found["network"] > 0.65, found
    assert min(found["trees"], found["linear"]) > 0.8, found
