"""A small convolutional network in plain JAX that predicts numbers from uint8 images."""

import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

CHANNELS = (24, 48, 64)  # output channels of the 3 x 3 convolutions
BATCH = 64
RATE = 2e-3  # initial learning rate of Adam, which falls to zero along a cosine
LAYOUT = ("NHWC", "HWIO", "NHWC")

Weights = list[tuple[Array, Array]]


def initial(key: PRNGKeyArray, outputs: int) -> Weights:
    """Make the initial weights of three convolutions and two dense layers."""
    widths = [12, *CHANNELS]
    shapes = [(3, 3, a, b) for a, b in itertools.pairwise(widths)]
    dense = [(2 * CHANNELS[-1], 64), (64, outputs)]
    weights = []
    for own, shape in zip(jax.random.split(key, 5), [*shapes, *dense], strict=True):
        scale = (2 / np.prod(shape[:-1])) ** 0.5
        weights.append((scale * jax.random.normal(own, shape), jnp.zeros(shape[-1])))
    weights[-1] = (0 * weights[-1][0], weights[-1][1])
    return weights


def apply(weights: Weights, x: Float[Array, "n h w 3"]) -> Float[Array, "n k"]:
    """Apply the network to images whose sides are multiples of 8."""
    n, h, w, c = x.shape
    x = x.reshape(n, h // 2, 2, w // 2, 2, c).transpose(0, 1, 3, 2, 4, 5).reshape(n, h // 2, w // 2, 4 * c)
    for index, (kernel, bias) in enumerate(weights[:-2]):
        if index:
            n, h, w, c = x.shape
            x = x.reshape(n, h // 2, 2, w // 2, 2, c).mean((2, 4))
        x = jax.nn.gelu(jax.lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=LAYOUT) + bias)
    x = jnp.concatenate([x.mean((1, 2)), x.max((1, 2))], 1)
    (a, b), (c_, d) = weights[-2:]
    return jax.nn.gelu(x @ a + b) @ c_ + d


def fit(
    key: PRNGKeyArray, images: np.ndarray, targets: np.ndarray, *, steps: int
) -> Callable[[np.ndarray], np.ndarray]:
    """Train a network to predict `targets` from `images`."""
    centre, scale = targets.mean(0), targets.std(0)
    wanted = jnp.asarray((targets - centre) / scale, jnp.float32)
    mean = images.mean((0,), dtype=np.float64).astype(np.float32)
    spread = float(np.mean([np.square(image - mean).mean() for image in images]) ** 0.5)

    def outputs(weights: Weights, rows: Array) -> Array:
        return apply(weights, (rows.astype(jnp.float32) - mean) / spread)

    def loss(weights: Weights, rows: Array, target: Array) -> Array:
        return jnp.square(outputs(weights, rows) - target).mean()

    optimizer = optax.adam(optax.cosine_decay_schedule(RATE, steps))
    begin, order = jax.random.split(key)
    weights = initial(begin, targets.shape[1])

    @jax.jit
    def step(weights: Weights, state: optax.OptState, rows: Array, target: Array) -> tuple[Weights, optax.OptState]:
        updates, state = optimizer.update(jax.grad(loss)(weights, rows, target), state)
        return optax.apply_updates(weights, updates), state

    state = optimizer.init(weights)
    for own in jax.random.split(order, steps):
        rows = np.asarray(jax.random.choice(own, len(images), (BATCH,)))
        weights, state = step(weights, state, images[rows], wanted[rows])

    predict = jax.jit(outputs)
    return lambda new: np.concatenate(
        [np.asarray(predict(weights, new[i : i + BATCH])) * scale + centre for i in range(0, len(new), BATCH)]
    )
