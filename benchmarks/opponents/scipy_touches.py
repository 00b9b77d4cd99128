"""Plain SciPy implementation of the voltages of a touched skin: the conductivity of the touched cells changes, and the
whole system is solved anew.

For each touch, the changes of element matrices are added to the sparse matrix A; then follow one SuperLU factorisation
(minimum degree of Aᵀ + A, symmetric mode, no pivoting off the diagonal), one solution for all electrodes, and the
voltages of all electrode pairs.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu


class PlainTouches:
    """Voltages of a touched skin, for one forward `model` of jeit (of which mesh, contact integrals and protocol are
    used) and a conductivity (cells,)."""

    def __init__(self, model, conductivity: np.ndarray):
        from jeit.forward.system import stiffness

        mesh = model.mesh
        contact = model.electrodes.contact(mesh)
        operator, load = model.system.grounded_system(mesh, conductivity, model.electrodes, contact)
        self.load = np.asarray(load)
        self.cells = np.asarray(mesh.cells)
        packed = np.asarray(stiffness(mesh, conductivity))
        rows, columns = np.tril_indices(self.cells.shape[1])
        self.element = np.zeros((mesh.num_cells, self.cells.shape[1], self.cells.shape[1]))
        self.element[:, rows, columns] = self.element[:, columns, rows] = packed.T
        self.matrix = sparse.csc_matrix(operator.pattern.to_scipy(np.asarray(operator.values)))
        self.protocol = model.protocol
        self.drive, self.measurement = np.asarray(self.protocol.drive), np.asarray(self.protocol.measurement)
        self.before = self.voltages(self.matrix)

    def voltages(self, matrix) -> np.ndarray:
        """Voltages of the protocol's channels, from the sum `matrix` of stiffness and contact matrices."""
        factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        product = self.load.T @ factor.solve(self.load)
        impedance = np.linalg.inv((np.diag(self.load.sum(axis=0)) - product)[:-1, :-1])  # against the ground
        table = self.measurement @ impedance @ self.drive.T
        return table[self.protocol.measurement_index, self.protocol.drive_index]

    def change(self, cells: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Change of the voltages when the conductivity of `cells` (indices) becomes (1 + change) times its value."""
        kept = change != 0
        cells, change = cells[kept], np.maximum(change[kept], 1e-9 - 1.0)
        nodes = self.cells[cells]
        added = self.element[cells] * change[:, None, None]
        rows, columns = np.broadcast_arrays(nodes[:, :, None], nodes[:, None, :])
        update = sparse.csc_matrix((added.ravel(), (rows.ravel(), columns.ravel())), shape=self.matrix.shape)
        return self.voltages((self.matrix + update).tocsc()) - self.before
