"""Kohonen's self-organising map of a skin's frames: the published experiments, compared with one-step images of the
same frames.

Pugach et al. 2015 trained a map on 208 voltages of a disk of 200 mm under a weight of 100 g. Their skin is simulated
(`benchmarks/problems/weighed_skins.py`). Positions, ratios and the order of time constants are comparable with the
paper, seconds are not. No frame for evaluation is in the training data.
"""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
from scipy.optimize import linear_sum_assignment

from benchmarks.harness.case import Case, Options, Result, Table, judged
from benchmarks.harness.timing import say
from benchmarks.problems.weighed_skins import CURRENT, DISC, GRAVITY, WeighedSkin
from jeit.image import find_inclusions
from jeit.inverse import Laplace, one_step
from jeit.touch import PlacedMap, SelfOrganisingMap
from jeit.touch.kohonen import (
    MapSchedule,
    drawn_map,
    learning_curves,
    map_quality,
    neuron_shares,
    time_constant,
    touches_reported,
)
from jeit.touch.simulate import BarIndenter, DiscIndenter, Press, PrismIndenter, RingIndenter

LEARNT, JUDGED, TRIALS = 10_000, 1000, 200
RATES, THEIR_SECONDS = (0.01, 0.005, 0.001), (4.2, 7.7, 19.6)
SHAPES = ((13, 16), (32, 32), (64, 64))
# Numbers of frames in the ordering and tuning phases, for one round of ten thousand frames (durations are not
# published), and the published initial and final values of the learning rate ε and the radius ρ.
PUBLISHED = MapSchedule(2000, 8000, (0.01, 0.001), (16.0, 1.0))
GRAMS, WEIGHTS = (2.3, 6.3, 20.3, 52.3, 102.3), (100.0, 50.0, 20.0)
APART, NEAR = 0.06, 0.02  # m: between weights, and of a touch from its weight
ASKED = {1: 0.9, 2: 0.8, 3: 0.6}
OBJECTS = {
    "prism": PrismIndenter(0.06, 0.04, 0.02),
    "cube": BarIndenter(0.03, 0.03),
    "ruler": BarIndenter(0.09, 0.02),
    "tube": RingIndenter(0.06, 0.05),
}
MIDDLE, MARKED = np.array([0.0, 0.02]), "#d1495b"  # sides of the objects, m, and their true values, in figures


def _rectangle(length: float, width: float) -> np.ndarray:
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * [length / 2, width / 2]


def _circle(diameter: float) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, 60)
    return diameter / 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)


# Outlines of the contact areas of the four objects.
OUTLINES = {
    "prism": [_rectangle(0.06, 0.0)],
    "cube": [_rectangle(0.03, 0.03)],
    "ruler": [_rectangle(0.09, 0.02)],
    "tube": [_circle(0.06), _circle(0.05)],
}


