"""An unrolled network with the skin's forward model: linear images of residual voltages, refined by convolutions.

Every step of the network computes linear images of the residual voltage changes by matrices of the forward model: one
Gauss-Newton step with a Gaussian prior. Two images allow for noise alone, a third also for drift of the contact
impedances. A small convolutional network then computes a correction of the depth map from the images. The training loss
includes the misfit of the voltages that the forward model predicts for the maps.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.touch.networks.linear_channels import LinearChannels, depth_from_strength, round_relative_to_maximum, strength
from jeit.touch.networks.three_stage_network import Convolution, channels_to_pixels, repeat_pixels
from jeit_solvers.module import Module

# Numbers of channels of the inner and of the outer layers of the refinement network.
_INNER_CHANNELS, _OUTER_CHANNELS = 24, 16
# Prior: standard deviation of the strength of a pixel's indentation; correlation length of the strengths, divided by
# the skin's longer side. Linear images: multiples of the noise for the images without drift, of which the first image
# is the initial map; standard deviation of the drift of log contact impedances, for one more image.
_STRENGTH_DEVIATION, _CORRELATION_LENGTH, _NOISE_MULTIPLES, _CONTACT_DRIFT = 0.15, 0.04, (8.0, 1.5), 0.05


class Refinement(Module):
    """Convolutional U-net that computes corrections of depth maps from images with half the maps' rows and columns."""

    inwards: tuple[Convolution, ...]
    outwards: tuple[Convolution, ...]
    last: Convolution

    def __init__(self, num_channels: int, *, key: Array):
        """Create an untrained U-net for images with `num_channels` channels."""
        convolution_keys = jax.random.split(key, 9)
        self.inwards = (
            Convolution(num_channels, _OUTER_CHANNELS, key=convolution_keys[0]),
            Convolution(_OUTER_CHANNELS, _INNER_CHANNELS, 2, key=convolution_keys[1]),
            Convolution(_INNER_CHANNELS, _INNER_CHANNELS, key=convolution_keys[2]),
            Convolution(_INNER_CHANNELS, _INNER_CHANNELS, 2, key=convolution_keys[3]),
            Convolution(_INNER_CHANNELS, _INNER_CHANNELS, key=convolution_keys[4]),
        )
        self.outwards = (
            Convolution(_INNER_CHANNELS, _INNER_CHANNELS, key=convolution_keys[5]),
            Convolution(_INNER_CHANNELS, _OUTER_CHANNELS, key=convolution_keys[6]),
            Convolution(_OUTER_CHANNELS, _OUTER_CHANNELS, key=convolution_keys[7]),
        )
        last_layer = Convolution(_OUTER_CHANNELS, 4, key=convolution_keys[8])
        # The initial weights of the last layer are small, so that an untrained network hardly changes the linear
        # images.
        self.last = eqx.tree_at(lambda layer: layer.weight, last_layer, 0.01 * last_layer.weight)

    def __call__(self, images: Float[Array, "b r c i"]) -> Float[Array, "b s d"]:
        """Compute corrections of depth maps from a batch of images (maps, rows, columns, channels)."""
        elu = jax.nn.elu
        full_resolution_features = elu(self.inwards[0](images))
        half_resolution_features = elu(self.inwards[2](elu(self.inwards[1](full_resolution_features))))
        quarter_resolution_features = elu(self.inwards[4](elu(self.inwards[3](half_resolution_features))))
        half_resolution_decoded = elu(
            self.outwards[0](half_resolution_features + repeat_pixels(quarter_resolution_features))
        )
        full_resolution_decoded = elu(
            self.outwards[2](full_resolution_features + repeat_pixels(elu(self.outwards[1](half_resolution_decoded))))
        )
        return channels_to_pixels(self.last(full_resolution_decoded))


