from .run import Progress, run_study, study_progress
from .spec import Point, Study, read_study
from .store import open_results

__all__ = [
    "Point",
    "Progress",
    "Study",
    "open_results",
    "read_study",
    "run_study",
    "study_progress",
]
