"""Small networks that judge a grasp: the probability that a lift will hold, from images or numbers."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, Float

from sts_jax._ranges import COUNT, NOT_NEGATIVE, POSITIVE, SHARE

STREAMS = {"vision": ("visual",), "touch": ("tactile",), "vision and touch": ("visual", "tactile")}
# Numbers in place of images: a force and torque sensor in each finger, and what is hidden as well
FORCES, HIDDEN = "force sensors", "forces and hidden state"
INPUTS = (*STREAMS, FORCES, HIDDEN)
PATCH = 4  # pixels, side of the patches that the first layer sees
WIDTHS = 32, 48, 64, 96  # channels after each layer
SHIFT = 3  # pixels, largest shift of an image in training
AT_ONCE = 256  # lifts that are judged in one call


@dataclasses.dataclass(frozen=True)
class Training:
    """Options of the training, the same for all inputs."""

    steps: int = dataclasses.field(default=1500, metadata=COUNT)  # gradient steps
    batch_size: int = dataclasses.field(default=64, metadata=COUNT)  # lifts in a batch
    learning_rate: float = dataclasses.field(default=2e-3, metadata=POSITIVE)  # at its largest, of AdamW
    weight_decay: float = dataclasses.field(default=0.05, metadata=NOT_NEGATIVE)
    dropout: float = dataclasses.field(default=0.3, metadata=SHARE)
    validate_every: int = dataclasses.field(default=50, metadata=COUNT)  # steps between two validations


class Eye(nnx.Module):
    """Features of images of one finger, (n, height, width, channels) -> (n, features)."""

    def __init__(self, shape: tuple[int, int, int], rngs: nnx.Rngs) -> None:
        a, b, c, d = WIDTHS
        self.patches = nnx.Linear(PATCH * PATCH * shape[2], a, rngs=rngs)
        self.halved = nnx.Linear(4 * a, b, rngs=rngs)
        self.around = nnx.Conv(b, b, (3, 3), rngs=rngs)
        self.quartered = nnx.Linear(4 * b, c, rngs=rngs)
        self.whole = nnx.Linear(shape[0] * shape[1] // (4 * PATCH) ** 2 * c, d, rngs=rngs)

    def __call__(self, images: Float[Array, "n h w c"]) -> Float[Array, "n d"]:
        """See the class."""
        x = nnx.gelu(self.patches(_tiles(images, PATCH)))
        x = nnx.gelu(self.halved(_tiles(x, 2)))
        x = nnx.gelu(x + self.around(x))
        x = nnx.gelu(self.quartered(_tiles(x, 2)))
        return nnx.gelu(self.whole(x.reshape(len(x), -1)))


class Judge(nnx.Module):
    """Logit of the probability that a lift holds, from images of both fingers (n, 2, h, w, c), or from numbers (n, k).

    Turning the scene by half a turn about the vertical exchanges the fingers, so their order does not matter.
    """

    def __init__(self, shape: tuple[int, ...], dropout: float, rngs: nnx.Rngs) -> None:
        width = WIDTHS[-1]
        self.sees = len(shape) == 4
        self.features = (
            Eye((shape[1], shape[2], shape[3]), rngs) if self.sees else nnx.Linear(shape[0], 2 * width, rngs=rngs)
        )
        self.dropout = nnx.Dropout(dropout if self.sees else 0.0, rngs=rngs)
        self.hidden = nnx.Linear(2 * width, width, rngs=rngs)
        self.out = nnx.Linear(width, 1, rngs=rngs)

    def __call__(self, x: Float[Array, "n ..."]) -> Float[Array, "n"]:
        """See the class."""
        if self.sees:
            fingers = self.features(x.reshape(-1, *x.shape[2:])).reshape(len(x), 2, -1)
            x = jnp.concatenate([fingers.mean(axis=1), fingers.max(axis=1)], axis=1)
        else:
            x = nnx.gelu(self.features(x))
        return self.out(nnx.gelu(self.hidden(self.dropout(x))))[:, 0]


def _tiles(x: Float[Array, "n h w c"], side: int) -> Float[Array, "n y x d"]:
    """Divide images into tiles, whose pixels become channels."""
    n, h, w, c = x.shape
    x = x.reshape(n, h // side, side, w // side, side, c).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(n, h // side, w // side, -1)


def inputs_of(data: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """One of INPUTS for all lifts: images, uint8 (n, 2, h, w, c), or numbers, float32 (n, k)."""
    if name in STREAMS:
        return np.concatenate([data[stream] for stream in STREAMS[name]], axis=-1)
    count = len(data["held"])
    columns = [data["wrench"].reshape(count, -1), data["opening"][:, None]]
    if name == HIDDEN:
        mass, friction, grip = (np.log(data[key])[:, None] for key in ("mass", "friction", "grip"))
        columns += [mass, friction, grip, friction + grip - mass]
    return np.concatenate(columns, axis=1).astype(np.float32)


def judged(
    options: Training,
    data: Mapping[str, np.ndarray],
    parts: Mapping[str, np.ndarray],
    name: str,
    seed: int,
    progress: Callable[[int], None] = lambda step: None,
) -> np.ndarray:
    """Train a network on the part `train`, and return its probabilities for the part `test`.

    The weights are those with the smallest log loss on the part `validation`.

    Args:
        parts: Rows of the lifts in each part.
        name: One of INPUTS.
    """
    given, held = inputs_of(data, name), data["held"].astype(np.float32)
    mean = given[parts["train"]].mean(axis=0, dtype=np.float32)
    spread = (given[parts["train"]] - mean).std(axis=0) if given.ndim == 2 else _spread(given[parts["train"]], mean)
    scale = (jnp.asarray(mean), jnp.asarray(np.maximum(spread, 1e-6)))
    graph, params, rest = nnx.split(Judge(given.shape[1:], options.dropout, nnx.Rngs(seed)), nnx.Param, ...)
    warmup = min(options.steps // 10, 100)
    rate = optax.warmup_cosine_decay_schedule(0.0, options.learning_rate, warmup, options.steps)
    optimiser = optax.adamw(rate, weight_decay=options.weight_decay)
    state, rng, key = optimiser.init(params), np.random.default_rng(seed), jax.random.key(seed)
    best, least = params, np.inf
    for step in range(options.steps):
        rows = rng.choice(parts["train"], min(options.batch_size, len(parts["train"])), replace=False)
        params, rest, state = _step(
            graph, optimiser, params, rest, state, jax.random.fold_in(key, step), given[rows], held[rows], scale
        )
        if (step + 1) % options.validate_every == 0 or step + 1 == options.steps:
            loss = _log_loss(_probabilities(graph, params, rest, given[parts["validation"]], scale), held, parts)
            if loss < least:
                best, least = params, loss
            progress(step + 1)
    return _probabilities(graph, best, rest, given[parts["test"]], scale)


def _spread(images: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Standard deviation of each stream around its mean image."""
    some = images[:: max(len(images) // 500, 1)] - mean
    return np.repeat([some[..., first : first + 3].std() for first in range(0, images.shape[-1], 3)], 3)


def _log_loss(probability: np.ndarray, held: np.ndarray, parts: Mapping[str, np.ndarray]) -> float:
    truth = held[parts["validation"]]
    return float(-np.mean(np.log(np.where(truth > 0, probability, 1 - probability))))


@functools.partial(jax.jit, static_argnums=(0, 1))
def _step(
    graph: Any, optimiser: Any, params: Any, rest: Any, state: Any, key: Array, x: Array, held: Array, scale: Any
) -> Any:
    """One gradient step, with shifted images."""
    x = (x.astype(jnp.float32) - scale[0]) / scale[1]
    if x.ndim == 5:
        shifts = jax.random.randint(key, (len(x), 2), -SHIFT, SHIFT + 1)
        padded = jnp.pad(x, ((0, 0), (0, 0), (SHIFT, SHIFT), (SHIFT, SHIFT), (0, 0)), "edge")
        x = jax.vmap(lambda one, by: jax.lax.dynamic_slice(one, (0, SHIFT + by[0], SHIFT + by[1], 0), x.shape[1:]))(
            padded, shifts
        )

    def loss(params: Any) -> Any:
        judge = nnx.merge(graph, params, rest, copy=True)
        value = jnp.mean(optax.sigmoid_binary_cross_entropy(judge(x), held))
        return value, nnx.split(judge, nnx.Param, ...)[2]

    gradient, rest = jax.grad(loss, has_aux=True)(params)
    updates, state = optimiser.update(gradient, state, params)
    return optax.apply_updates(params, updates), rest, state


def _probabilities(graph: Any, params: Any, rest: Any, x: np.ndarray, scale: Any) -> np.ndarray:
    count = min(AT_ONCE, len(x))
    padded = np.concatenate([x, x[: -len(x) % count]])  # all calls have the same shape
    found = [_call(graph, params, rest, padded[i : i + count], scale) for i in range(0, len(x), count)]
    return np.concatenate([np.asarray(one) for one in found])[: len(x)]


@functools.partial(jax.jit, static_argnums=0)
def _call(graph: Any, params: Any, rest: Any, x: Array, scale: Any) -> Array:
    judge = nnx.merge(graph, params, rest, copy=True)
    judge.eval()
    logit = judge((x.astype(jnp.float32) - scale[0]) / scale[1])
    return jnp.clip(jax.nn.sigmoid(logit), 1e-4, 1 - 1e-4)
