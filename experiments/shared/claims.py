"""Table 1 in the paper's layout, the scores of all cells, and a verdict on each of the paper's two claims.

The errors of images are arrays `(..., 3)` with the fields of `evaluation.metrics.ImageError`: cross-entropy, excess and
number of summed values. The excess is the cross-entropy minus the entropy of the true image, so differences of excesses
are differences of cross-entropies.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from experiments.shared.cells import ALL, NAMES, ONE_STEP, PAPER, REFERENCES, TOUCHLESS, WEIGHTS, Cell, Scores
from sts_jax.evaluation import STREAMS, metrics

# Table 1 of Rezaei-Shoshtari et al. (2021), "Learning Intuitive Physics with Multimodal Generative Models": the binary
# cross-entropy on the validation set (x1e-4), by scenario, model and stream, for multi-step and final-step models.
PUBLISHED: dict[str, dict[str, dict[str, tuple[int, int]]]] = {
    "freefall": {
        "vae-visual": {"visual": (6522, 5750)},
        "vae-tactile": {"tactile": (6770, 6703)},
        "mvae": {"visual": (6548, 5741), "tactile": (6726, 6703)},
        "mvae-without-pose": {"visual": (6635, 5752), "tactile": (6735, 6703)},
    },
    "inclined": {
        "vae-visual": {"visual": (6751, 5895)},
        "vae-tactile": {"tactile": (6714, 6711)},
        "mvae": {"visual": (6625, 5891), "tactile": (6719, 6709)},
        "mvae-without-pose": {"visual": (6549, 5890), "tactile": (6713, 6710)},
    },
    "perturbed": {
        "vae-visual": {"visual": (7369, 6158)},
        "vae-tactile": {"tactile": (6879, 6705)},
        "mvae": {"visual": (7552, 6054), "tactile": (6868, 6701)},
        "mvae-without-pose": {"visual": (6967, 6095), "tactile": (6896, 6702)},
    },
}
PREFERRED = 1  # the paper's bold values are those up to this above the smallest one of a scenario and stream
ROWS = ("vae-visual", "vae-tactile", "mvae", "mvae-without-pose", "statespace")  # the paper's, and ours
SCALES = ("step", "final")  # in the order of the paper's columns
FACTOR = 1e4  # tables have units of 1e-4
DRAWS = 2000  # number of bootstrap samples
CLAIMS = {
    "a": "models with touch predict better than vision or touch alone",
    "b": "predicting the resting state beats models of high temporal resolution",
}
FAMILIES = {"paper": "the paper's models", "statespace": "the state-space model"}
HOLDS, FAILS, UNDECIDED = "holds", "does not hold", "undecided"


@dataclasses.dataclass(frozen=True)
class Side:
    """A prediction that is scored or compared."""

    model: str
    scale: str = "final"
    given: str = ALL

    def __str__(self) -> str:
        """For example "MVAE with pose, rolled out"."""
        given = "" if self.given == ALL else f" from {self.given}"
        return f"{NAMES[self.model]}{given}{', rolled out' * (self.scale == 'step')}"


@dataclasses.dataclass(frozen=True)
class Comparison:
    """A part of a claim: the first side predicts a stream better than the second one."""

    first: Side
    second: Side
    stream: str

    def __str__(self) -> str:
        return f"{self.first} minus {self.second}, {self.stream}"


def _both(first: Side, second: Side) -> tuple[Comparison, ...]:
    return tuple(Comparison(first, second, stream) for stream in STREAMS)


_TOUCH, _MVAE = Side("statespace-visual-tactile"), Side("mvae-without-pose")
# What decides each claim, by family of models and claim. Both sides have made the same number of gradient steps with
# batches of the same size.
DECIDING: dict[tuple[str, str], tuple[Comparison, ...]] = {
    ("paper", "a"): (
        Comparison(_MVAE, Side("vae-visual"), "visual"),
        Comparison(_MVAE, Side("vae-tactile"), "tactile"),
    ),
    ("paper", "b"): _both(Side("mvae"), Side("mvae", "step")),
    ("statespace", "a"): (
        *_both(_TOUCH, Side("statespace-visual")),
        Comparison(_TOUCH, dataclasses.replace(_TOUCH, given="tactile"), "tactile"),
    ),
    ("statespace", "b"): _both(Side("statespace"), Side("statespace", "step")),
}
# Further differences, which `claims.md` shows
FURTHER: dict[tuple[str, str], tuple[Comparison, ...]] = {
    ("paper", "a"): (
        Comparison(Side("mvae"), Side("vae-visual"), "visual"),
        Comparison(Side("mvae"), Side("vae-tactile"), "tactile"),
        *_both(_MVAE, dataclasses.replace(_MVAE, given="visual")),
        Comparison(Side("mvae-without-pose", "step"), Side("vae-visual", "step"), "visual"),
        Comparison(Side("mvae-without-pose", "step"), Side("vae-tactile", "step"), "tactile"),
    ),
    ("paper", "b"): (
        *_both(_MVAE, Side("mvae-without-pose", "step")),
        Comparison(Side("vae-visual"), Side("vae-visual", "step"), "visual"),
        Comparison(Side("vae-tactile"), Side("vae-tactile", "step"), "tactile"),
    ),
    ("statespace", "a"): (
        *_both(Side("statespace"), Side("statespace-visual-pose")),
        *_both(Side("statespace", given="visual and tactile"), Side("statespace", given="visual")),
    ),
    ("statespace", "b"): (),
}


class Weights(NamedTuple):
    """Bootstrap samples: how often each held-out item and each seed was drawn."""

    items: np.ndarray  # (draws, n)
    seeds: np.ndarray  # (draws, seeds)


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval, whose limits are None if there is only one object."""

    value: float
    low: float | None
    high: float | None


