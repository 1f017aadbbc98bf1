"""The training loop: a Python loop over one compiled step, because convolutions in `lax.scan` are slow on a CPU."""

import contextlib
import json
import os
import zlib
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, PRNGKeyArray

from sts_jax import _files, mvae, statespace
from sts_jax.training import manifest
from sts_jax.training.checkpoint import TrainState, Weights, read, restore, save, verified

Batch = dict[str, Any]  # dictionaries by name as in `Arrays`, and `condition`, an array or None
Config = mvae.Config | statespace.Config  # of either kind of model
Terms = dict[str, Array]  # the parts of a loss


@dataclass(frozen=True)
class TrainConfig:
    """Options of a training run."""

    steps: int | None = None  # gradient steps (None: as many as `epochs` need)
    epochs: int = 200  # paper
    batch_size: int = 64  # paper
    # State-space models: views (first moments without a last one) and falls (trajectories without images) in a batch,
    # if the data has some
    views: int = 16
    falls: int = 96
    learning_rate: float = 1e-3  # not in the paper
    schedule: Literal["constant", "cosine"] = "constant"  # cosine ends at 0
    warmup: int = 0  # steps over which the learning rate rises from 0
    b1: float = 0.9  # Adam
    b2: float = 0.999
    epsilon: float = 1e-8
    # Adam's epsilon for the encoders of an `mvae` model (nats). Adam takes steps of full length even if a small beta
    # makes the gradient of the divergence small, so that encoders collapse during the warm-up. Gradients far below this
    # epsilon move them little.
    encoder_epsilon: float = 1.0
    clip: float | None = None  # largest global norm of the gradient
    beta_warmup: float = 0.25  # share of the steps over which beta goes from 0 to 1 (paper: 50 of 200 epochs)
    seed: int = 0
    log_every: int = 10  # steps per record, which is their mean
    checkpoint_every: int = 200  # steps, a multiple of log_every

    def __post_init__(self) -> None:
        if self.checkpoint_every % self.log_every:
            raise ValueError(f"checkpoint_every={self.checkpoint_every} is no multiple of log_every={self.log_every}")
        if self.schedule not in ("constant", "cosine"):
            raise ValueError(f"schedule must be 'constant' or 'cosine', got {self.schedule!r}")

    def total(self, samples: int) -> int:
        """Number of gradient steps for a dataset of `samples` samples."""
        return self.steps if self.steps is not None else self.epochs * -(-samples // self.batch_size)


@dataclass(frozen=True)
class Arrays:
    """A dataset in memory: arrays `(samples, *shape)` by modality. Images are uint8, or float32 in [0, 1]."""

    inputs: dict[str, np.ndarray]
    targets: dict[str, np.ndarray]  # for state-space models also the codes `state` and `pose`, and the index `outcome`
    present: dict[str, np.ndarray] = field(default_factory=dict)  # (samples,) bool, True if not given
    target_present: dict[str, np.ndarray] = field(default_factory=dict)
    condition: np.ndarray | None = None  # (samples, condition)
    empty: dict[str, np.ndarray] = field(default_factory=dict)  # images of the untouched sensor, for state-space models
    # For state-space models: first moments without a last one, `visual` and the code `state`, (views, *shape)
    views: dict[str, np.ndarray] = field(default_factory=dict)
    # For state-space models: trajectories without images, with the codes `state` and `pose`, `outcome`, and `condition`
    # if the model has one
    falls: dict[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        sizes = {len(x) for x in jax.tree.leaves(self._tree())}
        if len(sizes) != 1 or 0 in sizes:
            raise ValueError(f"arrays have {sorted(sizes)} samples, but all must have the same number, at least one")

    def __len__(self) -> int:
        return len(next(iter(self.targets.values())))

    def take(self, index: np.ndarray, **further: np.ndarray) -> Batch:
        """The batch of samples `index`, and of the given rows of `views` and `falls`."""
        batch = jax.tree.map(lambda x: x[index], self._tree()) | {"empty": self.empty}
        return batch | {name: {k: x[rows] for k, x in getattr(self, name).items()} for name, rows in further.items()}

    def checksum(self) -> int:
        """CRC-32 of the names, shapes, types and values of all arrays."""
        value = 0
        further = {"empty": self.empty, "views": self.views, "falls": self.falls}
        for path, x in jax.tree_util.tree_leaves_with_path(self._tree() | further):
            value = zlib.crc32(f"{path}{x.shape}{x.dtype}".encode(), value)
            value = zlib.crc32(np.ascontiguousarray(x).data, value)
        return value

    def _tree(self) -> Batch:
        return {name: getattr(self, name) for name in ("inputs", "targets", "present", "target_present", "condition")}


_KINDS: dict[type[Config], str] = {mvae.Config: "mvae", statespace.Config: "statespace"}  # `kind` in `config.json`


class Model(NamedTuple):
    """A trained model. `mvae.predict` and `statespace.sample` take its `graphdef` and `state`."""

    config: Config
    graphdef: nnx.GraphDef[Any]
    state: nnx.State  # parameters and running batch statistics
    step: int  # gradient steps done
    settings: dict[str, Any]  # content of config.json: `model`, `training`, `preprocessing`, ...

    def __repr__(self) -> str:
        config, numbers = self.config, sum(x.size for x in jax.tree.leaves(self.state))
        if isinstance(config, mvae.Config):
            made = ", ".join(f"{m.name} {m.kind} {m.shape}" for m in config.modalities) + f"; latent={config.latent}"
        else:
            made = f"{', '.join(config.inputs)}; look={config.look}, outcomes={config.outcomes}"
        return f"Model({made}, condition={config.condition}, {numbers:,} numbers, step={self.step})"


class Learner(NamedTuple):
    """Initialisation and loss of one kind of model."""

    config: Config
    init: Callable[[Array], tuple[nnx.GraphDef[Any], nnx.State, nnx.State]]
    loss: "_Loss"
    check: Callable[[Arrays], None]  # raises ValueError for arrays that do not fit


class _Loss(Protocol):
    def __call__(
        self,
        graphdef: nnx.GraphDef[Any],
        params: nnx.State,
        stats: nnx.State,
        key: PRNGKeyArray,
        batch: Batch,
        beta: Array,
    ) -> tuple[Array, tuple[nnx.State, Terms]]: ...


def learner(model: Config, *, targets: Literal["all", "own"] = "all", absent: tuple[str, ...] = ()) -> Learner:
    """The learner of a model.

    Args:
        model: the configuration of the model.
        targets: for `mvae` models, the argument `asked` of `mvae.loss`.
        absent: for `mvae` models, the argument `absent` of `mvae.loss`.
    """

    def paper_loss(
        graphdef: nnx.GraphDef[Any], params: nnx.State, stats: nnx.State, key: PRNGKeyArray, batch: Batch, beta: Array
    ) -> tuple[Array, tuple[nnx.State, Terms]]:
        own = {name: value for name, value in batch.items() if name != "empty"}
        total, (stats, terms) = mvae.loss(graphdef, params, stats, key, **own, beta=beta, asked=targets, absent=absent)
        return total, (stats, {"loss": terms.loss, "kl": terms.kl, **terms.reconstruction})

    def state_loss(
        graphdef: nnx.GraphDef[Any], params: nnx.State, stats: nnx.State, key: PRNGKeyArray, batch: Batch, beta: Array
    ) -> tuple[Array, tuple[nnx.State, Terms]]:
        own = {name: value for name, value in batch.items() if name != "target_present"}
        total, terms = statespace.loss(graphdef, params, key, **own, beta=beta)
        return total, (stats, {"loss": total, **terms})

    if isinstance(model, mvae.Config):
        return Learner(
            model,
            lambda key: mvae.init(key, model),
            paper_loss,
            lambda arrays: _check_paper(model, arrays, absent),
        )
    return Learner(
        model, lambda key: statespace.init(key, model), state_loss, lambda arrays: _check_state(model, arrays)
    )


def optimiser(config: TrainConfig, total: int) -> optax.GradientTransformation:
    """Adam as configured, with `encoder_epsilon` for the encoders of an `mvae` model."""
    rate: float | optax.Schedule = config.learning_rate
    if config.schedule == "cosine":
        rate = optax.cosine_decay_schedule(config.learning_rate, total - config.warmup)
    if config.warmup:
        rise = optax.linear_schedule(0.0, config.learning_rate, config.warmup)
        rest = rate if callable(rate) else optax.constant_schedule(rate)
        rate = optax.join_schedules([rise, rest], [config.warmup])

    def adam(epsilon: float) -> optax.GradientTransformation:
        return optax.adam(rate, b1=config.b1, b2=config.b2, eps=epsilon)

    parts = {"encoders": adam(config.encoder_epsilon), "others": adam(config.epsilon)}
    adams = optax.partition(parts, _kinds)
    return adams if config.clip is None else optax.chain(optax.clip_by_global_norm(config.clip), adams)


def _kinds(params: Any) -> Any:
    """The label `encoders` for the encoders of an `mvae` model, and `others` for all other parameters."""
    paper = "decoders" in params
    return jax.tree_util.tree_map_with_path(
        lambda path, _: "encoders" if paper and path[0].key == "encoders" else "others", params
    )


def initial(config: TrainConfig, learner: Learner, total: int) -> tuple[nnx.GraphDef[Any], TrainState]:
    """Initialise a model and its training state from `config.seed`."""
    graphdef, params, stats = learner.init(jax.random.key(config.seed))
    return graphdef, TrainState(params, stats, optimiser(config, total).init(params), jnp.zeros((), jnp.int32))


def step(
    learner: Learner,
    graphdef: nnx.GraphDef[Any],
    config: TrainConfig,
    total: int,
    state: TrainState,
    batch: Batch,
) -> tuple[TrainState, Terms]:
    """Take one gradient step. The state keeps its structure and dtypes.

    Args:
        learner: the loss.
        graphdef: definition of the model.
        config: options of the training run.
        total: steps of the whole run, which determine beta and the learning rate.
        state: the state before the step.
        batch: from `Arrays.take`. Images in uint8 become float32 in [0, 1] here.

    Returns:
        The state after the step, and the parts of the loss before it.
    """
    batch = jax.tree.map(lambda x: x.astype(jnp.float32) / 255 if x.dtype == jnp.uint8 else x, batch)
    # Half of the split is unused. Another stream would be as good, but the published results were made with this one.
    noise, _ = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), state.step))
    warmup = max(config.beta_warmup * total, 1)
    beta = jnp.minimum(state.step.astype(jnp.float32) / warmup, 1)

    def objective(params: nnx.State) -> tuple[Array, tuple[nnx.State, Terms]]:
        return learner.loss(graphdef, params, state.stats, noise, batch, beta)

    gradient, (stats, terms) = jax.grad(objective, has_aux=True)(state.params)
    update, rest = optimiser(config, total).update(gradient, state.optimiser, state.params)
    return TrainState(optax.apply_updates(state.params, update), stats, rest, state.step + 1), terms


