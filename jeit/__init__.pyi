from . import (
    acoustic,
    data,
    design,
    electrodes,
    forward,
    image,
    imaging,
    inverse,
    layout,
    mesh,
    plot,
    protocol,
    report,
    touch,
)
from .data import read
from .electrodes import BoundaryElectrodes, body_mesh
from .forward import ForwardModel
from .image import find_inclusions
from .imaging import image_difference
from .inverse import calibrate, one_step, reconstruct
from .layout import ring
from .mesh import Disk, Rectangle
from .plot import plot_image
from .protocol import adjacent

__version__: str

__all__ = [
    "BoundaryElectrodes",
    "Disk",
    "ForwardModel",
    "Rectangle",
    "acoustic",
    "adjacent",
    "body_mesh",
    "calibrate",
    "data",
    "design",
    "electrodes",
    "find_inclusions",
    "forward",
    "image",
    "image_difference",
    "imaging",
    "inverse",
    "layout",
    "mesh",
    "one_step",
    "plot",
    "plot_image",
    "protocol",
    "read",
    "reconstruct",
    "report",
    "ring",
    "touch",
]
