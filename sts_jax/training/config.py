"""The options of a training run."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class TrainConfig:
    """Options of a training run.

    Raises:
        ValueError: `checkpoint_every` is not a multiple of `log_every`, or `schedule` is unknown.
    """

    steps: int | None = None  # number of gradient steps (None: the number that `epochs` needs)
    epochs: int = 200  # passes over the training set, used if steps is None (paper: 200)
    batch_size: int = 64  # samples in a batch (paper: 64)
    # State-space models only: number of views in a batch, which are first frames without a trajectory, if the training
    # set has any
    views: int = 16
    # State-space models only: number of falls in a batch, which are trajectories without images, if the training set
    # has any
    falls: int = 96
    learning_rate: float = 1e-3  # learning rate of Adam (not in the paper)
    schedule: Literal["constant", "cosine"] = "constant"  # course of the learning rate. cosine falls to 0 at the end
    warmup: int = 0  # number of first steps over which the learning rate rises linearly from 0
    b1: float = 0.9  # Adam's decay of the mean gradient
    b2: float = 0.999  # Adam's decay of the mean squared gradient
    epsilon: float = 1e-8  # Adam's epsilon, added to the root of the mean squared gradient
    # Adam's epsilon for the encoders of an `mvae` model (nats). Adam takes steps of full length even where a small beta
    # makes the gradient of the divergence small, and the encoders then collapse during the warm-up of beta. With a
    # large epsilon, gradients far below it change the encoders little.
    encoder_epsilon: float = 1.0
    clip: float | None = None  # longer gradients are scaled down to this global norm (None: not clipped)
    beta_warmup: float = 0.25  # share of the steps over which beta rises from 0 to 1 (paper: 50 of 200 epochs)
    seed: int = 0  # seed of the initial parameters, of the order of the samples and of the noise
    log_every: int = 10  # number of steps whose mean is one record of the training log
    checkpoint_every: int = 200  # number of steps between two checkpoints, a multiple of log_every

    def __post_init__(self) -> None:
        if self.checkpoint_every % self.log_every:
            raise ValueError(
                f"checkpoint_every must be a multiple of log_every ({self.log_every}), got {self.checkpoint_every}"
            )
        if self.schedule not in ("constant", "cosine"):
            raise ValueError(f"schedule must be 'constant' or 'cosine', got {self.schedule!r}")

    def total(self, samples: int) -> int:
        """The number of gradient steps of the run, for a training set of `samples` samples."""
        return self.steps if self.steps is not None else self.epochs * -(-samples // self.batch_size)
