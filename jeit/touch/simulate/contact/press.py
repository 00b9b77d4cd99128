"""Presses: an indenter, its load and its place; at rest, or moving."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, real_array
from jeit.touch.simulate.contact.indenters import AbstractIndenter, check_indenter
from jeit.touch.simulate.contact.joined import check_angle, check_position
from jeit.touch.simulate.contact.pressure import check_load


class Press(eqx.Module):
    """An `indenter` under a `load` in newtons, turned by `angle` radians, its origin at `position` (x, y), metres.

    On a curved skin `position` is (x, y, z), on the face that is touched, and the indenter comes down along the inward
    normal there. With angle 0 its y axis is then up, as near to z as the surface goes, where this is not level, and
    along y where it is; its x axis to the right, as seen from outside.
    """

    indenter: AbstractIndenter
    load: float
    position: Float[np.ndarray, " d"]
    angle: float

    def __init__(self, indenter: AbstractIndenter, load: float, position: ArrayLike = (0.0, 0.0), angle: float = 0.0):
        """Raises `ValueError` for what is no indenter, load, place or angle."""
        check_indenter("indenter", indenter)
        check_load(load)
        self.indenter, self.load = indenter, float(load)
        self.position, self.angle = check_position(position, in_space=True), check_angle(angle)


class MovingPress(eqx.Module):
    """A press over time: `load` (T,) newtons, 0 while it is lifted, `position` (T, 2) metres, on a curved skin (T, 3).

    `angle` (T,) radians. There is one value for each frame; what stays the same may be given once.
    """

    indenter: AbstractIndenter
    load: Float[np.ndarray, " T"]
    position: Float[np.ndarray, "T d"]
    angle: Float[np.ndarray, " T"]

    def __init__(
        self, indenter: AbstractIndenter, load: ArrayLike, position: ArrayLike = (0.0, 0.0), angle: ArrayLike = 0.0
    ):
        """Raises `ValueError` for what is no indenter, negative loads, and what is not finite or not as long."""
        check_indenter("indenter", indenter)
        load = real_array("load", load, "newtons, one or one a frame (T,)")
        position = real_array("position", position, "(x, y) in metres, one or one a frame (T, 2)")
        angle = real_array("angle", angle, "radians, one or one a frame (T,)")
        if position.shape[-1:] not in ((2,), (3,)):
            raise ValueError(
                f"position must be (x, y) in metres, one or one a frame (T, 2); it has shape {position.shape}."
            )
        try:
            (number,) = np.broadcast_shapes(load.shape, position.shape[:-1], angle.shape)
            load, angle = np.broadcast_to(load, number), np.broadcast_to(angle, number)
            position = np.broadcast_to(position, (number, position.shape[-1]))
        except ValueError:
            raise ValueError(
                "load, position and angle must be (T,), (T, 2) and (T,) for T frames, or one for all; they have shapes "
                f"{load.shape}, {position.shape} and {angle.shape}."
            ) from None
        if not all(np.isfinite(values).all() for values in (load, position, angle)) or (load < 0).any():
            raise ValueError("load, position and angle must be finite, and loads, in newtons, zero or more.")
        self.indenter, self.load, self.position, self.angle = indenter, load, position, angle

    def at(self, frame: int) -> Press | None:
        """The press of one frame; None while it is lifted."""
        if not self.load[frame]:
            return None
        return Press(self.indenter, self.load[frame], self.position[frame], self.angle[frame])


def touches_of(presses) -> list[tuple[Press, ...]]:
    """List the simultaneous presses of each touch. Raises `ValueError` for none, and for what is none."""
    check_kind("presses", presses, (list, tuple), "a list of them, one for each frame, such as [press]")
    if not presses:
        raise ValueError("presses: give one at least.")
    touches = []
    for number, touch in enumerate(presses):
        wanted = "a Press, or a tuple of those that are there at once"
        check_kind(f"presses[{number}]", touch, (Press, tuple), wanted)
        touches.append((touch,) if isinstance(touch, Press) else touch)
        for press in touches[-1]:
            check_kind(f"presses[{number}]", press, Press, wanted)
    return touches


def motions_of(motions, frames: int) -> list[MovingPress]:
    """List the motions of a recording: one, or those of a list, which may be empty if nothing touches.

    Raises `ValueError` for what is none, those of another number of frames, and motions without any load.
    """
    motions = [motions] if isinstance(motions, MovingPress) else motions
    check_kind(
        "motions", motions, (list, tuple), "a MovingPress, or a list of those that are there at once, [] for none"
    )
    for number, motion in enumerate(motions):
        check_kind(f"motions[{number}]", motion, MovingPress, "a MovingPress")
        if len(motion.load) != frames:
            raise ValueError(f"motions[{number}] has {len(motion.load)} frames, and seconds {frames} times.")
    if motions and not any(motion.load.any() for motion in motions):
        raise ValueError("motions: no press has any load; give some, in newtons, or [] for an untouched skin.")
    return list(motions)
