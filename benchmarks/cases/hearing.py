"""Localising touches by sound, jeit beside plain NumPy and SciPy in one run: `python -m benchmarks.cases.hearing`.

25 microphones, 200 × 200 pixels, frames with the noise of the simulated skin. Both minimise the paper's loss, so their
maps and places must be the same. Then what only jeit does: the likelihood, and a recording of 25 channels at 40 kHz
turned into a track.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import time

import numpy as np

from benchmarks.harness import machine
from benchmarks.harness.contest import CORES, ROOT
from benchmarks.harness.report import duration, markdown, write_between_markers
from benchmarks.opponents.scipy_localiser import PlainLocaliser

HEADER = ["task", "jeit, a frame", "frames a second", "NumPy and SciPy", "times jeit's", "compile", "agreement"]
FASTER, WITH_MAPS, WITHOUT_MAPS, RECORDING = 20.0, 500.0, 20_000.0, 0.2
# Maps relative to their greatest value; places in metres.
SAME_MAP, SAME_PLACE = 1e-10, 1e-6


def frames(number: int):
    """MicrophoneArray, and intensities (F, M) of as many touches with the noise that they expect; floor and ν."""
    import jax
    import jax.numpy as jnp

    from jeit.acoustic import IntensityNoise, InverseSquare, MicrophoneArray, make_surface
    from jeit.mesh import Rectangle
    from jeit.simulate.sounding_skin import SoundingSkin, expected_power, microphone_grid, noise_power

    skin = SoundingSkin(jax.random.key(0))
    microphones = np.asarray(skin.microphones)
    random = np.random.default_rng(0)
    places = random.uniform(-0.09, 0.09, (number, 2))
    freedom, floor = 50.0, noise_power(skin)
    received = expected_power(skin, places) * np.exp(0.3 * random.standard_normal((number, 1))) * 3.0
    spread = np.sqrt(4 * received * floor / freedom + 2 * floor**2 / freedom)
    power = received + spread * random.standard_normal(received.shape)
    # The decay models that fit the noise-free skin best, near enough.
    squared = np.sum((microphone_grid(13)[:, None] - microphones) ** 2, axis=-1)
    response = expected_power(skin, microphone_grid(13))
    b = np.full(len(microphones), 1.3e-4)
    a = np.exp(np.mean(np.log(response * (squared + b)), axis=0))
    noise = IntensityNoise.create(len(microphones), floor=floor, freedom=freedom, relative=0.2)
    decay = InverseSquare(jnp.asarray(a), jnp.asarray(b))
    return MicrophoneArray(jnp.asarray(microphones), make_surface(Rectangle(0.2, 0.2)), decay, noise), power


def seconds(function, rounds: int) -> tuple[float, float]:
    """Median of some runs, and how much longer the first one took."""
    start = time.perf_counter()
    function()
    first, spent = time.perf_counter() - start, []
    for _ in range(rounds):
        start = time.perf_counter()
        function()
        spent.append(time.perf_counter() - start)
    middle = statistics.median(spent)
    return middle, max(first - middle, 0.0)


def play(number: int, rounds: int):
    """Table rows, checks, and whether both sides agree."""
    import jax

    from jeit.acoustic import Localiser

    microphone_array, power = frames(max(number, 4096))
    few, many = power[:number], power[: 8 * number]
    plain = PlainLocaliser(
        np.asarray(microphone_array.microphones),
        np.asarray(microphone_array.decay.a),
        np.asarray(microphone_array.decay.b),
        0.1,
        200,
    )
    with_pixels = Localiser.create(microphone_array, method="consistency", map_shape=(200, 200))
    coarse = Localiser.create(microphone_array, method="consistency")
    likelihood = Localiser.create(microphone_array)
    likely_maps = Localiser.create(microphone_array, map_shape=(200, 200))
    maps, estimate = np.asarray(with_pixels.maps(few)), with_pixels(few)
    theirs = np.stack([plain.locate(frame) for frame in few])
    inside = np.abs(theirs).max(axis=1) < 0.1 - 1e-9
    map_error = max(np.abs(maps[k] / plain.map(few[k]) - 1).max() for k in range(0, number, 7))
    place_error = float(np.median(np.linalg.norm(np.asarray(estimate.position) - theirs, axis=1)[inside]))
    pairs = [
        ("maps, the paper's loss", lambda: with_pixels.maps(few), lambda f: plain.map(f), number, f"{map_error:.0e}"),
        (
            f"the same, {len(many)} frames at once",
            lambda: with_pixels.maps(many),
            lambda f: plain.map(f),
            len(many),
            "",
        ),
        (
            "map and refined place",
            lambda: with_pixels(few),
            lambda f: plain.locate(f),
            number,
            f"{1e6 * place_error:.2g} µm",
        ),
        ("all maps kept, and places", lambda: with_pixels.with_maps(few), lambda f: plain.locate(f), number, ""),
        ("place without a map, the paper's loss", lambda: coarse(power), plain.locate_near, len(power), ""),
        ("maps, likelihood", lambda: likely_maps.maps(few), None, number, ""),
        ("place without a map, likelihood", lambda: likelihood(power), None, len(power), ""),
        ("one frame alone, likelihood", lambda: likelihood(power[:1]), None, 1, ""),
    ]
    rows, rates, ratios = [], {}, {}
    for name, mine, other, count, agreement in pairs:
        spent, compiling = seconds(lambda mine=mine: jax.block_until_ready(mine()), rounds)
        each = spent / count
        row = [name, duration(each), f"{1 / each:,.0f}", "", "", duration(compiling), agreement]
        if other is not None:
            slow, _ = seconds(lambda other=other: [other(frame) for frame in few[:32]], 3)
            ratios[name] = slow / 32 / each
            row[3:5] = [duration(slow / 32), f"{ratios[name]:.0f}×"]
        rates[name] = 1 / each
        rows.append(row)
    spent, compiling, real = recording(rounds)
    rows.append(
        [f"recording of 1 s, 25 × {real:,} samples, to a track", duration(spent), "", "", "", duration(compiling), ""]
    )
    checks = [
        _check("maps: ≥ 20× NumPy", ratios["maps, the paper's loss"], FASTER, "×"),
        _check("map and refinement: ≥ 20× SciPy", ratios["map and refined place"], FASTER, "×"),
        _check("with maps: ≥ 500 frames a second", rates["all maps kept, and places"], WITH_MAPS, " /s"),
        _check(
            "without, likelihood: ≥ 20,000 frames a second",
            rates["place without a map, likelihood"],
            WITHOUT_MAPS,
            " /s",
        ),
        ["a recording of 1 s: < 0.2 s", duration(spent), "met" if spent < RECORDING else "missed"],
    ]
    return rows, checks, map_error < SAME_MAP and place_error < SAME_PLACE


def recording(rounds: int) -> tuple[float, float, int]:
    """Seconds from samples at 40 kHz to a smoothed track, seconds to compile, and samples of a channel."""
    import jax

    from jeit.acoustic import Recording, Taps, calibrate_microphones, locate, track
    from jeit.simulate.sounding_skin import SoundingSkin, microphone_grid
    from jeit.simulate.touch_sounds import calibration_taps, stroke

    skin = SoundingSkin(jax.random.key(0), multiplexed=False)
    taps = calibration_taps(skin, jax.random.key(1), microphone_grid(9), repeats=1)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.1
    array = np.asarray(skin.microphones)
    calibration = calibrate_microphones(
        Taps(array, corners, taps.positions, samples=taps.samples, rate=taps.rate)
    ).calibration
    sound = stroke(skin, jax.random.key(2), np.array([[-0.07, -0.06], [0.07, 0.05]]), strength=2.0)
    heard = Recording(sound.samples, sound.rate)
    spent, compiling = seconds(lambda: track(locate(heard, calibration)), rounds)
    return spent, compiling, sound.samples.shape[1]


def _check(asked: str, measured: float, least: float, unit: str) -> list[str]:
    return [asked, f"{measured:,.0f}{unit}", "met" if measured >= least else "missed"]


def main() -> int:
    """Run, print the table and the checks; 1 if a figure is missed, or jeit and SciPy disagree."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cases.hearing", description=__doc__)
    parser.add_argument("--frames", type=int, default=32, help="of those with maps")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--quick", action="store_true", help="a smoke run, figures not judged")
    parser.add_argument("--write-readme", action="store_true", help="put the table into benchmarks/README.md")
    options = parser.parse_args()
    if options.quick:
        options.frames, options.rounds = 8, 2
    machine.use_cores(CORES)
    heading = machine.heading()
    rows, checks, agree = play(options.frames, options.rounds)
    memory = f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB, of both together"
    text = "\n\n".join(
        [
            "\n".join(f"- {line}" for line in [*heading, memory]),
            markdown(HEADER, rows),
            markdown(["asked", "measured", ""], checks),
        ]
    )
    print(text)
    if not agree:
        raise SystemExit("jeit and SciPy disagree.")
    if options.write_readme:
        write_between_markers(ROOT / "benchmarks" / "README.md", text, "hearing")
    return int(not options.quick and any(check[-1] == "missed" for check in checks))


if __name__ == "__main__":
    raise SystemExit(main())
