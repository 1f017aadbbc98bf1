"""The options of a training run, and its default optimiser."""

from dataclasses import dataclass, field
from typing import Any, Literal

import jax
import optax

from sts_jax._ranges import COUNT, NOT_NEGATIVE, POSITIVE, SHARE, check

_NUMBER = NOT_NEGATIVE | {"whole": True}  # 0 or a larger whole number
_DECAY = NOT_NEGATIVE | {"below": 1.0}


@dataclass(frozen=True)
class TrainConfig:
    """Options of a training run."""

    steps: int | None = field(default=None, metadata=COUNT)  # gradient steps (None: as many as `epochs` needs)
    epochs: int = field(default=200, metadata=COUNT)  # passes over the training set, used if steps is None (paper: 200)
    batch_size: int = field(default=64, metadata=COUNT)  # samples in a batch (paper: 64)
    # For state-space models: first frames without a trajectory, and trajectories without images, in a batch
    views: int = field(default=16, metadata=_NUMBER)
    falls: int = field(default=96, metadata=_NUMBER)
    learning_rate: float = field(default=1e-3, metadata=POSITIVE)  # learning rate of Adam (not in the paper)
    schedule: Literal["constant", "cosine"] = "constant"  # course of the learning rate. cosine falls to 0 at the end
    warmup: int = field(default=0, metadata=_NUMBER)  # first steps, in which the learning rate rises linearly from 0
    b1: float = field(default=0.9, metadata=_DECAY)  # Adam's decay of the mean gradient
    b2: float = field(default=0.999, metadata=_DECAY)  # Adam's decay of the mean squared gradient
    epsilon: float = field(default=1e-8, metadata=NOT_NEGATIVE)  # Adam's epsilon
    # Adam's epsilon for the encoders of an `mvae` model (nats). Adam takes steps of full length even where a small beta
    # makes the gradient of the divergence small, and the encoders then collapse during the warm-up of beta. With a
    # large epsilon, gradients far below it change the encoders little.
    encoder_epsilon: float = field(default=1.0, metadata=NOT_NEGATIVE)
    # longer gradients are scaled down to this global norm (None: not clipped)
    clip: float | None = field(default=None, metadata=POSITIVE)
    # share of the steps over which beta rises from 0 to 1 (paper: 50 of 200 epochs)
    beta_warmup: float = field(default=0.25, metadata=SHARE)
    seed: int = field(default=0, metadata=_NUMBER)  # of the initial parameters, the order of the samples and the noise
    log_every: int = field(default=10, metadata=COUNT)  # steps whose mean is one record of the training log
    checkpoint_every: int = field(default=200, metadata=COUNT)  # steps, a multiple of log_every

    def __post_init__(self) -> None:
        check(self)
        if self.checkpoint_every % self.log_every:
            raise ValueError(
                f"checkpoint_every must be a multiple of log_every ({self.log_every}), got {self.checkpoint_every}"
            )
        if self.schedule not in ("constant", "cosine"):
            raise ValueError(f"schedule must be 'constant' or 'cosine', got {self.schedule!r}")

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
        lambda path, _: "encoders" if paper and path[0].key == "encoders" else "others", params
    )
