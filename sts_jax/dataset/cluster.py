"""Shards that the workers of a Dask cluster make."""

from collections.abc import Iterator
from pathlib import Path

from sts_jax.dataset.collection import Collection
from sts_jax.dataset.remote import Remote, local_or_remote
from sts_jax.dataset.shards import simulate_shard, write_shard
from sts_jax.sensor import Sensor


def make_shards(
    address: str,
    collection: Collection,
    sensor: Sensor,
    target: Path | Remote,
    dataset: str,
    indices: list[int],
) -> Iterator[int]:
    """Make shards on the cluster of a Dask scheduler, which gives those of a lost worker to another one.

    Args:
        address: Address of the scheduler.
        dataset: See `records.finish_shard`.

    Yields:
        The index of each shard when it is finished.
    """
    try:
        import distributed
    except ImportError:
        raise ImportError("a cluster needs the package distributed: pip install distributed") from None
    place = target.url if isinstance(target, Remote) else str(target.absolute())
    try:
        client = distributed.Client(address)
    except (OSError, ValueError) as error:
        raise ConnectionError(f"cannot connect to the Dask scheduler {address} ({error}): check the address") from None
    with client:
        futures = {
            client.submit(_make_shard, collection, sensor, place, dataset, index, pure=False): index
            for index in indices
        }
        for future in distributed.as_completed(futures):
            future.result()
            yield futures[future]
            future.release()


def _make_shard(collection: Collection, sensor: Sensor, place: str, dataset: str, index: int) -> None:
    """Make one shard in a worker."""
    simulated = simulate_shard(collection, sensor, index, lambda _: None)
    write_shard(collection, sensor, local_or_remote(place), dataset, index, simulated, lambda _: None)
