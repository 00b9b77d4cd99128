"""Rigid indenters, described by the height of their surface above its lowest point."""

from __future__ import annotations

import abc

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates

from jeit.arguments import check_kind, check_metres, real_array
from jeit.design.skin.touch_shapes import AbstractIndentation, Hemisphere
from jeit.mesh.outline.domain import check_length
from jeit_solvers.engines import host
from jeit_solvers.module import Module


class AbstractIndenter(Module):
    """Base class of rigid bodies that are pressed straight down, described in the body's own frame of coordinates."""

    @abc.abstractmethod
    def gap(self, points: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "..."]:
        """Return the height of the surface above its lowest point at `points` (…, 2), metres; infinite beside the
        body."""

    @property
    @abc.abstractmethod
    def reach(self) -> float:
        """Distance in metres from the origin of the body's frame beyond which the body does not extend."""


class DiscIndenter(AbstractIndenter):
    """The flat end of a cylinder, such as of a weight.

    **Fields**: `diameter`: diameter, metres.

    **Example:**

    ```python
    press = Press(DiscIndenter(0.01), load=2.0, position=(0.01, 0.02))
    frames = skin.frames(key, [press])
    ```
    """

    diameter: float

    def __init__(self, diameter: float):
        """Create a disc. Raises `ValueError` for a diameter that is not positive."""
        _check_size("diameter", diameter)
        self.diameter = float(diameter)

    def gap(self, points):
        """Return zero at points beneath the disc, infinity elsewhere."""
        return _flat_gap(_distance_from_origin(points) <= self.diameter / 2)

    @property
    def reach(self) -> float:
        """Radius of the disc, metres."""
        return self.diameter / 2


class RingIndenter(AbstractIndenter):
    """The flat end of a tube.

    **Fields**: `outer_diameter`, `inner_diameter`: diameters, metres.

    **Example:**

    ```python
    press = Press(RingIndenter(0.02, 0.014), load=2.0)
    frames = skin.frames(key, [press])
    ```
    """

    outer_diameter: float
    inner_diameter: float

    def __init__(self, outer_diameter: float, inner_diameter: float):
        """Create a ring. Raises `ValueError` for diameters that are not positive, and for an inner diameter that is not
        smaller than the outer diameter."""
        _check_size("outer_diameter", outer_diameter)
        _check_size("inner_diameter", inner_diameter, outer_diameter, "the outer diameter")
        if inner_diameter == outer_diameter:
            raise ValueError(
                f"inner_diameter is the outer one, {1e3 * outer_diameter:g} mm: nothing is left; give less."
            )
        self.outer_diameter, self.inner_diameter = float(outer_diameter), float(inner_diameter)

    def gap(self, points):
        """Return zero at points beneath the wall of the tube, infinity elsewhere."""
        origin_distances = _distance_from_origin(points)
        return _flat_gap((origin_distances <= self.outer_diameter / 2) & (origin_distances >= self.inner_diameter / 2))

    @property
    def reach(self) -> float:
        """Outer radius of the ring, metres."""
        return self.outer_diameter / 2


class BarIndenter(AbstractIndenter):
    """A flat rectangle, such as the face of a cube or the edge of a ruler.

    **Fields**: `length`: side along x, metres; `width`: side along y, metres.

    **Example:**

    ```python
    press = Press(BarIndenter(0.03, 0.004), load=2.0, angle=0.5)
    frames = skin.frames(key, [press])
    ```
    """

    length: float
    width: float

    def __init__(self, length: float, width: float):
        """Create a bar. Raises `ValueError` for sides that are not positive."""
        _check_size("length", length)
        _check_size("width", width)
        self.length, self.width = float(length), float(width)

    def gap(self, points):
        """Return zero at points beneath the bar, infinity elsewhere."""
        return _flat_gap(_is_within_rectangle(points, self.length, self.width))

    @property
    def reach(self) -> float:
        """Half the diagonal of the bar, metres."""
        return float(np.hypot(self.length, self.width) / 2)


class PrismIndenter(AbstractIndenter):
    """A prism that touches with an edge along x, like a roof upside down.

    **Fields**: `length`: length of the edge, metres; `width`, `height`: width and height of the triangular section,
    metres.

    **Example:**

    ```python
    press = Press(PrismIndenter(0.03, 0.01, 0.008), load=1.0)
    frames = skin.frames(key, [press])
    ```
    """

    length: float
    width: float
    height: float

    def __init__(self, length: float, width: float, height: float):
        """Create a prism. Raises `ValueError` for sides that are not positive."""
        _check_size("length", length)
        _check_size("width", width)
        _check_size("height", height)
        self.length, self.width, self.height = float(length), float(width), float(height)

    def gap(self, points):
        """Return 2 `height` |y| / `width` at points beneath the prism, infinity elsewhere."""
        edge_heights = 2 * self.height * np.abs(np.asarray(points)[..., 1]) / self.width
        return np.where(_is_within_rectangle(points, self.length, self.width), edge_heights, np.inf)

    @property
    def reach(self) -> float:
        """Half the diagonal of the prism's upper face, metres."""
        return float(np.hypot(self.length, self.width) / 2)


