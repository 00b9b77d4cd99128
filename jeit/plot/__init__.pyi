from .colour_scale import ColourScale
from .imaging.admittivity import plot_admittivity
from .imaging.figures_of_merit import plot_figures_of_merit
from .imaging.frames import plot_frames
from .imaging.hyperparameter import plot_choice
from .imaging.image import plot_image
from .imaging.mesh import plot_mesh
from .solid.camera import Camera
from .solid.curved_skin import plot_curved_skin
from .solid.interactive import view_solid
from .solid.isosurfaces import plot_isosurfaces
from .solid.overview import plot_solid
from .solid.shaded_surface import plot_surface
from .solid.slices import plot_slice, plot_slices

__all__ = [
    "Camera",
    "ColourScale",
    "plot_admittivity",
    "plot_choice",
    "plot_curved_skin",
    "plot_figures_of_merit",
    "plot_frames",
    "plot_image",
    "plot_isosurfaces",
    "plot_mesh",
    "plot_slice",
    "plot_slices",
    "plot_solid",
    "plot_surface",
    "view_solid",
]
