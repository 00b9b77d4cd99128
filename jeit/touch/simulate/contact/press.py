"""Presses of a body on a skin, and their pressure."""

from __future__ import annotations

import abc

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates

from jeit.arguments import check_kind, describe, is_number, real_array
from jeit.touch.simulate.contact.combined_skins import check_angle, check_position
from jeit.touch.simulate.contact.indenters import AbstractIndenter, check_indenter
from jeit_solvers.module import Module


class AbstractPressure(Module):
    """Pressure on a skin, as a function of the place in the frame of the indenter that causes it.

    **Fields**: `load`: load of the indenter, newtons; `approach`: distance that the indenter has moved since its first
    contact, metres; `reach`: distance from the frame's origin beyond which there is no pressure, metres.
    """

    load: float
    approach: float
    reach: float

    @abc.abstractmethod
    def at(self, points: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "..."]:
        """Compute the pressure in pascals at `points` (…, 2), metres."""


class AbstractSupport(Module):
    """Base class of supports: the mechanical response of a skin to a press."""

    @abc.abstractmethod
    def pressure(self, indenter: AbstractIndenter, load: float) -> AbstractPressure:
        """Compute the pressure beneath `indenter` under a `load` in newtons. Raises `ValueError` for a load that the
        support cannot carry."""

    @abc.abstractmethod
    def spread(
        self,
        indenter: AbstractIndenter,
        loads: Float[np.ndarray, " n"],
        points: Float[np.ndarray, "n q 2"],
        areas: Float[np.ndarray, "n q"],
        fall: Float[np.ndarray, "n q"] | None = None,
    ) -> Float[np.ndarray, "n q"]:
        """Compute pressures (n, q), pascals, at q points under each of n loads of the same indenter.

        The points carry the whole load, or none if the indenter touches none of them.

        - `loads`: (n,), newtons.
        - `points`: (n, q, 2), points in the frame of the indenter, metres.
        - `areas`: (n, q), area of the skin around each point, m².
        - `fall`: (n, q), for curved skins: distance of the skin below the plane z = 0 of the frame at the points,
          metres.

        Raises `ValueError` as `pressure` does, and for a curved skin if the support requires a flat skin.
        """


class PressureRaster(AbstractPressure):
    """Pressure on a raster centred at the origin, interpolated linearly between the centres of pixels.

    **Fields**: `values`: (N, N), pressures of the pixels, pascals, row 0 at the minimum y; `pixel`: sides of a pixel
    along x and y, metres; `load`, `approach`, `reach`: as in `AbstractPressure`.
    """

    values: Float[np.ndarray, "N N"]
    pixel: Float[np.ndarray, "2"]

    def at(self, points):
        """Interpolate the pressure, pascals, linearly at `points` (…, 2), metres; zero outside the raster."""
        pixel_coordinates = np.moveaxis(
            (np.asarray(points) / self.pixel)[..., ::-1] + (len(self.values) - 1) / 2, -1, 0
        )
        flat_pressures = map_coordinates(self.values, pixel_coordinates.reshape(2, -1), order=1, mode="grid-constant")
        return flat_pressures.reshape(pixel_coordinates.shape[1:])


def raster(half_widths, num_pixels: int) -> tuple[Float[np.ndarray, "N N 2"], Float[np.ndarray, "2"]]:
    """Divide a rectangle around the origin into N × N pixels: return their centres (N, N, 2) and sides (2,), metres.

    `half_widths`: half the sides of the rectangle, metres; `num_pixels`: N.
    """
    pixel_sides = 2 * np.asarray(half_widths, float) / num_pixels
    pixel_indices = np.arange(num_pixels) - (num_pixels - 1) / 2
    return np.stack(np.meshgrid(pixel_sides[0] * pixel_indices, pixel_sides[1] * pixel_indices), axis=-1), pixel_sides


