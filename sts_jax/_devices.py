"""Processor cores of this process, and computation of a batch on the devices of a mesh with explicit axes."""

import os
from collections.abc import Callable
from typing import Any

import jax
from jax.sharding import AxisType, NamedSharding, PartitionSpec


def cores() -> int:
    """Number of processor cores that this process may use, which a cluster's scheduler may limit.

    The environment variable `PYTHON_CPU_COUNT` replaces it, as in Python 3.13: containers with a quota show all cores.
    """
    given = os.environ.get("PYTHON_CPU_COUNT", "")
    if given.isdecimal() and int(given) > 0:
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def on_each_device(function: Callable[[Any, Any], Any], items: Any, shared: Any, axes: Any = 0) -> Any:
    """Call `function(items, shared)` on every device that has a part of the items, with this part.

    JAX splits no operation over an explicit axis by itself if its result could be split in several ways. Without
    explicit axes, this is one call of the function.

    Args:
        items: Tree of arrays whose first axis may be split over devices.
        shared: Tree of arrays that every device needs as a whole.
        axes: Axis of the items in the results, as a prefix of the tree of results.
    """
    first = next((x for x in jax.tree.leaves(items) if _names(x) is not None), None)
    if first is None:
        return function(items, shared)
    names = _names(first)
    mesh = (jax.typeof(first) if isinstance(first, jax.core.Tracer) else first).sharding.mesh
    here, whole = PartitionSpec(names), PartitionSpec()
    items, shared = (
        jax.tree.map(lambda x, spec=spec: jax.sharding.reshard(x, NamedSharding(mesh, spec)), tree)
        for tree, spec in ((items, here), (shared, whole))
    )
    results = jax.tree.map(lambda axis: PartitionSpec(*[None] * axis, names), axes)
    call = jax.shard_map(function, mesh=mesh, in_specs=(here, whole), out_specs=results, check_vma=False)
    return call(items, shared)


def is_inside_mesh(items: Any) -> bool:
    """Whether arrays of a tree lie on a mesh with explicit axes of which none splits their first axis.

    They are then perhaps items of a larger batch that `jax.vmap` maps over such an axis.
    """
    leaves = jax.tree.leaves(items)
    explicit = any(AxisType.Explicit in jax.typeof(x).sharding.mesh.axis_types for x in leaves)
    return explicit and all(_names(x) is None for x in leaves)


def _names(x: Any) -> Any:
    """Explicit axes of the mesh over which the first axis of an array is split, or None."""
    sharding = jax.typeof(x).sharding
    return sharding.spec[0] if AxisType.Explicit in sharding.mesh.axis_types and sharding.spec else None
