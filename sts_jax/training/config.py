"""Options of a training run."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class TrainConfig:
    """Options of a training run.

    Raises:
        ValueError: `checkpoint_every` is no multiple of `log_every`, or `schedule` has an unknown name.
    """

    steps: int | None = None  # gradient steps (None: as many as `epochs` need)
    epochs: int = 200  # paper
    batch_size: int = 64  # paper
    # State-space models: views (first moments without a last one) and falls (trajectories without images) in a batch,
    # if the data has some
    views: int = 16
    falls: int = 96
    learning_rate: float = 1e-3  # not in the paper
    schedule: Literal["constant", "cosine"] = "constant"  # cosine ends at 0
    warmup: int = 0  # steps over which the learning rate rises from 0
    b1: float = 0.9  # Adam
    b2: float = 0.999
    epsilon: float = 1e-8
    # Adam's epsilon for the encoders of an `mvae` model (nats). Adam takes steps of full length even if a small beta
    # makes the gradient of the divergence small, so that encoders collapse during the warm-up. Gradients far below this
    # epsilon move them little.
    encoder_epsilon: float = 1.0
    clip: float | None = None  # largest global norm of the gradient
    beta_warmup: float = 0.25  # share of the steps over which beta goes from 0 to 1 (paper: 50 of 200 epochs)
    seed: int = 0
    log_every: int = 10  # steps per record, which is their mean
    checkpoint_every: int = 200  # steps, a multiple of log_every

    def __post_init__(self) -> None:
        if self.checkpoint_every % self.log_every:
            raise ValueError(
                f"checkpoint_every must be a multiple of log_every={self.log_every}, got {self.checkpoint_every}"
            )
        if self.schedule not in ("constant", "cosine"):
            raise ValueError(f"schedule must be 'constant' or 'cosine', got {self.schedule!r}")

    def total(self, samples: int) -> int:
        """Number of gradient steps for a dataset of `samples` samples."""
        return self.steps if self.steps is not None else self.epochs * -(-samples // self.batch_size)
