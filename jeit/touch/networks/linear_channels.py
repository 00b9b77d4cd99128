"""Linear model of a skin's channels, random touches for training networks, and positions of touches in depth maps."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from jeit.design import Bell, Skin, touches_away_from_the_edge
from jeit.forward.changes import ContactSensitivity
from jeit.forward.model import select_channels
from jeit.touch.simulate import (
    BarIndenter,
    DiscIndenter,
    Indent,
    IndentDraws,
    JoinedIndenters,
    PlacedIndenter,
    RevolvedIndenter,
    RingIndenter,
    ball_indenter,
    material,
)
from jeit.touch.simulate.contact.indent_sets import image_places
from jeit.touch.simulate.contact.indenters import AbstractIndenter
from jeit.touch.simulate.contact.indents import relative_changes, relative_voltage_changes
from jeit.touch.simulate.contact.samples import lattice
from jeit_solvers.engines import on_host

# Fraction of a map's maximum depth below which a pixel is not part of a touch.
_TOUCHED_DEPTH_FRACTION = 0.5


def deepest_positions(maps: Float[np.ndarray, "n r c"], places: Float[np.ndarray, "r c 2"]) -> Float[np.ndarray, "n 2"]:
    """Return the positions (maps, 2) of the deepest pixels of depth maps, metres; `places` (rows, columns, 2):
    positions of the pixels, metres."""
    deepest_indices = maps.reshape(len(maps), -1).argmax(axis=1)
    return places.reshape(-1, 2)[deepest_indices]


def depth_centroids(maps: Float[np.ndarray, "n r c"], places: Float[np.ndarray, "r c 2"]) -> Float[np.ndarray, "n 2"]:
    """Compute the centroid (maps, 2) of the indentation in each depth map, metres: the mean position, weighted by
    depth, of the pixels deeper than half of the map's maximum depth. `places` (rows, columns, 2): positions of the
    pixels, metres."""
    flat_maps = maps.reshape(len(maps), -1)
    max_depth_per_map = flat_maps.max(axis=1, keepdims=True)
    depth_weights = np.where(flat_maps > _TOUCHED_DEPTH_FRACTION * max_depth_per_map, np.maximum(flat_maps, 0), 0)
    # The centroid of a map without any depth is the middle of the skin.
    depth_weights = np.where(max_depth_per_map > 0, depth_weights, 1.0)
    return depth_weights @ places.reshape(-1, 2) / depth_weights.sum(axis=1, keepdims=True)


def error_statistics(
    estimated_positions: Float[np.ndarray, "n 2"], true_positions: Float[np.ndarray, "n 2"]
) -> dict[str, float]:
    """Compute the mean, standard deviation (sd) and root mean square (rms) of the distance between estimated and true
    positions, metres."""
    position_errors = np.linalg.norm(estimated_positions - true_positions, axis=1)
    return {
        "mean": float(position_errors.mean()),
        "sd": float(position_errors.std()),
        "rms": float(np.sqrt(np.mean(position_errors**2))),
    }


# Minimum and maximum depth of a simulated touch, divided by the skin's thickness; in Park et al., 1 and 8 mm of 10 mm.
RELATIVE_DEPTH_RANGE = (0.1, 0.8)
# Maximum number of bodies that touch the skin at once.
_MAX_SIMULTANEOUS_BODIES = 3
# Limit of detection of Park et al., newtons, for a ball of 15 mm diameter.
_DETECTION_LIMIT_FORCE = 0.7
# Voltage change at the limit of detection, in standard deviations of the noise.
_DETECTION_NOISE_RATIO = 3.0
# Number of places along a side at which the voltage change is computed.
_BALL_PLACES_PER_SIDE = 15
# Minimum distance of a touch's centre from the skin's edge, divided by the skin's shorter side.
_RELATIVE_EDGE_MARGIN = 0.04


def wrench_outline() -> JoinedIndenters:
    """Create the shape of an open-ended wrench laid flat, 100 mm long."""
    wrench_jaw = PlacedIndenter(RingIndenter(0.030, 0.014), (0.040, 0.0))
    return JoinedIndenters(PlacedIndenter(BarIndenter(0.070, 0.010), (-0.010, 0.0)), wrench_jaw)


def touching_bodies() -> list[AbstractIndenter]:
    """Create the bodies that touch the skin in simulations: bells, balls, discs, bars, and a wrench."""
    return [
        *(RevolvedIndenter(Bell(0.02, bell_deviation)) for bell_deviation in (5e-3, 7.5e-3, 10e-3)),
        *(ball_indenter(body_diameter) for body_diameter in (0.015, 0.020, 0.030)),
        *(DiscIndenter(body_diameter) for body_diameter in (0.010, 0.020, 0.030)),
        *(
            BarIndenter(bar_length, bar_width)
            for bar_length, bar_width in ((0.040, 0.008), (0.030, 0.015), (0.060, 0.010))
        ),
        wrench_outline(),
    ]


def touch_draws(skin: Skin) -> IndentDraws:
    """Create a generator of random touches by one to three of the `touching_bodies`, anywhere on a skin and at any
    angle."""
    thickness = float(skin.thickness)
    low_x, high_x, low_y, high_y = map(float, skin.flat_outline.extent)
    depth_range = (RELATIVE_DEPTH_RANGE[0] * thickness, RELATIVE_DEPTH_RANGE[1] * thickness)
    edge_margin = _RELATIVE_EDGE_MARGIN * min(high_x - low_x, high_y - low_y)
    return IndentDraws(
        touching_bodies(), skin.flat_outline, depth_range, margin=edge_margin, at_once=_MAX_SIMULTANEOUS_BODIES
    )


def detection_noise(skin: Skin, limit: float = _DETECTION_LIMIT_FORCE) -> float:
    """Compute the relative noise of a channel at which a ball of 15 mm diameter, pressed with `limit` newtons, is just
    detected.

    The ball is pressed at places all over the skin. At each place, the maximum relative voltage change over all
    channels is computed; the noise is a third of the median of these maxima. Park et al. 2022 detect 0.7 N; this load
    indents a hydrogel of 100 kPa by 1.7 mm.
    """
    ball = ball_indenter(0.015)
    ball_depth = material("hydrogel").support.pressure(ball, limit).approach
    ball_grid = touches_away_from_the_edge(skin.flat_outline, 0.0075, _BALL_PLACES_PER_SIDE, _BALL_PLACES_PER_SIDE)
    channel_changes = relative_changes(skin, [[Indent(ball, ball_depth, place)] for place in ball_grid.places])
    # The noise is rounded to four digits, which do not depend on the order of summation.
    return float(f"{np.median(np.abs(channel_changes).max(axis=1)) / _DETECTION_NOISE_RATIO:.4g}")


# Number of points along a side of each mesh cell by which the cell's response is distributed over pixels, which are
# smaller than cells.
_LATTICE_POINTS_PER_SIDE = 6
# Maximum relative depth for the nonlinear formula of strength, which is continued linearly for larger depths.
_MAX_RELATIVE_DEPTH = 0.9


class LinearChannels(NamedTuple):
    """Linear model of the relative voltage changes of a skin's channels.

    **Fields**: `operator` (channels, pixels): relative changes of the channels per unit of the `strength` of each
    pixel's indentation; `contacts` (electrodes, channels): relative changes per unit of the logarithm of each
    electrode's contact impedance; `shape`: (rows, columns) of the pixels.
    """

    operator: Float[np.ndarray, "M P"]
    contacts: Float[np.ndarray, "L M"]
    shape: tuple[int, int]

    @classmethod
    def from_skin(cls, skin: Skin, shape: tuple[int, int] = (48, 48)) -> "LinearChannels":
        """Compute the linear model of a skin, with pixels on a grid of the given shape over the skin's bounding box."""
        rows, columns = shape
        model, conductivity = skin.model, np.asarray(skin.model_conductivity)
        rest_voltages, jacobian = (np.asarray(array) for array in model.voltages_and_jacobian(conductivity))
        lattice_points = lattice(np.asarray(model.mesh.points)[np.asarray(model.mesh.cells)], _LATTICE_POINTS_PER_SIDE)
        cell_changes = relative_voltage_changes(
            rest_voltages, rest_voltages - jacobian.T * np.broadcast_to(conductivity, jacobian.shape[1])[:, None]
        )
        pixel_tree = KDTree(image_places(skin, columns, rows).reshape(-1, 2))
        pixel_indices = np.asarray(pixel_tree.query(lattice_points[..., :2].reshape(-1, 2))[1])
        # A point at depth b, divided by the skin's thickness, loses all conductivity under indentations δ > b. The line
        # through 0 that fits this loss best, for depths drawn uniformly in log δ, is δ ∫ [δ' > b] dδ' / ∫ δ' dδ'. In a
        # sheet, which has no depth b, every point loses the fraction δ.
        point_shares = np.ones(lattice_points.shape[:2])
        if skin.num_layers:
            relative_depths = (lattice_points[..., 2].max() - lattice_points[..., 2]) / float(skin.thickness)
            min_depth, max_depth = RELATIVE_DEPTH_RANGE
            point_shares = np.maximum(max_depth - np.maximum(relative_depths, min_depth), 0) / (
                (max_depth**2 - min_depth**2) / 2
            )
        channel_operator = np.zeros((rows * columns, len(rest_voltages)))
        for point_index, cell_pixels in enumerate(pixel_indices.reshape(lattice_points.shape[:2]).T):
            np.add.at(
                channel_operator,
                cell_pixels,
                cell_changes * point_shares[:, point_index, None] / lattice_points.shape[1],
            )
        return cls(
            round_relative_to_maximum(channel_operator.T),
            round_relative_to_maximum(_contact_changes(skin, rest_voltages, conductivity)),
            shape,
        )

    def coarser_operator(self) -> Float[np.ndarray, "M p"]:
        """Compute the operator for pixels twice as wide and high: the sum over the four pixels that each larger pixel
        covers."""
        rows, columns = self.shape
        pixel_blocks = self.operator.reshape(len(self.operator), rows // 2, 2, columns // 2, 2)
        return pixel_blocks.sum(axis=(2, 4)).reshape(len(pixel_blocks), -1)


def round_relative_to_maximum(values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Round values to a millionth of their maximum, or finer, to remove effects of the order of summation.

    NumPy's order of summation depends on the memory addresses of arrays. After rounding, training depends only on the
    random key.
    """
    rounding_unit = 2.0 ** (np.floor(np.log2(max(float(np.abs(values).max()), 1e-300))) - 20)
    return np.round(values / rounding_unit) * rounding_unit


def strength(depth):
    """Compute the strength δ / √(1 − δ) of an indentation, to which changes of voltages are proportional.

    The relative `depth` δ is the depth divided by the skin's thickness.

    The effect of a patch of lower conductivity is more than proportional to the change of its conductivity, since
    current flows around the patch. In two dimensions, patches with e^s and e^−s times the conductivity change voltages
    oppositely, to first order in their size (Keller's duality). The strength 2 sinh(s / 2), with log(1 − δ) = −s,
    changes its sign with s, as the changes of the voltages do.
    """
    clipped_depth = jnp.clip(depth, 0.0, _MAX_RELATIVE_DEPTH)
    return clipped_depth / jnp.sqrt(1 - clipped_depth) + (depth - clipped_depth)


def depth_from_strength(strength):
    """Compute the relative depths of indentations from their strengths: the inverse of `strength`. Negative strengths
    give negative depths."""
    positive_strength = jnp.maximum(strength, 0.0)
    return (jnp.sqrt(positive_strength**2 + 4) - positive_strength) * positive_strength / 2 + jnp.minimum(strength, 0.0)


def _contact_changes(skin: Skin, rest_voltages, conductivity) -> Float[np.ndarray, "L M"]:
    """Compute the relative changes of the channels per unit of the logarithm of each electrode's contact impedance;
    `rest_voltages`: voltages of the untouched skin."""
    model = skin.model
    electrode_fields, transfer_impedance = (np.asarray(array) for array in model.fields(conductivity))
    impedance_derivatives = ContactSensitivity(model.mesh, model.electrodes)(
        electrode_fields, transfer_impedance, model.electrodes.contact_impedance
    )
    contact_changes = np.stack(
        [
            select_channels(*on_host((model.protocol, impedance_derivative)))
            for impedance_derivative in impedance_derivatives
        ]
    )
    return relative_voltage_changes(np.asarray(rest_voltages), np.asarray(rest_voltages) + contact_changes)
