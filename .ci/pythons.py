"""Install jeit on every available Python, with the newest and the lowest versions of packages, and test it.

    python .ci/pythons.py                         # every Python, and the oldest with the lowest versions, as CI does
    python .ci/pythons.py --whole 3.13 least-3.11 # the whole test suite on some of them

Each row is a virtual environment of its own with the built wheel. First the main command runs and every module is
imported without extras. Then all extras are installed at once and the tests run. On the newest Python, each extra is
also installed alone. The versions of `least` are those that uv finds for the lower bounds of pyproject.toml. A Python
is looked up on the PATH and under pyenv; the row of a missing one says so.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
PYTHONS = [one.rpartition(" ")[2] for one in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", one)]
EXTRAS = list(PROJECT["optional-dependencies"])
SELECTION = (ROOT / "tests" / "selection.txt").read_text("utf-8").split()

# Import every module of both packages without any extra; an ImportError of an optional package is not an error here.
IMPORT_ALL = """
import importlib, pkgutil, jeit, jeit_solvers
from jeit.arguments.extras import EXTRAS
optional = {module for held in EXTRAS.values() for module in held}
names = [one.name for top in (jeit, jeit_solvers) for one in pkgutil.walk_packages(top.__path__, top.__name__ + ".")]
for name in names:
    try:
        importlib.import_module(name)
    except ImportError as error:
        if (error.name or "").partition(".")[0] not in optional:
            raise
print(len(names), "modules")
"""
IMPORT_EXTRA = """
import importlib.util, sys
from jeit.arguments.extras import EXTRAS
sys.exit([one for one in EXTRAS.get(sys.argv[1], ()) if importlib.util.find_spec(one) is None] or 0)
"""
HEADING = ["Python", "install", "main command", "import", "install extras", "tests", "each extra alone"]
COUNTS = r"\d+ (?:passed|failed|errors?|skipped)"


def interpreter(version: str) -> str | None:
    """Return the path of a working Python of this version, such as "3.12"; None if there is none."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    under_pyenv = sorted(pyenv.glob(f"{version}.*/bin/python"), key=lambda path: int(path.parts[-3].split(".")[2]))
    for one in (shutil.which(f"python{version}"), *reversed(under_pyenv)):
        asked = [str(one), "-c", "import sys, venv, ensurepip; print(sys.executable)"]
        if one and not (done := subprocess.run(asked, capture_output=True, text=True)).returncode:
            return done.stdout.strip()
    return None


def first(versions: list[str]) -> str | None:
    """Return the path of the first of these versions that is available."""
    return next(filter(None, map(interpreter, versions)), None)


class Row:
    """One environment: the steps run in it, and the seconds that each step took, as cells of a table."""

    def __init__(self, name: str, folder: Path, uv: Path):
        self.name, self.folder, self.python = name, folder, folder / ".venv" / "bin" / "python"
        self.uv = uv
        self.cells: list[str] = []

    def step(self, title: str, *commands: tuple, found: str = "", where: Path | None = None) -> None:
        """Run commands and add a cell: the seconds, and the matches of the pattern `found` in the output."""
        print(f"== {self.name}: {title}", flush=True)
        start, lines = time.monotonic(), ""
        for command in commands:
            words = [str(one) for one in command]
            to_one = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
            done = subprocess.run(words, cwd=where or self.folder, check=False, **to_one)
            lines += done.stdout
            if done.returncode:
                raise SystemExit(
                    f"{done.stdout[-6000:]}\n{self.name}, {title}: {words[0]} ended with {done.returncode}"
                )
        seconds = f"{time.monotonic() - start:.0f} s"
        self.cells.append(", ".join([*(re.findall(found, lines) if found else ()), seconds]))

    def installing(self, *what: str | Path) -> tuple:
        """Return the command that installs packages here. It uses uv, which accepts pip's arguments and is about five
        times as fast."""
        return (self.uv, "pip", "install", "--quiet", "--python", self.python, *what)


def least(uv: Path, python: str, folder: Path) -> Path:
    """Write a file of constraints: every package named in pyproject.toml, at its lowest permitted version that has a
    wheel."""
    made = folder / "least.txt"
    # MiniSom has no wheels and does not need them.
    wheels = ("--only-binary", ":all:", "--no-binary", "minisom")
    resolve = ("pip", "compile", "--quiet", "--resolution", "lowest-direct", "--all-extras", "--python", python)
    subprocess.run([uv, *resolve, *wheels, ROOT / "pyproject.toml", "-o", made], check=True, stdout=subprocess.DEVNULL)
    return made


