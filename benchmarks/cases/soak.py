"""An endless stream: a million frames through linear images, and thousands through Gauss-Newton.

Some frames are faulty, in bursts of a known kind of fault. Memory must not grow, the reported reason of every bad frame
must name its fault, and no good frame may be refused.
"""

from __future__ import annotations

import ctypes
import gc
import os
from typing import NamedTuple

import numpy as np

from benchmarks.harness.case import Case, Options, Result, Table, judged
from benchmarks.harness.tables import duration
from benchmarks.harness.timing import say
from benchmarks.problems.disturbed_frames import KINDS, DisturbedFrames
from benchmarks.problems.touched_sensors import NOISE, bodies, simulate
from jeit.inverse import Imager, stream
from jeit.inverse.nonlinear import GaussNewton, OneStep

SENSOR, NODES, BASE = "disk, 16 electrodes", 1193, 400
# Number of frames, frames from one burst of faults to the next, and maximum frames of a burst, for linear images and
# for Gauss-Newton; in a full run (False) and in a quick run (True).
LENGTHS = {False: ((1_000_000, 2000, 400), (20_000, 400, 80)), True: ((3000, 400, 80), (100, 50, 10))}
# Megabytes by which memory may grow from a tenth of the stream to its end, due to fluctuations of the allocator.
GROWTH = 8.0


class Soaked(NamedTuple):
    """Results of a stream: memory in MB after a tenth, half and all of the stream, seconds of each good frame and of
    each bad frame, numbers of bad frames whose fault was named, by kind, and number of good frames that were refused or
    reported as partial.
    """

    memory: list[float]
    good: np.ndarray
    bad: np.ndarray
    named: dict[str, int]
    accused: int


def run(options: Options) -> Result:
    """Measure linear images and Gauss-Newton images."""
    nodes = (options.nodes or (200 if options.quick else NODES,))[0]
    make, reach = bodies()[SENSOR]
    model = make(nodes)
    base, rest = simulate(make(2 * nodes), reach, BASE)
    touching = np.array([model.protocol.channels_touching(one) for one in range(model.protocol.num_electrodes)])
    noise = 2 * NOISE * np.abs(rest) + 1e-2 * NOISE * np.abs(rest).max()
    streams, kinds, asked = [], [], []
    for (name, solver), lengths in zip(
        (("linear", OneStep()), ("Gauss-Newton", GaussNewton(max_steps=4))), LENGTHS[options.quick], strict=True
    ):
        imager = Imager.create(model, 1.0, solver=solver, reference=rest, noise=noise, hyperparameter=3.0)
        frames = DisturbedFrames(base, rest, touching, *lengths)
        found = soak(imager, frames)
        times = [duration(one) for part in (found.good, found.bad) for one in np.quantile(part, (0.5, 0.99))]
        bad, growth = sum(frames.planted.values()), max(found.memory) - found.memory[0]
        memory = [f"{one:.1f} MB" for one in found.memory]
        right = sum(found.named.values())
        streams.append([name, f"{frames.number:,}", *memory, *times, f"{right:,} of {bad:,}", str(found.accused)])
        say(" | ".join(streams[-1]))
        kinds += [
            [name, kind, str(KINDS[kind].status), f"{planted:,}", f"{found.named[kind]:,}"]
            for kind, planted in frames.planted.items()
        ]
        asked += [
            judged(f"{name}: memory grows by ≤ {GROWTH:g} MB from 10 % on", f"{growth:.1f} MB", growth <= GROWTH),
            judged(f"{name}: every bad frame named", f"{right:,} of {bad:,}", right == bad),
            judged(f"{name}: no good frame refused, or in part", str(found.accused), found.accused == 0),
        ]
    title = f"{SENSOR}, {model.mesh.num_points} nodes, {base.shape[1]} voltages"
    header = ["images", "frames", "memory at 10 %", "at 50 %", "at the end", "good frame: median", "99 %"]
    header += ["bad frame: median", "99 %", "bad frames named", "good ones reported"]
    bad_header = ["images", "bad frames", "become", "planted", "named for their fault"]
    return Result([Table(header, streams, title), Table(bad_header, kinds)], asked)


def soak(imager: Imager, frames: DisturbedFrames) -> Soaked:
    """Image all frames and check the status of each image; no image is kept."""
    latency, bad = np.full(frames.number, np.nan), np.full(frames.number, False)
    named, accused, memory = dict.fromkeys(KINDS, 0), 0, []
    marks = {int(share * frames.number) for share in (0.1, 0.5, 1.0)}
    for one in stream(imager, frames):
        latency[one.number] = one.latency
        bad[one.number] = bool(frames.kind)
        if frames.kind:
            kind = KINDS[frames.kind]
            matches = one.status == kind.status and kind.word.format(frames.electrode + 1) in one.reason
            named[frames.kind] += matches
            if not matches and named[frames.kind] == 0:
                say(f"  {frames.kind}: {one.status}. {one.reason}")
        else:
            accused += one.status in ("refused", "partial")
        if one.number + 1 in marks:
            memory.append(resident_memory())
            say(f"  frame {one.number + 1:,}: {memory[-1]:.1f} MB")
    return Soaked(memory, latency[~bad], latency[bad], named, accused)


def resident_memory() -> float:
    """Resident memory of this process, MB, after free memory has been returned."""
    gc.collect()
    try:
        ctypes.CDLL("libc.so.6").malloc_trim(0)
        with open("/proc/self/statm", encoding="ascii") as statm:
            return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:
        return float("nan")


CASE = Case("soak", "a million streamed frames, some bad: memory, latency, each named for its fault", run, 12)
