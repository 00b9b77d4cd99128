"""Pats, tickles, strokes, wind and nothing told apart by sound, beside Park et al. (2022); all simulated.

What is simulated, and how people differ, is in `problems/sounding_people.py` and `jeit.acoustic.simulate.people`. The
paper augments first and splits at random after, so that copies of one window, and windows of one recording, are on both
sides; with recordings held out, and with people, they are not. To be compared: what each split makes of one and the
same network; not per cent.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from benchmarks.harness.case import Asked, Case, Options, Result, Table, judged
from benchmarks.harness.tables import duration
from benchmarks.harness.timing import say, timed
from benchmarks.problems.sounding_people import FEWER, LOUDER, HeardPeople, heard_people
from jeit.acoustic import Recording
from jeit.acoustic.simulate.people import MODALITIES
from jeit.touch.listening import Levels, ModalityNetwork, SoundImages, sound_images
from jeit.touch.listening.learners import LEARNERS, NetworkListener, TrainingSet
from jeit.touch.listening.modality_network import COPIES

# Where sets and trainings are kept from one run to the next.
STORE = Path(tempfile.gettempdir()) / "jeit-modality"
PEOPLE, CLIPS, SEED = 10, 8, 1
# Folds by person, of two each.
FOLDS = 5
# Batches at most, of the paper's schedule, of our own, and of shuffled labels.
BATCHES, OWN_BATCHES, SHUFFLED_BATCHES = 1000, 400, 100
# Decibels by which the copies of the paper's split differ from each window.
_COPIED = 2.0
PAPER = 98.7
METHODS = tuple(LEARNERS)


@dataclass
class Experiment:
    """A set, and what learns of it: `folder` for the trainings of networks, of a few batches if `quick`."""

    heard: HeardPeople
    folder: Path | None
    quick: bool = False

    def learnt(self, method: str, name: str, images: SoundImages, right: np.ndarray, groups: np.ndarray):
        """What learns these windows; `name` tells its training from others."""
        batches = OWN_BATCHES if method == "network" else BATCHES
        batches = 3 if self.quick else SHUFFLED_BATCHES if "shuffled" in name else batches
        kept = None if self.folder is None else self.folder / f"{name}-{batches}.training"
        return LEARNERS[method].learn(
            TrainingSet(images, right, groups, len(MODALITIES), jax.random.key(0), batches, kept)
        )

    def by_person(self, method: str, variants: list[tuple[float, int]], number: int = 25) -> np.ndarray:
        """Confusions (V, C, C), counts, of the windows of each fold's people when they were held out, in each of the
        `variants` of noise and microphones; what is learnt from is heard by `number` microphones without more noise."""
        images, right, person = self.heard.images[0.0, number], self.heard.right, self.heard.person
        fold = person // -(-(int(person.max()) + 1) // FOLDS)
        counts = np.zeros((len(variants), len(MODALITIES), len(MODALITIES)))
        for one in range(int(fold.max()) + 1):
            out = fold == one
            model = self.learnt(method, f"{method}-{number}-{one}", images[~out], right[~out], person[~out])
            for place, variant in enumerate(variants):
                said = model.log_odds(self.heard.images[variant][out]).argmax(axis=1)
                np.add.at(counts[place], (right[out], said), 1)
            say(f"{method}, {number} microphones: fold {one + 1}; {_percent(counts[0])} so far")
        return counts

    def by_recording(self, method: str, *, shuffled: bool = False) -> float:
        """Share that is right of a fifth of the clips, held out; learnt from labels that were `shuffled`, if so."""
        heard = self.heard
        out = heard.clip % 5 == 4
        order = np.random.default_rng(0).permutation(int((~out).sum())) if shuffled else slice(None)
        images, name = heard.images[0.0, 25], f"{method}-recording{'-shuffled' if shuffled else ''}"
        model = self.learnt(method, name, images[~out], heard.right[~out][order], heard.clip[~out])
        return float(np.mean(model.log_odds(images[out]).argmax(axis=1) == heard.right[out]))

    def as_the_paper(self, method: str) -> float:
        """Share that is right of a tenth of all copies, drawn at random: windows are copied with noise first."""
        heard, rng = self.heard, np.random.default_rng(0)
        copies = [_noisy(heard.images[0.0, 25], rng) for _ in range(COPIES)]
        images, right = SoundImages.joined(copies), np.tile(heard.right, COPIES)
        deal = rng.permutation(len(right))
        part = np.empty(len(right), int)
        part[deal] = np.arange(len(right)) * 10 // len(right)
        # Of the nine tenths one stops the training, drawn at random too.
        train, test = part < 9, part == 9
        model = self.learnt(method, f"{method}-paper", images[train], right[train], part[train])
        return float(np.mean(model.log_odds(images[test]).argmax(axis=1) == right[test]))

    def untrained(self) -> float:
        """Share that a network is right of before it is trained."""
        images = self.heard.images[0.0, 25]
        network = ModalityNetwork.draw(jax.random.key(0), images.intensity.shape[1] + 64, 41, len(MODALITIES))
        said = NetworkListener.from_network(network, Levels.from_images(images)).log_odds(images).argmax(axis=1)
        return float(np.mean(said == self.heard.right))


def run(options: Options) -> Result:
    """Three splits by every method; noise and microphones; how quick an answer is."""
    if options.quick:
        experiment = Experiment(heard_people(2, 2, SEED), None, quick=True)
    else:
        say(f"{PEOPLE} people × {CLIPS} clips × {len(MODALITIES)} modalities are simulated, or read")
        (STORE / "trainings").mkdir(parents=True, exist_ok=True)
        experiment = Experiment(heard_people(PEOPLE, CLIPS, SEED, store=STORE), STORE / "trainings")
    noisier = [(louder, 25) for louder in LOUDER]
    splits, persons, rows = {}, {}, []
    nothing = experiment.untrained(), experiment.by_recording("paper-network", shuffled=True)
    for method in METHODS:
        # By the two easier splits networks are told by the paper's schedule alone.
        leaky, fair = (None, None)
        if method != "network":
            leaky, fair = experiment.as_the_paper(method), experiment.by_recording(method)
            say(f"{method}: {100 * leaky:.1f} % of the paper's split, {100 * fair:.1f} % by recording")
        persons[method] = experiment.by_person(method, noisier)
        splits[method] = leaky, fair, _right(persons[method][0])
        rows.append([method, *("" if one is None else f"{100 * one:.1f} %" for one in splits[method])])
    rows += [
        [f"{name} network", "", f"{100 * one:.1f} %", ""]
        for name, one in zip(("untrained", "shuffled"), nothing, strict=True)
    ]
    best = max(METHODS, key=lambda method: splits[method][2])
    noise = [[method, *(_percent(one) for one in persons[method])] for method in METHODS]
    fewer = [
        [method, *(_percent(experiment.by_person(method, [(0.0, number)], number)[0]) for number in FEWER)]
        for method in ("trees", "linear")
    ]
    confusion = persons[best][0]
    confusion /= np.maximum(confusion.sum(axis=1, keepdims=True), 1)
    told = [[name, *(f"{100 * share:.0f}" for share in row)] for name, row in zip(MODALITIES, confusion, strict=True)]
    seconds = _seconds(experiment)
    tables = [
        Table(
            ["told by", "the paper's split", "by recording", "by person"],
            rows,
            "Three splits",
            f"Right of windows of 0.5 s held out. {PEOPLE} people, {len(experiment.heard.right)} windows; two people "
            f"are held out at a time. The paper's: {PAPER} % of its own recordings. Batches at most: {BATCHES} by the "
            f"paper's schedule, {OWN_BATCHES} by our own, {SHUFFLED_BATCHES} of shuffled labels.",
        ),
        Table(["modality", *MODALITIES], told, "Told as", f"Per cent, by {best}, two people held out at a time."),
        Table(
            ["told by", *(f"+{louder:g} dB" for louder in LOUDER)],
            noise,
            "More noise",
            "By person; learnt from without more noise.",
        ),
        Table(["told by", *map(str, FEWER)], fewer, "Fewer microphones", "By person."),
        Table(["what", "a window"], [[name, duration(own)] for name, own in seconds.items()], "Times"),
    ]
    return Result(tables, [] if options.quick else _asked(splits, nothing, best, seconds))


def _right(counts: np.ndarray) -> float:
    return float(counts.trace() / counts.sum())


def _percent(counts: np.ndarray) -> str:
    return f"{100 * _right(counts):.1f} %"


def _noisy(images: SoundImages, rng: np.random.Generator) -> SoundImages:
    """A copy with normal noise on its decibels."""
    parts = [
        power * 10 ** (_COPIED / 10 * rng.standard_normal(power.shape, np.float32))
        for power in (images.intensity, images.spectrum)
    ]
    return SoundImages(images.times, *parts, images.strongest, images.known)


def _seconds(experiment: Experiment) -> dict[str, float]:
    """Of one window of 25 microphones: its image, and what each method then needs."""
    heard = experiment.heard
    sound = Recording(np.random.default_rng(0).standard_normal((25, 4928)), 10_000.0)
    images = heard.images[0.0, 25]
    found = {"its image": timed(lambda: sound_images(sound), 20).median}
    every_other = np.arange(len(images)) % 2 == 0
    small = Experiment(heard, None, quick=True)
    for method in METHODS[1:]:
        model = small.learnt(method, method, images[every_other], heard.right[every_other], heard.clip[every_other])
        found[method] = timed(lambda model=model: model.log_odds(images[:1]), 20).median
    return found


def _asked(splits: dict, nothing: tuple[float, float], best: str, seconds: dict[str, float]) -> list[Asked]:
    paper, recording, person = splits["paper-network"]
    slowest = seconds["its image"] + max(own for name, own in seconds.items() if name != "its image")
    return [
        Asked(
            "right of people who were not learnt from, by the best method", f"{100 * splits[best][2]:.1f} % ({best})"
        ),
        judged(
            f"the paper's split is leaky: its figure ({PAPER} % in the paper) is above that by person",
            f"paper-network: {100 * paper:.1f} %, by recording {100 * recording:.1f} %, by person {100 * person:.1f} %",
            paper > person,
        ),
        judged(
            "an untrained network and one that learnt shuffled labels know nothing (20 %)",
            f"{100 * nothing[0]:.1f} % and {100 * nothing[1]:.1f} %",
            max(nothing) < 0.35,
        ),
        judged("a window in less than 10 ms", duration(slowest), slowest < 0.01),
    ]


CASE = Case("modality", "touch told by its sound, by a network and others, beside the paper's", run, 25, timed=False)
