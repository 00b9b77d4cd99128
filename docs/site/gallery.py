"""The gallery: every example with its picture, made by running it.

`python docs/site/gallery.py` makes the pictures that are not there yet (minutes); as a hook of mkdocs this does so too,
and adds the page. Pictures are kept in `.cache/gallery`, each under a name that changes with the example, with any file
of jeit and with the versions of the libraries beneath: no picture outlives the code that made it. While
pages are written, JEIT_GALLERY=kept takes what is kept, of older code too.
"""

import ast
import base64
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"
CACHE = ROOT / ".cache" / "gallery"
_BENEATH = ("jax", "numpy", "scipy", "equinox", "lineax", "optimistix", "matplotlib")
_HEAD = """# Gallery

Every example of `examples/`, with the picture that it makes. Each program is a test as well: it states a figure and
fails if that is missed. Times include compilation. Run one with `python examples/press_on_a_skin.py`, a study with
`jeit study run examples/study.toml`.
"""


def examples() -> list[Path]:
    """Every example, by name: programs, and the studies that `jeit study run` takes."""
    return sorted([*EXAMPLES.glob("*.py"), *EXAMPLES.glob("*.toml")])


@cache
def code() -> str:
    """A digest of everything beneath the examples."""
    digest = hashlib.sha256(" ".join(f"{name} {metadata.version(name)}" for name in _BENEATH).encode())
    for top in (ROOT / "jeit", ROOT / "solvers"):
        for path in sorted(top.rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def picture(example: Path) -> Path:
    """Where the picture of an example is kept, whether it is there or not."""
    digest = hashlib.sha256(code().encode() + example.read_bytes()).hexdigest()
    return CACHE / f"{example.stem}-{digest[:16]}.png"


def keep(example: Path, folder: Path) -> Path:
    """Keep the picture that an example left in `folder`. Raises `FileNotFoundError` if it left none of its name."""
    kept = picture(example)
    kept.parent.mkdir(parents=True, exist_ok=True)
    for old in kept.parent.glob(f"{example.stem}-*.png"):
        old.unlink()
    shutil.copyfile(folder / f"{example.stem}.png", kept)
    return kept


def make(example: Path) -> Path:
    """The picture of an example, made by running it if it is not kept. Raises `RuntimeError` if the example fails."""
    kept = picture(example)
    older = sorted(CACHE.glob(f"{example.stem}-*.png")) if os.environ.get("JEIT_GALLERY") == "kept" else []
    if kept.is_file() or older:
        return kept if kept.is_file() else older[-1]
    print(f"gallery: {example.name}", file=sys.stderr, flush=True)
    paths = [str(ROOT), str(ROOT / "solvers"), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "MPLBACKEND": "Agg", "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(example)]
        if example.suffix == ".toml":
            shutil.copy(example, folder)
            command = [sys.executable, "-m", "jeit", "study", "run", example.name, "--quiet"]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{example.name} failed:\n{done.stdout}{done.stderr}")
        if example.suffix == ".toml":
            _take_maps(Path(folder) / f"{example.stem}.html")
        return keep(example, Path(folder))


def _take_maps(report: Path) -> None:
    """Put the last picture of a study's report, its sensitivity maps, beside it."""
    encoded = re.findall(r'src="data:image/png;base64,([^"]+)"', report.read_text("utf-8"))[-1]
    report.with_suffix(".png").write_bytes(base64.b64decode(encoded))


def _said(example: Path) -> str:
    """What an example is said to be: the first line of its docstring, or of its comment."""
    text = example.read_text("utf-8")
    if example.suffix == ".toml":
        return text.split("\n")[0].lstrip("# ").rstrip(".")
    return " ".join((ast.get_docstring(ast.parse(text)) or "").split("\n\n")[0].split()).split("; see `")[0].rstrip(".")


def cost(example: Path) -> str:
    """The sentence of an example on its time and memory. Raises `ValueError` if there is none."""
    found = re.search(r"Takes \d+ s and [\d.]+ GB on two cores\.", " ".join(example.read_text("utf-8").split()))
    if found is None:
        raise ValueError(f"{example.name}: state 'Takes 12 s and 0.6 GB on two cores.', measured without kept programs")
    return found[0]


def page() -> str:
    """The page, as Markdown; its pictures stand beside it in `gallery/`."""
    lines = [_HEAD]
    for example in examples():
        title, what = example.stem.replace("_", " ").capitalize(), _said(example)
        language = "python" if example.suffix == ".py" else "toml"
        code = "\n".join(f"    {line}".rstrip() for line in example.read_text("utf-8").rstrip().split("\n"))
        lines += [f"## {title}", "", f"{what}. {cost(example)}", "", f"![{what}](gallery/{example.stem}.png)", ""]
        lines += [f'??? example "examples/{example.name}"', "", f"    ```{language}", code, "    ```", ""]
    return "\n".join(lines)


def on_files(files, config):
    """Add the page and its pictures, made where they are not kept."""
    from mkdocs.structure.files import File

    for example in examples():
        files.append(File.generated(config, f"gallery/{example.stem}.png", abs_src_path=str(make(example))))
    files.append(File.generated(config, "gallery.md", content=page()))
    return files


if __name__ == "__main__":
    for each in examples():
        print(make(each))
