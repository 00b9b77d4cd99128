"""jeit as a contestant at every task of the case `forward`, through its public interface."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.problems.disk import GAUSS_NEWTON, STEPS
from jeit.electrodes import BoundaryElectrodes, NodeElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import Imager, Noser, Parametrisation, one_step
from jeit.inverse.nonlinear import GaussNewton
from jeit.mesh import Mesh
from jeit.protocol import Protocol


@eqx.filter_jit
def _voltages_of_many(model, conductivities):
    return jax.vmap(model.voltages)(conductivities)


@eqx.filter_jit
def _voltages_and_jacobians_of_many(model, conductivities):
    return jax.vmap(model.voltages_and_jacobian)(conductivities)


class JeitContestant:
    """`tasks` maps a task's name to a function of the number of the repeat, which selects the conductivity or frame."""

    def __init__(self, problem: dict[str, np.ndarray]):
        mesh = Mesh.create(problem["points"], problem["cells"])
        if "nodes" in problem:
            electrodes = NodeElectrodes(problem["nodes"])
        else:
            electrodes = BoundaryElectrodes(problem["position"], problem["width"], problem["contact_impedance"])
        protocol = Protocol(
            problem["drive"], problem["measurement"], problem["drive_index"], problem["measurement_index"]
        )
        model = ForwardModel(mesh, electrodes, protocol, solver="cholesky")  # called repeatedly: compiled
        conductivities = jnp.asarray(problem["conductivities"])
        each, count = list(conductivities), len(conductivities)
        frames = jnp.asarray(problem["frames"])
        each_frame = list(frames[:64])
        background = jnp.full(mesh.num_cells, problem["background"])
        ready = jax.block_until_ready
        self._model, self._background, self._reconstruction = model, background, None
        self.description = f"JAX {jax.__version__}: {type(model.system.solver).__name__}"
        self.tasks = {
            "voltages": lambda k: ready(model.voltages(each[k % count])),
            "voltages and Jacobian": lambda k: ready(model.voltages_and_jacobian(each[k % count])),
            "homogeneous": lambda _: ready(model.voltages(background)),
            "64 conductivities": lambda _: ready(_voltages_of_many(model, conductivities)),
            "64 Jacobians": lambda _: ready(_voltages_and_jacobians_of_many(model, conductivities)),
            "reconstruction matrix": lambda _: ready(self.reconstruction.matrix),
            "linear image": lambda k: ready(self.reconstruction.image(each_frame[k % 64])),
            "1000 linear images": lambda _: ready(self.reconstruction.image(frames)),
        }

        if "measured" in problem:
            measured, imager = list(jnp.asarray(problem["measured"])), self._imager(problem)
            every, start = imager.weighing(imager.mask), imager.start
            self.tasks[GAUSS_NEWTON] = lambda k: ready(imager.estimate(measured[k % count], every, start).conductivity)

    def voltages(self, conductivity) -> np.ndarray:
        """Voltages (channels,) in volts for a conductivity (cells,) in siemens."""
        return np.asarray(self._model.voltages(jnp.asarray(conductivity)))

    def _imager(self, problem):
        """Imager of log σ with the NOSER prior and all basis functions, so that opponents can minimise the same
        function."""
        return Imager.create(
            self._model,
            self._background,
            prior=Noser(),
            hyperparameter=float(problem["hyperparameter"]),
            noise=problem["noise"],
            solver=GaussNewton(max_steps=STEPS, rtol=0.0),
            parametrisation=Parametrisation(informative=0.0),
        )

    @property
    def reconstruction(self):
        """The one-step reconstruction, computed on first use."""
        if self._reconstruction is None:
            self._reconstruction = one_step(self._model, self._background, prior=Noser(), hyperparameter=1e-2)
        return self._reconstruction
