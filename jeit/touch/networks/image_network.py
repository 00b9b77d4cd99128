"""`ImageNetwork`: a trained network that estimates maps of indentation depth from a skin's voltages; files of
networks."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, check_name, describe, is_number, real_array
from jeit.design import Skin
from jeit.protocol import Protocol
from jeit.touch.networks.three_stage_network import ThreeStages
from jeit.touch.networks.unrolled_network import Unrolled
from jeit.touch.simulate.contact.indent_sets import pixel_places
from jeit.touch.simulate.contact.indents import relative_voltage_changes
from jeit.touch.training import check_same, read_model, write_model

NETWORK_DESIGNS = ("unrolled", "three-stages")
_FILE_KIND, _FILE_VERSION = "a jeit image network", 1
# Maximum number of refinement steps of an unrolled network.
_MAX_NETWORK_STEPS = 100
NETWORK_FILE = "network.jeit"
# Maximum number of frames that are imaged at once; larger batches would exceed the processor's cache. JAX compiles a
# program for each power of two up to this number.
_MAX_BATCH_SIZE = 64
# Thresholds for unreliable depth maps: fraction of the squared voltage change that the map does not explain; minimum
# size of a change that is tested, as a multiple of the noise; maximum depth, divided by the skin's thickness; minimum
# outward bulge, as a multiple of the noise floor. A large unexplained fraction alone is no evidence, since a network
# that has learnt little misses many touches: the map must also bulge outwards more than it is indented.
_MAX_UNEXPLAINED_FRACTION, _MIN_CHANGE_TO_NOISE, _MAX_RELATIVE_DEPTH, _MIN_BULGE_TO_FLOOR = 0.6, 3.0, 1.2, 3.0
# Maximum fraction of channels without a reading with which a frame is still imaged.
MAX_MISSING_FRACTION = 0.5
# Maximum relative change of a voltage; larger changes are not caused by touch.
_MAX_RELATIVE_CHANGE = 100.0


@dataclass(frozen=True)
class ImageNetwork:
    """A trained network that estimates depth maps of touches from the voltages of one skin.

    **Fields**: `network`: the neural network; `design`: design of the network, one of `NETWORK_DESIGNS`; `thickness`:
    thickness of the skin, metres; `shape`: (rows, columns) of the depth maps; `extent`: (x_min, x_max, y_min, y_max) of
    the maps, metres, with row 0 at y_min; `noise`: relative noise of a channel in training; `made_for`: description of
    the skin, electrodes and protocol that the network was trained for, as plain values.

    **Example:**

    ```python
    network = read_network("network")
    print(isinstance(network, ImageNetwork), network.depth(rest, rest).shape)
    ```
    """

    network: ThreeStages | Unrolled
    design: str
    thickness: float
    shape: tuple[int, int]
    extent: tuple[float, float, float, float]
    noise: float
    made_for: dict[str, Any]

    @classmethod
    def from_skin(cls, network: ThreeStages | Unrolled, skin: Skin, noise: float, shape: tuple[int, int]):
        """Create an `ImageNetwork` from a neural network that was trained for the given skin."""
        design_name = "unrolled" if isinstance(network, Unrolled) else "three-stages"
        low_x, high_x, low_y, high_y = map(float, skin.flat_outline.extent)
        extent = low_x, high_x, low_y, high_y
        skin_description = describe_skin(skin.model.protocol, skin.layout.centres, extent)
        return cls(network, design_name, float(skin.thickness), shape, extent, float(noise), skin_description)

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields to pickle; compiled programs are left out and compiled again later."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def depth(self, voltages: ArrayLike, reference: ArrayLike) -> Float[np.ndarray, "*n rows columns"]:
        """Estimate maps of indentation depth, metres, from one frame (channels,) or several (frames, channels), volts.

        `reference`: frame of the untouched skin, volts. Channels without a reading are NaN; the "unrolled" design
        replaces missing channels by their expected values given the other channels. The network returns a map for any
        input: `doubts` states which maps are unreliable. Raises `ValueError` if the number of channels differs from
        that in training, and as `changes` does.
        """
        voltage_changes = self.changes(voltages, reference)
        depth_maps = self.thickness * self.share(voltage_changes)
        return depth_maps if np.ndim(voltages) == 2 else depth_maps[0]

    def changes(self, voltages: ArrayLike, reference: ArrayLike) -> Float[np.ndarray, "n M"]:
        """Compute relative voltage changes (frames, channels) from a reference frame, with missing channels filled in.

        Raises `ValueError` if voltages are infinite or change by more than 100 times the reference, and if too many
        channels are missing: more than half of the channels, or any channel for the design "three-stages".
        """
        num_channels = self.made_for["channels"]
        frames = real_array("voltages", voltages, f"frames ({num_channels},) or (n, {num_channels}), volts")
        reference_frame = real_array("reference", reference, f"a frame ({num_channels},), volts")
        for argument_name, checked_frames in (("voltages", frames), ("reference", reference_frame)):
            if checked_frames.shape[-1:] != (num_channels,) or checked_frames.ndim > (
                2 if argument_name == "voltages" else 1
            ):
                raise ValueError(
                    f"{argument_name} has shape {checked_frames.shape}; this network takes {num_channels} channels."
                )
            if np.isinf(checked_frames).any():
                raise ValueError(
                    f"{argument_name} is infinite in channel "
                    f"{np.flatnonzero(np.isinf(checked_frames))[0] % num_channels}."
                )
        frames = np.atleast_2d(frames)
        is_missing = np.isnan(frames) | np.isnan(reference_frame)
        max_missing_channels = MAX_MISSING_FRACTION * num_channels if isinstance(self.network, Unrolled) else 0
        worst_frame = int(is_missing.sum(axis=1).argmax()) if len(is_missing) else 0
        if is_missing.any() and is_missing[worst_frame].sum() > max_missing_channels:
            missing_channels = np.flatnonzero(is_missing[worst_frame])
            channels_text = ", ".join(map(str, missing_channels[:6])) + (", …" if len(missing_channels) > 6 else "")
            raise ValueError(
                f"voltages: no reading of {len(missing_channels)} of {num_channels} channels ({channels_text}); "
                + (
                    "half of them are needed."
                    if max_missing_channels
                    else "a network of three stages needs all, another does not."
                )
            )
        relative_changes = np.where(
            is_missing, np.nan, relative_voltage_changes(np.nan_to_num(reference_frame), np.nan_to_num(frames))
        )
        if (max_relative_change := np.nanmax(np.abs(relative_changes), initial=0)) > _MAX_RELATIVE_CHANGE:
            raise ValueError(
                f"voltages are {max_relative_change:.3g} times those of the reference; are units the same?"
            )
        return (
            fill_missing(relative_changes, self._channel_covariance, self.noise)
            if is_missing.any()
            else relative_changes
        )

    def doubts(self, change: Float[np.ndarray, "n M"], share: Float[np.ndarray, "n rows columns"]) -> list[str]:
        """State why each depth map is unreliable; an empty string if there is no evidence against the map.

        `change`: relative voltage changes; `share`: relative depth maps, as returned by `share(change)`. A map is
        unreliable if it is much deeper than the skin is thick. For the design "unrolled", which contains a forward
        model, a map is also unreliable if it bulges outwards more than it is indented, and the voltages that the model
        predicts for its indentation do not explain the change.
        """
        doubt_reasons = ["" for _ in share]
        change_norms = np.linalg.norm(change, axis=1)
        is_testable = change_norms > _MIN_CHANGE_TO_NOISE * self.noise * np.sqrt(change.shape[1])
        unexplained_fractions, min_bulge = np.zeros(len(share)), _MIN_BULGE_TO_FLOOR * self.floor / self.thickness
        if isinstance(self.network, Unrolled) and is_testable.any():
            predicted_changes = np.asarray(self._predict_changes(np.maximum(share, 0)))
            unexplained_fractions[is_testable] = (
                np.linalg.norm(change - predicted_changes, axis=1)[is_testable] / change_norms[is_testable]
            ) ** 2
        for map_index, depth_map in enumerate(share):
            if unexplained_fractions[map_index] > _MAX_UNEXPLAINED_FRACTION and -depth_map.min() > max(
                depth_map.max(), min_bulge
            ):
                doubt_reasons[map_index] = (
                    "the change is not that of a touch, but of a skin pushed outwards; do frame and reference "
                    "have the same "
                    "signs, and was the skin untouched in the reference?"
                )
            elif depth_map.max() > _MAX_RELATIVE_DEPTH:
                doubt_reasons[map_index] = (
                    f"{1e3 * self.thickness * float(depth_map.max()):.3g} mm deep, and the skin is "
                    f"{1e3 * self.thickness:.3g} mm thick; are the units those of the reference?"
                )
        return doubt_reasons

    @functools.cached_property
    def floor(self) -> float:
        """Noise floor of depth, metres: the maximum depth in 64 maps of an untouched skin, simulated with the channel
        noise of the training."""
        generator = np.random.default_rng(0)
        return self.thickness * float(
            self.share(self.noise * generator.normal(size=(64, self.made_for["channels"]))).max()
        )

    @functools.cached_property
    def _channel_covariance(self) -> Float[np.ndarray, "M M"]:
        """Covariance (channels, channels) of the relative voltage changes that touches cause."""
        assert isinstance(self.network, Unrolled)
        return self.network.covariance(pixel_places(self.extent, self.shape))

    @functools.cached_property
    def _predict_changes(self) -> Callable[..., Any]:
        """Compiled function that predicts relative voltage changes from relative depth maps by the forward model."""
        network = self.network
        assert isinstance(network, Unrolled)
        return jax.jit(lambda depth_maps: network.predicted_changes(jnp.asarray(depth_maps, jnp.float32)))

    def share(self, change: Float[np.ndarray, "n M"]) -> Float[np.ndarray, "n rows columns"]:
        """Compute depth maps, divided by the skin's thickness, from relative voltage changes (frames, channels).

        `change` is relative to a reference frame, as computed by `jeit.touch.simulate.relative_changes`.
        """
        num_frames = len(change)
        if not num_frames:
            return np.zeros((0, *self.shape), np.float32)
        batch_size = min(_MAX_BATCH_SIZE, 2 ** (num_frames - 1).bit_length())
        padded_changes = np.zeros((-(-num_frames // batch_size) * batch_size, change.shape[1]), np.float32)
        padded_changes[:num_frames] = change
        if len(padded_changes) == batch_size:
            return np.asarray(self._compiled_network(padded_changes))[:num_frames]
        batch_starts, compiled_network = range(0, len(padded_changes), batch_size), self._compiled_network
        # A compiled program leaves cores idle between its convolutions: running two programs at once takes three
        # quarters of the time.
        with ThreadPoolExecutor(min(len(batch_starts), os.cpu_count() or 1)) as thread_pool:
            map_batches = list(
                thread_pool.map(
                    lambda batch_start: np.asarray(
                        compiled_network(padded_changes[batch_start : batch_start + batch_size])
                    ),
                    batch_starts,
                )
            )
        return np.concatenate(map_batches)[:num_frames]

    @functools.cached_property
    def _compiled_network(self) -> Callable[..., Any]:
        """Compiled function that computes relative depth maps from relative voltage changes."""
        network_arrays, static_part = eqx.partition(self.network, eqx.is_array)
        run_network = jax.jit(
            lambda network_arrays, relative_changes: eqx.combine(network_arrays, static_part)(relative_changes)
        )
        return lambda relative_changes: run_network(network_arrays, jnp.asarray(relative_changes))

    def check_protocol(self, protocol: Protocol, name: str = "the data") -> None:
        """Raise `ValueError`, which states the difference, if the network was trained for a protocol other than
        `protocol`; currents may differ."""
        check_same(name, self.made_for, _describe_protocol(protocol))


def describe_skin(protocol: Protocol, centres: ArrayLike, extent: tuple[float, ...]) -> dict[str, Any]:
    """Describe the skin that a network is trained for, as plain values that JSON can store.

    `protocol`: measurement protocol of the skin; `centres` (electrodes, 2): centres of the electrodes, metres;
    `extent`: (x_min, x_max, y_min, y_max) of the skin's bounding box, metres.
    """
    centres_mm = np.round(1e3 * np.asarray(centres), 3).tolist()
    extent_mm = np.round(1e3 * np.asarray(extent), 3).tolist()
    return {**_describe_protocol(protocol), "skin_mm": extent_mm, "electrodes_mm": centres_mm}


def write_network(network: ImageNetwork, path: str | Path) -> None:
    """Write a trained image network to one file: arrays with a JSON header.

    **Arguments:**

    - `network`: the network.
    - `path`: path of the file.

    Raises `ValueError` if `network` is no `ImageNetwork` or `path` is a folder, and `OSError` if the file cannot be
    written.

    **Example:**

    ```python
    write_network(read_network("network"), "copy.jeit")
    network = read_network("copy.jeit")
    ```
    """
    check_kind("network", network, ImageNetwork, "an ImageNetwork, as of learn_images")
    header = {
        "design": network.design,
        "steps": len(network.network.steps) if isinstance(network.network, Unrolled) else 0,
        "thickness_m": network.thickness,
        "shape": list(network.shape),
        "extent_m": list(network.extent),
        "noise": network.noise,
        "made_for": network.made_for,
        "versions": {package_name: version(package_name) for package_name in ("jeit", "jax", "equinox")},
    }
    write_model(path, _FILE_KIND, _FILE_VERSION, header, network.network)


def read_network(path: str | Path, *, skin: Skin | None = None) -> ImageNetwork:
    """Read a trained image network from a file that `write_network` wrote, or from the folder of `learn_images`.

    Nothing in the file is executed.

    **Arguments:**

    - `path`: path of the file or folder.
    - `skin`: the skin to be imaged, which is compared with the skin that the network was trained for.

    Raises `FileNotFoundError` if the path does not exist, and `ValueError` if the file contains no image network or the
    network was trained for another skin.

    **Example:**

    ```python
    network = read_network("network", skin=sheet)
    depth = network.depth(rest, rest)  # (rows, columns), metres
    ```
    """
    path = Path(path)
    path = path / NETWORK_FILE if path.is_dir() else path
    header, network = read_model(path, _FILE_KIND, _FILE_VERSION, _untrained_network)
    low_x, high_x, low_y, high_y = map(float, header["extent_m"])
    image_network = ImageNetwork(
        network,
        header["design"],
        float(header["thickness_m"]),
        (int(header["shape"][0]), int(header["shape"][1])),
        (low_x, high_x, low_y, high_y),
        float(header["noise"]),
        header["made_for"],
    )
    if skin is not None:
        skin_description = describe_skin(
            skin.model.protocol, skin.layout.centres, (*map(float, skin.flat_outline.extent),)
        )
        check_same(path, image_network.made_for, skin_description)
    return image_network


def _untrained_network(header: dict[str, Any]) -> ThreeStages | Unrolled:
    """Create an untrained network of the architecture that the `header` of a network's file describes."""
    check_name("design", header["design"], NETWORK_DESIGNS)
    rows, columns = header["shape"]
    num_channels, key = header["made_for"]["channels"], jax.random.key(0)
    for header_size in (rows, columns, num_channels):
        if not (isinstance(header_size, int) and 1 <= header_size <= 10_000):
            raise ValueError(f"its header gives {describe(header_size)} rows, columns or channels")
    lengths_and_noise = [header["thickness_m"], header["noise"], *header["extent_m"]]
    if len(lengths_and_noise) != 6 or not all(is_number(header_number) for header_number in lengths_and_noise):
        raise ValueError("its header gives no thickness, noise and extent")
    if not (isinstance(header["steps"], int) and 0 <= header["steps"] <= _MAX_NETWORK_STEPS):
        raise ValueError(f"its header gives {describe(header['steps'])} steps")
    if header["design"] == "three-stages":
        return ThreeStages(num_channels, (rows, columns), key=key)
    return Unrolled(num_channels, (rows, columns), header["steps"], key=key)


