"""Response of a skin's channels to a depth map by the forward model, linear in a function of depth; and the effects of
misplaced electrodes and drifting contacts."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from jeit.design import Skin
from jeit.forward.changes import ContactSensitivity
from jeit.forward.model import select_channels
from jeit.touch.networks.touches import DEPTHS
from jeit.touch.simulate.contact.indent_sets import image_places
from jeit.touch.simulate.contact.indents import relative_to
from jeit.touch.simulate.contact.samples import lattice

# Points in each cell, along a side: pixels are smaller than cells.
_LATTICE = 6
# Greater depths continue the function linearly.
_DEEPEST = 0.9


class Sensed(NamedTuple):
    """A linear model of a skin's channels.

    **Fields**: `operator` (M, P), relative changes of the channels by each of P pixels' `strength`; `contacts` (L, M),
    relative changes by the logarithm of each electrode's contact impedance; `shape` (rows, columns).
    """

    operator: Float[np.ndarray, "M P"]
    contacts: Float[np.ndarray, "L M"]
    shape: tuple[int, int]

    @classmethod
    def of(cls, skin: Skin, shape: tuple[int, int] = (48, 48)) -> "Sensed":
        """Compute the model of a skin, with its pixels on a grid of this shape over its box."""
        rows, columns = shape
        model, conductivity = skin.model, np.asarray(skin.model_conductivity)
        rest, jacobian = (np.asarray(one) for one in model.voltages_and_jacobian(conductivity))
        points = lattice(np.asarray(model.mesh.points)[np.asarray(model.mesh.cells)], _LATTICE)
        each = relative_to(rest, rest - jacobian.T * np.broadcast_to(conductivity, jacobian.shape[1])[:, None])
        tree = KDTree(image_places(skin, columns, rows).reshape(-1, 2))
        pixel = np.asarray(tree.query(points[..., :2].reshape(-1, 2))[1])
        # At the share b of the thickness from the face, depths δ take all where δ > b: the line through 0 nearest to
        # that, over the depths that are drawn, uniform in log δ, is δ ∫ [δ' > b] dδ' / ∫ δ' dδ'. A sheet has no b, and
        # loses δ.
        share = np.ones(points.shape[:2])
        if skin.num_layers:
            below = (points[..., 2].max() - points[..., 2]) / float(skin.thickness)
            least, most = DEPTHS
            share = np.maximum(most - np.maximum(below, least), 0) / ((most**2 - least**2) / 2)
        operator = np.zeros((rows * columns, len(rest)))
        for place, number in enumerate(pixel.reshape(points.shape[:2]).T):
            np.add.at(operator, number, each * share[:, place, None] / points.shape[1])
        return cls(rounded(operator.T), rounded(_of_contacts(skin, rest, conductivity)), shape)

    def halved(self) -> Float[np.ndarray, "M p"]:
        """The operator for pixels twice as wide and high."""
        rows, columns = self.shape
        parts = self.operator.reshape(len(self.operator), rows // 2, 2, columns // 2, 2)
        return parts.sum(axis=(2, 4)).reshape(len(parts), -1)


def rounded(values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Round values to a millionth of their greatest, or less, to remove effects of the order of sums.

    The same key then gives the same training wherever NumPy's arrays lie in memory.
    """
    unit = 2.0 ** (np.floor(np.log2(max(float(np.abs(values).max()), 1e-300))) - 20)
    return np.round(values / unit) * unit


def strength(depth):
    """Strength δ / √(1 − δ) of depths δ over the thickness, to which changes of voltages are proportional.

    A patch that conducts less has a greater effect than its change of conductivity, since current flows around it. In
    two dimensions, patches of e^s and e^−s times the conductivity change voltages oppositely, to first order in their
    size (Keller's duality), which 2 sinh(s / 2) does, and log(1 − δ) = −s.
    """
    clipped = jnp.clip(depth, 0.0, _DEEPEST)
    return clipped / jnp.sqrt(1 - clipped) + (depth - clipped)


def depth_of(strength):
    """Depths of strengths, the inverse of `strength`; strengths below zero give depths below zero."""
    above = jnp.maximum(strength, 0.0)
    return (jnp.sqrt(above**2 + 4) - above) * above / 2 + jnp.minimum(strength, 0.0)


def _of_contacts(skin: Skin, rest, conductivity) -> Float[np.ndarray, "L M"]:
    model = skin.model
    fields, impedance = (np.asarray(one) for one in model.fields(conductivity))
    slope = ContactSensitivity(model.mesh, model.electrodes)(fields, impedance, model.electrodes.contact_impedance)
    changes = np.stack([select_channels(model.protocol, one) for one in slope])
    return relative_to(np.asarray(rest), np.asarray(rest) + changes)
