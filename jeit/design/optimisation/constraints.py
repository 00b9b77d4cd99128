"""Constraints on layouts: electrodes inside an outline, at a minimum spacing, and outside of keep-out regions."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.mesh import Domain


class Constraints(eqx.Module):
    """Discs wholly inside `outline` and wholly outside every domain of `keep_out`, their centres `minimum_spacing`
    metres apart or more, and no two of them overlapping.

    Raises `ValueError` for a spacing below zero.
    """

    outline: Domain
    minimum_spacing: float
    keep_out: tuple[Domain, ...] = ()

    def __check_init__(self):
        if not 0 <= self.minimum_spacing < np.inf:
            raise ValueError(f"minimum_spacing must be in metres, not negative; it is {self.minimum_spacing!r}.")

    def check_room(self, radii) -> None:
        """Raise `ValueError` for more discs of `radii` (L,), metres, than the densest packing of circles allows."""
        x_min, x_max, y_min, y_max = self.outline.extent
        least = float(np.min(radii))
        apart = max(self.minimum_spacing, 2 * least)
        # Circles of half that distance lie apart, and reach beyond where centres may be by their radius.
        room = (x_max - x_min - 2 * least + apart) * (y_max - y_min - 2 * least + apart)
        if len(radii) * apart**2 > 2 / np.sqrt(3) * room:
            raise ValueError(
                f"minimum_spacing: {len(radii)} electrodes {1e3 * apart:.3g} mm apart do not fit the outline, "
                f"{1e3 * (x_max - x_min):.3g} × {1e3 * (y_max - y_min):.3g} mm; give less, or fewer electrodes."
            )

    def shortfall(self, centres: Float[Array, "L 2"], radii: Float[Array, " L"]) -> Float[Array, " q"]:
        """Violation of each constraint, metres: positive where it is violated. Differentiable almost everywhere."""
        return jnp.concatenate(list(self.shortfalls(centres, radii).values()))

    def shortfalls(self, centres: Float[Array, "L 2"], radii: Float[Array, " L"]) -> dict[str, Float[Array, " q"]]:
        """Violations by the names of the constraints: "minimum_spacing", "outline" and "keep_out"."""
        first, second = np.triu_indices(len(radii), 1)
        distance = jnp.sqrt(jnp.sum((centres[first] - centres[second]) ** 2, axis=1) + 1e-24)
        outside = [radii + domain.signed_distance(centres) for domain in self.keep_out]
        return {
            "minimum_spacing": jnp.maximum(self.minimum_spacing, radii[first] + radii[second]) - distance,
            "outline": radii - self.outline.signed_distance(centres),
            "keep_out": jnp.concatenate(outside) if outside else jnp.zeros(0),
        }
