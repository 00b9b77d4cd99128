"""Measurements: frames of voltages with their protocol, electrodes and body."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Inexact
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, counted, describe, did_you_mean, is_number, object_html, object_text, picture
from jeit.electrodes import AbstractElectrodes
from jeit.inverse.placement import Uncertainty
from jeit.mesh import Body, Mesh
from jeit.mesh.solid_body import as_body
from jeit.protocol import Protocol
from jeit_solvers.engines import as_array, has_values, namespace, numpy_or_compiled, on_host
from jeit_solvers.module import Module


class Measurement(Module):
    """F frames of M measured (or simulated) voltages each.

    Build a measurement with `screen`, which looks for bad channels, or with a reader (`jeit.data.read`).

    **Fields**

    - `voltages`: (F, M) volts, real or complex; NaN only where masked.
    - `mask`: (F, M) booleans, True for usable voltages.
    - `protocol`: drive and measurement patterns of the M channels.
    - `electrodes`: positions and sizes of the electrodes (an object of `jeit.electrodes`), or None if they are not
      known.
    - `domain`: the body: an outline (`jeit.mesh.Disk` ...), a `jeit.mesh.Solid`, or a mesh (`jeit.mesh.OwnMesh`, or a
      `Mesh`, which is converted to it); None if it is not known.
    - `name`, `source`: name and origin of the data; `frame_names`: one name per frame, or empty.
    - `notes`: one sentence for each assumption, and for each reason why voltages were masked.
    - `times`: (F,) increasing times of the frames in seconds; None if they are not known.
    - `uncertainty`: how accurately electrodes and domain are known; None for the defaults of
      `jeit.inverse.Uncertainty`.

    **Example:**

    ```python
    pressed.voltages, pressed.protocol, pressed.notes
    pressed.without_electrodes(3).mask
    ```
    """

    voltages: Inexact[Array, "F M"]
    mask: Bool[Array, "F M"]
    protocol: Protocol
    electrodes: Any
    domain: Body | None
    name: str = eqx.field(static=True)
    source: str = eqx.field(static=True)
    frame_names: tuple[str, ...] = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)
    times: Float[Array, " F"] | None
    uncertainty: Uncertainty | None = eqx.field(static=True)

    def __init__(
        self,
        voltages: ArrayLike,
        mask: ArrayLike,
        protocol: Protocol,
        *,
        electrodes: AbstractElectrodes | None = None,
        domain: Body | Mesh | None = None,
        name: str = "measurement",
        source: str = "",
        frame_names: tuple[str, ...] = (),
        notes: tuple[str, ...] = (),
        times: ArrayLike | None = None,
        uncertainty: Uncertainty | None = None,
    ):
        """`voltages` and `mask`: (frames, channels), or (channels,) for one frame; `times`: (frames,). Raises
        `ValueError` if these shapes disagree, if times do not increase, and if `domain` is not a body."""
        self.voltages = as_array(_frame_matrix(voltages))
        self.mask = as_array(_frame_matrix(mask))
        self.protocol = protocol
        self.electrodes = electrodes
        self.domain = None if domain is None else as_body(domain)
        self.name = name
        self.source = source
        self.frame_names = tuple(frame_names)
        self.notes = tuple(notes)
        self.times = None if times is None else as_array(np.asarray(times, float))
        if uncertainty is not None:
            check_kind("uncertainty", uncertainty, Uncertainty, "a jeit.inverse.Uncertainty(position=…)")
        self.uncertainty = uncertainty
        if not jnp.issubdtype(self.voltages.dtype, jnp.inexact):
            raise ValueError(f"voltages are {self.voltages.dtype}; give real or complex volts.")
        if self.voltages.ndim != 2 or self.voltages.shape[1] != protocol.num_measurements:
            raise ValueError(
                f"voltages have shape {self.voltages.shape}, but the protocol '{protocol.name}' has "
                f"{protocol.num_measurements} channels: give (frames, channels)."
            )
        if self.mask.shape != self.voltages.shape or self.mask.dtype != bool:
            raise ValueError(
                f"mask has shape {self.mask.shape} of {self.mask.dtype}; give one True (usable) or False for "
                f"each of the voltages, shape {self.voltages.shape}."
            )
        if electrodes is not None and electrodes.num_electrodes != protocol.num_electrodes:
            raise ValueError(
                f"{electrodes.num_electrodes} electrodes were placed, but the protocol '{protocol.name}' "
                f"uses {protocol.num_electrodes}. Both must count the same electrodes."
            )
        if self.frame_names and len(self.frame_names) != self.voltages.shape[0]:
            raise ValueError(
                f"frame_names are {len(self.frame_names)} and the frames {self.voltages.shape[0]}; give one each."
            )
        if self.times is not None:
            _check_times(np.asarray(self.times), self.voltages.shape[0])

    def __repr__(self) -> str:
        return object_text(
            lambda: (
                f"Measurement({self.name!r}: {self.num_frames} frames, {np.sum(~self.mask)} voltages masked,\n"
                f"  {self.protocol!r}, {self.domain!r})"
            ),
            self,
        )

    def _repr_png_(self) -> bytes | None:
        return picture(self)

    def _repr_html_(self) -> str | None:
        return object_html(self)

    @property
    def num_frames(self) -> int:
        """Number of frames F."""
        return self.voltages.shape[0]

    @property
    def num_channels(self) -> int:
        """Number of channels M per frame."""
        return self.voltages.shape[1]

    @property
    def frame_rate(self) -> float | None:
        """Mean frame rate in frames per second; None if the times are not known, or if there are fewer than two
        frames."""
        if self.times is None or self.num_frames < 2:
            return None
        frame_times = np.asarray(self.times)
        return float((len(frame_times) - 1) / (frame_times[-1] - frame_times[0]))

    def at_rate(self, rate: float) -> "Measurement":
        """The same frames with times from 0 s, at `rate` frames per second. Raises `ValueError` unless `rate` is a
        positive number."""
        if not (is_number(rate) and rate > 0):
            raise ValueError(f"rate must be positive, frames in a second; it is {describe(rate)}.")
        return self._replace(self.voltages, self.mask, times=np.arange(self.num_frames) / float(rate))

    def frames(self, which: slice | ArrayLike) -> "Measurement":
        """The frames that `which` selects: a slice, increasing indices from 0, or a boolean mask (frames,).

        Raises `ValueError` for frames that do not exist, and if no frame is selected.
        """
        frame_indices = (
            np.arange(self.num_frames)[which] if isinstance(which, slice) else np.atleast_1d(np.asarray(which))
        )
        if frame_indices.dtype == bool and frame_indices.shape == (self.num_frames,):
            frame_indices = np.flatnonzero(frame_indices)
        if frame_indices.ndim != 1 or not frame_indices.size or frame_indices.dtype.kind not in "iu":
            raise ValueError(
                f"which: give a slice, whole numbers or a mask of {self.num_frames} frames that leaves some; got "
                f"{frame_indices.dtype} of shape {frame_indices.shape}."
            )
        if frame_indices.min() < 0 or frame_indices.max() >= self.num_frames or (np.diff(frame_indices) <= 0).any():
            raise ValueError(f"which: frames run from 0 to {self.num_frames - 1}; give numbers in rising order.")
        return self._select_frames(frame_indices)

    def frame(self, which: int | str) -> "Measurement":
        """A single frame as a measurement, selected by its index from 0 (negative: counted from the end) or by its
        name.

        Raises `ValueError` for a frame that does not exist.
        """
        return self._select_frames(np.array([self.frame_number(which)]))

    def frame_number(self, which: int | str) -> int:
        """The index, counted from 0, of the frame that has the index or name `which`. Raises `ValueError` for a frame
        that does not exist."""
        if isinstance(which, str):
            if which not in self.frame_names:
                known_names = ", ".join(self.frame_names) or "none: give a number"
                suggested_name = did_you_mean(which, self.frame_names)
                raise ValueError(
                    f"'{self.name}' has no frame named {which!r}{suggested_name}. Named frames: {known_names}."
                )
            which = self.frame_names.index(which)
        if not -self.num_frames <= which < self.num_frames:
            raise ValueError(f"'{self.name}' has frames 0 to {self.num_frames - 1}; there is no frame {which}.")
        return which % self.num_frames

    def split_reference(self) -> tuple["Measurement", "Measurement"]:
        """Split the measurement into the frames to image and the reference frame (the frame named "reference").

        Raises `ValueError` if no frame is named "reference", or if there is no other frame.
        """
        if "reference" not in self.frame_names or self.num_frames < 2:
            remedy_text = "say which (--reference-frames 0-17; measurement.frames(slice(0, 18))), or "
            raise ValueError(
                f"'{self.name}' holds no reference frame of its own. Measure the undisturbed body and give that file "
                f"as the reference; or, if frames of this one are that, {remedy_text if self.num_frames > 1 else ''}"
                'name one "reference" in the description: [data] frame_names.'
            )
        reference_index = self.frame_names.index("reference")
        other_indices = np.array([k for k in range(self.num_frames) if k != reference_index])
        return self._select_frames(other_indices), self._select_frames(np.array([reference_index]))

    def mean_frame(self) -> "Measurement":
        """The mean of the usable voltages over all frames, as a measurement of one frame; a channel that is usable in
        no frame stays masked."""
        mean_voltages, usable_mask = _masked_mean(self.voltages, self.mask)
        return self._replace(mean_voltages, usable_mask, frame_names=(), times=None)

    def filled(self, value: float = 0.0) -> Inexact[Array, "F M"]:
        """Voltages (frames, channels) in volts, with `value` in place of masked voltages."""
        return _fill_masked(self.voltages, self.mask, value)

    def masked(self, usable: ArrayLike, reason: str) -> "Measurement":
        """The same measurement with fewer usable channels.

        `usable`: boolean, (channels,) or (frames, channels); `reason`: text that is added to the notes if a voltage
        is masked. Raises `ValueError` if `usable` has a different shape.
        """
        usable_array = jnp.asarray(usable)
        if usable_array.dtype != bool or usable_array.shape not in ((self.num_channels,), self.mask.shape):
            raise ValueError(
                f"usable has shape {usable_array.shape} of {usable_array.dtype}; give booleans of shape "
                f"({self.num_channels},) or {self.mask.shape}."
            )
        reduced_mask = self.mask & usable_array
        mask_note = reason
        if has_values(reduced_mask):
            num_masked = int(self.mask.sum() - reduced_mask.sum())
            if num_masked == 0:
                return self
            mask_note = f"{counted(num_masked, 'voltage')} masked: {reason}"
        return self._replace(self.voltages, reduced_mask, notes=(*self.notes, mask_note))

    def without_electrodes(self, electrodes: int | Sequence[int]) -> "Measurement":
        """Mask the channels that drive or measure any of `electrodes` (counted from 0), e.g. missing or broken
        electrodes.

        Raises `ValueError` for electrodes that do not exist.
        """
        electrode_numbers = ", ".join(str(k + 1) for k in np.atleast_1d(electrodes))
        return self.masked(self.protocol.mask_without(electrodes), f"electrodes {electrode_numbers} left out.")

    def without_driven_channels(self) -> "Measurement":
        """Mask the channels that measure on an electrode that carries current, because their voltages include the
        contact impedance of this electrode."""
        usable_channels = ~self.protocol.channels_on_driven_electrodes()
        return self.masked(usable_channels, "they measure on driven electrodes.")

    def _select_frames(self, frame_indices: np.ndarray) -> "Measurement":
        selected_names = tuple(self.frame_names[k] for k in frame_indices) if self.frame_names else ()
        selected_times = None if self.times is None else np.asarray(self.times)[frame_indices]
        return self._replace(
            *_select_rows(self.voltages, self.mask, frame_indices), frame_names=selected_names, times=selected_times
        )

    def _replace(self, voltages, new_mask, **changed_fields) -> "Measurement":
        measurement_fields = {
            "frame_names": self.frame_names,
            "notes": self.notes,
            "times": self.times,
            **changed_fields,
        }
        return Measurement(
            voltages,
            new_mask,
            self.protocol,
            electrodes=self.electrodes,
            domain=self.domain,
            name=self.name,
            source=self.source,
            uncertainty=self.uncertainty,
            **measurement_fields,
        )


def _check_times(frame_times: np.ndarray, num_frames: int) -> None:
    if frame_times.shape != (num_frames,):
        raise ValueError(f"times have shape {frame_times.shape}; give seconds for each of {num_frames} frames.")
    if not np.isfinite(frame_times).all() or (np.diff(frame_times) <= 0).any():
        raise ValueError("times must be finite and rise from frame to frame, in seconds; sort the frames by time.")


def _frame_matrix(frame_values):
    """Values of one frame (channels,) or of several frames, as an array (frames, channels)."""
    return np.atleast_2d(on_host(frame_values)) if has_values(frame_values) else jnp.atleast_2d(frame_values)


@numpy_or_compiled
def _fill_masked(voltages, usable_mask, value):
    return namespace(voltages, usable_mask).where(usable_mask, voltages, value)


@numpy_or_compiled
def _select_rows(voltages, usable_mask, row_indices):
    return voltages[row_indices], usable_mask[row_indices]


@numpy_or_compiled
def _masked_mean(voltages, usable_mask):
    xp = namespace(voltages, usable_mask)
    num_usable = usable_mask.sum(axis=0)
    voltage_sum = xp.where(usable_mask, voltages, 0).sum(axis=0)
    return xp.where(num_usable > 0, voltage_sum / xp.maximum(num_usable, 1), xp.nan), num_usable > 0
