"""Read and write self-organising maps as files that contain only arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jeit.arguments import check_kind
from jeit.files import need, npz_arrays, written_whole
from jeit.touch.kohonen.placed_map import PlacedMap
from jeit.touch.kohonen.self_organising_map import SelfOrganisingMap

_OF_PLACES = "places", "widening", "missed", "fitted"


def write_map(learnt: SelfOrganisingMap | PlacedMap, path: str | Path) -> None:
    """Write a map to an NPZ file: its `weights` and `scale`, and the places of a `PlacedMap`.

    Raises `ValueError` if `learnt` is no map, or `path` is a folder.
    """
    check_kind("learnt", learnt, (SelfOrganisingMap, PlacedMap), "a map, as of SelfOrganisingMap.fit, or a PlacedMap")
    if Path(path).is_dir():
        raise ValueError(f"'{path}' is a folder; give a file, such as {Path(path) / 'map.npz'}.")
    placed = isinstance(learnt, PlacedMap)
    plain = learnt.learnt if placed else learnt
    more = {name: getattr(learnt, name) for name in _OF_PLACES} if placed else {}
    more = {name: value for name, value in more.items() if value is not None}
    with written_whole(path) as file:
        np.savez_compressed(file, weights=plain.weights, scale=plain.scale, **more)


def read_map(path: str | Path) -> SelfOrganisingMap | PlacedMap:
    """Read a map from a file that `write_map` wrote. Raises `FileNotFoundError`, and `ValueError` for any other
    file."""
    if Path(path).is_dir():
        raise ValueError(f"'{path}' is a folder; give an NPZ file.")
    if not Path(path).is_file():
        raise FileNotFoundError(f"'{path}': there is no such file.")
    try:
        arrays = npz_arrays(Path(path), "weights", "scale", *_OF_PLACES)
        need(arrays, "weights", "scale")
        learnt = SelfOrganisingMap(arrays["weights"], _number("scale", arrays))
        if "places" not in arrays:
            return learnt
        numbers = _number("widening", arrays), _number("missed", arrays)
        return PlacedMap(learnt, arrays["places"], *numbers, arrays.get("fitted"))
    except ValueError as error:
        raise ValueError(f"'{path}' is no map: {error}") from None


def _number(name: str, arrays: dict[str, np.ndarray]) -> float:
    value = arrays.get(name, np.zeros(0))
    if value.dtype.kind not in "fiu" or value.shape != ():
        raise ValueError(f"{name} must be one number; it has shape {value.shape}.")
    return float(value)
