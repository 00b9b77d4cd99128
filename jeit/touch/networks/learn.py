"""`learn_images`: train a network that images the touches of a described skin, on simulated data, and evaluate it."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind, check_name, describe
from jeit.arguments.extras import need_extra
from jeit.design import Skin, touches_away_from_the_edge
from jeit.design.study.store import OtherContents
from jeit.layout import Layout
from jeit.touch.networks.examples import Examples, StoredTouches
from jeit.touch.networks.image_network import DESIGNS, FILE, ImageNetwork, write_network
from jeit.touch.networks.places import centroids_of, errors
from jeit.touch.networks.sensed import Sensed
from jeit.touch.networks.touches import detection_noise, touch_draws
from jeit.touch.networks.training import Runs, train_three_stages, train_unrolled
from jeit.touch.networks.unrolled import Unrolled
from jeit.touch.simulate import Indent, IndentSet, ball, relative_changes, simulate_presses
from jeit.touch.simulate.contact.indent_sets import image_places
from jeit.touch.training import Plan, Trained

SHAPE = (48, 48)
# The number of touches of a chunk; seeds of the training set, the held-out set, and the test set, which no choice
# depends on.
_CHUNK, _SEEDS = 250, (0, 1, 2)
# Of the evaluation: the diameter of a ball, metres, its depth, as a share of the skin's thickness, and the number of
# places a side.
_BALL, _DEPTH, _PLACES = 0.015, 0.75, 15


@dataclass(frozen=True)
class Preset:
    """Size of a training: `number` of touches, `held_out` ones besides, and the `plan` of every training.

    `three_stages`: the plan of that design, where it is another.
    """

    number: int
    held_out: int
    plan: Plan
    three_stages: Plan | None = None

    def plan_of(self, design: str) -> Plan:
        """The plan of a design."""
        return self.three_stages if design == "three-stages" and self.three_stages is not None else self.plan


PRESETS = {
    "quick": Preset(1000, 250, Plan(rate=2e-3, batch=32, epochs=10, patience=6, decay=0.8)),
    "full": Preset(
        24_000,
        2000,
        Plan(rate=2e-3, batch=64, epochs=20, patience=8, decay=0.87),
        Plan(rate=1e-3, batch=128, epochs=30, patience=5, decay=0.92),
    ),
}


@dataclass(frozen=True)
class ImageStanding:
    """Accuracy of a network on touches of a test set.

    **Fields**: `explained`, the share of the squares of depths that its maps get right, at most 1; `place`, errors of
    the centroid of a single ball, metres, over a grid of places (mean, sd, rms), and `deepest`, the median ratio of its
    estimated to its true depth; `right` and `estimated`, some maps, (k, rows, columns) over the thickness.
    """

    explained: float
    place: dict[str, float]
    deepest: float
    right: Float[np.ndarray, "k rows columns"]
    estimated: Float[np.ndarray, "k rows columns"]


@dataclass(frozen=True)
class LearntImages:
    """A `network`, the `courses` of its trainings by name, its `standing`, and the `seconds` of each part of the
    work."""

    network: ImageNetwork
    courses: dict[str, Trained]
    standing: ImageStanding
    seconds: dict[str, float]


def learn_images(
    skin: Skin,
    folder: str | Path,
    *,
    preset: str | Preset = "full",
    design: str = "unrolled",
    touches: int | None = None,
    seed: int = 0,
    client: Any = None,
    progress: Callable[[str], None] | None = None,
) -> LearntImages:
    """Simulate touches of a skin, train a network on them, and write it to `folder`, as `network.jeit`.

    Interrupted at any moment, the same call resumes: touches are stored in chunks in the folder `work`, and trainings
    in checkpoints. `preset`: "quick", under two minutes, "full", or a `Preset`; `design`: "unrolled", a network with
    the skin's forward model, or "three-stages", that of Park et al. 2022. `touches`: the number of training touches, as
    many as fit on the disk; the preset's unless given. `client`: of a dask cluster, which then simulates. `progress` is
    called with a description of the progress. Raises `ValueError` for curved skins, names that there are not, no
    number, and a folder of another skin's work; `ImportError` without the extras `learn` and `cluster`.
    """
    need_extra("learn", "a network that images touches")
    need_extra("cluster", "a store of simulated touches")
    check_kind("skin", skin, Skin, "a Skin, as of read_described_skin('skin.toml')")
    if not isinstance(skin.layout, Layout):
        raise ValueError(
            f"skin: networks image flat skins, and {describe(skin.layout.name)} is of a curved one; give its surface "
            "as a rectangle, skin.width_mm and skin.height_mm in place of the table [surface]."
        )
    check_name("design", design, DESIGNS)
    if not isinstance(preset, Preset):
        check_name("preset", preset, PRESETS)
        preset = PRESETS[preset]
    if touches is not None:
        if not (isinstance(touches, int) and touches >= 1):
            raise ValueError(f"touches must be a whole number, 1 or more; it is {describe(touches)}.")
        preset = dataclasses.replace(preset, number=touches)
    report = (lambda _: None) if progress is None else progress
    work = Path(folder) / "work"
    work.mkdir(parents=True, exist_ok=True)
    seconds, start = {}, time.monotonic()
    report("noise")
    noise = detection_noise(skin)
    sets = {}
    for name, number, own in zip(
        ("learnt", "held-out", "standing"), (preset.number, preset.held_out, preset.held_out), _SEEDS, strict=True
    ):
        indents = IndentSet(skin, touch_draws(skin), number, seed=3 * seed + own, shape=SHAPE, chunk=_CHUNK)
        where = work / f"{name}.zarr"
        try:
            simulate_presses(
                indents,
                where,
                client=client,
                progress=lambda now, name=name: report(f"touches {name}: {now.points} of {now.all_points}"),
            )
        except OtherContents:
            raise ValueError(
                f"folder '{folder}' was begun for another skin, seed or number of touches; give another folder, or "
                f"delete '{work}' to learn anew."
            ) from None
        sets[name] = StoredTouches(indents, where)
    held, judged = (sets[name].in_memory() for name in ("held-out", "standing"))
    seconds["touches"] = time.monotonic() - start
    key = jax.random.key(seed)
    runs = Runs(preset.plan_of(design), key, work, progress)
    if design == "unrolled":
        sensed = Sensed.of(skin, SHAPE)
        start_network = Unrolled(held.change.shape[1], SHAPE, key=jax.random.fold_in(key, 3))
        places = image_places(skin, SHAPE[1], SHAPE[0])
        start_network = start_network.of_skin(sensed, places, skin.layout.centres, noise)
        learnt = train_unrolled(start_network, sensed, sets["learnt"], held, noise, runs)
    else:
        learnt = train_three_stages(sets["learnt"], held, noise, runs)
    seconds["training"] = time.monotonic() - start - seconds["touches"]
    network = ImageNetwork.of_skin(learnt.network, skin, noise, SHAPE)
    report("standing")
    standing = stand(network, skin, judged)
    seconds["all"] = time.monotonic() - start
    write_network(network, Path(folder) / FILE)
    return LearntImages(network, learnt.courses, standing, seconds)


def stand(network: ImageNetwork, skin: Skin, examples: Examples, seed: int = 0) -> ImageStanding:
    """Evaluate a network on touches, with the noise that it was trained with."""
    random = np.random.default_rng(seed)

    def answered(change):
        return network.share(change + network.noise * random.normal(size=change.shape))

    maps = answered(examples.change)
    explained = 1 - float(np.mean((maps - examples.depth) ** 2) / np.mean(examples.depth**2))
    grid = touches_away_from_the_edge(skin.outline, _BALL / 2, _PLACES, _PLACES)
    tip, depth = ball(_BALL), min(_DEPTH * float(skin.thickness), _BALL / 2)
    found = answered(relative_changes(skin, [[Indent(tip, depth, place)] for place in grid.places]))
    rows, columns = network.shape
    place = errors(centroids_of(found, image_places(skin, columns, rows)), grid.places)
    deepest = float(np.median(found.max(axis=(1, 2)))) * float(skin.thickness) / depth
    return ImageStanding(explained, place, deepest, examples.depth[:6], maps[:6])
