"""Measure how much hidden properties change the outcome of a trajectory, and how well touch and images reveal them.

    python -m benchmarks.hidden                 # the jerked pad, about half an hour on two CPU cores
    python -m benchmarks.hidden outcomes truth  # two of the three parts, which are listed below
    python -m benchmarks.hidden outcomes truth --scenario inclined --soaked FOLDER  # load stored trajectories

- `outcomes`: the share of each outcome, and the share of the starts whose outcome changes with other contents.
- `truth`: the log losses of two classifiers of the outcome, and the gain from the first to the second. The inputs of
  the first are the exact shape, the first pose and the jerk (on the slope, with the noise `slope_features.SEEN`). The
  second also gets a noisy measurement of touch: the weight on the jerked pad, the centre of pressure on the slope.
- `pictures`: as `truth`, but a small network estimates the measurement of touch from the first uint8 tactile image.

Cross-validation folds and bootstrap samples (for 95 % intervals) contain all starts of an object or none.
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, get_args

import jax
import numpy as np
import tyro

from benchmarks.instruments import classifier, cnn, jerk_features, slope_features
from benchmarks.instruments.starts import Starts, bodies, draw, roll, soaked
from sts_jax import objects, physics
from sts_jax.evaluation import metrics

Part = Literal["outcomes", "truth", "pictures"]
OTHERS = 1_000_000  # number of the first object on which networks are trained, far beyond the numbers under study
EXAMPLES = 8  # starts of each object on which networks are trained


@dataclasses.dataclass(frozen=True)
class Study:
    """The settings with which the benchmark studies one scenario, such as the classes of the objects."""

    scenario: physics.Scenario
    categories: tuple[str, ...]  # classes of the objects, in turn
    reroll: tuple[str, ...]  # fields of `physics.Hidden` that are drawn again
    touch: Callable[[Starts], np.ndarray]  # returns the exact measurement of touch (n, k), nan without contact
    noise: float  # standard deviation of the noise that is added to the measurement
    noise_name: str  # the noisy measurement in the printed lines
    # returns the features (n, k) of a classifier from scenario, bodies, starts, and touch (n, k) or None
    features: Callable[[Any, list[objects.Body], Starts, np.ndarray | None], np.ndarray]


STUDIES = {
    "perturbed": Study(
        scenario=physics.Perturbed(),
        categories=("bottle",),
        reroll=("fill",),
        touch=jerk_features.weighed,
        noise=jerk_features.NOISE,
        noise_name="weight to 5 %",
        features=jerk_features.shaken,
    ),
    "inclined": Study(
        scenario=physics.Inclined(),
        categories=objects.CATEGORIES,
        reroll=("fill", "up"),
        touch=slope_features.pressed,
        noise=slope_features.NOISE,
        noise_name="pressure to 1 mm",
        features=slope_features.laid,
    ),
}


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    parts: tyro.conf.Positional[tuple[Part, ...]] = ()  # parts of the printed report (default: all)
    scenario: Literal["perturbed", "inclined"] = "perturbed"  # the jerked pad, or the slope
    objects: int | None = None  # number of simulated objects (default: 200)
    num: int = 16  # number of simulated starts of each object
    again: int | None = None  # starts of each object that are simulated again with new contents (default: 8)
    others: int = 800  # number of objects on which the networks are trained
    steps: int = 1500  # training steps of the networks
    soaked: Path | None = None  # folder of kept blocks of `benchmarks.soak`, used instead of simulated starts

    def __post_init__(self) -> None:
        if self.soaked is not None and (self.objects, self.again) != (None, None):
            raise ValueError("--soaked provides the trajectories: leave out --objects and --again")


def outcomes(study: Study, starts: Starts) -> None:
    """Print the shares of the outcomes, of unsettled starts, and of starts whose outcome changes with the contents."""
    share = functools.partial(classifier.interval, classifier.mean, groups=starts.body)
    for outcome in study.scenario.outcomes:
        print(f"{outcome.name.lower():30s} {share(starts.outcome == outcome)}")
    print(f"{'unsettled':30s} {share(~starts.settled)}")
    rolled = starts.rerolled >= 0
    if not rolled.any():
        return
    changed = (starts.rerolled != starts.outcome)[rolled]
    figure = classifier.interval(classifier.mean, changed, groups=starts.body[rolled])
    print(f"{'another fill, another outcome':30s} {figure} ({len(changed)} starts)", flush=True)


def losses(study: Study, items: list[objects.Body], starts: Starts, touch: np.ndarray | None) -> np.ndarray:
    """Compute the log loss of a classifier that predicts how trajectories end, such as by toppling."""
    label = np.searchsorted(np.sort(study.scenario.outcomes), starts.outcome)
    features = study.features(study.scenario, items, starts, touch)
    return metrics.log_loss(classifier.probabilities(features, label, starts.body), label)


def gains(study: Study, items: list[objects.Body], starts: Starts, read: np.ndarray | None) -> None:
    """Print the log losses of classifiers that predict the outcome without and with touch, and the gain."""
    exact = study.touch(starts)
    rough = exact + study.noise * np.random.default_rng(0).normal(size=exact.shape)
    interval = functools.partial(classifier.interval, groups=starts.body)
    share = np.array([np.mean(starts.outcome == outcome) for outcome in study.scenario.outcomes])
    before, after = losses(study, items, starts, None), losses(study, items, starts, rough)
    print(f"{'log loss: constant':30s} {-(share * np.log(share)).sum():.3f}")
    print(f"{'log loss: vision':30s} {interval(classifier.mean, before)}")
    print(f"{'log loss: ' + study.noise_name:30s} {interval(classifier.mean, after)}")
    print(f"{'gain: ' + study.noise_name:30s} {interval(classifier.gain, before, after)}", flush=True)
    if read is None:
        return
    error = np.sqrt(np.nanmean((read - exact) ** 2, 0))
    print(f"{'read in the tactile frame':30s} rms error {' '.join(f'{e:.4g}' for e in error)}")
    gain = interval(classifier.gain, before, losses(study, items, starts, read))
    print(f"{'gain: pictures':30s} {gain}", flush=True)


def pictures(study: Study, items: list[objects.Body], starts: Starts, others: int, steps: int) -> np.ndarray:
    """Train a network on tactile images of other objects, and return its estimates of the measurement of touch."""
    rest = bodies(study.categories, others, OTHERS)
    learned = roll(jax.random.key(1), rest, dataclasses.replace(study.scenario, frames=1), EXAMPLES)
    touch = study.touch(learned)
    known = np.isfinite(touch).all(1)
    read = cnn.fit(jax.random.key(0), draw(rest, learned)[known], touch[known], steps=steps)(draw(items, starts))
    return np.where(np.isfinite(study.touch(starts)), read, np.nan)  # the network need not detect missing contact


def begun(study: Study, args: Args) -> tuple[list[objects.Body], Starts]:
    """Return the objects, and the initial states and outcomes of their trajectories."""
    if args.soaked is not None:
        starts = soaked(args.soaked, args.scenario)
        return bodies(study.categories, int(starts.body.max()) + 1), starts
    items = bodies(study.categories, 200 if args.objects is None else args.objects)
    again = 8 if args.again is None else args.again
    return items, roll(jax.random.key(0), items, study.scenario, args.num, again=again, reroll=study.reroll)


def main(args: Args) -> None:
    """Load or simulate the starts (initial states of trajectories), and print the requested parts of the report."""
    study = STUDIES[args.scenario]
    parts = args.parts or get_args(Part)
    items, starts = begun(study, args)
    number = len(np.unique(starts.body))
    print(study.scenario)
    print(f"{len(starts.body)} starts of {number} objects ({', '.join(study.categories)})", flush=True)
    if "outcomes" in parts:
        outcomes(study, starts)
    read = pictures(study, items, starts, args.others, args.steps) if "pictures" in parts else None
    if read is not None or "truth" in parts:
        gains(study, items, starts, read)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
