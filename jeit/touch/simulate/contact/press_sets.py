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
_VERSION = 1
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
        for name, value in (("number", number), ("chunk", chunk)):
            if not (isinstance(value, int) and value >= 1):
                raise ValueError(f"{name} must be a whole number, 1 or more; it is {value!r}.")
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
        return [range(self.number)[start : start + self.chunk] for start in range(0, self.number, self.chunk)]

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 hash of everything that determines the simulated data: skin, draws, seed, times, version."""
        model, settings = self.skin.model, (_VERSION, self.number, self.seed, self.held, self.elapsed, self.chunk)
        arrays = model.mesh, model.electrodes, model.protocol, self.skin.material, self.skin.conductivity
        leaves, structure = jax.tree.flatten((arrays, self.skin.gain, self.draws))
        sha256 = hashlib.sha256(f"{settings} {structure}".encode())
        for leaf in leaves:
            sha256.update(np.asarray(leaf).tobytes())
        return sha256.hexdigest()

    def solve(self, chunk: int) -> dict[str, np.ndarray]:
        """Simulate a chunk of k touches; return arrays (k, …) of voltages and of the parameters of presses, by their
        names in the store. Parameters are NaN where a touch has fewer presses than `draws.at_once`."""
        draw_key, frame_key = jax.random.split(jax.random.fold_in(jax.random.key(self.seed), chunk))
        touches = self.draws.draw(draw_key, len(self.chunks[chunk]))
        results = {name: np.full((len(touches), *shape), np.nan) for name, (shape, _) in self._shapes().items()}
        results["voltages"] = self.skin.frames(frame_key, touches, held=self.held, elapsed=self.elapsed)
        indenter_numbers = {
            id(indenter): indenter_number for indenter_number, indenter in enumerate(self.draws.indenters)
        }
        for touch_index, touch in enumerate(touches):
            for press_index, press in enumerate(touch):
                results["position"][touch_index, press_index], results["force"][touch_index, press_index] = (
                    press.position,
                    press.load,
                )
                results["angle"][touch_index, press_index], results["indenter"][touch_index, press_index] = (
                    press.angle,
                    indenter_numbers[id(press.indenter)],
                )
        return results

    def contents(self) -> Contents:
        """Describe the arrays in the Zarr store of the set."""

        def create_arrays(zarr_group: Any) -> None:
            for name, (shape, dimensions) in self._shapes().items():
                unit, meaning = _UNITS_AND_MEANINGS[name]
                zarr_group.create_array(
                    name,
                    shape=(self.number, *shape),
                    chunks=(min(self.chunk, self.number), *shape),
                    dtype="float64",
                    fill_value=np.nan,
                    dimension_names=("touch", *dimensions),
                    attributes={"units": unit, "long_name": meaning},
                )

        attributes = {"seed": self.seed, "held_s": self.held, "elapsed_s": self.elapsed}
        names = [*self._shapes()]
        return Contents(
            "press set", "simulate_presses", self.fingerprint, self.chunks, names, attributes, create_arrays
        )

    def _shapes(self) -> dict[str, tuple[tuple[int, ...], tuple[str, ...]]]:
        """Return, by name, the shape of each array for one touch, and the names of its dimensions."""
        per_press = (self.draws.at_once,), ("press",)
        return {
            "voltages": ((self.skin.model.protocol.num_measurements,), ("channel",)),
            "position": ((self.draws.at_once, 2), ("press", "axis")),
            "force": per_press,
            "angle": per_press,
            "indenter": per_press,
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
        remaining_chunks = [number for number in range(len(presses.chunks)) if number not in finished_chunks]
        report = ProgressReporter(presses.chunks, finished_chunks, progress)
        for number, results in _solve_chunks(presses, remaining_chunks, client):
            store.write(number, results)
            report.report_finished_chunk(number)
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
    for number in store.intact_chunks():
        is_finished[list(presses.chunks[number])] = True
    return store.open_dataset().assign_coords(finished=("touch", is_finished))


def solve_presses(presses: PressSet | IndentSet, chunk: int) -> dict[str, np.ndarray]:
    """Simulate one chunk of a set by its method `solve`, as a function that can be sent to the workers of a cluster."""
    return presses.solve(chunk)


def _solve_chunks(
    presses: PressSet | IndentSet, chunks: list[int], client: Any
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    if client is None:
        return ((number, solve_presses(presses, number)) for number in chunks)
    return solve_on_cluster(client, solve_presses, presses, chunks)
