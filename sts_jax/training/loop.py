"""The training loop.

It is a Python loop over one compiled step, because convolutions in `lax.scan` are slow on a CPU.
"""

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array

from sts_jax import storage
from sts_jax.training import manifest, optimisers, records
from sts_jax.training.arrays import Arrays, Batch, order
from sts_jax.training.checkpoint import TrainState, restore, save
from sts_jax.training.config import TrainConfig
from sts_jax.training.learners import Config, Learner, Loss, Terms, learner
from sts_jax.training.model import KINDS, Model, load

Progress = Callable[[int, int, dict[str, float]], None]  # arguments: steps done, steps in total, latest record
Log = Callable[[int, dict[str, float]], None]  # arguments: step of a record, its other numbers by name
_LABELS = ("model.outcome_names",)  # fields that the config.json of an older version may lack


def initial(
    config: TrainConfig, learner: Learner, total: int, optimiser: optax.GradientTransformation | None = None
) -> tuple[nnx.GraphDef[Any], TrainState]:
    """Initialise a model and the state of its training from `config.seed`.

    Args:
        config: Options of the training.
        learner: Initialisation and loss of the model, from `training.learner`.
        total: Number of steps of the whole training, which the default optimiser needs for its learning rate schedule.
        optimiser: Optimiser (default: the optimiser from `training.optimiser`).

    Returns:
        The definition of the model, and the state before the first step.
    """
    graphdef, params, stats = learner.init(jax.random.key(config.seed))
    optimiser = optimiser or optimisers.optimiser(config, total)
    # Without `jit`, JAX would compile a program for each shape of a parameter.
    return graphdef, TrainState(params, stats, jax.jit(optimiser.init)(params), jnp.zeros((), jnp.int32))


def step(
    learner: Learner,
    graphdef: nnx.GraphDef[Any],
    config: TrainConfig,
    total: int,
    state: TrainState,
    batch: Batch,
    optimiser: optax.GradientTransformation | None = None,
) -> tuple[TrainState, Terms]:
    """Make one gradient step.

    Args:
        learner: Loss of the model, from `training.learner`.
        graphdef: Definition of the model.
        config: Options of the training.
        total: Number of steps of the whole training. The schedule of the learning rate and the warm-up of beta
            depend on this number. beta is the weight of the divergence in the loss.
        state: State before the step.
        batch: Arrays of the batch, from `Arrays.take`. uint8 images are converted to float32 in [0, 1].
        optimiser: Optimiser that made `state` (default: the optimiser from `training.optimiser`).

    Returns:
        Two values, the new state and the parts of the loss. The new state has the structure and the dtypes of `state`.
        The loss is computed with the parameters before the step.

    Raises:
        ValueError: The loss function returns no part with the name `loss`.
    """
    batch = jax.tree.map(lambda x: x.astype(jnp.float32) / 255 if x.dtype == jnp.uint8 else x, batch)
    # The second key is unused. Without the split, the noise would differ from that of the published results.
    noise, _ = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), state.step))
    warmup = max(config.beta_warmup * total, 1)
    beta = jnp.minimum(state.step.astype(jnp.float32) / warmup, 1)

    def objective(params: nnx.State) -> tuple[Array, tuple[nnx.State, Terms]]:
        return learner.loss(graphdef, params, state.stats, noise, batch, beta)

    gradient, (stats, terms) = jax.grad(objective, has_aux=True)(state.params)
    if "loss" not in terms:
        raise ValueError(
            f"the loss function returned the parts {sorted(terms)}, but one part must have the name 'loss': add it, "
            "see training.Loss"
        )
    optimiser = optimiser or optimisers.optimiser(config, total)
    update, rest = optimiser.update(gradient, state.optimiser, state.params)
    return TrainState(optax.apply_updates(state.params, update), stats, rest, state.step + 1), terms


