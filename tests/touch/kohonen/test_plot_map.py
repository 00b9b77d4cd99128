"""Pictures of a self-organising map show its neurons at their places, with the edges between neighbours."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import LineCollection

from jeit.touch.kohonen import MapTouch
from jeit.touch.plots.kohonen_map import plot_map

PLACES = np.stack(np.meshgrid(np.linspace(0, 0.03, 4), np.linspace(0, 0.02, 3)), axis=-1)


def test_neurons_without_a_place_are_left_out():
    places, values = PLACES.copy(), np.arange(12.0).reshape(3, 4)
    places[0, 0] = np.nan
    touch = MapTouch(np.array([0.01, 0.01]), 0.002, 1.0)
    ax = plot_map(places, values, touches=[touch], label="Share", title="Map")
    neurons, edges = None, None
    for collection in ax.collections:
        if isinstance(collection, LineCollection):
            edges = collection.get_segments()
        else:
            neurons = np.asarray(collection.get_offsets())
    assert edges is not None
    assert neurons is not None
    assert len(neurons) == 11
    # A grid of 3 × 4 neurons has 17 edges, of which two end at the corner without a place.
    assert sum(np.isfinite(edge).all() for edge in edges) == 15
    cross = next(line for line in ax.lines if line.get_marker() == "+")
    np.testing.assert_allclose(np.ravel(cross.get_xydata()), touch.place)
    assert ax.get_title() == "Map"
    plt.close(ax.figure)


def test_arrays_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match=r"\(R, C, 2\)"):
        plot_map(PLACES[0])
    with pytest.raises(ValueError, match="no neuron has one"):
        plot_map(np.full_like(PLACES, np.nan))
    with pytest.raises(ValueError, match="one for each neuron"):
        plot_map(PLACES, np.zeros((2, 2)))
