"""Changes of electrodes between a reference and a frame: displacements and changes of contact impedance, estimated from
the voltage difference.

Displacements t of the electrodes along the directions in which they can move, and changes ζ of the logarithms of their
contact impedances, change the voltages by J (t, ζ), to first order. These are a few patterns, most of which no body
causes. A small body that explains a difference is therefore not mistaken for moved electrodes. The estimate minimises

    ½ ‖(d - c v - J (t, ζ)) / κn‖² + ½ ‖t / s‖² + ½ ‖ζ‖²,

where d is the voltage difference, v are the voltages of the reference, c is a change common to all voltages, n is the
`relative_noise`, s the standard deviation of electrode positions, and κn 3 % of the difference. If t and ζ explain most
of the difference, the displaced electrodes are estimated without the linear approximation by
`jeit.inverse.placement.place_electrodes`.

Soleimani, Gómez-Laberge and Adler, Physiological Measurement 27 (2006) S103, on electrode movement in difference
imaging.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jeit.arguments import percent
from jeit.forward import ForwardModel
from jeit.forward.changes import PlacementSensitivity
from jeit.forward.model import select_channels
from jeit.imaging.calibration import keep_last_result
from jeit.inverse.channels import IndependentChannels
from jeit.inverse.placement import place_electrodes
from jeit_solvers.engines import as_array, on_host

# Minimum share of the variance of the difference, corrected for the number of unknowns, that changes of electrodes
# explain, and their maximum size in standard deviations. In 75 simulated and measured tanks with bodies and without
# movement the share was at most 0.49, in tanks whose electrodes moved 0.9 to 1.
_MIN_SHARE, _MAX_SIZE = 0.7, 4.0
# Error of the linear approximation, as a share of the difference.
_LINEAR_ERROR = 0.03


class ElectrodeChange(NamedTuple):
    """Change of the electrodes between a reference and a frame, estimated by `ElectrodeChanges.find`.

    **Fields**: `shift` (L, a): displacements along the a directions in which each electrode can move, metres;
    `voltages` (M,): change of the voltages due to the change of the electrodes, volts; `unexplained`: root mean square
    of the remaining difference, as a share of the difference without a factor common to all voltages.
    """

    shift: Float[np.ndarray, "L a"]
    voltages: Float[np.ndarray, " M"]
    unexplained: float

    @property
    def doubt(self) -> str:
        """Description of the change, in a sentence."""
        distances = 1e3 * np.linalg.norm(self.shift, axis=1)
        largest = int(np.argmax(distances))
        return (
            f"electrodes that have moved by about {np.sqrt(np.mean(distances**2)):.2g} mm since the reference (root "
            f"mean square; electrode {largest + 1} by about {distances[largest]:.2g} mm) explain all but "
            f"{percent(self.unexplained)} of the difference; the image shows the rest. Measure a new reference."
        )


class ElectrodeChanges:
    """Estimates changes of the electrodes from voltage differences, see the module's docstring.

    `model`, `background`: the model of the reference and its conductivity, S/m (2-D: S); `noise` (M,): errors of the
    channels relative to each other; `mask` (M,): True for the channels to use; `deviation`: standard deviation of
    electrode positions, metres.
    """

    def __init__(
        self,
        model: ForwardModel,
        background: float,
        noise: Float[np.ndarray, " M"],
        mask: Bool[np.ndarray, " M"],
        deviation: float,
    ):
        self.model, self.background, self.mask, self.deviation = model, background, mask, deviation
        self.reference, self._derivatives = _voltages_and_derivatives(model, background)
        num_contacts = _num_contacts(model)
        num_shifts = self._derivatives.shape[1] - num_contacts
        self._spread = np.concatenate([np.full(num_shifts, deviation), np.ones(num_contacts)])
        self._weights = mask / noise
        level = self.reference * self._weights
        self._level = level / np.linalg.norm(level)
        self._rows = self._without_common_factor((self._derivatives * self._spread).T).T
        self._eigenvalues, self._eigenvectors = np.linalg.eigh(self._rows.T @ self._rows)
        num_independent = min(len(IndependentChannels.create(model.protocol).index), int(mask.sum())) - 1
        # Ratio of the numbers of independent channels and of those that are left after the fit.
        self._num_ratio = num_independent / max(num_independent - len(self._spread), 1e-9)

    def voltages(self, differences: Float[np.ndarray, "N M"]) -> Float[np.ndarray, "N M"]:
        """Changes of the voltages (N, M) due to changes of the electrodes, in a linear approximation; zero for
        differences (N, M) that are not mostly explained by them. All are in volts."""
        weighted = self._without_common_factor(differences)
        size = np.linalg.norm(weighted, axis=1, keepdims=True)
        error = _LINEAR_ERROR * size / np.sqrt(max(np.count_nonzero(self.mask), 1))
        projected = weighted @ self._rows @ self._eigenvectors
        coefficients = projected / (np.maximum(self._eigenvalues, 0) + np.where(size > 0, error, 1) ** 2)
        coefficients = coefficients @ self._eigenvectors.T
        unexplained = np.linalg.norm(weighted - coefficients @ self._rows.T, axis=1, keepdims=True)
        is_explained = (unexplained / np.where(size > 0, size, 1)) ** 2 * self._num_ratio < 1 - _MIN_SHARE
        is_plausible = np.sqrt(np.mean(coefficients**2, axis=1, keepdims=True)) < _MAX_SIZE
        is_change = (size > 0) & is_explained & is_plausible
        return np.where(is_change, (coefficients * self._spread) @ self._derivatives.T, 0.0)

    def find(self, difference: Float[np.ndarray, " M"]) -> ElectrodeChange | None:
        """Estimate the change of the electrodes that explains most of a voltage `difference` (M,), volts; None if no
        plausible change does."""
        if not self.voltages(difference[None]).any():
            return None
        try:
            measured = as_array(self.reference + difference)
            placement = place_electrodes(self.model, measured, deviation=self.deviation, mask=as_array(self.mask))
        except ValueError:
            return None
        change = np.where(self.mask, np.asarray(placement.model.voltages(self.background)) - self.reference, 0)
        rest, whole = self._without_common_factor(np.stack([difference - change, difference]))
        unexplained = float(np.linalg.norm(rest) / np.linalg.norm(whole))
        return ElectrodeChange(placement.shift, change, unexplained) if unexplained**2 < 1 - _MIN_SHARE else None

    def _without_common_factor(self, voltages: Float[np.ndarray, "N M"]) -> Float[np.ndarray, "N M"]:
        """Voltages divided by the noise of their channels, without the part that is a factor common to all."""
        weighted = voltages * self._weights
        return weighted - np.outer(weighted @ self._level, self._level)


@keep_last_result
def _voltages_and_derivatives(
    model: ForwardModel, background: float
) -> tuple[Float[np.ndarray, " M"], Float[np.ndarray, "M p"]]:
    """Voltages (M,) of a model, and their derivatives with respect to displacements, volts per metre, and, if voltages
    are measured on driven electrodes, to the logarithms of the contact impedances, volts."""
    fields, impedance = map(np.asarray, on_host(model.fields(background)))
    protocol, electrodes = on_host(model.protocol), model.electrodes
    changes = PlacementSensitivity(model.mesh, electrodes)(fields, impedance)  # pyright: ignore[reportArgumentType]
    changes = changes[: len(changes) - electrodes.num_electrodes + _num_contacts(model)]
    voltages, *derivatives = (np.asarray(select_channels(protocol, change)) for change in (impedance, *changes))
    return voltages, np.stack(derivatives, axis=1)


def _num_contacts(model: ForwardModel) -> int:
    """Number of contact impedances that the voltages depend on: none unless voltages are measured on driven
    electrodes."""
    return model.electrodes.num_electrodes if model.protocol.channels_on_driven_electrodes().any() else 0
