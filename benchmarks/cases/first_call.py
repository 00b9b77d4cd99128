"""First calls: the time that a user waits for one command or one script in a fresh process."""

from __future__ import annotations

import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks.harness.case import Case, Options, Result, Table, judged
from benchmarks.harness.tables import duration
from benchmarks.harness.timing import say

ROOT = Path(__file__).resolve().parents[2]
LIMIT = 300.0
_COMMAND = "from jeit.cli import main; raise SystemExit(main())"
_MODEL = """
from jeit import BoundaryElectrodes, Disk, ForwardModel, adjacent, ring
def ask(radius, nodes):
    model = ForwardModel(Disk(radius).mesh(num_points=nodes), BoundaryElectrodes(ring(radius, 16), 0.1 * radius, 0.1),
                         adjacent(16))
    model.voltages_and_jacobian(1.0)
"""
_TANK = (
    _MODEL
    + """
from jeit.inverse import Gaussian, reconstruct
model = ForwardModel(Disk(0.1).mesh(num_points=1150), BoundaryElectrodes(ring(0.1, 16), 0.012, 0.1), adjacent(16))
def image(length):
    reconstruct(model, model.voltages(1.1), 1.0, prior=Gaussian(length), hyperparameter=3.0)
"""
)
# Script that simulates taps and touches on a skin, as in docs/how-to/calibrate-microphones.md.
_SKIN = """
import jax
from jeit.acoustic import Recording, Taps, write_recording, write_taps
from jeit.acoustic import SoundingSkin, microphone_grid, simulate_calibration_taps, simulate_pat
skin, outline = SoundingSkin(jax.random.key(0)), [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]
taps = simulate_calibration_taps(skin, jax.random.key(1), microphone_grid(9))
taps = Taps(skin.microphones, outline, taps.positions, samples=taps.samples, rate=taps.rate)
write_taps("taps.npz", taps)
sound = simulate_pat(skin, jax.random.key(2), (0.03, 0.02))
write_recording("recording.npz", Recording(sound.samples, sound.rate))
"""
_CALIBRATED = (
    _SKIN
    + """
from jeit.acoustic import calibrate_microphones
calibrate_microphones(taps).calibration.save("skin.json")
"""
)


@dataclass(frozen=True)
class Job:
    """A command or a script to be timed: command-line arguments or the script, and the maximum seconds `cold` and
    `warm`.

    `before`: code that runs before the clock starts. `files`: a script that writes the files to be read.
    """

    name: str
    arguments: tuple[str, ...] = ()
    script: str = ""
    before: str = ""
    files: str = ""
    cold: float | None = None
    warm: float | None = None


def jobs(options: Options) -> list[Job]:
    """The jobs that can run on this machine: jobs on measured tanks need the data."""
    few = [
        Job("import jeit", script="import jeit", cold=2.0),
        Job("jeit demo", ("demo",), cold=8.0, warm=4.0),
        Job("README's fifteen lines, to the image", script=_fifteen_lines(), cold=10.0, warm=5.0),
    ]
    if options.quick:
        return few[:1]
    tanks = options.data or ROOT.parent / "shared" / "data"
    kit4, ktc = tanks / "kit4", tanks / "ktc2023"
    if kit4.is_dir() and ktc.is_dir():
        tank = ("reconstruct", str(kit4 / "datamat_2_2.mat"), "--reference", str(kit4 / "datamat_1_0.mat"))
        challenge = ("reconstruct", str(ktc / "data1.mat"), "--reference", str(ktc / "ref.mat"), "--segment")
        few += [
            Job("jeit reconstruct, KIT4, one-step", tank, warm=4.0),
            Job("jeit reconstruct, KIT4, Gauss-Newton", (*tank, "--method", "gauss-newton"), warm=6.0),
            Job("jeit reconstruct, Kuopio, --segment", challenge, warm=12.0),
        ]
    return [
        *few,
        # The following two jobs together may take 8 s.
        Job("jeit calibrate-microphones", ("calibrate-microphones", "taps.npz"), files=_SKIN, warm=4.0),
        Job("jeit locate", ("locate", "recording.npz", "-c", "skin.json"), files=_CALIBRATED, warm=4.0),
        Job("jeit layout compare", ("layout", "compare", "park-inner", "park-boundary"), warm=15.0),
        Job("jeit layout optimise", ("layout", "optimise", "park-boundary"), warm=25.0),
        Job("model, voltages and Jacobian, 1,150 nodes", script="ask(0.1, 1150)", before=_MODEL, cold=4.0),
        Job("model, voltages and Jacobian, 20,000 nodes", script="ask(0.1, 20000)", before=_MODEL, cold=6.0),
        Job("another radius", script="ask(0.06, 1150)", before=_MODEL + "ask(0.05, 1150)", cold=1.0),
        Job("another mesh, a tenth larger", script="ask(0.1, 1265)", before=_MODEL + "ask(0.1, 1150)", cold=1.0),
        Job("another correlation length", script="image(0.02)", before=_TANK + "image(0.03)", cold=1.0),
    ]


