"""Skins with a known model: images of their changes locate touches after little training."""

import numpy as np
import pytest

from jeit import BoundaryElectrodes, Disk, ForwardModel, adjacent, ring
from jeit.touch import LearntSkin, Presses, read_skin, write_skin
from jeit.touch.learnt.features import ContactFeatures, ImageFeatures, ImageReconstruction

RADIUS = 0.05
ELECTRODES = BoundaryElectrodes(ring(RADIUS, 12), width=0.008, contact_impedance=0.01)
MODEL = ForwardModel(Disk(RADIUS).mesh(num_points=300), ELECTRODES, adjacent(12))
# Twice as conductive as the model assumes, and on another mesh.
SKIN, CONDUCTIVITY = ForwardModel(Disk(RADIUS).mesh(num_points=700), ELECTRODES, adjacent(12)), 2.0


def record(number, seed, *, sign=1.0):
    """Presses that change the conductivity of a round spot by up to a half."""
    rng = np.random.default_rng(seed)
    radius, angle = 0.04 * np.sqrt(rng.uniform(size=number)), rng.uniform(0, 2 * np.pi, number)
    places = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    strength = rng.uniform(0.1, 0.5, number)
    corners = np.asarray(SKIN.mesh.points)[np.asarray(SKIN.mesh.cells)].mean(axis=1)
    spot = np.exp(-((np.linalg.norm(places[:, None] - corners, axis=2) / 0.008) ** 2))
    reference = np.asarray(SKIN.voltages(CONDUCTIVITY))
    changed = CONDUCTIVITY * (1 + sign * strength[:, None] * spot)
    frames = np.stack([np.asarray(SKIN.voltages(one)) for one in changed])
    noise = 1e-5 * np.abs(reference).max() * rng.normal(size=frames.shape)
    return {"frames": frames + noise, "reference": reference, "positions": places}


LEARNT, FRESH = record(24, 0), record(60, 1)


def off(skin):
    prediction = skin.predict(FRESH["frames"], FRESH["reference"])
    return np.nanmean(np.linalg.norm(prediction.position - FRESH["positions"], axis=1))


@pytest.fixture(scope="module")
def skin():
    return LearntSkin.fit(Presses.create(**LEARNT), method="ridge", model=MODEL)


def test_few_presses_are_enough_with_a_model(skin):
    """Without a model they are not."""
    assert off(skin) < 3.5e-3
    assert off(LearntSkin.fit(Presses.create(**LEARNT), method="ridge")) > 3 * off(skin)
    assert skin.standing["place"].method == "ridge on contacts"


def test_skins_with_a_model_are_saved(skin, tmp_path):
    write_skin(skin, tmp_path / "skin.skops")
    again = read_skin(tmp_path / "skin.skops").predict(FRESH["frames"], FRESH["reference"])
    np.testing.assert_array_equal(again.position, skin.predict(FRESH["frames"], FRESH["reference"]).position)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("unit", [1.0, 1e-3, -250.0])
def test_the_contact_is_the_touch_for_any_sign_and_unit(sign, unit):
    """Millivolts, counts of a converter, and voltages with the opposite sign."""
    pressed = record(24, 0, sign=sign)
    changes = unit * (pressed["frames"] - pressed["reference"])
    imaged, _ = ImageReconstruction.create(MODEL, changes, np.ones(len(changes.T), bool), unit * pressed["reference"])
    place = ContactFeatures(imaged)(changes)[:, :2]
    assert np.linalg.norm(place - pressed["positions"], axis=1).mean() < 3e-3


@pytest.mark.parametrize("reference", [None, np.zeros(108)])
def test_changes_without_a_reference_are_imaged_by_the_given_model(reference):
    changes = LEARNT["frames"] - LEARNT["reference"]
    imaged, notes = ImageReconstruction.create(MODEL, changes, np.ones(108, bool), reference)
    place = ContactFeatures(imaged)(changes)[:, :2]
    assert np.linalg.norm(place - LEARNT["positions"], axis=1).mean() < 3e-3
    assert notes == []


def test_contacts_of_a_given_image():
    """Of a square of 3 × 3 cells, with its peak at the centre and the right neighbour above the level."""
    grid = np.stack(np.meshgrid(np.arange(3.0), np.arange(3.0)), axis=-1).reshape(-1, 2)
    imaged = ImageReconstruction(np.eye(9), grid, np.full(9, 2.0), np.tile(np.arange(9), (9, 1)))
    image = np.zeros((1, 9))
    image[0, 4], image[0, 5], image[0, 0] = 1.0, 0.85, -3.0
    (found,) = imaged.contacts(image)
    np.testing.assert_allclose(found[:2], [1 + 0.15 / 0.45, 1.0])
    np.testing.assert_allclose(np.exp(found[2:]), [1.0, 2 * 1.85, 4.0])
    assert np.isfinite(imaged.contacts(-np.ones((1, 9)))).all()


def test_distant_cells_are_another_contact():
    changes = LEARNT["frames"] - LEARNT["reference"]
    imaged, _ = ImageReconstruction.create(MODEL, changes, np.ones(108, bool), LEARNT["reference"])
    image = sum(
        height * np.exp(-((np.linalg.norm(imaged.centres - [place, 0], axis=1) / 0.006) ** 2))
        for height, place in ((1.0, -0.03), (0.95, 0.03))
    )
    np.testing.assert_allclose(imaged.contacts(image[None])[0, :2], [-0.03, 0.0], atol=3e-3)


def test_images_are_relative_to_their_size():
    imaged, _ = ImageReconstruction.create(
        MODEL, LEARNT["frames"] - LEARNT["reference"], np.ones(108, bool), LEARNT["reference"]
    )
    changes = LEARNT["frames"] - LEARNT["reference"]
    one, three = ImageFeatures(imaged)(changes), ImageFeatures(imaged)(3 * changes)
    np.testing.assert_allclose(three[:, 6:], one[:, 6:], rtol=1e-9)
    np.testing.assert_allclose(three[:, 5] - one[:, 5], np.log(3))


def test_a_model_that_does_not_fit_is_reported(skin):
    assert not [note for note in skin.notes if "misses" in note]
    turned = np.random.default_rng(0).permutation(108)
    mixed = {key: value if key == "positions" else value[..., turned] for key, value in LEARNT.items()}
    found = LearntSkin.fit(Presses.create(**mixed), method="ridge", model=MODEL)
    assert any("model misses" in note for note in found.notes)


def test_bad_models_are_refused():
    presses = Presses.create(**LEARNT)
    more = BoundaryElectrodes(ring(RADIUS, 16), width=0.008, contact_impedance=0.01)
    other = ForwardModel(MODEL.mesh, more, adjacent(16))
    with pytest.raises(ValueError, match=r"model: its protocol has 208 channels, and frames have 108"):
        LearntSkin.fit(presses, model=other)
    with pytest.raises(ValueError, match="model must be a ForwardModel"):
        LearntSkin.fit(presses, model="skin.toml")  # type: ignore[arg-type]
    grouped = Presses.create(**LEARNT, group=np.zeros(24))
    with pytest.raises(ValueError, match="per_session takes their unit away"):
        LearntSkin.fit(grouped, model=MODEL, per_session=True)
