"""A Dask cluster makes the same bytes, also if it loses a worker midway."""

import signal
import subprocess
import sys

import pytest

import sts_jax as sts
from sts_jax import dataset

pytestmark = pytest.mark.slow

SMALL = dataset.Collection(
    sts.physics.Freefall(frames=12), num_objects=12, num_per_object=2, num_full=12, objects_per_shard=2
)


def bytes_of(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name != ".lock"}


@pytest.fixture
def cluster(tmp_path):
    """A scheduler and two workers on loopback, each a process: the address and the workers."""
    pytest.importorskip("distributed")
    started, file = [], tmp_path / "scheduler.json"

    def start(*words):
        command = [sys.executable, "-m", "distributed.cli." + words[0], *words[1:], "--scheduler-file", str(file)]
        with (tmp_path / f"{len(started)}.log").open("w") as log:
            started.append(subprocess.Popen(command, stdout=log, stderr=log))

    start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
    for _ in range(2):
        start("dask_worker", "--host", "127.0.0.1", "--nthreads", "1", "--no-nanny", "--no-dashboard")
    import distributed

    with distributed.Client(scheduler_file=str(file), timeout="120s") as client:
        client.wait_for_workers(2, timeout=300)
        yield client.scheduler.address, started[1:]
    for process in started:
        process.kill()
        process.wait()


def test_two_workers_of_which_one_is_killed_make_the_bytes_of_one_process(cluster, tmp_path):
    address, workers = cluster
    dataset.collect(SMALL, sts.Sensor(), tmp_path / "alone")
    killed = []

    def kill(progress):
        if progress.trajectories and not killed:
            killed.append(workers[0])
            workers[0].kill()

    made = dataset.collect(SMALL, sts.Sensor(), tmp_path / "cluster", cluster=address, progress=kill)
    assert killed
    assert workers[0].wait() == -signal.SIGKILL
    assert workers[1].poll() is None
    assert bytes_of(tmp_path / "cluster") == bytes_of(tmp_path / "alone")
    assert made == dataset.collect(SMALL, sts.Sensor(), tmp_path / "alone")


def test_an_address_without_a_scheduler_is_named(tmp_path):
    dask = pytest.importorskip("dask")
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(ConnectionError, match=r"cannot connect to the Dask scheduler tcp://127\.0\.0\.1:9 .*check the"),
    ):
        dataset.collect(SMALL, sts.Sensor(), tmp_path, cluster="tcp://127.0.0.1:9")
