"""Links that guides do not write: names in code style lead to the reference, files outside `docs/` to their pages."""

import posixpath
import re
from collections import Counter
from functools import cache
from pathlib import Path

import reference

ROOT = Path(__file__).resolve().parents[2]
# Files outside `docs/` that are pages of the site as well.
OUTSIDE = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "benchmarks/README.md": "benchmarks.md",
    "benchmarks/RESULTS.md": "results.md",
    "tests/README.md": "tests.md",
}
_CODE = re.compile(r"<(a|h\d|pre|autoref)\b.*?</\1>|<code>([A-Za-z_][\w.]*)((?:\([^<]*\))?)</code>", re.DOTALL)
_LINK = re.compile(r"(?<!!)\[([^\]\n]*)\]\((?!\w+:|#)([^)#\s]+)(#[^)\s]*)?\)")


@cache
def _targets() -> dict[str, str]:
    """What a name in code style may be short for: its home, where one thing alone is so called.

    What rooms export comes first; of the rest only names that are no common words.
    """
    rooms = [package for package in reference.packages() if package.path not in ("jeit", "jeit.cli")]
    exported = {(one.last, one.home) for room in rooms for one in room.exports.values()}
    rest = {(home.rpartition(".")[2], home) for home in reference.described()}
    short: dict[str, str] = {}
    for names in ({one for one in rest if not one[0].islower() or "_" in one[0]}, exported):
        times = Counter(name for name, _ in names)
        short |= {name: home for name, home in names if times[name] == 1}
    whole = {f"{one.path}.{name}": entry.home for one in reference.packages() for name, entry in one.exports.items()}
    paths = [*reference.described(), *(package.path for package in reference.packages())]
    return {**whole, **{path: path for path in paths}, **short}


def on_files(files, config):
    """Add the pages that stand outside `docs/`."""
    from mkdocs.structure.files import File

    for path, page in OUTSIDE.items():
        if (ROOT / path).is_file():
            files.append(File.generated(config, page, content=(ROOT / path).read_text("utf-8")))
    return files


def on_config(config):
    """Put the pages that stand outside `docs/` into the menu, those that there are."""
    there = [page for path, page in OUTSIDE.items() if path.startswith("benchmarks/") and (ROOT / path).is_file()]
    for entry in config.nav:
        if isinstance(entry, dict) and "Benchmarks" in entry:
            entry["Benchmarks"] = there
    return config


def on_page_markdown(markdown, page, config, files):
    """Lead links to files outside `docs/` to the pages that show them; where none does, leave the link's words."""
    inside = {page: path for path, page in OUTSIDE.items()}
    uri = page.file.src_uri
    here = ROOT / inside.get(uri, f"docs/{uri}")
    folder = posixpath.dirname(uri) or "."

    def moved(match: re.Match) -> str:
        words, anchor, path = match[1], match[3] or "", (here.parent / match[2]).resolve()
        repository_path = path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else ""
        if repository_path.startswith("docs/"):
            return f"[{words}]({repository_path.removeprefix('docs/')}{anchor})" if uri in inside else match[0]
        if repository_path in OUTSIDE and path.is_file():
            return f"[{words}]({posixpath.relpath(OUTSIDE[repository_path], folder)}{anchor})"
        return words if path.exists() else match[0]

    return markdown if uri.startswith("api/") else _LINK.sub(moved, markdown)


def on_page_content(html, page, config, files):
    """Lead names in code style to where the reference describes them."""

    def linked(match: re.Match) -> str:
        home = _targets().get(match[2] or "")
        if home is None:
            return match[0]
        return f'<autoref identifier="{home}" optional><code>{match[2]}{match[3]}</code></autoref>'

    return _CODE.sub(linked, html)
