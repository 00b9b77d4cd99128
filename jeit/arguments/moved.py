"""Public names of version 0.2 that have moved. They still work until the next version, with a `DeprecationWarning` that
names the new place."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Callable
from types import ModuleType
from typing import Any

# For each package that exported names in version 0.2, the new modules of the names that have moved unchanged.
_MOVED = {
    "jeit.imaging": {
        "jeit.touch": "LearntGestures NamedTouch TouchImages TouchWatch WatchedFrame doubts_of learn_gestures "
        "learn_health untouched_frames",
    },
    "jeit.plot": {
        "jeit.acoustic.plots": "Marks plot_error_curve plot_loss_map plot_pairs plot_receptive_fields plot_track",
        "jeit.design.plots": "plot_sensitivity_histograms plot_sensitivity_map plot_taxel_areas plot_taxels "
        "plot_travel plot_unrolled",
        "jeit.touch.plots": "plot_answers plot_changes plot_confusion plot_contact_stages plot_contacts "
        "plot_depth_map plot_force_errors plot_health plot_health_course "
        "plot_key_errors plot_losses plot_map plot_place_errors plot_places plot_timeline "
        "plot_touch_paths plot_tried",
    },
    "jeit.report": {
        "jeit.acoustic.reports": "draw_calibration draw_track report_track write_calibration write_track",
        "jeit.design.reports": "draw_improved_layout draw_layout_comparison report_improved_layout "
        "report_layout_comparison write_improved_layout write_layout_comparison "
        "write_study_report",
        "jeit.touch.reports": "draw_health draw_watch report_gestures report_health "
        "report_learnt_images report_learnt_skin report_listener report_watch write_depths "
        "write_gestures write_health write_learnt_images write_learnt_skin "
        "write_listener write_touches write_watch",
    },
    "jeit.simulate": {
        "jeit.acoustic.simulate": "Burst SoundClip SoundingPerson SoundingSkin calibration_taps microphone_grid "
        "pat quiet room_sound sound_clips stroke tap tickle wind",
        "jeit.data": "RoundSkin simulate_press",
        "jeit.touch.simulate": "Bar DepthMap Disc Foundation GestureStream HalfSpace Indent IndentDraws IndentSet "
        "Material MovingPress Person Press PressDraws PressSet PressedSkin Prism Revolved "
        "Ring TwoSheets ball depth_maps indented_cells material open_presses relative_changes "
        "simulate_gesture_stream simulate_gestures simulate_presses",
    },
}
_RENAMED = {
    "jeit.touch.attributes.least_told": "jeit.touch.attributes.least_detected",
    "jeit.touch.kohonen.touches_told": "jeit.touch.kohonen.touches_reported",
    "jeit.touch.training.Trained": "jeit.touch.training.TrainingResult",
    "jeit.touch.listening.Heard": "jeit.touch.listening.SoundLabels",
    "jeit.plot.plot_heard": "jeit.touch.plots.plot_sound_labels",
    **{
        f"{page}.{old}": f"{home}.{new}"
        for page, home in (
            ("jeit.simulate", "jeit.touch.simulate"),
            ("jeit.touch.simulate", "jeit.touch.simulate"),
            ("jeit.touch.simulate.contact", "jeit.touch.simulate.contact"),
        )
        for old, new in (("Joined", "JoinedIndenters"), ("Placed", "PlacedIndenter"))
    },
    **{f"jeit.report.{verb}_heard": f"jeit.touch.reports.{verb}_sound_labels" for verb in ("draw", "report", "write")},
}
MOVED = _RENAMED | {
    f"{page}.{name}": f"{home}.{name}"
    for page, homes in _MOVED.items()
    for home, names in homes.items()
    for name in names.split()
}
"""New full name for each old full name."""

# Modules that have moved as a whole.
_MOVED_PAGES = {
    "jeit.electrodes.body_mesh": "jeit.electrodes.face_patches",
    "jeit.report.study": "jeit.design.reports",
    "jeit.simulate.acoustic": "jeit.acoustic.simulate",
    "jeit.simulate.acoustic.people": "jeit.acoustic.simulate.people",
    "jeit.simulate.contact": "jeit.touch.simulate.contact",
    "jeit.simulate.damage": "jeit.touch.simulate.damage",
    "jeit.simulate.people": "jeit.touch.simulate.people",
}


def with_moved_names(page: str, find: Callable[[str], Any] | None = None) -> Callable[[str], Any]:
    """The `__getattr__` of a package from which names have moved; `find` is the `__getattr__` for the names it still
    has.

    Modules of the package that have moved as a whole can still be imported.
    """
    for below in _MOVED_PAGES:
        if below.rpartition(".")[0] == page:
            sys.modules[below] = module = ModuleType(below)
            vars(module)["__getattr__"] = with_moved_names(below)

    def find_or_forward(name: str) -> Any:
        old = f"{page}.{name}"
        if old in MOVED:
            return _forward(old, MOVED[old])
        if page in _MOVED_PAGES and not name.startswith("__"):
            return _forward(old, f"{_MOVED_PAGES[page]}.{name}")
        if find is None:
            raise AttributeError(f"module '{page}' has no attribute '{name}'", name=name, obj=sys.modules[page])
        return find(name)

    return find_or_forward


def _forward(old: str, new: str) -> Any:
    home, _, name = new.rpartition(".")
    found = getattr(importlib.import_module(home), name)
    warnings.warn(f"{old} is now {new}; the old name goes with the next version.", DeprecationWarning, stacklevel=3)
    return found
