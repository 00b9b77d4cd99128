"""Scores available in a study."""

from __future__ import annotations

from typing import Literal

ScoreName = Literal[
    "minimum",
    "mean",
    "uniformity",
    "blind_spot",
    "taxels",
    "information",
    "mean_variance",
    "largest_variance",
    "localisation_error",
]
# Scores for sheets only, from linearised voltage changes and a prior: see `jeit.design.layout_scores`.
OPTIMALITY = ("information", "mean_variance", "largest_variance", "localisation_error")
