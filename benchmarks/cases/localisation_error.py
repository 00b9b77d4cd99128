"""Errors of touches located by sound, beside the Cramér-Rao bound.

The simulated skin of 200 × 200 mm differs from the fitted model: it has echoes from the edges, attenuation that grows
with frequency, different gains, and noise that is as loud as a source 55 mm away. The skin is calibrated on a 13 × 13
grid of taps 15 mm apart (three taps at each position) and tested on another grid, 12.5 mm apart. The tests are the
paper's experiment (ten bursts of a vibrator at each position); single taps at several signal-to-noise ratios, compared
with the Cramér-Rao bound; ten bursts with several numbers of microphones; and ten bursts with microphones that are
displaced from their given positions and gains that changed after the calibration.
"""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np

from benchmarks.harness.case import Asked, Case, Headline, Options, Result, Table, judged
from benchmarks.harness.timing import say
from jeit.acoustic import Intensities, Localiser, Taps, calibrate_microphones, cramer_rao, locate, tap_intensities
from jeit.acoustic.localisation.locate import microphones_in_use
from jeit.acoustic.simulate import SoundingSkin, microphone_grid, simulate_calibration_taps
from jeit.acoustic.simulate.propagation import expected_power, noise_power
from jeit.acoustic.simulate.sounding_skin import MicrophoneModel
from jeit.layout import grid

RATIOS = (0, 5, 10, 15, 20, 25, 30, 35, 40)
# Limits: mean and standard deviation of the errors with the paper's loss, metres, and the fraction by which the errors
# with the likelihood must be smaller.
PAPER, BETTER = (6.6e-3, 3.8e-3), 0.25
# Standard deviations of the coordinates of the microphones, metres, and of the gains, as fractions of the intensities.
CHANGES = ((0.0, 0.0), (1e-3, 0.05), (2e-3, 0.1), (3e-3, 0.2))
CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.1
METHODS = ("consistency", "likelihood")


def calibrated(skin, given=None, taps: int = 13):
    """The calibration of a skin from a grid of `taps` × `taps` taps. `given`: stated positions (microphones, 2) in
    metres, by default the true positions.
    """

    sound = simulate_calibration_taps(skin, jax.random.key(1), grid(0.18, 0.18, taps, taps))
    array = np.asarray(skin.microphones) if given is None else given
    tapped = Taps(array, CORNERS, sound.positions, samples=sound.samples, rate=sound.rate)
    return calibrate_microphones(tapped).calibration


def averaged_intensities(skin, places, bursts: int):
    """Intensities (positions, microphones) of sources at `places` (positions, 2), averaged over bursts; noise floor
    (microphones,); degrees of freedom ν; and mask (positions, microphones) of usable intensities."""

    sound = simulate_calibration_taps(skin, jax.random.key(2), places, repeats=bursts)
    taps = Taps(np.asarray(skin.microphones), CORNERS, sound.positions, samples=sound.samples, rate=sound.rate)
    found = tap_intensities(taps)
    power = found.power.reshape(len(places), bursts, -1).mean(axis=1)
    usable = found.usable.reshape(len(places), bursts, -1).all(axis=1)
    return power, found.floor, float(np.median(found.freedom)) * bursts, usable


def errors(calibration, skin, places, bursts: int):
    """Errors (positions,) in metres of the positions by each method, the fraction of the likelihood's 95 % ellipses
    that contain the true position, and the root mean square error by the Cramér-Rao bound.
    """

    power, floor, freedom, usable = averaged_intensities(skin, places, bursts)
    measured = Intensities(np.arange(len(places)), power, floor=floor, freedom=freedom, usable=usable)
    microphone_array, use, _ = microphones_in_use(measured, calibration)
    found = {name: Localiser.create(microphone_array, method=name)(measured.power, use) for name in METHODS}
    off = {name: np.asarray(one.position) - places for name, one in found.items()}
    best = found["likelihood"]
    covariance = np.asarray(best.covariance)
    square = np.einsum("fi,fij,fj->f", off["likelihood"], np.linalg.inv(covariance), off["likelihood"])
    bound = np.asarray(cramer_rao(microphone_array, places, np.asarray(best.strength)))
    least = np.sqrt(np.mean(np.trace(bound, axis1=1, axis2=2)))
    return (
        {name: np.linalg.norm(one, axis=1) for name, one in off.items()},
        float(np.mean(square < 5.991)),
        float(least),
    )


