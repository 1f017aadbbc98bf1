"""The folder of a trained model: writing and loading it, and the calibration of state-space models.

- `config.json`: the model, the options of the training and the preprocessing
- `blank.npz`: the images of the empty sensor
- `checkpoints/STEP/`: the current checkpoint, which Orbax writes in the parts `weights` and `optimiser`, or one file of
  rounded weights. A prediction reads only the weights, so that another version of optax does not matter
- `calibration.json`: the calibration of the current checkpoint, for state-space models
- `metrics.jsonl`: the training log, one record per line: a step, and the means of the loss terms since the last record
- `best/`: a model folder of its own, with the weights of the checkpoint with the least validation loss. It has no
  optimiser's state, no log, and no calibration unless `calibrate` is called on it
- `manifest.json`: the SHA-256 of these files, the step of the current checkpoint, and the log's length at this step

A new checkpoint is written first, then the manifest is replaced, then the older checkpoint is deleted. At any kill, all
files that the manifest lists are therefore complete. Records of the log after the current checkpoint are not listed: a
resumed training makes them again.
"""

import contextlib
import dataclasses
import functools
import glob
import hashlib
import io
import json
import logging
import os
import shutil
import tempfile
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pydantic
from flax import nnx
from jaxtyping import Array, ArrayLike, Int, UInt8
from orbax.checkpoint import v1 as ocp

from sts_jax import mvae, statespace, storage
from sts_jax._checked import check_arrays, checked, in_32_bits
from sts_jax.training.arrays import Arrays, Config, check

CONFIG, BLANK, CALIBRATION, LOG = "config.json", "blank.npz", "calibration.json", "metrics.jsonl"
BEST = "best"  # folder of the weights with the least validation loss
WEIGHTS, OPTIMISER = "weights", "optimiser"  # the parts of a checkpoint
COMPACT = "weights.npz"  # the only file of a compact checkpoint
KINDS: dict[str, Any] = {"mvae": mvae, "statespace": statespace}  # package of each `kind` in `config.json`
Record = dict[str, float]  # `step`, and the terms of the loss by name

_LEVELS = 128  # root mean square of the weights of a channel, in steps of rounded weights
_LARGEST = 2**15 - 1  # largest whole number of a rounded weight, which has 16 bits
_STEP = ":step"  # suffix of the name of the array that has the steps of a kernel


class TrainState(NamedTuple):
    """The state of a training."""

    params: nnx.State
    stats: nnx.State  # running batch statistics
    optimiser: optax.OptState | None  # None if it is not written or read
    step: Int[Array, ""]  # gradient steps done


class _Blank(NamedTuple):
    visual: UInt8[np.ndarray, "height width 3"]
    tactile: UInt8[np.ndarray, "height width 3"]


class Model(NamedTuple):
    """A trained model. `graphdef` and `state` are the first two arguments of `mvae.predict` or `statespace.sample`."""

    config: Config  # configuration of the model
    graphdef: nnx.GraphDef[Any]  # definition of the model
    state: nnx.State  # parameters and running batch statistics
    step: int  # gradient steps done
    settings: dict[str, Any]  # content of config.json: `model`, `training`, `preprocessing`, ...
    calibration: statespace.Calibration | None = None  # from `calibrate`, for state-space models

    def __repr__(self) -> str:
        config, count = self.config, sum(x.size for x in jax.tree.leaves(self.state))
        if isinstance(config, mvae.Config):
            parts = ", ".join(f"{m.name} {m.kind} {m.shape}" for m in config.modalities) + f"; latent={config.latent}"
        else:
            parts = f"{', '.join(config.inputs)}; look={config.look}, outcomes={config.outcomes}"
        return f"Model({parts}, condition={config.condition}, {count:,} numbers, step={self.step})"


_Number = Annotated[int, pydantic.Field(ge=0)]
_Positive = Annotated[float, pydantic.Field(gt=0, allow_inf_nan=False)]


