"""Validation of the arrays and numbers in recordings and taps."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from jeit.mesh.topology import distance, is_inside_loops

# Minimum sampling rate with which the vibrations of a touch can be recorded.
MIN_RATE = 100.0  # Hz
# Maximum plausible length of a skin. Larger coordinates are probably in millimetres instead of metres.
MAX_SKIN_LENGTH = 5.0  # m
# Maximum distance of a tap outside the outline, as a fraction of the skin's length; distance in metres below which two
# microphones coincide.
_MAX_RELATIVE_DISTANCE_OUTSIDE, _MIN_SPACING = 0.05, 1e-6  # of the length; m
# Maximum magnitude of a coordinate in metres; squares of larger coordinates would lose precision.
_MAX_COORDINATE = 1e9


def alternative_array_name(arrays: dict[str, np.ndarray], first_name: str, second_name: str) -> str:
    """Return which of two alternative arrays a file contains: the name `first_name` or `second_name`. Raises
    `ValueError` if the file contains both arrays or neither."""
    if first_name in arrays and second_name in arrays:
        raise ValueError(f"it holds both '{first_name}' and '{second_name}'; keep the one to use.")
    if second_name not in arrays and first_name not in arrays:
        names_text = ", ".join(str(array_name) for array_name in arrays[""][:12]) or "nothing"
        raise ValueError(f"there is neither '{second_name}' nor '{first_name}'; the file holds {names_text}.")
    return first_name if first_name in arrays else second_name


def short_text(values: np.ndarray) -> str:
    """Text of an array for a message: its values if there are at most four, otherwise its shape."""
    return f"of shape {values.shape}" if values.size > 4 else str(values.tolist())


def convert_to_real_array(value, label: str, axes: str) -> np.ndarray:
    """Convert `value` to a real array with one axis for each of the names in `axes`, which are separated by commas.

    Arrays of float32 are not converted; other types are converted to float64. Raises `ValueError` for values that are
    not real, a different number of axes, and empty arrays.
    """
    try:
        converted_array = np.asarray(value)
    except ValueError:
        raise ValueError(f"{label}: rows differ in length; give one array ({axes}).") from None
    if converted_array.dtype.kind not in "fiu":
        raise ValueError(f"{label} is {converted_array.dtype}; give real numbers.")
    if converted_array.ndim != axes.count(",") + 1:
        raise ValueError(f"{label} has shape {converted_array.shape}; give ({axes}).")
    if converted_array.size == 0:
        raise ValueError(f"{label} is empty: its shape is {converted_array.shape}.")
    return converted_array if converted_array.dtype == np.float32 else converted_array.astype(float, copy=False)


def real_number(value, label: str) -> float:
    """Convert a number, or an array with one element, to a float. Raises `ValueError` for other values."""
    converted_array = np.asarray(value)
    if converted_array.dtype.kind not in "fiu" or converted_array.size != 1:
        raise ValueError(
            f"{label} must be one real number; it is {converted_array.dtype} of shape {converted_array.shape}."
        )
    return float(converted_array.reshape(()))


def sampling_rate(value) -> float:
    """Return the sampling rate in Hz as a float. Raises `ValueError` if the rate is not a finite number, or too low to
    record touches."""
    rate_hz = real_number(value, "rate")
    if not np.isfinite(rate_hz) or rate_hz < MIN_RATE:
        raise ValueError(
            f"rate is {rate_hz:g}; give the samples a second of each microphone in Hz (40000, not 40 kHz or 25 µs): "
            f"finite and at least {MIN_RATE:g}."
        )
    return rate_hz


def check_full_scale(value) -> float | None:
    """Return the largest possible magnitude of a sample as a float; None if unknown. Raises `ValueError` for values
    that are not positive and finite."""
    full_scale = None if value is None else real_number(value, "full_scale")
    if full_scale is not None and not 0 < full_scale < np.inf:
        raise ValueError(f"full_scale must be the largest sample possible, positive and finite; it is {full_scale:g}.")
    return full_scale


def check_coordinates(value, label: str, dimension: tuple[int, ...]) -> np.ndarray:
    """Convert `value` to an array (n, d) of n points in metres. `dimension`: the required (d,), where d is 2 or 3.
    Raises `ValueError` for other shapes, and for coordinates that are not finite."""
    points = convert_to_real_array(value, label, "points, 2 or 3").astype(float)
    if points.shape[1] not in (2, 3) or points.shape[1:] != dimension:
        raise ValueError(
            f"{label} has shape {points.shape}; give one row of 2 or 3 coordinates each, as many for microphones, "
            "outline and positions."
        )
    invalid_points = np.flatnonzero(~(np.abs(points) < _MAX_COORDINATE).all(axis=1))
    if invalid_points.size:
        invalid_point = points[invalid_points[0]].tolist()
        raise ValueError(
            f"{label}: row {invalid_points[0]} is {invalid_point}; every coordinate must be finite, in metres."
        )
    return points


def check_extent(points: np.ndarray, label: str) -> None:
    """Raise `ValueError` if the extent of points (n, d) along an axis exceeds the maximum plausible length of a
    skin."""
    largest_extent = np.ptp(points, axis=0).max()
    if largest_extent > MAX_SKIN_LENGTH:
        raise ValueError(
            f"{label} spread over {largest_extent:.4g}: are these metres? Divide millimetres by 1000; no side may be "
            f"longer than {MAX_SKIN_LENGTH:g} m."
        )


def check_microphones(positions: np.ndarray, skin: np.ndarray) -> None:
    """Raise `ValueError` if two microphones with `positions` (M, d) coincide, or if a microphone is farther from the
    bounding box of the points `skin` (n, d) than the length of this box. All coordinates are in metres."""
    lowest_coordinates, highest_coordinates = skin.min(axis=0), skin.max(axis=0)
    largest_skin_side = (highest_coordinates - lowest_coordinates).max()
    distances_from_skin = np.linalg.norm(
        positions - np.clip(positions, lowest_coordinates, highest_coordinates), axis=1
    )
    farthest_microphone = int(distances_from_skin.argmax())
    if distances_from_skin[farthest_microphone] > largest_skin_side:
        raise ValueError(
            f"microphones: number {farthest_microphone} at {positions[farthest_microphone].tolist()} is "
            f"{distances_from_skin[farthest_microphone]:.3g} m away from a skin that is only {largest_skin_side:.3g} m "
            "long: are these metres, in the outline's coordinates? Divide millimetres by 1000."
        )
    coincident_pairs = sorted(KDTree(positions).query_pairs(_MIN_SPACING))
    if coincident_pairs:
        first_microphone, second_microphone = coincident_pairs[0]
        raise ValueError(
            f"microphones: numbers {first_microphone} and {second_microphone} are at the same place, "
            f"{positions[first_microphone].tolist()}; give each its own."
        )


def check_taps(positions: np.ndarray, outline: np.ndarray) -> None:
    """Raise `ValueError` if one of the taps at `positions` (T, 2) is outside the `outline` (K, 2) by more than 5 % of
    the skin's length."""
    largest_skin_side = np.ptp(outline, axis=0).max()
    taps_outside = np.flatnonzero(~is_inside_loops(positions, [outline]))
    distances_from_outline = distance(positions[taps_outside], outline, np.roll(outline, -1, axis=0)).min(axis=1)
    if taps_outside.size and distances_from_outline.max() > _MAX_RELATIVE_DISTANCE_OUTSIDE * largest_skin_side:
        farthest_tap = int(taps_outside[distances_from_outline.argmax()])
        raise ValueError(
            f"positions: row {farthest_tap}, {positions[farthest_tap].tolist()}, is "
            f"{1e3 * distances_from_outline.max():.3g} mm outside the outline; taps must be on the skin, or within "
            f"{1e3 * _MAX_RELATIVE_DISTANCE_OUTSIDE * largest_skin_side:.3g} mm of it. Correct the place, or leave the "
            "tap out."
        )
