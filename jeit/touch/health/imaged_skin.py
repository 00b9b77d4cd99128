"""`ImagedSkin`: a skin's model, tied to its readings, for images that go on with what is left and for paths of cuts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jeit.forward import ForwardModel
from jeit.forward.assembly import check_conductivity
from jeit.inverse import one_step
from jeit.inverse.linear.one_step import LinearReconstruction
from jeit.mesh import centroids, measures
from jeit.touch.health.cut_path import FittedLoss, LossFit
from jeit_solvers.engines import as_array

# Gains of channels are read off the reference where the model agrees with it within this factor.
_AGREES = 3.0
# Units and polarity: what is wrong by so many times is not the model's error.
_OFF = 10.0
# A place to begin at is the middle of what stands above this share of an image's peak.
_ABOVE = 0.5
# A line is a cut if it leaves no more of the change than this, and no more than this share of what a spot does.
_EXPLAINS, _BETTER = 0.4, 0.6
# Of the skin's side: a second place to begin at is so far from the first, or it is no second.
_APART = 0.05


@dataclass(frozen=True)
class ImagedSkin:
    """**Fields**: `model`; `conductivity` (m,), S/m (2-D: S), as it is now, cuts and all, and when it was
    `healthy`; `gain` (M,), what channels read of the model's volts; `noise` (M,), volts; `sign` of a touch."""

    model: ForwardModel
    conductivity: Float[np.ndarray, " m"]
    healthy: Float[np.ndarray, " m"]
    gain: Float[np.ndarray, " M"]
    noise: Float[np.ndarray, " M"]
    sign: int

    @classmethod
    def create(
        cls, model: ForwardModel, conductivity: ArrayLike, reference: np.ndarray, noise: np.ndarray, sign: int
    ) -> "ImagedSkin":
        """Raises `ValueError` for a conductivity that is none, a reference of another skin, and a sign that is none."""
        if sign not in (1, -1):
            raise ValueError(f"sign must be 1, where touched skin conducts better, or -1, where worse; it is {sign!r}.")
        values = np.asarray(check_conductivity(model.mesh, conductivity))
        if values.ndim > 1 or np.iscomplexobj(values) or values.size not in (1, model.mesh.num_cells):
            raise ValueError("conductivity must be real, one number or one for each cell.")
        if model.protocol.num_measurements != reference.size:
            raise ValueError(
                f"healthy has {reference.size} channels, and the model {model.protocol.num_measurements}; give frames "
                "and model of one skin."
            )
        values = np.broadcast_to(values, model.mesh.num_cells).astype(float)
        predicted = np.asarray(model.voltages(values))
        used = np.isfinite(noise)
        ratio = reference[used] @ predicted[used] / (predicted[used] @ predicted[used])
        if not 1 / _OFF < ratio < _OFF:
            raise ValueError(
                f"healthy: it is {ratio:.2g} times what the model predicts; are both in SI units, and the signs right?"
            )
        each = reference / np.where(predicted == 0, np.inf, predicted)
        gain = np.where(used & (each > ratio / _AGREES) & (each < ratio * _AGREES), each, ratio)
        return cls(model, values, values, gain, noise, int(sign))

    def linear(self, usable: Bool[np.ndarray, " M"]) -> LinearReconstruction:
        """One-step images of the model's volts by the `usable` channels (M,), about the skin as it is now."""
        noise = np.where(np.isfinite(self.noise), self.noise / np.abs(self.gain), 1.0)
        return one_step(self.model, self.conductivity, noise=as_array(noise), mask=as_array(usable))

    def images(self, changes: Float[np.ndarray, "F M"], usable: Bool[np.ndarray, " M"]) -> Float[np.ndarray, "F m"]:
        """Changes of conductivity (F, m), S/m (2-D: S), of changes (F, M), volts, NaN where there is no reading; NaN
        for a frame without any."""
        there = np.isfinite(changes) & usable
        volts = np.where(there, changes / self.gain, 0.0)
        found = np.full((len(changes), self.model.mesh.num_cells), np.nan)
        patterns, kind = np.unique(there, axis=0, return_inverse=True)
        for number, pattern in enumerate(patterns):
            if pattern.any():
                rows = kind.ravel() == number
                found[rows] = np.asarray(self.linear(pattern).image(as_array(volts[rows])))
        return found

    def loss(
        self, change: Float[np.ndarray, " M"], usable: Bool[np.ndarray, " M"], noise: Float[np.ndarray, " M"]
    ) -> FittedLoss | None:
        """The cut that explains a change (M,), volts, if one does, and better than a press would. `noise` (M,) of the
        change, volts."""
        there = usable & np.isfinite(change)
        volts = np.where(there, change / self.gain, 0.0)
        image = np.asarray(self.linear(there).image(as_array(volts)))
        lost = np.maximum(-image, 0.0)
        if not lost.max() > 0:
            return None
        centres = np.asarray(centroids(self.model.mesh))[:, :2]
        weight = np.asarray(measures(self.model.mesh)) * np.where(lost > _ABOVE * lost.max(), lost, 0.0)
        start = weight @ centres / weight.sum()
        channels = np.flatnonzero(there)
        own = noise[channels] / np.abs(self.gain[channels])
        fit = LossFit(self.model, self.conductivity, volts[channels], channels, own, start)
        spot = fit.spot(start)
        starts = [start]
        if np.linalg.norm(spot.path[0] - start) > _APART * fit.side:
            starts.append(spot.path[0])
        line = fit.line(starts)
        if line.misfit > _EXPLAINS or line.misfit > _BETTER * spot.misfit:
            return None
        return line

    def with_loss(self, loss: FittedLoss) -> "ImagedSkin":
        """The skin with a cut."""
        return replace(self, conductivity=loss.conductivity)

    def healed(self) -> "ImagedSkin":
        """The skin without any."""
        return replace(self, conductivity=self.healthy)
