"""Write and read checkpoints of a training.

The folder of a model contains

- `config.json`: the model, the options of the training and the preprocessing
- `metrics.jsonl`: the training log
- `checkpoints/STEP/`: the current checkpoint
- `manifest.json`: the step of the current checkpoint and the checksums of the model's files
  (`sts_jax.training.manifest`)

If the process is killed while it writes a checkpoint, the previous checkpoint stays the current one.

A checkpoint has two parts, `weights` and `optimiser`. A prediction reads only the weights, so that a model stays
readable with another optimiser or another version of optax. Orbax writes both parts. `save(..., compact=True)`
instead writes one small file with rounded weights (`sts_jax.training.rounded`). Checkpoints of sts_jax 0.1 are not
divided into parts, and can still be read.
"""

import contextlib
import logging
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import optax
from flax import nnx
from jaxtyping import Array, Int
from orbax.checkpoint import v1 as ocp

from sts_jax import storage
from sts_jax.training import manifest, rounded

WEIGHTS, OPTIMISER = "weights", "optimiser"  # the parts of a checkpoint
_UNDIVIDED = "state"  # the only part of checkpoints of sts_jax 0.1


class TrainState(NamedTuple):
    """The state of a training: parameters, batch statistics, optimiser state and number of gradient steps done."""

    params: nnx.State  # parameters
    stats: nnx.State  # running batch statistics
    optimiser: optax.OptState  # state of the optimiser
    step: Int[Array, ""]  # gradient steps done


class Weights(NamedTuple):
    """The parameters, the batch statistics and the step number of a `TrainState`, without the optimiser's state."""

    params: nnx.State  # parameters
    stats: nnx.State  # running batch statistics
    step: Int[Array, ""]  # gradient steps done


State = TypeVar("State", TrainState, Weights)


def save(folder: Path, state: TrainState | Weights, *, compact: bool = False) -> None:
    """Write a checkpoint with its checksums, then delete older checkpoints.

    The checkpoint is the folder `folder/checkpoints/STEP`. STEP is the number of gradient steps done, in eight digits.

    Args:
        folder: Folder of the model.
        state: State of the training, or only its weights.
        compact: True writes all arrays to one small file, in which the weights are rounded, see `training.rounded`.

    Raises:
        OSError: The checkpoint cannot be written, for example because the disk is full. The previous checkpoint stays
            valid.
        ValueError: The folder has a checkpoint but no `manifest.json`, which contains the checksums.
    """
    before = _manifest(folder)
    if before is None:
        before = manifest.write(folder, None)
    step, kept = int(state.step), before.step
    path = manifest.checkpoint(folder, step)
    try:
        _keep_only(folder, kept)  # deletes a checkpoint that an interrupted call may have left
        try:
            if compact:
                path.mkdir(parents=True)
                rounded.write(path / rounded.NAME, _plain(state))
            else:
                path.parent.mkdir(parents=True, exist_ok=True)
                with _quiet_orbax():
                    parts = {part: leaves for part, leaves in _parts(state).items() if leaves}
                    ocp.save_checkpointables(str(path.absolute()), parts)
        except Exception as error:  # Orbax and TensorStore raise many types, with pages of traceback
            left = "no earlier checkpoint exists" if kept is None else f"the checkpoint of step {kept} is kept"
            raise OSError(
                f"cannot write {path}: {_first_line(error)}. {storage.remedy(error)}, then start again ({left})."
            ) from None
        manifest.write(folder, step)
        kept = step
    finally:
        _keep_only(folder, kept)


def restore(folder: Path, like: State) -> State | None:
    """Read the state of the current checkpoint, after comparing all files with their checksums.

    Args:
        folder: Folder of the model.
        like: State with the structure, shapes and dtypes of the state to read. The leaves may be abstract arrays, such
            as those from `jax.eval_shape`.

    Returns:
        The state in the checkpoint, or None if the folder has no checkpoint.

    Raises:
        DamagedFileError: A file is damaged, missing or not listed in `manifest.json`.
        ValueError: The checkpoint was written for another model or optimiser. Or the folder has a checkpoint, but no
            `manifest.json`.
    """
    path = verified(folder)
    return None if path is None else read(path, like)


def verified(folder: Path) -> Path | None:
    """Compare the configuration, the blank images and the current checkpoint of a model with their checksums.

    Args:
        folder: Folder of the model.

    Returns:
        The folder of the current checkpoint, or None if there is no checkpoint.

    Raises:
        DamagedFileError: A file is damaged, missing or not listed in `manifest.json`.
        ValueError: The folder has a checkpoint but no `manifest.json`, which contains the checksums.
    """
    listed = _manifest(folder)
    if listed is None:
        return None
    manifest.verify(folder, listed)
    return None if listed.step is None else manifest.checkpoint(folder, listed.step)


def read(path: Path, like: State) -> State:
    """Read a checkpoint.

    Parts of the state that `like` lacks are not returned. For example, `like` may lack the state of the optimiser.

    Args:
        path: Folder of the checkpoint.
        like: State with the structure, shapes and dtypes of the state to read. The leaves may be abstract arrays, such
            as those from `jax.eval_shape`.

    Returns:
        The state in the checkpoint.

    Raises:
        ValueError: The checkpoint cannot be read, or an array is missing or has another shape or dtype.
    """
    loaded: dict[str, Array] = {}
    for part, wanted in _parts(like).items():
        try:
            if (path / rounded.NAME).exists():
                loaded |= _read_rounded(path, wanted)
            else:
                loaded |= _read_orbax(path, part, wanted)
        except Exception as error:  # Orbax, TensorStore and zipfile raise many types, some with pages of traceback
            reason = f"({type(error).__name__}: {_first_line(error)})"
            if part == OPTIMISER:
                raise ValueError(
                    f"{path} has no state of this optimiser {reason}: the training used another optimiser, or the "
                    "model was written by Predictor.save, which leaves out the optimiser. Give the optimiser that the "
                    "training began with, or train in another folder. Predictor.load reads this model without an "
                    "optimiser."
                ) from None
            raise ValueError(
                f"{path} cannot be read {reason}, although its checksums are right. It belongs to another model or to "
                "a version of sts_jax with other networks, or it was damaged before the checksums were computed. Give "
                "another folder, load the model with the version that trained it, or delete the folder and train again."
            ) from None
    return jax.tree.unflatten(jax.tree.structure(like), [loaded[name] for name in _plain(like)])


