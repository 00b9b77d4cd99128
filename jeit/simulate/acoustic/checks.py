"""Checks of what the simulated acoustic skin is given: positive numbers, and places on the skin."""

import numpy as np
from jaxtyping import Float


def check_positive(name: str, value: float) -> None:
    """Raises `ValueError` for what is not a finite number above zero."""
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"{name} must be a positive number in SI units; it is {value}.")


def check_inside(name: str, points, width: float, height: float) -> Float[np.ndarray, "P 2"]:
    """`points` (P, 2) as an array of floats; raises `ValueError` unless all are finite and on the skin."""
    place = np.asarray(points, float)
    if place.ndim != 2 or place.shape[1] != 2 or len(place) == 0:
        raise ValueError(f"{name}: give (x, y) in metres for each, shape (P, 2), not {place.shape}.")
    if not np.isfinite(place).all():
        raise ValueError(f"{name}: row {np.argmin(np.isfinite(place).all(axis=1))} is not finite.")
    half = np.array([width, height]) / 2 * (1 + 1e-9)
    outside = (np.abs(place) > half).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        in_millimetres = (np.abs(place) > 10 * half).any() and (np.abs(place) <= 1000 * half).all()
        hint = " Are they in millimetres? Divide by 1000." if in_millimetres else ""
        raise ValueError(
            f"{name}: row {row}, ({place[row, 0]:g}, {place[row, 1]:g}) m, lies off the skin, which is {width:g} m by "
            f"{height:g} m about the origin. Positions are in metres from its middle.{hint}"
        )
    return place
