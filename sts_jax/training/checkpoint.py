"""Training states on disk.

A model's folder holds `config.json` (the model, the run and the caller's preprocessing), `metrics.jsonl`,
`checkpoints/STEP/` and `manifest.json`, which names the current checkpoint and holds the checksums of its files
(`sts_jax.training.manifest`). If the process is killed while it writes a checkpoint, the previous one stays current.

A checkpoint has two parts, `weights` and `optimiser`. A prediction reads the first part alone, so that another
optimiser, or another version of optax, leaves every model readable. Orbax writes both parts. The weights may instead be
one small file (`sts_jax.training.rounded`). Checkpoints of sts_jax 0.1 hold both parts in one, which is still read.
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

from sts_jax import _files
from sts_jax.training import manifest, rounded

WEIGHTS, OPTIMISER = "weights", "optimiser"  # the parts of a checkpoint
_UNDIVIDED = "state"  # the only part in checkpoints of sts_jax 0.1


class TrainState(NamedTuple):
    """Everything that changes during training."""

    params: nnx.State
    stats: nnx.State  # running batch statistics
    optimiser: optax.OptState
    step: Int[Array, ""]  # gradient steps done


class Weights(NamedTuple):
    """The part of a `TrainState` that a prediction needs."""

    params: nnx.State
    stats: nnx.State
    step: Int[Array, ""]


State = TypeVar("State", TrainState, Weights)


def save(folder: Path, state: TrainState | Weights, *, compact: bool = False) -> None:
    """Write `folder/checkpoints/STEP` and its checksums, then delete older checkpoints.

    Args:
        folder: the model's folder.
        state: the state to write.
        compact: whether to round the weights and write one small file, see `training.rounded`.

    Raises:
        OSError: the disk is full or the folder is not writable. The previous checkpoint stays valid.
        ValueError: the folder holds a checkpoint without a manifest.
    """
    before = _manifest(folder)
    if before is None:
        before = manifest.write(folder, None)
    step, kept = int(state.step), before.step
    path = manifest.checkpoint(folder, step)
    try:
        _keep_only(folder, kept)  # an interrupted call may have left a checkpoint that the manifest does not name
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
                f"cannot write {path}: {_first_line(error)}. {_files.remedy(error)}, then start again ({left})."
            ) from None
        manifest.write(folder, step)
        kept = step
    finally:
        _keep_only(folder, kept)


def restore(folder: Path, like: State) -> State | None:
    """Restore the newest state in `folder`, or return None if there is none yet.

    Args:
        folder: the model's folder.
        like: a state, or the `jax.eval_shape` of one, with the structure, shapes and dtypes to restore.

    Returns:
        A state of the same structure and dtypes.

    Raises:
        TornFileError: a file is damaged, missing or not listed in the manifest.
        ValueError: the checkpoint belongs to another model, or has no manifest.
    """
    path = verified(folder)
    return None if path is None else read(path, like)


def verified(folder: Path) -> Path | None:
    """Compare all files of a model with their checksums, and return its current checkpoint, or None before the first.

    Raises:
        TornFileError, ValueError: as `restore`.
    """
    listed = _manifest(folder)
    if listed is None:
        return None
    manifest.verify(folder, listed)
    return None if listed.step is None else manifest.checkpoint(folder, listed.step)


def read(path: Path, like: State) -> State:
    """Read the arrays of a checkpoint that `like` contains, and no others.

    Raises:
        ValueError: the checkpoint lacks one of them, or has it with another shape or dtype. The message names the part.
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
                    f"{path} has no state of this optimiser {reason}: its training used another optimiser, or "
                    "Predictor.save wrote it, which leaves the optimiser's state out. Give the optimiser that the "
                    "training began with, or train in another folder. Predictor.load reads this model either way."
                ) from None
            raise ValueError(
                f"{path} cannot be read {reason}: it was damaged before its checksums were taken, or belongs to "
                "another model, or to a version of sts_jax with other networks. Give another folder, load it with the "
                "version that trained it, or delete it and train again."
            ) from None
    return jax.tree.unflatten(jax.tree.structure(like), [loaded[name] for name in _plain(like)])


