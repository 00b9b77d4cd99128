"""Error bars of a solid imaged with total variation from two measurements."""

import numpy as np
import pytest

from jeit import image_difference
from jeit.data import Measurement
from jeit.electrodes import FacePatches
from jeit.electrodes.face_patches import body_mesh
from jeit.forward import ForwardModel
from jeit.imaging import ImagingSettings
from jeit.inverse import posterior
from jeit.mesh import Rectangle, Solid, centroids
from jeit.protocol import opposite

BOX, BATH = Solid(Rectangle(0.1, 0.14), 0.1), 0.2
SIDES = [(a, s * 0.07, z) for s in (-1, 1) for z in (0.03, 0.07) for a in (-0.025, 0.025)]
SIDES += [(s * 0.05, b, z) for s in (-1, 1) for z in (0.03, 0.07) for b in (-0.035, 0.035)]


@pytest.mark.slow
def test_a_solid_imaged_by_total_variation_has_error_bars():
    plates = FacePatches(np.array(SIDES), 0.03, 0.03, 1e-3)
    model = ForwardModel(body_mesh(BOX, plates, 1500), plates, opposite(16, current=1e-3))
    held = np.linalg.norm(np.asarray(centroids(model.mesh)) - [0.012, -0.025, 0.055], axis=1) < 0.022

    def measured(conductivity, seed):
        voltages = np.asarray(model.voltages(conductivity))
        voltages = voltages * (1 + 1e-4 * np.random.default_rng(seed).normal(size=voltages.shape))
        known = {"electrodes": plates, "domain": BOX, "name": str(seed)}
        return Measurement(voltages, np.ones(voltages.shape, bool), model.protocol, **known)

    frames = measured(BATH * np.where(held, 4.0, 1.0), 1), measured(BATH, 2)
    result = image_difference(*frames, ImagingSettings(method="total-variation", num_points=700))
    around = posterior(result.reconstruction)  # pyright: ignore[reportArgumentType]
    deviation, free = np.asarray(around.standard_deviation()), around.prior.variance(around.inversion.basis)
    relative = deviation / np.asarray(result.reconstruction.conductivity)  # pyright: ignore[reportAttributeAccessIssue]
    assert deviation.shape == (result.mesh.num_cells,)
    assert (np.isfinite(deviation) & (relative > 0) & (relative < 0.5 * np.sqrt(free))).all()
    # The data determine the bath as a whole much better than a single cell.
    mean, spread = around.region(np.ones(result.mesh.num_cells, bool))
    assert spread / mean < 0.2 * np.median(relative)
