"""Plot functions refuse arguments of another type before any axes are made."""

import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot

from jeit.acoustic.plots import plot_error_curve, plot_loss_map, plot_receptive_fields, plot_track
from jeit.design.plots import (
    plot_sensitivity_histograms,
    plot_sensitivity_map,
    plot_taxel_areas,
    plot_taxels,
    plot_travel,
)
from jeit.mesh import Disk, Rectangle
from jeit.plot import ColourScale, plot_choice, plot_figures_of_merit, plot_image, plot_mesh
from jeit.plot.imaging.image import plot_raster

matplotlib.use("Agg")
MESH = Disk(0.05).mesh(num_points=100)
ONES = np.ones(MESH.num_cells)
MAP = np.ones((4, 4))
SKIN = Rectangle(0.2, 0.2)


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda: plot_image(MESH, ONES, scale="viridis"), r"scale must be a ColourScale, such as .*; it is 'viridis'"),
        (lambda: plot_image(MESH, ONES, scale=1e-3), r"scale must be .*; it is 0\.001"),
        (lambda: plot_image(MESH, ONES, scale=ColourScale), "the class ColourScale itself"),
        (lambda: plot_raster(MAP, (0, 1, 0, 1), scale=None), "scale must be .*; it is None"),
        (lambda: plot_image(ONES, MESH), "mesh must be a Mesh, such as .*; it is an array"),
        (lambda: plot_image(MESH, ONES, 16), "electrodes must be .*; it is 16"),
        (lambda: plot_raster(MAP, (0, 1, 0, 1), mesh=SKIN), "mesh must be a Mesh, .*; it is a Rectangle"),
        (lambda: plot_mesh(Disk(0.05)), "mesh must be a Mesh, .*; it is a Disk"),
        (lambda: ColourScale(limit="x"), "limit must be finite.*; it is 'x'"),
        (lambda: plot_loss_map(MAP, SKIN, marks=(0.1, 0.1)), "marks must be MapMarks, such as .*; it is a tuple"),
        (lambda: plot_loss_map(MAP, SKIN, marks=np.zeros(2)), "marks must be MapMarks"),
        (lambda: plot_loss_map(MAP, SKIN, method="liklihood"), r"did you mean 'likelihood'\?"),
        (lambda: plot_track(MAP, MAP, SKIN), "track must be a Track"),
        (
            lambda: plot_receptive_fields("calibration.json"),
            "fit must be a CalibrationFit, .*; it is 'calibration.json'",
        ),
        (lambda: plot_error_curve([1.0], [0.1]), "errors must be {name: errors}; it is a list"),
        (lambda: plot_error_curve([1.0], {"a": [0.1]}, statistic="medain"), r"did you mean 'median'\?"),
        (lambda: plot_choice("gcv"), "choices must be a Choice, .*; it is 'gcv'"),
        (lambda: plot_choice({"gcv": 1}), "choices must be a Choice, .*; it is 1"),
        (lambda: plot_figures_of_merit([MAP]), "figures must be {name: figures}, .*; it is a list"),
        (lambda: plot_sensitivity_map(MAP), "theta must be a SensitivityMap"),
        (lambda: plot_sensitivity_histograms([MAP]), "maps must be {name: map}; it is a list"),
        (lambda: plot_sensitivity_histograms({"a": MAP}), r"maps\['a'\] must be a SensitivityMap"),
        (lambda: plot_taxels(MAP), "taxels must be Taxels, as of find_taxels"),
        (lambda: plot_taxels(MAP, colour="aera"), r"did you mean 'area'\?"),
        (lambda: plot_taxel_areas(MAP), "taxels must be Taxels"),
        (lambda: plot_travel(MAP), "optimisation must be an Optimisation"),
    ],
)
def test_arguments_of_another_type_are_refused(draw, message):
    pyplot.close("all")
    with pytest.raises(ValueError, match=message):
        draw()
    assert not pyplot.get_fignums()
