"""Contacts found in images of pressed skins: the published experiments, and a comparison of contact finders.

Chen et al. 2022 pressed a disk of 100 mm with weights, and detected contacts in back-projected images. Their skin is
simulated (`benchmarks/problems/contact_frames.py`). Distances in millimetres, profiles and ratios are comparable with
the published figures, pixel values are not.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from benchmarks.harness.case import Case, Options, Result, Table, judged
from benchmarks.harness.timing import say
from benchmarks.problems.contact_frames import RADIUS, SINGLE, ContactFrames, weight
from jeit.mesh import measures
from jeit.touch.contacts import CellFinder, RasterFinder, find_contacts
from jeit.touch.simulate import DiscIndenter, Press

METHODS = ("one-step", "back-projection")
# Maximum distance in metres at which a detected contact matches a true contact.
CUT = 0.015
AREAS, RATIOS = (415.5, 615.8, 1134.1), (1.0, 1.35, 2.68)
GRAMS = (100, 200, 400, 700, 1000, 1500, 2000, 2500, 3000, 3500, 3900)
PLAIN = {"constant": 10.0, "opening": 5, "smoothing": 0.0}


class Images:
    """Images of the frames of a skin by one method, and the contacts found in the images."""

    def __init__(self, frames: ContactFrames, method: str):
        self.frames, self.reconstruction = frames, frames.reconstruction(method)
        self.noise = frames.image_noise(self.reconstruction)

    def found(self, finder, read: np.ndarray) -> list:
        """Contacts that `finder` finds in the image of every frame of `read` (frames, channels)."""
        return [find_contacts(finder, one, self.noise) for one in self.frames.images(self.reconstruction, read)]


def run(options: Options) -> Result:
    """Repeat the published experiments, then compare contact finders on touches that were not used to choose
    defaults."""
    nodes = (1500, 600) if options.quick else (4000, 1000)
    quick = options.quick
    frames, single = ContactFrames(nodes=nodes), ContactFrames(nodes=nodes, saturation=SINGLE)
    images = {method: Images(frames, method) for method in METHODS}
    finder = CellFinder(frames.models[1].mesh)
    rows, asked = [], []
    for what, experiment in EXPERIMENTS.items():
        theirs, figures, met = experiment(frames, images, finder, quick)
        rows.append([what, theirs, *figures])
        say(" | ".join(rows[-1]))
        asked.append(judged(f"{what}: {theirs}", f"one-step: {figures[0]}", met))
    rows.append(_layers(frames, single, finder))
    say(" | ".join(rows[-1]))
    experiments = Table(["experiment", "the paper", *METHODS], rows, "The published experiments, contacts on the mesh")
    return Result([experiments, _finders(nodes, quick)], asked)


def _profile(frames, images, finder, quick):
    radii = np.arange(0, 0.0401, 0.02 if quick else 0.005)
    angles = np.radians([0, 45, 90])
    places = np.array([[r * np.cos(a), r * np.sin(a)] for r in radii for a in angles])
    read = frames.frames(100, [weight(100, place) for place in places])
    figures, met = [], False
    for method in METHODS:
        off = np.array(
            [_nearest(one, place) for one, place in zip(images[method].found(finder, read), places, strict=True)]
        )
        along = 1e3 * off.reshape(len(radii), 3).mean(axis=1)
        inner, outer = along[: len(along) // 2].mean(), along[len(along) // 2 :].mean()
        text = " ".join(f"{value:.1f}" for value in along)
        figures.append(f"most {1e3 * off.max():.1f} mm; from the centre outwards {text}")
        met = met or bool(off.max() <= 0.011 and inner < outer)
    return "error ≤ 11 mm, least at the centre", figures, met


def _load_curve(frames, images, finder, quick):
    read = frames.frames(200, [weight(grams, (0.0, 0.0), 0.016) for grams in GRAMS])
    figures, verdicts = [], []
    for method in METHODS:
        peaks = np.array([one[0].peak if one else 0.0 for one in images[method].found(finder, read)])
        slope = np.diff(peaks) / np.diff(GRAMS)
        rising, falling = bool((slope > 0).all()), bool(slope[-3:].mean() < 0.7 * slope[:3].mean())
        verdicts.append(rising and falling)
        text = " ".join(f"{value:.1f}" for value in peaks / peaks[0])
        figures.append(f"{text}; last slope over first {slope[-3:].mean() / slope[:3].mean():.2f}")
    return "100 to 3,900 g: rising, the slope falling", figures, verdicts[0]


def _round(frames, images, finder, quick):
    angle = np.arange(16) * np.pi / 8
    read = frames.frames(300, [weight(100, 0.03 * np.array([np.cos(a), np.sin(a)])) for a in angle])
    figures, met = [], []
    for method in METHODS:
        peaks = np.array([one[0].peak if one else 0.0 for one in images[method].found(finder, read)])
        worst = np.abs(peaks / peaks.mean() - 1).max()
        figures.append(f"within {100 * worst:.1f} % of their mean")
        met.append(bool(worst <= 0.1))
    return "16 points at 30 mm equal within 10 %", figures, met[0]


def _areas(frames, images, finder, quick):
    presses = [weight(800, (0.0, 0.0), np.sqrt(1e-6 * area / np.pi)) for area in AREAS]
    read = frames.frames(400, presses)
    cells = np.asarray(measures(frames.models[1].mesh))
    figures, met = [], []
    for method in METHODS:
        peaks = np.array([one[0].peak if one else 0.0 for one in images[method].found(finder, read)])
        whole = frames.images(images[method].reconstruction, read) @ cells
        figures.append(f"{_ratios(peaks)}; whole images {_ratios(whole)}")
        met.append(bool((np.abs(peaks / peaks[0] / RATIOS - 1) < 0.2).all()))
    return "800 g on 415.5, 615.8, 1,134.1 mm²: peaks 1 : 1.35 : 2.68", figures, met[0]


def _ratios(values: np.ndarray) -> str:
    return " : ".join(f"{value:.2f}" for value in values / values[0])


def _two(frames, images, finder, quick):
    turn = np.radians(120)
    pairs = [
        (weight(100, (0.02, 0.0), 0.008), weight(100, 0.035 * np.array([np.cos(turn), np.sin(turn)]), 0.008)),
        (weight(100, (-0.025, 0.0), 0.008), weight(200, (0.025, 0.0), 0.008)),
    ]
    read = frames.frames(500, pairs)
    figures, met = [], []
    for method in METHODS:
        found = images[method].found(finder, read)
        numbers = [len(one) for one in found]
        ratio = found[1][0].peak / found[1][-1].peak
        heavier = found[1][0].centroid[0] > 0
        figures.append(f"found {numbers[0]} and {numbers[1]}; peaks of 200 and 100 g 1 : {1 / ratio:.2f}")
        met.append(numbers == [2, 2] and bool(heavier))
    return "two weights are two contacts, the heavier the stronger", figures, met[0]


def _nothing(frames, images, finder, quick):
    read = frames.empty(6, 100 if quick else 1000)
    figures = [f"{sum(map(bool, images[method].found(finder, read)))} of {len(read):,}" for method in METHODS]
    return "no contact in empty frames", figures, figures[0].startswith("0 ")


EXPERIMENTS = {
    "place": _profile,
    "load": _load_curve,
    "sensitivity round a circle": _round,
    "area": _areas,
    "two objects": _two,
    "nothing": _nothing,
}


def _layers(frames, single, finder) -> list[str]:
    """The smallest detected change of conductivity, in standard deviations of a cell's noise: 0.5 N on two layers, 60 N
    on one layer."""
    radius = np.sqrt(226.98e-6 / np.pi)
    figures = []
    for method in METHODS:
        text = []
        for own, load in ((frames, 0.5), (single, 60.0)):
            mine = Images(own, method)
            read = own.frames(600, [Press(DiscIndenter(2 * radius), load, (0.0, 0.0))])
            found = mine.found(finder, read)[0]
            strongest = (own.images(mine.reconstruction, read)[0] / mine.noise.deviation).max()
            off = f"{1e3 * _nearest(found, np.zeros(2)):.1f} mm off" if found else "not found"
            text.append(f"{load:g} N: {strongest:.0f}σ, {off}")
        figures.append("; ".join(text))
    return [
        "two layers and one, 227 mm²",
        "two: 0.5 N is found; one: 60 N is misplaced",
        *figures,
    ]


def _finders(nodes, quick: bool) -> Table:
    """A table of the errors of each contact finder, for skins of two materials, three levels of noise, and one to three
    simultaneous discs and balls."""
    skins = [
        ContactFrames(name, noise, nodes=nodes, seed=7)
        for name in ("velostat", "conductive fabric")
        for noise in ((1.0,) if quick else (0.3, 1.0, 3.0))
    ]
    mesh = skins[0].models[1].mesh
    finders = {
        "on the mesh": CellFinder(mesh),
        "on a raster": RasterFinder(mesh),
        "on a raster, C = −10, opening 5, not smoothed": RasterFinder(mesh, **PLAIN),
    }
    rows = []
    touches = {id(skin): skin.touches(3, 8 if quick else 25) for skin in skins}
    reads = {id(skin): skin.frames(700, touches[id(skin)], at_once=8) for skin in skins}
    for method in METHODS:
        images = [Images(skin, method) for skin in skins]
        for name, finder in finders.items():
            apart, near, there, missed, false = [], [], 0, 0, 0
            for skin, one in zip(skins, images, strict=True):
                for touch, found in zip(touches[id(skin)], one.found(finder, reads[id(skin)]), strict=True):
                    distance, matched = compared([press.position for press in touch], [c.centroid for c in found])
                    apart.append(distance)
                    near.extend(matched)
                    there, missed = there + len(touch), missed + len(touch) - len(matched)
                    false += len(found) - len(matched)
            row = [method, name, *(f"{1e3 * value:.1f}" for value in (np.mean(apart), np.mean(near)))]
            row += [f"{1e3 * np.percentile(near, 95):.1f}", *(f"{100 * n / there:.0f} %" for n in (missed, false))]
            rows.append(row)
            say(" | ".join(row))
    header = ["images", "contacts", "OSPA distance, mm", "error, mm", "95th percentile, mm", "missed", "false"]
    caption = (
        "OSPA: mean distance of detected from true contacts, 15 mm for each missed or false one (Schuhmacher 2008)."
    )
    return Table(header, rows, "Touches that were not used to choose defaults", caption)


def compared(true: list, found: list) -> tuple[float, list[float]]:
    """OSPA distance (optimal subpattern assignment) between true and found contacts, in metres, and the distances of
    matched contacts."""
    if not found:
        return CUT, []
    distance = np.linalg.norm(np.array(true)[:, None] - np.array(found), axis=-1)
    rows, columns = linear_sum_assignment(np.minimum(distance, CUT))
    cut = np.minimum(distance[rows, columns], CUT)
    surplus = abs(len(true) - len(found))
    return float((cut.sum() + CUT * surplus) / max(len(true), len(found))), cut[cut < CUT].tolist()


def _nearest(found: list, place: np.ndarray) -> float:
    """Distance in metres of the strongest found contact from `place`; the diameter of the skin if no contact is
    found."""
    return float(np.linalg.norm(found[0].centroid - place)) if found else 2 * RADIUS


CASE = Case("contacts", "contacts found in images of pressed skins, beside the paper's", run, 3, timed=False)
