"""Localising touches by sound: jeit beside plain NumPy and SciPy.

25 microphones, 200 × 200 pixels, frames with the noise of the simulated skin. jeit and SciPy minimise the paper's loss,
so their maps and positions must agree. Without a map, SciPy starts from the loudest microphone. Two further tasks are
jeit's only: the likelihood, and the processing of a recording of 25 channels at 40 kHz to a track.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness.case import Asked, Case, Headline, Options, Result, Table, judged
from benchmarks.harness.tables import duration, times
from benchmarks.harness.timing import Timed, say, timed
from benchmarks.opponents.scipy_localiser import PlainLocaliser
from jeit.acoustic import Localiser, MicrophoneArray, Recording, Taps, calibrate_microphones, locate, track
from jeit.acoustic.decay import InverseSquare
from jeit.acoustic.microphones import IntensityNoise
from jeit.acoustic.simulate import SoundingSkin, microphone_grid, simulate_calibration_taps, simulate_stroke
from jeit.acoustic.simulate.propagation import expected_power, noise_power
from jeit.acoustic.simulate.sounding_skin import Readout
from jeit.acoustic.surface import make_surface
from jeit.mesh import Rectangle

HEADER = ["task", "jeit, a frame", "frames a second", "NumPy and SciPy", "times jeit's", "compile", "agreement"]
MAPS, PLACES, ALL = "maps, the paper's loss", "map and refined place", "all maps kept, and places"
LIKELY = "place without a map, likelihood"
FASTER, WITH_MAPS, WITHOUT_MAPS, RECORDING = 20.0, 500.0, 20_000.0, 0.2
# Maximum differences of maps, relative to the largest value, and of positions, in metres.
SAME_MAP, SAME_PLACE = 1e-10, 1e-6


def frames(number: int):
    """A microphone array, and intensities (touches, microphones) of `number` touches with the noise of the array's
    decay models, noise floor and degrees of freedom ν."""

    skin = SoundingSkin(jax.random.key(0))
    microphones = np.asarray(skin.microphones)
    random = np.random.default_rng(0)
    places = random.uniform(-0.09, 0.09, (number, 2))
    freedom, floor = 50.0, noise_power(skin)
    received = expected_power(skin, places) * np.exp(0.3 * random.standard_normal((number, 1))) * 3.0
    spread = np.sqrt(4 * received * floor / freedom + 2 * floor**2 / freedom)
    power = received + spread * random.standard_normal(received.shape)
    # Parameters of the decay models that approximately fit the noise-free skin best.
    squared = np.sum((microphone_grid(13)[:, None] - microphones) ** 2, axis=-1)
    response = expected_power(skin, microphone_grid(13))
    b = np.full(len(microphones), 1.3e-4)
    a = np.exp(np.mean(np.log(response * (squared + b)), axis=0))
    noise = IntensityNoise.create(len(microphones), floor=floor, freedom=freedom, relative=0.2)
    decay = InverseSquare(jnp.asarray(a), jnp.asarray(b))
    return MicrophoneArray(jnp.asarray(microphones), make_surface(Rectangle(0.2, 0.2)), decay, noise), power


def run(options: Options) -> Result:
    """Run every task, then the recording, and check the required figures."""
    number, rounds = (8, 2) if options.quick else (32, options.rounds or 15)
    duel = Duel(number, 512 if options.quick else 4096)
    rows, spent, theirs = [], {}, {}
    for name, (mine, other, count) in duel.tasks().items():
        found = timed(mine, rounds)
        spent[name] = found.median / count
        row = [name, duration(spent[name]), f"{1 / spent[name]:,.0f}", "", "", duration(found.compile)]
        if other is not None:
            theirs[name] = timed(lambda other=other: [other(frame) for frame in duel.few], 3).median / len(duel.few)
            row[3:5] = [duration(theirs[name]), times(theirs[name] / spent[name])]
        rows.append([*row, ""])
        say(" | ".join(rows[-1]))
    # Agreement is computed last, so that no function is compiled before it is timed.
    map_error, place_error = duel.agreement()
    same = {MAPS: f"{map_error:.0e}", PLACES: f"{1e6 * place_error:.2g} µm"}
    for row in rows:
        row[-1] = same.get(row[0], "")
    asked = _asked(spent, theirs)
    if not options.quick:
        track_times, samples = recording(rounds)
        job = f"recording of 1 s, 25 × {samples:,} samples, to a track"
        rows.append([job, duration(track_times.median), "", "", "", duration(track_times.compile), ""])
        asked.append(
            judged("a recording of 1 s: < 0.2 s", duration(track_times.median), track_times.median < RECORDING)
        )
    wrong = [] if map_error < SAME_MAP and place_error < SAME_PLACE else ["jeit and SciPy disagree"]
    ratio = times(theirs[PLACES] / spent[PLACES])
    job = "a touch located by sound, map of 200 × 200 and refinement", duration(spent[PLACES])
    other = f"SciPy: {duration(theirs[PLACES])}"
    headline = Headline(*job, other, ratio, f"same place to {same[PLACES]}")
    return Result([Table(HEADER, rows)], asked, headline=headline, wrong=wrong)


class Duel:
    """Frames, jeit's localisers with and without maps, and SciPy's localiser."""

    def __init__(self, number: int, without_map: int):
        self.array, self.power = frames(without_map)
        self.few, self.many = self.power[:number], self.power[: 8 * number]
        decay, microphones = self.array.decay, np.asarray(self.array.microphones)
        self.plain = PlainLocaliser(microphones, np.asarray(decay.a), np.asarray(decay.b), 0.1, 200)
        self.mapped = Localiser.create(self.array, method="consistency", map_shape=(200, 200))

    def agreement(self) -> tuple[float, float]:
        """Largest relative difference between jeit's and SciPy's maps, and median distance in metres between their
        positions inside the skin."""
        maps, estimate = np.asarray(self.mapped.maps(self.few)), self.mapped(self.few)
        theirs = np.stack([self.plain.locate(frame) for frame in self.few])
        inside = np.abs(theirs).max(axis=1) < 0.1 - 1e-9
        worst = max(np.abs(maps[k] / self.plain.map(self.few[k]) - 1).max() for k in range(0, len(self.few), 7))
        apart = np.linalg.norm(np.asarray(estimate.position) - theirs, axis=1)[inside]
        return float(worst), float(np.median(apart))

    def tasks(self):
        """For each task by name: jeit's function, SciPy's function for one frame (or None), and the number of frames
        that jeit's function processes."""
        mapped, plain, few, many, power = self.mapped, self.plain, self.few, self.many, self.power
        coarse, likelihood = Localiser.create(self.array, method="consistency"), Localiser.create(self.array)
        likely_maps = Localiser.create(self.array, map_shape=(200, 200))
        return {
            MAPS: (lambda: mapped.maps(few), plain.map, len(few)),
            f"the same, {len(many)} frames at once": (lambda: mapped.maps(many), plain.map, len(many)),
            PLACES: (lambda: mapped(few), plain.locate, len(few)),
            ALL: (lambda: mapped.with_maps(few), plain.locate, len(few)),
            "place without a map, the paper's loss": (lambda: coarse(power), plain.locate_near, len(power)),
            "maps, likelihood": (lambda: likely_maps.maps(few), None, len(few)),
            LIKELY: (lambda: likelihood(power), None, len(power)),
            "one frame alone, likelihood": (lambda: likelihood(power[:1]), None, 1),
        }


