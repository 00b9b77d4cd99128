from .hyperparameter_rules import draw_choice, report_choice, report_measurement, write_choice
from .image import draw_image, report_image, write_image
from .saved_image import SavedImage, read_image, write_views
from .series import write_film, write_series
from .stream import write_stream
from .volume_files import write_vtk_series, write_vtu, write_xdmf

__all__ = [
    "SavedImage",
    "draw_choice",
    "draw_image",
    "read_image",
    "report_choice",
    "report_image",
    "report_measurement",
    "write_choice",
    "write_film",
    "write_image",
    "write_series",
    "write_stream",
    "write_views",
    "write_vtk_series",
    "write_vtu",
    "write_xdmf",
]
