from .calibration import calibrated_model, imaging_mesh
from .describe import find_description
from .difference import ImagedDifference, image_difference
from .hyperparameter_rules import ComparedRules, RuleOutcome, compare_on_data
from .method import CONTACTS, METHODS, ImagingSettings
from .preparation import PreparedDifference, prepare_difference, select_frames
from .sequence import ImagedFrequencies, ImagedSequence, frequency_weight, image_frequencies, image_sequence
from .stream_preparation import StreamSettings, frames_of, prepare_imager

__all__ = [
    "CONTACTS",
    "METHODS",
    "ComparedRules",
    "ImagedDifference",
    "ImagedFrequencies",
    "ImagedSequence",
    "ImagingSettings",
    "PreparedDifference",
    "RuleOutcome",
    "StreamSettings",
    "calibrated_model",
    "compare_on_data",
    "find_description",
    "frames_of",
    "frequency_weight",
    "image_difference",
    "image_frequencies",
    "image_sequence",
    "imaging_mesh",
    "prepare_difference",
    "prepare_imager",
    "select_frames",
]