@dataclasses.dataclass(frozen=True)
class _Log:
    """The part of the training log up to the current checkpoint."""

    bytes: _Number
    sha256: str


@dataclasses.dataclass(frozen=True)
class _Facts:
    """The facts in the manifest of a model."""

    step: _Number | None  # step of the current checkpoint
    log: _Log | None = None
    split: str | None = None  # checksum of the split of the dataset, see `claim_split`


@dataclasses.dataclass(frozen=True)
class _Record:
    """A line of the training log."""

    terms: Record


@dataclasses.dataclass(frozen=True)
class _Subset:
    """The numbers of `statespace.Calibration` for one subset of the inputs."""

    outcome: _Positive
    weight: _Positive
    variance: _Positive
    contrast: _Positive


@dataclasses.dataclass(frozen=True)
class _CalibrationFile:
    """The content of `calibration.json`."""

    data: int | None
    subsets: dict[str, _Subset]


def manifest(folder: Path) -> storage.Manifest | None:
    """Read the manifest of a model's folder. None before the first checkpoint."""
    listed = storage.read_manifest(folder, _remedy(folder), _Facts)
    if listed is None and any((folder / "checkpoints").glob("[0-9]*")):
        raise storage.DamagedFileError(f"{folder} has a checkpoint but no {storage.MANIFEST}: {_remedy(folder)}.")
    return listed


def verified(folder: Path) -> int | None:
    """Compare all files but the calibration with the manifest. Return the step of the checkpoint, if any."""
    listed = manifest(folder)
    step = None if listed is None else listed.facts["step"]
    if listed is not None and step is not None:
        beside = [name for name in (CONFIG, BLANK) if (folder / name).exists()]
        names = dict.fromkeys([*listed.files, *beside, *_files(folder, step)])
        storage.verify(folder, listed, _remedy(folder), [name for name in names if name != CALIBRATION])
    return step


def save(folder: Path, state: TrainState, *, compact: bool = False) -> None:
    """Write a checkpoint, then delete older checkpoints. If it fails, the previous checkpoint stays the current one.

    With several processes, all call this function with arrays of which each process has a copy. The first one writes.

    Args:
        compact: True writes one small file, in which a weight w is a 16-bit integer q, with `w = q s`. Each output
            channel of a kernel has its own step `s = max(rms / 128, largest / 32767)`. Vectors are unchanged.
    """
    step = int(state.step)
    path = folder / _place(step)
    if jax.process_index() > 0:
        return _write_orbax(path, state)
    before = manifest(folder)
    if before is None:
        before = storage.write_manifest(folder, {}, {"step": None})
    kept = before.facts["step"]
    try:
        _keep_only(folder, kept)  # deletes a checkpoint that an interrupted call may have left
        try:
            if compact:
                path.mkdir(parents=True)
                write_rounded(path / COMPACT, _plain(state))
            else:
                path.parent.mkdir(parents=True, exist_ok=True)
                _write_orbax(path, state)
        except Exception as error:  # Orbax and TensorStore raise many types, with pages of traceback
            raise OSError(
                f"cannot write {path}: {_first_line(error)}. {storage.remedy(error)}, then start again from step "
                f"{kept or 0}."
            ) from None
        beside = [name for name in (CONFIG, BLANK) if (folder / name).exists()]
        known = {name: before.files[name] for name in beside if name in before.files}
        new = [name for name in beside if name not in known] + _files(folder, step)
        facts: dict[str, Any] = {**before.facts, "step": step}
        if log := _logged(folder, before, whole=True):
            facts["log"] = {"bytes": len(log), "sha256": hashlib.sha256(log).hexdigest()}
        _flush(folder, [LOG, *new] if log else new)
        storage.write_manifest(folder, known | storage.checksums(folder, new), facts)
        kept = step
        (folder / CALIBRATION).unlink(missing_ok=True)
    finally:
        _keep_only(folder, kept)


