"""Learn the weight and the correlation length of a prior from examples, by the gradient of the image error; see
`learn_a_prior.png`. Takes 7 s and 0.5 GB on two cores."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import minimize

from jeit import BoundaryElectrodes, Disk, ForwardModel, adjacent, one_step, plot_image, ring
from jeit.inverse import Gaussian, choose_hyperparameter
from jeit.inverse.prior.matern import smooth_prior
from jeit.mesh import centroids, measures
from jeit.plot import ColourScale

RADIUS, BACKGROUND = 0.1, 1e-3  # metres, siemens
RANDOM = np.random.default_rng(0)


def bodies(number: int) -> np.ndarray:
    """Two discs per body (number, 2, 4): x, y and radius in metres, and conductivity relative to the background, 0.5 or
    1.5."""
    place = RADIUS * (RANDOM.random((number, 2, 1)) * 0.75) ** 0.5 * 0.9
    angle = 2 * np.pi * RANDOM.random((number, 2, 1))
    radius = RADIUS * (0.12 + 0.13 * RANDOM.random((number, 2, 1)))
    factor = np.where(RANDOM.random((number, 2, 1)) < 0.5, 0.5, 1.5)
    return np.concatenate([place * np.cos(angle), place * np.sin(angle), radius, factor], axis=2)


def conductivities(mesh, discs: np.ndarray) -> np.ndarray:
    """Conductivities (number, m) in siemens."""
    centre, values = np.asarray(centroids(mesh)), np.full((len(discs), mesh.num_cells), BACKGROUND)
    for body, value in zip(discs, values, strict=True):
        for x, y, radius, factor in body:
            value[np.hypot(*(centre - [x, y]).T) < radius] = factor * BACKGROUND
    return values


def main() -> float:
    electrodes = BoundaryElectrodes(ring(RADIUS, 16), width=0.012, contact_impedance=1e-3)
    fine = ForwardModel(Disk(RADIUS).mesh(num_points=2500), electrodes, adjacent(16, current=1e-3))
    model = ForwardModel(Disk(RADIUS).mesh(num_points=700), electrodes, adjacent(16, current=1e-3))
    discs = bodies(64)
    voltages = np.stack([fine.voltages(one) for one in conductivities(fine.mesh, discs)])
    empty = np.asarray(fine.voltages(BACKGROUND))
    noise: Any = 2e-3 * np.abs(empty)
    changes: Any = voltages - empty + noise * RANDOM.normal(size=voltages.shape)
    truth, area = conductivities(model.mesh, discs) - BACKGROUND, np.asarray(measures(model.mesh))
    learnt, held_out = slice(0, 32), slice(32, None)

    def images(logarithms, which):
        weight, length = jnp.exp(logarithms)
        linear = one_step(model, BACKGROUND, prior=Gaussian(length), hyperparameter=weight, noise=noise)
        return linear.image(changes[which])

    def error(logarithms, which):
        """Root mean square of the image error, relative to that of the truth."""
        missed = (images(logarithms, which) - truth[which]) ** 2 @ area
        return jnp.sqrt(missed.sum() / (truth[which] ** 2 @ area).sum())

    default = smooth_prior(2 * RADIUS)
    by_rule = choose_hyperparameter(model, BACKGROUND, prior=default, noise=noise).hyperparameter
    start = np.log([float(by_rule), default.length])
    slope = jax.jit(jax.value_and_grad(lambda logarithms: error(logarithms, learnt)))
    found = minimize(lambda logarithms: [np.asarray(part, float) for part in slope(logarithms)], start, jac=True)
    before, after = float(error(start, held_out)), float(error(found.x, held_out))
    print(
        f"{found.nfev} gradients: λ from {np.exp(start[0]):.3g} to {np.exp(found.x[0]):.3g}, correlation length ",
        end="",
    )
    print(f"from {1e3 * np.exp(start[1]):.1f} to {1e3 * np.exp(found.x[1]):.1f} mm")
    print(f"error of {len(discs) // 2} bodies held out: {before:.3f} before, {after:.3f} after")

    shown = slice(32, 34)
    columns = {
        "truth": truth[shown],
        f"default prior\nerror {before:.2f}": images(start, shown),
        f"learnt prior\nerror {after:.2f}": images(found.x, shown),
    }
    figure = Figure(figsize=(9, 6), layout="constrained")
    axes = figure.subplots(2, 3)
    for column, (title, pictures) in enumerate(columns.items()):
        scale = ColourScale(limit=0.5 * BACKGROUND, bar=column == len(columns) - 1)
        for row, picture in enumerate(np.asarray(pictures)):
            title = title if row == 0 else f"body {row + 1}"
            plot_image(model.mesh, picture, ax=axes[row, column], title=title, scale=scale)
    figure.savefig("learn_a_prior.png")
    return after / before


if __name__ == "__main__":
    ratio = main()
    assert ratio < 0.97
