"""The training loop: a Python loop over one compiled step (a convolution inside `lax.scan` is slow on a CPU)."""

import contextlib
import json
import os
import zlib
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array

from sts_jax import _files, mvae
from sts_jax.training import manifest
from sts_jax.training.checkpoint import TrainState, Weights, read, restore, save, verified

Batch = dict[str, Any]  # `inputs`, `targets`, `present`, `target_present`: dicts by name; `condition`: array or None


@dataclass(frozen=True)
class TrainConfig:
    """How a model is trained."""

    steps: int | None = None  # gradient steps; None: `epochs` decide
    epochs: int = 200  # paper
    batch_size: int = 64  # paper
    learning_rate: float = 1e-3  # not in the paper
    schedule: Literal["constant", "cosine"] = "constant"  # cosine ends at 0
    b1: float = 0.9  # Adam
    b2: float = 0.999
    epsilon: float = 1e-8
    # Of the encoders' parameters, in nats: Adam makes steps of full length of any gradient, however small beta makes
    # the divergence's, so that encoders collapse during the warm-up; gradients far below this one move them little.
    encoder_epsilon: float = 1.0
    clip: float | None = None  # largest global norm of the gradient
    beta_warmup: float = 0.25  # share of the steps over which beta goes from 0 to 1 (paper: 50 of 200 epochs)
    seed: int = 0
    log_every: int = 10  # steps; a record is the mean over them
    checkpoint_every: int = 200  # steps, a multiple of log_every

    def __post_init__(self) -> None:
        if self.checkpoint_every % self.log_every:
            raise ValueError(f"checkpoint_every={self.checkpoint_every}: give a multiple of log_every={self.log_every}")
        if self.schedule not in ("constant", "cosine"):
            raise ValueError(f"schedule={self.schedule!r}; known are 'constant' and 'cosine'")

    def total(self, samples: int) -> int:
        """Gradient steps over a data set of so many samples."""
        return self.steps if self.steps is not None else self.epochs * -(-samples // self.batch_size)


@dataclass(frozen=True)
class Arrays:
    """A data set in memory, by modality, `(samples, *shape)`; images uint8, or float32 in [0, 1]."""

    inputs: dict[str, np.ndarray]
    targets: dict[str, np.ndarray]
    present: dict[str, np.ndarray] = field(default_factory=dict)  # (samples,) bool; one not given counts always
    target_present: dict[str, np.ndarray] = field(default_factory=dict)
    condition: np.ndarray | None = None  # (samples, condition)

    def __post_init__(self) -> None:
        sizes = {len(x) for x in jax.tree.leaves(self._tree())}
        if len(sizes) != 1 or 0 in sizes:
            raise ValueError(f"arrays of {sorted(sizes)} samples; all must have the same number, at least one")

    def __len__(self) -> int:
        return len(next(iter(self.targets.values())))

    def take(self, index: np.ndarray) -> Batch:
        """These samples."""
        return jax.tree.map(lambda x: x[index], self._tree())

    def checksum(self) -> int:
        """Changes when the data do."""
        value = 0
        for path, x in jax.tree_util.tree_leaves_with_path(self._tree()):
            value = zlib.crc32(f"{path}{x.shape}{x.dtype}".encode(), value)
            value = zlib.crc32(np.ascontiguousarray(x).data, value)
        return value

    def _tree(self) -> Batch:
        return {name: getattr(self, name) for name in ("inputs", "targets", "present", "target_present", "condition")}


class Model(NamedTuple):
    """A trained model, ready for `mvae.predict(model.graphdef, model.state, ...)`."""

    config: mvae.Config
    graphdef: nnx.GraphDef[mvae.MVAE]
    state: nnx.State  # parameters and running batch statistics
    step: int  # gradient steps done
    settings: dict[str, Any]  # config.json: `model`, `training`, `preprocessing`, ...

    def __repr__(self) -> str:
        modalities = ", ".join(f"{m.name} {m.kind} {m.shape}" for m in self.config.modalities)
        numbers = sum(x.size for x in jax.tree.leaves(self.state))
        return (
            f"Model({modalities}; latent={self.config.latent}, condition={self.config.condition}, "
            f"{numbers:,} numbers, step={self.step})"
        )


def optimiser(config: TrainConfig, total: int) -> optax.GradientTransformation:
    """Adam as configured, with an epsilon of its own for each of the parameters' `encoders` and `decoders`."""
    rate: float | optax.Schedule = config.learning_rate
    if config.schedule == "cosine":
        rate = optax.cosine_decay_schedule(config.learning_rate, total)
    rates = {"encoders": config.encoder_epsilon, "decoders": config.epsilon}
    parts = {name: optax.adam(rate, b1=config.b1, b2=config.b2, eps=epsilon) for name, epsilon in rates.items()}
    adam = optax.partition(parts, lambda params: jax.tree_util.tree_map_with_path(lambda path, _: path[0].key, params))
    return adam if config.clip is None else optax.chain(optax.clip_by_global_norm(config.clip), adam)


def initial(config: TrainConfig, model: mvae.Config, total: int) -> tuple[nnx.GraphDef[mvae.MVAE], TrainState]:
    """A new model and its state, a function of `config.seed`."""
    graphdef, params, stats = mvae.init(jax.random.key(config.seed), model)
    return graphdef, TrainState(params, stats, optimiser(config, total).init(params), jnp.zeros((), jnp.int32))


def step(
    graphdef: nnx.GraphDef[mvae.MVAE],
    config: TrainConfig,
    total: int,
    state: TrainState,
    batch: Batch,
    *,
    targets: Literal["all", "own"] = "all",
    absent: tuple[str, ...] = (),
) -> tuple[TrainState, mvae.Terms]:
    """One gradient step; the state keeps its structure and dtypes.

    Args:
        graphdef: definition of the model.
        config: how it is trained.
        total: steps of the whole run; beta and the learning rate follow from it.
        state: the state before.
        batch: `Arrays.take`; uint8 becomes float32 in [0, 1] here.
        targets: `mvae.loss`, `asked`.
        absent: `mvae.loss`.

    Returns:
        The state after, and the parts of the loss before.
    """
    batch = jax.tree.map(lambda x: x.astype(jnp.float32) / 255 if x.dtype == jnp.uint8 else x, batch)
    # Half of the split is unused: another stream would be as good, but the published results are of this one.
    noise, _ = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), state.step))
    warmup = max(config.beta_warmup * total, 1)
    beta = jnp.minimum(state.step.astype(jnp.float32) / warmup, 1)

    def objective(params: nnx.State) -> tuple[Array, tuple[nnx.State, mvae.Terms]]:
        return mvae.loss(graphdef, params, state.stats, noise, **batch, beta=beta, asked=targets, absent=absent)

    gradient, (stats, terms) = jax.grad(objective, has_aux=True)(state.params)
    update, rest = optimiser(config, total).update(gradient, state.optimiser, state.params)
    return TrainState(optax.apply_updates(state.params, update), stats, rest, state.step + 1), terms


