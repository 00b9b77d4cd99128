"""Measured frames imaged by a network: one after the other, each as soon as it has come."""

import time
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind
from jeit.data import Measurement
from jeit.touch.networks.image_network import ImageNetwork

# Metres that electrodes may be elsewhere than those that a network was trained for.
_OFF = 1e-3


class FrameDepth(NamedTuple):
    """One frame of a stream: its `number`, from 0, its map of `depth` (rows, columns), metres, None where it is refused
    for the `reason`, and the `latency`, seconds from the frame to the map."""

    number: int
    depth: Float[np.ndarray, "rows columns"] | None
    reason: str
    latency: float


def resting_frame(network: ImageNetwork, reference: Measurement) -> Float[np.ndarray, " M"]:
    """The mean (M,) of the frames of a skin that nobody touches, volts. Raises `ValueError` where they are of another
    skin or protocol than the network was trained for, with the difference, and for channels that no frame has."""
    check_measured(network, reference)
    mask, voltages = np.asarray(reference.mask), np.asarray(reference.voltages)
    number = mask.sum(axis=0)
    if not number.all():
        lost = np.flatnonzero(number == 0)
        raise ValueError(
            f"'{reference.name}' has no voltage of {len(lost)} of {len(number)} channels, the first is number "
            f"{lost[0]}; a network needs all of them."
        )
    return np.where(mask, voltages, 0).sum(axis=0) / number


def check_measured(network: ImageNetwork, measurement: Measurement) -> None:
    """Raise `ValueError` for what is no measurement, and one of another protocol, or of electrodes at other places,
    than the network was trained for."""
    check_kind("measurement", measurement, Measurement, "a Measurement, as of jeit.data.read")
    network.check_protocol(measurement.protocol, measurement.name)
    if np.iscomplexobj(measurement.voltages):
        raise ValueError(f"'{measurement.name}' is complex, and the network was trained on real voltages.")
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


def stream_depths(network: ImageNetwork, frames: Iterable, rest: Float[np.ndarray, " M"]) -> Iterator[FrameDepth]:
    """Maps of frames (M,), volts, one after the other, beside the frame `rest` (M,) of the untouched skin; everything
    is compiled before the first is asked for. A frame is refused, and the stream goes on, when it has another number of
    channels, or any of them is missing. Raises `ValueError` for what are no frames."""
    check_kind("frames", frames, Iterable, "frames one after another, each (M,) volts")
    network.depth(rest, rest)
    for number, frame in enumerate(frames):
        begin = time.perf_counter()
        try:
            depth, reason = network.depth(np.asarray(frame, float), rest), ""
        except (ValueError, TypeError) as error:
            depth, reason = None, " ".join(str(error).split())
        yield FrameDepth(number, depth, reason, time.perf_counter() - begin)
