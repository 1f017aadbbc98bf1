"""The default optimiser of a training: Adam with a learning rate schedule and gradient clipping."""

from typing import Any

import jax
import optax

from sts_jax.training.config import TrainConfig


def optimiser(config: TrainConfig, total: int) -> optax.GradientTransformation:
    """Make the default optimiser of a training: Adam, whose epsilon is `encoder_epsilon` for encoders of `mvae` models.

    Args:
        config: Options of the training.
        total: Number of steps of the whole training. A cosine schedule reaches 0 after these steps.

    Returns:
        The optimiser, with the learning rate schedule and the gradient clipping that `config` sets.

    Raises:
        ValueError: The warm-up takes all steps of a cosine schedule.
    """
    rate: float | optax.Schedule = config.learning_rate
    if config.schedule == "cosine":
        if config.warmup >= total:
            raise ValueError(
                f"warmup must be smaller than the number of steps of a cosine schedule ({total}), got {config.warmup}"
            )
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
    """Label the parameters: `encoders` for the encoders of an `mvae` model, `others` for all others."""
    paper = "decoders" in params
    return jax.tree_util.tree_map_with_path(
        lambda path, _: "encoders" if paper and path[0].key == "encoders" else "others", params
    )
