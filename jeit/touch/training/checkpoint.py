"""Where a training is, on the disk: what was killed goes on from there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import jax

from jeit.touch.training.model_file import read_model, write_model

_KIND, _VERSION = "a jeit training under way", 1


class Course(NamedTuple):
    """Losses that were looked at, one after the other: after how many batches `steps`, of the `training` batches since
    the last look, their mean, and of the rows held out, `validation`."""

    steps: list[int]
    training: list[float]
    validation: list[float]

    @property
    def best(self) -> int:
        """Number of the look at the least loss of the rows held out; 0 where none was looked at."""
        return min(range(len(self.validation)), key=self.validation.__getitem__, default=0)


class State(NamedTuple):
    """All of a training: `step`, batches done, and its `course`; the network that is `moving`, all of it, the state of
    its optimiser, the `best` network so far, and the `total` of the losses since the last look."""

    step: int
    course: Course
    moving: Any
    optimiser: Any
    best: Any
    total: Any


class Checkpoint:
    """A file of one training, which `fingerprint` tells from all others."""

    def __init__(self, path: str | Path, fingerprint: dict[str, Any]):
        self.path, self.fingerprint = Path(path), fingerprint

    def write(self, state: State) -> None:
        """Write all of it, whole or not at all."""
        head = {"training": self.fingerprint, "step": state.step, "course": list(state.course)}
        write_model(self.path, _KIND, _VERSION, head, state[2:])

    def read(self, like: State) -> State:
        """What was written; `like` itself, the state before the first batch, where nothing was. Raises `ValueError` for
        a file of another training, with the first difference."""
        if not self.path.exists():
            return like

        def make(head: dict[str, Any]) -> Any:
            for name, value in json.loads(json.dumps(self.fingerprint)).items():
                if head["training"].get(name) != value:
                    raise ValueError(
                        f"it is of another training ({name} was {head['training'].get(name)}, and is {value} now); "
                        "delete it, or give another file"
                    )
            return jax.tree.map(lambda leaf: leaf, like[2:])

        head, arrays = read_model(self.path, _KIND, _VERSION, make)
        return State(head["step"], Course(*head["course"]), *arrays)
