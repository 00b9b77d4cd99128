"""Fixtures of the command-line tests: a small tank as a CSV file with its description, in which tests insert faults."""

import numpy as np
import pytest

from jeit.cli import main
from jeit.layout import ring
from jeit.protocol import adjacent

DESCRIPTION = """
[geometry]
shape = "disk"
radius = 0.1
[electrodes]
layout = "ring"
number = 8
clockwise = true
width = 0.005
contact_impedance = 0.01
[protocol]
kind = "adjacent"
current = 1e-3
[data]
unit = "V"
"""


def _voltages(bump: float, turns=0.0) -> np.ndarray:
    """Voltages of a disk of 1 mS with small electrodes (a logarithm), plus a symmetric term: a change that is not
    noise. `turns`: angles (8,) in radians by which the electrodes have moved."""
    protocol, position = adjacent(8), np.asarray(ring(0.1, 8, clockwise=True))
    angle = np.arctan2(position[:, 1], position[:, 0]) + turns
    position = 0.1 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    distance = np.linalg.norm(position[:, None] - position[None], axis=-1)
    np.fill_diagonal(distance, 1e-4)
    touched = np.exp(-((position - position[0]) ** 2).sum(axis=1) / 0.01)
    impedance = -np.log(distance / 0.1) / (np.pi * 1e-3) + bump * np.outer(touched, touched)
    potentials = np.asarray(protocol.drive) @ impedance
    return np.einsum("kl,kl->k", protocol.channel_measurement, potentials[np.asarray(protocol.drive_index)])


@pytest.fixture
def tank(tmp_path):
    """A folder with `rest.csv`, `touched.csv` and their descriptions, and functions to write other files."""

    class Tank:
        folder = tmp_path
        description = DESCRIPTION
        rest = _voltages(0.0)
        touched = _voltages(100.0)
        moved = _voltages(0.0, 0.02 * np.random.default_rng(0).normal(size=8))

        def write(self, name, values, description=DESCRIPTION):
            rows = np.atleast_2d(values)
            text = values if isinstance(values, str) else "\n".join(",".join(map(repr, map(float, r))) for r in rows)
            (self.folder / f"{name}.csv").write_text(text, "utf-8")
            if description is not None:
                (self.folder / f"{name}.toml").write_text(description, "utf-8")
            return self.folder / f"{name}.csv"

    made = Tank()
    made.write("rest", made.rest)
    made.write("touched", made.touched)
    return made


@pytest.fixture
def run(capsys):
    """Run the command in this process and return its exit status, standard output and standard error."""

    def call(*arguments):
        status = main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return call
