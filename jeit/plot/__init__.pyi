from .colours import ColourScale
from .imaging.image import plot_admittivity, plot_image, plot_mesh
from .imaging.judgement import plot_choice, plot_figures_of_merit
from .imaging.series import plot_frames
from .solid.interactive import view_solid
from .solid.isosurfaces import plot_isosurfaces
from .solid.scene import Camera
from .solid.slices import plot_slice, plot_slices, plot_solid
from .solid.surfaces import plot_curved_skin, plot_surface

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
