"""Every figure of docs/design.md's "The paper's comparison": `python -m benchmarks.cases.design_figures` (12 minutes).

The paper's two layouts touched all over, for several margins, thicknesses and kinds of touch; optimised layouts; and
measurements chosen from all that could be made.
"""

from __future__ import annotations

import argparse

from benchmarks.cases.design_figures import layouts as design_layouts
from benchmarks.cases.design_figures import touches as design_touches
from benchmarks.cases.design_figures.touches import LAYOUTS, Setting
from benchmarks.harness import machine
from benchmarks.harness.contest import CORES, ROOT
from benchmarks.harness.report import write_between_markers

PICTURE = ROOT / "docs" / "images" / "design-thickness.png"


def touched(setting: Setting, step) -> tuple[dict[str, str], dict]:
    """Tables by their titles, and what is felt for each thickness."""
    step("touch both layouts")
    changed = {name: design_touches.changes(name, setting.places, setting.mesh) for name in LAYOUTS}
    step("compare them")
    tables = {"Margins and pairs": design_touches.comparison_table(setting, changed)}
    tables["Thickness"], studied = design_touches.thickness_table(setting, step)
    tables["Kinds of touch"] = design_touches.kinds_table(setting, changed, step)
    return tables, studied


def improved(quick: bool, step) -> dict[str, str]:
    """Tables by their titles."""
    step("optimise layouts")
    sizes = ((300, 600), (6, 8), 2, 2) if quick else ((1300, 6000), (16, 24), 4, 60)
    tables = {"Optimised layouts": design_layouts.optimised(*sizes)}
    step("choose measurements")
    if quick:
        told = design_layouts.selected("grid-4x3", 20, (20e-3, 6e-3), (38e-3,), (1e-4,), 50)
    else:
        priors = (19e-3, 38e-3, 57e-3), (1e-3, 1e-4)
        told = design_layouts.selected("park-inner", 94, (12e-3, 2.5e-3), *priors, 1000)
    return {**tables, "Chosen measurements": told}


def joined(tables: dict[str, str]) -> str:
    """All tables, each under its title."""
    return "\n\n".join(f"**{title}**\n\n{table}" for title, table in tables.items())


def main() -> int:
    """Run and print the tables; write them and the picture into the documentation if asked."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cases.design_figures", description=__doc__)
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--quick", action="store_true", help="a smoke run on coarse meshes, figures not judged")
    which.add_argument("--write-docs", action="store_true", help="tables and picture into docs/")
    options = parser.parse_args()
    machine.use_cores(CORES)
    from rich.console import Console

    from jeit.cli.console import Steps

    with Steps(Console(stderr=True), quiet=False) as step:
        tables, studied = touched(design_touches.QUICK if options.quick else Setting(), step)
        text = joined({**tables, **improved(options.quick, step)})
    print("\n".join(machine.heading()), text, sep="\n\n")
    if options.write_docs:
        design_touches.draw_thickness(studied, PICTURE)
        write_between_markers(ROOT / "docs" / "design.md", text, "figures")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