def order(seed: int, samples: int, batch_size: int, start: int, stop: int) -> Iterator[np.ndarray]:
    """Indices of the samples of batches `start` to `stop - 1`, a function of the seed and the step alone.

    Each epoch has a permutation of the samples, and a batch may straddle two epochs. Every sample is seen once per
    epoch and none is dropped.
    """
    permutations: dict[int, np.ndarray] = {}
    for number in range(start, stop):
        epoch, place = np.divmod(np.arange(number * batch_size, (number + 1) * batch_size), samples)
        permutations = {
            e: permutations.get(e, np.random.default_rng([seed, e]).permutation(samples)) for e in np.unique(epoch)
        }
        yield np.array([permutations[e][p] for e, p in zip(epoch, place, strict=True)])


def train(
    config: TrainConfig,
    model: Config,
    arrays: Arrays,
    *,
    workdir: str | os.PathLike[str],
    absent: tuple[str, ...] = (),
    targets: Literal["all", "own"] = "all",
    preprocessing: dict[str, Any] | None = None,
    progress: Callable[[int, int, dict[str, float]], None] | None = None,
) -> Model:
    """Train a model in `workdir`, or resume where an earlier call stopped.

    On one machine, a run that was killed and resumed gives the same parameters, to the last bit, as an uninterrupted
    one. A finished run is only read. Other entries in `workdir` are not changed. One process at a time can train in a
    folder.

    Args:
        config: options of the training run.
        model: configuration of the model.
        arrays: the training set.
        workdir: the model's folder, for `config.json`, `metrics.jsonl`, `checkpoints/` and `manifest.json`.
        absent: for `mvae` models, modalities that no sample has. `arrays.inputs` may lack them.
        targets: for `mvae` models, `all` or `own`, see `mvae.loss`.
        preprocessing: plain values for `config.json` that describe how images and vectors were made.
        progress: called after every step with the steps done, their total, and the latest record of
            `metrics.jsonl` (empty before the first).

    Returns:
        The trained model.

    Raises:
        ValueError: `workdir` was made with other settings or data, or holds a checkpoint without a manifest, or the
            arrays contradict `absent` or lack a modality.
        OSError: a file in `workdir` is damaged or cannot be written.
        LockedError: another process trains in `workdir`.
        FloatingPointError: the loss is no longer finite.
    """
    workdir = Path(workdir)
    total = config.total(len(arrays))
    task = learner(model, targets=targets, absent=absent)
    task.check(arrays)
    settings = {
        "kind": _KINDS[type(model)],
        "model": model.to_json(),
        "training": asdict(config),
        "targets": targets,
        "absent": list(absent),
        "data": {"samples": len(arrays), "checksum": arrays.checksum()},
        "preprocessing": preprocessing or {},
    }
    settings = json.loads(json.dumps(settings))
    there = manifest.read(workdir)
    # A finished run is only read. It takes no lock, because a lock writes a file.
    finished = there is not None and there.step == total
    with contextlib.nullcontext() if finished else _files.lock(workdir):
        _files.claim(workdir / "config.json", settings)
        graphdef, state = initial(config, task, total)
        state = restore(workdir, state) or state
        start = int(state.step)
        if start < total:
            log = workdir / "metrics.jsonl"
            record = _truncate(log, start)
            compiled = jax.jit(lambda state, batch: step(task, graphdef, config, total, state, batch), donate_argnums=0)
            further = {
                name: order(config.seed + 1, len(own["state"]), size, start, total)
                for name, own, size in (("views", arrays.views, config.views), ("falls", arrays.falls, config.falls))
                if own and size
            }
            recent: list[Terms] = []
            for done, index in enumerate(order(config.seed, len(arrays), config.batch_size, start, total), start + 1):
                rows = {name: next(batches) for name, batches in further.items()}
                state, terms = compiled(state, arrays.take(index, **rows))
                recent.append(jax.block_until_ready(terms))
                if done % config.log_every == 0 or done == total:
                    record = _record(done, recent)
                    recent = []
                    _append(log, record)
                    if not np.isfinite(record["loss"]):
                        raise FloatingPointError(
                            f"{workdir}: the loss is {record['loss']} at step {done}: lower learning_rate="
                            f"{config.learning_rate} or set clip"
                        )
                if done % config.checkpoint_every == 0 or done == total:
                    save(workdir, state)
                if progress is not None:
                    progress(done, total, record)
    return Model(model, graphdef, nnx.merge_state(state.params, state.stats), int(state.step), settings)


