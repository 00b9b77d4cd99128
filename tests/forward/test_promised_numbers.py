"""Numbers that docs/reference/versions.md promises within a major version: voltages to 1e-9, linear images to 1e-6.

The mesh is made here, so that no mesh generator takes part; the numbers are those of version 1.0.
"""

import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import Laplace, Noser, back_projection, one_step
from jeit.layout import ring
from jeit.mesh import Mesh, centroids
from jeit.protocol import adjacent

VOLTAGES = [
    -1.158370088181e-04,
    -9.255290395421e-05,
    -4.662305836452e-05,
    -3.887884650381e-05,
    -4.736975320005e-05,
    -9.529025572297e-05,
    -1.158489389855e-04,
    -5.902523497073e-05,
    -3.887884650381e-05,
    -5.842923013008e-05,
]
IMAGES = {
    "back_projection": [
        5.465751619e00,
        1.204160760e00,
        1.396157655e00,
        8.331717467e-01,
        3.301142167e00,
        -2.854234365e00,
        8.990545794e-01,
        2.387101000e00,
    ],
    "noser": [
        4.680523333e-03,
        1.313535569e-03,
        9.318308255e-03,
        4.733449032e-03,
        1.518655213e-02,
        -1.075183185e-02,
        5.839058764e-03,
        1.615391640e-03,
    ],
    "laplace": [
        9.140062890e-02,
        9.855830649e-02,
        1.417884288e-01,
        1.011628725e-01,
        1.816822274e-01,
        2.607512319e-02,
        1.286659215e-01,
        9.504527462e-02,
    ],
}


@pytest.fixture(scope="module")
def model():
    """Eight electrodes round a disk of five rings of nodes, 0.1 m in radius."""
    points, cells = [np.zeros((1, 2))], [(0, 1 + k, 1 + (k + 1) % 8) for k in range(8)]
    for row in range(1, 6):  # 8, 16, … nodes
        angles = 2 * np.pi * np.arange(8 * row) / (8 * row)
        points.append(0.02 * row * np.stack([np.cos(angles), np.sin(angles)], axis=1))
    for row in range(1, 5):
        first, next_first = 1 + 4 * row * (row - 1), 1 + 4 * row * (row + 1)
        for sector in range(8):
            inner = [first + (sector * row + k) % (8 * row) for k in range(row + 1)]
            outer = [next_first + (sector * (row + 1) + k) % (8 * (row + 1)) for k in range(row + 2)]
            cells += [(inner[k], outer[k], outer[k + 1]) for k in range(row + 1)]
            cells += [(inner[k], outer[k + 1], inner[k + 1]) for k in range(row)]
    mesh = Mesh.create(np.concatenate(points), np.array(cells))
    electrodes = BoundaryElectrodes(ring(0.1, 8), width=0.02, contact_impedance=0.01)
    return ForwardModel(mesh, electrodes, adjacent(8, current=1e-3))


def test_voltages(model):
    distance = np.linalg.norm(np.asarray(centroids(model.mesh)) - [0.04, 0.02], axis=1)
    voltages = model.voltages(np.where(distance < 0.03, 2.0, 1.0))
    np.testing.assert_allclose(voltages[::4], VOLTAGES, rtol=0, atol=1e-9 * np.abs(VOLTAGES).max())


@pytest.mark.parametrize("name", IMAGES)
def test_linear_images(model, name):
    made = {
        "back_projection": lambda: back_projection(model, 1.0),
        "noser": lambda: one_step(model, 1.0, prior=Noser(), hyperparameter=0.3),
        "laplace": lambda: one_step(model, 1.0, prior=Laplace(), hyperparameter=1e-3),
    }[name]()
    image = made.image(1e-3 * np.cos(np.arange(model.protocol.num_measurements)))
    np.testing.assert_allclose(image[::25], IMAGES[name], rtol=0, atol=1e-6 * np.abs(IMAGES[name]).max())
