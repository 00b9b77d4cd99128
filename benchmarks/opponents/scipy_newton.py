"""Gauss-Newton with SciPy alone, on the forward model of `scipy_baseline.py`.

Minimises ½ Σ ((v_i(σ) - f_i) / s_i)² + ½ ‖c‖² over c, with log σ = log σ₀ + τ c, by full steps, for a frame f with
noise s. The cells' standard deviations τ are those of the NOSER prior, (Σ_i J_ie²)^(-1/4) / λ at the background. With J
for ∂v/∂c / s and r for (v - f) / s, for m cells and M channels, the next c is computed by either of

    (JᵀJ + 1)⁻¹ Jᵀ (J c - r)        m equations, in the space of images
    Jᵀ (J Jᵀ + 1)⁻¹ (J c - r)       M equations, in the space of data

The faster equation on this mesh is kept, together with the fastest way of forming J for it. The `tuned` strength also
averages reciprocal channels, which halves the rows of J, and forms only half of the symmetric product (`syrk`). All
dense algebra uses SciPy's BLAS: NumPy has another BLAS, and the threads of both disturb each other.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import scipy.linalg
from scipy.linalg.blas import dgemm, dgemv, dsyrk

from benchmarks.harness.timing import least_times
from benchmarks.opponents.scipy_baseline import ScipyBaseline


class ScipyNewton:
    """Gauss-Newton with a fixed number of steps from the background, for frames (channels,) in volts."""

    def __init__(self, baseline: ScipyBaseline, problem: dict[str, np.ndarray], num_steps: int):
        self.baseline, self.num_steps = baseline, num_steps
        self.background = float(problem["background"])
        self._rows, self._weight = self._combine(problem["noise"], baseline.reciprocal_pairs)
        conductivity = np.full(baseline.num_cells, self.background)
        voltages, jacobian = baseline.voltages_and_jacobian(conductivity)
        frame = problem["measured"][0]
        _, jacobian = self._weigh(voltages, jacobian, conductivity, frame)
        self.deviation = np.sum(jacobian**2, axis=1) ** -0.25 / float(problem["hyperparameter"])
        self._choose(frame)

    @property
    def choice(self) -> str:
        """Text of the space (data or images) and the way of forming products that were fastest."""
        return ", ".join(way.__name__.strip("_").replace("_", " ") for way in (self._step, self._product))

    def conductivity(self, frame: np.ndarray) -> np.ndarray:
        """Conductivity (cells,) in siemens after the steps, for one frame."""
        self.baseline.product = self._product
        coefficients = np.zeros(self.baseline.num_cells)
        for _ in range(self.num_steps):
            coefficients = self._iterate(frame, coefficients)
        return self.background * np.exp(self.deviation * coefficients)

    def _iterate(self, frame, coefficients):
        conductivity = self.background * np.exp(self.deviation * coefficients)
        voltages, jacobian = self.baseline.voltages_and_jacobian(conductivity)
        return self._step(*self._weigh(voltages, jacobian, conductivity * self.deviation, frame), coefficients)

    def _combine(self, noise, pairs):
        """Indices of the channels that remain after averaging of reciprocal pairs, and the factors by which their
        residuals are weighted."""
        if not self.baseline.tuned or any(twin < 0 for _, twin in pairs):
            return None, 1 / noise
        channel, twin = np.array(pairs).T
        self._twin = twin
        if not np.allclose(noise[channel], noise[twin]):
            raise ValueError("The baseline averages reciprocal channels of equal noise only.")
        return channel, np.sqrt(2) / noise[channel]

    def _weigh(self, voltages, jacobian, slope, frame):
        """Weighted residual r (M,), and Jᵀ (m, M) in Fortran order, which BLAS accepts without a copy."""
        if self._rows is not None:
            frame = (frame[self._rows] + frame[self._twin]) / 2
            voltages, jacobian = voltages[self._rows], jacobian[self._rows]
        weighted = np.multiply(jacobian, self._weight[:, None], order="C")
        weighted *= slope
        return self._weight * (voltages - frame), weighted.T

    def _in_data_space(self, residual, jacobian, coefficients):
        if self.baseline.tuned:
            matrix = dsyrk(1.0, jacobian, trans=1, lower=1)
        else:
            matrix = dgemm(1.0, jacobian, jacobian, trans_a=1)
        matrix[np.diag_indices_from(matrix)] += 1
        return dgemv(1.0, jacobian, _solve(matrix, dgemv(1.0, jacobian, coefficients, trans=1) - residual))

    def _in_image_space(self, residual, jacobian, coefficients):
        matrix = dgemm(1.0, jacobian, jacobian, trans_b=1)
        matrix[np.diag_indices_from(matrix)] += 1
        return _solve(matrix, dgemv(1.0, jacobian, dgemv(1.0, jacobian, coefficients, trans=1) - residual))

    def _choose(self, frame):
        """Time whole iterations in the spaces of data and images, then with every way of forming J, and keep the
        fastest."""
        start = np.zeros(self.baseline.num_cells)

        def iterate(step, product) -> None:
            self._step, self.baseline.product = step, product
            self._iterate(frame, start)

        def fastest(ways: dict, repeats: int):
            spent = least_times(ways, repeats)
            return min(spent, key=spent.__getitem__)

        steps = {step.__name__: step for step in (self._in_data_space, self._in_image_space)}
        products = {product.__name__: product for product in self.baseline.ways}
        first = self.baseline.product
        step = steps[fastest({name: partial(iterate, one, first) for name, one in steps.items()}, 2)]
        self._product = products[fastest({name: partial(iterate, step, one) for name, one in products.items()}, 10)]
        self._step = step


def _solve(matrix, right):
    return scipy.linalg.solve(matrix, right, assume_a="pos", lower=True, overwrite_a=True, check_finite=False)
