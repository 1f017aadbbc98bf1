"""Errors of a plain convolutional network without latent variables, for comparison with the state-space model.

    python -m benchmarks.deterministic runs/freefall  # takes about 9 minutes on two CPU cores with the default preset
    python -m benchmarks.deterministic runs/perturbed --scenario perturbed --seconds 480

The network predicts a single last frame from the first images, the first pose and the condition. For a comparison at
equal cost, set `--seconds` to the training time of the run's state-space model.
"""

import dataclasses
import functools
import itertools
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from flax import nnx
from jaxtyping import Array, Float

import sts_jax as sts
from benchmarks.instruments.experiments import EXPERIMENTS
from experiments.shared import run
from sts_jax import dataset, evaluation, statespace, storage, training
from sts_jax.statespace import blocks

BATCH, RATE, WARMUP = 32, 1e-3, 100
POSE_WEIGHT, TACTILE_WEIGHT, OUTCOME_WEIGHT = 300.0, 4.0, 8.0  # the visual image's cross-entropy (nat) has weight 1
TITLE = "deterministic network, from all inputs"


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    workdir: Annotated[Path, tyro.conf.Positional]  # work directory of an experiment
    scenario: Literal["freefall", "inclined", "perturbed"] = "freefall"  # scenario of the work directory
    preset: Literal["smoke", "default", "long"] = "default"  # preset of the work directory
    seconds: float = 420.0  # duration of the training after compilation (s)
    seed: int = 0  # seed of the initial weights and of the order of the batches


class Network(nnx.Module):
    """Predicts the last images (64x64), pose and outcome from the first images (128x128), pose and condition."""

    def __init__(self, images: int, numbers: int, outcomes: int, rngs: nnx.Rngs) -> None:
        widths = [3 * images, 32, 64, 128, 128]
        self.down = nnx.List([nnx.Conv(4 * a, b, (3, 3), rngs=rngs) for a, b in itertools.pairwise(widths)])
        self.join = nnx.Linear(8 * 8 * 128 + numbers, 512, rngs=rngs)
        self.layers = nnx.List([nnx.Linear(512, 512, rngs=rngs) for _ in range(3)])
        self.norms = nnx.List([nnx.LayerNorm(512, rngs=rngs) for _ in range(3)])
        self.numbers = nnx.Linear(512, 12 + outcomes, rngs=rngs)
        self.core = nnx.Linear(512, 8 * 8 * 128, rngs=rngs)
        self.up = nnx.List([nnx.Conv(a, 4 * b, (3, 3), rngs=rngs) for a, b in ((128, 64), (64, 32), (32, 6))])

    def __call__(self, images: Float[Array, "n h w c"], numbers: Float[Array, "n k"]) -> tuple[Array, Array, Array]:
        """Predict the last state from the arrays of `features`."""
        x = images
        for layer in self.down:
            x = jax.nn.swish(layer(blocks.fold(x)))
        x = self.join(jnp.concatenate([x.reshape(len(x), -1), numbers], axis=-1))
        for norm, layer in zip(self.norms, self.layers, strict=True):
            x = x + layer(jax.nn.swish(norm(x)))
        final = self.numbers(x)
        picture = self.core(x).reshape(len(x), 8, 8, -1)
        for layer in self.up:
            picture = blocks.unfold(layer(jax.nn.swish(picture)))
        return picture, final[:, :12], final[:, 12:]


def features(inputs: dict[str, Array], condition: Array | None, empty: dict[str, Array]) -> tuple[Array, Array]:
    """Prepare the inputs of the network."""
    images = [inputs[name] / 255.0 - empty[name] / 255.0 for name in ("visual", "tactile") if name in inputs]
    numbers = [inputs["pose"]] if condition is None else [inputs["pose"], condition]
    return jnp.concatenate(images, axis=-1), jnp.concatenate(numbers, axis=-1)


def loss(graphdef: nnx.GraphDef[Network], params: nnx.State, batch: dict[str, Any]) -> Array:
    """Compute the mean loss of a batch."""
    picture, pose, outcome = nnx.merge(graphdef, params)(*features(batch["inputs"], batch["condition"], batch["empty"]))
    targets = batch["targets"]
    visual, tactile = (
        jnp.sum(optax.sigmoid_binary_cross_entropy(logits, targets[name] / 255.0), axis=(1, 2, 3))
        for name, logits in zip(("visual", "tactile"), jnp.split(picture, 2, axis=-1), strict=True)
    )
    known = optax.softmax_cross_entropy_with_integer_labels(outcome, targets["outcome"])
    error = jnp.sum((pose - targets["pose"]) ** 2, axis=-1)
    return jnp.mean(visual + TACTILE_WEIGHT * tactile + POSE_WEIGHT * error + OUTCOME_WEIGHT * known)