def train(
    config: TrainConfig,
    model: Config,
    arrays: Arrays,
    *,
    workdir: str | os.PathLike[str],
    absent: tuple[str, ...] = (),
    targets: Literal["all", "own"] = "all",
    preprocessing: dict[str, Any] | None = None,
    loss: Loss | None = None,
    optimiser: optax.GradientTransformation | None = None,
    notes: dict[str, Any] | None = None,
    progress: Progress | None = None,
    log: Log | None = None,
) -> Model:
    """Train a model in the folder `workdir`, or resume its training where an earlier call stopped.

    On one machine, a training that was killed and resumed ends with the same bits as an uninterrupted training. If the
    training in `workdir` has finished, the model is loaded and nothing is written. Files in `workdir` that do not
    belong to the training are not changed. Only one process at a time can train in a folder.

    Args:
        config: Options of the training.
        model: Configuration of the model.
        arrays: Training set.
        workdir: Folder of the model, for `config.json`, `metrics.jsonl`, `checkpoints/` and `manifest.json`.
        absent: For `mvae` models: names of modalities that are not inputs of any sample. `arrays.inputs` need not have
            them.
        targets: For `mvae` models: modalities to predict from each subset of the inputs. `all` means every modality.
            `own` means only the modalities in the subset.
        preprocessing: JSON values that describe how images and vectors were made, such as `dataclasses.asdict(p)` of a
            `Preprocessing` p. They are stored in `config.json`.
        loss: Loss that replaces the loss from `training.learner`, or None. `targets` and `absent` are not passed to the
            given loss.
        optimiser: Optimiser that replaces Adam (the optimiser from `training.optimiser`), or None. If an
            optimiser is given, the fields of `config` that define Adam, the learning rate and the clipping have no
            effect.
        notes: JSON values that name the given loss and optimiser. They are stored in `config.json`. A resumed training
            must have the same notes, because the functions themselves cannot be compared.
        progress: Function that is called after every step with the number of steps done, the number of all steps,
            and the latest record of `metrics.jsonl` (empty before the first record).
        log: Function that is called once for each record, with the step and the values of the record. When a training
            is resumed, `log` is first called with the records from earlier calls of `train`. In every call of `train`,
            `log` therefore receives all records of the training, in order.

    Returns:
        The trained model.

    Raises:
        ValueError: The training in `workdir` has other settings, other data or another optimiser. Also raised if
            `workdir` has a checkpoint but no `manifest.json`, or if the names, shapes or values of `arrays` do not fit
            the model.
        OSError: A file in `workdir` is damaged or cannot be written.
        LockedError: Another process trains in `workdir`.
        FloatingPointError: The loss is not finite.
    """
    workdir = Path(workdir)
    total = config.total(len(arrays))
    task = learner(model, targets=targets, absent=absent)
    task.check(arrays)
    if loss is not None:
        task = task._replace(loss=loss)
    settings = {
        "kind": next(name for name, kind in KINDS.items() if isinstance(model, kind)),
        "model": model.to_json(),
        "training": asdict(config),
        "targets": targets,
        "absent": list(absent),
        "data": {"samples": len(arrays), "checksum": arrays.checksum()},
        "preprocessing": preprocessing or {},
    }
    for name, function in (("loss", loss), ("optimiser", optimiser)):
        if function is not None:
            settings[name] = f"given as {name}="
    if notes:
        settings["notes"] = notes
    settings = json.loads(json.dumps(settings))
    there = manifest.read(workdir)
    if there is not None and there.step == total:  # without a lock, because a lock would write a file
        storage.claim(workdir / "config.json", settings, labels=_LABELS)
        _send(records.read(workdir / records.NAME, total), log)
        return load(workdir)
    with storage.lock(workdir):
        storage.claim(workdir / "config.json", settings, labels=_LABELS)
        optimiser = optimiser or optimisers.optimiser(config, total)
        graphdef, state = initial(config, task, total, optimiser)
        state = restore(workdir, state) or state
        take = jax.jit(
            lambda state, batch: step(task, graphdef, config, total, state, batch, optimiser), donate_argnums=0
        )
        state = _run(config, arrays, workdir, state, take, progress, log)
    return Model(model, graphdef, nnx.merge_state(state.params, state.stats), int(state.step), settings)


def _run(
    config: TrainConfig,
    arrays: Arrays,
    workdir: Path,
    state: TrainState,
    take: Callable[[TrainState, Batch], tuple[TrainState, Terms]],
    progress: Progress | None,
    log: Log | None,
) -> TrainState:
    """Make the remaining steps, with a record every `log_every` and a checkpoint every `checkpoint_every` steps."""
    start, total, path = int(state.step), config.total(len(arrays)), workdir / records.NAME
    kept = records.read(path, start)
    records.write(path, kept)  # without the records after the checkpoint, which the steps below write again
    _send(kept, log)
    record = kept[-1] if kept else {}
    recent: list[Terms] = []
    batches = _batches(config, arrays, start, total)
    batch = next(batches, {})
    for done in range(start + 1, total + 1):
        state, terms = take(state, batch)
        batch = next(batches, {})  # while the device computes the step
        recent.append(jax.block_until_ready(terms))
        if done % config.log_every == 0 or done == total:
            record = records.mean(done, recent)
            recent = []
            records.append(path, record)
            _send([record], log)
            if not np.isfinite(record["loss"]):
                raise FloatingPointError(
                    f"{workdir}: the loss is {record['loss']} at step {done}: lower TrainConfig.learning_rate (now "
                    f"{config.learning_rate}), or {'set' if config.clip is None else 'lower'} TrainConfig.clip (now "
                    f"{config.clip}). If you gave an optimiser, change that optimiser instead, because it does not use "
                    "these two options"
                )
        if done % config.checkpoint_every == 0 or done == total:
            save(workdir, state)
        if progress is not None:
            progress(done, total, record)
    return state


def _batches(config: TrainConfig, arrays: Arrays, start: int, total: int) -> Iterator[Batch]:
    """Iterate over the batches of the steps after step `start`."""
    further = {
        name: order(config.seed + 1, len(own["state"]), size, start, total)
        for name, own, size in (("views", arrays.views, config.views), ("falls", arrays.falls, config.falls))
        if own and size
    }
    for index in order(config.seed, len(arrays), config.batch_size, start, total):
        yield arrays.take(index, **{name: next(rows) for name, rows in further.items()})


def _send(some: list[records.Record], log: Log | None) -> None:
    """Call `log` with each record."""
    if log is not None:
        for record in some:
            log(int(record["step"]), {name: value for name, value in record.items() if name != "step"})
