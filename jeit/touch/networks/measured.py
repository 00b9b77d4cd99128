"""Image measured frames by a network, each as soon as it has come."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind
from jeit.data import Measurement
from jeit.touch.networks.image_network import ImageNetwork
from jeit.touch.networks.missing import MOST_MISSING

# The greatest distance, metres, of electrodes from those that a network was trained for.
_OFF = 1e-3


class FrameDepth(NamedTuple):
    """One frame of a stream: its `number`, from 0, its map of `depth` (rows, columns), metres, None where it is refused
    for the `reason`, and the `latency`, seconds from the frame to the map."""

    number: int
    depth: Float[np.ndarray, "rows columns"] | None
    reason: str
    latency: float


def resting_frame(frames: Float[np.ndarray, "r M"], name: str = "reference") -> Float[np.ndarray, " M"]:
    """The mean (M,) of frames (r, M) of a skin that nobody touches, volts, NaN where no frame has a reading. Raises
    `ValueError` where most channels have none."""
    known = np.isfinite(frames)
    number = known.sum(axis=0)
    if np.mean(number == 0) > MOST_MISSING:
        raise ValueError(f"'{name}' has no voltage of {int(np.sum(number == 0))} of {len(number)} channels.")
    return np.where(number, np.where(known, frames, 0).sum(axis=0) / np.maximum(number, 1), np.nan)


def check_measured(network: ImageNetwork, measurement: Measurement) -> None:
    """Raise `ValueError` for what is no measurement, and one of another protocol, or of electrodes at other places,
    than the network was trained for."""
    check_kind("measurement", measurement, Measurement, "a Measurement, as of jeit.data.read")
    network.check_protocol(measurement.protocol, measurement.name)
    if np.iscomplexobj(measurement.voltages):
        raise ValueError(f"'{measurement.name}' is complex, and the network was trained on real voltages.")
    _check_extent(network, measurement)
    places = getattr(measurement.electrodes, "position", None)
    if places is None or np.ndim(places) != 2:
        return
    own = 1e-3 * np.asarray(network.made_for["electrodes_mm"])
    off = np.linalg.norm(np.asarray(places)[:, :2] - own, axis=1)
    if off.max() > _OFF:
        raise ValueError(
            f"'{measurement.name}': electrode {off.argmax() + 1} is {1e3 * off.max():.3g} mm from where the network's "
            "is; train one for this skin."
        )


def _check_extent(network: ImageNetwork, measurement: Measurement) -> None:
    domain = measurement.domain
    here = getattr(domain, "extent", None)
    if here is None or np.shape(here) != (4,):
        return
    own, given = (np.subtract(one[1::2], one[::2]) for one in (network.extent, np.asarray(here, float)))
    if np.abs(own - given).max() > _OFF:
        raise ValueError(
            f"'{measurement.name}': its skin is {1e3 * given[0]:.4g} × {1e3 * given[1]:.4g} mm, and the network's "
            f"{1e3 * own[0]:.4g} × {1e3 * own[1]:.4g} mm; train one for this skin."
        )


def stream_depths(network: ImageNetwork, frames: Iterable, rest: Float[np.ndarray, " M"]) -> Iterator[FrameDepth]:
    """Image frames (M,), volts, one after the other, relative to the frame `rest` (M,) of the untouched skin.

    Everything is compiled before the first frame is requested. A frame is refused, and the stream continues, when it
    has another number of channels, too many of them are missing, or its map is unreliable (`ImageNetwork.doubts`).
    Raises `ValueError` for what are no frames.
    """
    check_kind("frames", frames, Iterable, "frames one after another, each (M,) volts")
    network.doubts(np.ones((1, len(rest))), network.share(np.zeros((1, len(rest)))))
    for number, frame in enumerate(frames):
        begin = time.perf_counter()
        try:
            change = network.changes(np.asarray(frame, float), rest)
            share = network.share(change)
            (reason,) = network.doubts(change, share)
            depth = None if reason else network.thickness * share[0]
        except (ValueError, TypeError) as error:
            depth, reason = None, " ".join(str(error).split())
        yield FrameDepth(number, depth, reason, time.perf_counter() - begin)
