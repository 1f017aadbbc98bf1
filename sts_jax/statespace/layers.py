"""Rendered images of objects (`Layers`), and `compose`, which combines them with the images of the empty sensor."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

CONTRAST = 40.0  # contrast of samples without a calibration, see `compose`


class Layers(NamedTuple):
    """Outlines and colours of n rendered objects, and the changes that the objects cause in the tactile images.

    `compose` combines them with the images of the empty sensor, and returns complete images.
    """

    covered: Float[Array, "n size size 1"]  # logit of the probability that a pixel shows the object
    colour: Float[Array, "n size size 3"]  # colour of the object, [0, 1]
    touch: Float[Array, "n size size 3"]  # change of the logits of the tactile image


def compose(
    layers: Layers,
    empty: dict[str, Float[Array, "size size 3"]],
    level: Float[Array, "n"] | None = None,
    contrast: float | Float[Array, "n"] = CONTRAST,
) -> dict[str, Float[Array, "n size size 3"]]:
    """Combine the rendered objects with the images of the empty sensor.

    Args:
        layers: Rendered images of n objects, from the decoder.
        empty: `visual` and `tactile` image of the empty sensor in [0, 1], with the size of the rendered images.
        level: Threshold for each object, from 0 to 1. A threshold gives an object sharp outlines in the visual image.
            `layers.covered` is the logit of the probability p that the object covers a pixel. If p is well above the
            threshold, the pixel shows the object. If p is well below the threshold, the pixel shows the empty sensor.
            If p is near the threshold, the pixel shows a mixture of both. If the threshold is drawn uniformly, the
            pixel shows the object with the probability p. With None, every pixel shows a mixture: the mean of the
            colours of the object and the empty sensor, with the weights p and 1 - p.
        contrast: Sharpness of the outlines if there is a threshold. The weight of the object in a mixture is the
            sigmoid of `contrast * (logit(p) - logit(level))`.

    Returns:
        The images `visual` and `tactile` of each object, in [0, 1].
    """
    logit = layers.covered
    if level is not None:
        level = jnp.clip(level, 0.01, 0.99).reshape(-1, 1, 1, 1)
        logit = jnp.reshape(contrast, (-1, 1, 1, 1)) * (logit - jnp.log(level / (1 - level)))
    covered = jax.nn.sigmoid(logit)
    grey = jnp.clip(empty["tactile"], 0.01, 0.99)
    return {
        "visual": covered * layers.colour + (1 - covered) * empty["visual"],
        "tactile": jax.nn.sigmoid(jnp.log(grey / (1 - grey)) + layers.touch),
    }
