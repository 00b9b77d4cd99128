"""Virtual environments of opponents whose libraries conflict with jeit's, created when first needed."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import venv
from pathlib import Path

from benchmarks.harness.machine import ROOT
from benchmarks.harness.timing import say

REQUIREMENTS = Path(__file__).parents[1] / "opponents" / "requirements"


def python(opponent: str, *also: str, create: bool = True) -> str | None:
    """Python interpreter of an opponent's environment in `.cache/` of the repository; None if the environment is
    missing or cannot be created.

    The packages of the environment are pinned in `opponents/requirements/OPPONENT.txt`, and in `also` (pip's
    requirements).
    """
    requirements = REQUIREMENTS / f"{opponent}.txt"
    key = hashlib.sha256(requirements.read_bytes() + " ".join((sys.version, *also)).encode()).hexdigest()[:12]
    folder = ROOT / ".cache" / f"{opponent}-{key}"
    interpreter = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    complete = folder / "complete"
    if complete.exists():
        return str(interpreter)
    if not create:
        return None
    say(f"Making an environment for {opponent} (once) …")
    install = [str(interpreter), "-m", "pip", "install", "--quiet", "--requirement", str(requirements), *also]
    try:
        venv.create(folder, with_pip=True, clear=True)
        subprocess.run(install, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        say(f"{opponent} could not be installed and is left out of this run: {error}")
        return None
    complete.touch()
    return str(interpreter)
