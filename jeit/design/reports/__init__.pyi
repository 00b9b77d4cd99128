from .layout_comparison import draw_layout_comparison, report_layout_comparison, write_layout_comparison
from .layout_improvement import draw_improved_layout, report_improved_layout, write_improved_layout
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
