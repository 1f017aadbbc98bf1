"""Hidden properties: whether they decide the outcome, and whether touch or images reveal them.

    python -m benchmarks.hidden                 # the jerked pad, about half an hour on two CPU cores
    python -m benchmarks.hidden outcomes truth  # some of the parts outcomes, truth, pictures, fill
    python -m benchmarks.hidden --keep FOLDER   # keep starts and outcomes there, and resume from them
    python -m benchmarks.hidden outcomes truth --scenario inclined --soaked FOLDER  # starts from `benchmarks.soak`

- `outcomes`: shares of the outcomes, and of the starts that end differently when only the fill (on the slope, the fill
  and its direction) is drawn again.
- `truth`: log loss of a classifier of the outcome that has the exact shape, start and jerk (on the slope, the pose up
  to `slope.SEEN`), and of one that also has a noisy measurement of touch. The gain is the share of the loss that
  disappears.
- `pictures`: the same with the measurement that a small network reads from the first uint8 tactile frame. The network
  is trained on other objects.
- `fill`: AUC of a small network that separates full from empty objects in frames in the air, in the same frames with
  the fuller objects painted, and in tactile frames. For the jerked pad only, where containers stand.

Folds and 95 % intervals are by object. Everything is simulated once with the defaults of the scenario. The features of
the classifiers are in `benchmarks.jerk` and `benchmarks.slope`.
"""

import argparse
import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from benchmarks import classify, jerk, reader, slope, soak
from benchmarks.starts import Starts, bodies, draw, kept, roll
from sts_jax import dataset, objects, physics

PARTS = ("outcomes", "truth", "pictures", "fill")
TINT = 0.1  # share of white in the colours of painted objects (linear light)
OTHERS = 1_000_000  # keys of the objects on which networks are trained begin here
EXAMPLES = 8  # starts of each of these objects


@dataclasses.dataclass(frozen=True)
class Study:
    """The study of one scenario."""

    scenario: physics.Scenario
    categories: tuple[str, ...]  # categories of the objects, in turn
    reroll: tuple[str, ...]  # hidden values that are drawn again
    touch: Callable[[Starts], np.ndarray]  # (n, k) exact measurement of touch, nan without contact
    noise: float  # standard deviation of the measurement, in each column
    noise_name: str
    # features of shape (n, k), given the scenario, the bodies and their starts. `touch` may be None
    features: Callable[[Any, list[objects.Body], Starts, np.ndarray | None], np.ndarray]


@dataclasses.dataclass(frozen=True)
class Counts:
    """The numbers of objects, starts and training steps."""

    objects: int = 200
    num: int = 16  # starts of each object
    again: int = 8  # starts of each object that are rolled again
    others: int = 800  # objects on which networks are trained
    steps: int = 1500  # training steps of the networks


class Lesson(NamedTuple):
    """Training data of networks, and the images to which they are applied."""

    items: list[objects.Body]  # training objects
    starts: Starts  # EXAMPLES starts of each training object
    examples: np.ndarray  # uint8 (m, 64, 64, 3), tactile frames of these starts
    tactile: np.ndarray  # uint8 (n, 64, 64, 3), tactile frames of the starts under study


STUDIES = {
    "perturbed": Study(
        scenario=physics.Perturbed(),
        categories=("bottle",),
        reroll=("fill",),
        touch=jerk.weighed,
        noise=jerk.NOISE,
        noise_name="weight to 5 %",
        features=jerk.shaken,
    ),
    "inclined": Study(
        scenario=physics.Inclined(),
        categories=objects.CATEGORIES,
        reroll=("fill", "up"),
        touch=slope.pressed,
        noise=slope.NOISE,
        noise_name="pressure to 1 mm",
        features=slope.laid,
    ),
}


