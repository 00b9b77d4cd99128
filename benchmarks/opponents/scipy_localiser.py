"""Plain implementation of localisation by sound in NumPy and SciPy: for each frame, a map of the loss over pixels, and
a refinement.

As in Text S2 of Park et al. (2022), the loss is computed on a grid of pixels, and a bounded solver starts from the
pixel of least loss. Constants (distances, responses) are computed once.
"""

from __future__ import annotations

import numpy as np
import scipy.optimize


class PlainLocaliser:
    """Localiser for one array: M microphones (M, 2), parameters a and b (M,) of the decay model a / (r² + b), half of
    the skin's width in metres, pixels along a side."""

    def __init__(self, microphones, a, b, half: float, pixels: int):
        self.microphones, self.a, self.b, self.half = microphones, a, b, half
        middles = -half + 2 * half * (np.arange(pixels) + 0.5) / pixels
        self.x, self.y = np.meshgrid(middles, middles)
        squared = (self.x - microphones[:, 0, None, None]) ** 2 + (self.y - microphones[:, 1, None, None]) ** 2
        self.inverse = (squared + b[:, None, None]) / a[:, None, None]

    def map(self, intensity: np.ndarray) -> np.ndarray:
        """The loss of one frame at every pixel, relative to the square of the largest intensity."""
        loudest = intensity.argmax()
        strength = (intensity / intensity[loudest])[:, None, None] * self.inverse
        return np.sum((strength[loudest] - strength) ** 2, axis=0)

    def locate(self, intensity: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        """Position of least loss within the skin, found by L-BFGS-B with the exact gradient from `start` or else from
        the pixel of least loss."""
        loudest = intensity.argmax()
        relative = intensity / intensity[loudest] / self.a
        if start is None:
            row, column = np.unravel_index(self.map(intensity).argmin(), self.x.shape)
            start = np.array([self.x[row, column], self.y[row, column]])

        def loss(place):
            offset = place - self.microphones
            strength = relative * (np.sum(offset**2, axis=1) + self.b)
            slope = 2 * relative[:, None] * offset
            off = strength[loudest] - strength
            return np.sum(off**2), 2 * off @ (slope[loudest] - slope)

        bounds = [(-self.half, self.half)] * 2
        found = scipy.optimize.minimize(loss, start, jac=True, bounds=bounds, method="L-BFGS-B", tol=1e-14)
        return found.x

    def locate_near(self, intensity: np.ndarray) -> np.ndarray:
        """Position found by L-BFGS-B from the microphone with the largest intensity, without a map."""
        return self.locate(intensity, self.microphones[intensity.argmax()])
