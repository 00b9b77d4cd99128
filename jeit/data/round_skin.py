"""Simulated measurements of a round piezoresistive skin while it is pressed.

No openly licensed measurement of a tactile skin exists; simulated measurements replace it, and their notes state that
they are simulated.
"""

from __future__ import annotations

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jeit.arguments import check_key, check_kind
from jeit.data.measurement import Measurement
from jeit.data.screening import screen
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import ring
from jeit.mesh import Disk, centroids
from jeit.protocol import adjacent
from jeit_solvers.engines import namespace, numpy_or_compiled
from jeit_solvers.module import Module


class RoundSkin(Module):
    """A round conductive sheet with electrodes along its edge, measured with the adjacent (neighbouring) protocol.

    The defaults describe the skin of Chen et al. (2022): a film of 100 mm diameter, 16 electrodes, 208 voltages.

    **Fields**: `radius` in metres; `num_electrodes`; `electrode_width` in metres; `contact_impedance` in ohm·m;
    `conductivity`: sheet conductivity in siemens; `current` in amperes; `num_points`: number of nodes of the mesh for
    the simulation, which should be finer than the mesh of the reconstruction.

    **Example:**

    ```python
    skin = RoundSkin(radius=0.05, num_points=400)
    skin.model().voltages(1e-3)
    ```
    """

    radius: float = 0.05
    num_electrodes: int = eqx.field(static=True, default=16)
    electrode_width: float = 0.008
    contact_impedance: float = 0.2
    conductivity: float = 1e-3
    current: float = 1e-3
    num_points: int = eqx.field(static=True, default=4000)

    def model(self) -> ForwardModel:
        """The forward model that is used to simulate the skin."""
        electrodes = self.electrodes()
        mesh = Disk(self.radius).mesh(num_points=self.num_points)
        return ForwardModel(mesh, electrodes, adjacent(self.num_electrodes, current=self.current))

    def electrodes(self) -> BoundaryElectrodes:
        """The electrodes of the skin; electrode 1 is at 12 o'clock, and the other electrodes follow clockwise."""
        electrode_positions = ring(self.radius, self.num_electrodes, clockwise=True)
        return BoundaryElectrodes(electrode_positions, self.electrode_width, self.contact_impedance)


@numpy_or_compiled
def pressed_conductivity(
    points: Float[Array, "m 2"], background: float, position, radius: float, strength: float
) -> Float[Array, " m"]:
    """Conductivity (m,) in siemens at m `points` of a sheet pressed by a sphere: σ₀ (1 + strength √(1 - (r /
    radius)²)).

    `background` is σ₀ in siemens, r the distance from `position` in metres. The change has the shape of the Hertzian
    pressure under a sphere: the relative change is `strength` at `position`, and zero outside `radius` metres. The
    conductivity is assumed to increase with pressure.
    """
    xp = namespace(points, position)
    squared_distances = xp.sum((points - xp.asarray(position)) ** 2, axis=-1) / radius**2
    return background * (1 + strength * xp.sqrt(xp.maximum(1 - squared_distances, 0)))


def simulate_press(
    skin: RoundSkin,
    key: Array,
    position: tuple[float, float],
    *,
    radius: float = 0.008,
    strength: float = 0.5,
    noise: float = 1e-4,
) -> tuple[Measurement, Measurement]:
    """Simulate a frame of the pressed skin and a frame of the skin at rest; returns `(pressed, rest)`.

    **Arguments:**

    - `skin`: the skin.
    - `key`: key of the random noise (`jax.random.key`).
    - `position`: coordinates (x, y) of the press in metres.
    - `radius`: radius of the contact area in metres.
    - `strength`: maximum relative change of conductivity.
    - `noise`: standard deviation of the noise in each voltage relative to the root mean square of all voltages (1e-4:
      80 dB).

    Raises `ValueError` for a press beyond the edge, for values that are not positive, and for arguments that are not a
    skin or a key.

    **Example:**

    ```python
    pressed, rest = simulate_press(skin, jax.random.key(1), (0.0, 0.02), radius=0.01)
    ```
    """
    check_kind("skin", skin, RoundSkin, "a RoundSkin, such as RoundSkin(radius=0.05)")
    press_centre = np.asarray(position, float)
    if press_centre.shape != (2,) or not np.isfinite(press_centre).all():
        raise ValueError(f"position: give (x, y) in metres, not {position!r}.")
    if not (np.isfinite(radius) and radius > 0):
        raise ValueError(f"radius: the contact must be of positive size, in metres; it is {radius}.")
    if np.hypot(*press_centre) + radius > skin.radius:
        raise ValueError(
            f"position: a press at ({press_centre[0]:g}, {press_centre[1]:g}) m with a contact of radius {radius:g} m "
            f"reaches beyond the skin, whose radius is {skin.radius:g} m. Positions are in metres from its centre."
        )
    if not (np.isfinite(strength) and strength > -1 and strength != 0):
        raise ValueError(f"strength: the relative change must be above -1 and not zero; it is {strength}.")
    if not (np.isfinite(noise) and noise >= 0):
        raise ValueError(f"noise must be zero or positive, relative to the voltages; it is {noise}.")
    check_key(key)
    model = skin.model()
    points = centroids(model.mesh)
    pressed_conductivities = pressed_conductivity(points, skin.conductivity, press_centre, radius, strength)
    frames = np.stack([model.voltages(pressed_conductivities), model.voltages(skin.conductivity)])
    frames += noise * np.sqrt(np.mean(frames**2)) * np.asarray(jax.random.normal(key, frames.shape))
    screened_measurement = screen(
        frames,
        model.protocol,
        electrodes=model.electrodes,
        domain=Disk(skin.radius),
        name="simulated press",
        source="simulated",
        frame_names=("pressed", "reference"),
        notes=(f"simulated on a mesh of {model.mesh.num_points} nodes, with {noise:g} relative noise; not measured.",),
    )
    return screened_measurement.frame("pressed"), screened_measurement.frame("reference")
