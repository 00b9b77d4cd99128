"""Back-projection: the change of each channel, spread over the cells in the channel's equipotential band."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Bool
from numpy.typing import ArrayLike

from jeit.arguments import check_has_values
from jeit.forward import ForwardModel
from jeit.forward.model import check_model
from jeit.inverse.linear.one_step import LinearReconstruction


def back_projection(
    model: ForwardModel,
    conductivity: ArrayLike,
    *,
    filtered: bool = False,
    hyperparameter: float = 0.05,
    mask: Bool[Array, " M"] | None = None,
) -> LinearReconstruction:
    """Back-projection of voltage differences along the bands between equipotential lines of every drive.

    Every channel's relative change is spread over the cells whose potential, under that channel's drive, lies
    between the potentials of its measuring electrodes, and a cell takes the mean over the channels that reach it
    (Barber and Brown, J. Phys. E 17 (1984) 723-733). The result is scaled so that a uniform change of conductivity
    is imaged as itself.

    `filtered`: back-project filtered data F v instead, where F minimises ‖JBFv - v‖² + λ²‖JB‖²‖Fv‖², so that the image,
    seen through the Jacobian J, gives back the data: sharper, and noisier; `hyperparameter` is λ. `mask`: True for the
    channels to use. Raises `ValueError` for protocols whose channels have more than two electrodes, where no band is
    defined. `conductivity`: the background, S/m (2-D: S).
    """
    check_model(model)
    instead = (
        "work it out once outside: its image() is what JAX transforms; or take one_step, which can be differentiated"
    )
    check_has_values("model or conductivity", (model, conductivity), "its bands are drawn from", instead)
    protocol = model.protocol
    used = np.ones(protocol.num_measurements, bool) if mask is None else np.asarray(mask, bool)
    if used.shape != (protocol.num_measurements,) or not used.any():
        raise ValueError(f"mask must be ({protocol.num_measurements},) booleans with at least one True.")
    measurement = np.asarray(protocol.measurement)
    if (np.count_nonzero(measurement, axis=1) != 2).any():
        raise ValueError(
            f"Back-projection needs measurements between two electrodes each; protocol '{protocol.name}' has others. "
            "Use one_step, which takes any protocol."
        )
    voltages, jacobian = map(np.asarray, model.voltages_and_jacobian(conductivity))
    nodal = np.asarray(model.potentials(conductivity))
    cells = np.asarray(model.mesh.cells)
    potential = nodal[:, cells].mean(axis=2)  # (S, m)
    electrode = np.asarray(protocol.drive @ model.transfer_impedance(conductivity))  # (S, L)
    first, second = (measurement > 0).argmax(axis=1), (measurement < 0).argmax(axis=1)
    drive, pair = np.asarray(protocol.drive_index), np.asarray(protocol.measurement_index)
    ends = np.stack([electrode[drive, first[pair]], electrode[drive, second[pair]]])
    band = (potential[drive] >= ends.min(axis=0)[:, None]) & (potential[drive] < ends.max(axis=0)[:, None])
    band = (band & used[:, None]).T.astype(float)  # (m, M)
    reached = np.maximum(band.sum(axis=1), 1)
    # A uniform relative change δ of conductivity changes every voltage by -δ: that is the scale.
    scale = np.broadcast_to(np.asarray(conductivity, float), (model.mesh.num_cells,))
    smear = -(scale / reached)[:, None] * band / np.where(used & (voltages != 0), voltages, np.inf)
    if not filtered:
        return LinearReconstruction.create(model, smear, np.nan, "none", "back-projection")
    kept = np.flatnonzero(used)
    seen = jacobian[kept] @ smear[:, kept]
    damping = (hyperparameter * np.linalg.norm(seen, 2)) ** 2
    matrix = np.zeros_like(smear)
    filter_matrix = np.linalg.solve(seen.T @ seen + damping * np.eye(len(kept)), seen.T)
    matrix[:, kept] = smear[:, kept] @ filter_matrix
    return LinearReconstruction.create(model, matrix, hyperparameter, "given", "filtered back-projection")
