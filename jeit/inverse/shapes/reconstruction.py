"""The result of `reconstruct_shapes`: the bodies, and the conductivity and voltages that follow from them."""

from __future__ import annotations

from jaxtyping import Array, Float

from jeit.forward import ForwardModel
from jeit.inverse.shapes.ellipsoid import Ellipsoid
from jeit.inverse.shapes.star import Star
from jeit_solvers.module import Module

Body = Star | Ellipsoid


class FinerImage(Module):
    """Conductivity of reconstructed bodies on a refined mesh, for display.

    **Fields**: `model`: forward model on the refined mesh, with the same electrodes and a protocol of independent
    channels; `conductivity` (c,): conductivity of the refined cells, S/m.
    """

    model: ForwardModel
    conductivity: Float[Array, " c"]


class ShapeReconstruction(Module):
    """Result of `reconstruct_shapes`.

    **Fields**: `bodies`: `Star`s in a sheet, `Ellipsoid`s in a solid, in descending order of `rise`; `conductivity`
    (m,): S/m (2-D: S), in partly covered cells of a solid the geometric mean of body and bath; `voltages` (M,):
    voltages predicted for the bodies and for other changes besides them, such as moved electrodes; `misfit`: root mean
    square of predicted - measured voltages over the channels used, in standard deviations; `drift`: relative difference
    of the bath's conductivity from `background`; `doubtful`: bodies that were removed because their `rise` is too
    small; `contrast_deviations`: standard deviation of each body's contrast in log σ, due to noise and to the mesh (the
    mesh contributes 0.03, in solids 0.1); `alternatives`: for each body of a solid, the body of the other kind
    (ellipsoid or column) if the data do not determine the kind, else None; `alternative_deviations`: standard
    deviations of the contrasts of the alternatives, or NaN; `finer`: for a solid with bodies, the conductivity on the
    last refined mesh, for display.

    **Example:**

    ```python
    found = reconstruct_shapes(model, voltages, 1.0, start=[(1, (0.04, 0.0), 0.03)])
    found.bodies, found.misfit
    ```
    """

    bodies: tuple[Body, ...]
    conductivity: Float[Array, " m"]
    voltages: Float[Array, " M"]
    misfit: Float[Array, ""]
    drift: float
    doubtful: tuple[Body, ...]
    contrast_deviations: tuple[float, ...]
    alternatives: tuple[Ellipsoid | None, ...]
    alternative_deviations: tuple[float, ...]
    finer: FinerImage | None = None

    @property
    def hyperparameter(self) -> float:
        """Hyperparameter: NaN, because the prior of shapes has no hyperparameter."""
        return float("nan")

    @property
    def rule(self) -> str:
        """Rule that chose the hyperparameter: "none", as there is no hyperparameter."""
        return "none"

    @property
    def choice(self) -> None:
        """Choice of the hyperparameter: None, as there is no hyperparameter."""
        return None
