"""The paper's encoders and decoders as Flax NNX modules.

Images have shape `(batch, height, width, channel)`. Their encoders take values in [0, 1], and their decoders return
logits. Vectors have shape `(batch, size)`. Their values are not limited. Categories have shape `(batch, classes)`.
Their encoders take the probabilities of the classes, one-hot if the class is known, and their decoders return logits.

Source: the paper's supplement, "Network Architecture". The hidden widths are those of Wu and Goodman (2018).
"""

import itertools
import math
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float, PRNGKeyArray

from sts_jax._checked import in_32_bits
from sts_jax.mvae.convolutions import conv, conv_transpose
from sts_jax.mvae.gaussian import Gaussian

_SIZE = 4  # side of every kernel
_LAYERS = ((2, 1), (2, 1), (2, 1), (1, 0))  # stride and padding of the encoder, reversed in the decoder
_EPSILON = 1e-5  # added to the variance in batch normalisation
_LOG_VAR_LIMIT = 8.0  # an encoder's variances lie within exp(-8) .. exp(8)
# Only a few latents are active at initialisation, with little noise. The others start near the prior and can grow. If
# all were active, the divergence (hundreds of nats) would outweigh the information of an image. If the noise were as
# wide as the prior, a decoder would learn to ignore the latent. Both collapse the posterior before anything is learnt.
_ACTIVE = 16  # active latents at initialisation
_QUIET = 0.03  # scale of the other latents' kernels at initialisation, relative to an active latent
_FIRST_LOG_VAR = -4.0  # log variance of an active latent at initialisation


@dataclass(frozen=True)
class Modality:
    """One quantity that a model receives as an input and predicts as an output: an image, a vector or a category."""

    name: str
    kind: Literal["image", "vector", "category"]
    # (height, width, channel), with sides >= 32 that are multiples of 8, or (size,), or (classes,)
    shape: tuple[int, ...]
    weight: float = 1.0  # weight lambda of the reconstruction error (paper: 1 for images, 1000 for the pose)
    # For images: grey value, > 0 and < 1, of the predictions before training. The grey value of the background saves
    # many training steps.
    start: float = 0.5

    def __post_init__(self) -> None:
        if not 0 < self.start < 1:
            raise ValueError(f"modality {self.name!r}: start must be a grey value > 0 and < 1, got {self.start}")
        image = len(self.shape) == 3 and all(side >= 32 and side % 8 == 0 for side in self.shape[:2])
        vector = len(self.shape) == 1 and self.shape[0] > 0
        if not (self.kind == "image" and image) and not (self.kind in ("vector", "category") and vector):
            raise ValueError(
                f"modality {self.name!r} must be an 'image' of shape (height, width, channel) with sides >= 32 that "
                f"are multiples of 8, a 'vector' of shape (size,), or a 'category' of shape (classes,), got "
                f"{self.kind!r} of shape {self.shape}"
            )


