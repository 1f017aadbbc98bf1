"""The parts of a training that differ between the kinds of models: initialisation, loss and the check of the arrays."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from flax import nnx
from jaxtyping import Array, Float, PRNGKeyArray

from sts_jax import mvae, statespace
from sts_jax.training.arrays import Arrays, Batch

Config = mvae.Config | statespace.Config  # of a model of either kind
Terms = dict[str, Array]  # the parts of a loss, scalars by name


@runtime_checkable
class Loss(Protocol):
    """The loss of one batch, a pure function that `jax.grad` and `jax.jit` trace."""

    def __call__(
        self,
        graphdef: nnx.GraphDef[Any],
        params: nnx.State,
        stats: nnx.State,
        key: PRNGKeyArray,
        batch: Batch,
        beta: Float[Array, ""],
    ) -> tuple[Float[Array, ""], tuple[nnx.State, Terms]]:
        """Compute the loss.

        Args:
            graphdef: definition of the model.
            params: parameters, by which the loss is differentiated.
            stats: running batch statistics.
            key: a key of this step, consumed.
            batch: from `Arrays.take`, with images in float32, [0, 1].
            beta: weight of the divergence, which rises from 0 to 1 over `TrainConfig.beta_warmup`.

        Returns:
            The loss, and a pair: the new batch statistics (`stats` if the loss changes none), and the scalars of a
            record by name. One of them is `loss`, which must be finite.
        """
        ...


class Learner(NamedTuple):
    """Initialisation, loss and check of one model."""

    config: Config
    init: Callable[[Array], tuple[nnx.GraphDef[Any], nnx.State, nnx.State]]  # from a key: definition, params, stats
    loss: Loss
    check: Callable[[Arrays], None]  # raises ValueError for arrays that do not fit


def learner(model: Config, *, targets: Literal["all", "own"] = "all", absent: tuple[str, ...] = ()) -> Learner:
    """The learner of a model.

    Args:
        model: the configuration of the model.
        targets: for `mvae` models, the argument `asked` of `mvae.loss`.
        absent: for `mvae` models, the argument `absent` of `mvae.loss`.
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
    """Raise a ValueError if the arrays do not fit a state-space model."""
    if arrays.target_present or not set(arrays.present) <= set(model.inputs):
        raise ValueError(
            f"present has masks for {sorted(arrays.present)}, target_present has masks for "
            f"{sorted(arrays.target_present)}, but the "
            f"model takes masks only of its inputs {list(model.inputs)}: remove the others"
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
                f"{kind} have samples of {found}, but the model takes {expected[kind]}: make them with state_moments"
            )
    if {name: x.shape for name, x in arrays.empty.items()} != {name: (*size, 3) for name in statespace.IMAGES}:
        raise ValueError(f"empty needs `visual` and `tactile` of shape {(*size, 3)}, from dataset.empty_frame")
    further = {
        "views": {"visual": (*size, 3), "state": (statespace.STATE_CODE,)},
        "falls": {**codes, "outcome": (), **({"condition": (model.condition,)} if model.condition else {})},
    }
    for kind, values in (("views", arrays.views), ("falls", arrays.falls)):
        found = {name: x.shape[1:] for name, x in values.items()}
        if values and (found != further[kind] or len({len(x) for x in values.values()}) > 1):
            shapes = {name: x.shape for name, x in values.items()}
            raise ValueError(
                f"{kind} has {shapes}, but it takes equally many samples of {further[kind]}: make them with "
                "state_moments"
            )
    for outcome in (own["outcome"] for own in (arrays.targets, arrays.falls) if own):
        if not np.issubdtype(outcome.dtype, np.integer) or outcome.min() < 0 or outcome.max() >= model.outcomes:
            raise ValueError(
                f"outcome is {outcome.dtype} from {outcome.min()} to {outcome.max()}, but the model takes whole "
                f"numbers from 0 to {model.outcomes - 1}: give such numbers, or a model of more outcomes"
            )
    _check_condition(model.condition, arrays)


def _check_condition(expected: int, arrays: Arrays) -> None:
    """Raise a ValueError if the condition has another width than that of the model."""
    width = 0 if arrays.condition is None else arrays.condition.shape[1]
    if width != expected:
        raise ValueError(
            f"condition has width {width}, but the model takes {expected}: give arrays of this width, or a model with "
            f"condition={width}"
        )


def _check_paper(model: mvae.Config, arrays: Arrays, absent: tuple[str, ...]) -> None:
    """Raise a ValueError if the arrays do not fit an `mvae` model."""
    for name in absent:
        if np.any(arrays.present.get(name, False)):
            raise ValueError(
                f"{name} is declared absent, but {int(np.sum(arrays.present[name]))} samples have it: remove it from "
                "`absent`"
            )
    for kind, values in (("inputs", arrays.inputs), ("targets", arrays.targets)):
        needed = set(model.names) - (set(absent) if kind == "inputs" else set())
        if not needed <= set(values) <= set(model.names):
            raise ValueError(
                f"{kind} has {sorted(values)}, but the model {sorted(model.names)} needs {sorted(needed)}: give these, "
                "or name the missing inputs in `absent`"
            )
    for kind, masks in (("present", arrays.present), ("target_present", arrays.target_present)):
        if not set(masks) <= set(model.names):
            raise ValueError(
                f"{kind} has masks for {sorted(masks)}, but the model has {sorted(model.names)}: remove the others"
            )
    for modality in model.modalities:
        for values in (arrays.inputs, arrays.targets):
            if modality.name in values and values[modality.name].shape[1:] != modality.shape:
                raise ValueError(
                    f"{modality.name}: arrays of shape {values[modality.name].shape[1:]}, but the model's Modality has "
                    f"shape {modality.shape}: give arrays of that shape, or a model with the arrays' shape"
                )
    _check_condition(model.condition, arrays)
