"""Pressed skins: from loads to conductivity to voltages, with drift and the response of the material.

The effective pressure q of a material follows from the pressure p over time by hysteresis, then creep.

**Hysteresis** is a generalised play operator (Visintin, Differential Models of Hysteresis, 1994, section III.2) between
the curve w = p, on which the load rises, and the curve w = p / (1 − H), on which it falls; between the curves, w is
constant. It does not depend on the rate. Both curves end at zero, and their maximum difference after a load p is H p.

**Creep** is that of a standard linear solid with several branches, in which a share a_k of w is delayed:

q = (1 − Σ a_k) w + Σ a_k y_k, τ_k dy_k/dt = w − y_k,

solved exactly for w that is linear between two times.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jeit.arguments import check_key, check_kind, check_name, describe, is_number, real_array
from jeit.design.skin.reached_cells import is_curved
from jeit.design.skin.touched_cells import TouchedCells, pad_rows
from jeit.design.skin.voltage_changes import touch_changes
from jeit.forward import ForwardModel
from jeit.forward.changes import ContactSensitivity
from jeit.forward.model import check_model, select_channels
from jeit.forward.system import check_conductivity
from jeit.mesh import Mesh, centroids, measures
from jeit.touch.simulate.contact.cell_pressure import pressed_cells
from jeit.touch.simulate.contact.materials import Material
from jeit.touch.simulate.contact.press import MovingPress, Press, motions_of, touches_of
from jeit.touch.simulate.contact.samples import Samples
from jeit_solvers.engines import as_array
from jeit_solvers.module import Module


def standard_normal(key: Array, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Draw standard normal numbers with `jax.random.normal`. The number of draws is rounded up to a power of two, so
    that fewer programs are compiled for records of different lengths."""
    number = math.prod(shape)
    return np.asarray(jax.random.normal(key, (1 << max(number - 1, 0).bit_length(),)))[:number].reshape(shape)


def random_walk(
    key: Array, seconds: Float[np.ndarray, " T"], trend: float, deviation: float, count: int
) -> Float[np.ndarray, "T k"]:
    """Logarithms (T, k) of `count` = k drifting quantities, 0 at time 0: a common `trend` per second, and an
    independent random walk with standard `deviation` per √s for each. `seconds`: (T,), in ascending order."""
    steps = np.diff(seconds, prepend=0.0)
    normal = standard_normal(key, (len(steps), count))
    return trend * np.asarray(seconds)[:, None] + deviation * np.cumsum(np.sqrt(steps)[:, None] * normal, axis=0)


def draw_gains(key: Array, spread: float, num_channels: int) -> Float[np.ndarray, " M"]:
    """Draw gains of `num_channels` channels, log-normal about 1; `spread`: standard deviation of the logarithm."""
    return np.exp(spread * standard_normal(key, (num_channels,)))


