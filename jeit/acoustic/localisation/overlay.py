"""Overlays: maps of many frames in one picture, the older the fainter (Park 2022, Fig. 3C)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike


def brightness(
    maps: ArrayLike, *, method: str = "likelihood", share: float = 0.02
) -> Float[np.ndarray, "F rows columns"]:
    """Brightness of each pixel from the maps of frames: 1 at the best pixel of each map, falling to 0; 0 outside the
    outline.

    `maps` (F, rows, columns), as from `Localiser.with_maps`. For "likelihood" maps it is the likelihood relative to the
    best pixel's, exp(−(map − least)). The paper's loss ("consistency") has no such scale: its brightness falls to 1/e
    where the loss is that of the best `share` of the pixels. Raises `ValueError` for other methods or shapes.
    """
    values = np.asarray(maps, float)
    if values.ndim != 3:
        raise ValueError(f"maps has shape {values.shape}; give (frames, rows, columns).")
    if method not in ("likelihood", "consistency"):
        raise ValueError(f"method must be likelihood or consistency; it is {method!r}.")
    if not 0 < share < 1:
        raise ValueError(f"share must be between 0 and 1; it is {share}.")
    flat = np.where(np.isnan(values), np.inf, values).reshape(len(values), -1)
    least = flat.min(axis=1, keepdims=True)
    known = np.isfinite(least)
    least = np.where(known, least, 0.0)
    scale = 1.0
    if method == "consistency":
        rank = max(1, int(share * np.isfinite(flat).sum(axis=1).max(initial=1)))
        scale = np.partition(flat, min(rank, flat.shape[1] - 1), axis=1)[:, [min(rank, flat.shape[1] - 1)]] - least
        scale = np.where(np.isfinite(scale) & (scale > 0), scale, 1.0)
    return np.where(known, np.exp(-(flat - least) / scale), 0.0).reshape(values.shape)


def overlay(images: ArrayLike, times: ArrayLike, *, time_constant: float = 0.3) -> Float[np.ndarray, "F rows columns"]:
    """Overlay every frame with those before it, which fade as exp(−age / `time_constant`): (F, rows, columns).

    `images` (F, rows, columns), zero where there is no touch, NaN counts as zero; `times` (F,) in seconds, increasing.
    Each pixel shows the maximum of the faded frames, so that a source at rest does not saturate. The last image is the
    picture of the whole recording. Raises `ValueError` for shapes that disagree and a time constant that is not
    positive.
    """
    frames, when = np.nan_to_num(np.asarray(images, float)), np.asarray(times, float)
    if frames.ndim != 3 or when.shape != (len(frames),) or not len(frames):
        raise ValueError(f"images has shape {frames.shape} and times {when.shape}; give (F, rows, columns) and (F,).")
    if not (np.diff(when) > 0).all():
        raise ValueError("times must increase, in seconds.")
    if not (np.isfinite(time_constant) and time_constant > 0):
        raise ValueError(f"time_constant must be positive, in seconds; it is {time_constant}.")
    result = np.empty_like(frames)
    left = np.zeros_like(frames[0])
    for number, fade in enumerate(np.exp(-np.diff(when, prepend=when[0]) / time_constant)):
        left = np.maximum(fade * left, frames[number])
        result[number] = left
    return result


def fade(images: ArrayLike, times: ArrayLike, *, at: float, time_constant: float) -> Float[np.ndarray, "rows columns"]:
    """Faded overlay of some frames `at` a time (seconds): the last picture of their `overlay`, without computing the
    others.

    For a long recording, the picture of the whole is the maximum of the pictures of its parts.
    """
    age = np.maximum(at - np.asarray(times, float), 0.0)
    weight = np.exp(-age / time_constant)
    return np.max(np.nan_to_num(np.asarray(images, float)) * weight[:, None, None], axis=0)