def run(options: Options) -> Result:
    """Run all experiments, and draw figures if an output folder is given."""
    quick = options.quick
    learnt, judged_by, trials, nodes = (300, 60, 12, 800) if quick else (LEARNT, JUDGED, TRIALS, 4000)
    disk, square = WeighedSkin("disk", nodes), WeighedSkin("square", nodes)
    frames, places = disk.presses(10, learnt)
    fresh, right = disk.presses(20, judged_by)
    rest = disk.skin.rest()
    schedule = MapSchedule(1000, 1000) if quick else MapSchedule()
    say("learning curves")
    curves = learning_curves(frames, jax.random.key(0), RATES, steps=1000 if quick else 10_000)
    tables, asked = [], []
    constants = [time_constant(one) for one in curves]
    over = float((curves / curves[:, -1:]).max() - 1)
    rows = [
        [
            f"{rate:g}",
            f"{theirs:g} s",
            f"{steps:,.0f} frames",
            f"{theirs / THEIR_SECONDS[0]:.1f}",
            f"{steps / constants[0]:.1f}",
        ]
        for rate, theirs, steps in zip(RATES, THEIR_SECONDS, constants, strict=True)
    ]
    header = ["ε", "time constant, the paper", "here", "over the first, the paper", "here"]
    tables.append(Table(header, rows, "Learning curves", "The mean weight from a small start; the radius stays 16."))
    asked.append(
        judged(
            "slower for smaller ε, no overshoot",
            f"overshoot {100 * over:.2g} %",
            constants == sorted(constants) and over < 0.01,
        )
    )
    say("places")
    maps, place_rows = {}, []
    for shape in SHAPES[:2] if quick else SHAPES:
        own = SelfOrganisingMap.fit(frames, jax.random.key(1), shape=shape, schedule=schedule)
        maps[shape] = PlacedMap.learn(own, frames, places)
        place_rows.append(_row(f"map, {shape[0]} × {shape[1]}", maps[shape].locate(fresh)[0], right))
    published = SelfOrganisingMap.fit(frames, jax.random.key(1), schedule=MapSchedule(300, 300) if quick else PUBLISHED)
    winners = PlacedMap.learn(published, frames, places).locate(fresh)[0]
    place_rows.append(_row("map, 32 × 32, published ε, 10,000 frames once", winners, right))
    images = _imaged(disk, fresh, rest, quick)
    place_rows.append(_row("one-step image, Laplace", images, right))
    header = [
        "by",
        "median",
        "mean",
        "95 %",
        "most",
        "most, of 200 mm",
        "median within 40 mm of the centre",
        "beyond 80 mm",
    ]
    tables.append(
        Table(
            header,
            place_rows,
            "Places of 100 g, errors in millimetres",
            "The paper: at most 1.5 % (3 mm) and “about 7 mm” in the same text, both methods.",
        )
    )
    placed = maps[32, 32]
    estimated, _ = placed.locate(fresh)
    worst = float(np.linalg.norm(estimated - right, axis=1).max())
    asked.append(judged("error ≤ 1.5 % of the diameter everywhere", f"{100 * worst / 0.2:.1f} %", worst <= 3e-3))
    say("sensitivity")
    along, ohms = _sensitivity(disk, rest)
    inner, outer = float(ohms[-1, [0, 8]].mean() / ohms[-1, 4]), float(ohms[-1, 9] / ohms[-1, 4])
    tables.append(_ohms(along, ohms))
    asked.append(
        judged(
            "102.3 g at the boundary about 7 × as at the centre",
            f"{inner:.1f} × at 80 mm, {outer:.1f} × at 90 mm",
            5 <= outer <= 9,
        )
    )
    say("several weights")
    table, shares = _several(disk, placed, rest, trials)
    tables.append(table)
    for number, share in shares.items():
        asked.append(
            judged(
                f"{number} of 100, 50, 20 g detected in ≥ {100 * ASKED[number]:.0f} %",
                f"{100 * share:.0f} %",
                share >= ASKED[number],
            )
        )
    say("topology")
    table, drawings, trust = _topology(disk, square, placed, frames, learnt, schedule)
    tables.append(table)
    asked.append(judged("trustworthiness ≥ 0.95 on disk and square", f"{min(trust):.3f}", min(trust) >= 0.95))
    pressed = {
        name: disk.skin.frames(jax.random.key(40), [Press(one, 3.0, tuple(MIDDLE))])[0] for name, one in OBJECTS.items()
    }
    tables.append(_shapes(placed, pressed, rest))
    if options.output is not None:
        _draw(
            options.output,
            curves,
            (placed, images, fresh, right),
            drawings,
            (disk, placed, rest),
            pressed,
            (along, ohms),
        )
    return Result(tables, [] if quick else asked)


def _row(name: str, estimated: np.ndarray, right: np.ndarray) -> list[str]:
    off, radius = 1e3 * np.linalg.norm(estimated - right, axis=1), np.linalg.norm(right, axis=1)
    figures = [np.median(off), off.mean(), np.quantile(off, 0.95), off.max()]
    middle, edge = np.median(off[radius < 0.04]), np.median(off[radius > 0.08])
    row = [name, *(f"{one:.2f}" for one in figures), f"{100 * off.max() / 200:.1f} %", f"{middle:.2f}", f"{edge:.2f}"]
    say(" | ".join(row))
    return row


def _imaged(disk: WeighedSkin, fresh: np.ndarray, rest: np.ndarray, quick: bool) -> np.ndarray:
    """Positions (frames, 2) of the strongest inclusion in one-step images on about 1,024 cells."""
    model = disk.model(300 if quick else 560)
    noise = disk.skin.material.noise * float(np.sqrt(np.mean(rest**2)))
    linear = one_step(model, float(disk.skin.conductivity[0]), prior=Laplace(), noise=noise)
    found = [find_inclusions(model.mesh, one) for one in np.asarray(linear.image(fresh - rest))]
    return np.array([one[0].centroid if one else (np.nan, np.nan) for one in found])