class RevolvedIndenter(AbstractIndenter):
    """A rigid body of revolution about the vertical; its depth in the skin follows from the load.

    **Fields**: `indentation`: profile of the body, an indentation of `jeit.design`, such as `Bell()`.

    **Example:**

    ```python
    press = Press(RevolvedIndenter(Bell(depth=5e-3, deviation=5e-3)), load=1.0)
    frames = skin.frames(key, [press])
    ```
    """

    indentation: AbstractIndentation

    def __init__(self, indentation: AbstractIndentation):
        """Create the body. Raises `ValueError` for an argument that is not an indentation."""
        check_kind("indentation", indentation, AbstractIndentation, "an indentation, such as Bell() or Hemisphere()")
        self.indentation = indentation

    def gap(self, points):
        """Return the depth of the profile in its middle minus its depth at `points`; infinity beyond the reach of the
        indenter."""
        origin_distances = _distance_from_origin(points)
        max_depth = float(self.indentation.depth_at(host.zeros(())))
        profile_gaps = max_depth - np.asarray(self.indentation.depth_at(origin_distances))
        return np.where(origin_distances < self.reach, profile_gaps, np.inf)

    @property
    def reach(self) -> float:
        """Reach of the indentation, metres."""
        return float(self.indentation.reach)


def ball_indenter(diameter: float) -> RevolvedIndenter:
    """Return an indenter with the shape of the lower half of a ball.

    **Arguments:**

    - `diameter`: diameter of the ball, metres.

    Raises `ValueError` for a diameter that is not positive.

    **Example:**

    ```python
    press = Press(ball_indenter(0.015), load=2.0, position=(0.01, 0.02))
    frames = skin.frames(key, [press])
    ```
    """
    check_metres("diameter", diameter)
    return RevolvedIndenter(Hemisphere(diameter / 2, diameter))


class DepthMapIndenter(AbstractIndenter):
    """An indenter whose surface heights are an image, centred at the origin and interpolated linearly.

    **Fields**: `height`: (rows, columns), height of the surface towards the skin in metres, NaN where there is no
    surface; row 0 is at the minimum y; `pixel`: side of a pixel in metres.

    **Example:**

    ```python
    roof = -np.abs(np.linspace(-5e-3, 5e-3, 21))[:, None] * np.ones(21)
    press = Press(DepthMapIndenter(roof, pixel=5e-4), load=1.0)
    ```
    """

    height: Float[np.ndarray, "rows columns"]
    pixel: float

    def __init__(self, height: ArrayLike, pixel: float):
        """Create an indenter. Raises `ValueError` for an image of fewer than 2 × 2 pixels, an image with infinite
        values or only NaN, and a pixel size that is not positive."""
        height = real_array("height", height, "an image (rows, columns), in metres")
        if height.ndim != 2 or min(height.shape) < 2 or np.isinf(height).any() or np.isnan(height).all():
            raise ValueError(
                "height must be an image (rows, columns) of 2 × 2 pixels or more, in metres, NaN where there is "
                f"nothing of it; this one has shape {height.shape}, {np.isfinite(height).sum()} pixels of it finite."
            )
        check_metres("pixel", pixel)
        self.height, self.pixel = height, float(pixel)

    def gap(self, points):
        """Return the maximum height of the surface minus its height at the points; infinity where there is no
        surface."""
        centre_pixel = (np.array(self.height.shape) - 1) / 2
        pixel_coordinates = np.moveaxis(np.asarray(points)[..., ::-1] / self.pixel + centre_pixel, -1, 0)
        flat_heights = map_coordinates(self.height, pixel_coordinates.reshape(2, -1), order=1, cval=np.nan)
        surface_heights = flat_heights.reshape(pixel_coordinates.shape[1:])
        return np.where(np.isnan(surface_heights), np.inf, np.nanmax(self.height) - surface_heights)

    @property
    def reach(self) -> float:
        """Half the diagonal of the image, metres."""
        return float(np.hypot(*self.height.shape) * self.pixel / 2)


def check_indenter(name: str, value) -> None:
    """Check that the argument `name` is an indenter. Raises `ValueError` otherwise."""
    check_kind(name, value, AbstractIndenter, "an indenter, such as DiscIndenter(0.02) or ball_indenter(0.015)")


def _check_size(argument_name: str, argument_value, max_length: float = np.inf, limit_text: str = "") -> None:
    """Check that a length is positive metres, not above `max_length`, and warn if it looks like millimetres."""
    check_metres(argument_name, argument_value, max_length, limit_text)
    check_length(argument_name, argument_value)


def _distance_from_origin(points):
    return np.linalg.norm(np.asarray(points), axis=-1)


def _flat_gap(is_beneath):
    return np.where(is_beneath, 0.0, np.inf)


def _is_within_rectangle(points, length: float, width: float):
    points = np.asarray(points)
    return (np.abs(points[..., 0]) <= length / 2) & (np.abs(points[..., 1]) <= width / 2)
