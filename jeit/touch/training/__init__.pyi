from .batches import ArrayRows, MappedRows, Rows
from .fitting import Objective, Plan, TrainingResult, fit
from .model_file import check_same, read_head, read_model, write_model

__all__ = [
    "ArrayRows",
    "MappedRows",
    "Objective",
    "Plan",
    "Rows",
    "TrainingResult",
    "check_same",
    "fit",
    "read_head",
    "read_model",
    "write_model",
]
