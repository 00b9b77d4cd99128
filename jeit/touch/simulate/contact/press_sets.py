"""Sets of random touches and their frames, larger than memory: simulated in chunks and written to a Zarr store.

The simulation runs on this machine or on a cluster. The store and its chunks have the same form as those of the studies
in `jeit.design`. Needs the extra `cluster`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jeit.arguments import check_kind, describe
from jeit.arguments.extras import require_extra
from jeit.design.study.contents import Contents
from jeit.design.study.run import Progress, ProgressReporter, solve_on_cluster
from jeit.design.study.store import Store, writing
from jeit.touch.simulate.contact.indent_sets import IndentSet
from jeit.touch.simulate.contact.indents import PressDraws
from jeit.touch.simulate.contact.press import Press
from jeit.touch.simulate.contact.pressed_skin import PressedSkin, check_seconds

# Version of the simulation, which must be increased if a change of the code changes the results.
_FINGERPRINT_VERSION = 1
_UNITS_AND_MEANINGS = {
    "voltages": ("V", "what the channels read"),
    "position": ("m", "where the presses are, NaN where there are fewer"),
    "force": ("N", "loads of the presses"),
    "angle": ("rad", "that the presses are turned by"),
    "indenter": ("1", "of the presses, its number among those drawn from"),
}


class PressSet:
    """A set of random touches and the frames of a pressed skin, which `simulate_presses` computes.

    **Arguments:**

    - `skin`: the skin.
    - `draws`: distribution from which the touches are drawn.
    - `number`: number of touches.
    - `seed`: random seed, which determines the touches and the frames.
    - `held`, `elapsed`: duration of the load, and time during which the skin has drifted, seconds.
    - `chunk`: number of touches that are simulated and written at once; it also affects the random numbers.

    **Example:**

    ```python
    draws = PressDraws([DiscIndenter(0.01)], outline, load=(1.0, 5.0), margin=0.01)
    data = simulate_presses(PressSet(skin, draws, number=8), "presses.zarr")  # with zarr
    ```
    """

    def __init__(
        self,
        skin: PressedSkin,
        draws: PressDraws,
        number: int,
        *,
        seed: int = 0,
        held: float = 1.0,
        elapsed: float = 0.0,
        chunk: int = 1000,
    ):
        """Create a set of touches. Raises `ValueError` for invalid arguments, and if the middle of the skin cannot
        carry the maximum load on every indenter. At the edge, indenters go deeper, which is not checked."""
        check_kind("skin", skin, PressedSkin, "a PressedSkin")
        check_kind(
            "draws",
            draws,
            PressDraws,
            "PressDraws, such as PressDraws([ball_indenter(0.015)], Disk(0.05), (0.1, 10.0))",
        )
        for argument_name, argument_value in (("number", number), ("chunk", chunk)):
            if not (isinstance(argument_value, int) and argument_value >= 1):
                raise ValueError(f"{argument_name} must be a whole number, 1 or more; it is {argument_value!r}.")
        if not (isinstance(seed, int) and 0 <= seed < 2**63):
            raise ValueError(f"seed must be a whole number, 0 or more; it is {describe(seed)}.")
        check_seconds("held", held)
        check_seconds("elapsed", elapsed)
        self.skin, self.draws, self.number, self.seed = skin, draws, number, seed
        self.held, self.elapsed, self.chunk = held, elapsed, chunk
        innermost_place = draws.innermost()
        skin.touched([Press(indenter, draws.load[1], innermost_place) for indenter in draws.indenters])

    @property
    def chunks(self) -> list[range]:
        """Numbers of the touches in each chunk."""
        return [
            range(self.number)[first_touch : first_touch + self.chunk]
            for first_touch in range(0, self.number, self.chunk)
        ]

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 hash of everything that determines the simulated data: skin, draws, seed, times, version."""
        model, hashed_settings = (
            self.skin.model,
            (_FINGERPRINT_VERSION, self.number, self.seed, self.held, self.elapsed, self.chunk),
        )
        hashed_arrays = model.mesh, model.electrodes, model.protocol, self.skin.material, self.skin.conductivity
        tree_leaves, tree_structure = jax.tree.flatten((hashed_arrays, self.skin.gain, self.draws))
        hash_state = hashlib.sha256(f"{hashed_settings} {tree_structure}".encode())
        for tree_leaf in tree_leaves:
            hash_state.update(np.asarray(tree_leaf).tobytes())
        return hash_state.hexdigest()

    def solve(self, chunk: int) -> dict[str, np.ndarray]:
        """Simulate a chunk of k touches; return arrays (k, …) of voltages and of the parameters of presses, by their
        names in the store. Parameters are NaN where a touch has fewer presses than `draws.at_once`."""
        draw_key, frame_key = jax.random.split(jax.random.fold_in(jax.random.key(self.seed), chunk))
        touches = self.draws.draw(draw_key, len(self.chunks[chunk]))
        touch_arrays = {
            array_name: np.full((len(touches), *touch_shape), np.nan)
            for array_name, (touch_shape, _) in self._array_shapes().items()
        }
        touch_arrays["voltages"] = self.skin.frames(frame_key, touches, held=self.held, elapsed=self.elapsed)
        indenter_numbers = {
            id(indenter): indenter_number for indenter_number, indenter in enumerate(self.draws.indenters)
        }
        for touch_index, touch_presses in enumerate(touches):
            for press_index, press in enumerate(touch_presses):
                touch_arrays["position"][touch_index, press_index], touch_arrays["force"][touch_index, press_index] = (
                    press.position,
                    press.load,
                )
                touch_arrays["angle"][touch_index, press_index], touch_arrays["indenter"][touch_index, press_index] = (
                    press.angle,
                    indenter_numbers[id(press.indenter)],
                )
        return touch_arrays

    def contents(self) -> Contents:
        """Describe the arrays in the Zarr store of the set."""

        def create_arrays(zarr_group: Any) -> None:
            for array_name, (touch_shape, dimension_names) in self._array_shapes().items():
                array_unit, array_meaning = _UNITS_AND_MEANINGS[array_name]
                zarr_group.create_array(
                    array_name,
                    shape=(self.number, *touch_shape),
                    chunks=(min(self.chunk, self.number), *touch_shape),
                    dtype="float64",
                    fill_value=np.nan,
                    dimension_names=("touch", *dimension_names),
                    attributes={"units": array_unit, "long_name": array_meaning},
                )

        set_attributes = {"seed": self.seed, "held_s": self.held, "elapsed_s": self.elapsed}
        array_names = [*self._array_shapes()]
        return Contents(
            "press set", "simulate_presses", self.fingerprint, self.chunks, array_names, set_attributes, create_arrays
        )

    def _array_shapes(self) -> dict[str, tuple[tuple[int, ...], tuple[str, ...]]]:
        """Return, by name, the shape of each array for one touch, and the names of its dimensions."""
        press_shape = (self.draws.at_once,), ("press",)
        return {
            "voltages": ((self.skin.model.protocol.num_measurements,), ("channel",)),
            "position": ((self.draws.at_once, 2), ("press", "axis")),
            "force": press_shape,
            "angle": press_shape,
            "indenter": press_shape,
        }


