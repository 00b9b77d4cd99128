from .batches import ArrayRows, MappedRows, Rows
from .fitting import TrainingObjective, TrainingPlan, TrainingResult, fit_network
from .model_file import check_same, read_file_header, read_model, write_model

__all__ = [
    "ArrayRows",
    "MappedRows",
    "Rows",
    "TrainingObjective",
    "TrainingPlan",
    "TrainingResult",
    "check_same",
    "fit_network",
    "read_file_header",
    "read_model",
    "write_model",
]
