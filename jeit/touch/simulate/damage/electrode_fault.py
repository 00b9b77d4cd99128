"""`ElectrodeFault`: a dead electrode, a loose one, or one whose wire is torn off, and the readings of its channels."""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.arguments import check_key, check_kind, check_name, describe, is_number, real_array
from jeit.forward import ForwardModel
from jeit.forward.model import check_model, select_channels

FaultKind = Literal["dead", "loose", "torn"]
FAULTS: tuple[FaultKind, ...] = ("dead", "loose", "torn")
# Contact impedance of a dead electrode, relative to before; the limit of the source's voltage, relative to the greatest
# that it drives at rest.
_DEAD, _RAIL = 1e7, 5.0
# A loose contact fluctuates between these factors, its logarithm with this time constant in seconds; the number of
# levels at which it is solved.
_LOOSE, _WANDERING, _LEVELS = (10.0, 1000.0), 0.5, 7
# Voltage picked up by a wire that hangs in the air, relative to the root mean square of all voltages.
_STRAY = 0.02


class ElectrodeFault(eqx.Module):
    """What happens to an `electrode` (its number, from 0).

    **Fields**: `kind`, one of `FAULTS`. "dead": its contact impedance is 10⁷ times as large; what it drives, the source
    cannot, which gives out at five times the greatest voltage at rest, and what it measures floats. "loose": its
    contact impedance is 10 to 1,000 times as large, and wanders within half a second. "torn": no current and no
    voltage; its channels read what a wire picks up, or a constant `rail`, volts, if that is given.
    """

    electrode: int
    kind: FaultKind = "dead"
    rail: float | None = None

    def __check_init__(self):
        """Raises `ValueError` for an electrode or a kind that there is not, and a rail that is no voltage."""
        if not (isinstance(self.electrode, (int, np.integer)) and self.electrode >= 0):
            raise ValueError(f"electrode must be its number, from 0; it is {describe(self.electrode)}.")
        check_name("kind", self.kind, FAULTS)
        if self.rail is not None and not is_number(self.rail):
            raise ValueError(f"rail must be volts, or None; it is {describe(self.rail)}.")

    def changes(
        self, key: Array, model: ForwardModel, conductivity: ArrayLike, seconds: Float[np.ndarray, " T"]
    ) -> Float[np.ndarray, "T M"]:
        """Differences of the voltages (T, M) of a skin at rest from those without the fault, at `seconds` (T,), volts.

        `conductivity` of the skin, S/m (2-D: S). Raises `ValueError` for what is no key or model, an electrode that it
        lacks, and times that are none.
        """
        check_key(key)
        check_model(model)
        protocol = model.protocol
        if self.electrode >= protocol.num_electrodes:
            raise ValueError(f"electrode {self.electrode}: the model has {protocol.num_electrodes}, counted from 0.")
        seconds = real_array("seconds", seconds, "times (T,) of the frames")
        for_wandering, for_strays = jax.random.split(key)
        rest = np.asarray(model.voltages(conductivity))
        if self.kind == "loose":
            return self._wandering(for_wandering, model, conductivity, seconds) - rest
        stray = (
            _STRAY * np.sqrt(np.mean(rest**2)) * np.asarray(jax.random.normal(for_strays, (len(seconds), rest.size)))
        )
        driving = np.asarray(protocol.channel_drive)[:, self.electrode] != 0
        reading = np.asarray(protocol.channel_measurement)[:, self.electrode] != 0
        if self.kind == "torn":
            silent = np.broadcast_to(stray if self.rail is None else self.rail, stray.shape)
            return np.where(driving | reading, silent - rest, 0.0)
        dead = self._driven(model, conductivity)
        changed = np.where(reading & ~driving, stray - rest, dead - rest)
        return np.where(driving | reading, changed, (dead - rest) * np.ones_like(stray))

    def _worse(self, model: ForwardModel, factor: float) -> ForwardModel:
        impedance = np.array(np.broadcast_to(model.electrodes.contact_impedance, model.protocol.num_electrodes), float)
        impedance[self.electrode] *= factor
        worse = eqx.tree_at(lambda one: one.contact_impedance, model.electrodes, jax.numpy.asarray(impedance))
        return model.with_electrodes(worse)

    def _driven(self, model: ForwardModel, conductivity) -> Float[np.ndarray, " M"]:
        """Voltages (M,) with a dead electrode, from a source of limited voltage."""
        before, after = (np.asarray(one.transfer_impedance(conductivity)) for one in (model, self._worse(model, _DEAD)))
        drive = np.asarray(model.protocol.drive)
        spans = [np.ptp(np.where(drive != 0, drive @ z.T, 0.0), axis=1) for z in (before, after)]
        current = np.minimum(1.0, _RAIL * spans[0].max() / spans[1])
        voltages = np.asarray(select_channels(model.protocol, after))
        return voltages * current[np.asarray(model.protocol.drive_index)]

    def _wandering(self, key: Array, model: ForwardModel, conductivity, seconds: np.ndarray) -> np.ndarray:
        """Voltages (T, M) of a contact that fluctuates, solved at a few levels of its logarithm."""
        low, high = np.log(_LOOSE)
        levels = np.linspace(low, high, _LEVELS)
        solved = [np.asarray(self._worse(model, float(np.exp(one))).voltages(conductivity)) for one in levels]
        normal = np.asarray(jax.random.normal(key, (len(seconds),)))
        place, steps = np.empty(len(seconds)), np.diff(seconds, prepend=seconds[:1])
        now = 0.0
        for number, (step, one) in enumerate(zip(steps, normal, strict=True)):
            kept = np.exp(-step / _WANDERING) if number else 0.0
            now = kept * now + np.sqrt(1 - kept**2) * one
            place[number] = now
        # Uniform in its logarithm: the quantile of a normal variable.
        share = np.asarray(jax.scipy.stats.norm.cdf(place)) * (_LEVELS - 1)
        below = np.minimum(share.astype(int), _LEVELS - 2)
        part = (share - below)[:, None]
        table = np.array(solved)
        return (1 - part) * table[below] + part * table[below + 1]


def check_fault(name: str, given) -> None:
    """Raise `ValueError`, about the argument `name`, for what is no `ElectrodeFault`."""
    check_kind(name, given, ElectrodeFault, 'an ElectrodeFault(3, "dead")')