def save_best(folder: Path, state: TrainState) -> None:
    """Write the weights to the model folder `best` in the folder of a model, with its settings, blank and split."""
    best, listed = folder / BEST, manifest(folder)
    for name in (CONFIG, BLANK) if jax.process_index() == 0 else ():
        content = (folder / name).read_bytes() if (folder / name).exists() else None
        if content is not None and not (best / name).exists():
            storage.write_bytes(best / name, content)
        elif content is not None and (best / name).read_bytes() != content:
            raise ValueError(f"{best / name} is that of another training than {folder / name}: delete {best}")
    if verified(best) == int(state.step):
        return  # written before a kill
    if jax.process_index() == 0 and manifest(best) is None:
        facts = {} if listed is None else {name: fact for name, fact in listed.facts.items() if name == "split"}
        storage.write_manifest(best, {}, {**facts, "step": None})
    save(best, state._replace(optimiser=None))


def restore(folder: Path, like: TrainState) -> TrainState | None:
    """Read the current checkpoint, if any, after comparing all files with the manifest.

    Args:
        like: State, with abstract arrays or not, of the same structure, shapes and dtypes.
    """
    step = verified(folder)
    return None if step is None else read(folder, step, like)


def read(folder: Path, step: int, like: TrainState) -> TrainState:
    """Read the checkpoint of a step in a verified folder."""
    path = folder / _place(step)
    loaded: dict[str, Array] = {}
    for part, wanted in _parts(like).items():
        try:
            if (path / COMPACT).exists():
                stored = read_rounded(path / COMPACT)
                _compare(stored, wanted)
                loaded |= jax.device_put({name: stored[name] for name in wanted})
            else:
                # Not bound to a device, so that they can be used with several
                loaded |= jax.device_put(jax.tree.map(np.asarray, _read_orbax(path, part, wanted)))
        except Exception as error:  # Orbax, TensorStore and zipfile raise many types, some with pages of traceback
            problem, remedy = "cannot be read", "It belongs to another model or version of sts_jax: train again"
            if part == OPTIMISER:
                problem, remedy = "has no state of this optimiser", "give the optimiser that the training began with"
            reason = f"{type(error).__name__}: {_first_line(error)}"
            raise ValueError(f"{path} {problem} ({reason}): {remedy}, or choose another folder.") from None
    for name in _plain(like._replace(optimiser=None)):
        if not np.isfinite(loaded[name]).all():
            raise ValueError(f"{path} has NaN or infinite weights in {name}: {_remedy(folder)}.")
    whole = [
        jax.random.wrap_key_data(loaded[name], impl=jax.random.key_impl(leaf)) if _is_key(leaf) else loaded[name]
        for name, leaf in zip(_plain(like), jax.tree.leaves(like), strict=True)
    ]
    return jax.tree.unflatten(jax.tree.structure(like), whole)


def records(folder: Path) -> list[Record]:
    """Read the training log of a model up to the current checkpoint, after comparing it with the manifest."""
    listed = manifest(folder)
    lines = [] if listed is None else _logged(folder, listed).splitlines()
    try:
        some = [storage.decode(_Record, {"terms": json.loads(line)}, "record").terms for line in lines]
        if any("step" not in record for record in some):
            raise ValueError("field record.step is missing")
    except (ValueError, RecursionError) as error:
        raise storage.DamagedFileError(f"{folder / LOG} is no training log ({error}): {_remedy(folder)}.") from None
    return some


def claim_split(folder: Path, split: Mapping[str, np.ndarray]) -> None:
    """Record the split of the dataset in the manifest of a model, or compare it with that of its training.

    Call it before the training, and before the model is scored, so that this never happens on its training data.

    Args:
        split: Indices of the objects or trajectories in each part, such as `train`.
    """
    listed = manifest(folder) or storage.Manifest({}, {"step": None})
    checksum = storage.digest({name: part.tolist() for name, part in split.items()})
    if listed.facts["step"] is None:
        storage.write_manifest(folder, listed.files, {**listed.facts, "split": checksum})
    elif listed.facts.get("split", checksum) != checksum:
        raise ValueError(
            f"{folder} was trained with another split of the dataset into training and test data: restore its "
            f"split.json, or delete {folder} and train again"
        )


