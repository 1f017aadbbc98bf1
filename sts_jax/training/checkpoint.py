"""Training states on disk.

A model's folder holds `config.json` (the model, the run and the caller's preprocessing), `metrics.jsonl` and
`checkpoints/STEP/`, of which the newest counts. Orbax writes a checkpoint under a temporary name and renames it
when it is complete, so a kill leaves the one before.
"""

import json
import os
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import jax
import optax
from flax import nnx
from jaxtyping import Array, Int
from orbax.checkpoint import v1 as ocp


class TrainState(NamedTuple):
    """All that changes while a model is trained."""

    params: nnx.State
    stats: nnx.State  # running batch statistics
    optimiser: optax.OptState
    step: Int[Array, ""]  # gradient steps done


def save(folder: Path, state: TrainState) -> None:
    """Write `folder/checkpoints/STEP`; older ones go once it is complete."""
    checkpoints = folder / "checkpoints"
    checkpoints.mkdir(parents=True, exist_ok=True)
    name = f"{int(state.step):08d}"
    ocp.save(str(checkpoints.absolute() / name), _plain(state))
    for old in checkpoints.iterdir():
        if old.name != name:
            shutil.rmtree(old)


def restore(folder: Path, like: TrainState) -> TrainState | None:
    """The newest state in `folder`, or None where there is none yet.

    Args:
        folder: the model's folder.
        like: a state, or the `jax.eval_shape` of one, with the structure, shapes and dtypes wanted.

    Returns:
        A state of the same structure and dtypes.

    Raises:
        ValueError: the checkpoint is torn, or of another model.
    """
    newest = _newest(folder)
    if newest is None:
        return None
    device = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    abstract = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=device), _plain(like))
    try:
        loaded = ocp.load(str(newest.absolute()), abstract)
    except Exception as error:  # Orbax and TensorStore raise many kinds
        reason = (str(error).splitlines() or [""])[0]
        raise ValueError(
            f"{newest}: torn, or of another model ({type(error).__name__}: {reason}); delete {folder} and train again"
        ) from error
    return jax.tree.unflatten(jax.tree.structure(like), [loaded[name] for name in _plain(like)])


def read_settings(folder: Path) -> dict[str, Any] | None:
    """What `config.json` holds, or None where there is none.

    Raises:
        ValueError: the file is torn.
    """
    path = folder / "config.json"
    if not path.exists():
        return None
    try:
        return json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: torn ({error}); delete {folder} and train again") from error


def write_text(path: Path, text: str) -> None:
    """Replace a file as a whole."""
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text)
    os.replace(temporary, path)


def _newest(folder: Path) -> Path | None:
    checkpoints = folder / "checkpoints"
    found = [p for p in checkpoints.iterdir() if p.name.isdigit()] if checkpoints.is_dir() else []
    return max(found, default=None, key=lambda p: int(p.name))


def _plain(state: TrainState) -> dict[str, Any]:
    """The leaves by their paths, so that what is on disk knows no class of Flax or optax."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}
