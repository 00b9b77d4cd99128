"""Image measured frames by a network, each as soon as it arrives."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind
from jeit.data import Measurement
from jeit.touch.networks.image_network import MOST_MISSING, ImageNetwork

# Maximum difference, metres, of electrode positions and of the skin's size from those that a network was trained for.
_POSITION_TOLERANCE = 1e-3


class FrameDepth(NamedTuple):
    """Depth map of one frame of a stream.

    **Fields**: `number`: number of the frame, from 0; `depth` (rows, columns): map of depth, metres, None if the frame
    is refused; `reason`: reason for refusing it, otherwise an empty string; `latency`: time from the frame to the map,
    seconds.
    """

    number: int
    depth: Float[np.ndarray, "rows columns"] | None
    reason: str
    latency: float


def resting_frame(frames: Float[np.ndarray, "r M"], name: str = "reference") -> Float[np.ndarray, " M"]:
    """Mean (M,) of frames of the untouched skin, volts; NaN for channels without a reading.

    **Arguments:**

    - `frames`: the frames (r, M), volts.
    - `name`: what they are called in the error.

    Raises `ValueError` if more than half of the channels have no reading.

    **Example:**

    ```python
    reference = resting_frame(empty)
    image = linear.image(frame - reference)
    ```
    """
    known = np.isfinite(frames)
    number = known.sum(axis=0)
    if np.mean(number == 0) > MOST_MISSING:
        raise ValueError(f"'{name}' has no voltage of {int(np.sum(number == 0))} of {len(number)} channels.")
    return np.where(number, np.where(known, frames, 0).sum(axis=0) / np.maximum(number, 1), np.nan)


def check_measured(network: ImageNetwork, measurement: Measurement) -> None:
    """Check that a measurement is of the skin that a network was trained for.

    Raises `ValueError` for anything but a measurement, for complex voltages, and for another protocol, other positions
    of electrodes, or another size of the skin.
    """
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
    if off.max() > _POSITION_TOLERANCE:
        raise ValueError(
            f"'{measurement.name}': electrode {off.argmax() + 1} is {1e3 * off.max():.3g} mm from where the network's "
            "is; train one for this skin."
        )


def _check_extent(network: ImageNetwork, measurement: Measurement) -> None:
    """Raise `ValueError` if the skin of a measurement differs in size from that of the network by more than a
    millimetre."""
    domain = measurement.domain
    here = getattr(domain, "extent", None)
    if here is None or np.shape(here) != (4,):
        return
    own, given = (np.subtract(one[1::2], one[::2]) for one in (network.extent, np.asarray(here, float)))
    if np.abs(own - given).max() > _POSITION_TOLERANCE:
        raise ValueError(
            f"'{measurement.name}': its skin is {1e3 * given[0]:.4g} × {1e3 * given[1]:.4g} mm, and the network's "
            f"{1e3 * own[0]:.4g} × {1e3 * own[1]:.4g} mm; train one for this skin."
        )


def stream_depths(network: ImageNetwork, frames: Iterable, rest: Float[np.ndarray, " M"]) -> Iterator[FrameDepth]:
    """Reconstruct an image of each frame in turn, relative to a frame of the untouched skin.

    The network is compiled before the first frame is requested. A frame is refused, and the stream continues, if it has
    another number of channels, if too many of its channels are missing, or if its map is unreliable (see
    `ImageNetwork.doubts`).

    **Arguments:**

    - `network`: the network.
    - `frames`: frames (M,), volts.
    - `rest`: frame (M,) of the untouched skin, volts, as from `resting_frame`.

    Raises `ValueError` if `frames` is not iterable.

    **Example:**

    ```python
    for imaged in stream_depths(read_network("network"), [rest, rest], rest):
        print(imaged.number, imaged.reason)
    ```
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
