"""Pictures, with matplotlib: meshes, images, solids and surfaces in space, electrodes, sensitivity, taxels, layouts,
voltages, microphones, touches, contacts, self-organising maps, damage, gestures in time, depths.

Every function takes `ax`, makes a figure of its own where none is given, and returns the axes it drew on. Lengths are
in metres in the arguments and in millimetres in the pictures.
"""

from __future__ import annotations

from jeit.arguments.moved import tell_old_names as _tell_old_names
from jeit.plot.acoustic.localisation_error import plot_error_curve, plot_pairs
from jeit.plot.acoustic.loss_map import Marks, plot_loss_map
from jeit.plot.acoustic.receptive_fields import plot_receptive_fields
from jeit.plot.acoustic.track import plot_track
from jeit.plot.colour_scale import ColourScale
from jeit.plot.design.sensitivity_map import plot_sensitivity_histograms, plot_sensitivity_map
from jeit.plot.design.taxels import plot_taxel_areas, plot_taxels
from jeit.plot.design.travel import plot_travel
from jeit.plot.design.unrolled_skin import plot_unrolled
from jeit.plot.imaging.admittivity import plot_admittivity
from jeit.plot.imaging.figures_of_merit import plot_figures_of_merit
from jeit.plot.imaging.frames import plot_frames
from jeit.plot.imaging.hyperparameter import plot_choice
from jeit.plot.imaging.image import plot_image
from jeit.plot.imaging.mesh import plot_mesh
from jeit.plot.solid.camera import Camera
from jeit.plot.solid.curved_skin import plot_curved_skin
from jeit.plot.solid.interactive import view_solid
from jeit.plot.solid.isosurfaces import plot_isosurfaces
from jeit.plot.solid.overview import plot_solid
from jeit.plot.solid.shaded_surface import plot_surface
from jeit.plot.solid.slices import plot_slice, plot_slices
from jeit.plot.touch.contact_stages import plot_contact_stages
from jeit.plot.touch.contacts import plot_contacts
from jeit.plot.touch.depth_map import plot_depth_map, plot_losses
from jeit.plot.touch.health import plot_health
from jeit.plot.touch.health_course import plot_health_course
from jeit.plot.touch.heard import plot_heard
from jeit.plot.touch.kohonen_map import plot_map
from jeit.plot.touch.learning import (
    plot_confusion,
    plot_force_errors,
    plot_key_errors,
    plot_place_errors,
    plot_tried,
)
from jeit.plot.touch.timeline import plot_changes, plot_timeline, plot_touch_paths
from jeit.plot.touch.touches import plot_answers, plot_places

_tell_old_names(__name__)

__all__ = [
    "Camera",
    "ColourScale",
    "Marks",
    "plot_admittivity",
    "plot_answers",
    "plot_changes",
    "plot_choice",
    "plot_confusion",
    "plot_contact_stages",
    "plot_contacts",
    "plot_curved_skin",
    "plot_depth_map",
    "plot_error_curve",
    "plot_figures_of_merit",
    "plot_force_errors",
    "plot_frames",
    "plot_health",
    "plot_health_course",
    "plot_heard",
    "plot_image",
    "plot_isosurfaces",
    "plot_key_errors",
    "plot_loss_map",
    "plot_losses",
    "plot_map",
    "plot_mesh",
    "plot_pairs",
    "plot_place_errors",
    "plot_places",
    "plot_receptive_fields",
    "plot_sensitivity_histograms",
    "plot_sensitivity_map",
    "plot_slice",
    "plot_slices",
    "plot_solid",
    "plot_surface",
    "plot_taxel_areas",
    "plot_taxels",
    "plot_timeline",
    "plot_touch_paths",
    "plot_track",
    "plot_travel",
    "plot_tried",
    "plot_unrolled",
    "view_solid",
]
