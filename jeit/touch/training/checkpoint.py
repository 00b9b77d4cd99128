"""Checkpoints of trainings on disk, from which an interrupted training resumes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import jax

from jeit.touch.training.model_file import read_model, write_model

_KIND, _VERSION = "a jeit training under way", 1


class Course(NamedTuple):
    """Losses at each evaluation.

    `steps`: the number of batches done; `training`: the mean loss of the batches since the last evaluation;
    `validation`: the loss of the held-out rows.
    """

    steps: list[int]
    training: list[float]
    validation: list[float]

    @property
    def best(self) -> int:
        """Number of the evaluation with the least loss of the held-out rows; 0 if there was none."""
        return min(range(len(self.validation)), key=self.validation.__getitem__, default=0)


class State(NamedTuple):
    """The whole state of a training.

    `step`, batches done, and its `course`; the network that is `moving`, all of it, the state of its optimiser, the
    `best` network so far, and the `total` of the losses since the last evaluation.
    """

    step: int
    course: Course
    moving: Any
    optimiser: Any
    best: Any
    total: Any


class Checkpoint:
    """A checkpoint file of one training, identified by its `fingerprint`."""

    def __init__(self, path: str | Path, fingerprint: dict[str, Any]):
        self.path, self.fingerprint = Path(path), fingerprint

    def write(self, state: State) -> None:
        """Write the state, whole or not at all."""
        head = {"training": self.fingerprint, "step": state.step, "course": list(state.course)}
        write_model(self.path, _KIND, _VERSION, head, state[2:])

    def read(self, like: State) -> State:
        """Read the state; `like`, the state before the first batch, if there is no file.

        Raises `ValueError` for a file of another training, with the first difference.
        """
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
