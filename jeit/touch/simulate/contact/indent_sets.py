"""Sets of random indents, with simulated voltages of a skin and depth maps, computed in chunks like sets of presses."""

from __future__ import annotations

import hashlib
from functools import cached_property, lru_cache
from threading import Lock
from typing import Any

import jax
import numpy as np

from jeit.arguments import check_kind, describe
from jeit.design import Skin
from jeit.design.skin.voltage_changes import RestingSkin
from jeit.design.study.contents import Contents
from jeit.touch.simulate.contact.indents import IndentDraws, depth_maps, relative_changes, resting_skin

# Version of the simulation, which must be increased if a change of the code changes the results.
_FINGERPRINT_VERSION = 2
# Lock that lets only one thread of a worker compute the data shared by all chunks.
_RESTING_SKIN_LOCK = Lock()
_UNITS_AND_MEANINGS = {
    "change": ("1", "change of each channel's voltage, relative to the skin at rest"),
    "depth": ("1", "depth of the indentation over the thickness of the skin, row 0 at the least y"),
}


class IndentSet:
    """A set of `number` random touches drawn from `draws`, with the noise-free voltages of a `skin`.

    `seed`: random seed, which determines the touches. `shape`: (rows, columns) of the maps of indentation depth over
    the skin. `chunk`: number of touches that are simulated and written at once, which also affects the random numbers.
    """

    def __init__(
        self,
        skin: Skin,
        draws: IndentDraws,
        number: int,
        *,
        seed: int = 0,
        shape: tuple[int, int] = (48, 48),
        chunk: int = 1000,
    ):
        """Create a set of touches. Raises `ValueError` for invalid arguments, and for depths that reach the skin's
        thickness."""
        check_kind("skin", skin, Skin, "a Skin, as of Skin.create(named_layout('park-inner'))")
        check_kind("draws", draws, IndentDraws, "IndentDraws([ball_indenter(0.015)], skin.flat_outline, (1e-3, 8e-3))")
        for argument_name, argument_value in (("number", number), ("chunk", chunk)):
            if not (isinstance(argument_value, int) and argument_value >= 1):
                raise ValueError(f"{argument_name} must be a whole number, 1 or more; it is {argument_value!r}.")
        if not (isinstance(seed, int) and 0 <= seed < 2**63):
            raise ValueError(f"seed must be a whole number, 0 or more; it is {describe(seed)}.")
        if draws.depth[1] >= float(skin.thickness):
            raise ValueError(
                f"draws go {1e3 * draws.depth[1]:.3g} mm deep, and the skin is {1e3 * float(skin.thickness):.3g} mm "
                "thick; draw less depth."
            )
        self.skin, self.draws, self.number, self.seed = skin, draws, number, seed
        self.chunk, self.shape = chunk, (int(shape[0]), int(shape[1]))
        rows, columns = self.shape
        self.places = image_places(skin, columns, rows)

    @property
    def chunks(self) -> list[range]:
        """Numbers of the touches in each chunk."""
        return [
            range(self.number)[first_touch : first_touch + self.chunk]
            for first_touch in range(0, self.number, self.chunk)
        ]

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 hash of everything that determines the simulated data: skin, draws, seed, sizes, version."""
        model = self.skin.model
        hashed_arrays = (
            model.mesh,
            model.electrodes,
            model.protocol,
            self.skin.conductivity,
            self.skin.thickness,
            self.draws,
        )
        hashed_settings = _FINGERPRINT_VERSION, self.number, self.seed, self.chunk, self.shape
        return _hash_arrays(hashed_arrays, str(hashed_settings))

    def solve(self, chunk: int) -> dict[str, np.ndarray]:
        """Simulate a chunk of k touches; return relative changes of voltages (k, M) and depth maps (k, rows, columns),
        by the names of their arrays in the store."""
        chunk_key = jax.random.fold_in(jax.random.key(self.seed), chunk)
        touches = self.draws.draw(chunk_key, len(self.chunks[chunk]))
        relative_depths = depth_maps(touches, self.places) / float(self.skin.thickness)
        with _RESTING_SKIN_LOCK:
            resting_data = _shared_resting_skin(_SkinAndDepth(self.skin, self.draws.depth[1]))
        return {
            "change": relative_changes(self.skin, touches, resting_data),
            "depth": relative_depths.astype(np.float32),
        }

    def contents(self) -> Contents:
        """Describe the arrays in the Zarr store of the set."""

        def create_arrays(zarr_group: Any) -> None:
            num_channels = self.skin.model.protocol.num_measurements
            array_types = {
                "change": ((num_channels,), ("channel",), "float64"),
                "depth": (self.shape, ("row", "column"), "float32"),
            }
            for array_name, (touch_shape, dimension_names, data_type) in array_types.items():
                array_unit, array_meaning = _UNITS_AND_MEANINGS[array_name]
                zarr_group.create_array(
                    array_name,
                    shape=(self.number, *touch_shape),
                    chunks=(min(self.chunk, self.number), *touch_shape),
                    dtype=data_type,
                    fill_value=np.nan,
                    dimension_names=("touch", *dimension_names),
                    attributes={"units": array_unit, "long_name": array_meaning},
                )

        array_names = [*_UNITS_AND_MEANINGS]
        set_attributes = {"seed": self.seed}
        return Contents(
            "indent set", "simulate_presses", self.fingerprint, self.chunks, array_names, set_attributes, create_arrays
        )


class _SkinAndDepth:
    """Hashable key of a skin and its maximum depth of indentation, metres; equal for equal skins and depths."""

    def __init__(self, skin: Skin, depth: float):
        self.skin, self.depth = skin, depth
        model = skin.model
        self._digest_text = _hash_arrays(
            (model.mesh, model.electrodes, model.protocol, skin.model_conductivity), str(depth)
        )

    def __eq__(self, other_key: object) -> bool:
        return isinstance(other_key, _SkinAndDepth) and other_key._digest_text == self._digest_text

    def __hash__(self) -> int:
        return hash(self._digest_text)


@lru_cache(maxsize=1)
def _shared_resting_skin(skin_and_depth: _SkinAndDepth) -> RestingSkin | None:
    """Return the data of a skin at rest that all chunks and sets of the skin share; about a gigabyte for a 3-D
    layer."""
    return resting_skin(skin_and_depth.skin, skin_and_depth.depth)


def _hash_arrays(array_tree: Any, settings_text: str) -> str:
    """Compute the SHA-256 hash of a tree of arrays and a text."""
    tree_leaves, tree_structure = jax.tree.flatten(array_tree)
    hash_state = hashlib.sha256(f"{settings_text} {tree_structure}".encode())
    for tree_leaf in tree_leaves:
        hash_state.update(np.asarray(tree_leaf).tobytes())
    return hash_state.hexdigest()


def image_places(skin: Skin, columns: int, rows: int) -> np.ndarray:
    """Return the centres (rows, columns, 2) of the pixels of a grid over the bounding box of a skin, metres; row 0 is
    at the minimum y."""
    low_x, high_x, low_y, high_y = map(float, skin.flat_outline.extent)
    return pixel_places((low_x, high_x, low_y, high_y), (rows, columns))


def pixel_places(extent: tuple[float, float, float, float], shape: tuple[int, int]) -> np.ndarray:
    """Return the centres (rows, columns, 2) of the pixels of a grid over a box (x_min, x_max, y_min, y_max), metres;
    row 0 is at the minimum y."""
    (low_x, high_x, low_y, high_y), (rows, columns) = extent, shape
    x = low_x + (high_x - low_x) * (np.arange(columns) + 0.5) / columns
    y = low_y + (high_y - low_y) * (np.arange(rows) + 0.5) / rows
    return np.stack(np.meshgrid(x, y), axis=-1)