def outcomes(study: Study, starts: Starts) -> None:
    """Print the shares of the outcomes, of unsettled starts, and of starts that end differently with another fill."""
    share = functools.partial(classify.interval, np.mean, groups=starts.body)
    for outcome in study.scenario.outcomes:
        print(f"{outcome.name.lower():30s} {share(starts.outcome == outcome)}")
    print(f"{'unsettled':30s} {share(~starts.settled)}")
    rolled = starts.rerolled >= 0
    if not rolled.any():
        return
    changed = (starts.rerolled != starts.outcome)[rolled]
    figure = classify.interval(np.mean, changed, groups=starts.body[rolled])
    print(f"{'another fill, another outcome':30s} {figure} ({len(changed)} starts)", flush=True)


def losses(study: Study, items: list[objects.Body], starts: Starts, touch: np.ndarray | None) -> np.ndarray:
    """Log loss (n,) of each start's outcome, for a classifier without or with touch."""
    label = np.searchsorted(np.sort(study.scenario.outcomes), starts.outcome)
    features = study.features(study.scenario, items, starts, touch)
    return classify.log_loss(classify.chances(features, label, starts.body), label)


def gains(study: Study, items: list[objects.Body], starts: Starts, read: np.ndarray | None) -> None:
    """Print the log losses of classifiers on true states and, if given, with the touch `read` from images."""
    exact = study.touch(starts)
    rough = exact + study.noise * np.random.default_rng(0).normal(size=exact.shape)
    interval = functools.partial(classify.interval, groups=starts.body)
    share = np.array([np.mean(starts.outcome == outcome) for outcome in study.scenario.outcomes])
    before, after = losses(study, items, starts, None), losses(study, items, starts, rough)
    print(f"{'log loss: constant':30s} {-(share * np.log(share)).sum():.3f}")
    print(f"{'log loss: vision':30s} {interval(np.mean, before)}")
    print(f"{'log loss: ' + study.noise_name:30s} {interval(np.mean, after)}")
    print(f"{'gain: ' + study.noise_name:30s} {interval(classify.gain, before, after)}", flush=True)
    if read is None:
        return
    seen_too = losses(study, items, starts, read)
    error = np.sqrt(np.nanmean((read - exact) ** 2, 0))
    print(f"{'read in the tactile frame':30s} rms error {' '.join(f'{e:.4g}' for e in error)}")
    print(f"{'gain: pictures':30s} {interval(classify.gain, before, seen_too)}")
    print(f"{'share of the gain kept':30s} {interval(classify.kept, before, after, seen_too)}", flush=True)


def lesson(study: Study, items: list[objects.Body], starts: Starts, others: int) -> Lesson:
    """Simulate the first frames of training objects, and render the tactile frames of these and of the starts."""
    rest = bodies(study.categories, others, OTHERS)
    learned = roll(jax.random.key(1), rest, dataclasses.replace(study.scenario, frames=1), EXAMPLES)
    return Lesson(rest, learned, draw(rest, learned)[1], draw(items, starts)[1])


def pictures(study: Study, learned: Lesson, starts: Starts, steps: int) -> np.ndarray:
    """Touch (n, k) as a network reads it from the tactile frames of the starts, nan without contact."""
    told = study.touch(learned.starts)
    known = np.isfinite(told).all(1)
    read = reader.fit(jax.random.key(0), learned.examples[known], told[known], steps=steps)(learned.tactile)
    return np.where(np.isfinite(study.touch(starts)), read, np.nan)  # contact is taken as known


def painted(body: objects.Body) -> objects.Body:
    """The body with a share TINT of white in its colours."""
    return dataclasses.replace(body, colors=(1 - TINT) * body.colors + TINT)


def aloft(key: PRNGKeyArray, items: list[objects.Body], num: int) -> tuple[Starts, np.ndarray, np.ndarray]:
    """Objects in the air at the start of freefall: starts, visual frames, and these with the fuller ones painted."""
    starts = roll(key, items, physics.Freefall(frames=11), num)  # the fewest in which a fall can end
    plain, _ = draw(items, starts)
    both, _ = draw([painted(body) for body in items], starts)
    return starts, plain, np.where((starts.fill > 0.5)[:, None, None, None], both, plain)


