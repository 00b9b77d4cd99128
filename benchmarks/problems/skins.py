"""The skins of 200 × 200 mm with 32 inner electrodes that are touched all over."""

from __future__ import annotations

import numpy as np

SIDE, THICKNESS = 0.2, 0.01


def skin(kind: str, cell_size: float):
    """Forward model of a "sheet" or a "layer" with the paper's inner layout, conductivity (cells,), and arguments for
    `touched_cells`.

    `cell_size` in metres.
    """
    from jeit.electrodes import FaceDiscs
    from jeit.forward import ForwardModel
    from jeit.layout import named_layout
    from jeit.mesh import layer, rectangle
    from jeit.protocol import two_terminal

    layout, plane = named_layout("park-inner"), rectangle(SIDE, SIDE, cell_size=cell_size)
    if kind == "sheet":
        model = ForwardModel(plane, layout.sheet_discs(1e-3), two_terminal(32))
        return model, np.full(plane.num_cells, 1e-2), {"thickness": THICKNESS}
    mesh = layer(plane, THICKNESS, 5)
    bottom = np.column_stack([layout.centres, np.zeros(32)])
    return ForwardModel(mesh, FaceDiscs(bottom, 3e-3, 1e-4), two_terminal(32)), np.ones(mesh.num_cells), {}
