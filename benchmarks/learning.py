"""How long learning takes: one training step at batch 64, one prediction at batch 1.

    python -m benchmarks.learning

The step is that of freefall (three modalities, touch absent, every subset asked for all). Beside it stands the
same step in the plain way: XLA's own convolutions and transposed convolutions, and all seven subsets enumerated.
Medians, alternated, after one unmeasured call each. A few minutes on two CPU cores.
"""

import statistics
import time
from collections.abc import Callable
from typing import Any
from unittest import mock

import jax
import numpy as np
from flax import nnx
from jaxtyping import Array

from sts_jax import mvae, training
from sts_jax.mvae import networks

MODEL = mvae.Config(
    (
        mvae.Modality("visual", "image", (64, 64, 3)),
        mvae.Modality("tactile", "image", (64, 64, 3)),
        mvae.Modality("pose", "vector", (12,), 1000.0),
    )
)
VISUAL = mvae.Config(MODEL.modalities[:1])
LAYOUT = ("NHWC", "HWIO", "NHWC")


def plain_conv(x: Array, kernel: Array, stride: int, padding: int) -> Array:
    """What `nnx.Conv` computes."""
    return jax.lax.conv_general_dilated(x, kernel, (stride, stride), [(padding,) * 2] * 2, dimension_numbers=LAYOUT)


def plain_conv_transpose(x: Array, kernel: Array, stride: int, padding: int) -> Array:
    """What `nnx.ConvTranspose` computes."""
    pads = [(len(kernel) - 1 - padding,) * 2] * 2
    return jax.lax.conv_transpose(x, kernel[::-1, ::-1], (stride, stride), pads, dimension_numbers=LAYOUT)


def stepper(model: mvae.Config, size: int, absent: tuple[str, ...]) -> Callable[[], None]:
    """A training step on random data, compiled."""
    rng = np.random.default_rng(0)
    data: dict[str, Any] = {
        m.name: rng.integers(0, 256, (size, *m.shape), dtype=np.uint8)
        if m.kind == "image"
        else rng.random((size, *m.shape), np.float32)
        for m in model.modalities
    }
    masks = {} if absent else {"tactile": np.zeros(size, bool)} if "tactile" in data else {}
    inputs = {name: x for name, x in data.items() if name not in absent}
    batch = training.Arrays(inputs, data, masks).take(np.arange(size))
    config = training.TrainConfig(batch_size=size)
    learner = training.learner(model, absent=absent)
    graphdef, state = training.initial(config, learner, 100)
    run = jax.jit(lambda s, b: training.step(learner, graphdef, config, 100, s, b), donate_argnums=0)
    compiled = run.lower(state, batch).compile()

    def call() -> None:
        nonlocal state
        state, _ = jax.block_until_ready(compiled(state, batch))

    return call


def predictor(size: int) -> Callable[[], None]:
    """A prediction of everything from vision, compiled."""
    graphdef, params, stats = mvae.init(jax.random.key(0), MODEL)
    state = nnx.merge_state(params, stats)
    run = jax.jit(lambda state, x: mvae.predict(graphdef, state, {"visual": x}))
    x = np.full((size, 64, 64, 3), 0.5, np.float32)
    return lambda: jax.block_until_ready(run(state, x)) and None


def medians(calls: dict[str, Callable[[], None]], repeats: int) -> dict[str, float]:
    """Seconds per call, alternated."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        call()
    for _ in range(repeats):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            times[name].append(time.perf_counter() - start)
    return {name: statistics.median(values) for name, values in times.items()}


def main() -> None:
    """Measure and print."""
    with mock.patch.multiple(networks, conv=plain_conv, conv_transpose=plain_conv_transpose):
        plain = stepper(MODEL, 64, ())
    steps = medians({"step": stepper(MODEL, 64, ("tactile",)), "plain": plain}, 3)
    ratio = steps["plain"] / steps["step"]
    print(f"training step, batch 64: {steps['step']:.2f} s; plain {steps['plain']:.2f} s, ratio {ratio:.1f}")
    for size in (16, 32):
        print(f"training step, batch {size}: {medians({'': stepper(MODEL, size, ('tactile',))}, 5)['']:.3f} s")
    visual = medians({"": stepper(VISUAL, 64, ())}, 5)[""]
    print(f"training step, visual only, batch 64: {visual:.3f} s")
    print(f"prediction, batch 1: {1e3 * medians({'': predictor(1)}, 50)['']:.1f} ms")


if __name__ == "__main__":
    main()
