"""Predictions on held-out objects, scored, compared and written as a table."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sts_jax import physics
from sts_jax.dataset import Pairs
from sts_jax.evaluation import metrics


class Predicted(NamedTuple):
    """What some predictor says of the last moment of `n` trajectories; None where it says nothing."""

    visual: np.ndarray | None = None  # float (n, height, width, 3) in [0, 1]
    tactile: np.ndarray | None = None  # float (n, height, width, 3)
    pose: np.ndarray | None = None  # float (n, 7)
    outcome: np.ndarray | None = None  # int (n,), physics.Outcome


class Scores(NamedTuple):
    """Errors of one predictor, per item."""

    visual: metrics.ImageError | None
    visual_object: metrics.ImageError | None
    tactile: metrics.ImageError | None
    tactile_object: metrics.ImageError | None
    position: np.ndarray | None  # m (n,)
    angle: np.ndarray | None  # rad (n,)
    axis: np.ndarray | None  # rad (n,), of the up axes
    outcome: np.ndarray | None  # int (n,)


CONSTANT, COPY, NEIGHBOUR = "constant (mean training target)", "copy of the input", "nearest neighbour"


def outcome_of_pose(scenario: physics.Scenario, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """`scenario.outcome` of poses `(n, 7)`, true or predicted."""
    return np.asarray(jax.vmap(scenario.outcome)(jnp.asarray(first), jnp.asarray(last)))


def outcome_of_image(visual: np.ndarray, blank: np.ndarray, threshold: float) -> np.ndarray:
    """The outcome of freefall as an image shows it: off the pad where it is closer to the empty one than a threshold.

    How a thing lies that is still on the pad is not read from images: there is no outcome of other scenarios.
    """
    empty = emptiness(visual, blank) <= threshold
    return np.where(empty, int(physics.Outcome.FELL_OFF), int(physics.Outcome.RESTS))


def emptiness(visual: np.ndarray, blank: np.ndarray) -> np.ndarray:
    """Mean absolute difference `(n,)` of images `(n, height, width, 3)` in [0, 1] from the empty sensor's."""
    return np.abs(visual - blank).mean((1, 2, 3))


def baselines(scenario: physics.Scenario, train: Pairs, test: Pairs) -> dict[str, Predicted]:
    """What can be said without learning: the mean target, the input itself, the target of the nearest input.

    The neighbour is the training item whose first visual image is nearest in squared distance. With a condition, its
    squared distance counts as much: both are divided by the training set's variance, the condition's number by number.
    """
    inputs = train.visual[:, 0].reshape(len(train.visual), -1).astype(np.float32)
    queries = test.visual[:, 0].reshape(len(test.visual), -1).astype(np.float32)
    distance = (inputs**2).sum(1) - 2 * queries @ inputs.T
    width = train.condition.shape[1]
    if width:
        variance = float(((inputs - inputs.mean(0)) ** 2).sum(1).mean())
        gap = test.condition[:, None] - train.condition[None]
        distance = distance / variance + (gap**2 / train.condition.var(0)).sum(-1) / width
    nearest = distance.argmin(1)
    num = len(test.visual)

    def repeat(mean: np.ndarray) -> np.ndarray:
        return np.broadcast_to(mean, (num, *mean.shape))

    mean_pose = train.pose[:, 1].mean(0)
    mean_pose[3:] /= max(np.linalg.norm(mean_pose[3:]), 1e-6)
    majority = np.bincount(train.outcome).argmax()
    return {
        CONSTANT: Predicted(
            repeat(train.visual[:, 1].mean(0) / 255),
            repeat(train.tactile[:, 1].mean(0) / 255),
            repeat(mean_pose),
            np.full(num, majority),
        ),
        COPY: Predicted(
            test.visual[:, 0] / 255,
            test.tactile[:, 0] / 255,
            test.pose[:, 0],
            outcome_of_pose(scenario, test.pose[:, 0], test.pose[:, 0]),
        ),
        NEIGHBOUR: Predicted(
            train.visual[nearest, 1] / 255,
            train.tactile[nearest, 1] / 255,
            train.pose[nearest, 1],
            train.outcome[nearest],
        ),
    }


def score(predicted: Predicted, test: Pairs) -> Scores:
    """Errors per item of a prediction of the last moment."""
    inside = test.segmentation[:, 1]

    def images(image: np.ndarray | None, target: np.ndarray, mask: np.ndarray | None) -> metrics.ImageError | None:
        return None if image is None else metrics.image_error(image, target / 255, mask)

    pose = predicted.pose
    return Scores(
        images(predicted.visual, test.visual[:, 1], None),
        images(predicted.visual, test.visual[:, 1], inside),
        images(predicted.tactile, test.tactile[:, 1], None),
        images(predicted.tactile, test.tactile[:, 1], inside),
        None if pose is None else metrics.position_error(pose, test.pose[:, 1]),
        None if pose is None else metrics.geodesic_angle(pose, test.pose[:, 1]),
        None if pose is None else metrics.axis_angle(pose, test.pose[:, 1]),
        predicted.outcome,
    )