def spread(values) -> str:
    """Text of the mean ± standard deviation in millimetres."""
    return f"{1e3 * np.mean(values):.1f} ± {1e3 * np.std(values):.1f}"


def paper_table(skin, calibration, number: int, sides, bursts: int) -> tuple[Table, dict]:
    """A table of the paper's experiment, and of the same experiment nearer to the edge, and the errors of the first.

    `number`: number of places along a side; `sides`: sides of the touched squares in metres; `bursts`: number of taps
    at each place.
    """
    header = [f"{number} × {number} places, mm", "the paper's loss", "likelihood", "in the 95 % ellipse"]
    rows, first = [["paper, measured", "6.6 ± 3.8", "", ""]], None
    for name, side in zip(("simulated", "to 10 mm from the edge"), sides, strict=False):
        off, cover, _ = errors(calibration, skin, grid(side, side, number, number), bursts)
        rows.append([name, *(spread(off[method]) for method in METHODS), f"{100 * cover:.0f} %"])
        say(" | ".join(rows[-1]))
        first = first or off
    return Table(header, rows), first or {}


def ratio_table(skin, calibration, ratios, number: int) -> tuple[Table, dict[str, list[float]], list[float]]:
    """A table of single taps at several signal-to-noise ratios, root mean square errors by method, and Cramér-Rao
    bounds, in metres."""
    places = grid(0.15, 0.15, number, number)
    loudest = 10 * np.log10((expected_power(skin, places) / noise_power(skin)).max(axis=1).mean())
    curve: dict[str, list[float]] = {"paper's loss": [], "likelihood": []}
    rows, bounds = [], []
    for ratio in ratios:
        noisy = SoundingSkin(jax.random.key(0), microphone_model=MicrophoneModel(snr_db=ratio - loudest))
        off, cover, least = errors(calibration, noisy, places, 1)
        roots = [float(np.sqrt(np.mean(off[name] ** 2))) for name in METHODS]
        bounds.append(least)
        for name, root in zip(curve, roots, strict=True):
            curve[name].append(root)
        figures = [f"{1e3 * value:.2f}" for value in (*roots, least)]
        rows.append([f"{ratio}", *(spread(off[name]) for name in METHODS), *figures, f"{100 * cover:.0f} %"])
        say(" | ".join(rows[-1]))
    header = ["loudest microphone, dB", "paper's loss, mm", "likelihood, mm", "paper's loss, rms"]
    header += ["likelihood, rms", "Cramér-Rao bound, rms", "in the 95 % ellipse"]
    return Table(header, rows), curve, bounds


def microphone_table(sides, number: int) -> Table:
    """A table of the errors with ten bursts for several numbers of microphones; `sides` are the numbers of microphones
    along a side."""
    rows = []
    for side in sides:
        few = SoundingSkin(jax.random.key(0), microphone_grid(side))
        off, cover, _ = errors(calibrated(few), few, grid(0.15, 0.15, number, number), 10)
        rows.append([str(side**2), *(spread(off[name]) for name in METHODS), f"{100 * cover:.0f} %"])
        say(" | ".join(rows[-1]))
    return Table(["microphones", "paper's loss, mm", "likelihood, mm", "in the 95 % ellipse"], rows)