def load(workdir: str | os.PathLike[str]) -> Model:
    """Load a trained model from its folder alone.

    Every file is compared with its checksum before it is used. A training may run in the folder meanwhile.

    Args:
        workdir: the `workdir` that was given to `train`.

    Returns:
        The model at its newest checkpoint.

    Raises:
        FileNotFoundError: the folder has no `config.json` or no checkpoint.
        OSError: a file is damaged, missing or not listed in `manifest.json`.
        ValueError: `config.json` was written by another version of sts_jax, or the folder has no manifest.
    """
    workdir = Path(workdir)
    while True:
        before = manifest.read(workdir)
        try:
            return _load(workdir)
        except (OSError, ValueError):
            if manifest.read(workdir) == before:
                raise
            # A training has replaced the checkpoint while it was read, so read the new one.


def _load(workdir: Path) -> Model:
    path = workdir / "config.json"
    if not path.exists():
        raise FileNotFoundError(f"{workdir} has no config.json: give the folder of a trained model, or train one there")
    checkpoint = verified(workdir)
    settings = _files.read_json(path, f"delete {workdir} and train again")
    if checkpoint is None:
        raise FileNotFoundError(f"{workdir} has no checkpoint: run its training to the first one")
    try:
        kind = settings.get("kind", "mvae")  # version 0.1 had no other kind
        model = {name: config for config, name in _KINDS.items()}[kind].from_json(settings["model"])
        like = jax.eval_shape(lambda: Weights(*learner(model).init(jax.random.key(0))[1:], jnp.zeros((), jnp.int32)))
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(
            f"{path} describes no model of this version of sts_jax ({type(error).__name__}: {error}): load it with the "
            f"version that trained it, or delete {workdir} and train again"
        ) from error
    weights = read(checkpoint, like)
    graphdef = nnx.graphdef(nnx.eval_shape(lambda: _module(model)))
    return Model(model, graphdef, nnx.merge_state(weights.params, weights.stats), int(weights.step), settings)