@dataclasses.dataclass(frozen=True)
class Results:
    """The scores of a scenario's cells, for those seeds of which all cells are complete."""

    scenario: str
    objects: np.ndarray  # object of each held-out item
    seeds: tuple[int, ...]
    cells: Mapping[Cell, Scores]
    references: Scores

    def errors(self, side: Side, weights: str, stream: str) -> np.ndarray | None:
        """The errors of a prediction for each seed, `(seeds, n, 3)`, or None if it does not have the stream."""
        name = f"/{side.given}/{stream}_bce"
        if side.model in REFERENCES:
            found = [self.references.get(side.model + name) for _ in self.seeds]
        else:
            cells = [Cell(self.scenario, side.model, side.scale, seed) for seed in self.seeds]
            found = [self.cells.get(cell, {}).get(weights + name) for cell in cells]
        parts = [part for part in found if part is not None]
        return np.stack(parts) if len(parts) == len(found) else None


@dataclasses.dataclass(frozen=True)
class Row:
    """The scores of one stream of a prediction, as means over seeds. `model` may also be a reference."""

    side: Side
    weights: str
    stream: str
    bce: Estimate
    excess: Estimate
    skill: Estimate
    bce_of_seed: tuple[float, ...]
    one_step: Estimate | None  # excess of predicting the next frame from a true one, as a mean over moments


@dataclasses.dataclass(frozen=True)
class Difference:
    """Excess of the first side of a comparison minus that of the second one, paired by item and seed."""

    comparison: Comparison
    deciding: bool
    last: Estimate  # with the weights of the last step
    best: Estimate  # with those of the least validation loss


@dataclasses.dataclass(frozen=True)
class Verdict:
    """The verdict on a claim, for each of the two kinds of weights."""

    family: str
    claim: str
    last: str
    best: str
    differences: tuple[Difference, ...]


@dataclasses.dataclass(frozen=True)
class Summary:
    """All numbers of a scenario, as `metrics.json` has them."""

    scenario: str
    items: int
    objects: int
    seeds: tuple[int, ...]
    entropy: dict[str, float]  # of the true images, for each stream
    rows: tuple[Row, ...]
    verdicts: tuple[Verdict, ...]
    published: dict[str, dict[str, tuple[int, int]]]

    def row(self, side: Side, weights: str, stream: str) -> Row | None:
        """The scores of a prediction, or None if it was not computed."""
        found = [row for row in self.rows if (row.side, row.weights, row.stream) == (side, weights, stream)]
        return found[0] if found else None