def summarise(scores: Mapping[str, Scores], test: Pairs, *, num: int = 2000, seed: int = 0) -> dict:
    """All figures of all predictors with 95 % intervals over objects, and the differences from the baselines.

    Args:
        scores: By name; the constant, the copy and the neighbour must be among them.
        test: The items that were scored.
        num: Bootstrap draws.
        seed: Of the draws.

    Returns:
        A JSON-able dictionary: `items`, `objects`, `outcomes`, `predictors` (name -> figure -> value, low, high), and
        `differences` (name -> baseline -> figure -> value, low, high), where a positive difference of skill and a
        negative difference of an error speak for the predictor.
    """
    stayed = test.outcome != int(physics.Outcome.FELL_OFF)

    def figures(weight: np.ndarray) -> np.ndarray:
        return np.stack([_figures(s, scores[CONSTANT], test, stayed, weight) for s in scores.values()])

    value = figures(np.ones(len(test.object)))
    draws = metrics.bootstrap(test.object, figures, num=num, seed=seed)
    names = list(scores)

    def cell(number: float, sample: np.ndarray) -> dict | None:
        if not np.isfinite(number):
            return None
        low, high = metrics.interval(sample)
        return {"value": float(number), "low": low, "high": high}

    def column(values: np.ndarray, sample: np.ndarray) -> dict:
        return {f: cell(values[k], sample[:, k]) for k, f in enumerate(FIGURES)}

    reference = {name: names.index(name) for name in (CONSTANT, COPY, NEIGHBOUR)}
    return {
        "items": len(test.object),
        "objects": len(np.unique(test.object)),
        "outcomes": {physics.Outcome(o).name.lower(): int((test.outcome == o).sum()) for o in np.unique(test.outcome)},
        "predictors": {name: column(value[i], draws[:, i]) for i, name in enumerate(names)},
        "differences": {
            name: {base: column(value[i] - value[j], draws[:, i] - draws[:, j]) for base, j in reference.items()}
            for i, name in enumerate(names)
            if name not in reference
        },
    }


# The figures of a predictor: per stream BCE and excess (nats a pixel and channel), skill over all pixels and over the
# target's object pixels; position (m), angle and angle of the up axes (rad) over all items and over those that stayed
# on the pad.
FIGURES = (
    *(f"{s}_{f}{p}" for s in ("visual", "tactile") for f in ("bce", "excess", "skill") for p in ("", "_object")),
    *("position", "position_on_pad", "angle", "angle_on_pad", "axis", "axis_on_pad", "outcome_balanced_accuracy"),
)


def _figures(s: Scores, constant: Scores, test: Pairs, stayed: np.ndarray, weight: np.ndarray) -> np.ndarray:
    out: list[float] = []
    for stream in ("visual", "tactile"):
        errors = [getattr(s, stream), getattr(s, f"{stream}_object")]
        references = [getattr(constant, stream), getattr(constant, f"{stream}_object")]
        for kind in ("bce", "excess"):
            out += [
                float("nan") if e is None else metrics.mean_per_pixel(getattr(e, kind), e.pixels, weight)
                for e in errors
            ]
        out += [
            float("nan") if e is None else metrics.skill(e, r, weight) for e, r in zip(errors, references, strict=True)
        ]
    for error in (s.position, s.angle, s.axis):
        for keep in (np.ones_like(stayed), stayed):
            w = weight * keep
            out.append(float("nan") if error is None or w.sum() == 0 else float((w * error).sum() / w.sum()))
    out.append(float("nan") if s.outcome is None else metrics.balanced_accuracy(s.outcome, test.outcome, weight))
    return np.array(out)


def table(summary: dict, *, title: str, notes: Sequence[str] = ()) -> str:
    """The summary as Markdown: one row a predictor, then the differences from the baselines."""
    heads = [
        ("visual BCE", "visual_bce", 1, 4),
        ("visual excess x1e-4", "visual_excess", 1e4, 1),
        ("visual skill", "visual_skill", 1, 3),
        ("visual on object", "visual_skill_object", 1, 3),
        ("tactile BCE", "tactile_bce", 1, 4),
        ("tactile excess x1e-4", "tactile_excess", 1e4, 1),
        ("tactile skill", "tactile_skill", 1, 3),
        ("tactile on object", "tactile_skill_object", 1, 3),
        ("position (mm)", "position", 1e3, 1),
        ("on pad", "position_on_pad", 1e3, 1),
        ("angle (deg)", "angle", 180 / np.pi, 0),
        ("on pad", "angle_on_pad", 180 / np.pi, 0),
        ("up axis (deg)", "axis", 180 / np.pi, 0),
        ("on pad", "axis_on_pad", 180 / np.pi, 0),
        ("outcome, balanced", "outcome_balanced_accuracy", 1, 3),
    ]
    outcomes = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in summary["outcomes"].items())
    lines = [
        f"# {title}",
        "",
        f"{summary['items']} held-out trajectories of {summary['objects']} objects ({outcomes}). In brackets: 95 % "
        "intervals, bootstrapped over objects. BCE and excess are nats a pixel and channel; skill is 1 - excess / "
        "excess of the constant.",
        "",
        f"| predictor | {' | '.join(h[0] for h in heads)} |",
        "|---" * (len(heads) + 1) + "|",
    ]
    for name, row in summary["predictors"].items():
        cells = [_cell(row[key], scale, digits, "skill" in key) for _, key, scale, digits in heads]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    shown = [h for h in heads if "_skill" in h[1] or h[1] in ("position", "angle", "axis")]
    lines += [
        "",
        "Differences from the baselines (skill: positive is better; errors: negative is better):",
        "",
        f"| predictor | against | {' | '.join(h[0] for h in shown)} |",
        "|---" * (len(shown) + 2) + "|",
    ]
    for name, against in summary["differences"].items():
        for base, row in against.items():
            cells = [_cell(row[key], scale, digits, True) for _, key, scale, digits in shown]
            lines.append(f"| {name} | {base} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", *notes, ""])


def _cell(figure: dict | None, scale: float, digits: int, with_interval: bool) -> str:
    if figure is None:
        return "-"
    value, low, high = (f"{figure[key] * scale:.{digits}f}" for key in ("value", "low", "high"))
    return f"{value} [{low}, {high}]" if with_interval else value
