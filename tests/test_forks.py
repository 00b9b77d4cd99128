"""Forked processes after jeit has computed: NumPy results are available, compiled programs are refused, nothing
hangs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import multiprocessing, os, sys, warnings
warnings.filterwarnings("ignore", ".*os.fork.*")
import jax, numpy as np
import jeit
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import calibrate, one_step
from jeit.layout import ring
from jeit.mesh import disk
from jeit.protocol import adjacent

def made():
    return ForwardModel(disk(0.1, num_points=60), BoundaryElectrodes(ring(0.1, 8), 0.03, 0.01), adjacent(8))

def compiled(model):
    return jax.jit(lambda s: model.voltages(s))(1.0)

def slope(model):
    return jax.grad(lambda s: model.voltages(s).sum())(1.0)

def asked(work):
    def result(model):
        try:
            return np.asarray(work(model)).tobytes()
        except RuntimeError as error:
            return str(error)
    return result

WORK = {
    "voltages": lambda model: model.voltages(1.0),
    "jacobian": lambda model: model.jacobian(1.0),
    "model": lambda model: made().voltages(1.0),
    "image": lambda model: reconstruction.image(np.ones(len(model.voltages(1.0)))),
    "calibration": lambda model: calibrate(model, expected).conductivity,
    "compiled": compiled,
    "slope": slope,
}

def answer(model, pipe):
    pipe.send({name: asked(work)(model) for name, work in WORK.items()})

if __name__ == "__main__":
    way, before = sys.argv[1:]
    if before == "used":
        model = made()
        compiled(model)
        expected, reconstruction = np.asarray(model.voltages(1.0)), one_step(model, 1.0)
    context = multiprocessing.get_context(way)
    if way == "spawn":
        model = made()
        with context.Pool(1) as pool:
            assert pool.apply(compiled, (model,)).tobytes() == compiled(model).tobytes()
        sys.exit()
    here, there = context.Pipe()
    if before == "imported":
        # One compiled program stands for all.
        WORK.pop("slope")

        def answer_anew(pipe):
            globals().update(model=made())
            globals().update(expected=np.asarray(model.voltages(1.0)), reconstruction=one_step(model, 1.0))
            answer(model, pipe)
        child = context.Process(target=answer_anew, args=(there,))
    else:
        child = context.Process(target=answer, args=(model, there))
    child.start()
    assert here.poll(90), "the child hangs"
    results = here.recv()
    child.join()
    if before == "imported":
        model = made()
        expected, reconstruction = np.asarray(model.voltages(1.0)), one_step(model, 1.0)
    refused = {name for name, outcome in results.items() if isinstance(outcome, str) and "forked" in outcome}
    in_numpy = {"compiled": WORK["voltages"], "slope": lambda model: np.sum(model.jacobian(1.0))}
    for name, outcome in results.items():
        if name not in refused and name in in_numpy:
            np.testing.assert_allclose(np.frombuffer(outcome), np.ravel(in_numpy[name](model)), rtol=1e-9)
        elif name not in refused:
            assert outcome == asked(WORK[name])(model), name
    print(*sorted(refused))
"""


def refused(tmp_path: Path, *how: str) -> list[str]:
    """Names of the results refused in a forked process; all other results equal those of the parent, bit for bit where
    NumPy computes them."""
    path = tmp_path / "program.py"
    path.write_text(PROGRAM)
    environment = {**os.environ, "JEIT_COMPILATION_CACHE": "off"}
    done = subprocess.run(
        [sys.executable, str(path), *how], env=environment, capture_output=True, text=True, timeout=180
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no os.fork here")
def test_compiled_code_is_refused_in_forks_after_jax_has_started(tmp_path):
    assert refused(tmp_path, "fork", "used") == ["compiled", "slope"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no os.fork here")
def test_forks_of_a_process_that_only_imported_jeit_compute_everything(tmp_path):
    assert refused(tmp_path, "fork", "imported") == []


@pytest.mark.slow
def test_spawned_processes_compute_everything(tmp_path):
    assert refused(tmp_path, "spawn", "used") == []
