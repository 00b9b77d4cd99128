"""Factorisations in a known ordering, for the tuned SciPy baseline."""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg


class Permuted:
    """Factorisation of matrices with a fixed sparsity pattern in a given ordering of the unknowns."""

    def __init__(self, matrix, permutation):
        self.permutation = permutation
        # Applying the permutation to the indices of the values gives the new index of each value.
        places = scipy.sparse.csc_matrix(
            (np.arange(1, matrix.nnz + 1, dtype=float), matrix.indices, matrix.indptr), matrix.shape
        )
        permuted = places[permutation][:, permutation].tocsc()
        permuted.sort_indices()
        self.places = permuted.data.astype(np.intp) - 1
        self.indices, self.indptr, self.shape = permuted.indices, permuted.indptr, matrix.shape
        column = np.repeat(np.arange(matrix.shape[1]), np.diff(self.indptr))
        offset = self.indices - column
        self.bandwidth = int(offset.max())
        lower = offset >= 0
        self.band_source, self.band_row, self.band_column = self.places[lower], offset[lower], column[lower]

    def superlu(self, matrix):
        permuted = scipy.sparse.csc_matrix((matrix.data[self.places], self.indices, self.indptr), self.shape)
        factor = scipy.sparse.linalg.splu(
            permuted,
            permc_spec="NATURAL",
            diag_pivot_thresh=0.0,
            panel_size=1,
            options={"SymmetricMode": True},
        )
        return self._solver(factor.solve)

    def cholesky(self, matrix):
        band = np.zeros((self.bandwidth + 1, self.shape[0]), order="F")
        band[self.band_row, self.band_column] = matrix.data[self.band_source]
        factor = scipy.linalg.cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
        return self._solver(
            lambda right: scipy.linalg.cho_solve_banded((factor, True), right, overwrite_b=True, check_finite=False)
        )

    def _solver(self, solve):
        def permuted_solve(load):
            solution = np.empty_like(load)
            solution[self.permutation] = solve(np.asfortranarray(load[self.permutation]))
            return solution

        return permuted_solve