@dataclass(frozen=True)
class Config:
    """Configuration of a multimodal variational autoencoder, in values that JSON can represent."""

    modalities: tuple[Modality, ...]
    latent: int = 256  # components of the latent (paper)
    hidden: int = 512  # width between two fully connected layers (not in the paper)
    widths: tuple[int, ...] = (32, 64, 128, 256)  # channels after each convolution of an image encoder (paper)
    condition: int = 0  # width of the condition c, which is appended to the latent, 0 for none
    encode_condition: bool = False  # True: experts q(z | x, c), the condition is also an input of the encoders
    # standard: p(z) = N(0, I). conditional: a Gaussian p(z | c) with a network of its own. The prior is both the prior
    # expert of the product and the distribution that the loss measures the divergence from (paper, equation 10)
    prior: Literal["standard", "conditional"] = "standard"
    momentum: float = 0.9  # weight of the old values in the running batch statistics, per step

    def __post_init__(self) -> None:
        names = [m.name for m in self.modalities]
        if not names or len(set(names)) != len(names):
            raise ValueError(f"modalities must have at least one name, and each once, got {names}")
        if len(self.widths) != len(_LAYERS):
            raise ValueError(f"widths must have {len(_LAYERS)} numbers, one per convolution, got {self.widths}")
        if self.prior not in ("standard", "conditional"):
            raise ValueError(f"prior must be 'standard' or 'conditional', got {self.prior!r}")
        if not self.condition and (self.encode_condition or self.prior == "conditional"):
            raise ValueError(
                f"encode_condition={self.encode_condition} and prior={self.prior!r} need a condition, but condition=0: "
                "give its width, or leave out both options"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the modalities."""
        return tuple(m.name for m in self.modalities)


class _Linear(nnx.Module):
    def __init__(self, a: int, b: int) -> None:
        self.kernel = nnx.Param(_spread((a, b), a))
        self.bias = nnx.Param(jnp.zeros(b, jnp.float32))

    def __call__(self, x: Array) -> Array:
        return x @ self.kernel[...] + self.bias[...][None]


class _FromFeatures(_Linear):
    """The first fully connected layer of an encoder. With `encode_condition`, the condition follows the features."""

    def __init__(self, size: int, config: Config) -> None:
        width = config.condition if config.encode_condition else 0
        super().__init__(size + width, config.hidden)
        if width:  # the few numbers of the condition count as much as all features
            self.kernel[size:] = _spread((width, config.hidden), width)

    def __call__(self, x: Array, condition: Array | None = None) -> Array:
        return super().__call__(x if condition is None else jnp.concatenate([x, condition], axis=-1))


class _ToLatent(_Linear):
    """The last layer of an encoder. It returns the mean and the log variance of each latent."""

    def __init__(self, config: Config) -> None:
        super().__init__(config.hidden, 2 * config.latent)
        active = jnp.arange(config.latent) < _ACTIVE
        self.kernel[...] *= jnp.tile(jnp.where(active, 1.0, _QUIET), 2)[None]
        self.bias[config.latent :] = jnp.where(active, _FIRST_LOG_VAR, 0.0)


class _FromLatent(_Linear):
    """The first layer of a decoder. Its input is the latent followed by the condition."""

    def __init__(self, config: Config, size: int) -> None:
        super().__init__(config.latent + config.condition, size)
        rows = jnp.arange(config.latent + config.condition)
        used = (rows < _ACTIVE) | (rows >= config.latent)
        self.kernel[...] = jnp.where(used, 1.0, _QUIET)[:, None] * _spread(
            self.kernel.shape, min(_ACTIVE, config.latent) + config.condition
        )


class BatchNorm(nnx.Module):
    """Batch normalisation with a weight per sample.

    In training, the mean of a channel is `sum_n w_n mean_hw(x_n) / sum_n w_n`, with the weight `w_n` of sample n and
    the mean over its pixels, and the variance likewise. Each running statistic becomes `momentum * old + (1 - momentum)
    * new`. If all weights are 0, the running statistics are used and stay unchanged. Evaluation (`weights=None`) uses
    the running statistics.
    """

    def __init__(self, channels: int, *, momentum: float) -> None:
        self.scale = nnx.Param(jnp.ones(channels, jnp.float32))
        self.bias = nnx.Param(jnp.zeros(channels, jnp.float32))
        self.mean = nnx.BatchStat(jnp.zeros(channels, jnp.float32))
        self.var = nnx.BatchStat(jnp.ones(channels, jnp.float32))
        self.momentum = momentum

    def __call__(
        self, x: Float[Array, "batch h w channel"], weights: Float[Array, "batch"] | None
    ) -> Float[Array, "batch h w channel"]:
        """Normalise images channel by channel, then scale and shift them. `weights` are those of the samples."""
        mean, var = self.mean[...], self.var[...]
        if weights is not None:
            total = jnp.sum(weights)
            share = weights / jnp.where(total > 0, total, 1)
            new_mean = jnp.sum(share[:, None] * jnp.mean(x, axis=(1, 2)), axis=0)
            new_var = jnp.sum(share[:, None] * jnp.mean((x - new_mean[None, None, None]) ** 2, axis=(1, 2)), axis=0)
            old_mean, old_var = mean, var
            mean, var = jnp.where(total > 0, new_mean, old_mean), jnp.where(total > 0, new_var, old_var)
            self.mean[...] = jax.lax.stop_gradient(self.momentum * old_mean + (1 - self.momentum) * mean)
            self.var[...] = jax.lax.stop_gradient(self.momentum * old_var + (1 - self.momentum) * var)
        slope = self.scale[...] / jnp.sqrt(var + _EPSILON)
        offset = self.bias[...] - slope * mean
        return x * slope[None, None, None] + offset[None, None, None]


class _ImageEncoder(nnx.Module):
    """Four convolutions, each with batch normalisation and Swish, then two fully connected layers."""

    def __init__(self, modality: Modality, config: Config) -> None:
        channels = (modality.shape[2], *config.widths)
        self.kernels = nnx.List(
            [
                nnx.Param(_spread((_SIZE, _SIZE, a, b), _SIZE**2 * a))
                for a, b in zip(channels, config.widths, strict=False)
            ]
        )
        self.norms = nnx.List([BatchNorm(c, momentum=config.momentum) for c in config.widths])
        self.first = _FromFeatures(math.prod(_core(modality)) * config.widths[-1], config)
        self.second = _ToLatent(config)

    def __call__(self, x: Array, weights: Array | None, condition: Array | None = None) -> Gaussian:
        for kernel, norm, (stride, padding) in zip(self.kernels, self.norms, _LAYERS, strict=True):
            x = jax.nn.swish(norm(conv(x, kernel[...], stride, padding), weights))
        return _gaussian(self.second(jax.nn.swish(self.first(x.reshape(len(x), -1), condition))))


class _ImageDecoder(nnx.Module):
    """A fully connected layer, then four transposed convolutions. The last of them is linear and returns logits."""

    def __init__(self, modality: Modality, config: Config) -> None:
        channels = (*config.widths[::-1], modality.shape[2])
        self.core = (*_core(modality), channels[0])
        self.first = _FromLatent(config, math.prod(self.core))
        self.kernels = nnx.List(
            [
                nnx.Param(_spread((_SIZE, _SIZE, a, b), (_SIZE // stride) ** 2 * a))
                for a, b, (stride, _) in zip(channels, channels[1:], _LAYERS[::-1], strict=False)
            ]
        )
        self.norms = nnx.List([BatchNorm(c, momentum=config.momentum) for c in channels[1:-1]])
        # The small last kernel and the bias make the output of an untrained decoder `start` nearly everywhere.
        self.kernels[-1][...] *= 0.1
        self.bias = nnx.Param(jnp.full(channels[-1], math.log(modality.start / (1 - modality.start)), jnp.float32))

    def __call__(self, z: Array, weights: Array | None) -> Array:
        x = jax.nn.swish(self.first(z)).reshape(len(z), *self.core)
        for i, (stride, padding) in enumerate(_LAYERS[::-1]):
            x = conv_transpose(x, self.kernels[i][...], stride, padding)
            if i < len(self.norms):
                x = jax.nn.swish(self.norms[i](x, weights))
        return x + self.bias[...][None, None, None]


class _VectorEncoder(nnx.Module):
    """Two fully connected layers."""

    def __init__(self, modality: Modality, config: Config) -> None:
        self.first = _FromFeatures(modality.shape[0], config)
        self.second = _ToLatent(config)

    def __call__(self, x: Array, weights: Array | None, condition: Array | None = None) -> Gaussian:
        del weights
        return _gaussian(self.second(jax.nn.swish(self.first(x, condition))))


class _VectorDecoder(nnx.Module):
    """Two fully connected layers."""

    def __init__(self, modality: Modality, config: Config) -> None:
        self.first = _FromLatent(config, config.hidden)
        self.second = _Linear(config.hidden, modality.shape[0])

    def __call__(self, z: Array, weights: Array | None) -> Array:
        del weights
        return self.second(jax.nn.swish(self.first(z)))


class _Prior(nnx.Module):
    """The prior `p(z | c)`: two fully connected layers. Before training, it is close to the standard normal."""

    def __init__(self, config: Config) -> None:
        self.first = _Linear(config.condition, config.hidden)
        self.second = _Linear(config.hidden, 2 * config.latent)
        self.second.kernel[...] *= _QUIET

    def __call__(self, condition: Array) -> Gaussian:
        return _gaussian(self.second(jax.nn.swish(self.first(condition))))


class MVAE(nnx.Module):
    """A multimodal variational autoencoder with one encoder and one decoder for each modality.

    An encoder maps images in [0, 1], vectors or probabilities of classes, `(batch, *shape)`, to the expert,
    `(batch, latent)`. With `Config.encode_condition`, it also takes the condition. A decoder maps latents with the
    condition, `(batch, latent + condition)`, to predictions, `(batch, *shape)`, logits for images and categories. The
    second argument of both has the weights of the samples in batch normalisation. None uses the running statistics. The
    network `prior` maps conditions to the prior. Only a model with a conditional prior has it.
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        encoders = {"image": _ImageEncoder, "vector": _VectorEncoder, "category": _VectorEncoder}
        decoders = {"image": _ImageDecoder, "vector": _VectorDecoder, "category": _VectorDecoder}
        self.encoders = nnx.Dict({m.name: encoders[m.kind](m, config) for m in config.modalities})
        self.decoders = nnx.Dict({m.name: decoders[m.kind](m, config) for m in config.modalities})
        if config.prior == "conditional":
            self.prior = _Prior(config)


@in_32_bits
def init(key: PRNGKeyArray, config: Config) -> tuple[nnx.GraphDef[MVAE], nnx.State, nnx.State]:
    """Create a model with random parameters: its definition, parameters and running batch statistics.

    Kernels are drawn from normal distributions with variance `1 / fan_in`, where `fan_in` counts only the active
    inputs. Only the first 16 components of the latent are active at the start. The weights of the others are multiplied
    by 0.03, so that they start near the prior, and the last kernel of an image decoder by 0.1. A conditional prior
    starts near the standard normal.
    """
    # All kernels are drawn in one call, because every shape of a draw would need a compilation of its own.
    graphdef, params, stats = nnx.split(MVAE(config), nnx.Param, nnx.BatchStat)
    leaves, tree = jax.tree.flatten(params)
    noise = np.cumsum([0] + [x.size if x.ndim > 1 else 0 for x in leaves])

    @jax.jit
    def draw(key: PRNGKeyArray) -> list[Array]:
        drawn = jax.random.normal(key, (int(noise[-1]),), jnp.float32)
        ends = itertools.pairwise(noise)
        return [x if a == b else x * drawn[a:b].reshape(x.shape) for x, (a, b) in zip(leaves, ends, strict=True)]

    return graphdef, jax.tree.unflatten(tree, draw(key)), stats


def _core(modality: Modality) -> tuple[int, int]:
    """Height and width of the feature map between the convolutions and the fully connected layers."""
    return modality.shape[0] // 8 - 3, modality.shape[1] // 8 - 3


def _spread(shape: tuple[int, ...], fan_in: int) -> Array:
    """A kernel whose entries are their standard deviation. `init` multiplies them by standard normal numbers."""
    return jnp.full(shape, 1 / math.sqrt(fan_in), jnp.float32)


def _gaussian(x: Array) -> Gaussian:
    mean, log_var = jnp.split(x, 2, axis=-1)
    return Gaussian(mean, _LOG_VAR_LIMIT * jnp.tanh(log_var / _LOG_VAR_LIMIT))
