"""pyEIT's own virtual environment, made when first needed, from pinned requirements."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import venv
from pathlib import Path

REQUIREMENTS = Path(__file__).parents[1] / "opponents" / "requirements" / "pyeit.txt"


def python(*, create: bool = True) -> Path | None:
    """Interpreter of the environment in `.cache/` under the repository; None if it is missing or cannot be made."""
    key = hashlib.sha256(REQUIREMENTS.read_bytes() + sys.version.encode()).hexdigest()[:12]
    folder = REQUIREMENTS.parents[2] / ".cache" / f"pyeit-{key}"
    interpreter = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    complete = folder / "complete"
    if complete.exists():
        return interpreter
    if not create:
        return None
    print("Making pyEIT's environment (once) …", file=sys.stderr, flush=True)
    venv.create(folder, with_pip=True, clear=True)
    install = [str(interpreter), "-m", "pip", "install", "--quiet", "--requirement", str(REQUIREMENTS)]
    if subprocess.run(install, check=False).returncode != 0:
        print("pip could not install pyEIT: it is left out of this run.", file=sys.stderr)
        return None
    complete.touch()
    return interpreter
