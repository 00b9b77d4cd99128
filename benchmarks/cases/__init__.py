"""What is measured: one case to a file, each with its `CASE`. To add one, write a file and name it here."""

from __future__ import annotations

from importlib import import_module

from benchmarks.harness.case import Case

# In the order in which they run and are reported: times first, then studies of accuracy, which take longest.
NAMES = (
    "forward",
    "solver",
    "scaling",
    "gauss_newton",
    "optimisers",
    "realtime",
    "soak",
    "live",
    "live_page",
    "hearing",
    "design",
    "contact",
    "learnt",
    "kohonen_speed",
    "first_call",
    "solids",
    "contacts",
    "kohonen",
    "network_eit",
    "localisation_error",
    "skin_health",
    "mixed_tanks",
    "unlike_tanks",
    "cut_tanks",
    "solid_tanks",
    "untuned_arrays",
    "ktc2023",
    "real_skins",
    "crash",
    "fuzz",
    "threads",
    "discriminants",
    "gestures",
    "modality",
    "design_figures",
)


def load(name: str) -> Case:
    """The case of this name. Raises `ValueError` for a name that there is not."""
    if name not in NAMES:
        raise ValueError(f"There is no case {name!r}; there are {', '.join(NAMES)}.")
    return import_module(f"benchmarks.cases.{name}").CASE
