"""Time of one training step and of one prediction, for the paper's model and for the state-space model.

    python -m benchmarks.learning                    # about 3 minutes on two CPU cores
    python -m benchmarks.learning --only statespace  # one kind of model
    taskset -c 0 python -m benchmarks.learning       # on one core

The plain implementation masks touch in all samples, enumerates all seven subsets of the three modalities, and uses
XLA's convolutions and transposed convolutions. All times are medians of several calls.
"""

import dataclasses
import os
from collections.abc import Callable
from typing import Any, Literal
from unittest import mock

import jax
import numpy as np
import tyro
from flax import nnx
from jaxtyping import Array

import sts_jax as sts
from benchmarks.instruments.timing import median_seconds
from sts_jax import mvae, statespace, training
from sts_jax.mvae import networks

STATE = statespace.Config(imprints=True, shading=24, outlines=32)  # as in experiments
MODEL = mvae.Config(
    (
        mvae.Modality("visual", "image", (64, 64, 3)),
        mvae.Modality("tactile", "image", (64, 64, 3)),
        mvae.Modality("pose", "vector", (12,), 1000.0),
    )
)
VISUAL = mvae.Config(MODEL.modalities[:1])
LAYOUT = ("NHWC", "HWIO", "NHWC")


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    only: Literal["paper", "statespace"] | None = None  # kind of model to measure. None: both kinds


def plain_conv(x: Array, kernel: Array, stride: int, padding: int) -> Array:
    """The function `mvae.networks.conv`, implemented with XLA's convolution as in `nnx.Conv`."""
    return jax.lax.conv_general_dilated(x, kernel, (stride, stride), [(padding,) * 2] * 2, dimension_numbers=LAYOUT)


def plain_conv_transpose(x: Array, kernel: Array, stride: int, padding: int) -> Array:
    """The function `mvae.networks.conv_transpose`, implemented with XLA's transposed convolution."""
    pads = [(len(kernel) - 1 - padding,) * 2] * 2
    return jax.lax.conv_transpose(x, kernel[::-1, ::-1], (stride, stride), pads, dimension_numbers=LAYOUT)


def stepper(
    model: mvae.Config | statespace.Config, batch: dict[str, Any], size: int, absent: tuple[str, ...] = ()
) -> Callable[[], None]:
    """Make a function that runs one compiled training step of a model."""
    config = training.TrainConfig(batch_size=size)
    learner = training.learner(model, absent=absent)
    graphdef, state = training.initial(config, learner, 100)
    run = jax.jit(lambda s, b: training.step(learner, graphdef, config, 100, s, b), donate_argnums=0)
    compiled = run.lower(state, batch).compile()

    def call() -> None:
        nonlocal state
        state, _ = jax.block_until_ready(compiled(state, batch))

    return call


def paper_stepper(model: mvae.Config, size: int, absent: tuple[str, ...]) -> Callable[[], None]:
    """Make a function that runs one training step of an `mvae` model on random data."""
    rng = np.random.default_rng(0)
    data: dict[str, Any] = {
        m.name: rng.integers(0, 256, (size, *m.shape), dtype=np.uint8)
        if m.kind == "image"
        else rng.random((size, *m.shape), np.float32)
        for m in model.modalities
    }
    masks = {"tactile": np.zeros(size, bool)} if "tactile" in data and not absent else {}
    inputs = {name: x for name, x in data.items() if name not in absent}
    return stepper(model, training.Arrays(inputs, data, masks).take(np.arange(size)), size, absent)


def predictor(size: int) -> Callable[[], None]:
    """Make a function that predicts all modalities of `MODEL` from a fixed batch of visual images."""
    graphdef, params, stats = mvae.init(jax.random.key(0), MODEL)
    state = nnx.merge_state(params, stats)
    run = jax.jit(lambda state, x: mvae.predict(graphdef, state, {"visual": x}))
    x = np.full((size, 64, 64, 3), 0.5, np.float32)
    return lambda: jax.block_until_ready(run(state, x)) and None