def simulate_presses(
    presses: PressSet | IndentSet,
    path: str | Path,
    *,
    client: Any = None,
    progress: Callable[[Progress], None] | None = None,
):
    """Simulate the unfinished chunks of a set of presses or indents, and return all its data as `open_presses` does.

    An interrupted simulation resumes after the last finished chunk when it is run again with the same store.

    **Arguments:**

    - `presses`: the set of presses or indents.
    - `path`: path of the Zarr store, which is created if it does not exist.
    - `client`, `progress`: client of a Dask cluster, and function that is called with the progress, as in
      `jeit.design.run_study`.

    Raises `ValueError` for a path to the store of a different set, for a store in use by another process, and as
    `PressedSkin.frames` does; `ImportError` without the extra `cluster`; `OSError` if the store cannot be written.

    **Example:**

    ```python
    draws = PressDraws([DiscIndenter(0.01)], outline, load=(1.0, 5.0), margin=0.01)
    data = simulate_presses(PressSet(skin, draws, number=8), "presses.zarr")  # with zarr
    ```
    """
    require_extra("cluster", "a set of touches")
    check_kind("presses", presses, (PressSet, IndentSet), "a PressSet(skin, draws, number), or an IndentSet")
    with writing(presses.contents(), path) as store:
        finished_chunks = set(store.intact_chunks())
        remaining_chunks = [
            chunk_number for chunk_number in range(len(presses.chunks)) if chunk_number not in finished_chunks
        ]
        progress_reporter = ProgressReporter(presses.chunks, finished_chunks, progress)
        for chunk_number, chunk_results in _solve_chunks(presses, remaining_chunks, client):
            store.write(chunk_number, chunk_results)
            progress_reporter.report_finished_chunk(chunk_number)
    return open_presses(presses, path)


def open_presses(presses: PressSet | IndentSet, path: str | Path):
    """Open the simulated data of a set of presses or indents as an `xarray.Dataset`.

    The dimensions are touch, channel and press or, for indents, row and column instead of press. Data are read on
    access; `finished` (touch,) marks the touches that have been simulated.

    **Arguments:**

    - `presses`: the set.
    - `path`: path of the Zarr store in which `simulate_presses` wrote the data.

    Raises the errors of `jeit.design.study.store.Store`.

    **Example:**

    ```python
    presses = PressSet(skin, PressDraws([DiscIndenter(0.01)], outline, (1.0, 5.0), margin=0.01), 8)
    simulate_presses(presses, "presses.zarr")  # with zarr
    data = open_presses(presses, "presses.zarr")
    ```
    """
    require_extra("cluster", "a set of touches")
    store = Store(presses.contents(), path, create=False)
    is_finished = np.zeros(presses.number, bool)
    for chunk_number in store.intact_chunks():
        is_finished[list(presses.chunks[chunk_number])] = True
    return store.open_dataset().assign_coords(finished=("touch", is_finished))


def solve_presses(presses: PressSet | IndentSet, chunk: int) -> dict[str, np.ndarray]:
    """Simulate one chunk of a set by its method `solve`, as a function that can be sent to the workers of a cluster."""
    return presses.solve(chunk)


def _solve_chunks(
    presses: PressSet | IndentSet, chunk_numbers: list[int], cluster_client: Any
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    if cluster_client is None:
        return ((chunk_number, solve_presses(presses, chunk_number)) for chunk_number in chunk_numbers)
    return solve_on_cluster(cluster_client, solve_presses, presses, chunk_numbers)
