"""The benchmark cases: one module each, which defines `CASE`. To add a case, write a module and add its name here."""

from __future__ import annotations

from importlib import import_module

from benchmarks.harness.case import Case

# Names of the cases in the order in which they run and are reported: cases that measure times first, then studies of
# accuracy, which take longest.
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
    """The benchmark case called `name`. Raises `ValueError` for an unknown name."""
    if name not in NAMES:
        raise ValueError(f"There is no case {name!r}; there are {', '.join(NAMES)}.")
    return import_module(f"benchmarks.cases.{name}").CASE
