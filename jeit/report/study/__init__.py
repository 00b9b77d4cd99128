"""A study as one HTML page, and its pictures."""

from __future__ import annotations

from jeit.report.study.report import write_study_report

__all__ = [
    "write_study_report",
]