def detect(name: str, images: np.ndarray, starts: Starts, new: np.ndarray, held_out: Starts, steps: int) -> None:
    """Print how well a network detects, in frames of held-out objects, which are fuller than half."""
    read = reader.fit(jax.random.key(1), images, starts.fill[:, None] > 0.5, steps=steps)
    label, score = held_out.fill > 0.5, read(new)[:, 0]
    figure = classify.interval(classify.auc, label, score, groups=held_out.body)
    print(f"{'AUC of the fill: ' + name:30s} {figure} ({len(label)} held-out items)", flush=True)


def fill(learned: Lesson, items: list[objects.Body], starts: Starts, counts: Counts) -> None:
    """Print how well the fill is detected from touch, from frames in the air, and from these with paint."""
    detect("touch, standing", learned.examples, learned.starts, learned.tactile, starts, counts.steps)
    flying, plain, tinted = aloft(jax.random.key(2), learned.items, EXAMPLES)
    new, new_plain, new_tinted = aloft(jax.random.key(3), items, counts.num)
    detect("seen in the air", plain, flying, new_plain, new, counts.steps)
    detect(f"{TINT:.0%} tint", tinted, flying, new_tinted, new, counts.steps)


def main(parts: set[str], name: str, counts: Counts, keep: Path | None, soaked: Path | None) -> None:
    """Simulate the necessary starts and print the parts."""
    study = STUDIES[name]
    if soaked is not None:
        starts = soak.soaked(soaked, name)
        items = bodies(study.categories, int(starts.body.max()) + 1)
    else:
        if keep is not None:
            made = {"scenario": repr(study.scenario), "objects": counts.objects, "num": counts.num}
            dataset.claim(keep / f"{name}.json", made | {"again": counts.again})
        items = bodies(study.categories, counts.objects)
        begin = functools.partial(roll, again=counts.again, reroll=study.reroll)
        starts = kept(keep, name, lambda: begin(jax.random.key(0), items, study.scenario, counts.num))
    number = len(np.unique(starts.body))
    print(study.scenario)
    print(f"{len(starts.body)} starts of {number} objects ({', '.join(study.categories)})", flush=True)
    if "outcomes" in parts:
        outcomes(study, starts)
    learned = lesson(study, items, starts, counts.others) if parts & {"pictures", "fill"} else None
    read = pictures(study, learned, starts, counts.steps) if learned and "pictures" in parts else None
    if parts & {"truth", "pictures"}:
        gains(study, items, starts, read)
    if learned and "fill" in parts:
        fill(learned, items, starts, counts)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    usual = Counts()
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"some of {', '.join(PARTS)} (default: all)")
    parser.add_argument("--scenario", choices=STUDIES, default="perturbed")
    parser.add_argument("--objects", type=int, help=f"simulated objects ({usual.objects})")
    parser.add_argument("--num", type=int, default=usual.num, help=f"starts of each object ({usual.num})")
    parser.add_argument("--again", type=int, help=f"of these, starts that are rolled again ({usual.again})")
    parser.add_argument("--others", type=int, default=usual.others, help=f"training objects ({usual.others})")
    parser.add_argument("--steps", type=int, default=usual.steps, help=f"training steps of networks ({usual.steps})")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep starts and outcomes there, resume from them")
    parser.add_argument("--soaked", type=Path, metavar="FOLDER", help="use kept blocks of benchmarks.soak instead")
    args = parser.parse_args()
    # Full and empty objects are separated only where containers stand.
    parts = PARTS if args.scenario == "perturbed" else PARTS[:-1]
    if not set(args.parts) <= set(parts):
        parser.error(f"{' '.join(args.parts)}: the parts of {args.scenario} are {', '.join(parts)}")
    unused = [f"--{name}" for name in ("objects", "again", "keep") if getattr(args, name) is not None]
    if args.soaked is not None and unused:
        parser.error(f"--soaked has the starts, so {' and '.join(unused)} would be ignored: leave them out")
    given = {field.name: getattr(args, field.name) for field in dataclasses.fields(Counts)}
    counts = Counts(**{name: count for name, count in given.items() if count is not None})
    main(set(args.parts or parts), args.scenario, counts, args.keep, args.soaked)
