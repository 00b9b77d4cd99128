"""Every figure of docs/reference/layout-figures.md.

The figures are for the paper's two electrode layouts with touches all over the skin, for several margins, thicknesses
and kinds of touch; for optimised layouts; and for measurements selected from all possible measurements. They concern
accuracy, not time.
"""

from __future__ import annotations

from benchmarks.cases.design_figures import layouts, touches
from benchmarks.harness.case import Case, Options, Result, Table
from benchmarks.harness.timing import say

PICTURE = "design-thickness.png"


def run(options: Options) -> Result:
    """Compute five tables and, if an output folder is given, draw the figure of thickness."""
    setting = touches.QUICK if options.quick else touches.Setting()
    say("both layouts touched")
    changed = {name: touches.changes(name, setting.places, setting.mesh) for name in touches.LAYOUTS}
    tables = [touches.comparison_table(setting, changed)]
    thickness, studied = touches.thickness_table(setting)
    tables += [thickness, touches.kinds_table(setting, changed), *_improved(options.quick)]
    if options.output is not None:
        touches.draw_thickness(studied, options.output / PICTURE)
    return Result(tables)


def _improved(quick: bool) -> list[Table]:
    """Tables of the improvements over the paper's layouts and measurements."""
    say("layouts optimised")
    sizes = ((300, 600), (6, 8), 2, 2) if quick else ((1300, 6000), (16, 24), 4, 60)
    optimised = layouts.optimised(*sizes)
    say("measurements chosen")
    if quick:
        return [optimised, layouts.selected("grid-4x3", 20, (20e-3, 6e-3), (38e-3,), (1e-4,), 50)]
    priors = (19e-3, 38e-3, 57e-3), (1e-3, 1e-4)
    return [optimised, layouts.selected("park-inner", 94, (12e-3, 2.5e-3), *priors, 1000)]


CASE = Case(
    "design_figures",
    "the paper's layouts compared on simulated skins, optimised layouts, chosen measurements",
    run,
    12,
    page=("docs/reference/layout-figures.md", "figures"),
    pictures=True,
    timed=False,
)
