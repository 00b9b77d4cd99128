"""Form of a body fitted in a solid, an ellipsoid or a column, and the surface that pictures draw of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np

if TYPE_CHECKING:
    from jeit.image.plane import TriangleSurface

_ROUND, _UP = 48, 24


class SolidForm(eqx.Module):
    """An ellipsoid, or an elliptic column that stands.

    **Fields**: `centre`, metres; `axes`, three half axes as rows, metres, of a column the last up to its upper end;
    `column`, whether it is one.
    """

    centre: tuple[float, ...]
    axes: tuple[tuple[float, ...], ...]
    column: bool

    def surface(self) -> TriangleSurface:
        """Triangles all round it."""
        from jeit.image.plane import TriangleSurface

        up = np.linspace(0, np.pi, _UP + 1)
        radius, height = np.sin(up), -np.cos(up)
        if self.column:
            radius, height = np.array([0.0, 1.0, 1.0, 0.0]), np.array([-1.0, -1.0, 1.0, 1.0])
        angle = 2 * np.pi * np.arange(_ROUND) / _ROUND
        level = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        unit = np.concatenate([level, np.broadcast_to(height[:, None, None], (len(height), _ROUND, 1))], axis=2)
        axes = np.array(self.axes)
        axes[0] *= np.sign(np.linalg.det(axes))  # outward all round
        low = _ROUND * np.arange(len(height) - 1)[:, None] + np.arange(_ROUND)
        low_next = np.roll(low, -1, axis=1)
        high, high_next = low + _ROUND, low_next + _ROUND
        corners = [np.stack([low, low_next, high], axis=-1), np.stack([low_next, high_next, high], axis=-1)]
        return TriangleSurface(unit.reshape(-1, 3) @ axes + np.array(self.centre), np.stack(corners).reshape(-1, 3))