def _sensitivity(disk: WeighedSkin, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (10,) along a diameter in metres, and mean changes (5, 10) of transfer resistance under five weights at
    these positions."""
    along = np.array([*np.linspace(-0.08, 0.08, 9), 0.09])
    touches = [[Press(DiscIndenter(DISC), grams * GRAVITY, (x, 0.0)) for x in along] for grams in GRAMS]
    read = [disk.skin.voltages_under(disk.skin.touched(some)) * disk.skin.gain for some in touches]
    return along, np.array([np.abs(one - rest).mean(axis=1) for one in read]) / CURRENT


def _ohms(along: np.ndarray, ohms: np.ndarray) -> Table:
    rows = [[f"{grams:g} g", *(f"{one:.3g}" for one in row)] for grams, row in zip(GRAMS, ohms, strict=True)]
    return Table(
        ["weight", *(f"{1e3 * x:.0f} mm" for x in along)],
        rows,
        "Mean change of 208 transfer resistances, Ω",
        "The paper: at its boundary, 102.3 g change resistance about seven times as much as at the centre.",
    )


def _several(disk: WeighedSkin, placed: PlacedMap, rest: np.ndarray, trials: int) -> tuple[Table, dict[int, float]]:
    rows, shares = [], {}
    for number in (0, 1, 2, 3):
        if number:
            frames, places = disk.several(100 + number, trials, WEIGHTS[:number], APART)
        else:
            frames, places = disk.skin.frames(jax.random.key(50), [()] * trials), np.zeros((trials, 0, 2))
        counts, off, strengths = np.zeros(5, int), [], []
        for frame, where in zip(frames, places, strict=True):
            found = touches_reported(placed, frame, rest)
            counts[min(len(found), 4)] += 1
            if number and len(found) == number:
                distance = np.linalg.norm(where[:, None] - np.array([one.place for one in found]), axis=-1)
                own = linear_sum_assignment(distance)
                off.append(distance[own])
                strengths.append([found[one].strength for one in own[1]])
        near = [bool((one < NEAR).all()) for one in off]
        right = counts[0] / trials if not number else sum(near) / trials
        estimated = (
            " : ".join(f"{one / np.median(strengths, axis=0)[0]:.2f}" for one in np.median(strengths, axis=0))
            if strengths
            else ""
        )
        rows.append(
            [
                str(number),
                *(str(one) for one in counts),
                f"{100 * right:.0f} %",
                f"{1e3 * np.median(np.concatenate(off)):.1f}" if off else "",
                estimated,
            ]
        )
        say(" | ".join(rows[-1]))
        if number:
            shares[number] = right
    header = [
        "weights",
        *(f"detected {one}" for one in ("none", "1", "2", "3", "more")),
        "right, within 20 mm",
        "error, mm",
        "strengths",
    ]
    return Table(
        header,
        rows,
        "100, 50 and 20 g, 60 mm apart at least",
        "The paper shows one picture of each, and activities of 0.8, 0.6 and 0.48 for 100, 50 and 20 g.",
    ), shares


def _topology(disk, square, placed, frames, learnt: int, schedule):
    """A table of the quality of the maps of both skins, the arrays for the figures, and the trustworthiness."""
    other, there = square.presses(30, learnt)
    again = PlacedMap.learn(SelfOrganisingMap.fit(other, jax.random.key(1), schedule=schedule), other, there)
    rows, trust, drawings = [], [], {}
    for name, own, seen in (("disk", placed, frames), ("square", again, other)):
        quality = map_quality(own.learnt, seen)
        trust.append(quality.trustworthiness)
        rows.append(
            [
                name,
                f"{1e3 * quality.quantisation_error:.3g} mV",
                f"{100 * quality.topographic_error:.1f} %",
                f"{quality.trustworthiness:.4f}",
            ]
        )
        say(" | ".join(rows[-1]))
        drawings[name] = own
    header = ["skin", "quantisation error", "topographic error", "trustworthiness"]
    return Table(header, rows, "Order of the maps, 32 × 32"), drawings, trust


def _shapes(placed: PlacedMap, pressed: dict[str, np.ndarray], rest: np.ndarray) -> Table:
    """A table of the length and width of the part of the map that each of four objects of equal load activates (root
    mean square distances times √12)."""
    rows = []
    for name, frame in pressed.items():
        shares = neuron_shares(placed, frame, rest)
        there = shares > 0
        weight, place = shares[there], placed.places[there]
        middle = weight @ place / weight.sum()
        spread = np.linalg.eigvalsh((place - middle).T * weight @ (place - middle) / weight.sum())
        sides = 1e3 * np.sqrt(12 * np.maximum(spread, 0))
        rows.append([name, f"{sides[1]:.0f} × {sides[0]:.0f} mm", f"{1e3 * np.hypot(*(middle - MIDDLE)):.1f} mm"])
        say(" | ".join(rows[-1]))
    return Table(
        ["object", "estimated extent", "off"],
        rows,
        "Four shapes under 3 N",
        "Prism: a ridge of 60 mm; cube: 30 mm; ruler: 90 × 20 mm; tube: 60 mm outside, 50 mm inside.",
    )


def _draw(folder: Path, curves, located, drawings, multi, pressed, sensed) -> None:
    """Draw one figure of all results that the paper shows."""
    import matplotlib.pyplot as plt

    from jeit.touch.plots import plot_map

    folder.mkdir(parents=True, exist_ok=True)
    placed, images, fresh, right = located
    figure, axes = plt.subplots(4, 4, figsize=(17, 16), layout="constrained")
    for rate, curve in zip(RATES, curves, strict=True):
        axes[0, 0].plot(np.abs(curve), label=f"ε = {rate:g}")
    axes[0, 0].set(xlabel="Frames shown", ylabel="Mean weight (V)", title="Learning curves")
    axes[0, 0].legend(frameon=False)
    off = {"map": placed.locate(fresh)[0] - right, "one-step image": images - right}
    top = 5.0
    for ax, (name, one) in zip(axes[0, 1:3], off.items(), strict=True):
        drawn = ax.scatter(*(1e3 * right.T), c=1e3 * np.linalg.norm(one, axis=1), s=9, vmin=0, vmax=top, cmap="viridis")
        ax.set(title=f"Places of 100 g, {name}", xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
        ax.set(xticks=range(-100, 101, 50), yticks=range(-100, 101, 50))
        figure.colorbar(drawn, ax=ax, label="Error (mm)", shrink=0.7)
    bins = np.linspace(0, 8, 41)
    for name, one in off.items():
        axes[0, 3].hist(1e3 * np.linalg.norm(one, axis=1), bins, density=True, histtype="step", label=name)
    axes[0, 3].set(xlabel="Error (mm)", ylabel="Density (1/mm)", title="Errors of places of 100 g")
    axes[0, 3].legend(frameon=False)
    disk, _, rest = multi
    where = np.array([[-0.05, 0.03], [0.05, 0.04], [0.0, -0.06]])
    for number, ax in zip((1, 2, 3), axes[1], strict=False):
        touch = tuple(
            Press(DiscIndenter(DISC), one * GRAVITY, place) for one, place in zip(WEIGHTS[:number], where, strict=False)
        )
        frame = disk.skin.frames(jax.random.key(60), [touch])[0]
        activity = placed.learnt.activity(frame)[0]
        title = " + ".join(f"{one:g} g" for one in WEIGHTS[:number])
        plot_map(placed.places, activity, touches=touches_reported(placed, frame, rest), title=title, ax=ax)
        ax.plot(*where[:number].T, "o", markersize=17, markerfacecolor="none", color=MARKED)
    for ax, (name, frame) in zip(axes[2], pressed.items(), strict=True):
        plot_map(placed.places, neuron_shares(placed, frame, rest), label="Share", title=f"{name}, 3 N", ax=ax)
        for line in OUTLINES[name]:
            ax.plot(*(line + MIDDLE).T, color=MARKED, linewidth=1.5, zorder=3)
    axes[1, 3].plot(1e3 * sensed[0], sensed[1].T, marker=".")
    axes[1, 3].set(yscale="log", xlabel="Place on a diameter (mm)", ylabel="Mean change (Ω)", title="Sensitivity")
    axes[1, 3].legend([f"{one:g} g" for one in GRAMS], frameon=False, ncols=2, loc="upper center")
    axes[1, 3].set_ylim(top=60)
    for column, (name, own) in enumerate(drawings.items()):
        plot_map(own.places, title=f"{name}: neurons at their places", ax=axes[3, 2 * column])
        drawn = drawn_map(own.learnt, jax.random.key(0))
        plot_map(drawn, title=f"{name}: by a spring layout", on_skin=False, ax=axes[3, 2 * column + 1])
    figure.savefig(folder / "kohonen.png", dpi=72)
    plt.close(figure)


CASE = Case(
    "kohonen",
    "self-organising maps of a skin's frames, beside the paper's",
    run,
    6,
    page=("docs/explanation/map-experiments.md", "kohonen"),
    pictures=True,
    timed=False,
)