def _read_orbax(path: Path, part: str, wanted: dict[str, Any]) -> dict[str, Array]:
    stored = part if (path / part).is_dir() else _UNDIVIDED
    if not wanted and stored != part:
        return {}  # an optimiser without arrays has no part of its own
    device = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    abstract = {name: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=device) for name, x in wanted.items()}
    context = ocp.Context()
    context.pytree.loading.partial_load = True
    with _quiet_orbax():
        # Compare the shapes first. Orbax cuts or pads arrays of another shape, or prints thousands of lines.
        there = ocp.metadata(str(path.absolute()), stored).metadata
        _compare(there, wanted)
        if stored == OPTIMISER and there.keys() != wanted.keys():
            extra = min(there.keys() - wanted.keys())
            raise ValueError(f"the checkpoint has the array {extra}, which the given optimiser's state lacks")
        with context:
            return ocp.load(str(path.absolute()), abstract, checkpointable_name=stored)


def _read_rounded(path: Path, wanted: dict[str, Any]) -> dict[str, Array]:
    there = rounded.read(path / rounded.NAME)
    _compare(there, wanted)
    return jax.device_put({name: there[name] for name in wanted}, jax.devices()[0])


def _compare(there: dict[str, Any], wanted: dict[str, Any]) -> None:
    for name, x in wanted.items():
        if name not in there or (there[name].shape, there[name].dtype) != (x.shape, x.dtype):
            raise ValueError(f"array {name} is missing, or does not have shape {x.shape} and dtype {x.dtype}")


def seal(folder: str | os.PathLike[str]) -> None:
    """Write `manifest.json` for a model of sts_jax 0.1, which did not write this file.

    The manifest contains the checksums of the model's files. A model without a manifest cannot be loaded. Files that
    were damaged before this call are not detected.

    Args:
        folder: Folder of the model.

    Raises:
        FileNotFoundError: The folder has no checkpoint.
        ValueError: The folder already has a manifest.
        OSError: The manifest cannot be written.
    """
    folder = Path(folder)
    if (folder / manifest.NAME).exists():
        raise ValueError(
            f"{folder} already has a {manifest.NAME}, so the model can be loaded without this call. If you changed a "
            f"file of the model on purpose, delete {manifest.NAME} and call seal again."
        )
    steps = _steps(folder)
    if not steps:
        raise FileNotFoundError(f"{folder} has no checkpoint: give the folder of a trained model.")
    manifest.write(folder, max(steps))


def _manifest(folder: Path) -> manifest.Manifest | None:
    """Read the manifest. Raise a ValueError if there is none although the folder has a checkpoint."""
    found = manifest.read(folder)
    if found is None and _steps(folder):
        raise ValueError(
            f"{folder} has a checkpoint but no {manifest.NAME}: the model was trained by an earlier version of "
            "sts_jax, or the file was deleted. Without this file, damage to the model's files cannot be found. Delete "
            f"the folder and train again or, if you trust the files, call training.seal({str(folder)!r}) once."
        )
    return found


def _steps(folder: Path) -> list[int]:
    """The steps of all checkpoints in a model's folder."""
    checkpoints = folder / "checkpoints"
    return [int(path.name) for path in checkpoints.iterdir() if path.name.isdigit()] if checkpoints.is_dir() else []


def _keep_only(folder: Path, step: int | None) -> None:
    """Delete all checkpoints in a model's folder but that of one step. None deletes all. Other folders are kept."""
    checkpoints = folder / "checkpoints"
    for path in checkpoints.iterdir() if checkpoints.is_dir() else ():
        made = path.name.split(".")[0].isdecimal()  # Orbax adds a suffix to the name of an unfinished checkpoint
        if made and (step is None or path != manifest.checkpoint(folder, step)):
            shutil.rmtree(path, ignore_errors=True)  # a folder that remains is ignored: the manifest does not name it


@contextlib.contextmanager
def _quiet_orbax() -> Iterator[None]:
    """Silence the log in which Orbax prints the tracebacks of its threads, for example 237 lines if the disk is full.

    Orbax also raises the error. A thread that fails after the error was raised still logs its traceback.
    """
    logger = logging.getLogger("absl")
    disabled, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = disabled


def _first_line(error: Exception) -> str:
    lines = str(error).splitlines() or [type(error).__name__]
    return lines[0][:500]


def _plain(state: TrainState | Weights) -> dict[str, Any]:
    """The arrays of a state by their paths, so that the files do not depend on the classes of Flax and optax."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def _parts(state: TrainState | Weights) -> dict[str, dict[str, Any]]:
    """The arrays of a state by part of the checkpoint, then by path."""
    leaves = _plain(state)
    optimiser = {name: leaf for name, leaf in leaves.items() if name.startswith(f"{OPTIMISER}/")}
    weights = {name: leaf for name, leaf in leaves.items() if name not in optimiser}
    return {WEIGHTS: weights, OPTIMISER: optimiser} if isinstance(state, TrainState) else {WEIGHTS: weights}