def _read_orbax(path: Path, part: str, wanted: dict[str, Any]) -> dict[str, Array]:
    stored = part if (path / part).is_dir() else _UNDIVIDED
    if not wanted and stored != part:
        return {}  # of an optimiser without arrays
    device = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    abstract = {name: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=device) for name, x in wanted.items()}
    context = ocp.Context()
    context.pytree.loading.partial_load = True
    with _quiet_orbax():
        # Compare first, because Orbax cuts or pads arrays of another shape, or prints thousands of lines.
        there = ocp.metadata(str(path.absolute()), stored).metadata
        _compare(there, wanted)
        if stored == OPTIMISER and there.keys() != wanted.keys():
            raise ValueError(f"{min(there.keys() - wanted.keys())} belongs to another optimiser than the given one")
        with context:
            return ocp.load(str(path.absolute()), abstract, checkpointable_name=stored)


def _read_rounded(path: Path, wanted: dict[str, Any]) -> dict[str, Array]:
    there = rounded.read(path / rounded.NAME)
    _compare(there, wanted)
    return jax.device_put({name: there[name] for name in wanted}, jax.devices()[0])


def _compare(there: dict[str, Any], wanted: dict[str, Any]) -> None:
    for name, x in wanted.items():
        if name not in there or (there[name].shape, there[name].dtype) != (x.shape, x.dtype):
            raise ValueError(f"{name} is missing or has another shape")


def seal(folder: str | os.PathLike[str]) -> None:
    """Write a manifest of the present files of a model that was trained by sts_jax 0.1, which wrote none.

    Raises:
        FileNotFoundError: the folder has no checkpoint.
        ValueError: the folder has a manifest.
    """
    folder = Path(folder)
    if (folder / manifest.NAME).exists():
        raise ValueError(
            f"{folder} has a {manifest.NAME} already, and its files are verified whenever it is loaded: there is "
            f"nothing to seal. If you changed a file on purpose, delete {manifest.NAME} first."
        )
    steps = _steps(folder)
    if not steps:
        raise FileNotFoundError(f"{folder} has no checkpoint: give the folder of a trained model.")
    manifest.write(folder, max(steps))


def _manifest(folder: Path) -> manifest.Manifest | None:
    found = manifest.read(folder)
    if found is None and _steps(folder):
        raise ValueError(
            f"{folder} has a checkpoint but no {manifest.NAME}: it was trained by an earlier version of sts_jax, or "
            "the file was deleted, and nothing shows that its files are undamaged. Delete the folder and train again, "
            f"or, if you trust these files, call training.seal({str(folder)!r}) once."
        )
    return found


def _steps(folder: Path) -> list[int]:
    checkpoints = folder / "checkpoints"
    return [int(path.name) for path in checkpoints.iterdir() if path.name.isdigit()] if checkpoints.is_dir() else []


def _keep_only(folder: Path, step: int | None) -> None:
    checkpoints = folder / "checkpoints"
    for path in checkpoints.iterdir() if checkpoints.is_dir() else ():
        if step is None or path != manifest.checkpoint(folder, step):
            shutil.rmtree(path, ignore_errors=True)  # a leftover does no harm, because the manifest does not name it


@contextlib.contextmanager
def _quiet_orbax() -> Iterator[None]:
    """Silence the log in which Orbax prints the tracebacks of its threads before it raises their error.

    A full disk gives 237 lines of them. A thread that fails after the error was raised still logs its traceback.
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
    """The leaves by path, so that the files do not depend on the classes of Flax and optax."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def _parts(state: TrainState | Weights) -> dict[str, dict[str, Any]]:
    """The leaves of each part of a checkpoint."""
    leaves = _plain(state)
    optimiser = {name: leaf for name, leaf in leaves.items() if name.startswith(f"{OPTIMISER}/")}
    weights = {name: leaf for name, leaf in leaves.items() if name not in optimiser}
    return {WEIGHTS: weights, OPTIMISER: optimiser} if isinstance(state, TrainState) else {WEIGHTS: weights}
