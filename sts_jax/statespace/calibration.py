"""Calibration: numbers that correct the predicted density of the final pose and set the contrast of sampled images.

The transition is the network that predicts the density of the final pose. For each outcome, such as resting or falling
off, the density is a mixture of Gaussians. The encoders estimate the states of training objects better than the states
of other objects. The transition learns from training objects, and its density is too narrow for other objects. It is
corrected separately for each combination of inputs, such as the visual image alone or the visual image and the pose.

Three numbers correct the density: an exponent of the probabilities of the outcomes, an exponent of the weights of the
mixtures, and a factor of the variances. They are temperatures in the sense of Guo et al.
(2017), "On Calibration of Modern Neural Networks". The first number can make the probabilities of the outcomes less
certain or more certain. After a short training, these probabilities are often too uncertain, and the number makes them
more certain. The other two numbers can only widen the density of the pose. In a fit to few objects, a narrower density
often has the largest likelihood, but it covers too few of the true poses of other objects.

A fourth number is the contrast of the sampled images. A larger contrast makes their outlines sharper. The gradient
energy of an image is the sum of the squared differences of neighbouring pixels. The fit chooses the contrast at which
the gradient energy of the sampled images is nearest to that of the true images.

`statespace.fitting` finds the numbers on trajectories that the training did not see.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sts_jax.mvae import Gaussian
from sts_jax.statespace.config import Config
from sts_jax.statespace.networks import FinalPose, Model
from sts_jax.statespace.objective import experts, fuse, of_state


class Calibration(NamedTuple):
    """Numbers that correct the density of the final pose and set the contrast of sampled images.

    Each array has one value for each subset of the inputs. If `outcome`, `weight` and `variance` are 1, the density is
    unchanged. A larger `contrast` makes the outlines in sampled images sharper. A subset has the index
    `sum(2**i for i in members)`, where `members` are the positions of its inputs in `Config.inputs`. For example, the
    subset of the first and the second input has the index 3.
    """

    outcome: Float[Array, "subsets"]  # exponent of the probabilities of the outcomes, in [1/4, 4]
    weight: Float[Array, "subsets"]  # exponent of the weights of an outcome's mixture components, in [1/4, 1]
    variance: Float[Array, "subsets"]  # factor of the variances of the components, in [1, 4]
    contrast: Float[Array, "subsets"]  # contrast of the outlines in samples, `compose`


def of_items(config: Config, calibration: Calibration, present: dict[str, Bool[Array, "n"]]) -> Calibration:
    """Select the calibration of each item: the values for the subset of the inputs that the item has.

    Args:
        config: Configuration of the model.
        calibration: Values for each subset of the inputs.
        present: Masks `(n,)` of the inputs by name. True means that the item has the input. An item with the input
            `state` (the true pose, shape and mass) gets the value 1 for each number that corrects the density of the
            final pose, so the density stays unchanged.

    Returns:
        A `Calibration` whose four arrays, such as `outcome` and `contrast`, have one value for each item, `(n,)`.
    """
    names = enumerate(config.inputs)
    subset = jnp.asarray(sum(2**i * present[name].astype(int) for i, name in names if name in present))
    corrected_as = jnp.where(present["state"], 0, subset) if "state" in present else subset
    density = Calibration(*(x[corrected_as] for x in calibration))
    return density._replace(contrast=calibration.contrast[subset])


def predict(
    model: Model,
    inputs: dict[str, Array],
    present: dict[str, Bool[Array, "n"]],
    empty: dict[str, Float[Array, "size size 3"]],
    condition: Float[Array, "n c"] | None = None,
    calibration: Calibration | None = None,
) -> tuple[Gaussian, FinalPose]:
    """Infer the state and the appearance in the first frame, and predict the density of the final pose.

    Args:
        model: The networks.
        inputs: One or more inputs of n items, by name: images `visual` and `tactile` `(n, size, size, 3)` in [0, 1],
            pose codes `pose` `(n, 12)` and true state codes `state` `(n, code)`.
        present: A mask for each name in `inputs`, `(n,)`. True means that the item has the input.
        empty: `visual` and `tactile` image of the empty sensor, in [0, 1].
        condition: Known quantities of the scenario such as an acceleration, `(n, c)`, from
            `training.Preprocessing.encode_condition`. None if the model has no condition.
        calibration: Numbers that correct the density. With None, no density is corrected. If an item has the input
            `state`, its density is never corrected.

    Returns:
        The posterior in the first frame, `(n, code + look)`, and the density of the final pose. The posterior is a
        Gaussian over the state code (pose, shape and mass) and the appearance code (all other visible properties).
    """
    belief = fuse(experts(model, inputs, present, empty), present)
    final = model.transition(of_state(belief), condition)
    if calibration is None:
        return belief, final
    own = of_items(model.config, calibration, present)
    return belief, corrected(final, own.outcome, own.weight, own.variance)


def corrected(
    final: FinalPose, outcome: Float[Array, "*n"], weight: Float[Array, "*n"], variance: Float[Array, "*n"]
) -> FinalPose:
    """Correct the predicted densities of the final pose with the numbers of a `Calibration`.

    Args:
        final: Densities of n items.
        outcome: Exponent of the probabilities of the outcomes: a scalar for all items, or `(n,)`.
        weight: Exponent of the weights of the mixture components: a scalar for all items, or `(n,)`.
        variance: Factor of the variances of the components: a scalar for all items, or `(n,)`.

    Returns:
        The corrected densities.
    """

    def power(log: Array, exponent: Array) -> Array:
        return jax.nn.log_softmax(log * exponent.reshape(-1, *(1,) * (log.ndim - 1)))

    return final._replace(
        outcome=power(final.outcome, outcome),
        weight=power(final.weight, weight),
        log_var=final.log_var + jnp.log(variance).reshape(-1, 1, 1, 1),
    )
