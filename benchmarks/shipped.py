"""Metrics of the models that come with the library, on many objects that no model was trained on.

    python -m benchmarks.shipped perturbed    # about 15 minutes on two CPU cores, 8 GB of memory
    python -m benchmarks.shipped perturbed --trained runs/perturbed/models/statespace    # another trained model
    python -m benchmarks.shipped perturbed --noise 4 --blur 0.5    # the input images of a worse camera

An experiment has few held-out objects, so its intervals are wide. This command draws new objects, and simulates and
renders four trajectories of each, which stay in the work directory. The calibration error of few trajectories is above
0 even if the probabilities are exact, so the command also prints it for outcomes that are drawn from the model's own
probabilities. The pictures WORKDIR-visual.png and WORKDIR-all.png show predictions of one object of each class.
"""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
import tyro

import sts_jax as sts
from benchmarks.instruments.experiments import EXPERIMENTS
from experiments.shared import drawing
from experiments.shared.datasets import collect
from experiments.shared.evaluate import MAIN_SUBSETS
from experiments.shared.terminal import Bar
from sts_jax import dataset, evaluation, physics, statespace

PER_OBJECT = 4  # trajectories of each object
REFERENCE = 0.2  # share of the objects that define the constant baseline and the frequencies of the outcomes
NUM_SAMPLES = 16  # samples of each prediction
COLUMNS = {
    "visual skill": "visual_skill",
    "tactile skill": "tactile_skill",
    "position on pad (mm)": "position_on_pad",
    "balanced accuracy": "outcome_balanced_accuracy",
    "log loss (nats)": "outcome_log_loss",
    "calibration error": "outcome_calibration_error",
    "ROC area of falling off": "fell_off_auc",
}
SAMPLE_COLUMNS = {  # columns of the table of the samples
    f"visual skill, best of {NUM_SAMPLES}": "visual_skill_best",
    "sharpness": "sharpness",
    "tactile sharpness": "tactile_sharpness",
    "energy score (mm)": "energy",
    f"coverage of {100 * evaluation.metrics.LEVEL:g} %": "coverage",
}
SHOWN = 8  # trajectories in a picture
PICTURES = {"from visual": "visual", "from all inputs": "all"}  # end of a picture's name, by what is given
DRAWS = 200  # number of times that outcomes are drawn from the probabilities


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    # experiment, which is also the name of its shipped model
    model: Annotated[Literal["freefall", "inclined", "perturbed", "released"], tyro.conf.Positional]
    trained: Path | None = None  # folder of a state-space model of this experiment, to measure it instead
    objects: int = 1250  # number of objects. A fifth of them are for the baselines
    seed: int = 100  # seed of the objects and trajectories. The models were trained with the seed 2
    workdir: Path | None = None  # folder for the trajectories (default: runs/shipped-MODEL)
    noise: float = 0.0  # standard deviation of the noise that is added to the input images (of 255)
    blur: float = 0.0  # standard deviation of the Gaussian that blurs the input images before (pixels of 128)


def collection(args: Args) -> dataset.Collection:
    """Make the settings of a dataset that tests the model `args.model` on objects that no model was trained on."""
    return dataclasses.replace(
        EXPERIMENTS[args.model].COLLECTION,
        num_objects=args.objects,
        num_per_object=PER_OBJECT,
        num_rendered=None,
        num_views=0,
        num_full=0,
        shares=(REFERENCE, 0.0, 1 - REFERENCE),
        seed=args.seed,
    )


def columns(names: dict[str, str]) -> list[evaluation.Column]:
    """Columns of metrics by their heading."""
    metrics = {metric.name: metric for metric in evaluation.METRICS}
    return [evaluation.Column(heading, (metrics[name],)) for heading, name in names.items()]


def degraded(images: np.ndarray, args: Args, rng: np.random.Generator) -> np.ndarray:
    """Blur images, uint8 `(n, h, w, 3)`, then add noise, as `args` says."""

    def worse(image: np.ndarray) -> np.ndarray:
        blurred = cv2.GaussianBlur(image.astype(np.float32), (0, 0), args.blur) if args.blur else image
        return np.clip(np.rint(blurred + args.noise * rng.standard_normal(image.shape)), 0, 255).astype(np.uint8)

    return np.stack([worse(image) for image in images])


def if_calibrated(confidence: np.ndarray, *, draws: int = DRAWS, seed: int = 0) -> float:
    """Compute the mean calibration error that chance alone causes if the predicted probabilities are correct."""
    drawn = np.random.default_rng(seed).random((draws, len(confidence))) < confidence
    return float(np.mean([evaluation.metrics.calibration_error(confidence, right) for right in drawn]))


