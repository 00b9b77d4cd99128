"""Baseline opponent written with SciPy alone: complete electrode model, SuperLU, Jacobian by products of fields.

Everything that does not depend on the conductivity is done once, in the constructor: element matrices, the sparse map
from conductivity to matrix entries, gradients, the fill-reducing ordering (timed, the fastest kept) and the way the
products are formed (timed, the fastest kept). The remaining computation is the least cost per conductivity for a user
of SciPy.

The baseline has two strengths:

- `plain`: SuperLU in its best ordering, as the SciPy manual offers it, and products drive by drive;
- `tuned`: the ordering found once and reused (`NATURAL` on the permuted matrix, panels of one column, which suit these
  small fronts), or LAPACK's banded Cholesky where that is faster; and each pair of reciprocal channels computed once.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from scipy.sparse.csgraph import reverse_cuthill_mckee

from benchmarks.harness.timing import least_times
from benchmarks.opponents.scipy_contact import contact_integrals
from benchmarks.opponents.scipy_permuted import Permuted

SYMMETRIC = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
ORDERINGS: dict[str, dict[str, Any]] = {
    "COLAMD": {"permc_spec": "COLAMD"},
    "MMD_ATA": {"permc_spec": "MMD_ATA"},
    "MMD_AT_PLUS_A": {"permc_spec": "MMD_AT_PLUS_A"},
    "MMD_AT_PLUS_A, symmetric mode": SYMMETRIC,
}


class ScipyBaseline:
    """Voltages and Jacobian of a two-dimensional body with one conductivity per cell, computed with NumPy and SciPy
    only.

    `problem` contains plain arrays in SI units, for n nodes, m cells, S drives, K measurement patterns, M channels and
    L electrodes: `points` (n, 2), `cells` (m, 3), `drive` (S, L), `measurement` (K, L), `drive_index` and
    `measurement_index` (M,), and either `position` (L, 2), `width` (L,), `contact_impedance` (L,) of arcs on the
    boundary, or `nodes` (L,) of point electrodes. `choose=False` skips the timing of choices.
    """

    def __init__(
        self, problem: dict[str, np.ndarray], strength: Literal["plain", "tuned"] = "plain", *, choose: bool = True
    ):
        self.points, self.cells = problem["points"], problem["cells"]
        self.drive, self.measurement = problem["drive"], problem["measurement"]
        self.drive_index, self.measurement_index = problem["drive_index"], problem["measurement_index"]
        self.num_cells, self.num_points = len(self.cells), len(self.points)
        self.tuned = strength == "tuned"
        self._set_up_electrodes(problem)
        self._set_up_assembly()
        self._set_up_fields()
        self.ordering, self._factor, self.product = "MMD_AT_PLUS_A", _superlu(SYMMETRIC), self._by_drive
        if choose:
            conductivity = np.ones(self.num_cells)
            self._choose_ordering(self.matrix(conductivity))
            self._choose_product(conductivity)

    @property
    def reciprocal_pairs(self) -> list[tuple[int, int]]:
        """Pairs of reciprocal channels, which have equal readings, each pair once; the second index is -1 for a channel
        without a duplicate."""
        return [(channel, twin) for channel, twin, _, _ in self._reciprocal]

    @property
    def ways(self) -> list[Any]:
        """All ways of forming the products of fields in the Jacobian."""
        ways = [self._by_drive, self._by_channel, self._by_matrix_products]
        return [*ways, self._by_reciprocal_pair] if self.tuned else ways

    @property
    def choices(self) -> str:
        """Text of the ordering and the way of forming products that were fastest on this mesh."""
        return f"{self.ordering}; {self.product.__name__.strip('_').replace('_', ' ')}"

    # The timed part, which depends on the conductivity.

    def voltages(self, conductivity: np.ndarray) -> np.ndarray:
        """Voltages (channels,) in volts for a conductivity (cells,) in siemens."""
        return self._solve(conductivity)[0]

    def voltages_and_jacobian(self, conductivity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Voltages (channels,) and their derivative (channels, cells) with respect to the conductivity of every
        cell."""
        voltages, fields = self._solve(conductivity)
        return voltages, self.product(self._gradients(fields))

    def matrix(self, conductivity: np.ndarray) -> scipy.sparse.csc_matrix:
        """Sum (n, n) of stiffness matrix and contact mass matrix. Only the values depend on the conductivity; one
        sparse product computes them."""
        values = self._value_map @ conductivity + self._constant_values
        return scipy.sparse.csc_matrix((values, self._indices, self._indptr), (self.num_points, self.num_points))

    def _solve(self, conductivity):
        """Voltages (channels,), and potentials (n, P) at the n nodes for the P distinct drive and measurement
        patterns."""
        solve = self._factor(self.matrix(conductivity))
        unit = solve(self._load)  # (n, L): fields of unit electrode potentials, or of unit currents
        if self.is_point:
            impedance = unit[self._nodes]
            fields = unit @ self._patterns.T
        else:
            # Electrode potentials U from currents I: (D - Bᵀ A⁻¹ B) U = I, singular only for constant U.
            admittance = self._diagonal - self._load.T @ unit
            shift = np.trace(admittance) / len(admittance) ** 2
            impedance = np.linalg.inv(admittance + shift)
            fields = unit @ (impedance @ self._patterns.T)
        table = self.measurement @ impedance @ self.drive.T
        return table[self.measurement_index, self.drive_index], fields

    def _gradients(self, fields):
        """Gradients ∇u times the square root of the cell's area, (2, P, m), of the P potentials u in `fields` (n,
        P)."""
        stacked = self._gradient @ np.ascontiguousarray(fields)
        return np.ascontiguousarray(stacked.T).reshape(-1, 2, self.num_cells).transpose(1, 0, 2)

    # Three ways of forming J[k, e] = -∫_e ∇u_drive(k) · ∇u_measurement(k) for channel k and cell e. The fastest way on
    # this mesh is kept.

    def _by_drive(self, gradients):
        jacobian = np.empty((len(self.drive_index), self.num_cells))
        (x, y), (minus_x, minus_y) = gradients, -gradients
        for drive, rows, measured in self._drive_groups:
            np.multiply(x[measured], minus_x[drive], out=jacobian[rows])
            jacobian[rows] += y[measured] * minus_y[drive]
        return jacobian

    def _by_channel(self, gradients):
        jacobian = np.empty((len(self.drive_index), self.num_cells))
        (x, y), (minus_x, minus_y) = gradients, -gradients
        scratch = np.empty(self.num_cells)
        for row, drive, measured in zip(jacobian, self._drive_field, self._measurement_field, strict=True):
            np.multiply(x[measured], minus_x[drive], out=row)
            np.multiply(y[measured], minus_y[drive], out=scratch)
            row += scratch
        return jacobian

    def _by_matrix_products(self, gradients):
        per_cell = np.ascontiguousarray(gradients.transpose(2, 1, 0))
        products = np.matmul(-per_cell, per_cell.transpose(0, 2, 1)).reshape(self.num_cells, -1)
        chosen = np.take(products, self._drive_field * per_cell.shape[1] + self._measurement_field, axis=1)
        return chosen.T  # column-major, as computed: a row-major copy would only cost time

    def _by_reciprocal_pair(self, gradients):
        jacobian = np.empty((len(self.drive_index), self.num_cells))
        (x, y), (minus_x, minus_y) = gradients, -gradients
        scratch = np.empty(self.num_cells)
        for channel, twin, drive, measured in self._reciprocal:
            row = jacobian[channel]
            np.multiply(x[measured], minus_x[drive], out=row)
            np.multiply(y[measured], minus_y[drive], out=scratch)
            row += scratch
            if twin >= 0:
                jacobian[twin] = row
        return jacobian

    # The part that does not depend on the conductivity.

    def _set_up_electrodes(self, problem):
        count = self.num_points
        self.is_point = "nodes" in problem
        if self.is_point:
            self._nodes = problem["nodes"]
            self._load = np.zeros((count, len(self._nodes)), order="F")
            self._load[self._nodes, np.arange(len(self._nodes))] = 1.0
            # Grounding one node through 1 S changes no voltages, because currents sum to zero.
            self._contact = scipy.sparse.coo_matrix(([1.0], ([0], [0])), (count, count))
            return
        mass, load, area = contact_integrals(
            self.points, self.cells, problem["position"], problem["width"], problem["contact_impedance"]
        )
        self._contact, self._load, self._diagonal = mass, np.asfortranarray(load), np.diag(area)

    def _set_up_assembly(self):
        """Compute the sparse map (nonzeros, cells) from conductivity to the values of the matrix in compressed-column
        order."""
        corners = self.points[self.cells]
        edge = np.roll(corners, 1, axis=1) - np.roll(corners, -1, axis=1)  # edge opposite each corner
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        self.area = 0.5 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
        stiffness = np.einsum("mid,mjd->mij", edge, edge) / (4 * self.area[:, None, None])
        # The gradient of a corner's basis function is its opposite edge rotated by 90°, over twice the area.
        turned = np.stack([-edge[..., 1], edge[..., 0]], axis=-1) / (2 * self.area[:, None, None])
        weighted = turned * np.sqrt(self.area)[:, None, None]
        shape, rows = (self.num_cells, self.num_points), np.repeat(np.arange(self.num_cells), 3)
        self._gradient = scipy.sparse.vstack(
            [scipy.sparse.csr_matrix((weighted[..., d].ravel(), (rows, self.cells.ravel())), shape) for d in range(2)],
            format="csr",
        )

        row, column = np.repeat(self.cells, 3, axis=1).ravel(), np.tile(self.cells, (1, 3)).ravel()
        contact = self._contact.tocoo()
        all_rows, all_columns = np.concatenate([row, contact.row]), np.concatenate([column, contact.col])
        key = all_columns.astype(np.int64) * self.num_points + all_rows
        unique, place = np.unique(key, return_inverse=True)
        self._indices = (unique % self.num_points).astype(np.int32)
        self._indptr = np.searchsorted(unique, np.arange(self.num_points + 1) * self.num_points).astype(np.int32)
        entries = len(row)
        self._value_map = scipy.sparse.csr_matrix(
            (stiffness.ravel(), (place[:entries], np.repeat(np.arange(self.num_cells), 9))),
            (len(unique), self.num_cells),
        )
        self._constant_values = np.bincount(place[entries:], contact.data, len(unique))

    def _set_up_fields(self):
        """Find the distinct drive and measurement patterns: proportional patterns are solved for only once."""
        patterns, drive_field, drive_scale = _distinct(self.drive, np.empty((0, self.drive.shape[1])))
        patterns, measurement_field, measurement_scale = _distinct(self.measurement, patterns)
        self._patterns = patterns
        self._drive_field = drive_field[self.drive_index]
        self._measurement_field = measurement_field[self.measurement_index]
        scale = drive_scale[self.drive_index] * measurement_scale[self.measurement_index]
        if not np.allclose(scale, scale[0]):
            raise ValueError("The baseline expects drives of one amplitude.")
        self._gradient = self._gradient * np.sqrt(abs(scale[0]))
        self._drive_groups = []
        for drive in np.unique(self._drive_field):
            rows = np.flatnonzero(self._drive_field == drive)
            if np.any(np.diff(rows) != 1):
                raise ValueError("The baseline expects channels drive by drive.")
            self._drive_groups.append((drive, slice(rows[0], rows[-1] + 1), self._measurement_field[rows]))
        channel = {}
        pairs = []
        for k, pair in enumerate(zip(self._drive_field.tolist(), self._measurement_field.tolist(), strict=True)):
            twin = channel.get(pair[::-1])
            if twin is None:
                channel[pair] = len(pairs)
                pairs.append([k, -1, *pair])
            else:
                pairs[twin][1] = k
        self._reciprocal = pairs

    def _choose_ordering(self, matrix):
        """Time every candidate ordering on this matrix (factorisation and solution together) and keep the fastest."""
        candidates = {name: _superlu(options) for name, options in ORDERINGS.items()}
        if self.tuned:
            permutation = np.argsort(scipy.sparse.linalg.splu(matrix, **SYMMETRIC).perm_c)
            candidates["MMD_AT_PLUS_A found once, panels of 1"] = Permuted(matrix, permutation).superlu
            banded = Permuted(matrix, reverse_cuthill_mckee(matrix, symmetric_mode=True))
            if banded.bandwidth < 200:
                candidates["banded Cholesky (pbtrf), reverse Cuthill-McKee"] = banded.cholesky
        self.timings = least_times({k: (lambda f=f: f(matrix)(self._load)) for k, f in candidates.items()})
        self.ordering = min(self.timings, key=self.timings.__getitem__)
        self._factor = candidates[self.ordering]

    def _choose_product(self, conductivity):
        gradients = self._gradients(self._solve(conductivity)[1])
        timings = least_times({way.__name__: (lambda way=way: way(gradients)) for way in self.ways})
        self.product = min(self.ways, key=lambda way: timings[way.__name__])


def _superlu(options):
    return lambda matrix: scipy.sparse.linalg.splu(matrix, **options).solve


def _distinct(rows, known):
    """Directions of `rows` (patterns) including those in `known`, each once; the index of each row's direction, and the
    factor of each row along it."""
    directions, which, scale = list(known), [], []
    for row in rows:
        size = np.abs(row).max()
        factors = [row @ direction / (direction @ direction) for direction in directions]
        same = [
            index
            for index, (factor, direction) in enumerate(zip(factors, directions, strict=True))
            if np.allclose(row, factor * direction, atol=1e-12 * size)
        ]
        if not same:
            same, factors = [len(directions)], [*factors, size]
            directions.append(row / size)
        which.append(same[0])
        scale.append(factors[same[0]])
    return np.array(directions), np.array(which), np.array(scale)
