"""`jeit learn image --scheduler` with the command and a worker killed: the network is that of one process."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest
from small_networks import SKIN

# The processes are killed while touches are simulated; one epoch of training is enough.
QUICK = """
import sys
from jeit.cli import main
from jeit.touch.networks import PRESETS, NetworkPreset
from jeit.touch.training import TrainingPlan
PRESETS["quick"] = NetworkPreset(1000, 250, TrainingPlan(rate=2e-3, batch=32, epochs=1))
sys.exit(main(sys.argv[1:]))
"""


def finished(model) -> int:
    """Finished chunks of the training touches."""
    path = model / "work" / "learnt.zarr" / "zarr.json"
    return len(json.loads(path.read_bytes())["attributes"]["finished"]) if path.exists() else 0


@pytest.mark.slow(first=True)
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_command_and_workers_killed(tmp_path):
    distributed = pytest.importorskip("distributed")
    skin = tmp_path / "skin.toml"
    skin.write_text(SKIN)

    def start(name, *options):
        command = [sys.executable, "-c", QUICK, "learn", "image", str(skin), "--output", str(tmp_path / name)]
        command += ["--preset", "quick", "--touches", "1000", "--quiet", *options]
        return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)

    def wait(name, process, number):
        while finished(tmp_path / name) < number:
            assert process.poll() is None, process.communicate()[1]
            time.sleep(0.05)

    whole = start("whole")
    assert (whole.communicate()[1], whole.returncode) == ("", 0)
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):
        scheduler = "--scheduler", cluster.scheduler_address
        process = start("killed", *scheduler)
        wait("killed", process, 1)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert 1 <= finished(tmp_path / "killed") < 4
        process = start("killed", *scheduler)
        wait("killed", process, 2)
        os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)
        assert (process.communicate()[1], process.returncode) == ("", 0)
    assert (tmp_path / "killed" / "network.jeit").read_bytes() == (tmp_path / "whole" / "network.jeit").read_bytes()