def main(args: Args) -> str:
    """Test a model on new trajectories, and return a table of the main metrics and a table for sampled predictions."""
    if args.objects < 5:
        raise ValueError(f"--objects must be at least 5, got {args.objects}")
    if args.noise < 0 or args.blur < 0:
        raise ValueError(f"--noise and --blur must be >= 0, got {args.noise} and {args.blur}")
    sts.enable_compilation_cache()
    scenario = EXPERIMENTS[args.model].COLLECTION.scenario
    predictor = _predictor(args, scenario)
    folder = args.workdir or Path("runs") / f"shipped-{args.model}"
    made, sensor = collection(args), sts.Sensor()
    data = collect(made, sensor, folder)
    rows = evaluation.rows_of(data, "object")
    size = EXPERIMENTS[args.model].DEFAULT.image_size
    train, given = dataset.reduced(data.pairs(rows["train"]), size), data.pairs(rows["test"])
    if args.noise or args.blur:
        rng = np.random.default_rng(args.seed)
        for images in (given.visual, given.tactile):
            images[:, 0] = degraded(images[:, 0], args, rng)
    test = dataset.reduced(given, size)
    judge = evaluation.scorer(scenario, train)
    items = evaluation.figures.one_of_each(test, dataset.class_names(made), SHOWN)
    scores = {title: judge(row, test) for title, row in evaluation.baselines(scenario, train, test).items()}
    every = evaluation.subsets(predictor.modalities)
    subsets = {title: every[title] for title in (f"from {given}" for given in MAIN_SUBSETS) if title in every}
    worse = [f"{name}{value:g}" for name, value in (("noise", args.noise), ("blur", args.blur)) if value]
    worse += [] if args.trained is None else ["-".join(args.trained.parts[-3:])]
    with Bar() as bar:
        for number, (given_by, subset) in enumerate(subsets.items()):
            bar("predict", number, len(subsets), given_by)
            row = evaluation.predict(predictor, subset, given, scenario, num_samples=NUM_SAMPLES)
            scores[given_by] = judge(row, test)
            if given_by in PICTURES:
                name = "-".join([folder.name, *worse, PICTURES[given_by]])
                path, shown = folder.with_name(f"{name}.png"), evaluation.take(row, items)
                title = f"{args.model}, {given_by}: {', '.join(['new objects', *worse])}"
                drawing.draw_predictions(path, made, sensor, given.take(items), shown, title)
            del row  # gigabytes of samples
    notes = [
        f"Outcomes drawn from the model's probabilities {title}: calibration error "
        f"{if_calibrated(errors[evaluation.CALIBRATION][:, 0]):.3f}."
        for title, errors in scores.items()
        if title in subsets and evaluation.CALIBRATION in errors
    ]
    if {"from visual", "from visual and tactile"} <= set(scores):
        gain = evaluation.gain(scores["from visual"], scores["from visual and tactile"], test)
        assert gain is not None
        notes.append(
            f"Touch removes {evaluation.metrics.written(**gain, digits=3)} of the outcome's log loss from vision."
        )
    summary = evaluation.summarise(scores, test, outcomes=scenario.outcomes)
    measured = "the shipped model" if args.trained is None else f"the model in {args.trained}"
    measured += f", noise {args.noise:g}, blur {args.blur:g}" if args.noise or args.blur else ""
    title = f"{args.model}: {measured} on new objects (seed {args.seed})"
    main_table = evaluation.table(summary, title=title, notes=notes, columns=columns(COLUMNS))
    title = f"{args.model}: {NUM_SAMPLES} samples of each prediction"
    sample_table = evaluation.table(summary, title=title, rows=[*subsets], columns=columns(SAMPLE_COLUMNS))
    return f"{main_table}\n{sample_table}"


def _predictor(args: Args, scenario: physics.Scenario) -> sts.Predictor:
    """Load the model, and check that it was trained for the scenario."""
    predictor = sts.Predictor.load(args.trained or args.model)
    config, outcomes, known = predictor.model.config, len(scenario.outcomes), len(scenario.condition_scale)
    if not isinstance(config, statespace.Config):
        raise ValueError(f"--trained {args.trained} is not a state-space model")
    if (config.outcomes, config.condition) != (outcomes, known):
        raise ValueError(
            f"--trained {args.trained} has outcomes={config.outcomes} and condition={config.condition}, but "
            f"{args.model} has outcomes={outcomes} and condition={known}"
        )
    return predictor


if __name__ == "__main__":
    print(main(tyro.cli(Args, description=__doc__)))