def resample(objects: np.ndarray, num_seeds: int, *, num: int = DRAWS, seed: int = 0) -> Weights | None:
    """Draw objects with all their items, and independently of them seeds. None if there is only one object.

    Args:
        objects: Object of each item, `(n,)`.
    """
    rng = np.random.default_rng(seed)
    _, member = np.unique(objects, return_inverse=True)
    size = int(member.max()) + 1
    if size < 2:
        return None
    drawn = rng.multinomial(size, np.full(size, 1 / size), size=num)
    return Weights(drawn[:, member], rng.multinomial(num_seeds, np.full(num_seeds, 1 / num_seeds), size=num))


def ratio(values: np.ndarray, count: np.ndarray, weights: Weights | None) -> Estimate:
    """The sum of `values` over seeds and items divided by that of `count`, both `(seeds, n)`."""
    value = float(values.sum() / count.sum())
    if weights is None:
        return Estimate(value, None, None)
    items = weights.items[:, : values.shape[1]]  # the ceiling is for the first items only
    total, whole = (((weights.seeds @ x) * items).sum(1) for x in (values, count))
    with np.errstate(invalid="ignore"):
        return Estimate(value, *metrics.interval(total / whole))


def verdict(differences: Sequence[Estimate]) -> str:
    """The verdict on a claim from its differences, each of which is negative if the claim is right."""
    if any(one.low is not None and one.low > 0 for one in differences):
        return FAILS
    if differences and all(one.high is not None and one.high < 0 for one in differences):
        return HOLDS
    return UNDECIDED


def summarise(results: Results) -> Summary:
    """Compute all numbers of a scenario. The same bootstrap samples serve for all of them."""
    weights = resample(results.objects, len(results.seeds))
    cells = [Side(cell.model, cell.scale, given) for cell, scores in results.cells.items() for given in _given(scores)]
    sides = [*(Side(name) for name in REFERENCES), *dict.fromkeys(cells)]
    rows = [_row(results, side, which, s, weights) for side in sides for which in WEIGHTS for s in STREAMS]
    entropy = {}
    for stream in STREAMS:
        bce, excess, pixels = results.references[f"constant/{ALL}/{stream}_bce"].sum(0)
        entropy[stream] = float((bce - excess) / pixels)
    return Summary(
        scenario=results.scenario,
        items=len(results.objects),
        objects=len(np.unique(results.objects)),
        seeds=results.seeds,
        entropy=entropy,
        rows=tuple(row for row in rows if row is not None),
        verdicts=tuple(_verdict(results, family, claim, weights) for family, claim in DECIDING),
        published=PUBLISHED[results.scenario],
    )


def _given(scores: Scores) -> list[str]:
    """The inputs from which a model was scored."""
    return [given for given in dict.fromkeys(name.split("/")[1] for name in scores) if given != ONE_STEP]


def _row(results: Results, side: Side, which: str, stream: str, weights: Weights | None) -> Row | None:
    errors = results.errors(side, which, stream)
    if errors is None:
        return None
    constant = results.references[f"constant/{ALL}/{stream}_bce"][: errors.shape[1], 1]
    lost = ratio(errors[..., 1], np.broadcast_to(constant, errors.shape[:2]), weights)
    steps = results.errors(dataclasses.replace(side, given=ONE_STEP), which, stream)
    return Row(
        *(side, which, stream),
        bce=ratio(errors[..., 0], errors[..., 2], weights),
        excess=ratio(errors[..., 1], errors[..., 2], weights),
        skill=Estimate(1 - lost.value, *(None if limit is None else 1 - limit for limit in (lost.high, lost.low))),
        bce_of_seed=tuple((errors[..., 0].sum(1) / errors[..., 2].sum(1)).tolist()),
        one_step=None if steps is None else ratio(steps[..., 1], steps[..., 2], weights),
    )