class Unrolled(Module):
    """Network that computes depth maps, divided by the skin's thickness, from relative voltage changes.

    **Fields**: `operator` (channels, pixels): response of the channels to indentation of each pixel; `imagers`
    (channels, pixels, images): transposed matrices that map voltage changes to linear images with pixels twice as wide;
    `constant_images` (rows / 2, columns / 2, images): relative distance from the nearest electrode and standardised log
    response of each pixel; `steps`: networks that correct the depth map; `shape`: (rows, columns) of the maps. Only
    `steps` are trained; the other fields depend on the skin.
    """

    operator: Float[Array, "M P"]
    imagers: Float[Array, "M p k"]
    constant_images: Float[Array, "r c s"]
    steps: tuple[Refinement, ...]
    shape: tuple[int, int] = eqx.field(static=True)

    def __init__(self, num_channels: int, shape: tuple[int, int], num_steps: int = 1, *, key: Array):
        """Create an untrained network for `num_channels` channels and maps of the given shape, not yet adapted to a
        skin."""
        rows, columns = shape[0] // 2, shape[1] // 2
        num_images = len(_NOISE_MULTIPLES) + 1
        self.operator = jnp.asarray(np.zeros((num_channels, shape[0] * shape[1]), np.float32))
        self.imagers = jnp.asarray(np.zeros((num_channels, rows * columns, num_images), np.float32))
        self.constant_images = jnp.asarray(np.zeros((rows, columns, 2), np.float32))
        step_keys = jax.random.split(key, num_steps)
        self.steps = tuple(
            Refinement(num_images + 2 + (4 if step_index else 0), key=step_key)
            for step_index, step_key in enumerate(step_keys)
        )
        self.shape = shape

    def adapted_to_skin(
        self, channels: LinearChannels, pixel_positions: Float[np.ndarray, "r c 2"], electrode_positions, noise: float
    ) -> "Unrolled":
        """Return the network with the matrices and constant images of a skin.

        `channels`: linear model of the skin's channels; `pixel_positions` (rows, columns, 2): positions of the map's
        pixels, metres; `electrode_positions` (electrodes, 2): positions of the electrodes, metres; `noise`: relative
        noise of the channels.
        """
        coarse_operator = channels.coarser_operator()
        strength_covariance = _strength_covariance(pixel_positions[::2, ::2].reshape(-1, 2))
        cross_covariance = coarse_operator @ strength_covariance
        change_covariance = cross_covariance @ coarse_operator.T
        drift_covariance = _CONTACT_DRIFT**2 * channels.contacts.T @ channels.contacts
        noise_covariance = noise**2 * np.eye(len(change_covariance))
        error_covariances = [
            *(noise_multiple**2 * noise_covariance for noise_multiple in _NOISE_MULTIPLES),
            noise_covariance + drift_covariance,
        ]
        imagers = np.stack(
            [
                np.linalg.solve(change_covariance + error_covariance, cross_covariance)
                for error_covariance in error_covariances
            ],
            axis=-1,
        )
        block_centres = pixel_positions.reshape(self.shape[0] // 2, 2, self.shape[1] // 2, 2, 2).mean(axis=(1, 3))
        electrode_distances = np.linalg.norm(
            block_centres[..., None, :] - np.asarray(electrode_positions), axis=-1
        ).min(axis=-1)
        log_sensitivity = np.log(np.linalg.norm(coarse_operator, axis=0).reshape(electrode_distances.shape) + 1e-9)
        constant_images = np.stack(
            [
                electrode_distances / electrode_distances.max(),
                (log_sensitivity - log_sensitivity.mean()) / log_sensitivity.std(),
            ],
            axis=-1,
        )
        skin_arrays = [
            jnp.asarray(round_relative_to_maximum(array), jnp.float32)
            for array in (channels.operator, imagers, constant_images)
        ]
        return eqx.tree_at(
            lambda network: (network.operator, network.imagers, network.constant_images), self, skin_arrays
        )

    @property
    def trained(self) -> "Unrolled":
        """Tree of booleans with the structure of the network: true for the arrays that are trained."""
        false_mask = jax.tree.map(lambda _: False, self)
        return eqx.tree_at(lambda network: network.steps, false_mask, jax.tree.map(eqx.is_inexact_array, self.steps))

    def covariance(self, pixel_positions: Float[np.ndarray, "r c 2"]) -> Float[np.ndarray, "M M"]:
        """Compute the covariance (channels, channels) of the relative voltage changes due to touches that are
        distributed according to the prior; `pixel_positions` (rows, columns, 2): positions of the pixels, metres."""
        rows, columns = self.shape[0] // 2, self.shape[1] // 2
        coarse_operator = np.asarray(self.operator, float).reshape(-1, rows, 2, columns, 2).sum(axis=(2, 4))
        coarse_operator = coarse_operator.reshape(len(coarse_operator), -1)
        return coarse_operator @ _strength_covariance(pixel_positions[::2, ::2].reshape(-1, 2)) @ coarse_operator.T

    def predicted_changes(self, maps: Float[Array, "b r c"]) -> Float[Array, "b M"]:
        """Compute the relative voltage changes (maps, channels) that the linear forward model predicts for relative
        depth maps."""
        return strength(maps).reshape(len(maps), -1) @ self.operator.T

    def maps_after_steps(self, changes: Float[Array, "b M"]) -> list[Float[Array, "b r c"]]:
        """Compute the relative depth maps after each step of the network from relative voltage changes (frames,
        channels)."""
        num_frames, (rows, columns) = len(changes), (self.shape[0] // 2, self.shape[1] // 2)
        constant_images = jnp.broadcast_to(self.constant_images, (num_frames, *self.constant_images.shape))
        maps_of_steps = []
        for refinement in self.steps:
            voltage_residual = changes - self.predicted_changes(maps_of_steps[-1]) if maps_of_steps else changes
            residual_images = (voltage_residual @ self.imagers.reshape(len(self.imagers), -1)).reshape(
                num_frames, rows, columns, -1
            )
            refinement_inputs = [residual_images / _STRENGTH_DEVIATION, constant_images]
            if maps_of_steps:
                previous_maps = maps_of_steps[-1]
                pixel_blocks = previous_maps.reshape(num_frames, rows, 2, columns, 2)
                refinement_inputs.append(jnp.moveaxis(pixel_blocks, 2, 3).reshape(num_frames, rows, columns, 4))
            else:
                previous_maps = repeat_pixels(depth_from_strength(residual_images[..., :1]))[..., 0]
            maps_of_steps.append(previous_maps + refinement(jnp.concatenate(refinement_inputs, axis=-1)))
        return maps_of_steps

    def __call__(self, changes: Float[Array, "b M"]) -> Float[Array, "b r c"]:
        """Compute the relative depth maps after the last step of the network from relative voltage changes (frames,
        channels)."""
        return self.maps_after_steps(changes)[-1]


def _strength_covariance(pixel_positions: Float[np.ndarray, "p 2"]) -> Float[np.ndarray, "p p"]:
    """Compute the prior covariance of the indentation strengths of pixels, a Gaussian function of the pixels'
    distance."""
    correlation_length = _CORRELATION_LENGTH * np.ptp(pixel_positions, axis=0).max()
    squared_distances = ((pixel_positions[:, None] - pixel_positions) ** 2).sum(axis=-1)
    return _STRENGTH_DEVIATION**2 * np.exp(-squared_distances / (2 * correlation_length**2))
