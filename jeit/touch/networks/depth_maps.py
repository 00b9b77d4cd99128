"""Estimate depth maps of measured frames by a network, each map as soon as its frame arrives."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind
from jeit.data import Measurement
from jeit.touch.networks.image_network import MAX_MISSING_FRACTION, ImageNetwork

# Maximum difference, metres, of electrode positions and skin size between a measurement and a network's training.
_POSITION_TOLERANCE = 1e-3


class FrameDepth(NamedTuple):
    """Indentation depth map of one frame of a stream.

    **Fields**: `number`: number of the frame, from 0; `depth` (rows, columns): depth map, metres, None if the frame is
    refused; `reason`: reason for refusing the frame, otherwise an empty string; `latency`: time from the frame's
    arrival to the map, seconds.
    """

    number: int
    depth: Float[np.ndarray, "rows columns"] | None
    reason: str
    latency: float


def resting_frame(frames: Float[np.ndarray, "r M"], name: str = "reference") -> Float[np.ndarray, " M"]:
    """Compute the mean frame (channels,) of an untouched skin, volts; NaN for channels without a reading.

    **Arguments:**

    - `frames`: frames of the untouched skin (frames, channels), volts.
    - `name`: name of the frames in error messages.

    Raises `ValueError` if more than half of the channels have no reading.

    **Example:**

    ```python
    reference = resting_frame(empty)
    image = linear.image(frame - reference)
    ```
    """
    has_reading = np.isfinite(frames)
    num_readings = has_reading.sum(axis=0)
    if np.mean(num_readings == 0) > MAX_MISSING_FRACTION:
        raise ValueError(
            f"'{name}' has no voltage of {int(np.sum(num_readings == 0))} of {len(num_readings)} channels."
        )
    return np.where(num_readings, np.where(has_reading, frames, 0).sum(axis=0) / np.maximum(num_readings, 1), np.nan)


def check_measured(network: ImageNetwork, measurement: Measurement) -> None:
    """Check that a measurement is of the skin that a network was trained for.

    Raises `ValueError` if `measurement` is no measurement, has complex voltages, or differs from the network's training
    in protocol, positions of electrodes, or size of the skin.
    """
    check_kind("measurement", measurement, Measurement, "a Measurement, as of jeit.data.read")
    network.check_protocol(measurement.protocol, measurement.name)
    if np.iscomplexobj(measurement.voltages):
        raise ValueError(f"'{measurement.name}' is complex, and the network was trained on real voltages.")
    _check_extent(network, measurement)
    electrode_positions = getattr(measurement.electrodes, "position", None)
    if electrode_positions is None or np.ndim(electrode_positions) != 2:
        return
    trained_positions = 1e-3 * np.asarray(network.made_for["electrodes_mm"])
    electrode_distances = np.linalg.norm(np.asarray(electrode_positions)[:, :2] - trained_positions, axis=1)
    if electrode_distances.max() > _POSITION_TOLERANCE:
        raise ValueError(
            f"'{measurement.name}': electrode {electrode_distances.argmax() + 1} is "
            f"{1e3 * electrode_distances.max():.3g} mm from where the network's is; train one for this skin."
        )


def _check_extent(network: ImageNetwork, measurement: Measurement) -> None:
    """Raise `ValueError` if the sizes of a measurement's and a network's skin differ by more than a millimetre."""
    measured_domain = measurement.domain
    measured_extent = getattr(measured_domain, "extent", None)
    if measured_extent is None or np.shape(measured_extent) != (4,):
        return
    trained_size, measured_size = (
        np.subtract(extent[1::2], extent[::2]) for extent in (network.extent, np.asarray(measured_extent, float))
    )
    if np.abs(trained_size - measured_size).max() > _POSITION_TOLERANCE:
        raise ValueError(
            f"'{measurement.name}': its skin is {1e3 * measured_size[0]:.4g} × {1e3 * measured_size[1]:.4g} mm, and "
            f"the network's {1e3 * trained_size[0]:.4g} × {1e3 * trained_size[1]:.4g} mm; train one for this skin."
        )


def stream_depths(network: ImageNetwork, frames: Iterable, rest: Float[np.ndarray, " M"]) -> Iterator[FrameDepth]:
    """Estimate the depth map of each frame in turn, relative to a frame of the untouched skin, by a network.

    The network is compiled before the first frame is requested. A frame is refused, and the stream continues, if its
    number of channels differs from that of the network, if too many of its channels are missing, or if its map is
    unreliable (see `ImageNetwork.doubts`).

    **Arguments:**

    - `network`: the trained image network.
    - `frames`: an iterable of frames (channels,), volts.
    - `rest`: frame (channels,) of the untouched skin, volts, as returned by `resting_frame`.

    Raises `ValueError` if `frames` is not iterable.

    **Example:**

    ```python
    for imaged in stream_depths(read_network("network"), [rest, rest], rest):
        print(imaged.number, imaged.reason)
    ```
    """
    check_kind("frames", frames, Iterable, "frames one after another, each (M,) volts")
    network.doubts(np.ones((1, len(rest))), network.share(np.zeros((1, len(rest)))))
    for frame_index, frame in enumerate(frames):
        start_time = time.perf_counter()
        try:
            voltage_change = network.changes(np.asarray(frame, float), rest)
            depth_fraction = network.share(voltage_change)
            (reason,) = network.doubts(voltage_change, depth_fraction)
            depth_map = None if reason else network.thickness * depth_fraction[0]
        except (ValueError, TypeError) as error:
            depth_map, reason = None, " ".join(str(error).split())
        yield FrameDepth(frame_index, depth_map, reason, time.perf_counter() - start_time)
