"""The default optimiser."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sts_jax import training


def test_a_gradient_far_below_its_epsilon_moves_an_encoder_little_and_a_decoder_fully():
    config = training.TrainConfig(learning_rate=0.1, encoder_epsilon=2.0)
    adam = training.optimiser(config, 10)
    params = {"encoders": jnp.zeros(3), "decoders": jnp.zeros(3)}
    gradient = jax.tree.map(lambda x: x + 0.02, params)
    update, _ = adam.update(gradient, adam.init(params), params)
    np.testing.assert_allclose(update["decoders"], -0.1, rtol=1e-4)
    np.testing.assert_allclose(update["encoders"], -0.1 * 0.02 / 2.02, rtol=1e-4)  # lr g / (|g| + epsilon)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"log_every": 0}, "log_every must be >= 1, got 0"),
        ({"learning_rate": -1e-3}, "learning_rate must be > 0, got -0.001"),
        ({"learning_rate": float("nan")}, "learning_rate must be finite, got nan"),
        ({"b2": 1.0}, r"b2 must be < 1\.0000, got 1\.0"),
        ({"beta_warmup": 1.5}, "beta_warmup must be <= 1, got 1.5"),
        ({"log_every": 3, "checkpoint_every": 4}, r"checkpoint_every must be a multiple of log_every \(3\), got 4"),
    ],
)
def test_an_option_out_of_range_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        training.TrainConfig(**fields)


def test_a_cosine_schedule_needs_steps_after_the_warmup():
    config = training.TrainConfig(schedule="cosine", warmup=10)
    with pytest.raises(ValueError, match=r"warmup must be smaller than the number of steps .* \(10\), got 10"):
        training.optimiser(config, 10)
