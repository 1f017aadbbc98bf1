"""The smallest state-space models, which compile in seconds."""

import dataclasses

import jax
import numpy as np

import sts_jax as sts
from sts_jax import statespace, training

TINY = statespace.Config(
    input_size=16,
    image_size=16,
    look=4,
    components=2,
    window=8,
    encoder=(4, 4, 4),
    decoder=(8, 4, 4, 4),
    hidden=16,
    transition=16,
    canvas=16,
)

STATE = dataclasses.replace(TINY, inputs=statespace.INPUTS, outcomes=3, condition=3, input_size=32)


def state_model(**changes):
    """A predictor with a state-space model before its training."""
    size = STATE.input_size
    view = {"resolution": (size, size), "condition_scale": (10.0, 10.0, 0.1)} | changes
    graphdef, params, _ = statespace.init(jax.random.key(0), STATE)
    settings = {"kind": "statespace", "model": STATE.to_json()}
    model = training.Model(STATE, graphdef, params, 0, settings)
    grey = np.full((size, size, 3), 178, np.uint8)
    return sts.Predictor(model, training.Preprocessing(**view), (grey, grey), "new")