def order(seed: int, samples: int, batch_size: int, start: int, stop: int) -> Iterator[np.ndarray]:
    """Indices of the batches `start .. stop`, a function of the seed and the step alone.

    Permutations of the samples follow one another, one per epoch, and a batch may straddle two: every sample is
    seen once per epoch and none is dropped.
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
    model: mvae.Config,
    arrays: Arrays,
    *,
    workdir: str | os.PathLike[str],
    absent: tuple[str, ...] = (),
    targets: Literal["all", "own"] = "all",
    preprocessing: dict[str, Any] | None = None,
    progress: Callable[[int, int, dict[str, float]], None] | None = None,
) -> Model:
    """Train a model in `workdir`, or go on where an earlier call on it stopped.

    A run that was killed gives the parameters, to the last bit, of one that was not, on one machine. Where the
    last step is done, nothing is written. Other entries in `workdir` are left alone. One process at a time trains in
    a folder.

    Args:
        config: how.
        model: what.
        arrays: the training set.
        workdir: the model's folder: `config.json`, `metrics.jsonl`, `checkpoints/`, `manifest.json`.
        absent: modalities present in no sample; they may be missing from `arrays.inputs`.
        targets: `all` or `own`, see `mvae.loss`.
        preprocessing: plain values for `config.json`: how images and vectors were made.
        progress: called after every step with the steps done, their total, and the latest record of
            `metrics.jsonl` (empty before the first).

    Returns:
        The trained model.

    Raises:
        ValueError: `workdir` was made with other settings or data, or holds a checkpoint without a manifest; the
            arrays contradict `absent` or lack a modality.
        OSError: a file in `workdir` is damaged or cannot be written.
        LockedError: another process trains in `workdir`.
        FloatingPointError: the loss is no longer finite.
    """
    workdir = Path(workdir)
    total = config.total(len(arrays))
    _check(model, arrays, absent)
    settings = {
        "model": model.to_json(),
        "training": asdict(config),
        "targets": targets,
        "absent": list(absent),
        "data": {"samples": len(arrays), "checksum": arrays.checksum()},
        "preprocessing": preprocessing or {},
    }
    settings = json.loads(json.dumps(settings))
    there = manifest.read(workdir)
    # A finished run is only read, and a lock is a file.
    finished = there is not None and there.step == total
    with contextlib.nullcontext() if finished else _files.lock(workdir):
        _files.claim(workdir / "config.json", settings)
        graphdef, state = initial(config, model, total)
        state = restore(workdir, state) or state
        start = int(state.step)
        if start < total:
            log = workdir / "metrics.jsonl"
            record = _truncate(log, start)
            compiled = jax.jit(
                lambda state, batch: step(graphdef, config, total, state, batch, targets=targets, absent=absent),
                donate_argnums=0,
            )
            recent: list[mvae.Terms] = []
            for done, index in enumerate(order(config.seed, len(arrays), config.batch_size, start, total), start + 1):
                state, terms = compiled(state, arrays.take(index))
                recent.append(jax.block_until_ready(terms))
                if done % config.log_every == 0 or done == total:
                    record = _record(done, recent)
                    recent = []
                    _append(log, record)
                    if not np.isfinite(record["loss"]):
                        raise FloatingPointError(
                            f"{workdir}: the loss is {record['loss']} at step {done}; lower learning_rate="
                            f"{config.learning_rate} or set clip"
                        )
                if done % config.checkpoint_every == 0 or done == total:
                    save(workdir, state)
                if progress is not None:
                    progress(done, total, record)
    return Model(model, graphdef, nnx.merge_state(state.params, state.stats), int(state.step), settings)


def load(workdir: str | os.PathLike[str]) -> Model:
    """The model in a folder, from this folder alone.

    Every file is compared with its checksum before it is used. A training that runs in the folder may go on.

    Args:
        workdir: the `workdir` that was given to `train`.

    Returns:
        The model at its newest checkpoint.

    Raises:
        FileNotFoundError: the folder has no `config.json` or no checkpoint.
        OSError: a file is damaged, missing or not listed in `manifest.json`.
        ValueError: `config.json` is of another version of sts_jax, or the folder has no manifest.
    """
    workdir = Path(workdir)
    while True:
        before = manifest.read(workdir)
        try:
            return _load(workdir)
        except (OSError, ValueError):
            if manifest.read(workdir) == before:
                raise
            # A training has replaced the checkpoint while it was read: read the new one.


def _load(workdir: Path) -> Model:
    path = workdir / "config.json"
    if not path.exists():
        raise FileNotFoundError(
            f"{workdir}: has no config.json; give the folder of a trained model, or train one there"
        )
    checkpoint = verified(workdir)
    settings = _files.read_json(path, f"delete {workdir} and train again")
    if checkpoint is None:
        raise FileNotFoundError(f"{workdir}: has no checkpoint; run its training to the first one")
    try:
        model = mvae.Config.from_json(settings["model"])
        like = jax.eval_shape(lambda: Weights(*mvae.init(jax.random.key(0), model)[1:], jnp.zeros((), jnp.int32)))
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(
            f"{path} describes no model of this version of sts_jax ({type(error).__name__}: {error}); load it with the "
            f"version that trained it, or delete {workdir} and train again"
        ) from error
    weights = read(checkpoint, like)
    graphdef = nnx.graphdef(nnx.eval_shape(lambda: mvae.MVAE(model)))
    return Model(model, graphdef, nnx.merge_state(weights.params, weights.stats), int(weights.step), settings)


def _truncate(log: Path, start: int) -> dict[str, float]:
    """Drop the records after step `start` and return the last one that stays."""
    try:
        lines = log.read_bytes().splitlines() if log.exists() else []
    except OSError as error:
        raise OSError(
            f"cannot read {log}: {error}. Check its permissions, or delete it to go on without it."
        ) from error
    records = []
    for number, line in enumerate(lines, 1):
        try:
            record = json.loads(line.decode())
            keep = record["step"] <= start
        except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError) as error:
            if number == len(lines):  # torn by a kill
                break
            raise _files.TornFileError(
                f"{log}, line {number}, is damaged ({type(error).__name__}: {error}); delete this line, or the "
                "file, to go on without these records."
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
            f"cannot write {log}: {error}. {_files.remedy(error)}, then start again; the last checkpoint is kept."
        ) from error


def _record(done: int, recent: list[mvae.Terms]) -> dict[str, float]:
    mean = jax.tree.map(lambda *x: float(np.mean(x)), *recent)
    return {"step": done, "loss": mean.loss, "kl": mean.kl, **mean.reconstruction}


def _check(model: mvae.Config, arrays: Arrays, absent: tuple[str, ...]) -> None:
    for name in absent:
        if np.any(arrays.present.get(name, False)):
            raise ValueError(f"{name} is declared absent, and {int(np.sum(arrays.present[name]))} samples have it")
    for kind, values in (("inputs", arrays.inputs), ("targets", arrays.targets)):
        needed = set(model.names) - (set(absent) if kind == "inputs" else set())
        if not needed <= set(values) <= set(model.names):
            raise ValueError(f"{kind} named {sorted(values)}; the model {sorted(model.names)} needs {sorted(needed)}")
    for kind, masks in (("present", arrays.present), ("target_present", arrays.target_present)):
        if not set(masks) <= set(model.names):
            raise ValueError(f"{kind} named {sorted(masks)}; the model has {sorted(model.names)}")
    for modality in model.modalities:
        for values in (arrays.inputs, arrays.targets):
            if modality.name in values and values[modality.name].shape[1:] != modality.shape:
                raise ValueError(
                    f"{modality.name}: arrays of {values[modality.name].shape[1:]}, the model takes {modality.shape}"
                )
    width = 0 if arrays.condition is None else arrays.condition.shape[1]
    if width != model.condition:
        raise ValueError(f"condition of width {width}; the model takes {model.condition}")
