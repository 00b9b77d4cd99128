"""Two layouts of a skin side by side, as in text S4 of Park et al. 2022: sensitivity, blind spots, virtual taxels."""

import numpy as np

from jeit.design.skin_response import SkinResponse


def comparison(one: SkinResponse, other: SkinResponse) -> list[dict]:
    """What is told of each of two layouts, as plain numbers.

    `sensitivity_…_V`; `blind_spot_fraction`, the share of the area that is less sensitive than the other's least
    sensitive place; `taxel_count`, those of any area, and `taxel_area_cm2`; `taxel_overlap`, how many cover a place in
    the mean; `two_point_mm`, their mean diameter.
    """
    return [_told(*pair) for pair in ((one, other), (other, one))]


def _told(felt: SkinResponse, other: SkinResponse) -> dict:
    theta, taxels = felt.sensitivity, felt.taxels
    areas = 1e4 * np.asarray(taxels.areas)
    return {
        "layout": felt.layout.name,
        "electrodes": felt.layout.num_electrodes,
        "measurements": theta.changes.shape[1],
        "sensitivity_min_V": float(theta.minimum),
        "sensitivity_mean_V": float(theta.mean),
        "sensitivity_uniformity": float(theta.uniformity),
        "blind_spot_fraction": float(theta.blind_spot(other.sensitivity.minimum)),
        "taxel_count": int((areas > 0).sum()),
        "taxel_area_cm2": {"mean": float(areas.mean()), "std": float(areas.std()), "max": float(areas.max())},
        "taxel_overlap": float(taxels.overlap),
        "two_point_mm": 1e3 * float(taxels.two_point_discrimination),
    }
