"""The options of a training, its default optimiser, and the training loop.

The loop is a Python loop over one compiled step, because convolutions in `lax.scan` are slow on a CPU.
"""

import collections
import concurrent.futures
import functools
import inspect
import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, PRNGKeyArray

from sts_jax import mvae, statespace, storage
from sts_jax._checked import in_32_bits
from sts_jax._ranges import COUNT, NOT_NEGATIVE, NUMBER, POSITIVE, SHARE
from sts_jax._ranges import check as check_ranges
from sts_jax.training import folder
from sts_jax.training.arrays import Arrays, Batch, Config, check, order
from sts_jax.training.devices import Devices
from sts_jax.training.folder import KINDS, Model, Record, TrainState, load
from sts_jax.training.preprocess import Preprocessing

_DECAY = NOT_NEGATIVE | {"below": 1.0}
_AHEAD = 2  # number of batches that are read ahead
Progress = Callable[[int, int, dict[str, float]], None]  # arguments: steps done, steps in total, latest record
Log = Callable[[int, dict[str, float]], None]  # arguments: step of a record, its other numbers by name
Terms = dict[str, Array]  # scalars by name: the loss and its parts

# A loss: a pure function of a model's definition, its parameters, its running batch statistics, a random key, a batch
# from `Arrays.take` with images as float32 in [0, 1], and beta, the weight of the divergence, which rises from 0 to 1.
# It returns the loss, and a pair of the new batch statistics and scalars for the training log. One must be `loss`.
Loss = Callable[
    [nnx.GraphDef[Any], nnx.State, nnx.State, PRNGKeyArray, Batch, Array], tuple[Array, tuple[nnx.State, Terms]]
]


