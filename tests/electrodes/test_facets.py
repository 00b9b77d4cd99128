"""Electrodes made of whole boundary facets: which facets they cover, by index, tag and node, and faults are refused.
Of electrodes on faces, which appear undistorted from above."""

import jax
import numpy as np
import pytest

from jeit.electrodes import FaceDiscs, FacePatches, FacetElectrodes, SheetDiscs, electrodes_from_nodes, plates
from jeit.mesh import Rectangle, box

SHEET = Rectangle(0.02, 0.01).mesh(cell_size=0.004)


class Pen:
    def __init__(self):
        self.drawn = []

    def lines(self, lines, middle):
        self.drawn.append((np.array(lines), middle))

    def disc(self, position, radius):
        self.drawn.append("disc")

    def rectangle(self, position, width, height):
        self.drawn.append("rectangle")

    def dot(self, position):
        self.drawn.append("dot")


def test_tags_nodes_and_indices_give_the_same_electrodes():
    by_tag = plates(SHEET, ["left", "right"], 0.01)
    indices = [np.asarray(SHEET.tags[side]) for side in ("left", "right")]
    by_node = electrodes_from_nodes(SHEET, [np.asarray(SHEET.facets)[one].ravel() for one in indices], 0.01)
    by_index = FacetElectrodes(SHEET, indices, 0.01)
    np.testing.assert_array_equal(by_tag.covers, by_node.covers)
    np.testing.assert_array_equal(by_tag.covers, by_index.covers)
    assert by_tag.geometry() == {}
    np.testing.assert_array_equal(by_tag.with_contact_impedance(0.02).contact_impedance, [0.02, 0.02])
    pen = Pen()
    by_tag.draw(SHEET, pen)  # pyright: ignore[reportArgumentType]
    (left, left_middle), (right, right_middle) = pen.drawn
    assert np.ptp(left[..., 0]) == np.ptp(right[..., 0]) == 0
    np.testing.assert_allclose(right_middle - left_middle, [0.02, 0], atol=1e-12)


def test_electrodes_on_walls_are_drawn_as_dots():
    """Seen from above, only those in a sheet and on horizontal faces have their shape."""
    solid, places = box(0.1, 0.1, 0.05, num_points=60), [[0.0, 0.0, 0.05], [0.0, 0.0, 0.0], [0.05, 0.0, 0.025]]
    for electrodes, mesh, drawn in (
        (SheetDiscs([[0.0, 0.0]], 2e-3, 0.01), SHEET, ["disc"]),
        (FaceDiscs(places, 0.01, 0.01), solid, ["disc", "disc", "dot"]),
        (FacePatches(np.array(places), 0.01, 0.02, 0.01), solid, ["rectangle", "rectangle", "dot"]),
    ):
        pen = Pen()
        electrodes.draw(mesh, pen)  # pyright: ignore[reportArgumentType]
        assert pen.drawn == drawn


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FacetElectrodes(SHEET, [], 0.01), "facets is empty"),
        (lambda: FacetElectrodes(SHEET, [[0], []], 0.01), "electrode 2 has no facets"),
        (lambda: FacetElectrodes(SHEET, [[0], [1.5]], 0.01), "give integer facet indices"),
        (lambda: FacetElectrodes(SHEET, [[0], [10_000]], 0.01), "names facet 10000, and the mesh has"),
        (lambda: FacetElectrodes(SHEET, [[0, 1], [1, 2]], 0.01), "Electrodes 1 and 2 overlap: both cover .* facet 1"),
        (lambda: FacetElectrodes(SHEET, [[0], [1]], -1.0), "contact_impedance"),
        (lambda: plates(SHEET, ["lid"], 0.01), "no facets tagged 'lid'; its tags are: .*left"),
        (lambda: electrodes_from_nodes(SHEET, [[0]], 0.01), "the 1 nodes of electrode 1 span no boundary facet"),
        (lambda: jax.jit(lambda mesh: electrodes_from_nodes(mesh, [[0, 1]], 1.0).covers)(SHEET), "being traced"),
        (lambda: FacetElectrodes(SHEET, [[0], [1]], 0.01).check(Rectangle(0.02, 0.01).mesh(cell_size=0.002)), "again"),
    ],
)
def test_faults_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
