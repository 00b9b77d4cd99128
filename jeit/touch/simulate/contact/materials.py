"""Materials of skins, with their mechanical and electrical properties, and elastic foundations.

The effective pressure q of a material follows from the pressure p over time by hysteresis, then creep.

**Hysteresis** is a generalised play operator (Visintin, Differential Models of Hysteresis, 1994, section III.2) between
the curve w = p, on which the load rises, and the curve w = p / (1 − H), on which it falls; between the curves, w is
constant. Hysteresis does not depend on the rate of loading. Both curves end at zero, and their maximum difference after
a load p is H p.

**Creep** is that of a standard linear solid with several branches, in which a share a_k of w is delayed:

q = (1 − Σ a_k) w + Σ a_k y_k, τ_k dy_k/dt = w − y_k,

solved exactly for w that is linear between two times.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_metres, check_name, describe, is_number
from jeit.touch.simulate.contact.indenters import AbstractIndenter
from jeit.touch.simulate.contact.press import (
    AbstractPressure,
    AbstractSupport,
    check_load,
    check_resolved,
    check_support,
    contact_window,
    raster,
)
from jeit_solvers.module import Module

# Number of pixels along a side of the raster on which the contact is located, and of the raster on which the approach
# that balances the load is computed.
_NUM_COARSE_PIXELS, _NUM_FINE_PIXELS = 24, 96


class FoundationPressure(AbstractPressure):
    """Pressure max(k (approach − gap), 0) on a Winkler foundation with `stiffness` k in Pa/m, evaluated at any point
    without a raster. The gap is the height of the indenter's surface at the point above its lowest point."""

    indenter: AbstractIndenter
    stiffness: float

    def at(self, points):
        """Compute the pressure at `points` (…, 2), metres, in pascals, from the heights of the indenter there."""
        return self.stiffness * np.maximum(self.approach - self.indenter.gap(points), 0.0)


class Foundation(AbstractSupport):
    """Winkler foundation: pressure p = E δ / thickness at indentation δ (Johnson, Contact Mechanics, 1985, section
    4.3).

    The model applies to layers that are thin compared with the width of the contact. **Fields**: `modulus`: modulus E
    in pascals of the layer under compression without lateral expansion; `thickness`: thickness of the layer, metres.

    **Example:**

    ```python
    foam = Foundation(modulus=1e5, thickness=5e-3)
    soft = dataclasses.replace(material("velostat"), support=foam)
    ```
    """

    modulus: float
    thickness: float

    def __init__(self, modulus: float, thickness: float):
        """Create a foundation. Raises `ValueError` for values that are not positive."""
        check_modulus(modulus)
        check_metres("thickness", thickness)
        self.modulus, self.thickness = float(modulus), float(thickness)

    @property
    def stiffness(self) -> float:
        """Pressure on the layer divided by its indentation, Pa/m."""
        return self.modulus / self.thickness

    def pressure(self, indenter: AbstractIndenter, load: float) -> FoundationPressure:
        """Compute the pressure beneath `indenter` under a `load` in newtons.

        Raises `ValueError` for a load that is not positive or that presses through the layer, and for indenters thinner
        than a pixel.
        """
        check_load(load)

        def balance_load(half_widths, num_pixels: int) -> tuple[np.ndarray, float]:
            pixel_centres, pixel_sides = raster(half_widths, num_pixels)
            pixel_gaps = indenter.gap(pixel_centres)
            pixel_areas = np.full(pixel_gaps.size, pixel_sides.prod())
            return pixel_gaps, float(solve_contact_displacement(pixel_gaps.ravel(), pixel_areas, load / self.stiffness))

        def is_pressed(half_widths, num_pixels: int) -> np.ndarray:
            pixel_gaps, approach = balance_load(half_widths, num_pixels)
            return pixel_gaps < approach

        half_widths = contact_window(is_pressed, indenter.reach, _NUM_COARSE_PIXELS)
        pixel_gaps, approach = balance_load(half_widths, _NUM_FINE_PIXELS)
        pixel_centres, pixel_sides = raster(half_widths, _NUM_FINE_PIXELS)
        check_resolved(pixel_gaps < approach, pixel_sides)
        self._check_approach(approach, load)
        contact_reach = float(
            np.linalg.norm(pixel_centres[pixel_gaps < approach], axis=-1).max() + np.hypot(*pixel_sides)
        )
        return FoundationPressure(float(load), approach, contact_reach, indenter, self.stiffness)

    def spread(self, indenter: AbstractIndenter, loads, points, areas, fall=None):
        """Compute pressures (n, q), pascals, at q points under each of n loads, which the points carry.

        On a curved skin, `fall` is added to the height of the indenter above the skin. Raises `ValueError` for a load
        that presses through the layer.
        """
        point_gaps = indenter.gap(points) if fall is None else indenter.gap(points) + fall
        indentation_depths = solve_contact_displacement(point_gaps, areas, loads / self.stiffness)
        deepest_press_index = indentation_depths.argmax()
        self._check_approach(indentation_depths[deepest_press_index], loads[deepest_press_index])
        return self.stiffness * np.maximum(indentation_depths[:, None] - point_gaps, 0.0)

    def _check_approach(self, approach: float, load: float) -> None:
        if approach >= self.thickness:
            raise ValueError(
                f"load is {load:g} N, which presses the indenter {1e3 * approach:.3g} mm into a layer "
                f"{1e3 * self.thickness:.3g} mm thick; give less load, a wider indenter or a stiffer layer."
            )