def append(folder: Path, record: Record) -> None:
    """Append a record to the training log."""
    with (folder / LOG).open("a") as file:
        file.write(json.dumps(record) + "\n")


def resume_log(folder: Path) -> list[Record]:
    """Remove the records after the current checkpoint from the training log, and return the others."""
    kept = records(folder)
    listed = manifest(folder)
    storage.write_bytes(folder / LOG, b"" if listed is None else _logged(folder, listed))
    return kept


def _logged(folder: Path, listed: storage.Manifest, *, whole: bool = False) -> bytes:
    """The log up to the checkpoint of a manifest, or the whole log, compared with the manifest."""
    path, fact = folder / LOG, listed.facts.get("log") or {"bytes": 0}
    content = path.read_bytes() if path.exists() else b""
    known = content[: fact["bytes"]]
    if len(known) < fact["bytes"] or (known and hashlib.sha256(known).hexdigest() != fact["sha256"]):
        raise storage.DamagedFileError(f"{path} is not the log that {storage.MANIFEST} lists: {_remedy(folder)}.")
    return content if whole else known


@checked
def save_blank(
    folder: Path, visual: UInt8[Array | np.ndarray, "h w 3"], tactile: UInt8[Array | np.ndarray, "h w 3"]
) -> None:
    """Write the images of the empty sensor to the folder of a model. Those of a trained model cannot change."""
    if manifest(folder / BEST) is not None:
        save_blank(folder / BEST, visual, tactile)
    path, listed = folder / BLANK, manifest(folder)
    images = {"visual": np.asarray(visual), "tactile": np.asarray(tactile)}
    new = not path.exists()
    if not new and listed is not None and listed.facts["step"] is not None:
        if not all(map(np.array_equal, load_blank(folder), images.values())):
            raise ValueError(f"{folder} was trained with another empty sensor: choose another folder, or delete it")
    elif new or not _has(path, images):
        storage.write_arrays(path, images)
        new = True
    if listed is not None and (new or BLANK not in listed.files):
        storage.write_manifest(folder, {**listed.files, BLANK: storage.sha256(path)}, listed.facts)


def _has(path: Path, images: Mapping[str, np.ndarray]) -> bool:
    """Whether a file has these arrays, and is not damaged."""
    with contextlib.suppress(OSError, KeyError):
        old = storage.read_arrays(path, "")
        return all(np.array_equal(old[name], image) for name, image in images.items())
    return False


