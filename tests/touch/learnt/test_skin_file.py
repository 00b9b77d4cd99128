"""Learnt skins as files: they are read unchanged, and other files are refused."""

import zipfile
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from made_skins import record

from jeit.touch import LearntSkin, PlacedMap, Presses, SelfOrganisingMap, read_skin, write_skin
from jeit.touch.learnt.array_models import Forest
from jeit.touch.learnt.methods import REGRESSORS
from jeit.touch.learnt.neural_networks import Network

FRESH = record(30, seed=1)


def same(one, other):
    one, other = (each.predict(FRESH["frames"], FRESH["reference"]) for each in (one, other))
    for name in ("position", "position_std", "force", "force_std", "probability", "novelty"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(one.label, other.label)


def test_a_skin_that_is_read_predicts_the_same(skin, tmp_path):
    write_skin(skin, tmp_path / "skin.skops")
    again = read_skin(tmp_path)  # its folder
    same(again, skin)
    assert again.notes == skin.notes


def drawn_network(features, targets):
    """A network of the kind that `Network.train` makes, with random weights."""
    rng, sizes = np.random.default_rng(0), (features.shape[1], 5, targets.shape[1])
    weights = [rng.normal(size=(after, before)) for before, after in pairwise(sizes)]
    return Network(weights, [rng.normal(size=len(one)) for one in weights], features.std(axis=0))


def coarse_map(features, targets):
    """A placed map in which each press is a neuron."""
    return PlacedMap.learn(SelfOrganisingMap(features[None], 1.0), features, targets)


MODELS = [*(REGRESSORS[name] for name in ("ridge", "neighbours", "gaussian-process", "forest", "trees"))]


def test_models_of_every_kind_predict_the_same_places(quick, tmp_path, recorded):
    """One file of a skin that averages seven models, as blends are saved."""
    changes = recorded["frames"] - recorded["reference"]
    place = quick.place
    (features, _), *_ = place.members
    values, targets = (
        features(changes, recorded["reference"])[:60],
        (recorded["positions"][:60] - place.mean) / place.scale,
    )
    members = [(features, learn(values, targets)) for learn in (*MODELS, drawn_network, coarse_map)]
    assert {type(model).__name__ for _, model in members} == {
        "RidgeCV",
        "NearestNeighbours",
        "GaussianProcess",
        "Forest",
        "Network",
        "PlacedMap",
    }
    write_skin(replace(quick, place=replace(place, members=members)), tmp_path / "one.skops")
    again = read_skin(tmp_path / "one.skops").place.members
    for (ours, model), (theirs, other) in zip(members, again, strict=True):
        asked = [one(FRESH["frames"] - FRESH["reference"], FRESH["reference"]) for one in (ours, theirs)]
        np.testing.assert_array_equal(other.predict(asked[1]), model.predict(asked[0]))


@pytest.mark.parametrize("method", ["quadratic-discriminant", "quadratic-svm", "bagged-trees", "nearest"])
def test_classifiers(method, tmp_path, recorded):
    label = np.where(recorded["positions"][:, 0] > 0, "right", "left")
    presses = Presses.create(recorded["frames"], reference=recorded["reference"], label=label)
    skin = LearntSkin.fit(presses.rows(slice(60)), method=method)
    write_skin(skin, tmp_path / "one.skops")
    asked = FRESH["frames"], FRESH["reference"]
    predicted = skin.predict(*asked)
    assert np.isfinite(predicted.probability).any()
    np.testing.assert_array_equal(read_skin(tmp_path / "one.skops").predict(*asked).probability, predicted.probability)


class Payload:
    """A pickle that would be executed on reading."""

    def __reduce__(self):
        return (open, ("ran", "w"))


def test_other_files_are_refused_and_nothing_is_executed(tmp_path, monkeypatch):
    from skops.io import dump

    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match="jeit touch fit"):
        read_skin("none")
    (tmp_path / "text").write_text("skin")
    with zipfile.ZipFile("zip", "w") as file:
        file.writestr("schema.json", "{}")
    dump({"kind": "another"}, "another")
    dump({"kind": "a jeit learnt skin", "version": 9, "skin": {}}, "newer")
    dump({"kind": "a jeit learnt skin", "version": 1, "skin": {}}, "older")
    dump({"kind": "a jeit learnt skin", "version": 2, "skin": {"jeit": "Presses"}}, "strange")
    dump({"kind": "a jeit learnt skin", "version": 2, "skin": {"channels": 1}}, "less")
    dump({"kind": "a jeit learnt skin", "version": 2, "skin": {"channels": Payload()}}, "payload")
    dump({"kind": "a jeit learnt skin", "version": 2, "skin": {"channels": np.random.default_rng}}, "function")
    for name in ("text", "zip", "another", "newer", "older", "strange", "less", "payload", "function"):
        with pytest.raises(ValueError, match="not a learnt skin that can be read"):
            read_skin(name)
    with pytest.raises(ValueError, match="of version 1, and this jeit reads 2"):
        read_skin("older")
    assert not (tmp_path / "ran").exists()


def test_an_inconsistent_file_is_reported(quick, tmp_path):
    """Inconsistent numbers would cause errors in NumPy, or wrong places."""
    write_skin(quick, tmp_path / "skin.skops")
    with zipfile.ZipFile(tmp_path / "skin.skops") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
        seal = archive.comment
    largest = max(members, key=lambda name: len(members[name]) * name.endswith(".npy"))
    members[largest] = members[largest][:-8] + bytes(8)
    with zipfile.ZipFile(tmp_path / "changed.skops", "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
        archive.comment = seal
    with pytest.raises(ValueError, match="changed since it was written"):
        read_skin(tmp_path / "changed.skops")


def test_the_same_skin_is_the_same_bytes(quick, tmp_path):
    write_skin(quick, tmp_path / "one.skops")
    write_skin(read_skin(tmp_path / "one.skops"), tmp_path / "two.skops")
    assert (tmp_path / "one.skops").read_bytes() == (tmp_path / "two.skops").read_bytes()


def test_a_forest_is_no_deeper_than_its_number_of_nodes():
    """Otherwise it could be traversed without end."""
    nodes = np.zeros((1, 3), int)
    with pytest.raises(ValueError, match="depth is 1000000000000, of trees of 3 nodes"):
        Forest(nodes, np.zeros((1, 3)), nodes, nodes, np.zeros((1, 3, 1)), 10**12, np.zeros(1), np.zeros(0))
