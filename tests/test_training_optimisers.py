"""The default optimiser."""

import jax
import jax.numpy as jnp
import numpy as np

from sts_jax import training


def test_a_gradient_far_below_its_epsilon_moves_an_encoder_little_and_a_decoder_fully():
    config = training.TrainConfig(learning_rate=0.1, encoder_epsilon=2.0)
    adam = training.optimiser(config, 10)
    params = {"encoders": jnp.zeros(3), "decoders": jnp.zeros(3)}
    gradient = jax.tree.map(lambda x: x + 0.02, params)
    update, _ = adam.update(gradient, adam.init(params), params)
    np.testing.assert_allclose(update["decoders"], -0.1, rtol=1e-4)
    np.testing.assert_allclose(update["encoders"], -0.1 * 0.02 / 2.02, rtol=1e-4)  # lr g / (|g| + epsilon)
