"""The gradient of a voltage with respect to electrode positions, checked by moving an electrode; see
`design_gradient.png`. Takes 7 s and 0.6 GB on two cores."""

import equinox as eqx
import jax
import jax.numpy as jnp

from jeit import BoundaryElectrodes, Disk, ForwardModel, adjacent, ring
from jeit.plot import plot_mesh


def main() -> float:
    mesh = Disk(0.05).mesh(num_points=400)
    model = ForwardModel(mesh, BoundaryElectrodes(ring(0.05, 8), width=0.01, contact_impedance=0.1), adjacent(8))

    def first_voltage(position):
        moved = eqx.tree_at(lambda m: m.electrodes.position, model, position)
        return moved.voltages(1e-3)[0]

    position = model.electrodes.position
    gradient = jax.grad(first_voltage)(position)
    step = 1e-6 * jnp.zeros_like(position).at[0, 0].set(1.0)  # one micrometre, electrode 1, along x
    difference = (first_voltage(position + step) - first_voltage(position - step)) / 2e-6

    ax = plot_mesh(mesh, model.electrodes, title="Where to move electrodes for a greater first voltage")
    arrows = 0.012 * gradient / jnp.linalg.norm(gradient, axis=1).max()  # metres; the longest arrow is 12 mm
    ax.quiver(*position.T, *arrows.T, angles="xy", scale_units="xy", scale=1, color="#157f3b", width=0.008, zorder=5)
    ax.figure.savefig("design_gradient.png")
    return float(abs(gradient[0, 0] / difference - 1))


if __name__ == "__main__":
    error = main()
    print(f"gradient against central difference: {error:.1e}")
    assert error < 1e-5