def solve_contact_displacement(
    gap: Float[np.ndarray, "*n q"], area: Float[np.ndarray, "*n q"], volume: Float[np.ndarray, "*n"] | float
) -> Float[np.ndarray, "*n"]:
    """Compute the level δ at which Σ area · max(δ − gap, 0) equals `volume`, as that of water over ground of height
    `gap`.

    The level is 0 if every gap is infinite. If the m lowest points are below the level, δ = (volume + Σ area · gap) / Σ
    area over these points. The result is exact for the smallest m for which the next point is above the level.
    """
    sort_order = np.argsort(gap, axis=-1)
    sorted_gaps = np.take_along_axis(gap, sort_order, axis=-1)
    sorted_areas = np.where(np.isfinite(sorted_gaps), np.take_along_axis(area, sort_order, axis=-1), 0.0)
    weighted_gaps = sorted_areas * np.where(sorted_areas > 0, sorted_gaps, 0.0)
    cumulative_gaps, cumulative_areas = np.cumsum(weighted_gaps, axis=-1), np.cumsum(sorted_areas, axis=-1)
    candidate_levels = (np.asarray(volume)[..., None] + cumulative_gaps) / np.where(
        cumulative_areas > 0, cumulative_areas, np.inf
    )
    next_gaps = np.concatenate([sorted_gaps[..., 1:], np.full((*sorted_gaps.shape[:-1], 1), np.inf)], axis=-1)
    first_level = np.argmax((candidate_levels <= next_gaps) & (cumulative_areas > 0), axis=-1)
    return np.take_along_axis(candidate_levels, first_level[..., None], axis=-1)[..., 0]


def check_modulus(modulus) -> None:
    """Raise `ValueError` unless an elastic modulus, pascals, is positive."""
    if not (is_number(modulus) and modulus > 0):
        raise ValueError(f"modulus must be positive, in pascals (1e6 for a soft rubber); it is {describe(modulus)}.")


