from .run import Progress, run_study, study_progress
from .spec import Study, StudyPoint, read_study
from .store import open_results

__all__ = [
    "Progress",
    "Study",
    "StudyPoint",
    "open_results",
    "read_study",
    "run_study",
    "study_progress",
]