def _module(model: Config) -> nnx.Module:
    return mvae.MVAE(model) if isinstance(model, mvae.Config) else statespace.Model(model, nnx.Rngs(0))


def _truncate(log: Path, start: int) -> dict[str, float]:
    """Drop the records after step `start` and return the last one that is kept."""
    try:
        lines = log.read_bytes().splitlines() if log.exists() else []
    except OSError as error:
        raise OSError(
            f"cannot read {log}: {error}. Check its permissions, or delete it to continue without it."
        ) from error
    records = []
    for number, line in enumerate(lines, 1):
        try:
            record = json.loads(line.decode())
            keep = record["step"] <= start
        except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError) as error:
            if number == len(lines):  # cut off by a kill
                break
            raise _files.TornFileError(
                f"{log}, line {number}, is damaged ({type(error).__name__}: {error}): delete this line, or the "
                "file, to continue without these records."
            ) from error
        if keep:
            records.append(record)
    _files.write_bytes(log, "".join(json.dumps(r) + "\n" for r in records).encode())
    return records[-1] if records else {}


def _append(log: Path, record: dict[str, float]) -> None:
    try:
        with log.open("a") as file:
            file.write(json.dumps(record) + "\n")
    except OSError as error:
        raise OSError(
            f"cannot write {log}: {error}. {_files.remedy(error)}, then start again (the last checkpoint is kept)."
        ) from error


