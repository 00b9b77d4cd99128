"""Networks trained from arrays, and kept as files.

`fit` trains any equinox network by Adam, stops early, and goes on where it was killed; `write_model` and `read_model`
keep networks as numbers with a JSON head, never a pickle. Training needs the extra `learn`; what is trained does not.
"""

from __future__ import annotations

from jeit.touch.training.batches import ArrayRows, MappedRows, Rows
from jeit.touch.training.fitting import Objective, Plan, Trained, fit
from jeit.touch.training.model_file import check_same, read_head, read_model, write_model

__all__ = [
    "ArrayRows",
    "MappedRows",
    "Objective",
    "Plan",
    "Rows",
    "Trained",
    "check_same",
    "fit",
    "read_head",
    "read_model",
    "write_model",
]
