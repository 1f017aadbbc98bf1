"""Training over two devices, and over two processes, against one device: the same weights up to rounding."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from statespace_config import SMALL, STATE, arrays, trajectories

from sts_jax import training
from sts_jax.training.devices import Devices

HERE = Path(__file__).parent
CONFIG = training.TrainConfig(steps=8, batch_size=8, falls=32, log_every=2, checkpoint_every=4)

# Trains in this process, one of `count`, and writes the rows that it read. With `stop`, it ends after this step.
WORKER = """
import dataclasses, json, sys
from pathlib import Path
import jax
workdir, kind, process, count, devices, port, stop, batch_size = sys.argv[1:3] + list(map(int, sys.argv[3:]))
jax.config.update("jax_num_cpu_devices", devices)
if count > 1:
    jax.distributed.initialize(f"localhost:{port}", count, process)
from statespace_config import SMALL, Killed, arrays, kill_at
from sts_jax import training
from test_training_devices import CONFIG, state_set
rows, take = [], training.Arrays.take
def recorded(self, index, **further):
    rows.append(index.tolist())
    return take(self, index, **further)
training.Arrays.take = recorded
config = dataclasses.replace(CONFIG, batch_size=batch_size)
model, data = state_set() if kind == "state" else (SMALL, arrays())
try:
    trained = training.train(config, model, data, workdir=workdir, validation=None if kind == "state" else arrays(9, 1),
                             progress=kill_at(stop) if stop else None)
    assert all(leaf.is_fully_addressable and len(leaf.devices()) == 1 for leaf in jax.tree.leaves(trained.state))
except Killed:
    pass
Path(f"{workdir}-rows{process}.json").write_text(json.dumps(rows))
"""


def state_set():
    """A state-space model and a training set with views and falls."""
    data = trajectories(16)
    targets = {name: data["targets"][name] for name in ("state", "pose", "outcome")}
    views = {"visual": data["inputs"]["visual"], "state": targets["state"]}
    return STATE, training.Arrays(**data, views=views, falls=targets | {"condition": data["condition"]})


def run(workdir, kind="small", *, count=1, devices=1, stop=0, batch_size=8):
    """Train in `count` processes at a time, and return what they wrote to stderr."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    environment = os.environ | {"PYTHONPATH": f"{HERE.parent}{os.pathsep}{HERE}", "JAX_PLATFORMS": "cpu"}
    workers = [
        subprocess.Popen(
            [sys.executable, "-c", WORKER, *map(str, (workdir, kind, i, count, devices, port, stop, batch_size))],
            env=environment,
            stderr=subprocess.PIPE,
            text=True,
        )
        for i in range(count)
    ]
    errors = [worker.communicate(timeout=900)[1] for worker in workers]
    return [worker.returncode for worker in workers], errors


def weights(folder):
    return jax.tree.leaves(training.load(folder, calibrated=False).state)


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    folder = tmp_path_factory.mktemp("single")
    training.train(CONFIG, SMALL, arrays(), workdir=folder, validation=arrays(9, 1))
    return folder


def assert_same_training(folder, single):
    for one, other in zip(weights(folder), weights(single), strict=True):
        np.testing.assert_allclose(one, other, atol=2e-6)
    for name in ("metrics.jsonl", "best/metrics.jsonl"):
        assert (folder / name).exists() == (single / name).exists()
    assert_same_losses(folder, single)


def assert_same_losses(folder, single, rel=1e-5):
    logs = [[*map(json.loads, (path / "metrics.jsonl").read_text().splitlines())] for path in (folder, single)]
    for one, other in zip(*logs, strict=True):
        assert one == pytest.approx(other, rel=rel)


@pytest.mark.slow
def test_several_devices_train_as_one(tmp_path, single):
    codes, errors = run(tmp_path / "run", devices=3)  # 3 do not divide the batch of 8, so that 2 are used
    assert codes == [0], errors
    assert_same_training(tmp_path / "run", single)


@pytest.mark.slow
def test_two_processes_read_a_half_each_and_resume_together(tmp_path, single):
    folder = tmp_path / "run"
    for stop in (6, 0):
        codes, errors = run(folder, count=2, stop=stop)
        assert codes == [0, 0], errors
    assert_same_training(folder, single)
    halves = [json.loads(Path(f"{folder}-rows{process}.json").read_text()) for process in range(2)]
    order = list(training.order(CONFIG.seed, 20, 8, 4, 8))  # resumed after step 4
    read = [[rows for rows in half if len(rows) == 4] for half in halves]
    np.testing.assert_array_equal(np.concatenate([np.array(part) for part in read], axis=1)[:4], order)


@pytest.mark.slow
def test_a_state_space_model_with_views_and_falls_trains_as_on_one_device(tmp_path):
    training.train(CONFIG, *state_set(), workdir=tmp_path / "one")
    codes, errors = run(tmp_path / "two", "state", devices=2)
    assert codes == [0], errors
    one, two = (np.concatenate([np.ravel(leaf) for leaf in weights(tmp_path / name)]) for name in ("one", "two"))
    # Adam makes a step of full length from a gradient that is rounding alone. How many weights have one depends on the
    # processor.
    assert np.median(np.abs(one - two)) < 2e-5
    assert np.quantile(np.abs(one - two), 0.99) < 5e-4
    assert_same_losses(tmp_path / "two", tmp_path / "one", rel=1e-3)


@pytest.mark.slow
def test_a_batch_that_the_processes_do_not_divide_is_named(tmp_path):
    codes, errors = run(tmp_path / "run", count=2, batch_size=7)
    assert codes == [1, 1]
    assert all("batch_size is 7, but it must be a multiple of 2, the number of devices" in error for error in errors)
    assert not (tmp_path / "run").exists()


def test_one_device_reads_batches_as_they_are():
    data, index = arrays(), np.arange(8)
    assert Devices.of(None).mesh is None
    batch = Devices.of(None).take(data, index, {})
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(batch))
    jax.tree.map(np.testing.assert_array_equal, batch, data.take(index))
    with pytest.raises(ValueError, match=r"devices must be as many in each process, and at least 1, got \[0\]"):
        Devices.of([])
