"""Pressed skins: compute conductivity from loads, and voltages from conductivity, with hysteresis, creep and drift."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jeit.arguments import check_key, check_kind, check_name, describe, is_number, real_array
from jeit.design.skin.touched_cells import TouchedCells, is_curved, pad_rows
from jeit.design.skin.voltage_changes import RestingSkin, touch_changes
from jeit.forward import ForwardModel
from jeit.forward.changes import ContactSensitivity
from jeit.forward.model import check_model, select_channels
from jeit.forward.system import check_conductivity
from jeit.mesh import Mesh, centroids, measures
from jeit.touch.simulate.contact.cell_pressure import pressed_cells
from jeit.touch.simulate.contact.materials import Material, advance_state, creep_pressure, unloaded_state
from jeit.touch.simulate.contact.press import MovingPress, Press, convert_to_motions, convert_to_touches
from jeit.touch.simulate.contact.samples import Samples
from jeit_solvers.engines import as_array, on_host
from jeit_solvers.module import Module

# Minimum number of normal numbers drawn at once.
_MIN_DRAWS = 2**12


def standard_normal(key: Array, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Draw standard normal numbers with `jax.random.normal`. The number of draws is rounded up to a power of two,
    and to one number for gains, drift and short recordings, so that JAX compiles fewer programs. The first draws are
    the same for any number."""
    num_draws = math.prod(shape)
    padded_num_draws = max(1 << max(num_draws - 1, 0).bit_length(), _MIN_DRAWS)
    return np.asarray(jax.random.normal(key, (padded_num_draws,)))[:num_draws].reshape(shape)


def split_keys(key: Array, number: int) -> list[Array]:
    """Split a random key into a list of keys. Iterating over an array of keys would compile a program for each length
    of the array."""
    keys = jax.random.split(key, number)
    return [keys[key_index] for key_index in range(number)]


def random_walk(
    key: Array, seconds: Float[np.ndarray, " T"], common_trend: float, deviation: float, count: int
) -> Float[np.ndarray, "T k"]:
    """Draw logarithms (T, k) of k = `count` drifting quantities, 0 at time 0: a common `common_trend` per second plus
    independent random walks of standard `deviation` per √s. `seconds`: times (T,), in ascending order."""
    time_steps = np.diff(seconds, prepend=0.0)
    normal_draws = standard_normal(key, (len(time_steps), count))
    return common_trend * np.asarray(seconds)[:, None] + deviation * np.cumsum(
        np.sqrt(time_steps)[:, None] * normal_draws, axis=0
    )


def draw_gains(key: Array, gain_deviation: float, num_channels: int) -> Float[np.ndarray, " M"]:
    """Draw log-normal gains of channels (M,), with median 1; `gain_deviation`: standard deviation of the logarithm."""
    return np.exp(gain_deviation * standard_normal(key, (num_channels,)))


