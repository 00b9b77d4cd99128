"""Estimate the place of a touch from a map of depth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

# Share of a map's greatest depth below which a pixel is not part of a touch.
_PART = 0.5


def peaks(maps: Float[np.ndarray, "n r c"], places: Float[np.ndarray, "r c 2"]) -> Float[np.ndarray, "n 2"]:
    """Places (n, 2) of the deepest pixels, metres; `places` of the pixels."""
    deepest = maps.reshape(len(maps), -1).argmax(axis=1)
    return places.reshape(-1, 2)[deepest]


def centroids_of(maps: Float[np.ndarray, "n r c"], places: Float[np.ndarray, "r c 2"]) -> Float[np.ndarray, "n 2"]:
    """Centroids (n, 2) of the pixels deeper than half of the deepest, weighted by depth, metres."""
    flat = maps.reshape(len(maps), -1)
    most = flat.max(axis=1, keepdims=True)
    weight = np.where(flat > _PART * most, np.maximum(flat, 0), 0)
    # For a map without any depth: the middle of the skin.
    weight = np.where(most > 0, weight, 1.0)
    return weight @ places.reshape(-1, 2) / weight.sum(axis=1, keepdims=True)


def errors(found: Float[np.ndarray, "n 2"], right: Float[np.ndarray, "n 2"]) -> dict[str, float]:
    """Mean, standard deviation and root mean square of the distance of estimated from true places, metres."""
    off = np.linalg.norm(found - right, axis=1)
    return {"mean": float(off.mean()), "sd": float(off.std()), "rms": float(np.sqrt(np.mean(off**2)))}