def roller(steps: int) -> Callable[[], None]:
    """Make a function that rolls out `MODEL` from a visual image."""
    graphdef, params, stats = mvae.init(jax.random.key(0), MODEL)
    view, blank = training.Preprocessing(stride=1, period=0.032), np.full((64, 64, 3), 128, np.uint8)
    model = training.Model(MODEL, graphdef, nnx.merge_state(params, stats), 0, {})
    predict = sts.Predictor(model, view, (blank, blank), "random weights")
    image = np.full(blank.shape, 0.5, np.float32)
    image[20:40, 15:45] = 0.2
    return lambda: jax.block_until_ready(predict.rollout({"visual": image}, steps)) and None


def state_stepper(size: int) -> Callable[[], None]:
    """Make a function that runs one training step of a state-space model on random data."""
    rng, model = np.random.default_rng(0), STATE
    config = training.TrainConfig(batch_size=size)

    def images(count: int, side: int) -> np.ndarray:
        return rng.integers(0, 256, (count, side, side, 3), dtype=np.uint8)

    def codes(count: int, width: int) -> np.ndarray:
        return rng.normal(size=(count, width)).astype(np.float32)

    def ends(count: int) -> dict[str, np.ndarray]:
        outcome = rng.integers(0, 2, count).astype(np.int32)
        state, pose = codes(count, statespace.STATE_CODE), codes(count, statespace.POSE_CODE)
        return {"state": state, "pose": pose, "outcome": outcome}

    large, small = model.input_size, model.image_size
    arrays = training.Arrays(
        inputs={"visual": images(size, large), "pose": codes(size, statespace.POSE_CODE)},
        targets={"visual": images(size, small), "tactile": images(size, small), **ends(size)},
        empty={name: images(1, large)[0] for name in statespace.IMAGES},
        views={"visual": images(config.views, large), "state": codes(config.views, statespace.STATE_CODE)},
        falls=ends(config.falls),
    )
    batch = arrays.take(np.arange(size), views=np.arange(config.views), falls=np.arange(config.falls))
    return stepper(model, batch, size)


def state_predictor(num_samples: int) -> Callable[[], None]:
    """Make a function without arguments that computes one prediction, to measure its duration."""
    config = STATE
    graphdef, params, _ = statespace.init(jax.random.key(0), config)
    view = training.Preprocessing(resolution=(config.input_size, config.input_size))
    blank = np.full((config.input_size, config.input_size, 3), 128, np.uint8)
    predict = sts.Predictor(training.Model(config, graphdef, params, 0, {}), view, (blank, blank), "random weights")
    image = np.full(blank.shape, 0.5, np.float32)
    image[40:80, 30:90] = 0.2
    key = jax.random.key(0)
    return lambda: jax.block_until_ready(predict(visual=image, key=key, num_samples=num_samples)) and None


def paper() -> None:
    """Print how long training steps and a prediction take with the paper's model (ms)."""
    with mock.patch.multiple(networks, conv=plain_conv, conv_transpose=plain_conv_transpose):
        plain = paper_stepper(MODEL, 64, ())
    ours, enumerated = median_seconds(paper_stepper(MODEL, 64, ("tactile",)), plain, repeats=3)
    ratio = enumerated / ours
    print(f"training step, batch 64: {1e3 * ours:.1f} ms, plain {1e3 * enumerated:.1f} ms, ratio {ratio:.1f}")
    for size in (16, 32):
        show(f"training step, batch {size}", paper_stepper(MODEL, size, ("tactile",)), 5)
    show("training step, visual only, batch 64", paper_stepper(VISUAL, 64, ()), 5)
    show("prediction, batch 1", predictor(1), 50)
    steps = 32
    print(f"roll-out, batch 1, per frame: {1e3 * median_seconds(roller(steps), repeats=11)[0] / steps:.1f} ms")


def show(name: str, call: Callable[[], None], repeats: int) -> None:
    """Print the median time of a function."""
    print(f"{name}: {1e3 * median_seconds(call, repeats=repeats)[0]:.1f} ms")


def main(args: Args) -> None:
    """Measure how long training steps and predictions of the chosen models take, and print the results."""
    print(f"{jax.devices()[0].device_kind}, {os.cpu_count()} cores")
    if args.only != "statespace":
        paper()
    if args.only != "paper":
        show("state-space model, training step, batch 32", state_stepper(32), 11)
        show("state-space model, prediction with 16 samples", state_predictor(16), 50)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
