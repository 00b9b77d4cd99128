"""Public names of version 0.2 that have moved. The old names work until version 1.1; their use issues a
`DeprecationWarning` that states the new name."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Callable
from types import ModuleType
from typing import Any

# For each package that exported names in version 0.2: the new modules of names that have moved but were not changed.
_MOVED_NAMES = {
    "jeit.imaging": {
        "jeit.touch": "LearntGestures NamedTouch TouchImages TouchWatch WatchedFrame doubts_of learn_gestures "
        "learn_health untouched_frames",
    },
    "jeit.plot": {
        "jeit.acoustic": "plot_error_curve plot_loss_map plot_receptive_fields plot_track",
        "jeit.design": "plot_sensitivity_histograms plot_sensitivity_map plot_taxel_areas plot_taxels plot_travel "
        "plot_unrolled",
        "jeit.touch": "plot_confusion plot_contact_stages plot_contacts plot_depth_map plot_health plot_health_course "
        "plot_map plot_timeline plot_touch_paths",
        "jeit.touch.plots": "plot_answers plot_changes plot_force_errors plot_key_errors plot_losses plot_place_errors "
        "plot_places plot_tried",
    },
    "jeit.report": {
        "jeit.acoustic": "write_calibration write_track",
        "jeit.acoustic.reports": "draw_calibration draw_track report_track",
        "jeit.design": "write_improved_layout write_layout_comparison write_study_report",
        "jeit.design.reports": "draw_improved_layout draw_layout_comparison report_improved_layout "
        "report_layout_comparison",
        "jeit.touch": "write_listener",
        "jeit.touch.reports": "draw_health draw_watch report_gestures report_health report_learnt_images "
        "report_learnt_skin report_listener report_watch write_depths write_gestures write_health write_learnt_images "
        "write_learnt_skin write_touches write_watch",
    },
    "jeit.simulate": {
        "jeit.acoustic": "Burst SoundingPerson SoundingSkin microphone_grid",
        "jeit.acoustic.simulate": "SoundClip",
        "jeit.data": "RoundSkin simulate_press",
        "jeit.touch": "Foundation HalfSpace Indent IndentDraws Material MovingPress Person Press PressDraws PressSet "
        "PressedSkin TwoSheets depth_maps material open_presses relative_changes simulate_gesture_stream "
        "simulate_gestures simulate_presses",
        "jeit.touch.simulate": "GestureStream IndentSet indented_cells",
    },
}
_RENAMED_INDENTERS = {
    **{old: f"{old}Indenter" for old in ("Bar", "DepthMap", "Disc", "Prism", "Revolved", "Ring")},
    "Joined": "JoinedIndenters",
    "Placed": "PlacedIndenter",
    "ball": "ball_indenter",
}
_RENAMED_SOUNDS = {
    **{old: f"simulate_{old}" for old in ("calibration_taps", "pat", "room_sound", "sound_clips", "stroke", "tap")},
    "quiet": "simulate_silence",
    "tickle": "simulate_tickle",
    "wind": "simulate_wind",
}
_RENAMED_MARKS = {"Marks": "MapMarks", "plot_pairs": "plot_position_errors"}
_RENAMED_DAMAGE = {"mended": "mend_cut", "Mishap": "DamageEvent", "record_mishaps": "record_damage"}
_RENAMED_TRAINING = {"Objective": "TrainingObjective", "Plan": "TrainingPlan", "fit": "fit_network"}
# For each package of version 0.2, the package that now contains its renamed names, and the new name for each old name.
_RENAMED_NAMES_BY_MODULE = (
    ("jeit.acoustic.plots", "jeit.acoustic", _RENAMED_MARKS),
    ("jeit.acoustic.simulate", "jeit.acoustic", _RENAMED_SOUNDS),
    ("jeit.plot", "jeit.acoustic", _RENAMED_MARKS),
    ("jeit.plot", "jeit.touch", {"plot_heard": "plot_sound_labels"}),
    ("jeit.report", "jeit.touch.reports", {f"{verb}_heard": f"{verb}_sound_labels" for verb in ("draw", "report")}),
    ("jeit.report", "jeit.touch", {"write_heard": "write_sound_labels"}),
    ("jeit.simulate", "jeit.acoustic", _RENAMED_SOUNDS),
    ("jeit.simulate", "jeit.touch", _RENAMED_INDENTERS),
    ("jeit.touch.attributes", "jeit.touch.attributes", {"least_told": "detection_threshold"}),
    ("jeit.touch.kohonen", "jeit.touch", {"Schedule": "MapSchedule", "touches_told": "touches_reported"}),
    ("jeit.touch.listening", "jeit.touch", {"Heard": "SoundLabels"}),
    ("jeit.touch.networks", "jeit.touch", {"Preset": "NetworkPreset"}),
    ("jeit.touch.simulate", "jeit.touch", _RENAMED_INDENTERS),
    ("jeit.touch.simulate.contact", "jeit.touch", _RENAMED_INDENTERS),
    ("jeit.touch.simulate.damage", "jeit.touch", _RENAMED_DAMAGE),
    ("jeit.touch.training", "jeit.touch", _RENAMED_TRAINING),
    ("jeit.touch.training", "jeit.touch.training", {"Trained": "TrainingResult"}),
)
MOVED = {
    f"{old_module}.{old_name}": f"{new_module}.{new_name}"
    for old_module, new_module, new_names in _RENAMED_NAMES_BY_MODULE
    for old_name, new_name in new_names.items()
} | {
    f"{old_module}.{name}": f"{new_module}.{name}"
    for old_module, names_by_module in _MOVED_NAMES.items()
    for new_module, moved_names in names_by_module.items()
    for name in moved_names.split()
}
"""New full name, such as "jeit.touch.Press", for each old full name."""

# New name of each module that has moved as a whole, by its old name.
_MOVED_MODULES = {
    "jeit.electrodes.body_mesh": "jeit.electrodes.face_patches",
    "jeit.report.study": "jeit.design.reports",
    "jeit.simulate.acoustic": "jeit.acoustic.simulate",
    "jeit.simulate.acoustic.people": "jeit.acoustic.simulate.people",
    "jeit.simulate.contact": "jeit.touch.simulate.contact",
    "jeit.simulate.damage": "jeit.touch.simulate.damage",
    "jeit.simulate.people": "jeit.touch.simulate.people",
}


def with_moved_names(page: str, find_current_name: Callable[[str], Any] | None = None) -> Callable[[str], Any]:
    """Create the `__getattr__` of a package from which names have moved; `find_current_name` is the `__getattr__` for
    the names that the package still contains.

    Modules of the package that have moved can still be imported under their old names.
    """
    for old_module in _MOVED_MODULES:
        if old_module.rpartition(".")[0] == page:
            sys.modules[old_module] = empty_module = ModuleType(old_module)
            vars(empty_module)["__getattr__"] = with_moved_names(old_module)

    def find_or_forward(name: str) -> Any:
        old_full_name = f"{page}.{name}"
        if old_full_name in MOVED:
            return _import_moved_attribute(old_full_name, MOVED[old_full_name])
        if page in _MOVED_MODULES and not name.startswith("__"):
            return _import_moved_attribute(old_full_name, f"{_MOVED_MODULES[page]}.{name}")
        if find_current_name is None:
            raise AttributeError(f"module '{page}' has no attribute '{name}'", name=name, obj=sys.modules[page])
        return find_current_name(name)

    return find_or_forward


def _import_moved_attribute(old_full_name: str, new_full_name: str) -> Any:
    new_module, _, name = new_full_name.rpartition(".")
    attribute = getattr(importlib.import_module(new_module), name)
    warnings.warn(
        f"{old_full_name} is now {new_full_name}; the old name is removed in version 1.1.",
        DeprecationWarning,
        stacklevel=3,
    )
    return attribute