def recording(rounds: int) -> tuple[Timed, int]:
    """Time of processing samples at 40 kHz to a smoothed track, and number of samples of a channel."""

    skin = SoundingSkin(jax.random.key(0), readout=Readout(multiplexed=False))
    taps = simulate_calibration_taps(skin, jax.random.key(1), microphone_grid(9), repeats=1)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.1
    array = np.asarray(skin.microphones)
    calibration = calibrate_microphones(
        Taps(array, corners, taps.positions, samples=taps.samples, rate=taps.rate)
    ).calibration
    sound = simulate_stroke(skin, jax.random.key(2), np.array([[-0.07, -0.06], [0.07, 0.05]]), strength=2.0)
    track_times = Recording(sound.samples, sound.rate)
    return timed(lambda: track(locate(track_times, calibration, compiled=True)), rounds), sound.samples.shape[1]


def _asked(spent: dict[str, float], theirs: dict[str, float]) -> list[Asked]:
    """Checks of the required figures, from jeit's seconds per frame (`spent`) and SciPy's (`theirs`)."""

    def at_least(asked: str, measured: float, least: float, unit: str) -> Asked:
        return judged(asked, f"{measured:,.0f}{unit}", measured >= least)

    return [
        at_least("maps: ≥ 20× NumPy", theirs[MAPS] / spent[MAPS], FASTER, "×"),
        at_least("map and refinement: ≥ 20× SciPy", theirs[PLACES] / spent[PLACES], FASTER, "×"),
        at_least("with maps: ≥ 500 frames a second", 1 / spent[ALL], WITH_MAPS, " /s"),
        at_least("without, likelihood: ≥ 20,000 frames a second", 1 / spent[LIKELY], WITHOUT_MAPS, " /s"),
    ]


CASE = Case("hearing", "touches located by sound: jeit beside NumPy and SciPy on one loss", run, 1.5)
