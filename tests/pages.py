"""The documentation's pages, whose code is run."""

import re
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1] / "docs"


def run_page(name: str) -> dict:
    """Run every block of Python of a page in `docs/`, one after the other; what they name in the end."""
    names: dict = {}
    for block in re.findall(r"```python\n(.*?)```", (DOCS / name).read_text("utf-8"), re.DOTALL):
        exec(compile(block, name, "exec"), names)
    return names
