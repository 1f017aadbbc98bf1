"""Linear probes: what the latent of an `mvae` model tells about the object and its contact, beside the model's inputs.

A probe is a ridge regression to a quantity of the first frame. Its features are either the mean of the latent's
posterior, given a subset of the inputs, or these inputs themselves: images reduced to 16 x 16 pixels, and encoded
poses. The probe of the class has a target for each class (1 for members, 0 for others), and the largest prediction
decides. Probes are fitted to the training objects. For each quantity, the penalty with the smallest error on the
validation objects is used.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sts_jax import mvae
from sts_jax._checked import in_32_bits
from sts_jax.dataset import Dataset, Pairs, reduced_images
from sts_jax.evaluation import metrics
from sts_jax.evaluation.predictions import in_unit, subsets
from sts_jax.evaluation.results import cell, head, row

SIDE = 16  # pixels, side of the reduced images: few, so that a regression to the images is well-posed
PENALTIES = 10.0 ** np.arange(-6, 5)  # tried penalties, see `ridge`
CLASS = "class"
_HEADINGS = {  # columns of the table by the name of the quantity
    CLASS: "class, accuracy",
    "size": "size, R2",
    "colour": "mean colour, R2",
    "force": "vertical force, R2",
    "area": "contact area, R2",
}
_PARTS = ("train", "validation", "test")
_CHUNK = 64  # number of images that one call encodes


class Quantities(NamedTuple):
    """What the probes find, for the first frames of n trajectories. NaN where a quantity is not defined."""

    label: np.ndarray  # int (n,): index of the object's class among the sorted names
    size: np.ndarray  # (n, 1): mean width of the object's hull over all directions (m)
    colour: np.ndarray  # (n, 3): mean of the object's pixels in the visual image, sRGB in [0, 1]
    force: np.ndarray  # (n, 1): component of the pad's force on the object along z (N)
    area: np.ndarray  # (n, 1): share of the pixels of the tactile image that differ from the image of the empty sensor


def quantities(
    data: Dataset, pairs: Pairs, names: Sequence[str], blank: np.ndarray, *, threshold: float = 3 / 255
) -> Quantities:
    """Determine the quantities of the probes from the simulation and the images of the first frames.

    Args:
        data: The dataset of `pairs`, which has the forces.
        names: Class of each object of the collection, from `dataset.class_names`.
        blank: Tactile image of the empty sensor, uint8 or in [0, 1].
        threshold: Difference of a channel from which a pixel counts as changed by the contact.
    """
    classes = sorted(set(names))
    seen = pairs.segmentation[:, 0, ..., None]
    count = seen.sum((1, 2), dtype=np.float64)
    colour = (in_unit(pairs.visual[:, 0]) * seen).sum((1, 2), dtype=np.float64)
    changed = np.abs(in_unit(pairs.tactile[:, 0]) - in_unit(blank)).max(-1) > threshold
    return Quantities(
        label=np.array([classes.index(names[index]) for index in pairs.object]),
        size=2 * pairs.support.mean(1, keepdims=True, dtype=np.float64),
        colour=np.where(count > 0, colour / np.maximum(count, 1), np.nan),
        force=data.trajectory["wrench"][pairs.trajectory, _frame(pairs), 2:3].astype(np.float64),
        area=changed.mean((1, 2))[:, None],
    )


def ridge(
    features: np.ndarray, targets: np.ndarray, penalties: np.ndarray = PENALTIES
) -> tuple[np.ndarray, np.ndarray]:
    """Fit linear maps `y = x W + b`, one for each penalty, in closed form.

    They minimise `mean_n |y_n - x_n W - b|^2 + penalty v |W|^2`, with the mean variance v of the features.

    Args:
        features: `(n, d)`.
        targets: `(n, t)`.
        penalties: `(p,)`.

    Returns:
        W `(p, d, t)` and b `(p, t)`. W is 0 if all features are constant.
    """
    centre, level = features.mean(0), targets.mean(0)
    left, spread, right = np.linalg.svd(features - centre, full_matrices=False)
    scale = (spread**2).sum() / features.shape[1]
    gain = spread / np.maximum(spread**2 + penalties[:, None] * scale, np.finfo(np.float64).tiny)
    weights = right.T @ (gain[..., None] * (left.T @ (targets - level)))
    return weights, level - centre @ weights


def _frame(pairs: Pairs) -> np.ndarray:
    """Numbers of the first frames, int `(n,)`."""
    return np.zeros(len(pairs.object), np.int64) if pairs.frame is None else pairs.frame[:, 0]


@in_32_bits
def latents(predictor: Any, inputs: Sequence[str], pairs: Pairs) -> np.ndarray:
    """Means of the latent's posterior of an `mvae` model, `(n, latent)`, given some inputs in the first frames.

    Args:
        predictor: A `sts_jax.Predictor` of an `mvae` model.
        inputs: Some of `visual`, `tactile` and `pose`.
    """
    model, view, blank = predictor.model, predictor.preprocessing, predictor.empty["tactile"]
    condition = None
    if model.config.condition:
        condition = pairs.condition
        if view.stride is not None:  # a one-step model also receives the time since frame 0
            condition = np.column_stack([condition, _frame(pairs) * view.period / view.stride])
    parts = []
    for start in range(0, len(pairs.object), _CHUNK):
        rows = np.minimum(np.arange(start, start + _CHUNK), len(pairs.object) - 1)
        given = {name: jnp.asarray(in_unit(getattr(pairs, name)[rows, 0])) for name in inputs}
        some = None if condition is None else jnp.asarray(condition[rows], jnp.float32)
        parts.append(np.asarray(_means(model.graphdef, model.state, view, jnp.asarray(blank), given, some)))
    return np.concatenate(parts)[: len(pairs.object)]


@functools.partial(jax.jit, static_argnames=("graphdef", "view"))
def _means(
    graphdef: Any, state: Any, view: Any, blank: Array, given: dict[str, Array], condition: Array | None
) -> Float[Array, "n latent"]:
    present = {"tactile": view.touched(given["tactile"], blank)} if "tactile" in given else {}
    codes = {name: view.encode(name, values) for name, values in given.items()}
    if condition is not None:
        condition = view.encode_condition(condition)
    return mvae.infer(graphdef, state, codes, present=present, condition=condition).mean


def raw(predictor: Any, inputs: Sequence[str], pairs: Pairs) -> np.ndarray:
    """The inputs in the first frames as features `(n, d)`: images of at most 16 x 16 pixels, and encoded poses."""
    parts = []
    for name in inputs:
        values = getattr(pairs, name)[:, 0]
        if name == "pose":
            values = np.asarray(predictor.preprocessing.encode_pose(jnp.asarray(values)))
        else:
            values = in_unit(reduced_images({name: values}, min(SIDE, values.shape[1]))[name])
        parts.append(values.reshape(len(values), -1).astype(np.float64))
    return np.concatenate(parts, 1)


def errors(features: Mapping[str, np.ndarray], found: Mapping[str, Quantities]) -> dict[str, np.ndarray]:
    """Fit a probe of each quantity, and compute its error and the reference error of held-out trajectories, `(n, 2)`.

    The error is the squared error, and the reference that of the training mean, or 1 for a wrong class with reference
    1. So 1 minus the ratio of their sums is R2 or the accuracy. A quantity that is constant in the training or the
    held-out trajectories is left out.

    Args:
        features: Features of each part `train`, `validation` and `test`, `(n, d)`.
        found: The quantities of each part.
    """
    number = 1 + max(int(part.label.max()) for part in found.values())
    wanted = {part: found[part]._asdict() | {CLASS: np.eye(number)[found[part].label]} for part in _PARTS}
    names = [name for name in _HEADINGS if all(np.ptp(wanted[part][name], axis=0).any() for part in ("train", "test"))]
    targets = np.concatenate([wanted["train"][name] for name in names], 1)
    weights, offsets = ridge(features["train"], targets)
    result, column = {}, 0
    for name in names:
        columns = slice(column, column := column + wanted["train"][name].shape[1])

        def error(part: str, k: int, name: str = name, columns: slice = columns) -> np.ndarray:
            predicted, true = features[part] @ weights[k][:, columns] + offsets[k][columns], wanted[part][name]
            return predicted.argmax(1) != true.argmax(1) if name == CLASS else ((predicted - true) ** 2).sum(1)

        # Of equal errors, the largest penalty wins.
        best = min(reversed(range(len(PENALTIES))), key=lambda k: error("validation", k).mean())
        test = error("test", best).astype(np.float64)
        reference = ((wanted["test"][name] - targets[:, columns].mean(0)) ** 2).sum(1)
        result[name] = np.stack([test, np.ones_like(test) if name == CLASS else reference], 1)
    return result


def probe(
    predictor: Any, data: Dataset, pairs: Mapping[str, Pairs], names: Sequence[str], *, num: int = 2000, seed: int = 0
) -> dict:
    """Probe the latent and the inputs of an `mvae` model for each subset of its inputs, on held-out objects.

    A trajectory whose first image does not show the object is left out.

    Args:
        predictor: A `sts_jax.Predictor` of an `mvae` model, of the last frame or of one step.
        data: The dataset of `pairs`.
        pairs: Trajectories of the parts `train`, `validation` and `test`, in the resolution of the model.
        names: Class of each object of the collection, from `dataset.class_names`.
        num: Number of bootstrap samples of the objects.

    Returns:
        A dictionary that can be written as JSON, with the following entries.

        - `items`, `objects`, `classes`: Numbers of held-out trajectories and objects, and of classes.
        - `chance`: Accuracy of the most common class of the training trajectories.
        - `probes`: By the description of the inputs (`evaluation.subsets`) and the name of the quantity, the results
            from the `latent` and from the `raw` inputs, and their `difference` (latent minus raw). Each is a dictionary
            as in `evaluation.summarise`: the accuracy of the class, or R2, which is 1 minus the squared error divided
            by that of the training mean. None for a constant quantity, such as the force before a fall.
    """
    if not isinstance(predictor.model.config, mvae.Config):
        raise ValueError(f"{predictor.name} is not an mvae model: give the predictor of an mvae model")
    if lacking := set(_PARTS) - set(pairs):
        raise ValueError(f"`pairs` lacks the parts {sorted(lacking)}: give the pairs of {', '.join(_PARTS)}")
    kept, found = {}, {}
    for part in _PARTS:
        threshold = predictor.preprocessing.touch_threshold
        every = quantities(data, pairs[part], names, predictor.empty["tactile"], threshold=threshold)
        rows = np.flatnonzero(~np.isnan(every.colour).any(1))
        if not len(rows):
            raise ValueError(f"no first image of the part {part!r} shows an object: give pairs of other trajectories")
        kept[part], found[part] = pairs[part].take(rows), Quantities(*(leaf[rows] for leaf in every))
    described = subsets([name for name in predictor.modalities if name in ("visual", "tactile", "pose")])
    results = {}
    for text, inputs in described.items():
        if inputs:
            latent, given = (
                errors({part: function(predictor, inputs, kept[part]) for part in _PARTS}, found)
                for function in (latents, raw)
            )
            results[text] = {
                name: _compared(latent[name], given[name], kept["test"].object, num, seed) if name in latent else None
                for name in _HEADINGS
            }
    label = found["test"].label
    return {
        "items": len(label),
        "objects": len(np.unique(kept["test"].object)),
        "classes": len(set(names)),
        "chance": float((label == np.bincount(found["train"].label).argmax()).mean()),
        "probes": results,
    }


def _compared(
    latent: np.ndarray, given: np.ndarray, objects: np.ndarray, num: int, seed: int
) -> dict[str, dict | None]:
    def statistic(weight: np.ndarray) -> np.ndarray:
        one, two = (metrics.skill(values[:, 0], values[:, 1], weight) for values in (latent, given))
        return np.array([one, two, one - two])

    value, draws = statistic(np.ones(len(objects))), metrics.bootstrap(objects, statistic, num=num, seed=seed)
    return {name: cell(value[i], draws[:, i]) for i, name in enumerate(("latent", "raw", "difference"))}


def probes_table(summary: Mapping[str, Any], *, title: str) -> str:
    """Format the result of `probe` as a Markdown table. A latent or input that is significantly better is bold."""
    lines = head(["probe", *_HEADINGS.values()])
    for text, results in summary["probes"].items():
        for kind, sign in (("latent", 1), ("raw", -1)):
            cells = [_shown(results[name], kind, sign) for name in _HEADINGS]
            lines.append(row([f"{text}: {'latent' if kind == 'latent' else 'inputs'}", *cells]))
    note = (
        f"{summary['items']} held-out trajectories of {summary['objects']} objects of {summary['classes']} classes. "
        "Linear probes of the first frame, from the mean of the latent, and from the inputs themselves (images reduced "
        f"to {SIDE} x {SIDE} pixels, encoded poses). They are ridge regressions, fitted to the training objects, with "
        "the penalty that is best for the validation objects. R2 is 1 minus the squared error divided by that of the "
        f"training mean. The most common class has the accuracy {summary['chance']:.2f}. Size is the mean width of the "
        "hull, mean colour that of the object's pixels in the visual image, and contact area the share of changed "
        "pixels in the tactile image. Brackets contain 95 % bootstrap intervals over objects. Bold: the better of "
        "latent and inputs, if the interval of their difference excludes 0. A quantity with - is constant."
    )
    return "\n".join([f"# {title}", "", note, "", *lines, ""])


def _shown(results: Mapping[str, Mapping | None] | None, kind: str, sign: int) -> str:
    value = None if results is None else results[kind]
    if results is None or value is None:
        return "-"
    text, difference = metrics.written(**value, digits=2), results["difference"]
    limits = [] if difference is None else [sign * x for x in (difference["low"], difference["high"]) if x is not None]
    return f"**{text}**" if limits and min(limits) > 0 else text