def fill(made: Row, wheel: Path, uv: Path, *, whole: bool, tested: bool) -> None:
    """Run all steps in one environment, "3.12" or "least-3.11"; without the tests if they are `tested` elsewhere."""
    name, folder = made.name, made.folder
    version = name.removeprefix("least-")
    python = interpreter(version)
    if python is None:
        made.cells = [f"skipped: there is no Python {version} here"]
        return
    constraints = ("-c", least(uv, python, folder)) if name != version else ()
    made.step("install", (uv, "venv", "--quiet", "--python", python, ".venv"), made.installing(*constraints, wheel))
    made.step("main command", (made.python.with_name("jeit"), "demo", "--output", "out"))
    if not (folder / "out" / "image.png").stat().st_size:
        raise SystemExit(f"{name}: the main command made no picture")
    made.step("import every module", (made.python, "-c", IMPORT_ALL), found=r"\d+ modules")
    # Linters and documentation tools are not tested with the lowest versions.
    together = ",".join(one for one in EXTRAS if not constraints or one not in ("docs", "dev"))
    # The wheel is tested. The whole suite needs the sources, because some tests import the benchmarks.
    sources = [made.installing(*constraints, "-e", f"{ROOT}[test]")] if whole else []
    made.step("install all extras", made.installing(*constraints, f"{wheel}[{together}]"), *sources)
    command = (made.python, "-m", "pytest") if whole else (made.python.with_name("pytest"), *SELECTION)
    tests = (*command, "-n", "2", "-q", "-p", "no:randomly", "-m", "not slow")
    if tested:
        made.cells.append("elsewhere")
    else:
        made.step("tests", tests, found=COUNTS, where=ROOT)
    if python == first(PYTHONS[::-1]) and not constraints:
        made.step("each extra alone", *(one for extra in EXTRAS for one in alone(extra, wheel, uv, python)))


def alone(extra: str, wheel: Path, uv: Path, python: str) -> list[tuple]:
    """Return the commands that leave one extra alone in an environment and check that its packages are there.

    The environment is used again for the next extra, whose installation removes what it does not need: the modules of
    JAX are compiled once.
    """
    its_own = Path("alone") / "bin" / "python"
    return [
        (uv, "venv", "--quiet", "--allow-existing", "--python", python, "alone"),
        (uv, "pip", "install", "--quiet", "--exact", "--python", its_own, f"{wheel}[{extra}]"),
        (uv, "pip", "check", "--quiet", "--python", its_own),
        (its_own, "-c", IMPORT_EXTRA, extra),
    ]


def from_sources(archive: Path, uv: Path, python: str, folder: Path) -> None:
    """Install the source distribution as pip does from an index, and run its command."""
    its_own = folder / "sources" / "bin" / "python"
    for command in (
        (uv, "venv", "--quiet", "--python", python, its_own.parents[1]),
        (uv, "pip", "install", "--quiet", "--python", its_own, archive),
        (its_own.with_name("jeit"), "--version"),
    ):
        subprocess.run([str(one) for one in command], check=True)


def main() -> int:
    """Build and check a source distribution and a wheel, fill the rows and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    every = [*PYTHONS, f"least-{PYTHONS[0]}"]
    parser.add_argument("names", nargs="*", default=every, help="such as 3.12, or least-3.11")
    parser.add_argument("--whole", action="store_true", help="all quick tests, not those of tests/selection.txt alone")
    parser.add_argument("--tested", nargs="*", default=[], metavar="NAME", help="those whose tests are not run here")
    parser.add_argument("--find", choices=("newest", "oldest"), help="print the path of such a Python here, and end")
    parser.add_argument("--list", action="store_true", help="print the supported versions of Python, and end")
    asked = parser.parse_args()
    if asked.list:
        print(*PYTHONS)
        return 0
    if asked.find:
        found = first(PYTHONS[::-1] if asked.find == "newest" else PYTHONS)
        print(found or f"no Python of {', '.join(PYTHONS)} here", file=sys.stdout if found else sys.stderr)
        return 0 if found else 1
    known = [*PYTHONS, *(f"least-{one}" for one in PYTHONS)]
    if strange := [one for one in (*asked.names, *asked.tested) if one not in known]:
        parser.error(f"{', '.join(strange)}: give some of {', '.join(known)}")
    uv = shutil.which("uv", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]))
    if uv is None or find_spec("build") is None or find_spec("twine") is None:
        parser.error("uv, build and twine are needed: pip install '.[dev]'")
    rows: list[Row] = []
    try:
        with tempfile.TemporaryDirectory() as kept:
            building = [sys.executable, "-m", "build", "--outdir", kept, str(ROOT)]
            subprocess.run(building, check=True, stdout=subprocess.DEVNULL)
            wheel, archive = next(Path(kept).glob("*.whl")), next(Path(kept).glob("*.tar.gz"))
            subprocess.run([sys.executable, "-m", "twine", "check", "--strict", wheel, archive], check=True)
            from_sources(archive, Path(uv), first(PYTHONS[::-1]) or sys.executable, Path(kept))
            for name in asked.names:
                with tempfile.TemporaryDirectory() as folder:
                    rows.append(Row(name, Path(folder), Path(uv)))
                    fill(rows[-1], wheel, Path(uv), whole=asked.whole, tested=name in asked.tested)
    finally:
        for line in (HEADING, ["---"] * len(HEADING), *([one.name, *one.cells] for one in rows)):
            print(f"| {' | '.join([*line, *[''] * (len(HEADING) - len(line))])} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