@dataclass(frozen=True)
class TrainConfig:
    """Options of a training run."""

    steps: int | None = field(default=None, metadata=COUNT)  # gradient steps (None: as many as `epochs` needs)
    epochs: int = field(default=200, metadata=COUNT)  # passes over the training set, used if steps is None (paper: 200)
    batch_size: int = field(default=64, metadata=COUNT)  # samples in a batch (paper: 64)
    # For state-space models: first frames without a trajectory, and trajectories without images, in a batch
    views: int = field(default=16, metadata=NUMBER)
    falls: int = field(default=192, metadata=NUMBER)
    learning_rate: float = field(default=1e-3, metadata=POSITIVE)  # learning rate of Adam (not in the paper)
    schedule: Literal["constant", "cosine"] = "constant"  # course of the learning rate. cosine falls to 0 at the end
    warmup: int = field(default=0, metadata=NUMBER)  # first steps, in which the learning rate rises linearly from 0
    b1: float = field(default=0.9, metadata=_DECAY)  # Adam's decay of the mean gradient
    b2: float = field(default=0.999, metadata=_DECAY)  # Adam's decay of the mean squared gradient
    epsilon: float = field(default=1e-8, metadata=NOT_NEGATIVE)  # Adam's epsilon
    # Adam's epsilon for the encoders and the prior of an `mvae` model (nats). Adam takes steps of full length even
    # where a small beta makes the gradient of the divergence small, and the encoders then collapse during the warm-up
    # of beta. With a large epsilon, gradients far below it change the encoders little.
    encoder_epsilon: float = field(default=1.0, metadata=NOT_NEGATIVE)
    # longer gradients are scaled down to this global norm (None: not clipped)
    clip: float | None = field(default=None, metadata=POSITIVE)
    # share of the steps over which beta rises from 0 to 1 (paper: 50 of 200 epochs)
    beta_warmup: float = field(default=0.25, metadata=SHARE)
    seed: int = field(default=0, metadata=NUMBER)  # of the initial parameters, the order of the samples and the noise
    log_every: int = field(default=10, metadata=COUNT)  # steps whose mean is one record of the training log
    checkpoint_every: int = field(default=200, metadata=COUNT)  # steps, a multiple of log_every

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.checkpoint_every % self.log_every:
            raise ValueError(
                f"checkpoint_every must be a multiple of log_every ({self.log_every}), got {self.checkpoint_every}"
            )

    def total(self, samples: int) -> int:
        """The number of gradient steps for a training set of `samples` samples."""
        return self.steps if self.steps is not None else self.epochs * -(-samples // self.batch_size)


def optimiser(config: TrainConfig, total: int) -> optax.GradientTransformation:
    """Make the default optimiser for `total` steps: Adam with a learning rate schedule and gradient clipping."""
    rate: float | optax.Schedule = config.learning_rate
    if config.schedule == "cosine":
        if config.warmup >= total:
            raise ValueError(f"warmup must be smaller than the number of steps ({total}), got {config.warmup}")
        rate = optax.cosine_decay_schedule(config.learning_rate, total - config.warmup)
    if config.warmup:
        rise = optax.linear_schedule(0.0, config.learning_rate, config.warmup)
        rest = rate if callable(rate) else optax.constant_schedule(rate)
        rate = optax.join_schedules([rise, rest], [config.warmup])

    def adam(epsilon: float) -> optax.GradientTransformation:
        return optax.adam(rate, b1=config.b1, b2=config.b2, eps=epsilon)

    parts = {"encoders": adam(config.encoder_epsilon), "others": adam(config.epsilon)}
    adams = optax.partition(parts, _labels)
    return adams if config.clip is None else optax.chain(optax.clip_by_global_norm(config.clip), adams)


def _labels(params: Any) -> Any:
    paper = "decoders" in params
    return jax.tree_util.tree_map_with_path(
        lambda path, _: "encoders" if paper and path[0].key in ("encoders", "prior") else "others", params
    )


_default_optimiser = optimiser  # some functions have an argument `optimiser`


class Learner(NamedTuple):
    """The functions that train one model."""

    # Takes a random key. Returns the definition of the model, its parameters and its running batch statistics
    init: Callable[[Array], tuple[nnx.GraphDef[Any], nnx.State, nnx.State]]
    loss: Loss
    check: Callable[[Arrays], None]  # raises a ValueError if a training set does not fit the model
    score: Loss  # the loss with the running batch statistics, for validation


def learner(model: Config, *, targets: Literal["all", "own"] = "all", absent: tuple[str, ...] = ()) -> Learner:
    """Make the learner of a model, with the loss `mvae.loss` or `statespace.loss`. Other arguments as for `train`."""

    package = mvae if isinstance(model, mvae.Config) else statespace

    def loss(
        graphdef: nnx.GraphDef[Any],
        params: nnx.State,
        stats: nnx.State,
        key: PRNGKeyArray,
        batch: Batch,
        beta: Array,
        *,
        training: bool = True,
    ) -> tuple[Array, tuple[nnx.State, Terms]]:
        if package is mvae:
            batch = {name: value for name, value in batch.items() if name != "empty"}
            total, (stats, terms) = mvae.loss(
                graphdef, params, stats, key, **batch, beta=beta, asked=targets, absent=absent, training=training
            )
            return total, (stats, {"loss": terms.loss, "kl": terms.kl, **terms.reconstruction})
        batch = {name: value for name, value in batch.items() if name != "target_present"}
        total, parts = statespace.loss(graphdef, params, key, **batch, beta=beta)
        return total, (stats, {"loss": total, **parts})

    suits, score = functools.partial(check, model, absent=absent), functools.partial(loss, training=False)
    return Learner(lambda key: package.init(key, model), loss, suits, score)


@in_32_bits
def initial(
    config: TrainConfig, learner: Learner, total: int, optimiser: optax.GradientTransformation | None = None
) -> tuple[nnx.GraphDef[Any], TrainState]:
    """Initialise a model and the state of its training from `config.seed`. Other arguments as for `step`."""
    graphdef, params, stats = learner.init(jax.random.key(config.seed))
    optimiser = optimiser or _default_optimiser(config, total)
    # Without `jit`, JAX would compile a program for each shape of a parameter.
    return graphdef, TrainState(params, stats, jax.jit(optimiser.init)(params), jnp.zeros((), jnp.int32))


@in_32_bits
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
        total: Number of steps of the whole training, for the schedules of the learning rate and of beta.
        batch: Arrays of the batch, from `Arrays.take`. uint8 images are converted to float32 in [0, 1].
        optimiser: Optimiser that made `state` (default: the optimiser from `training.optimiser`).

    Returns:
        The new state, and the parts of the loss with the parameters before the step.
    """
    batch = _floats(batch)
    # The second key is unused. Without the split, the noise would differ from that of the published results.
    noise, _ = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), state.step))
    warmup = max(config.beta_warmup * total, 1)
    beta = jnp.minimum(state.step.astype(jnp.float32) / warmup, 1)

    def objective(params: nnx.State) -> tuple[Array, tuple[nnx.State, Terms]]:
        return learner.loss(graphdef, params, state.stats, noise, batch, beta)

    gradient, (stats, terms) = jax.grad(objective, has_aux=True)(state.params)
    if "loss" not in terms:
        raise ValueError(f"the loss function returned the parts {sorted(terms)}, but one must have the name 'loss'")
    optimiser = optimiser or _default_optimiser(config, total)
    update, rest = optimiser.update(gradient, state.optimiser, state.params)
    return TrainState(optax.apply_updates(state.params, update), stats, rest, state.step + 1), terms


def _floats(batch: Batch) -> Batch:
    """Convert uint8 images to float32 in [0, 1]."""
    floats: Batch = jax.tree.map(lambda x: x.astype(jnp.float32) / 255 if x.dtype == jnp.uint8 else x, batch)
    return floats


@in_32_bits
def train(
    config: TrainConfig,
    model: Config,
    arrays: Arrays,
    *,
    workdir: str | os.PathLike[str],
    validation: Arrays | None = None,
    absent: tuple[str, ...] = (),
    targets: Literal["all", "own"] = "all",
    preprocessing: dict[str, Any] | None = None,
    loss: Loss | None = None,
    optimiser: optax.GradientTransformation | None = None,
    notes: dict[str, Any] | None = None,
    devices: Sequence[jax.Device] | None = None,
    progress: Progress | None = None,
    log: Log | None = None,
) -> Model:
    """Train a model in the folder `workdir`, or resume its training where an earlier call stopped.

    On the CPU of one machine, a training that was killed and resumed ends with the same bits as an uninterrupted one. A
    GPU adds in no fixed order, unless XLA_FLAGS has `--xla_gpu_deterministic_ops=true`. If the training in `workdir`
    has finished, the model is loaded and nothing is written. Only one process at a time can train in a folder. A folder
    with other settings, data or optimiser is refused.

    Args:
        workdir: Folder of the model, see `sts_jax.training.folder` for its files.
        validation: Samples whose loss is computed at each checkpoint, with beta = 1, running batch statistics and the
            same noise each time. It is the number `validation` of the log, and the weights with the least one are kept
            in `workdir/best`, a model folder. Its `views` and `falls` are not used. `calibrate` works on each folder.
        absent: For `mvae` models: names of modalities that are not inputs of any sample, and not in `arrays.inputs`.
        targets: For `mvae` models: modalities to predict from each subset of the inputs, every modality (`all`) or only
            those in the subset (`own`).
        preprocessing: JSON values that describe how images and vectors were made, such as `dataclasses.asdict(p)` of a
            `Preprocessing` p. They are stored in `config.json`.
        loss: Replaces the loss from `training.learner`, also for `validation`: with `training=False`, as that loss has
            it, if it has this argument. `targets` and `absent` are not passed to it.
        optimiser: Replaces the optimiser from `training.optimiser` and its fields of `config`.
        notes: JSON values that name the given loss and optimiser, stored in `config.json`. A resumed training must have
            the same notes, because the functions themselves cannot be compared.
        devices: Devices over which each batch is split. None: all devices, of all processes of `jax.distributed`. Then
            every process calls `train` with the same arguments. The first one writes the folder, and all read it.
        progress: Function that is called after every step with the number of steps done, the number of all steps,
            and the latest record of `metrics.jsonl` (empty before the first record).
        log: Function that is called once for each record, with the step and the values of the record. A resumed
            training first calls it with the records of earlier calls of `train`.

    Raises:
        FloatingPointError: The loss is not finite.
    """
    workdir = Path(workdir)
    total = config.total(len(arrays))
    further = {name: getattr(config, name) for name in ("views", "falls") if getattr(arrays, name)}
    over = Devices.of(devices, batch_size=config.batch_size, **further)
    task = learner(model, targets=targets, absent=absent)
    task.check(arrays)
    if loss is not None:
        can_score = "training" in inspect.signature(loss).parameters
        score: Any = functools.partial(loss, training=False) if can_score else loss  # type: ignore[call-arg]
        task = task._replace(loss=loss, score=score)
    settings: dict[str, Any] = {
        "kind": next(name for name, kind in KINDS.items() if isinstance(model, kind.Config)),
        "model": asdict(model),
        "training": asdict(config),
        "targets": targets,
        "absent": list(absent),
        "data": {"samples": len(arrays), "checksum": arrays.checksum()},
        "preprocessing": preprocessing or {},
    }
    if validation is not None:
        _check_validation(model, validation)
        settings["data"]["validation"] = {"samples": len(validation), "checksum": validation.checksum()}
    for name, function in (("loss", loss), ("optimiser", optimiser)):
        if function is not None:
            settings[name] = f"given as {name}="
    if notes:
        settings["notes"] = notes
    settings = json.loads(json.dumps(settings))
    groups = {"model": model, "training": config, "preprocessing": Preprocessing()}
    defaults = {name: storage.default_fields(group) for name, group in groups.items()}
    step_done = folder.verified(workdir)
    over.agree(settings=settings, step=step_done)
    if step_done == total:  # without a lock, because a lock would write a file
        storage.claim(workdir / folder.CONFIG, settings, defaults)
        _send(folder.records(workdir), log)
        return load(workdir, calibrated=False)
    with over.lock(workdir):
        if over.leads:
            storage.claim(workdir / folder.CONFIG, settings, defaults)
        optimiser = optimiser or _default_optimiser(config, total)
        graphdef, state = initial(config, task, total, optimiser)
        state = over.copies(folder.restore(workdir, state) or state)
        form = jax.tree.structure(state)

        def advance(leaves: list[Array], batch: Batch) -> tuple[list[Array], Terms]:
            """`step` on the arrays of a state: to pass an `nnx.State` to a compiled function takes 10 ms."""
            after, terms = step(task, graphdef, config, total, jax.tree.unflatten(form, leaves), batch, optimiser)
            return jax.tree.leaves(after), terms

        take = jax.jit(advance, donate_argnums=0, out_shardings=over.everywhere)
        score = None if validation is None else _scorer(config, task, graphdef, validation, over)
        state = over.one(_run(config, arrays, workdir, state, over, take, score, progress, log))
        over.wait("end of the training")
    return Model(model, graphdef, nnx.merge_state(state.params, state.stats), int(state.step), settings)


def _run(
    config: TrainConfig,
    arrays: Arrays,
    workdir: Path,
    state: TrainState,
    over: Devices,
    take: Callable[[list[Array], Batch], tuple[list[Array], Terms]],
    score: Callable[[TrainState], float] | None,
    progress: Progress | None,
    log: Log | None,
) -> TrainState:
    """Make the remaining steps, with a record every `log_every` and a checkpoint every `checkpoint_every` steps."""
    start, total = int(state.step), config.total(len(arrays))
    kept = folder.resume_log(workdir) if over.leads else folder.records(workdir)
    _send(kept, log)
    record = kept[-1] if kept else {}
    least = min((each["validation"] for each in kept if "validation" in each), default=np.inf)
    recent: list[Terms] = []
    batches = _batches(config, arrays, start, total, over)
    leaves, form = jax.tree.flatten(state)
    for done in range(start + 1, total + 1):
        leaves, terms = take(leaves, next(batches))
        recent.append(jax.block_until_ready(terms))
        at_checkpoint = done % config.checkpoint_every == 0 or done == total
        if at_checkpoint:
            state = jax.tree.unflatten(form, leaves)
        if done % config.log_every == 0 or done == total:
            record = {"step": done, **jax.tree.map(lambda *x: float(np.mean(x)), *recent)}
            if score is not None and at_checkpoint:
                record["validation"] = score(state)
            recent = []
            if over.leads:
                folder.append(workdir, record)
            _send([record], log)
            if not np.isfinite(record["loss"]):
                raise FloatingPointError(
                    f"{workdir}: the loss is {record['loss']} at step {done}: lower TrainConfig.learning_rate (now "
                    f"{config.learning_rate}) or TrainConfig.clip (now {config.clip}), or change your own optimiser."
                )
            if not np.isfinite(record.get("validation", 0.0)):
                raise FloatingPointError(
                    f"{workdir}: the validation loss is {record['validation']} at step {done}: mask values of "
                    "`validation` that are not finite with its field `present`, or lower TrainConfig.learning_rate."
                )
        if at_checkpoint:
            if record.get("validation", np.inf) < least:
                least = record["validation"]
                folder.save_best(workdir, over.whole(state))  # before the checkpoint: a resumed training finds it
            folder.save(workdir, over.whole(state))
        if progress is not None:
            progress(done, total, record)
    return state


def _batches(config: TrainConfig, arrays: Arrays, start: int, total: int, over: Devices) -> Iterator[Batch]:
    further = {
        name: order(config.seed + 1, len(values["state"]), size, start, total)
        for name, values, size in (("views", arrays.views, config.views), ("falls", arrays.falls, config.falls))
        if values and size
    }
    rows = zip(order(config.seed, len(arrays), config.batch_size, start, total), *further.values(), strict=True)
    return _read_ahead(arrays, ((first, dict(zip(further, more, strict=True))) for first, *more in rows), over)


def _read_ahead(
    arrays: Arrays, chosen: Iterable[tuple[np.ndarray, dict[str, np.ndarray]]], over: Devices
) -> Iterator[Batch]:
    """Take batches in a thread, while the device computes. `chosen` has the arguments of `Arrays.take`."""
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        waiting: collections.deque[concurrent.futures.Future[Batch]] = collections.deque()
        for index, further in chosen:
            waiting.append(pool.submit(over.take, arrays, index, further))
            if len(waiting) > _AHEAD:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _scorer(
    config: TrainConfig, task: Learner, graphdef: nnx.GraphDef[Any], validation: Arrays, over: Devices
) -> Callable[[TrainState], float]:
    """A function that computes the validation loss of a state."""
    starts = range(0, len(validation), config.batch_size)
    rows = [np.arange(start, min(start + config.batch_size, len(validation))) for start in starts]

    @jax.jit
    def loss(params: nnx.State, stats: nnx.State, key: PRNGKeyArray, batch: Batch) -> Array:
        return task.score(graphdef, params, stats, key, _floats(batch), jnp.ones(()))[0]

    def score(state: TrainState) -> float:
        keys = jax.random.split(jax.random.key(config.seed), len(rows))
        batches = _read_ahead(validation, ((index, {}) for index in rows), over)
        values = [float(loss(state.params, state.stats, *both)) for both in zip(keys, batches, strict=True)]
        return float(np.average(values, weights=[len(index) for index in rows]))

    return score


def _check_validation(model: Config, validation: Arrays) -> None:
    """Raise a ValueError if a validation set does not fit a model. It may lack an input, such as the first touch."""
    names = model.names if isinstance(model, mvae.Config) else ()
    try:
        check(model, validation, tuple(name for name in names if name not in validation.inputs))
    except ValueError as error:
        raise ValueError(f"`validation` does not fit the model: {error}") from None


def _send(some: list[Record], log: Log | None) -> None:
    if log is not None:
        for record in some:
            log(int(record["step"]), {name: value for name, value in record.items() if name != "step"})
