"""Virtual taxels (tactile pixels): regions of a skin in which touches cause similar voltage changes (Park et al. 2022,
text S4)."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jeit.arguments import check_key
from jeit.design.defaults import NUM_TAXELS, THRESHOLD
from jeit_solvers import KMeans, kmeans
from jeit_solvers.engines import as_array, has_values, namespace, numpy_or_compiled
from jeit_solvers.module import Module


class Taxels(Module):
    """The k virtual taxels of an electrode layout, from touches at n positions, as returned by `find_taxels`.

    **Fields**

    - `places`: touched positions (n, 2), on a curved skin (n, 3), metres.
    - `cell_area` (n,): area of the part of the skin that each position represents, m².
    - `clusters`: k-means clusters of the voltage changes, with the mean change of each cluster.
    - `similarity` (k, n): cosine of the angle between the mean voltage change of each cluster and the change at each
      position.
    - `threshold`: minimum similarity for a position to belong to a taxel.

    After `jax.vmap`, all arrays and properties have a leading axis for the layouts.
    """

    places: Float[Array, "*layouts n d"]
    cell_area: Float[Array, "*layouts n"]
    clusters: KMeans
    similarity: Float[Array, "*layouts k n"]
    threshold: float = eqx.field(static=True)

    @property
    def labels(self) -> Int[Array, "*layouts n"]:
        """Index of the cluster of voltage changes that each touched position belongs to; every position belongs to
        exactly one cluster."""
        return self.clusters.labels

    @property
    @numpy_or_compiled
    def members(self) -> Bool[Array, "*layouts k n"]:
        """Mask (k, n) of the touched positions that each taxel covers. Taxels may overlap, and a position may be
        covered by no taxel."""
        return self.similarity >= self.threshold

    @property
    @numpy_or_compiled
    def positions(self) -> Float[Array, "*layouts k d"]:
        """Centroid of the touched positions in each cluster, metres; on a curved skin, the centroid lies slightly below
        the surface."""
        num_taxels = self.similarity.shape[-2]
        area_weights = (self.labels[..., None, :] == np.arange(num_taxels)[:, None]) * self.cell_area[..., None, :]
        return area_weights @ self.places / area_weights.sum(axis=-1, keepdims=True)

    @property
    @numpy_or_compiled
    def areas(self) -> Float[Array, "*layouts k"]:
        """Area that each taxel covers, m²; 0 if no position has a voltage change similar to the mean change of the
        taxel's cluster."""
        return (self.members * self.cell_area[..., None, :]).sum(axis=-1)

    @property
    @numpy_or_compiled
    def mean_area(self) -> Float[Array, "*layouts"]:
        """Mean of the taxel `areas`, m²."""
        return self.areas.mean(axis=-1)

    @property
    @numpy_or_compiled
    def std_area(self) -> Float[Array, "*layouts"]:
        """Standard deviation of the taxel `areas`, m²."""
        return self.areas.std(axis=-1)

    @property
    @numpy_or_compiled
    def max_area(self) -> Float[Array, "*layouts"]:
        """Maximum of the taxel `areas`, m²."""
        return self.areas.max(axis=-1)

    @property
    @numpy_or_compiled
    def coverage(self) -> Int[Array, "*layouts n"]:
        """Number of taxels that cover each touched position."""
        return self.members.sum(axis=-2)

    @property
    @numpy_or_compiled
    def overlap(self) -> Float[Array, "*layouts"]:
        """Mean number of taxels that cover a point of the skin: the sum of the taxel areas divided by the area of the
        skin."""
        return self.areas.sum(axis=-1) / self.cell_area.sum(axis=-1)

    @property
    @numpy_or_compiled
    def diameters(self) -> Float[Array, "*layouts k"]:
        """Diameter of a circle with the area of each taxel, 2 √(area / π), metres."""
        return 2 * namespace(self.areas).sqrt(self.areas / np.pi)

    @property
    @numpy_or_compiled
    def two_point_discrimination(self) -> Float[Array, "*layouts"]:
        """Estimate of the minimum distance at which two touches are distinguishable, metres: the mean of the
        `diameters`.

        Park et al. estimate this distance by the "average diameter of the virtual taxels". Two touches at a smaller
        distance are on average within the same taxel: their voltage changes differ in magnitude rather than in pattern.
        """
        return self.diameters.mean(axis=-1)


