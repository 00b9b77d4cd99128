from .layouts import (
    draw_improved_layout,
    draw_layout_comparison,
    report_improved_layout,
    report_layout_comparison,
    write_improved_layout,
    write_layout_comparison,
)
from .study import write_study_report

__all__ = [
    "draw_improved_layout",
    "draw_layout_comparison",
    "report_improved_layout",
    "report_layout_comparison",
    "write_improved_layout",
    "write_layout_comparison",
    "write_study_report",
]