def white_noise(key: Array, deviation: float, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Draw independent normal noise with standard `deviation`, volts."""
    return deviation * standard_normal(key, shape)


class MaterialState(NamedTuple):
    """State of a material at m points, in pascals. **Fields**: `held`: (m,), output w of the hysteresis; `late`: (k,
    m), states y of the delayed branches."""

    held: Float[np.ndarray, " m"]
    late: Float[np.ndarray, "k m"]


def unloaded_state(material: Material, num_points: int) -> MaterialState:
    """State of a material at `num_points` points without earlier load."""
    return MaterialState(np.zeros(num_points), np.zeros((len(material.creep), num_points)))


def advance_state(
    material: Material, state: MaterialState, pressure: Float[np.ndarray, " m"], seconds: float
) -> tuple[MaterialState, Float[np.ndarray, " m"]]:
    """Advance the state `state` by a time step in `seconds` to `pressure` (m,); return the new state and the effective
    pressure (m,), pascals."""
    held = np.maximum(pressure, np.minimum(state.held, pressure / (1 - material.hysteresis)))
    shares, times = _branches(material)
    late = state.late
    if seconds > 0:
        passed = seconds / times
        kept = np.exp(-passed)
        slope = 1 + np.expm1(-passed) / passed
        late = kept * late + (1 - kept) * state.held + slope * (held - state.held)
    return MaterialState(held, late), (1 - shares.sum()) * held + np.sum(shares * late, axis=0)


def held_pressure(material: Material, pressure: Float[np.ndarray, "..."], seconds: float) -> Float[np.ndarray, "..."]:
    """Effective pressure (…), pascals, under a first load that was applied suddenly and held for `seconds`."""
    shares, times = _branches(material)
    return np.asarray(pressure) * (1 - np.sum(shares * np.exp(-seconds / times)))


def _branches(material: Material) -> tuple[np.ndarray, np.ndarray]:
    """Shares (k, 1) and time constants (k, 1), in seconds, of the creep branches."""
    pairs = np.array(material.creep, float).reshape(-1, 2)
    return pairs[:, :1], pairs[:, 1:]


# Number of touches processed at once; numbers of cells that separate groups of touches; and ratio of the extent of a
# touch to the root of its area, above which its contacts are taken to be apart.
_AT_ONCE, _CELLS, _APART = 1024, (128, 512, 2048), 3.0
# Changes below this share of the maximum change of a touch are neglected.
_LEAST = 1e-6


class PressedSkin(Module):
    """A sheet or layer of a material that is pressed. Voltages are exact; they are computed by low-rank updates of one
    factorisation.

    The sheet may be a surface in space, and the layer a shell. Presses are then at (x, y, z), and the support of the
    material must be a `Foundation`.

    **Arguments:**

    - `key`: random key from which the gains of the channels are drawn.
    - `model`: forward model of a sheet, or of a layer with its top at the maximum z.
    - `material`: the material.
    - `conductivity`: conductivity at rest, S/m (2-D: S); may be tensors, which are scaled by presses. By default that
      of the material.
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
        """Create a skin with random gains drawn with `key`.

        `conductivity`: at rest, S/m (2-D: S); default: that of the material. `face`: as in
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

    def rest(self) -> Float[np.ndarray, " M"]:
        """Voltages (M,) of the untouched skin with gains, but without drift and noise."""
        return self.gain * self._exact_rest

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
        description of the progress. Raises `ValueError` for presses off the skin or through it, and for invalid
        arguments.
        """
        check_key(key)
        check_seconds("held", held)
        check_seconds("elapsed", elapsed)
        exact = self.voltages_under(self.touched(presses, held=held, progress=progress), progress=progress)
        return self.read(key, exact, np.array([float(elapsed)]))

    def touched(
        self,
        presses: Sequence[Press | Sequence[Press]],
        *,
        held: float = 1.0,
        progress: Callable[[str], None] | None = None,
    ) -> TouchedCells:
        """Cells whose conductivity is changed by n touches, and their relative changes. Arguments as in `frames`.
        Raises `ValueError` as `frames`."""
        touches = touches_of(presses)
        pressed = pressed_cells(Samples.from_mesh(self.model.mesh, self.face), self.material.support, touches, progress)
        change = self.material.change(held_pressure(self.material, pressed.pressure, held)).mean(axis=-1)
        places = np.array([touch[0].position if touch else np.zeros(self._dimension) for touch in touches])
        return _collect_changes(places, pressed.cells, change, self.model.mesh.num_cells)

    def record(
        self,
        key: Array,
        motions: MovingPress | Sequence[MovingPress],
        seconds: Float[np.ndarray, " T"],
        *,
        progress: Callable[[str], None] | None = None,
    ) -> Float[np.ndarray, "T M"]:
        """Simulate voltages (T, M) at times `seconds` (T,) of a skin under moving presses.

        `motions`: a `MovingPress`, a list of simultaneous ones, or `[]` for an untouched skin. The skin has had no load
        before the first frame, and drifts from time 0. `progress` is called with a description of the progress. Raises
        `ValueError` for times that are negative or decrease, for motions of other lengths, and as `frames`.
        """
        check_key(key)
        seconds = _check_times(seconds)
        exact = self.voltages_under(self.touched_in_time(motions, seconds, progress=progress), progress=progress)
        return self.read(key, exact, seconds)

    def record_each(
        self,
        key: Array,
        recordings: Sequence[tuple[MovingPress | Sequence[MovingPress], Float[np.ndarray, " T"]]],
        *,
        progress: Callable[[str], None] | None = None,
    ) -> list[Float[np.ndarray, "T M"]]:
        """Simulate the voltages (T, M) of several recordings, given as pairs of motions and times as in `record`.

        Each recording begins with a skin without earlier load. Many recordings are processed together, which is much
        faster than one by one. Raises `ValueError` for elements that are not pairs, and as `record`.
        """
        check_key(key)
        wanted = "a list of pairs of motions and seconds, one for each recording"
        check_kind("recordings", recordings, (list, tuple), wanted)
        for number, pair in enumerate(recordings):
            if not (isinstance(pair, tuple) and len(pair) == 2):
                raise ValueError(f"recordings[{number}]: give {wanted}; it is {describe(pair)}.")
        if not recordings:
            return []
        times = [_check_times(seconds) for _, seconds in recordings]
        each = [self.touched_in_time(motions, own) for (motions, _), own in zip(recordings, times, strict=True)]
        exact = self.voltages_under(_concatenate(each), progress=progress)
        parts = np.split(exact, np.cumsum([len(own) for own in times])[:-1])
        keys = jax.random.split(key, len(times))
        return [self.read(one, part, own) for one, part, own in zip(keys, parts, times, strict=True)]

    def touched_in_time(
        self,
        motions: MovingPress | Sequence[MovingPress],
        seconds: Float[np.ndarray, " T"],
        *,
        progress: Callable[[str], None] | None = None,
    ) -> TouchedCells:
        """Cells whose conductivity is changed in each of T frames, also by earlier loads, and their relative changes.
        Arguments as in `record`. Raises `ValueError` as `record`."""
        seconds = _check_times(seconds)
        motions = motions_of(motions, len(seconds))
        found = [[motion.at(frame) for motion in motions] for frame in range(len(seconds))]
        touches = [tuple(press for press in some if press is not None) for some in found]
        pressed = pressed_cells(Samples.from_mesh(self.model.mesh, self.face), self.material.support, touches, progress)
        there = [own.any(axis=-1) for own in pressed.pressure]
        cells = np.unique(pressed.cells[np.array(there)]) if motions else np.zeros(1, int)
        place = np.searchsorted(cells, pressed.cells)
        shape = len(cells), pressed.pressure.shape[-1]
        strain, before = unloaded_state(self.material, cells.size * shape[1]), seconds[0]
        change = np.zeros((len(seconds), len(cells)))
        for frame, now in enumerate(seconds):
            pressure = np.zeros(shape)
            pressure[place[frame][there[frame]]] = pressed.pressure[frame][there[frame]]
            strain, effective = advance_state(self.material, strain, pressure.ravel(), now - before)
            change[frame], before = self.material.change(effective.reshape(shape)).mean(axis=-1), now
        places = np.array([touch[0].position if touch else np.zeros(self._dimension) for touch in touches])
        return _collect_changes(places, np.broadcast_to(cells, change.shape), change, self.model.mesh.num_cells)

    def voltages_under(
        self, touched: TouchedCells, *, progress: Callable[[str], None] | None = None
    ) -> Float[np.ndarray, "n M"]:
        """Voltages (n, M) of the model under n touches, without gains, drift and noise.

        `progress` is called with the number of touches done. Raises as `touch_changes`.
        """
        done = 0
        voltages = np.tile(self._exact_rest, (len(touched.places), 1))
        places, cells, change = (np.asarray(one) for one in (touched.places, touched.cells, touched.change))
        for alike in _groups_of_similar_cost(self.model.mesh, cells, change):
            for some in np.split(alike, range(_AT_ONCE, len(alike), _AT_ONCE)):
                even = some[np.minimum(np.arange(_round_up(len(some))), len(some) - 1)]
                own = slice(0, _round_up(int(np.count_nonzero(change[some], axis=1).max())))
                arrays = as_array(places[even]), as_array(cells[even, own]), as_array(change[even, own])
                rows = TouchedCells(*arrays, num_cells=touched.num_cells)
                voltages[some] += np.asarray(touch_changes(self.model, self.conductivity, rows))[: len(some)]
                done += len(some)
                if progress is not None:
                    progress(f"voltages: {done} of {len(voltages)}")
        return voltages

    def read(
        self, key: Array, exact: Float[np.ndarray, "n M"], seconds: Float[np.ndarray, " t"]
    ) -> Float[np.ndarray, "n M"]:
        """Add drift, gains and noise to exact voltages (n, M) at times `seconds`, (n,) or (1,) for all; return volts.

        Voltages for conductivity e^d σ and contact impedances e^c z are those for σ and e^(c + d) z, divided by e^d.
        The effect of contacts is linearised about the skin at rest. Raises `ValueError` for an invalid key.
        """
        check_key(key)
        for_conductivity, for_contacts, for_noise = jax.random.split(key, 3)
        own = self.material
        drift = random_walk(for_conductivity, seconds, own.conductivity_trend, own.conductivity_walk, 1)
        if drift.any() or own.contact_trend or own.contact_walk:
            number = self.model.electrodes.num_electrodes
            contacts = random_walk(for_contacts, seconds, own.contact_trend, own.contact_walk, number)
            exact = (exact + (contacts + drift) @ self._contact_slope) * np.exp(-drift)
        deviation = own.noise * float(np.sqrt(np.mean(self._exact_rest**2)))
        return self.gain * (exact + white_noise(for_noise, deviation, exact.shape))

    @property
    def _dimension(self) -> int:
        """Number of coordinates of the positions of presses."""
        return 3 if is_curved(self.model.mesh) else 2

    @cached_property
    def _exact_rest(self) -> Float[np.ndarray, " M"]:
        """Voltages (M,) of the model at rest."""
        return np.asarray(self.model.voltages(self.conductivity))

    @cached_property
    def _contact_slope(self) -> Float[np.ndarray, "L M"]:
        """Derivative ∂v/∂log z (L, M) of the voltages at rest by the logarithms of the contact impedances, volts; zero
        for point electrodes."""
        electrodes, protocol = self.model.electrodes, self.model.protocol
        if electrodes.is_point:
            return np.zeros((electrodes.num_electrodes, protocol.num_measurements))
        fields, impedance = (np.asarray(one) for one in self.model.fields(self.conductivity))
        slope = ContactSensitivity(self.model.mesh, electrodes)(fields, impedance, electrodes.contact_impedance)
        return np.stack([select_channels(protocol, one) for one in slope])


def _collect_changes(places, cells, change, num_cells: int) -> TouchedCells:
    """Collect the changes that are not negligible as `TouchedCells`, padded with zeros at the end of each row."""
    kept = np.abs(change) > _LEAST * np.abs(change).max(axis=1, keepdims=True)
    rows, there = pad_rows([row[one] for row, one in zip(cells, kept, strict=True)])
    wide = _round_up(rows.shape[1]) - rows.shape[1]
    changes = np.zeros(rows.shape)
    changes[there] = change[kept]
    rows, changes = (np.pad(array, ((0, 0), (0, wide))) for array in (rows, changes))
    return TouchedCells(as_array(places), as_array(rows), as_array(changes), num_cells)


def _concatenate(each: Sequence[TouchedCells]) -> TouchedCells:
    """Concatenate the touched cells of several recordings, padded with zeros at the end of each row."""
    wide = max(one.cells.shape[1] for one in each)

    def concatenate(name: str) -> Array:
        arrays = [np.asarray(getattr(one, name)) for one in each]
        return as_array(np.concatenate([np.pad(one, ((0, 0), (0, wide - one.shape[1]))) for one in arrays]))

    places = as_array(np.concatenate([np.asarray(one.places) for one in each]))
    return TouchedCells(places, concatenate("cells"), concatenate("change"), each[0].num_cells)


def _groups_of_similar_cost(
    mesh: Mesh, cells: Int[np.ndarray, "n c"], change: Float[np.ndarray, "n c"]
) -> list[np.ndarray]:
    """Group touches by similar cost, and return the numbers of the touches in each group.

    Groups differ in the number of touched cells, and in whether these are close together or form contacts that are
    apart. Touches without changes are left out.
    """
    there = change != 0
    number = there.sum(axis=1)
    middles = np.asarray(centroids(mesh))[:, : 3 if is_curved(mesh) else 2][cells]
    low, high = (find(np.where(there[..., None], middles, far), axis=1) for find, far in ((np.min, 1), (np.max, -1)))
    area = np.sum(np.where(there, np.asarray(measures(mesh))[cells], 0.0), axis=1)
    apart = np.linalg.norm(high - low, axis=1) > _APART * np.sqrt(area)
    kinds = np.where(number > 0, 1 + 2 * np.searchsorted(_CELLS, number) + apart, 0)
    return [np.flatnonzero(kinds == kind) for kind in np.unique(kinds[kinds > 0])]


def _round_up(count: int) -> int:
    """Round up to a power of two, at least 16, since JAX compiles a program for every number of touches and cells."""
    return 2 ** max(4, (count - 1).bit_length())


def check_seconds(name: str, value) -> None:
    """Check that the argument `name` is a time in seconds, zero or more. Raises `ValueError` otherwise."""
    if not (is_number(value) and value >= 0):
        raise ValueError(f"{name} must be seconds, zero or more; it is {describe(value)}.")


def _check_times(seconds) -> Float[np.ndarray, " T"]:
    seconds = real_array("seconds", seconds, "times (T,) of the frames")
    if seconds.ndim != 1 or not seconds.size or not np.isfinite(seconds).all():
        raise ValueError(f"seconds must be times (T,) of the frames; they have shape {seconds.shape}.")
    if seconds[0] < 0 or (np.diff(seconds) < 0).any():
        raise ValueError("seconds must not be negative, nor fall.")
    return seconds