def _describe_protocol(protocol: Protocol) -> dict[str, Any]:
    """Return the numbers of channels and electrodes of a protocol, and a hash of its drive and measurement patterns
    that does not depend on the current."""
    drive_patterns, measurement_patterns = np.asarray(protocol.channel_drive), np.asarray(protocol.channel_measurement)
    scaled_patterns = (
        np.round(
            np.concatenate(
                [
                    drive_patterns / np.abs(drive_patterns).max(),
                    measurement_patterns / np.abs(measurement_patterns).max(),
                ]
            ),
            6,
        )
        + 0.0
    )
    return {
        "channels": protocol.num_measurements,
        "electrodes": protocol.num_electrodes,
        "patterns_sha256": hashlib.sha256(scaled_patterns.tobytes()).hexdigest()[:16],
    }


def fill_missing(
    changes: Float[np.ndarray, "n M"], covariance: Float[np.ndarray, "M M"], noise: float
) -> Float[np.ndarray, "n M"]:
    """Replace missing channels, NaN, by their expected values given the other channels, C₂₁ (C₁₁ + noise² 1)⁻¹ y₁.

    C is the `covariance` of the relative changes that touches cause; index 1 stands for known channels, 2 for missing
    channels; y₁ are the changes of the known channels. `noise`: standard deviation of the Gaussian noise of each
    channel.
    """
    completed_changes = np.array(changes, float)
    has_reading = np.isfinite(completed_changes)
    for read_channels in np.unique(has_reading[~has_reading.all(axis=1)], axis=0):
        has_same_channels = (has_reading == read_channels).all(axis=1)
        read_covariance = covariance[np.ix_(read_channels, read_channels)] + noise**2 * np.eye(int(read_channels.sum()))
        regression_matrix = np.linalg.solve(read_covariance, covariance[np.ix_(read_channels, ~read_channels)])
        completed_changes[np.ix_(has_same_channels, ~read_channels)] = (
            completed_changes[np.ix_(has_same_channels, read_channels)] @ regression_matrix
        )
    return completed_changes