def _verdict(results: Results, family: str, claim: str, weights: Weights | None) -> Verdict:
    deciding, differences = DECIDING[family, claim], []
    for comparison in (*deciding, *FURTHER[family, claim]):
        last, best = (_difference(results, comparison, which, weights) for which in WEIGHTS)
        if last is not None and best is not None:
            differences.append(Difference(comparison, comparison in deciding, last, best))
    chosen = [one for one in differences if one.deciding]
    if len(chosen) < len(deciding):
        return Verdict(family, claim, UNDECIDED, UNDECIDED, tuple(differences))
    verdicts = verdict([one.last for one in chosen]), verdict([one.best for one in chosen])
    return Verdict(family, claim, *verdicts, tuple(differences))


def _difference(results: Results, comparison: Comparison, which: str, weights: Weights | None) -> Estimate | None:
    first, second = (results.errors(side, which, comparison.stream) for side in (comparison.first, comparison.second))
    if first is None or second is None:
        return None
    return ratio(first[..., 1] - second[..., 1], first[..., 2], weights)


def table(every: Sequence[Summary], *, title: str, notes: Sequence[str]) -> str:
    """`table1.md`: the paper's layout, and below it the scores of all predictions."""
    lines = _head(["scenario", "model", *(f"{s}, {scale}" for s in STREAMS for scale in ("multi-step", "final-step"))])
    for one in every:
        lines += [_line([one.scenario, NAMES[model], *_cells(one, model)]) for model in ROWS]
    text = [
        f"# {title}",
        "",
        "Binary cross-entropy per pixel and channel (x1e-4, lower is better) of the last frame of held-out "
        "trajectories, predicted from the first one: ours, with the weights of the last step, as a mean over seeds, "
        "and in brackets the paper's (Rezaei-Shoshtari et al. 2021, Table 1). Multi-step models predict the next frame "
        "and are rolled out to the last one. Bold: the paper's preferred values, and ours by the rule that gives the "
        f"same cells in the paper's table, at most {PREFERRED} above the smallest value of the four models for a "
        "scenario and stream. The paper's images differ from ours, so only numbers of one table, scenario and stream "
        "can be compared. The state-space model is ours.",
        "",
        *lines,
        "",
        *notes,
        "",
    ]
    return "\n".join([*text, *(line for one in every for line in _details(one))])


def _cells(one: Summary, model: str) -> list[str]:
    """The cells of a row in the paper's layout: ours, and in brackets the paper's."""
    texts = []
    for stream in STREAMS:
        ours = {(m, s): one.row(Side(m, s), "last", stream) for m in ROWS for s in SCALES}
        values = {key: FACTOR * row.bce.value for key, row in ours.items() if row is not None}
        least = min((x for (name, _), x in values.items() if name in PAPER), default=np.inf)
        published = one.published.get(model, {}).get(stream)
        smallest = min(x for both in one.published.values() for x in both.get(stream, ()))
        for column, scale in enumerate(SCALES):
            value = values.get((model, scale))
            text = "-" if value is None else _bold(f"{value:.0f}", model in PAPER and value <= least + PREFERRED)
            if published is not None:
                text += f" ({_bold(str(published[column]), published[column] <= smallest + PREFERRED)})"
            texts.append("NA" if model in PAPER and published is None else text)
    return texts


