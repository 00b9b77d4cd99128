"""Pictures, with matplotlib: meshes, images, electrodes, sensitivity, taxels, layouts, voltages, microphones, touches.

Every function takes `ax`, makes a figure of its own where none is given, and returns the axes it drew on. Lengths are
in metres in the arguments and in millimetres in the pictures.
"""

from jeit.plot.acoustic.localisation_error import plot_error_curve as plot_error_curve
from jeit.plot.acoustic.localisation_error import plot_pairs as plot_pairs
from jeit.plot.acoustic.loss_map import Marks as Marks
from jeit.plot.acoustic.loss_map import plot_loss_map as plot_loss_map
from jeit.plot.acoustic.receptive_fields import plot_receptive_fields as plot_receptive_fields
from jeit.plot.acoustic.track import plot_track as plot_track
from jeit.plot.colour_scale import ColourScale as ColourScale
from jeit.plot.design.sensitivity_map import plot_sensitivity_histograms as plot_sensitivity_histograms
from jeit.plot.design.sensitivity_map import plot_sensitivity_map as plot_sensitivity_map
from jeit.plot.design.taxels import plot_taxel_areas as plot_taxel_areas
from jeit.plot.design.taxels import plot_taxels as plot_taxels
from jeit.plot.design.travel import plot_travel as plot_travel
from jeit.plot.imaging.figures_of_merit import plot_figures_of_merit as plot_figures_of_merit
from jeit.plot.imaging.hyperparameter import plot_choice as plot_choice
from jeit.plot.imaging.image import plot_image as plot_image
from jeit.plot.imaging.mesh import plot_mesh as plot_mesh
