"""What differs between the trainings of `mvae` and `statespace` models: initialisation, loss, check of the arrays."""

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
    """A loss: a pure function of a model, a random key and one batch, which `jax.grad` and `jax.jit` can trace."""

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
            params: Parameters of the model. The loss is differentiated by them.
            key: Random key, another one in every step.
            batch: Arrays of the batch, from `Arrays.take`, with images as float32 in [0, 1].
            beta: Weight of the divergence, which rises from 0 to 1 over the share `TrainConfig.beta_warmup` of the
                steps.

        Returns:
            The loss, and a pair of the new running batch statistics (`stats` if the loss does not change them) and
            scalars by name for the training log. One of them must be `loss`. The training stops if it is not finite.
        """
        ...


class Learner(NamedTuple):
    """The functions that train one model."""

    config: Config  # configuration of the model
    # Takes a random key. Returns the definition of the model, its parameters and its running batch statistics
    init: Callable[[Array], tuple[nnx.GraphDef[Any], nnx.State, nnx.State]]
    loss: Loss
    check: Callable[[Arrays], None]  # raises a ValueError if a training set does not fit the model


def learner(model: Config, *, targets: Literal["all", "own"] = "all", absent: tuple[str, ...] = ()) -> Learner:
    """Make the learner of a model, with the loss `mvae.loss` or `statespace.loss`.

    Args:
        targets: For `mvae` models: modalities to predict from each subset of the inputs, every modality (`all`) or only
            those in the subset (`own`).
        absent: For `mvae` models: names of modalities that are not inputs of any sample.
    """

    def paper_loss(
        graphdef: nnx.GraphDef[Any], params: nnx.State, stats: nnx.State, key: PRNGKeyArray, batch: Batch, beta: Array
    ) -> tuple[Array, tuple[nnx.State, Terms]]:
        batch = {name: value for name, value in batch.items() if name != "empty"}
        total, (stats, terms) = mvae.loss(
            graphdef, params, stats, key, **batch, beta=beta, asked=targets, absent=absent
        )
        return total, (stats, {"loss": terms.loss, "kl": terms.kl, **terms.reconstruction})

    def state_loss(
        graphdef: nnx.GraphDef[Any], params: nnx.State, stats: nnx.State, key: PRNGKeyArray, batch: Batch, beta: Array
    ) -> tuple[Array, tuple[nnx.State, Terms]]:
        batch = {name: value for name, value in batch.items() if name != "target_present"}
        total, terms = statespace.loss(graphdef, params, key, **batch, beta=beta)
        return total, (stats, {"loss": total, **terms})

    if isinstance(model, mvae.Config):
        return Learner(
            model, lambda key: mvae.init(key, model), paper_loss, lambda arrays: _check_paper(model, arrays, absent)
        )
    return Learner(
        model, lambda key: statespace.init(key, model), state_loss, lambda arrays: _check_state(model, arrays)
    )


def _check_state(model: statespace.Config, arrays: Arrays) -> None:
    """Raise a ValueError if a training set does not fit a state-space model."""
    if arrays.target_present or not set(arrays.present) <= set(model.inputs):
        raise ValueError(
            f"`present` may have masks for {list(model.inputs)} only, and `target_present` for nothing, got "
            f"{sorted(arrays.present)} and {sorted(arrays.target_present)}"
        )
    size, small = (model.input_size,) * 2, (model.image_size,) * 2
    ends = {"state": (statespace.STATE_CODE,), "pose": (statespace.POSE_CODE,), "outcome": ()}
    expected: dict[str, dict[str, tuple[int, ...]]] = {
        "inputs": {name: (statespace.POSE_CODE,) if name == "pose" else (*size, 3) for name in model.inputs},
        "targets": {**{name: (*small, 3) for name in statespace.IMAGES}, **ends},
        "views": {"visual": (*size, 3), "state": ends["state"]},
        "falls": {**ends, **({"condition": (model.condition,)} if model.condition else {})},
    }
    for kind, shapes in expected.items():
        values = getattr(arrays, kind)
        actual = {name: x.shape[1:] for name, x in values.items()}
        optional = kind in ("views", "falls") and not values
        if not optional and (actual != shapes or len({len(x) for x in values.values()}) > 1):
            raise ValueError(
                f"`{kind}` has the shapes { {name: x.shape for name, x in values.items()} }, but the model needs the "
                f"shapes {shapes} after an axis of one length: make the arrays with training.state_arrays"
            )
    empty = {name: x.shape for name, x in arrays.empty.items()}
    if empty != {name: (*size, 3) for name in statespace.IMAGES}:
        raise ValueError(
            f"`empty` has the shapes {empty}, but it must have `visual` and `tactile` images of shape {(*size, 3)}: "
            "make them with dataset.empty_frame"
        )
    for outcome in (values["outcome"] for values in (arrays.targets, arrays.falls) if values):
        if not np.issubdtype(outcome.dtype, np.integer) or outcome.min() < 0 or outcome.max() >= model.outcomes:
            raise ValueError(
                f"`outcome` must be integers from 0 to {model.outcomes - 1}, got {outcome.dtype} from {outcome.min()} "
                f"to {outcome.max()}"
            )
    _check_condition(model.condition, arrays)


def _check_condition(expected: int, arrays: Arrays) -> None:
    """Raise a ValueError if the condition of the training set has another width than the model needs."""
    width = 0 if arrays.condition is None else arrays.condition.shape[1]
    if width != expected:
        raise ValueError(
            f"`condition` has width {width}, but the model has condition={expected}: change the data, or make a model "
            f"with condition={width}"
        )


def _check_paper(model: mvae.Config, arrays: Arrays, absent: tuple[str, ...]) -> None:
    """Raise a ValueError if a training set does not fit an `mvae` model."""
    names = set(model.names)
    for name in absent:
        if name not in names or np.any(arrays.present.get(name, False)):
            raise ValueError(
                f"`absent` contains {name!r}, but the model has the modalities {sorted(names)}, and "
                f"{int(np.sum(arrays.present.get(name, 0)))} samples have {name}: remove the name from `absent`"
            )
    for kind, values in (("inputs", arrays.inputs), ("targets", arrays.targets)):
        needed = names - (set(absent) if kind == "inputs" else set())
        if not needed <= set(values) <= names:
            raise ValueError(
                f"`{kind}` has the modalities {sorted(values)}, but the model needs {sorted(needed)} and allows only "
                f"{sorted(names)}: add or remove arrays, or add the names of missing inputs to `absent`"
            )
        for modality in model.modalities:
            if modality.name in values and values[modality.name].shape[1:] != modality.shape:
                raise ValueError(
                    f"modality {modality.name!r}: the samples of `{kind}` have the shape "
                    f"{values[modality.name].shape[1:]}, but the model needs {modality.shape}"
                )
    for kind, masks in (("present", arrays.present), ("target_present", arrays.target_present)):
        if not set(masks) <= names:
            raise ValueError(f"`{kind}` has masks for {sorted(masks)}, but the model has only {sorted(names)}")
    _check_condition(model.condition, arrays)
