"""Pressure beneath a rigid indenter under a given load."""

from __future__ import annotations

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import map_coordinates

from jeit.arguments import check_kind, describe, is_number
from jeit.touch.simulate.contact.indenters import AbstractIndenter


class AbstractPressure(eqx.Module):
    """Pressure in the frame of the indenter that causes it.

    **Fields**: `load`, newtons; `approach`, how far the indenter has come down from where it first touched, metres;
    `reach`, the distance from the frame's origin beyond which there is no pressure, metres.
    """

    load: float
    approach: float
    reach: float

    @abc.abstractmethod
    def at(self, points: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "..."]:
        """Pressure in pascals at `points` (…, 2), metres."""


class AbstractSupport(eqx.Module):
    """The mechanical response of a skin to a press. Add another by writing one class."""

    @abc.abstractmethod
    def pressure(self, indenter: AbstractIndenter, load: float) -> AbstractPressure:
        """Pressure beneath `indenter` under `load` newtons. Raises `ValueError` for a load that cannot be carried."""

    @abc.abstractmethod
    def spread(
        self,
        indenter: AbstractIndenter,
        loads: Float[np.ndarray, " n"],
        points: Float[np.ndarray, "n q 2"],
        areas: Float[np.ndarray, "n q"],
        fall: Float[np.ndarray, "n q"] | None = None,
    ) -> Float[np.ndarray, "n q"]:
        """Pressures (n, q) under n `loads`, newtons, at `points` in the indenter's frame, each of which stands for an
        area, m²: they carry the load among them, all of it, or are zero where the indenter touches none. `fall` of a
        curved skin: how far below the frame's plane it lies at the points, metres. Raises `ValueError` as `pressure`
        does, and for a curved skin where it is none of these."""


class PressureRaster(AbstractPressure):
    """Pressure known on pixels round the origin, row 0 at the least y, and linear between their middles.

    **Fields**: `values` (N, N), pascals, and `pixel`, their sides along x and y in metres; the others as of every
    pressure.
    """

    values: Float[np.ndarray, "N N"]
    pixel: Float[np.ndarray, "2"]

    def at(self, points):
        """Pressure, linear between pixels, zero beyond them."""
        place = np.moveaxis((np.asarray(points) / self.pixel)[..., ::-1] + (len(self.values) - 1) / 2, -1, 0)
        flat = map_coordinates(self.values, place.reshape(2, -1), order=1, mode="grid-constant")
        return flat.reshape(place.shape[1:])


def raster(half_widths, number: int) -> tuple[Float[np.ndarray, "N N 2"], Float[np.ndarray, "2"]]:
    """Middles (N, N, 2) of `number` by `number` pixels over a rectangle round the origin, and their sides, metres."""
    pixel = 2 * np.asarray(half_widths, float) / number
    along = np.arange(number) - (number - 1) / 2
    return np.stack(np.meshgrid(pixel[0] * along, pixel[1] * along), axis=-1), pixel


def contact_window(pressed, reach: float, number: int) -> Float[np.ndarray, "2"]:
    """Half the sides in metres of a rectangle round the origin that holds the contact and little else.

    `pressed(half_widths, number)` (N, N): where a raster of that window has contact. The window shrinks until the
    contact fills more than half of both its sides: a light load on a ball touches a small part of it. It stays as it is
    where a contact passes between the pixels.
    """
    window = np.full(2, reach)
    while True:
        points, pixel = raster(window, number)
        touched = points[pressed(window, number)]
        if not len(touched):
            return window
        extent = np.abs(touched).max(axis=0) + pixel
        if (extent > window / 2).all():
            return extent + pixel
        window = np.minimum(window, extent + pixel)


def check_load(load) -> None:
    """Raise `ValueError` for what is no positive load in newtons."""
    if not (is_number(load) and load > 0):
        raise ValueError(f"load must be positive, in newtons (100 g weigh 0.98 N); it is {describe(load)}.")


def check_seen(contact: Bool[np.ndarray, "N N"], pixel) -> None:
    """Raise `ValueError` where a contact lies between the pixels of a raster, of these sides."""
    if not contact.any():
        raise ValueError(
            f"indenter: what touches of it is thinner than a pixel, {1e3 * np.max(pixel):.2g} mm, of the raster that "
            "pressure is found on; give a wider one, or one with its middle nearer to its frame's origin."
        )


def check_support(name: str, given) -> None:
    """Raise `ValueError`, about the argument `name`, for what is no support."""
    check_kind(name, given, AbstractSupport, "a support, such as Foundation(1e6, 3e-3) or HalfSpace(1e6)")