class Material(Module):
    """Material of a skin: its mechanical and electrical properties, in SI units.

    To change values: `dataclasses.replace(material("velostat"), noise=0.0)`.

    **Fields**

    - `conductivity`, `thickness`: conductivity, S/m, and thickness, metres, of the conductor at rest.
    - `support`: mechanical support that carries the load.
    - `saturation`, `half_pressure`: c and p½ (pascals) of the conductivity σ = σ₀ (1 + c q / (q + p½)) under an
      effective pressure q: c is the limit of the relative change at high pressure, and p½ the pressure at half this
      change.
    - `hysteresis`: maximum difference of q between unloading and loading, divided by the maximum pressure.
    - `creep`: pairs of the share of q that responds with delay, and the time constant of this response, seconds.
    - `conductivity_trend`, `contact_trend`: relative drift of the conductivity and of the contact impedance of each
      electrode, per second.
    - `conductivity_walk`, `contact_walk`: standard deviation of the random walk of the conductivity and of the contact
      impedances, relative, per √s.
    - `noise`: standard deviation of the noise of each voltage, relative to the root mean square of all voltages.
    - `gain_spread`: standard deviation of the logarithm of the gain of each channel.

    **Example:**

    ```python
    foam = Foundation(modulus=1e5, thickness=5e-3)
    own = Material(2.0, 5e-3, foam, saturation=1.5, half_pressure=2e4, noise=1e-4)
    ```
    """

    conductivity: float
    thickness: float
    support: AbstractSupport
    saturation: float
    half_pressure: float
    hysteresis: float = 0.0
    creep: tuple[tuple[float, float], ...] = ()
    conductivity_trend: float = 0.0
    conductivity_walk: float = 0.0
    contact_trend: float = 0.0
    contact_walk: float = 0.0
    noise: float = 0.0
    gain_spread: float = 0.0

    def __check_init__(self):
        """Check the fields. Raises `ValueError` for values out of range."""
        check_metres("thickness", self.thickness)
        check_support("support", self.support)
        for field_name in ("conductivity", "half_pressure"):
            _check_number(field_name, getattr(self, field_name), lambda field_value: field_value > 0, "positive")
        _check_number(
            "saturation", self.saturation, lambda field_value: field_value > -1, "above −1, where nothing conducts"
        )
        _check_number("hysteresis", self.hysteresis, lambda field_value: 0 <= field_value < 1, "from 0 to below 1")
        for field_name in ("conductivity_walk", "contact_walk", "noise", "gain_spread"):
            _check_number(field_name, getattr(self, field_name), lambda field_value: field_value >= 0, "zero or more")
        for field_name in ("conductivity_trend", "contact_trend"):
            _check_number(field_name, getattr(self, field_name), lambda _: True, "a number")
        if not _are_creep_branches(self.creep):
            raise ValueError(
                f"creep: give (share, seconds) of every branch, shares of sum below 1, such as ((0.1, 1.0), (0.1, "
                f"60.0)); it is {self.creep!r}."
            )

    def change(self, pressure: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Compute the relative change of conductivity, c q / (q + p½), at effective pressures q (…), pascals."""
        pressure = np.asarray(pressure)
        return self.saturation * pressure / (pressure + self.half_pressure)


def _check_number(field_name: str, field_value, is_valid: Callable[[float], bool], value_requirement: str) -> None:
    if not (is_number(field_value) and is_valid(field_value)):
        raise ValueError(f"{field_name} must be {value_requirement}; it is {describe(field_value)}.")


def _are_creep_branches(creep) -> bool:
    """Whether `creep` consists of pairs (share, seconds) whose shares have a sum below 1."""
    if not isinstance(creep, (tuple, list)) or not all(
        isinstance(creep_branch, (tuple, list)) and len(creep_branch) == 2 for creep_branch in creep
    ):
        return False
    if not all(
        is_number(branch_fraction) and is_number(time_constant) and branch_fraction >= 0 and time_constant > 0
        for branch_fraction, time_constant in creep
    ):
        return False
    return sum(branch_fraction for branch_fraction, _ in creep) < 1


# Values from papers are cited; all other values are assumptions, chosen so that materials differ as their authors
# describe.
MATERIALS = {
    # From Chen et al. 2022 and Pugach et al. 2015: carbon-filled polyolefin, 500 Ω cm, 0.1 mm thick. Two equal sheets
    # have at most twice the conductivity of one; Chen's double layer approaches a limit at 39 N. Pugach describes the
    # hysteresis as high. Assumed: half of the change at 30 kPa; support by 2 mm of soft rubber; value of the
    # hysteresis; creep with 0.5 s to 2 minutes; drift; noise of -80 dB; gains.
    "velostat": Material(
        conductivity=0.2,
        thickness=1e-4,
        support=Foundation(1e6, 2e-3),
        saturation=1.0,
        half_pressure=30e3,
        hysteresis=0.15,
        creep=((0.08, 0.5), (0.07, 10.0), (0.05, 120.0)),
        conductivity_trend=1e-6,
        conductivity_walk=5e-5,
        contact_trend=2e-6,
        contact_walk=2e-4,
        noise=1e-4,
        gain_spread=0.01,
    ),
    # From Silvera Tawil et al. 2011: sheet conductance 12.5 mS, 0.6 mm thick, under 5 mm of foam, with squares of 660
    # mS that would allow 54 times the conductivity if they formed one sheet in perfect contact. From Russo et al. 2017:
    # response from 10 kPa on, elastic return, and hysteresis. Assumed: at most five times the conductivity, half of the
    # change at 20 kPa; foam with a modulus of 300 kPa; less hysteresis and creep than Velostat; drift; noise of -70 dB,
    # due to the many contacts in a fabric; gains.
    "conductive fabric": Material(
        conductivity=12.5e-3 / 0.6e-3,
        thickness=0.6e-3,
        support=Foundation(300e3, 5e-3),
        saturation=4.0,
        half_pressure=20e3,
        hysteresis=0.08,
        creep=((0.06, 0.3), (0.04, 20.0)),
        conductivity_trend=1e-6,
        conductivity_walk=1e-4,
        contact_trend=5e-6,
        contact_walk=5e-4,
        noise=3e-4,
        gain_spread=0.01,
    ),
    # From Park et al. 2022: 10 mm thick, pressing raises the impedance, hysteresis below 3 %. From jeit.design: 1 S/m.
    # Assumed: conductivity falls to a tenth at high pressure, by half of this change at 50 kPa; modulus of 100 kPa;
    # little creep; drift, since gels dry; noise of -66 dB (Park gives 0.45 Ω for a specimen of unknown resistance).
    "hydrogel": Material(
        conductivity=1.0,
        thickness=10e-3,
        support=Foundation(100e3, 10e-3),
        saturation=-0.9,
        half_pressure=50e3,
        hysteresis=0.03,
        creep=((0.02, 5.0),),
        conductivity_trend=-5e-6,
        conductivity_walk=3e-5,
        contact_trend=1e-6,
        contact_walk=1e-4,
        noise=5e-4,
        gain_spread=0.01,
    ),
}


def material(name: str) -> Material:
    """Return the material with the given name.

    **Arguments:**

    - `name`: "velostat", "conductive fabric" or "hydrogel".

    Raises `ValueError` for other names.

    **Example:**

    ```python
    quiet = dataclasses.replace(material("velostat"), noise=0.0)
    skin = PressedSkin(key, model, quiet)
    ```
    """
    check_name("name", name, MATERIALS)
    return MATERIALS[name]


class MaterialState(NamedTuple):
    """State of a material at m points, pascals. **Fields**: `hysteresis_output`: (m,), pressure w after hysteresis;
    `branch_states`: (k, m), states y of the k delayed branches of creep."""

    hysteresis_output: Float[np.ndarray, " m"]
    branch_states: Float[np.ndarray, "k m"]


def unloaded_state(material: Material, num_points: int) -> MaterialState:
    """Return the state of a material at `num_points` points without earlier load."""
    return MaterialState(np.zeros(num_points), np.zeros((len(material.creep), num_points)))


def advance_state(
    material: Material, state: MaterialState, pressure: Float[np.ndarray, " m"], seconds: float
) -> tuple[MaterialState, Float[np.ndarray, " m"]]:
    """Advance a material's `state` by a time step of `seconds`, at the end of which the material bears `pressure` (m,);
    return the new state and the effective pressure (m,), pascals."""
    hysteresis_output = np.maximum(pressure, np.minimum(state.hysteresis_output, pressure / (1 - material.hysteresis)))
    creep_fractions, time_constants = _creep_branches(material)
    branch_states = state.branch_states
    if seconds > 0:
        relative_times = seconds / time_constants
        decay_factors = np.exp(-relative_times)
        ramp_response = 1 + np.expm1(-relative_times) / relative_times
        branch_states = decay_factors * branch_states + (1 - decay_factors) * state.hysteresis_output
        branch_states += ramp_response * (hysteresis_output - state.hysteresis_output)
    return MaterialState(hysteresis_output, branch_states), (1 - creep_fractions.sum()) * hysteresis_output + np.sum(
        creep_fractions * branch_states, axis=0
    )


def creep_pressure(material: Material, pressure: Float[np.ndarray, "..."], seconds: float) -> Float[np.ndarray, "..."]:
    """Compute the effective pressure (…), pascals, under the first `pressure` on a material, applied suddenly and
    constant for `seconds`."""
    creep_fractions, time_constants = _creep_branches(material)
    return np.asarray(pressure) * (1 - np.sum(creep_fractions * np.exp(-seconds / time_constants)))


def _creep_branches(material: Material) -> tuple[np.ndarray, np.ndarray]:
    """Return the shares (k, 1) and time constants (k, 1), seconds, of a material's k branches of creep."""
    branch_parameters = np.array(material.creep, float).reshape(-1, 2)
    return branch_parameters[:, :1], branch_parameters[:, 1:]