def fit(
    arrays: training.Arrays, network: nnx.GraphDef[Network], params: nnx.State, seconds: float, seed: int
) -> tuple[nnx.State, int]:
    """Train the network, with a learning rate that falls along a cosine of the elapsed time."""
    optimiser = optax.chain(optax.clip_by_global_norm(3e3), optax.scale_by_adam(b2=0.99))

    @functools.partial(jax.jit, donate_argnums=(0, 1))
    def step(params: nnx.State, state: optax.OptState, batch: dict[str, Any], rate: Array) -> tuple[Any, Any]:
        update, state = optimiser.update(jax.grad(functools.partial(loss, network))(params, batch), state)
        return optax.apply_updates(params, jax.tree.map(lambda x: -rate * x, update)), state

    state = optimiser.init(params)
    start, count = None, 0
    for index in training.order(seed, len(arrays), BATCH, 0, 10**9):
        share = 0.0 if start is None else (time.perf_counter() - start) / seconds
        if share >= 1:
            break
        rate = RATE * min((count + 1) / WARMUP, 1) * 0.5 * (1 + np.cos(np.pi * share))
        params, state = jax.block_until_ready(step(params, state, arrays.take(index), jnp.float32(rate)))
        start = start or time.perf_counter()
        count += 1
    return params, count


def predict(
    graphdef: nnx.GraphDef[Network], params: nnx.State, job: run.Job, arrays: training.Arrays
) -> evaluation.Predicted:
    """Predict the last images, pose and outcome of every trajectory."""

    @jax.jit
    def run(batch: dict[str, Any]) -> tuple[Array, ...]:
        found = nnx.merge(graphdef, params)(*features(batch["inputs"], batch["condition"], batch["empty"]))
        visual, tactile = jnp.split(jax.nn.sigmoid(found[0]), 2, axis=-1)
        return visual, tactile, job.preprocessing.decode_pose(found[1]), jax.nn.softmax(found[2])

    parts = [run(arrays.take(rows)) for rows in np.array_split(np.arange(len(arrays)), -(-len(arrays) // 64))]
    visual, tactile, pose, outcome = (np.concatenate([np.asarray(part[k]) for part in parts]) for k in range(4))
    return evaluation.Predicted(visual, tactile, pose, outcome_probability=outcome)


def main(args: Args) -> str:
    """Train the network on a run's training objects, and return the table of its errors on held-out objects."""
    sts.enable_compilation_cache()
    config, sensor = EXPERIMENTS[args.scenario].PRESETS[args.preset], sts.Sensor()
    with storage.lock(args.workdir):
        storage.claim(args.workdir / "config.json", dataclasses.asdict(config))
        data = run.collect(config.collection, sensor, args.workdir / "dataset")
    rows, scenario = evaluation.rows_of(data, config.splits[0]), config.collection.scenario
    train, given = data.pairs(rows["train"]), data.pairs(rows["test"])
    job = next(run.jobs(config, sensor, train))
    assert isinstance(job.model, statespace.Config)
    held_out = training.state_arrays(given, job.model, scenario, job.preprocessing, job.empty)
    numbers = 12 + len(job.preprocessing.condition_scale)
    images = len([name for name in ("visual", "tactile") if name in job.arrays.inputs])
    network, params = nnx.split(Network(images, numbers, len(scenario.outcomes), nnx.Rngs(args.seed)))
    params, steps = fit(job.arrays, network, params, args.seconds, args.seed)
    train, test = (dataset.reduced(pairs, config.image_size) for pairs in (train, given))
    predictions = evaluation.baselines(scenario, train, test)
    predictions[TITLE] = predict(network, params, job, held_out)
    judge = evaluation.scorer(scenario, train)
    scores = {title: judge(row, test) for title, row in predictions.items()}
    size = sum(x.size for x in jax.tree.leaves(params))
    note = f"{steps} gradient steps of {BATCH} in {args.seconds:g} s, {size:,} parameters."
    title = f"{args.workdir.name}: a deterministic network"
    summary = evaluation.summarise(scores, test, outcomes=scenario.outcomes)
    return evaluation.full_table(summary, title=title, notes=[note])


if __name__ == "__main__":
    print(main(tyro.cli(Args, description=__doc__)))