def contact_window(is_pressed, reach: float, num_pixels: int) -> Float[np.ndarray, "2"]:
    """Return half the sides, in metres, of a rectangle around the origin that encloses the contact closely.

    `is_pressed(half_widths, num_pixels)`: function that returns an array (N, N): whether each pixel of a raster over a
    rectangle is in contact. Starting from `reach`, the rectangle shrinks until the contact fills more than half of both
    its sides, since a ball under a light load touches only a small part of its rectangle. If the contact covers the
    centre of no pixel, the last rectangle is returned.
    """
    half_widths = np.full(2, reach)
    while True:
        pixel_centres, pixel_sides = raster(half_widths, num_pixels)
        touched_points = pixel_centres[is_pressed(half_widths, num_pixels)]
        if not len(touched_points):
            return half_widths
        contact_extent = np.abs(touched_points).max(axis=0) + pixel_sides
        if (contact_extent > half_widths / 2).all():
            return contact_extent + pixel_sides
        half_widths = np.minimum(half_widths, contact_extent + pixel_sides)


def check_load(load) -> None:
    """Raise `ValueError` unless a load, newtons, is positive."""
    if not (is_number(load) and load > 0):
        raise ValueError(f"load must be positive, in newtons (100 g weigh 0.98 N); it is {describe(load)}.")


def check_resolved(contact: Bool[np.ndarray, "N N"], pixel) -> None:
    """Raise `ValueError` unless a contact (N, N) on a raster covers at least one pixel; `pixel`: sides of a pixel,
    metres."""
    if not contact.any():
        raise ValueError(
            f"indenter: its contact is thinner than a pixel, {1e3 * np.max(pixel):.2g} mm, of the raster that "
            "pressure is found on; give a wider one, or one with its middle nearer to its frame's origin."
        )


def check_support(name: str, value) -> None:
    """Raise `ValueError` unless the argument `name` is a support, such as `Foundation(1e6, 3e-3)`."""
    check_kind(name, value, AbstractSupport, "a support, such as Foundation(1e6, 3e-3) or HalfSpace(1e6)")


class Press(Module):
    """An indenter that presses on a skin with a load.

    On a curved skin, the position is (x, y, z) on the touched face, and the indenter moves along the inward normal.
    With angle 0, seen from outside, the indenter's x axis points to the right, and its y axis up. Up is the projection
    of the z axis onto the surface or, where the surface is nearly horizontal, of the y axis.

    **Fields**: `indenter`: the indenter; `load`: load, newtons; `position`: position (x, y) of the indenter's origin,
    metres; `angle`: angle by which the indenter is rotated, radians.

    **Example:**

    ```python
    press = Press(ball_indenter(0.015), load=2.0, position=(0.01, 0.02))
    frames = skin.frames(key, [press, ()])  # pressed, and untouched
    ```
    """

    indenter: AbstractIndenter
    load: float
    position: Float[np.ndarray, " d"]
    angle: float

    def __init__(self, indenter: AbstractIndenter, load: float, position: ArrayLike = (0.0, 0.0), angle: float = 0.0):
        """Create a press. Raises `ValueError` for an invalid indenter, load, position or angle."""
        check_indenter("indenter", indenter)
        check_load(load)
        self.indenter, self.load = indenter, float(load)
        self.position, self.angle = check_position(position, in_space=True), check_angle(angle)