def run(options: Options) -> Result:
    """Time each job cold, without a cache of compiled code, and warm (median of three runs)."""
    rows, checks = [], []
    for job in jobs(options):
        with tempfile.TemporaryDirectory() as folder:
            subprocess.run([sys.executable, "-c", job.files], cwd=folder, check=True, timeout=LIMIT)
            cold, cpu = seconds(job, Path(folder))
            warm, again = (None, None) if job.before else _again(job, Path(folder))
        cells = [job.name, duration(cold), duration(cpu)]
        rows.append([*cells, *("" if one is None else duration(one) for one in (warm, again))])
        say(f"{job.name}: {duration(cold)}" + ("" if warm is None else f", then {duration(warm)}"))
        checks += [
            judged(f"{job.name}, {when} ≤ {most:g} s", duration(took), took <= most)
            for when, most, took in (("first", job.cold, cold), ("again", job.warm, warm))
            if most is not None and took is not None
        ]
    heads = ["job, in a fresh process", "first", "CPU", "again", "CPU, again"]
    return Result([Table(heads, rows)], checks)


def _again(job: Job, folder: Path) -> tuple[float, float]:
    runs = [seconds(job, folder) for _ in range(3)]
    return statistics.median(wall for wall, _ in runs), statistics.median(cpu for _, cpu in runs)


def seconds(job: Job, folder: Path) -> tuple[float, float]:
    """Wall and CPU seconds of a job in a fresh process, with its caches in `folder`.

    Raises `RuntimeError` if the job fails. The code `before` of a job is not counted.
    """
    environment = dict(os.environ, XDG_CACHE_HOME=str(folder / "cache"), MPLCONFIGDIR=str(folder / "matplotlib"))
    for name in ("JAX_COMPILATION_CACHE_DIR", "JEIT_COMPILATION_CACHE", "PYTHONDONTWRITEBYTECODE"):
        environment.pop(name, None)
    timed = "import time\n{}\nstart, cpu = time.perf_counter(), time.process_time()\n{}\n"
    timed += "print(time.perf_counter() - start, time.process_time() - cpu)"
    if job.arguments:
        command = [sys.executable, "-c", _COMMAND, *job.arguments, "--output", str(folder / "out")]
    else:
        command = [sys.executable, "-c", timed.format(job.before, job.script)]
    start, before = time.perf_counter(), _children()
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT)
    wall, cpu = time.perf_counter() - start, _children() - before
    if done.returncode:
        raise RuntimeError(f"{job.name}: {done.stderr.strip().splitlines()[-1]}")
    if job.before or job.name == "import jeit":
        wall, cpu = (float(number) for number in done.stdout.split()[-2:])
    return wall, cpu


def _children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _fifteen_lines() -> str:
    """The example of README.md, up to the computation of the image."""
    block = re.search(r"## Fifteen lines\n+```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert block is not None
    return block.group(1).split("plot_image(")[0]


CASE = Case("first_call", "first calls: commands and scripts in a fresh process, cold and again", run, 6)