def _details(one: Summary) -> list[str]:
    """The table of all predictions of a scenario."""
    heads = [f"{stream} {name}" for stream in STREAMS for name in ("excess", "skill", "one-step excess")]
    lines = _head(["prediction", *heads])
    for side in dict.fromkeys(row.side for row in one.rows):
        texts = []
        for stream in STREAMS:
            both = [one.row(side, which, stream) for which in WEIGHTS]
            for name, digits, factor in (("excess", 1, FACTOR), ("skill", 3, 1), ("one_step", 1, FACTOR)):
                found = [None if row is None else getattr(row, name) for row in both]
                shown = ["-" if value is None else f"{factor * value.value:.{digits}f}" for value in found]
                texts.append(shown[0] if side.model in REFERENCES or shown[0] == "-" else " / ".join(shown))
        scale = "" if side.model in REFERENCES or side.scale == "step" else ", final-step"
        lines.append(_line([f"{REFERENCES.get(side.model) or side}{scale}", *texts]))
    return [
        f"## {one.scenario}",
        "",
        f"{_counted(one)} Excess is the cross-entropy above the entropy of the true images "
        f"({', '.join(f'{s} {FACTOR * x:.0f}' for s, x in one.entropy.items())}), x1e-4. Skill is 0 for the constant "
        "and 1 for the true image. Slashes separate the weights of the last step from those of the least validation "
        "loss. The one-step excess is that of the next frame, predicted from a true frame, as a mean over several "
        "moments, and for the state-space model from frame 0 only. It stands beside the excess of the last frame, "
        "which a one-step model predicts from its own predictions.",
        "",
        *lines,
        "",
    ]


def verdicts(every: Sequence[Summary], *, equal_steps: bool = True, split: str = "object") -> str:
    """`claims.md`: a sentence for each claim, scenario and family of models, and all differences."""
    steps = "number of gradient steps" if equal_steps else "number of epochs, so one-step models make more steps,"
    validation = "" if split == "object" else " The validation trajectories are the training trajectories."
    text = [
        "# The paper's two claims",
        "",
        *(f"- Claim ({letter}): {claim}." for letter, claim in CLAIMS.items()),
        "",
        "A difference is the excess (x1e-4) of the first prediction minus that of the second one, on the same held-out "
        "trajectories and with the same seeds. It is negative if the claim is right. Brackets contain its 95 % "
        f"interval from a hierarchical bootstrap: each of {DRAWS} samples draws the held-out objects, with all their "
        "trajectories, and independently of them the seeds, both with replacement. A claim holds if the intervals of "
        "all its differences are below 0. It does not hold if that of one of them is above 0. Otherwise it is "
        f"undecided. The compared models were trained on the same trajectories, with the same {steps} and batches of "
        f"the same size.{validation}",
        "",
    ]
    for one in every:
        text += [f"## {one.scenario}", "", _counted(one), "", *(_sentence(one, each) for each in one.verdicts), ""]
        text += _head(["difference", "weights of the last step", "weights of the least validation loss", "claim"])
        for each in one.verdicts:
            for found in each.differences:
                claim = f"({each.claim})" if found.deciding else ""
                text.append(_line([str(found.comparison), _shown(found.last), _shown(found.best), claim]))
        text.append("")
    return "\n".join(text)


def _sentence(one: Summary, each: Verdict) -> str:
    """The sentence about a claim."""
    begin = f"- {FAMILIES[each.family].capitalize()}, claim ({each.claim}): **{each.last}**"
    deciding = [found for found in each.differences if found.deciding]
    if not deciding and each.family == "statespace" and each.claim == "a" and one.scenario in TOUCHLESS:
        return f"{begin}, because nothing touches the pad in the first frame."
    if len(deciding) < len(DECIDING[each.family, each.claim]):
        return f"{begin}, because not all of its models were trained."
    shown = [f"{found.comparison} {_shown(found.last)}" for found in deciding]
    other = f" (weights of the least validation loss: {each.best})" if each.best != each.last else ""
    return f"{begin}{other}: {'; '.join(shown)}."


def _counted(one: Summary) -> str:
    seeds = ", ".join(map(str, one.seeds))
    return f"{one.items} held-out trajectories of {one.objects} objects, seed{'s' * (len(one.seeds) > 1)} {seeds}."


def _shown(estimate: Estimate) -> str:
    return metrics.written(**dataclasses.asdict(estimate), digits=1, factor=FACTOR)


def _bold(text: str, bold: bool) -> str:
    return f"**{text}**" if bold else text


def _head(texts: Sequence[str]) -> list[str]:
    return [_line(texts), "|---" * len(texts) + "|"]


def _line(texts: Sequence[str]) -> str:
    return f"| {' | '.join(texts)} |"
