"""Links that guides do not write: names in code style lead to the reference, files outside `docs/` to their pages."""

import re
from functools import cache
from pathlib import Path

import reference

ROOT = Path(__file__).resolve().parents[2]
# Files outside `docs/` that are pages of the site as well.
OUTSIDE = {
    "CHANGELOG.md": "changelog.md",
    "benchmarks/README.md": "benchmarks.md",
    "benchmarks/RESULTS.md": "results.md",
}
_CODE = re.compile(r"<(a|h\d|pre|autoref)\b.*?</\1>|<code>([A-Za-z_][\w.]*)((?:\([^<]*\))?)</code>", re.DOTALL)
_LINK = re.compile(r"\]\((?!\w+:|#)([^)#\s]+)(#[^)\s]*)?\)")


@cache
def _targets() -> dict[str, str]:
    """What a name in code style may be short for: its home, where only one room exports a name that is so called."""
    rooms = [package for package in reference.packages() if package.path not in ("jeit", "jeit.cli")]
    homes = {
        name: {one.exports[name].home for one in rooms if name in one.exports} for r in rooms for name in r.exports
    }
    short = {name: homes_of.pop() for name, homes_of in homes.items() if len(homes_of) == 1}
    whole = {f"{one.path}.{name}": entry.home for one in reference.packages() for name, entry in one.exports.items()}
    return {**{home: home for home in reference.described()}, **whole, **short}


def on_files(files, config):
    """Add the pages that stand outside `docs/`."""
    from mkdocs.structure.files import File

    for path, page in OUTSIDE.items():
        if (ROOT / path).is_file():
            files.append(File.generated(config, page, content=(ROOT / path).read_text("utf-8")))
    return files


def on_page_markdown(markdown, page, config, files):
    """Lead links to files outside `docs/` to the pages of the site that show them."""
    inside = {page: path for path, page in OUTSIDE.items()}
    here = ROOT / inside.get(page.file.src_uri, f"docs/{page.file.src_uri}")

    def moved(match: re.Match) -> str:
        path = (here.parent / match[1]).resolve()
        told = path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else ""
        if told.startswith("docs/") and page.file.src_uri in inside:
            return f"]({told.removeprefix('docs/')}{match[2] or ''})"
        return f"]({OUTSIDE[told]}{match[2] or ''})" if told in OUTSIDE else match[0]

    return markdown if page.file.src_uri.startswith("api/") else _LINK.sub(moved, markdown)


def on_page_content(html, page, config, files):
    """Lead names in code style to where the reference describes them."""

    def linked(match: re.Match) -> str:
        home = _targets().get(match[2] or "")
        if home is None:
            return match[0]
        return f'<autoref identifier="{home}" optional><code>{match[2]}{match[3]}</code></autoref>'

    return _CODE.sub(linked, html)
