"""A user-defined outline, in one class, works wherever the built-in ones do."""

import xml.etree.ElementTree as ElementTree

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest

from jeit.acoustic.surface import make_surface
from jeit.data import Measurement, impossible_signs, write_table
from jeit.design.plots.travel import outline_path
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.imaging.calibration import imaging_mesh
from jeit.layout import Layout, perimeter, quasi_uniform, read_layout, write_layout
from jeit.mesh import Domain, Rectangle, quality
from jeit.mesh.generate.curve import create_smooth_curve
from jeit.mesh.generate.unstructured import MeshTarget, mesh_within
from jeit.plot import plot_mesh
from jeit.protocol import adjacent
from jeit.report.folder import describe_domain
from jeit_solvers.engines import namespace

matplotlib.use("Agg")


class Stadium(Domain):
    """All points within `radius` of the line from (-half, 0) to (half, 0), metres; arc length from the lower right."""

    half: float
    radius: float

    @property
    def area(self):
        return 4 * self.half * self.radius + np.pi * self.radius**2

    @property
    def perimeter(self):
        return 4 * self.half + 2 * np.pi * self.radius

    @property
    def extent(self):
        return (-self.half - self.radius, self.half + self.radius, -self.radius, self.radius)

    def boundary(self, arc_length):
        xp = namespace(arc_length)
        side, turn = 2 * self.half, np.pi * self.radius
        arc = xp.mod(xp.asarray(arc_length), self.perimeter)
        along = xp.clip(arc - turn, 0, side) - xp.clip(arc - 2 * turn - side, 0, side)
        angle = (xp.clip(arc, 0, turn) + xp.clip(arc - turn - side, 0, turn)) / self.radius - np.pi / 2
        middle = xp.stack([self.half - along, xp.zeros_like(along)], axis=-1)
        return middle + self.radius * xp.stack([xp.cos(angle), xp.sin(angle)], axis=-1)

    def loops(self, num_chords=120):
        return (self.boundary(self.perimeter * np.arange(num_chords) / num_chords),)

    def contains(self, points):
        xp = namespace(points)
        return xp.linalg.norm(self._from_line(points), axis=-1) <= self.radius

    def signed_distance(self, points):
        xp = namespace(points)
        return self.radius - xp.linalg.norm(self._from_line(points), axis=-1)

    def nearest(self, points):
        xp = namespace(points)
        offset = self._from_line(points)
        distance = xp.linalg.norm(offset, axis=-1, keepdims=True)
        return xp.asarray(points) - offset * xp.maximum(0, 1 - self.radius / distance)

    def describe(self):
        return {"shape": "stadium", "half": self.half, "radius": self.radius}

    def draw(self, pen):
        pen.loop(np.asarray(self.loops()[0]))

    def mesh(self, num_points=None, cell_size=None, refine=None):
        edge = create_smooth_curve(self.perimeter, lambda arc: np.asarray(self.boundary(arc)))
        return mesh_within([edge], self.area, MeshTarget.create(num_points, cell_size), refine)

    def _from_line(self, points):
        xp = namespace(points)
        points = xp.asarray(points)
        return points - xp.stack([xp.clip(points[..., 0], -self.half, self.half), 0 * points[..., 1]], axis=-1)


STADIUM = Stadium(0.05, 0.04)


def test_its_mesh_has_its_area_and_good_cells():
    mesh = STADIUM.mesh(num_points=600)
    corners = np.asarray(mesh.points)[np.asarray(mesh.cells)]
    area = np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 2
    # The mesh is inscribed with about 75 nodes on its edge: the area is smaller by 2/3 π²/75² of the round part.
    assert area == pytest.approx(STADIUM.area, rel=2e-3)
    assert mesh.num_points == pytest.approx(600, rel=0.06)
    assert quality(mesh).smallest_angle.min() >= 25


def test_voltages_of_electrodes_on_its_edge(tmp_path):
    electrodes = BoundaryElectrodes(perimeter(STADIUM, 8), 0.01, 1e-3)
    mesh = imaging_mesh(STADIUM, electrodes, 900)
    model = ForwardModel(mesh, electrodes, adjacent(8, current=1e-3))
    voltages = np.asarray(model.voltages(1.0))
    # Half a turn about its middle maps every electrode to the fourth from it, and so each drive to the fourth.
    turned = voltages.reshape(8, -1)[[4, 5, 6, 7, 0, 1, 2, 3]].ravel()
    np.testing.assert_allclose(voltages, turned, rtol=0.02, atol=0.002 * np.abs(voltages).max())
    measured = Measurement(
        voltages[None], np.ones((1, len(voltages)), bool), model.protocol, electrodes=electrodes, domain=STADIUM
    )
    assert impossible_signs(measured) == 0
    with pytest.raises(ValueError, match="write_table: a description cannot say"):
        write_table(measured, tmp_path / "table.npz")
    axes = plot_mesh(mesh, electrodes)
    assert len(axes.texts) >= 8
    plt.close(axes.figure)


def test_its_description_and_drawing():
    assert describe_domain(STADIUM) == {"shape": "stadium", "half": 0.05, "radius": 0.04, "unit": "m"}
    path = outline_path(STADIUM)
    assert path.contains_point((0.085, 0.0))
    assert not path.contains_point((0.085, 0.035))
    np.testing.assert_allclose(make_surface(STADIUM).outline.area, STADIUM.area, rtol=1e-3)


@pytest.mark.parametrize("ending", ["svg", "dxf"])
def test_a_layout_on_it_is_written_and_read(ending, tmp_path):
    layout = Layout(quasi_uniform(STADIUM, 6, margin=0.01), 0.005, outline=STADIUM)
    path = tmp_path / f"skin.{ending}"
    if ending == "dxf":
        pytest.importorskip("ezdxf")
    write_layout(layout, path)
    drawn = read_layout(path)
    np.testing.assert_allclose(drawn.centres, layout.centres, atol=1e-8)
    np.testing.assert_allclose(drawn.outline.area, STADIUM.area, rtol=1e-3)
    if ending == "svg":
        assert len(ElementTree.parse(path).findall(".//{*}g[@id='OUTLINE']/{*}polygon")) == 1


def test_a_layout_outside_of_it_is_refused():
    corner = [[0.085, 0.035], [0.0, 0.0]]
    assert Layout(corner, 0.005, outline=Rectangle(0.18, 0.08)).num_electrodes == 2
    with pytest.raises(ValueError, match="beyond the outline"):
        Layout(corner, 0.005, outline=STADIUM)
