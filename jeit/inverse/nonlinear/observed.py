"""What of a model and its voltages is used: the channels that a mask leaves, and of those the independent ones."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Bool, Float

from jeit.forward import ForwardModel
from jeit.inverse.channels import Data, IndependentChannels
from jeit_solvers.engines import has_values, on_host


def independent_data(
    model: ForwardModel,
    measured: Float[Array, " M"],
    used: Bool[np.ndarray, " M"],
    deviation: Float[Array, " M"],
    *,
    at_once: bool,
) -> tuple[ForwardModel, Data]:
    """The model of the independent channels among those used, and their voltages.

    `deviation` (M,) of the noise, volts. `at_once`: in NumPy, if the model works that way.
    """
    kept = np.flatnonzero(used)
    observed = model if used.all() else model.with_protocol(model.protocol.subset(kept))
    channels = IndependentChannels.create(observed.protocol)
    small = observed
    if has_values(observed.protocol):
        small = observed.with_protocol(observed.protocol.subset(np.asarray(channels.index)))
    # Of a solid body compiled programs would hold the Jacobian several times over.
    if at_once and (model.at_once or model.mesh.dimension == 3) and has_values(small):
        small, channels = on_host((small, channels))  # and so is all that is made of them
    return small, channels.weigh(deviation[kept]).combine(measured[kept])
