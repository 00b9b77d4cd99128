"""Where electrodes should go, before any material is cut.

What a skin of a given layout, its electrodes' positions, will feel: sensitivity maps, virtual taxels, scores. Better
layouts: moved by gradients, within an outline and with minimum spacing; and the measurements worth making with them.
Studies of many layouts, which survive a crash. Here is what a designer uses; the rest, such as the classes of what is
found, is in the modules.

Names are imported when first used: the command line shows defaults (`jeit.design.defaults`) without waiting.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jeit.design.comparison import compare_layouts as compare_layouts
    from jeit.design.improvement import improve_layout as improve_layout
    from jeit.design.measurements.candidates import Candidates as Candidates
    from jeit.design.measurements.selection import information_bound as information_bound
    from jeit.design.measurements.selection import select_measurements as select_measurements
    from jeit.design.optimisation.design_space import DesignSpace as DesignSpace
    from jeit.design.optimisation.objective import Objective as Objective
    from jeit.design.optimisation.optimise import optimise_layout as optimise_layout
    from jeit.design.optimisation.surface_optimise import optimise_surface_layout as optimise_surface_layout
    from jeit.design.response import skin_response as skin_response
    from jeit.design.scores import TouchPrior as TouchPrior
    from jeit.design.scores import layout_scores as layout_scores
    from jeit.design.sensitivity import sensitivity_map as sensitivity_map
    from jeit.design.skin.indentation import Bell as Bell
    from jeit.design.skin.indentation import Hemisphere as Hemisphere
    from jeit.design.skin.skin import Skin as Skin
    from jeit.design.skin.skin_file import describes_skin as describes_skin
    from jeit.design.skin.skin_file import read_described_skin as read_described_skin
    from jeit.design.skin.touch_grid import touch_grid as touch_grid
    from jeit.design.skin.touch_grid import touches_away_from_the_edge as touches_away_from_the_edge
    from jeit.design.study import open_results as open_results
    from jeit.design.study import read_study as read_study
    from jeit.design.study import run_study as run_study
    from jeit.design.taxels import find_taxels as find_taxels

_HOMES = {
    "Bell": "skin.indentation",
    "Candidates": "measurements.candidates",
    "DesignSpace": "optimisation.design_space",
    "Hemisphere": "skin.indentation",
    "Objective": "optimisation.objective",
    "Skin": "skin.skin",
    "TouchPrior": "scores",
    "compare_layouts": "comparison",
    "find_taxels": "taxels",
    "improve_layout": "improvement",
    "information_bound": "measurements.selection",
    "layout_scores": "scores",
    "open_results": "study",
    "optimise_layout": "optimisation.optimise",
    "optimise_surface_layout": "optimisation.surface_optimise",
    "describes_skin": "skin.skin_file",
    "read_described_skin": "skin.skin_file",
    "read_study": "study",
    "run_study": "study",
    "select_measurements": "measurements.selection",
    "sensitivity_map": "sensitivity",
    "skin_response": "response",
    "touch_grid": "skin.touch_grid",
    "touches_away_from_the_edge": "skin.touch_grid",
}


def __getattr__(name: str):
    if name in _HOMES:
        return getattr(importlib.import_module(f"jeit.design.{_HOMES[name]}"), name)
    from jeit.arguments.moved import missing

    raise missing(__name__, name)


__all__ = sorted(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