class MovingPress(Module):
    """An indenter that moves over a skin: its load, position and angle in each of T frames.

    A load, position or angle that is constant may be a single value.

    **Fields**: `indenter`: the indenter; `load` (T,): load, newtons, 0 while lifted; `position` (T, 2), or (T, 3) on a
    curved skin: position of the indenter's origin, metres; `angle` (T,): angle by which the indenter is rotated,
    radians.

    **Example:**

    ```python
    stroke = MovingPress(DiscIndenter(0.01), 2.0, np.linspace((-0.02, 0.0), (0.02, 0.0), 10))
    film = skin.record(key, stroke, np.arange(10) / 10)
    ```
    """

    indenter: AbstractIndenter
    load: Float[np.ndarray, " T"]
    position: Float[np.ndarray, "T d"]
    angle: Float[np.ndarray, " T"]

    def __init__(
        self, indenter: AbstractIndenter, load: ArrayLike, position: ArrayLike = (0.0, 0.0), angle: ArrayLike = 0.0
    ):
        """Create a moving press. Raises `ValueError` for an invalid indenter, negative loads, values that are not
        finite, and different numbers of frames."""
        check_indenter("indenter", indenter)
        load = real_array("load", load, "newtons, one or one a frame (T,)")
        position = real_array("position", position, "(x, y) in metres, one or one a frame (T, 2)")
        angle = real_array("angle", angle, "radians, one or one a frame (T,)")
        if position.shape[-1:] not in ((2,), (3,)):
            raise ValueError(
                f"position must be (x, y) in metres, one or one a frame (T, 2); it has shape {position.shape}."
            )
        try:
            (num_frames,) = np.broadcast_shapes(load.shape, position.shape[:-1], angle.shape)
            load, angle = np.broadcast_to(load, num_frames), np.broadcast_to(angle, num_frames)
            position = np.broadcast_to(position, (num_frames, position.shape[-1]))
        except ValueError:
            raise ValueError(
                "load, position and angle must be (T,), (T, 2) and (T,) for T frames, or one for all; they have shapes "
                f"{load.shape}, {position.shape} and {angle.shape}."
            ) from None
        if (
            not all(np.isfinite(argument_values).all() for argument_values in (load, position, angle))
            or (load < 0).any()
        ):
            raise ValueError("load, position and angle must be finite, and loads, in newtons, zero or more.")
        self.indenter, self.load, self.position, self.angle = indenter, load, position, angle

    def at(self, frame: int) -> Press | None:
        """Return the press in the frame with index `frame`; None while the indenter is lifted."""
        if not self.load[frame]:
            return None
        return Press(self.indenter, self.load[frame], self.position[frame], self.angle[frame])


def convert_to_touches(presses) -> list[tuple[Press, ...]]:
    """Convert a list of presses, or of tuples of presses, to a list of tuples: the simultaneous presses of each touch.
    Raises `ValueError` for an empty list, and for elements that are not presses."""
    check_kind("presses", presses, (list, tuple), "a list of them, one for each frame, such as [press]")
    if not presses:
        raise ValueError("presses: give one at least.")
    touches = []
    for touch_index, touch_presses in enumerate(presses):
        press_requirement = "a Press, or a tuple of those that are there at once"
        check_kind(f"presses[{touch_index}]", touch_presses, (Press, tuple), press_requirement)
        touches.append((touch_presses,) if isinstance(touch_presses, Press) else touch_presses)
        for press in touches[-1]:
            check_kind(f"presses[{touch_index}]", press, Press, press_requirement)
    return touches


def convert_to_motions(motions, num_frames: int) -> list[MovingPress]:
    """Return the moving presses of a recording as a list; `motions`: a moving press or a list, empty for an untouched
    skin.

    Raises `ValueError` for anything but moving presses, for a number of frames other than `num_frames`, and for motions
    without any load.
    """
    motions = [motions] if isinstance(motions, MovingPress) else motions
    check_kind(
        "motions", motions, (list, tuple), "a MovingPress, or a list of those that are there at once, [] for none"
    )
    for motion_index, motion in enumerate(motions):
        check_kind(f"motions[{motion_index}]", motion, MovingPress, "a MovingPress")
        if len(motion.load) != num_frames:
            raise ValueError(f"motions[{motion_index}] has {len(motion.load)} frames, and seconds {num_frames} times.")
    if motions and not any(motion.load.any() for motion in motions):
        raise ValueError("motions: no press has any load; give some, in newtons, or [] for an untouched skin.")
    return list(motions)