def find_taxels(
    changes: ArrayLike,
    places: ArrayLike,
    cell_area: ArrayLike,
    *,
    num_taxels: int = NUM_TAXELS,
    threshold: float = THRESHOLD,
    key: Any,
    directions: bool = False,
    restarts: int = 10,
) -> Taxels:
    """Find virtual taxels from the voltage `changes` (n, m) due to the same touch at `places` (n, 2), on a curved skin
    (n, 3), metres.

    The voltage changes are clustered by k-means. A taxel consists of the positions at which the cosine of the angle
    between the mean change of its cluster and the change at the position is at least `threshold`. Park et al. 2022,
    text S4, use 48 × 48 positions, 90 clusters and a threshold of 0.7. Positions whose touches change no voltage belong
    to no taxel.

    For a batch of layouts with changes (B, n, m), and `keys` from `jax.random.split(key, B)`::

        jax.vmap(lambda changes, key: find_taxels(changes, places, cell_area, key=key))(changes, keys)

    **Arguments:**

    - `changes`: voltage changes (n, m) due to the same touch at each of n positions, volts.
    - `places`: the positions (n, 2), on a curved skin (n, 3), metres.
    - `cell_area`: area of the part of the skin that each position represents, m²; one value for all, or (n,).
    - `num_taxels`: number k of clusters.
    - `threshold`: minimum cosine, between 0 and 1, for a position to belong to a taxel.
    - `key`: random key for k-means, from `jax.random.key`.
    - `directions`: whether to scale the voltage changes to length 1 before clustering. Without scaling, as in Park et
      al., positions of low sensitivity fall into one cluster, since all their voltage changes are small. With scaling,
      the changes in a cluster have a similar pattern.
    - `restarts`: number of runs of k-means from random starts, of which the best result is used.

    Raises `ValueError` for shapes that disagree, voltage changes that are not finite or are all zero, and lengths and
    areas whose units do not fit together.

    **Example:**

    ```python
    taxels = find_taxels(response.sensitivity.changes, touches.places, touches.cell_area, num_taxels=4, key=key)
    print(1e4 * taxels.mean_area)  # cm²
    ```
    """
    check_key(key)
    _check_arguments(changes, places, cell_area, num_taxels, threshold)
    checked_changes, touched_positions = jnp.asarray(changes, float), jnp.asarray(places, float)
    unit_changes = _normalise_rows(checked_changes)
    clusters = kmeans(unit_changes if directions else checked_changes, num_taxels, key, restarts=restarts)
    cell_areas = as_array(namespace(cell_area).broadcast_to(cell_area, touched_positions.shape[:1]), float)
    return Taxels(
        touched_positions, cell_areas, clusters, _cosine_similarities(clusters.centres, unit_changes), float(threshold)
    )


@numpy_or_compiled
def _cosine_similarities(row_vectors: Float[Array, "k m"], unit_changes: Float[Array, "n m"]) -> Float[Array, "k n"]:
    return _normalise_rows(row_vectors) @ unit_changes.T


@numpy_or_compiled
def _normalise_rows(row_vectors: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Scale n vectors (n, m) to length 1; zero vectors remain zero and have a derivative of zero."""
    xp, squared_norms = namespace(row_vectors), (row_vectors**2).sum(axis=1, keepdims=True)
    return xp.where(squared_norms > 0, row_vectors / xp.sqrt(xp.where(squared_norms > 0, squared_norms, 1)), 0)


def _check_arguments(changes, places, cell_area, num_taxels, threshold) -> None:
    """Raise `ValueError` for invalid arguments; of traced arrays, only the shape is checked."""
    changes_shape = np.shape(changes)
    has_space_coordinates = np.shape(places) == (*changes_shape[:1], 3) and not (
        has_values(places) and not np.ptp(places, axis=0).any()
    )
    has_valid_shape = np.shape(places) == (*changes_shape[:1], 2) or has_space_coordinates
    if (
        len(changes_shape) != 2
        or 0 in changes_shape
        or not has_valid_shape
        or np.shape(cell_area) not in ((), changes_shape[:1])
    ):
        raise ValueError(
            f"changes has shape {changes_shape}, places {np.shape(places)} and cell_area {np.shape(cell_area)}; give "
            "(n, m), (n, 2), on a curved skin (n, 3), and a number or (n,): one touch for each of n places, m voltages "
            "each."
        )
    if jnp.iscomplexobj(changes):
        raise ValueError("changes are complex; give their real part or the changes of the magnitudes.")
    if not isinstance(num_taxels, (int, np.integer)) or not 1 <= num_taxels <= changes_shape[0]:
        raise ValueError(
            f"num_taxels must be a whole number from 1 to the {changes_shape[0]} places; it is {num_taxels!r}."
        )
    if not 0 < threshold < 1:
        raise ValueError(f"threshold is a cosine, more than 0 and less than 1; it is {threshold!r}.")
    if has_values(changes):
        is_invalid_change = ~np.isfinite(np.asarray(changes)).all(axis=1)
        if is_invalid_change.any():
            raise ValueError(
                f"changes: those of {is_invalid_change.sum()} of {changes_shape[0]} places are NaN or infinite."
            )
        if not np.asarray(changes).any():
            raise ValueError("changes are all zero: none of the touches changes any voltage.")
    if has_values(places, cell_area):
        _check_plausible_lengths(
            np.asarray(places, float), np.broadcast_to(np.asarray(cell_area, float), changes_shape[:1])
        )


def _check_plausible_lengths(places: np.ndarray, cell_area: np.ndarray) -> None:
    if not np.isfinite(places).all():
        raise ValueError("places must be finite, in metres.")
    if not (np.isfinite(cell_area) & (cell_area > 0)).all():
        raise ValueError("cell_area must be positive and finite, in m².")
    box_area = float(np.prod(np.sort(np.ptp(places, axis=0))[-2:]))
    # The cells around the positions approximately fill the bounding box of the positions. If the areas differ by a
    # factor of 100, the units are wrong.
    if box_area > 0 and not 0.01 < cell_area.sum() / box_area < 100:
        raise ValueError(
            f"cell_area: the cells are {cell_area.sum():.3g} m² together, but the box round the places is "
            f"{box_area:.3g} m²; give places in metres and cell_area in m²."
        )
