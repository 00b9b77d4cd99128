"""Rigid indenters: the height of their surface above its lowest point."""

from __future__ import annotations

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates

from jeit.arguments import check_kind, check_metres, real_array
from jeit.design.skin.indentation import AbstractIndentation, Hemisphere
from jeit.mesh.outline.domain import check_length
from jeit_solvers.engines import host


class AbstractIndenter(eqx.Module):
    """A rigid body that moves straight down, in a frame of its own. Add another by writing one class."""

    @abc.abstractmethod
    def gap(self, points: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "..."]:
        """Height in metres, zero or more, of its surface above its lowest point over `points` (…, 2), metres; infinite
        where there is none."""

    @property
    @abc.abstractmethod
    def reach(self) -> float:
        """Distance in metres from the frame's origin beyond which the body does not extend."""


class Disc(AbstractIndenter):
    """The flat end of a cylinder, such as a weight's: of `diameter` metres."""

    diameter: float

    def __init__(self, diameter: float):
        """Raises `ValueError` for a diameter that is not positive."""
        _check_size("diameter", diameter)
        self.diameter = float(diameter)

    def gap(self, points):
        """Zero under it."""
        return _flat(_distance(points) <= self.diameter / 2)

    @property
    def reach(self) -> float:
        """Its radius."""
        return self.diameter / 2


class Ring(AbstractIndenter):
    """The flat end of a tube, or hollow cylinder: of `outer_diameter` and `inner_diameter` metres."""

    outer_diameter: float
    inner_diameter: float

    def __init__(self, outer_diameter: float, inner_diameter: float):
        """Raises `ValueError` for diameters that are not positive, or a hole that leaves nothing."""
        _check_size("outer_diameter", outer_diameter)
        _check_size("inner_diameter", inner_diameter, outer_diameter, "the outer diameter")
        if inner_diameter == outer_diameter:
            raise ValueError(
                f"inner_diameter is the outer one, {1e3 * outer_diameter:g} mm: nothing is left; give less."
            )
        self.outer_diameter, self.inner_diameter = float(outer_diameter), float(inner_diameter)

    def gap(self, points):
        """Zero under its wall."""
        distance = _distance(points)
        return _flat((distance <= self.outer_diameter / 2) & (distance >= self.inner_diameter / 2))

    @property
    def reach(self) -> float:
        """Its outer radius."""
        return self.outer_diameter / 2


class Bar(AbstractIndenter):
    """A flat rectangle, such as a cube's face or a ruler's edge: `length` along x and `width` along y, metres."""

    length: float
    width: float

    def __init__(self, length: float, width: float):
        """Raises `ValueError` for sides that are not positive."""
        _check_size("length", length)
        _check_size("width", width)
        self.length, self.width = float(length), float(width)

    def gap(self, points):
        """Zero under it."""
        return _flat(_within(points, self.length, self.width))

    @property
    def reach(self) -> float:
        """Half its diagonal."""
        return float(np.hypot(self.length, self.width) / 2)


class Prism(AbstractIndenter):
    """A roof upside down, with its ridge along x: `length` of the ridge, `width` of the base, `height`, all metres."""

    length: float
    width: float
    height: float

    def __init__(self, length: float, width: float, height: float):
        """Raises `ValueError` for sides that are not positive."""
        _check_size("length", length)
        _check_size("width", width)
        _check_size("height", height)
        self.length, self.width, self.height = float(length), float(width), float(height)

    def gap(self, points):
        """2 height |y| / width."""
        slope = 2 * self.height * np.abs(np.asarray(points)[..., 1]) / self.width
        return np.where(_within(points, self.length, self.width), slope, np.inf)

    @property
    def reach(self) -> float:
        """Half the diagonal of its base."""
        return float(np.hypot(self.length, self.width) / 2)


class Revolved(AbstractIndenter):
    """The body that leaves an indentation of `jeit.design`, such as `Bell()`: the same profile, now of something rigid
    that goes in as deep as its load takes it."""

    indentation: AbstractIndentation

    def __init__(self, indentation: AbstractIndentation):
        """Raises `ValueError` for what is no indentation."""
        check_kind("indentation", indentation, AbstractIndentation, "an indentation, such as Bell() or Hemisphere()")
        self.indentation = indentation

    def gap(self, points):
        """Difference of the profile's depth from that in its middle."""
        distance = _distance(points)
        deepest = float(self.indentation.depth_at(host.zeros(())))
        gap = deepest - np.asarray(self.indentation.depth_at(distance))
        return np.where(distance < self.reach, gap, np.inf)

    @property
    def reach(self) -> float:
        """The indentation's."""
        return float(self.indentation.reach)


def ball(diameter: float) -> Revolved:
    """The lower half of a ball of `diameter` metres. Raises `ValueError` for one that is not positive."""
    check_metres("diameter", diameter)
    return Revolved(Hemisphere(diameter / 2, diameter))


class DepthMap(AbstractIndenter):
    """A surface of one's own, linear between its pixels' middles, round the origin.

    **Fields**: `height` (rows, columns), metres, how far it stands out towards the skin, NaN where there is nothing;
    row 0 at the least y; `pixel`, their side in metres.
    """

    height: Float[np.ndarray, "rows columns"]
    pixel: float

    def __init__(self, height: ArrayLike, pixel: float):
        """Raises `ValueError` for what is no image of at least 2 × 2 pixels, one that is infinite somewhere or NaN
        throughout, and pixels of no size."""
        height = real_array("height", height, "an image (rows, columns), in metres")
        if height.ndim != 2 or min(height.shape) < 2 or np.isinf(height).any() or np.isnan(height).all():
            raise ValueError(
                "height must be an image (rows, columns) of 2 × 2 pixels or more, in metres, NaN where there is "
                f"nothing of it; this one has shape {height.shape}, {np.isfinite(height).sum()} pixels of it finite."
            )
        check_metres("pixel", pixel)
        self.height, self.pixel = height, float(pixel)

    def gap(self, points):
        """Difference of the surface's height from its greatest height."""
        middle = (np.array(self.height.shape) - 1) / 2
        place = np.moveaxis(np.asarray(points)[..., ::-1] / self.pixel + middle, -1, 0)
        flat = map_coordinates(self.height, place.reshape(2, -1), order=1, cval=np.nan)
        height = flat.reshape(place.shape[1:])
        return np.where(np.isnan(height), np.inf, np.nanmax(self.height) - height)

    @property
    def reach(self) -> float:
        """Half the image's diagonal."""
        return float(np.hypot(*self.height.shape) * self.pixel / 2)


def check_indenter(name: str, given) -> None:
    """Raise `ValueError`, about the argument `name`, for what is no indenter."""
    check_kind(name, given, AbstractIndenter, "an indenter, such as Disc(0.02) or ball(0.015)")


def _check_size(name: str, value, most: float = np.inf, limit: str = "") -> None:
    """Raise `ValueError` as `check_metres` does, and warn of a length that looks like millimetres."""
    check_metres(name, value, most, limit)
    check_length(name, value)


def _distance(points):
    return np.linalg.norm(np.asarray(points), axis=-1)


def _flat(there):
    return np.where(there, 0.0, np.inf)


def _within(points, length: float, width: float):
    points = np.asarray(points)
    return (np.abs(points[..., 0]) <= length / 2) & (np.abs(points[..., 1]) <= width / 2)
