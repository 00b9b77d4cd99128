"""The hook of the site that mends links: pages in folders reach the pages that stand outside `docs/`."""

from types import SimpleNamespace

import links
import pytest


@pytest.mark.parametrize(
    ("page", "written", "shown"),
    [
        ("index.md", "[changes](../CHANGELOG.md#top)", "[changes](changelog.md#top)"),
        ("how-to/tank.md", "[changes](../../CHANGELOG.md)", "[changes](../changelog.md)"),
        ("how-to/tank.md", "[cases](../../benchmarks/README.md)", "[cases](../benchmarks.md)"),
        ("how-to/tank.md", "[data](../reference/conventions.md)", "[data](../reference/conventions.md)"),
        ("how-to/tank.md", "[the reader](../../jeit/data/registry.py)", "the reader"),
        ("how-to/tank.md", "[nothing](../missing.md)", "[nothing](../missing.md)"),
        ("contributing.md", "[where](docs/reference/conventions.md)", "[where](reference/conventions.md)"),
        ("benchmarks.md", "[units](../docs/reference/conventions.md)", "[units](reference/conventions.md)"),
    ],
)
def test_links_to_files_outside_the_pages(page, written, shown):
    asked = SimpleNamespace(file=SimpleNamespace(src_uri=page))
    assert links.on_page_markdown(written, asked, None, None) == shown