def _record(done: int, recent: list[Terms]) -> dict[str, float]:
    return {"step": done, **jax.tree.map(lambda *x: float(np.mean(x)), *recent)}


def _check_state(model: statespace.Config, arrays: Arrays) -> None:
    """Raise a ValueError if the arrays do not fit a state-space model."""
    if arrays.target_present or not set(arrays.present) <= set(model.inputs):
        raise ValueError(
            f"present masks {sorted(arrays.present)} and target_present masks {sorted(arrays.target_present)}, but the "
            f"model takes masks only of its inputs {list(model.inputs)}"
        )
    size, small = (model.input_size,) * 2, (model.image_size,) * 2
    codes, images = {"state": (statespace.STATE_CODE,), "pose": (statespace.POSE_CODE,)}, statespace.IMAGES
    expected = {
        "inputs": {name: (statespace.POSE_CODE,) if name == "pose" else (*size, 3) for name in model.inputs},
        "targets": {**{name: (*small, 3) for name in images}, **codes, "outcome": ()},
    }
    for kind, values in (("inputs", arrays.inputs), ("targets", arrays.targets)):
        found = {name: x.shape[1:] for name, x in values.items()}
        if found != expected[kind]:
            raise ValueError(f"{kind} have samples of {found}, but the model takes {expected[kind]}")
    if {name: x.shape for name, x in arrays.empty.items()} != {name: (*size, 3) for name in statespace.IMAGES}:
        raise ValueError(f"empty needs `visual` and `tactile` of shape {(*size, 3)}, from dataset.empty_frame")
    further = {
        "views": {"visual": (*size, 3), "state": (statespace.STATE_CODE,)},
        "falls": {**codes, "outcome": (), **({"condition": (model.condition,)} if model.condition else {})},
    }
    for kind, values in (("views", arrays.views), ("falls", arrays.falls)):
        found = {name: x.shape[1:] for name, x in values.items()}
        if values and (found != further[kind] or len({len(x) for x in values.values()}) > 1):
            shapes = {name: x.shape for name, x in values.items()}
            raise ValueError(f"{kind} has {shapes}, but it takes equally many samples of {further[kind]}")
    for outcome in (own["outcome"] for own in (arrays.targets, arrays.falls) if own):
        if not np.issubdtype(outcome.dtype, np.integer) or outcome.min() < 0 or outcome.max() >= model.outcomes:
            raise ValueError(
                f"outcome is {outcome.dtype} from {outcome.min()} to {outcome.max()}, but the model takes whole "
                f"numbers from 0 to {model.outcomes - 1}: give such numbers, or a model of more outcomes"
            )
    _check_condition(model.condition, arrays)


def _check_condition(expected: int, arrays: Arrays) -> None:
    width = 0 if arrays.condition is None else arrays.condition.shape[1]
    if width != expected:
        raise ValueError(f"condition has width {width}, but the model takes {expected}")


def _check_paper(model: mvae.Config, arrays: Arrays, absent: tuple[str, ...]) -> None:
    for name in absent:
        if np.any(arrays.present.get(name, False)):
            raise ValueError(f"{name} is declared absent, but {int(np.sum(arrays.present[name]))} samples have it")
    for kind, values in (("inputs", arrays.inputs), ("targets", arrays.targets)):
        needed = set(model.names) - (set(absent) if kind == "inputs" else set())
        if not needed <= set(values) <= set(model.names):
            raise ValueError(f"{kind} has {sorted(values)}, but the model {sorted(model.names)} needs {sorted(needed)}")
    for kind, masks in (("present", arrays.present), ("target_present", arrays.target_present)):
        if not set(masks) <= set(model.names):
            raise ValueError(f"{kind} masks {sorted(masks)}, but the model has {sorted(model.names)}")
    for modality in model.modalities:
        for values in (arrays.inputs, arrays.targets):
            if modality.name in values and values[modality.name].shape[1:] != modality.shape:
                raise ValueError(
                    f"{modality.name}: arrays of {values[modality.name].shape[1:]}, but the model has {modality.shape}"
                )
    _check_condition(model.condition, arrays)
