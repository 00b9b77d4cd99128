"""pyEIT as a contestant, on the same mesh, protocol and conductivities as jeit, in a separate environment.

pyEIT has point electrodes only, one node each, so it is compared with jeit's point electrode model. pyEIT drives 1 A,
and its Jacobian is -∂v/∂σ. `in_si` converts voltages and Jacobian for the comparison, outside the timed part.
"""

from __future__ import annotations

from importlib.metadata import version

import numpy as np
from pyeit.eit.fem import EITForward
from pyeit.eit.jac import JAC
from pyeit.eit.protocol import PyEITProtocol
from pyeit.mesh import PyEITMesh

from benchmarks.problems.disk import GAUSS_NEWTON, STEPS

# Of fifteen tested settings (pyEIT's three methods, weights from 1e-4 to 1e4, decreasing and constant, including the
# setting of pyEIT's example), this setting gives the images closest to the truth. Its misfit is within 5 % of the
# lowest misfit.
SETTING = {"method": "kotre", "p": 0.5, "lamb": 0.1}


class PyeitContestant:
    """`tasks` maps a task's name to a function of the number of the repeat, which selects the conductivity."""

    def __init__(self, problem: dict[str, np.ndarray]):
        drive, measurement = problem["drive"], problem["measurement"]
        drive_index, measurement_index = problem["drive_index"], problem["measurement_index"]
        num_drives = len(drive)
        drive_pairs = np.stack([drive.argmax(axis=1), drive.argmin(axis=1)], axis=1)
        pairs = np.stack([measurement.argmax(axis=1), measurement.argmin(axis=1)], axis=1)
        # pyEIT requires equally many channels for every drive, ordered drive by drive, as in adjacent protocols.
        if not np.array_equal(drive_index, np.repeat(np.arange(num_drives), len(drive_index) // num_drives)):
            raise ValueError("pyEIT needs channels drive by drive, equally many for each.")
        current = drive.max()
        protocol = PyEITProtocol(
            drive_pairs,
            pairs[measurement_index].reshape(num_drives, -1, 2),
            np.ones(len(drive_index), bool),
        )
        mesh = PyEITMesh(problem["points"], problem["cells"], 1.0, problem["nodes"], len(problem["points"]) // 2)
        forward = EITForward(mesh, protocol)
        conductivities, count = problem["conductivities"], len(problem["conductivities"])
        homogeneous = np.full(len(problem["cells"]), float(problem["background"]))

        def voltages_and_jacobian(k):
            jacobian, voltages = forward.compute_jac(conductivities[k % count])
            return voltages, jacobian

        self.description = f"pyEIT {version('pyeit')}, NumPy {np.__version__}, SciPy {version('scipy')}"
        self.current = current
        self.tasks = {
            "voltages": lambda k: forward.solve_eit(conductivities[k % count]),
            "homogeneous": lambda _: forward.solve_eit(homogeneous),
            "voltages and Jacobian": voltages_and_jacobian,
        }
        if "measured" in problem:
            measured, solver = problem["measured"] / current, JAC(mesh, protocol)
            # `setup` would invert a matrix for linear images, which `gn` does not use: only the parameters are needed.
            solver.params, solver.is_ready = SETTING, True
            self.description += f", {SETTING}"
            self.tasks[GAUSS_NEWTON] = lambda k: solver.gn(
                measured[k % count], x0=homogeneous, maxiter=STEPS, gtol=0.0, **SETTING
            )

    def in_si(self, task, results):
        """Convert results to volts, and Jacobians to volts per siemens, at the problem's current. Images are already in
        siemens."""
        if task == GAUSS_NEWTON:
            return results
        if isinstance(results, tuple):
            return self.current * results[0], -self.current * results[1]
        return self.current * results