def load_blank(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the images of the empty sensor, visual and tactile, uint8 (height, width, 3), from the folder of a model."""
    path, listed = folder / BLANK, manifest(folder)
    if not path.exists():
        raise FileNotFoundError(f"{path} is missing: write it with training.save_blank.")
    if listed is not None and listed.facts["step"] is not None:
        storage.verify(folder, listed, _remedy(folder), [BLANK])
    images = storage.read_arrays(path, _remedy(folder))
    try:
        check_arrays(_Blank, images)
    except ValueError as error:
        raise storage.DamagedFileError(
            f"{path} has no images of the empty sensor ({error}): {_remedy(folder)}."
        ) from None
    return images["visual"], images["tactile"]


def save_calibration(
    folder: Path, calibration: statespace.Calibration, inputs: tuple[str, ...], data: int | None = None
) -> None:
    """Write the calibration of a model's current checkpoint.

    Args:
        inputs: Inputs of the model, `Config.inputs`.
        data: Checksum of the arrays to which it was fitted, `Arrays.checksum`. None if unknown.
    """
    listed = manifest(folder)
    if listed is None:
        raise FileNotFoundError(f"{folder} has no checkpoint to calibrate: train a model there first.")
    files = {name: checksum for name, checksum in listed.files.items() if name != CALIBRATION}
    if CALIBRATION in listed.files:  # a kill during the write must leave a valid folder
        storage.write_manifest(folder, files, listed.facts)
    subsets = {}
    for number, row in enumerate(np.asarray(calibration).T.tolist()):
        members = [name for i, name in enumerate(inputs) if number & 2**i]
        subsets[" and ".join(members) or "no input"] = dict(zip(calibration._fields, row, strict=True))
    storage.write_json(folder / CALIBRATION, {"data": data, "subsets": subsets})
    storage.write_manifest(folder, files | storage.checksums(folder, [CALIBRATION]), listed.facts)


def read_calibration(folder: Path) -> tuple[statespace.Calibration, int | None] | None:
    """Read the calibration of a model, and the checksum of the arrays to which it was fitted, if any."""
    remedy = "restore it from a copy, or calibrate again (training.calibrate)"
    listed = manifest(folder)
    if listed is None or CALIBRATION not in listed.files:
        if (folder / CALIBRATION).exists():
            warnings.warn(
                f"{folder / CALIBRATION} is not used, because {storage.MANIFEST} does not list it: it is that of "
                "another model or checkpoint. Calibrate again (training.calibrate)",
                stacklevel=3,
            )
        return None
    storage.verify(folder, listed, remedy, [CALIBRATION])
    content = storage.read_fields(_CalibrationFile, folder / CALIBRATION, remedy)
    rows = [dataclasses.astuple(row) for row in content.subsets.values()]
    return statespace.Calibration(*jnp.asarray(rows, jnp.float32).reshape(-1, 4).T), content.data


@in_32_bits
def load(workdir: str | os.PathLike[str], *, calibrated: bool = True) -> Model:
    """Load a model, after comparing its files with their checksums. A training may run in the folder meanwhile.

    Args:
        workdir: Folder of the model, the `workdir` of `train`.
        calibrated: False leaves out the calibration, and does not read its file.
    """
    workdir = Path(workdir)
    while True:
        before = manifest(workdir)
        try:
            return _load(workdir, calibrated)
        except (OSError, ValueError):
            if manifest(workdir) == before:
                raise
            # A training replaced the checkpoint while it was read. The loop reads the new one.


def _load(workdir: Path, calibrated: bool) -> Model:
    path = workdir / CONFIG
    if not path.exists():
        raise FileNotFoundError(f"{workdir} has no config.json: give the folder of a trained model")
    step = verified(workdir)
    if step is None:
        raise FileNotFoundError(f"{workdir} has no checkpoint: run its training until the first checkpoint is written")
    settings = storage.read_json(path, f"delete {workdir} and train again")
    try:
        kind = KINDS[settings["kind"]]
        config = storage.decode(kind.Config, settings["model"], "model")
        graphdef, params, stats = _abstract(kind, config)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(
            f"{path} does not describe a model that this version of sts_jax can load ({error!r}): train again"
        ) from error
    like = TrainState(params, stats, None, jnp.int32(0))
    weights = read(workdir, step, like)
    fitted = read_calibration(workdir) if calibrated else None
    if fitted and len(fitted[0].outcome) != 2 ** len(config.inputs):
        raise storage.DamagedFileError(f"{workdir / CALIBRATION} is that of other inputs: {_remedy(workdir)}.")
    state = nnx.merge_state(weights.params, weights.stats)
    return Model(config, graphdef, state, step, settings, fitted[0] if fitted else None)


@functools.cache
def _abstract(kind: Any, config: Config) -> tuple[nnx.GraphDef[Any], nnx.State, nnx.State]:
    """The result of `init` without its numbers. To trace it takes half a second."""
    return jax.eval_shape(lambda: kind.init(jax.random.key(0), config))


@in_32_bits
def calibrate(workdir: str | os.PathLike[str], arrays: Arrays) -> Model:
    """Fit the calibration of a trained state-space model, and write it to `calibration.json` in the model's

    See `statespace.fit_calibration`. If the model was calibrated on the same arrays before, nothing is fitted or
    written.

    Args:
        arrays: Trajectories of objects that the model was not trained on, from `state_arrays`.
    """
    path = Path(workdir)
    model = load(path, calibrated=False)
    if not isinstance(model.config, statespace.Config):
        raise ValueError(f"{path} has an mvae model, but only a state-space model can be calibrated")
    if model.config.stride:
        raise ValueError(f"{path} has a one-step model, whose density of a step is not calibrated: leave this out")
    check(model.config, arrays)
    checksum = arrays.checksum()
    with contextlib.suppress(storage.DamagedFileError):  # it is fitted again
        fitted = read_calibration(path)
        if fitted is not None and fitted[1] == checksum:
            return model._replace(calibration=fitted[0])
    params, _ = nnx.split_state(model.state, nnx.Param, nnx.BatchStat)
    calibration = statespace.fit_calibration(
        model.graphdef,
        params,
        arrays.inputs,
        arrays.targets,
        arrays.empty,
        present=arrays.present,
        condition=arrays.condition,
    )
    with storage.lock(path):
        listed = manifest(path)
        if listed is None or listed.facts["step"] != model.step:
            raise ValueError(f"{path} was trained on while its calibration was fitted: calibrate it again")
        save_calibration(path, calibration, model.config.inputs, checksum)
    return model._replace(calibration=calibration)


def write_rounded(path: Path, arrays: Mapping[str, ArrayLike]) -> None:
    """Write arrays to a compressed file. float32 arrays with two or more axes are rounded, see `save`."""
    stored = {}
    for name, array in arrays.items():
        stored[name] = values = np.asarray(array)
        if values.dtype != np.float32 or values.ndim < 2:
            continue
        inputs = tuple(range(values.ndim - 1))
        rms = np.sqrt(np.mean(np.square(values, dtype=np.float64), axis=inputs))
        step = np.maximum(rms / _LEVELS, np.abs(values).max(axis=inputs) / _LARGEST).astype(np.float32)
        number = np.rint(values / np.where(step == 0, 1, step)).astype(np.int32)
        # High and low bytes are stored apart, because the high bytes have few values and then compress better.
        stored[name] = np.stack([number >> 8, number & 255]).astype(np.uint8)
        stored[name + _STEP] = step
    np.savez_compressed(path, allow_pickle=False, **stored)


def read_rounded(path: Path) -> dict[str, np.ndarray]:
    """Read a file from `write_rounded`."""
    with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
        stored = dict(file)
    arrays = {name: values for name, values in stored.items() if not name.endswith(_STEP)}
    for name in arrays:
        if name + _STEP in stored:
            high, low = arrays[name].view(np.int8)[0], arrays[name][1]
            arrays[name] = (high * np.float32(256) + low) * stored[name + _STEP]
    return arrays


def _write_orbax(path: Path, state: TrainState) -> None:
    with _orbax(path) as place:
        ocp.save_checkpointables(place, {part: leaves for part, leaves in _parts(state).items() if leaves})


def _read_orbax(path: Path, part: str, wanted: dict[str, Any]) -> dict[str, Array]:
    if not wanted and not (path / part).exists():
        return {}  # an optimiser without arrays has no part of its own
    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    abstract = {name: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=device) for name, x in wanted.items()}
    context = _alone()
    context.pytree.loading.partial_load = True
    with _orbax(path) as place, context:
        # Compare the shapes first. Orbax cuts or pads arrays of another shape, or prints thousands of lines.
        stored = ocp.metadata(place, part).metadata
        _compare(stored, wanted)
        if part == OPTIMISER and stored.keys() != wanted.keys():
            extra = min(stored.keys() - wanted.keys())
            raise ValueError(f"the checkpoint has the array {extra}, which the given optimiser's state lacks")
        return ocp.load(place, abstract, checkpointable_name=part)


def _compare(stored: Mapping[str, Any], wanted: dict[str, Any]) -> None:
    for name, x in wanted.items():
        if name not in stored or (stored[name].shape, stored[name].dtype) != (x.shape, x.dtype):
            raise ValueError(f"array {name} is missing, or does not have shape {x.shape} and dtype {x.dtype}")


def _place(step: int) -> str:
    return f"checkpoints/{step:08d}"


def _files(folder: Path, step: int) -> list[str]:
    paths = sorted(path for path in (folder / _place(step)).rglob("*") if not path.is_dir())
    return [path.relative_to(folder).as_posix() for path in paths]


def _keep_only(folder: Path, step: int | None) -> None:
    """Delete all checkpoints but that of one step. Other folders are kept."""
    checkpoints = folder / "checkpoints"
    for path in checkpoints.iterdir() if checkpoints.is_dir() else ():
        is_checkpoint = path.name.split(".")[0].isdecimal()  # Orbax adds a suffix to that of an unfinished one
        if is_checkpoint and (step is None or path != folder / _place(step)):
            shutil.rmtree(path, ignore_errors=True)  # a folder that remains is ignored: the manifest does not name it


@contextlib.contextmanager
def _orbax(path: Path) -> Iterator[str]:
    """The path of a checkpoint for Orbax, without the log in which Orbax prints the tracebacks of its threads.

    Orbax takes the path for a pattern, so a path with brackets is reached through a link.
    """
    logger = logging.getLogger("absl")
    disabled, logger.disabled = logger.disabled, True
    path = path.absolute()
    with contextlib.ExitStack() as stack:
        stack.callback(setattr, logger, "disabled", disabled)
        if glob.escape(str(path)) != str(path):
            link = Path(stack.enter_context(tempfile.TemporaryDirectory()), "link")
            link.symlink_to(path.parent)
            path = link / path.name
        yield str(path)


def _alone() -> ocp.Context:
    """Options of Orbax, with which it reads without waiting for other processes."""
    context = ocp.Context()
    if jax.process_count() > 1:
        context.multiprocessing.primary_host = jax.process_index()
        context.multiprocessing.active_processes = {jax.process_index()}
        context.multiprocessing.barrier_sync_key_prefix = f"process {jax.process_index()}"
    return context


def _plain(state: TrainState) -> dict[str, Any]:
    """The arrays of a state by their paths, so that the files do not depend on the classes of Flax and optax.

    The random keys of an optimiser become the numbers that they consist of.
    """
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    return {
        jax.tree_util.keystr(path, simple=True, separator="/"): jax.random.key_data(leaf) if _is_key(leaf) else leaf
        for path, leaf in leaves
    }


def _is_key(leaf: Any) -> bool:
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _parts(state: TrainState) -> dict[str, dict[str, Any]]:
    """The arrays of a state by part of the checkpoint, then by path."""
    leaves = _plain(state)
    optimiser = {name: leaf for name, leaf in leaves.items() if name.startswith(f"{OPTIMISER}/")}
    weights = {name: leaf for name, leaf in leaves.items() if name not in optimiser}
    return {WEIGHTS: weights} if state.optimiser is None else {WEIGHTS: weights, OPTIMISER: optimiser}


def _flush(folder: Path, names: Iterable[str]) -> None:
    """Flush files to disk, so that a power failure leaves what the manifest will list."""
    paths = [folder / name for name in names]
    for path in paths:
        with path.open("rb") as file:
            os.fsync(file.fileno())
    for parent in {parent for path in paths for parent in path.parents if parent.is_relative_to(folder)}:
        storage.flush_folder(parent)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:500]


def _remedy(folder: Path) -> str:
    return f"restore it from a copy, or delete {folder} and train again"
