"""The parts of a training that differ between `mvae` and `statespace` models.

These parts are the initialisation of the model, the loss, and the check of the training set.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from flax import nnx
from jaxtyping import Array, Float, PRNGKeyArray

from sts_jax import mvae, statespace
from sts_jax.training.arrays import Arrays, Batch

Config = mvae.Config | statespace.Config  # configuration of a model of either kind
Terms = dict[str, Array]  # scalars by name: the loss and its parts


@runtime_checkable
class Loss(Protocol):
    """Type of a loss function: a pure function of a model, a random key and one batch.

    `jax.grad` and `jax.jit` can trace it. See `__call__` for the arguments.
    """

    def __call__(
        self,
        graphdef: nnx.GraphDef[Any],
        params: nnx.State,
        stats: nnx.State,
        key: PRNGKeyArray,
        batch: Batch,
        beta: Float[Array, ""],
    ) -> tuple[Float[Array, ""], tuple[nnx.State, Terms]]:
        """Compute the loss of one batch.

        Args:
            graphdef: Definition of the model.
            params: Parameters of the model. The loss is differentiated by them.
            stats: Running batch statistics of the model.
            key: Random key, another one in every step.
            batch: Arrays of the batch, from `Arrays.take`, with images as float32 in [0, 1].
            beta: Weight of the divergence, which rises from 0 to 1 over the share `TrainConfig.beta_warmup` of the
                steps.

        Returns:
            The loss, and a pair of the new running batch statistics (`stats` if the loss does not change them), and
            scalars by name for the training log. One of the scalars must be `loss`. The training stops with an error if
            it is not finite.
        """
        ...


class Learner(NamedTuple):
    """The functions that train one model. They initialise the model, compute the loss, and check the training set."""

    config: Config  # configuration of the model
    # Takes a random key. Returns the definition of the model, its parameters and its running batch statistics
    init: Callable[[Array], tuple[nnx.GraphDef[Any], nnx.State, nnx.State]]
    loss: Loss
    check: Callable[[Arrays], None]  # raises a ValueError if a training set does not fit the model


def learner(model: Config, *, targets: Literal["all", "own"] = "all", absent: tuple[str, ...] = ()) -> Learner:
    """Make the learner of a model.

    A learner has the functions that train a model. They initialise the model, compute the loss, and check the training
    set. The loss is `mvae.loss` or `statespace.loss`, depending on the type of the model.

    Args:
        model: Configuration of the model.
        targets: Modalities to predict from each subset of the inputs. `all` means every modality. `own` means only the
            modalities in the subset. Ignored for state-space models.
        absent: Names of modalities that are not inputs of any sample. Ignored for state-space models.

    Returns:
        The learner.
    """

    def paper_loss(
        graphdef: nnx.GraphDef[Any], params: nnx.State, stats: nnx.State, key: PRNGKeyArray, batch: Batch, beta: Array
    ) -> tuple[Array, tuple[nnx.State, Terms]]:
        own = {name: value for name, value in batch.items() if name != "empty"}
        total, (stats, terms) = mvae.loss(graphdef, params, stats, key, **own, beta=beta, asked=targets, absent=absent)
        return total, (stats, {"loss": terms.loss, "kl": terms.kl, **terms.reconstruction})

    def state_loss(
        graphdef: nnx.GraphDef[Any], params: nnx.State, stats: nnx.State, key: PRNGKeyArray, batch: Batch, beta: Array
    ) -> tuple[Array, tuple[nnx.State, Terms]]:
        own = {name: value for name, value in batch.items() if name != "target_present"}
        total, terms = statespace.loss(graphdef, params, key, **own, beta=beta)
        return total, (stats, {"loss": total, **terms})

    if isinstance(model, mvae.Config):
        return Learner(
            model,
            lambda key: mvae.init(key, model),
            paper_loss,
            lambda arrays: _check_paper(model, arrays, absent),
        )
    return Learner(
        model, lambda key: statespace.init(key, model), state_loss, lambda arrays: _check_state(model, arrays)
    )


def _check_state(model: statespace.Config, arrays: Arrays) -> None:
    """Raise a ValueError if a training set does not fit a state-space model."""
    if arrays.target_present or not set(arrays.present) <= set(model.inputs):
        raise ValueError(
            f"`present` has masks for {sorted(arrays.present)}, and `target_present` has masks for "
            f"{sorted(arrays.target_present)}. For a state-space model, `present` may have masks only for the model's "
            f"inputs, which are {list(model.inputs)}, and `target_present` must be empty: remove all other masks"
        )
    size, small = (model.input_size,) * 2, (model.image_size,) * 2
    codes, images = {"state": (statespace.STATE_CODE,), "pose": (statespace.POSE_CODE,)}, statespace.IMAGES
    expected = {
        "inputs": {name: (statespace.POSE_CODE,) if name == "pose" else (*size, 3) for name in model.inputs},
        "targets": {**{name: (*small, 3) for name in images}, **codes, "outcome": ()},
    }
    for kind, values in (("inputs", arrays.inputs), ("targets", arrays.targets)):
        found = {name: x.shape[1:] for name, x in values.items()}
        if found != expected[kind]:
            raise ValueError(
                f"`{kind}` has samples of the shapes {found}, but the model needs samples of the shapes "
                f"{expected[kind]}: make the arrays with training.state_arrays"
            )
    if {name: x.shape for name, x in arrays.empty.items()} != {name: (*size, 3) for name in statespace.IMAGES}:
        raise ValueError(
            f"`empty` has the shapes { {name: x.shape for name, x in arrays.empty.items()} }, but it must have "
            f"`visual` and `tactile` images of shape {(*size, 3)}: make them with dataset.empty_frame"
        )
    further = {
        "views": {"visual": (*size, 3), "state": (statespace.STATE_CODE,)},
        "falls": {**codes, "outcome": (), **({"condition": (model.condition,)} if model.condition else {})},
    }
    for kind, values in (("views", arrays.views), ("falls", arrays.falls)):
        found = {name: x.shape[1:] for name, x in values.items()}
        if values and (found != further[kind] or len({len(x) for x in values.values()}) > 1):
            shapes = {name: x.shape for name, x in values.items()}
            raise ValueError(
                f"`{kind}` has arrays of the shapes {shapes}, but all arrays must have the same number of samples "
                f"(first axis), and the samples must have the shapes {further[kind]}: make the arrays with "
                "training.state_arrays"
            )
    for outcome in (own["outcome"] for own in (arrays.targets, arrays.falls) if own):
        if not np.issubdtype(outcome.dtype, np.integer) or outcome.min() < 0 or outcome.max() >= model.outcomes:
            raise ValueError(
                f"`outcome` has the type {outcome.dtype} and values from {outcome.min()} to {outcome.max()}, but the "
                f"model needs integers from 0 to {model.outcomes - 1}: give integers in this range, or a model with "
                "more outcomes"
            )
    _check_condition(model.condition, arrays)


def _check_condition(expected: int, arrays: Arrays) -> None:
    """Raise a ValueError if the condition of the training set has another width than the model needs."""
    width = 0 if arrays.condition is None else arrays.condition.shape[1]
    if width != expected:
        found = "None" if arrays.condition is None else f"an array of width {width}"
        needed = f"an array of width {expected}" if expected else "None"
        raise ValueError(
            f"`condition` is {found}, but it must be {needed} for a model with condition={expected}: change the data, "
            f"or make a model with condition={width}"
        )


def _check_paper(model: mvae.Config, arrays: Arrays, absent: tuple[str, ...]) -> None:
    """Raise a ValueError if a training set does not fit an `mvae` model."""
    for name in absent:
        if name not in model.names:
            raise ValueError(
                f"`absent` contains {name!r}, but the model has only the modalities {sorted(model.names)}: remove "
                "this name"
            )
        if np.any(arrays.present.get(name, False)):
            raise ValueError(
                f"`absent` contains {name!r}, but some samples have this modality: remove the name from `absent`. The "
                f"number of True values in `present[{name!r}]` is {int(np.sum(arrays.present[name]))}"
            )
    for kind, values in (("inputs", arrays.inputs), ("targets", arrays.targets)):
        needed = set(model.names) - (set(absent) if kind == "inputs" else set())
        if not needed <= set(values) <= set(model.names):
            raise ValueError(
                f"`{kind}` has the modalities {sorted(values)}, but the model needs {sorted(needed)} and allows only "
                f"{sorted(model.names)}: add or remove arrays, or add the names of missing inputs to `absent`"
            )
    for kind, masks in (("present", arrays.present), ("target_present", arrays.target_present)):
        if not set(masks) <= set(model.names):
            raise ValueError(
                f"`{kind}` has masks for {sorted(masks)}, but the model has only the modalities {sorted(model.names)}: "
                "remove all other masks"
            )
    for modality in model.modalities:
        for values in (arrays.inputs, arrays.targets):
            if modality.name in values and values[modality.name].shape[1:] != modality.shape:
                raise ValueError(
                    f"modality {modality.name!r}: the samples have the shape {values[modality.name].shape[1:]}, but "
                    f"the model needs the shape {modality.shape}: change the samples or the model"
                )
    _check_condition(model.condition, arrays)