def change_table(changes, number: int, taps: int) -> Table:
    """A table of the errors with ten bursts at each position, located with the defaults, after changes of microphone
    positions and gains."""
    header = ["microphones off, mm", "gains changed, %", "median, mm", "greatest, mm", "in the 95 % ellipse"]
    given, places, rows = microphone_grid(5), grid(0.15, 0.15, number, number), []
    for place, gain in changes:
        rng = np.random.default_rng(0)
        skin = SoundingSkin(jax.random.key(0), given + place * rng.normal(size=given.shape))
        power, floor, freedom, usable = averaged_intensities(skin, places, 10)
        factor = np.exp(gain * rng.normal(size=len(given)))
        recorded = Intensities(
            np.arange(len(places)), power * factor, floor=floor * factor, freedom=freedom, usable=usable
        )
        found = locate(recorded, calibrated(skin, given, taps))
        off = found.position - places
        length = 1e3 * np.linalg.norm(off, axis=1)
        square = np.einsum("fi,fij,fj->f", off, np.linalg.inv(found.covariance), off)
        figures = [f"{np.median(length):.1f}", f"{length.max():.1f}", f"{100 * np.mean(square < 5.991):.0f} %"]
        two = f"{(found.status == 'two touches').sum()} of {len(places)}"
        rows.append([f"{1e3 * place:.0f}", f"{100 * gain:.0f}", *figures, two])
        say(" | ".join(rows[-1]))
    return Table([*header, "taken for two touches"], rows)


def draw(ratios, curve: dict[str, list[float]], bounds: list[float], path: Path) -> None:
    """Draw the errors of single taps against the signal-to-noise ratio."""
    from matplotlib.figure import Figure

    from jeit.acoustic.plots import plot_error_curve

    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    labels = {"quantity": "Signal-to-noise ratio of the loudest microphone (dB)", "statistic": "rms"}
    plot_error_curve(ratios, curve, bound=bounds, title="A single tap", ax=figure.subplots(), **labels)
    figure.savefig(path, dpi=110)


def run(options: Options) -> Result:
    """Compute the tables and, if an output folder is given, draw the curve."""
    quick, skin = options.quick, SoundingSkin(jax.random.key(0))
    number, ratios, sides, bursts = (4, (20,), (0.15,), 1) if quick else (13, RATIOS, (0.15, 0.18), 10)
    taps = 7 if quick else 13
    calibration = calibrated(skin, taps=taps)
    paper, off = paper_table(skin, calibration, number, sides, bursts)
    against, curve, bounds = ratio_table(skin, calibration, ratios, number)
    tables = [paper, against, change_table(CHANGES[2:3] if quick else CHANGES, number, taps)]
    if not quick:
        tables.insert(2, microphone_table((2, 3, 4, 5), number))
    if options.output is not None:
        draw(ratios, curve, bounds, options.output / "hearing-error.png")
    asked = _asked(off)
    mine = f"{spread(off['likelihood'])} mm"
    job = "distance of touches located by sound, 13 × 13 places (simulated skin)"
    published = f"paper, on its own skin: 6.6 ± 3.8 mm; its loss here: {spread(off['consistency'])} mm"
    better = off["consistency"].mean() / off["likelihood"].mean()
    headline = Headline(job, mine, published, f"{better:.1f}×", f"95 % ellipses hold {paper.rows[1][-1]}")
    return Result(tables, [asked], headline=headline)


def _asked(off: dict) -> Asked:
    loss, gain = off["consistency"], 1 - off["likelihood"].mean() / off["consistency"].mean()
    met = loss.mean() <= PAPER[0] and loss.std() <= PAPER[1] and gain >= BETTER
    measured = f"{spread(loss)} mm, {100 * gain:.0f} % better"
    return judged("paper's loss ≤ 6.6 ± 3.8 mm, likelihood 25 % better", measured, bool(met))


CASE = Case(
    "localisation_error",
    "errors of touches located by sound, beside the Cramér-Rao bound",
    run,
    3,
    pictures=True,
    timed=False,
)
