"""Simulated acoustic skin: the sound received from touches by microphones under an elastomer layer.

No openly licensed recording of a skin with microphones exists; this stands in where one is needed. Sound is propagated
frequency by frequency, with spreading, viscoelastic loss, delays and echoes of the edges, so that localisation is
*not* tested on the decay model a/(r² + b) that it fits. The setup is that of Park et al., Science Robotics 7,
eabm7187 (2022). The physics is in `jeit.acoustic.simulate.propagation`, touches in `jeit.acoustic.simulate.touches`.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.acoustic.simulate.layer import ElastomerLayer
from jeit.acoustic.simulate.microphones import MicrophoneModel, Readout, microphone_grid
from jeit.arguments import check_key, check_kind


class SoundingSkin(eqx.Module):
    """An elastomer layer with microphones under its surface.

    A source of strength 1 is one whose sound, received by a nominal microphone right below it with no loss and no
    echoes, would have a mean square of 1; this is the (arbitrary) unit of all samples.

    **Fields**

    - `microphones` (M, 2), metres; `microphone_depth` (M,) metres under the surface; `gain` (M,), in amplitude;
      `noise_factor` (M,), power of each microphone's own noise relative to the nominal one.
    - `layer`: its shape and material. `microphone_model`: what the nominal microphone is like.
      `readout`: how all are read.
    - `spectral_slope`: the power density of a touch falls as frequency to minus this (1: 3 dB per octave).
    """

    microphones: Float[Array, "M 2"]
    microphone_depth: Float[Array, " M"]
    gain: Float[Array, " M"]
    noise_factor: Float[Array, " M"]
    layer: ElastomerLayer
    microphone_model: MicrophoneModel
    readout: Readout
    spectral_slope: float

    def __init__(
        self,
        key: Array,
        microphones: ArrayLike | None = None,
        *,
        layer: ElastomerLayer | None = None,
        microphone_model: MicrophoneModel | None = None,
        readout: Readout | None = None,
        spectral_slope: float = 1.0,
    ):
        """`key` draws by how much the microphones differ, as `microphone_model` has it: the same key gives the same
        microphones, whatever the other arguments. `microphones`: (M, 2) metres; a grid of 5 × 5 unless given.
        `layer`, `microphone_model` and `readout`: those of the paper's device unless given. Raises `ValueError` for
        microphones off the layer, and for things of another kind.
        """
        check_key(key)
        self.layer = ElastomerLayer() if layer is None else layer
        self.microphone_model = MicrophoneModel() if microphone_model is None else microphone_model
        self.readout = Readout() if readout is None else readout
        check_kind("layer", self.layer, ElastomerLayer, "an ElastomerLayer, such as ElastomerLayer(0.2, 0.2, 0.01)")
        check_kind(
            "microphone_model", self.microphone_model, MicrophoneModel, "a MicrophoneModel, such as MicrophoneModel()"
        )
        check_kind("readout", self.readout, Readout, "a Readout, such as Readout(multiplexed=False)")
        if not np.isfinite(spectral_slope):
            raise ValueError(f"spectral_slope must be finite; it is {spectral_slope}.")
        self.spectral_slope = spectral_slope
        width, height = self.layer.width, self.layer.height
        place = microphone_grid(5, width=width, height=height) if microphones is None else microphones
        place = self.layer.check_inside("microphones", place)
        draws = np.asarray(jax.random.normal(key, (3, len(place))))
        self.microphones = jnp.asarray(place)
        self.microphone_depth = jnp.asarray(
            self.microphone_model.depth * np.exp(self.microphone_model.depth_spread * draws[0])
        )
        self.gain = jnp.asarray(10 ** (self.microphone_model.gain_spread_db * draws[1] / 20))
        self.noise_factor = jnp.asarray(10 ** (self.microphone_model.noise_spread_db * draws[2] / 10))

    @property
    def num_microphones(self) -> int:
        """Number of microphones, M."""
        return self.microphones.shape[0]

    @property
    def rate(self) -> float:
        """Samples of each microphone per second."""
        return self.readout.rate

    @property
    def stagger(self) -> np.ndarray:
        """Delay of the sampling of each microphone after the first, (M,) seconds."""
        return self.readout.stagger(self.num_microphones)


def check_skin_and_key(skin: SoundingSkin, key: Array) -> None:
    """Raises `ValueError` for what is no `SoundingSkin`, and for what is no random key."""
    check_kind("skin", skin, SoundingSkin, "a SoundingSkin, such as SoundingSkin(jax.random.key(0))")
    check_key(key)