def white_noise(key: Array, deviation: float, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Draw independent normal noise with standard `deviation`, volts."""
    return deviation * standard_normal(key, shape)


# Number of touches processed at once.
_TOUCHES_AT_ONCE = 1024
# Maximum size of the inverse of a system matrix between all nodes.
_MAX_INVERSE_BYTES = 160 * 2**20
# Limits between groups of touches, in numbers of cells.
_GROUP_CELL_LIMITS = (128, 512, 2048)
# Ratio of the extent of a touch to the square root of its area above which the touch is assumed to consist of
# separate contacts.
_MIN_SEPARATION = 3.0
# Changes below this share of the maximum change of a touch are neglected.
_MIN_RELATIVE_CHANGE = 1e-6


class PressedSkin(Module):
    """Simulated skin, a sheet or a layer of a material, whose voltages under presses are computed.

    Voltages are computed exactly, by low-rank updates of one factorisation. The sheet may be a surface in space, and
    the layer a shell. On such a curved skin, presses are at (x, y, z), and the support of the material must be a
    `Foundation`.

    **Arguments:**

    - `key`: random key from which the gains of the channels are drawn.
    - `model`: forward model of a sheet, or of a layer with its top at the maximum z.
    - `material`: the material.
    - `conductivity`: conductivity at rest, S/m (2-D: S), by default that of the material; may be tensors, which presses
      multiply by a scalar.
    - `face`: pressed face of a curved layer, "outer" or "inner".

    **Fields**: the arguments except `key`, and `gain` (M,): gain of each channel.

    **Example:**

    ```python
    skin = PressedSkin(key, model, material("velostat"))
    frames = skin.frames(key, [Press(DiscIndenter(0.01), 2.0, (0.01, 0.02))])
    ```
    """

    model: ForwardModel
    material: Material
    conductivity: Float[np.ndarray, "..."]
    gain: Float[np.ndarray, " M"]
    face: str = eqx.field(static=True)

    def __init__(
        self,
        key: Array,
        model: ForwardModel,
        material: Material,
        *,
        conductivity: ArrayLike | None = None,
        face: str = "outer",
    ):
        """Create a skin with random gains of the channels drawn with `key`.

        `conductivity`: conductivity at rest, S/m (2-D: S); default: that of the material. `face`: as in
        `jeit.design.Skin.touched_face`. Raises `ValueError` for invalid arguments.
        """
        check_key(key)
        check_model(model)
        check_kind("material", material, Material, 'a Material, such as material("velostat")')
        if conductivity is None:
            conductivity = material.conductivity * (material.thickness if model.mesh.dimension == 2 else 1.0)
        check_name("face", face, ("outer", "inner"))
        self.model, self.material, self.face = model, material, face
        self.conductivity = np.asarray(check_conductivity(model.mesh, conductivity))
        self.gain = draw_gains(key, material.gain_spread, model.protocol.num_measurements)

    def __getstate__(self) -> dict[str, Any]:
        """The skin without its large inverse, which would be sent to each worker of a cluster."""
        return {attribute: content for attribute, content in self.__dict__.items() if attribute != "_resting_skin"}

    def rest(self) -> Float[np.ndarray, " M"]:
        """Return the voltages (M,) of the untouched skin with gains, but without drift and noise."""
        return self.gain * self._rest_voltages

    def frames(
        self,
        key: Array,
        presses: Sequence[Press | Sequence[Press]],
        *,
        held: float = 1.0,
        elapsed: float = 0.0,
        progress: Callable[[str], None] | None = None,
    ) -> Float[np.ndarray, "n M"]:
        """Simulate the voltages (n, M) of n touches of a skin without earlier load.

        `presses`: for each touch, a press or a tuple of simultaneous presses. `held`: duration of the load, seconds.
        `elapsed`: time during which the skin has drifted, seconds, the same for all frames. `progress` is called with a
        description of the progress. Raises `ValueError` for presses off the skin, loads that press through the skin,
        and invalid arguments.
        """
        check_key(key)
        check_seconds("held", held)
        check_seconds("elapsed", elapsed)
        exact_voltages = self.voltages_under(self.touched(presses, held=held, progress=progress), progress=progress)
        return self.read(key, exact_voltages, np.array([float(elapsed)]))

    def touched(
        self,
        presses: Sequence[Press | Sequence[Press]],
        *,
        held: float = 1.0,
        progress: Callable[[str], None] | None = None,
    ) -> TouchedCells:
        """Compute which cells change their conductivity under n touches, and their relative changes. Arguments and
        errors: see `frames`."""
        touches = convert_to_touches(presses)
        contact = pressed_cells(Samples.from_mesh(self.model.mesh, self.face), self.material.support, touches, progress)
        changes = self.material.change(creep_pressure(self.material, contact.pressure, held)).mean(axis=-1)
        places = np.array([touch[0].position if touch else np.zeros(self._dimension) for touch in touches])
        return _collect_changes(places, contact.cells, changes, self.model.mesh.num_cells)

    def record(
        self,
        key: Array,
        motions: MovingPress | Sequence[MovingPress],
        seconds: Float[np.ndarray, " T"],
        *,
        progress: Callable[[str], None] | None = None,
    ) -> Float[np.ndarray, "T M"]:
        """Simulate voltages (T, M) at times `seconds` (T,) of a skin under moving presses.

        `motions`: a `MovingPress`, a list of simultaneous moving presses, or `[]` for an untouched skin. The skin has
        had no load before the first frame, and drifts from time 0. `progress` is called with a description of the
        progress. Raises `ValueError` for times that are negative or decrease, for motions with more or fewer frames
        than times, and as `frames` does.
        """
        check_key(key)
        seconds = _check_times(seconds)
        exact_voltages = self.voltages_under(
            self.touched_in_time(motions, seconds, progress=progress), progress=progress
        )
        return self.read(key, exact_voltages, seconds)

    def record_each(
        self,
        key: Array,
        recordings: Sequence[tuple[MovingPress | Sequence[MovingPress], Float[np.ndarray, " T"]]],
        *,
        progress: Callable[[str], None] | None = None,
    ) -> list[Float[np.ndarray, "T M"]]:
        """Simulate the voltages (T, M) of several recordings, given as pairs of motions and times as in `record`.

        Each recording begins with a skin without earlier load. Many recordings are processed together, which is much
        faster than one by one. Raises `ValueError` for elements that are not pairs, and as `record` does.
        """
        check_key(key)
        expected_kind = "a list of pairs of motions and seconds, one for each recording"
        check_kind("recordings", recordings, (list, tuple), expected_kind)
        for recording_index, recording in enumerate(recordings):
            if not (isinstance(recording, tuple) and len(recording) == 2):
                raise ValueError(f"recordings[{recording_index}]: give {expected_kind}; it is {describe(recording)}.")
        if not recordings:
            return []
        times = [_check_times(seconds) for _, seconds in recordings]
        touched_of_recordings = [
            self.touched_in_time(motions, recording_times)
            for (motions, _), recording_times in zip(recordings, times, strict=True)
        ]
        exact_voltages = self.voltages_under(_join_recordings(touched_of_recordings), progress=progress)
        voltages_of_recordings = np.split(
            exact_voltages, np.cumsum([len(recording_times) for recording_times in times])[:-1]
        )
        recording_keys = split_keys(key, len(times))
        return [
            self.read(recording_key, recording_voltages, recording_times)
            for recording_key, recording_voltages, recording_times in zip(
                recording_keys, voltages_of_recordings, times, strict=True
            )
        ]

    def touched_in_time(
        self,
        motions: MovingPress | Sequence[MovingPress],
        seconds: Float[np.ndarray, " T"],
        *,
        progress: Callable[[str], None] | None = None,
    ) -> TouchedCells:
        """Compute which cells change their conductivity in each of T frames, also due to earlier loads, and their
        relative changes. The arguments are those of `record`, which raises the same errors."""
        seconds = _check_times(seconds)
        motions = convert_to_motions(motions, len(seconds))
        presses_of_frames = [[motion.at(frame_index) for motion in motions] for frame_index in range(len(seconds))]
        touches = [tuple(press for press in frame_presses if press is not None) for frame_presses in presses_of_frames]
        contact = pressed_cells(Samples.from_mesh(self.model.mesh, self.face), self.material.support, touches, progress)
        is_pressed = [frame_pressure.any(axis=-1) for frame_pressure in contact.pressure]
        cells = np.unique(contact.cells[np.array(is_pressed)]) if motions else np.zeros(1, int)
        cell_positions = np.searchsorted(cells, contact.cells)
        pressure_shape = len(cells), contact.pressure.shape[-1]
        material_state, previous_time = unloaded_state(self.material, cells.size * pressure_shape[1]), seconds[0]
        changes = np.zeros((len(seconds), len(cells)))
        for frame_index, frame_time in enumerate(seconds):
            cell_pressure = np.zeros(pressure_shape)
            cell_pressure[cell_positions[frame_index][is_pressed[frame_index]]] = contact.pressure[frame_index][
                is_pressed[frame_index]
            ]
            material_state, creep_pressures = advance_state(
                self.material, material_state, cell_pressure.ravel(), frame_time - previous_time
            )
            changes[frame_index], previous_time = (
                self.material.change(creep_pressures.reshape(pressure_shape)).mean(axis=-1),
                frame_time,
            )
        places = np.array([touch[0].position if touch else np.zeros(self._dimension) for touch in touches])
        return _collect_changes(places, np.broadcast_to(cells, changes.shape), changes, self.model.mesh.num_cells)

    def voltages_under(
        self, touched: TouchedCells, *, progress: Callable[[str], None] | None = None
    ) -> Float[np.ndarray, "n M"]:
        """Compute the voltages (n, M) of the model under n touches, without gains, drift and noise.

        `progress` is called with a message on the number of touches computed so far. Raises the errors of
        `touch_changes`.
        """
        num_finished = 0
        voltages = np.tile(self._rest_voltages, (len(touched.places), 1))
        places, cells, changes = (np.asarray(array) for array in (touched.places, touched.cells, touched.change))
        for touch_group in _groups_of_similar_cost(self.model.mesh, cells, changes):
            for touch_chunk in np.split(touch_group, range(_TOUCHES_AT_ONCE, len(touch_group), _TOUCHES_AT_ONCE)):
                padded_chunk = touch_chunk[np.minimum(np.arange(_round_up(len(touch_chunk))), len(touch_chunk) - 1)]
                used_columns = slice(0, _round_up(int(np.count_nonzero(changes[touch_chunk], axis=1).max())))
                chunk_arrays = (
                    as_array(places[padded_chunk]),
                    as_array(cells[padded_chunk, used_columns]),
                    as_array(changes[padded_chunk, used_columns]),
                )
                chunk_touches = TouchedCells(*chunk_arrays, num_cells=touched.num_cells)
                voltages[touch_chunk] += self._exact_changes(chunk_touches)[: len(touch_chunk)]
                num_finished += len(touch_chunk)
                if progress is not None:
                    progress(f"voltages: {num_finished} of {len(voltages)}")
        return voltages

    def read(
        self, key: Array, exact: Float[np.ndarray, "n M"], seconds: Float[np.ndarray, " t"]
    ) -> Float[np.ndarray, "n M"]:
        """Add drift, gains and noise to exact voltages (n, M) at times `seconds`, (n,) or (1,) for all; return volts.

        Drift makes the conductivity e^d σ and the contact impedances e^c z. The voltages are those for σ and e^(c + d)
        z, divided by e^d. The effect of contact impedances is linearised about the skin at rest. Raises `ValueError`
        for an invalid key.
        """
        check_key(key)
        conductivity_key, contact_key, noise_key = jax.random.split(key, 3)
        material = self.material
        conductivity_drift = random_walk(
            conductivity_key, seconds, material.conductivity_trend, material.conductivity_walk, 1
        )
        if conductivity_drift.any() or material.contact_trend or material.contact_walk:
            num_electrodes = self.model.electrodes.num_electrodes
            contact_drift = random_walk(
                contact_key, seconds, material.contact_trend, material.contact_walk, num_electrodes
            )
            exact = (exact + (contact_drift + conductivity_drift) @ self._contact_derivative) * np.exp(
                -conductivity_drift
            )
        noise_deviation = material.noise * float(np.sqrt(np.mean(self._rest_voltages**2)))
        return self.gain * (exact + white_noise(noise_key, noise_deviation, exact.shape))

    def _exact_changes(self, touched: TouchedCells) -> Float[np.ndarray, "n M"]:
        """Exact changes (n, M), volts, of the voltages due to n touches of similar cost."""
        if self._resting_skin is None:
            return np.asarray(touch_changes(self.model, self.conductivity, touched))
        return self._resting_skin.changes_of_equal_touches(touched)

    @cached_property
    def _resting_skin(self) -> RestingSkin | None:
        """The skin at rest, which is solved once, and by one program, for all touches; None if its mesh is too large
        for the inverse between all nodes."""
        all_nodes = np.ones(self.model.mesh.num_points, bool)
        return RestingSkin.create(self.model, self.conductivity, all_nodes, max_bytes=_MAX_INVERSE_BYTES)

    @property
    def _dimension(self) -> int:
        """Number of coordinates of the position of a press."""
        return 3 if is_curved(self.model.mesh) else 2

    @cached_property
    def _rest_voltages(self) -> Float[np.ndarray, " M"]:
        """Voltages (M,) of the model at rest."""
        return np.asarray(self.model.voltages(self.conductivity))

    @cached_property
    def _contact_derivative(self) -> Float[np.ndarray, "L M"]:
        """Derivative ∂v/∂log z (L, M), volts, of the M voltages at rest with respect to the logarithms of the contact
        impedances of the L electrodes; zero for point electrodes."""
        electrodes, protocol = self.model.electrodes, self.model.protocol
        if electrodes.is_point:
            return np.zeros((electrodes.num_electrodes, protocol.num_measurements))
        fields, impedance = (np.asarray(array) for array in self.model.fields(self.conductivity))
        derivatives = ContactSensitivity(self.model.mesh, electrodes)(fields, impedance, electrodes.contact_impedance)
        return np.stack([select_channels(*on_host((protocol, derivative))) for derivative in derivatives])


def _collect_changes(places, cells, changes, num_cells: int) -> TouchedCells:
    """Collect the changes of cells that are not negligible as `TouchedCells`, whose rows are padded with zeros."""
    is_significant = np.abs(changes) > _MIN_RELATIVE_CHANGE * np.abs(changes).max(axis=1, keepdims=True)
    padded_cells, is_not_padding = pad_rows(
        [row_cells[is_kept] for row_cells, is_kept in zip(cells, is_significant, strict=True)]
    )
    num_padding = _round_up(padded_cells.shape[1]) - padded_cells.shape[1]
    significant_changes = np.zeros(padded_cells.shape)
    significant_changes[is_not_padding] = changes[is_significant]
    padded_cells, significant_changes = (
        np.pad(array, ((0, 0), (0, num_padding))) for array in (padded_cells, significant_changes)
    )
    return TouchedCells(as_array(places), as_array(padded_cells), as_array(significant_changes), num_cells)


def _join_recordings(touched_of_recordings: Sequence[TouchedCells]) -> TouchedCells:
    """Concatenate the touched cells of several recordings, padded with zeros at the end of each row."""
    max_num_cells = max(touched.cells.shape[1] for touched in touched_of_recordings)

    def join_field(field_name: str) -> Array:
        arrays = [np.asarray(getattr(touched, field_name)) for touched in touched_of_recordings]
        return as_array(
            np.concatenate([np.pad(touched, ((0, 0), (0, max_num_cells - touched.shape[1]))) for touched in arrays])
        )

    places = as_array(np.concatenate([np.asarray(touched.places) for touched in touched_of_recordings]))
    return TouchedCells(places, join_field("cells"), join_field("change"), touched_of_recordings[0].num_cells)


def _groups_of_similar_cost(
    mesh: Mesh, cells: Int[np.ndarray, "n c"], relative_changes: Float[np.ndarray, "n c"]
) -> list[np.ndarray]:
    """Group touches whose voltages cost similar computing time; return the numbers of the touches in each group.

    Groups differ in the number of touched cells, and in whether the cells are close together or form separate contacts.
    Touches without changes are left out.
    """
    is_changed = relative_changes != 0
    num_changed = is_changed.sum(axis=1)
    cell_centres = np.asarray(centroids(mesh))[:, : 3 if is_curved(mesh) else 2][cells]
    lower_corners, upper_corners = (
        extremum(np.where(is_changed[..., None], cell_centres, padding_coordinate), axis=1)
        for extremum, padding_coordinate in ((np.min, 1), (np.max, -1))
    )
    changed_areas = np.sum(np.where(is_changed, np.asarray(measures(mesh))[cells], 0.0), axis=1)
    is_far_apart = np.linalg.norm(upper_corners - lower_corners, axis=1) > _MIN_SEPARATION * np.sqrt(changed_areas)
    group_numbers = np.where(
        num_changed > 0, 1 + 2 * np.searchsorted(_GROUP_CELL_LIMITS, num_changed) + is_far_apart, 0
    )
    return [
        np.flatnonzero(group_numbers == group_number) for group_number in np.unique(group_numbers[group_numbers > 0])
    ]


def _round_up(num_items: int) -> int:
    """Round `num_items` up to a power of two, 16 or more: JAX compiles a program for every number of touches and
    cells."""
    return 2 ** max(4, (num_items - 1).bit_length())


def check_seconds(name: str, value) -> None:
    """Raise `ValueError` unless the argument `name` is a time in seconds, zero or more."""
    if not (is_number(value) and value >= 0):
        raise ValueError(f"{name} must be seconds, zero or more; it is {describe(value)}.")


def _check_times(seconds) -> Float[np.ndarray, " T"]:
    seconds = real_array("seconds", seconds, "times (T,) of the frames")
    if seconds.ndim != 1 or not seconds.size or not np.isfinite(seconds).all():
        raise ValueError(f"seconds must be times (T,) of the frames; they have shape {seconds.shape}.")
    if seconds[0] < 0 or (np.diff(seconds) < 0).any():
        raise ValueError("seconds must not be negative, nor fall.")
    return seconds
