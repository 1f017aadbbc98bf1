"""The paper's Table 1: four models of three scenarios at two time scales, and ours, with a verdict on its two claims.

    python -m experiments.table1                  # about 2.7 hours on two CPU cores, 13 GB on disk, can be resumed
    python -m experiments.table1 --seeds 0        # one seed, in a third of the time. More seeds may follow
    python -m experiments.table1 --preset smoke   # two steps of every model, for tests (nearly all is compilation)
    python -m experiments.table1 --preset paper   # the paper's data size and training schedule: weeks, days on a GPU

The results go to `runs/table1/`: `table1.md`, `claims.md`, `metrics.json` and figures. See `docs/experiments.md` for
the files and the options. Every field of the configuration is an option too: `--perturbed.num-objects 100`.
"""

import dataclasses
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import jax
import numpy as np
import tyro

import sts_jax as sts
from experiments.shared import cells, claims, drawing, evaluate, run
from experiments.shared import config as common
from experiments.shared.cells import NAMES, Cell, Config
from experiments.shared.terminal import on_one_line, say
from sts_jax import dataset, evaluation, physics, storage
from sts_jax.evaluation import figures
from sts_jax.training import TrainConfig

SHOWN = 24  # held-out trajectories in the largest figures
DRAWN = 16  # samples of the state-space model for each predicted last frame
COURSES = 4  # sampled courses of a state-space model whose mean images are drawn, and samples of the end beside them
SHEETS = ("mvae", "statespace")  # models whose predictions and roll-outs are drawn
CROSSED = ("mvae-without-pose", "statespace")  # models that predict one stream from the other one

COLLECTION = dataset.Collection(num_objects=400, num_per_object=1, shares=(0.75, 0.1, 0.15), seed=2)
DEFAULT = Config(
    freefall=dataclasses.replace(COLLECTION, scenario=physics.Freefall()),
    inclined=dataclasses.replace(COLLECTION, scenario=physics.Inclined()),
    perturbed=dataclasses.replace(COLLECTION, scenario=physics.Perturbed(), categories=("bottle",)),
    # All cells of a family make the same number of steps with batches of the same size.
    training=dataclasses.replace(common.TRAINING, steps=300, checkpoint_every=50),
    state_training=dataclasses.replace(common.STATE_TRAINING, steps=300, warmup=50, checkpoint_every=50),
)


def _smoke(scenario: physics.Scenario, categories: tuple[str, ...] = COLLECTION.categories) -> dataset.Collection:
    return dataset.Collection(
        scenario, categories, num_objects=12, num_per_object=1, objects_per_shard=12, shares=(0.5, 0.25, 0.25)
    )


SMOKE = dataclasses.replace(
    DEFAULT,
    freefall=_smoke(physics.Freefall(frames=12)),
    inclined=_smoke(physics.Inclined(frames=6)),
    perturbed=_smoke(physics.Perturbed(frames=6), ("bottle",)),
    training=dataclasses.replace(DEFAULT.training, steps=2, batch_size=4, log_every=1, checkpoint_every=1),
    state_training=dataclasses.replace(
        DEFAULT.state_training, steps=2, warmup=0, batch_size=4, log_every=1, checkpoint_every=1
    ),
    seeds=(0,),
    num_validated=1,
    num_samples=2,
    moments=(0, 2),
    rerolls=2,
    num_rerolled=3,
)


def _paper(collection: dataset.Collection, num_objects: int) -> dataset.Collection:
    return dataclasses.replace(collection, num_objects=num_objects, num_per_object=5, crop=True, objects_per_shard=20)


PAPER = dataclasses.replace(
    DEFAULT,
    freefall=_paper(DEFAULT.freefall, 340),  # 1,700 trajectories
    inclined=_paper(DEFAULT.inclined, 480),  # 2,400
    perturbed=_paper(DEFAULT.perturbed, 500),  # 2,500
    training=TrainConfig(epochs=200, batch_size=64, learning_rate=1e-3),
    models=get_args(cells.Name)[: len(cells.PAPER)],  # the state-space model needs images of the whole pad
    targets="own",
    rotation="quaternion",
    mask_blank_touch=False,
    encode_condition=True,
    prior="conditional",
    split="trajectory",
)
PRESETS = {"smoke": SMOKE, "default": DEFAULT, "paper": PAPER}


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    workdir: Path  # folder for the results
    # configuration of the preset. Each of its fields is an option
    config: Annotated[Config, tyro.conf.arg(name="")]
    preset: Literal["smoke", "default", "paper"] = "default"  # set of default values for the options
    debug: bool = False  # show the traceback of every error


def main(config: Config, workdir: Path) -> None:
    """Collect the datasets, train and score all cells, and write the tables, the claims and the figures."""
    cells.check(config)
    sensor, todo = sts.Sensor(), list(cells.cells(config))
    left = {cell: cells.estimated_s(config, cell) for cell in todo}
    collecting = sum(cells.estimated_collecting_s(config, name) for name in config.scenarios)
    say(
        f"{len(todo)} models, about {_minutes(sum(left.values()) + collecting)} if nothing is done yet: "
        f"{_minutes(collecting)} for the datasets, {_minutes(sum(left.values()))} for the models"
    )
    with storage.lock(workdir, finished=True):
        fields, defaults = dataclasses.asdict(config), storage.default_fields(config)
        storage.claim(workdir / "config.json", fields, defaults, cells.FREE)
        scenes: dict[str, cells.Scene] = {n: cells.scene(config, n, sensor, workdir) for n in config.scenarios}
        references = {name: cells.references(config, sensor, workdir, scene) for name, scene in scenes.items()}
        spent, expected = 0.0, 0.0
        for number, cell in enumerate(todo, 1):
            start = time.monotonic()
            if cells.compute(config, sensor, workdir, scenes[cell.scenario], cell):
                spent, expected = spent + time.monotonic() - start, expected + left[cell]
                rest = sum(left[other] for other in todo[number:]) * spent / expected
                say(f"[{number}/{len(todo)}] {cell.name}: {time.monotonic() - start:.0f} s, {_minutes(rest)} left")
            jax.clear_caches()  # programs of all models together would exceed Linux' limit of maps (vm.max_map_count)
            following = todo[number] if number < len(todo) else None
            if following is None or (following.scenario, following.seed) != (cell.scenario, cell.seed):
                write(config, workdir, scenes, references)
        draw(config, workdir, sensor, scenes)
        print(ending(workdir))


def write(
    config: Config,
    workdir: Path,
    scenes: dict[str, cells.Scene],
    references: dict[str, cells.Scores],
) -> None:
    """Write the tables, the claims and the metrics from the scores of the seeds that are complete."""
    results, checksums, every = [], dict[str, str](), list(cells.cells(config))
    for name, scene in scenes.items():
        complete, scores = [], dict[Cell, cells.Scores]()
        for seed in config.seeds:
            wanted = [cell for cell in every if (cell.scenario, cell.seed) == (name, seed)]
            files = {cell: f"scores/{cell.name}.npz" for cell in wanted}
            if all((workdir / file).exists() for file in files.values()):
                complete.append(seed)
                scores |= {cell: storage.read_arrays(workdir / file, f"delete {file}") for cell, file in files.items()}
                checksums |= storage.checksums(workdir, [*files.values(), f"scores/{name}/references.npz"])
        if complete:
            results.append(claims.Results(name, scene.test.object, tuple(complete), scores, references[name]))
    if not results or evaluate.stale(workdir, "results", checksums) is None:
        return
    numbers = [claims.summarise(one) for one in results]
    title = f"Table 1, {workdir.name}: the last frame from the first one, held out by {config.split}"
    texts = {
        "table1.md": claims.table(numbers, title=title, notes=notes(config)),
        "claims.md": claims.verdicts(numbers, equal_steps=config.training.steps is not None, split=config.split),
    }
    for file, text in texts.items():
        storage.write_bytes(workdir / file, text.encode())
    storage.write_json(
        workdir / "metrics.json", {"split": config.split, "scenarios": [dataclasses.asdict(one) for one in numbers]}
    )
    evaluate.record(workdir, "results", checksums, [workdir / file for file in (*texts, "metrics.json")])


def draw(config: Config, workdir: Path, sensor: sts.Sensor, scenes: dict[str, cells.Scene]) -> None:
    """Draw the figures and write the probes of the models of the first seed, unless they are there already."""
    models = list(cells.cells(dataclasses.replace(config, seeds=config.seeds[:1])))
    checksums = {c.name: evaluate.identity(workdir / "models" / c.name) for c in models} | {"figures": str(SHOWN)}
    if evaluate.stale(workdir, "figures", checksums) is None:
        return
    files, texts = [], []
    for number, (name, scene) in enumerate(scenes.items()):
        say(f"figures: {number}/{len(scenes)} {name}")
        own = [c for c in models if c.scenario == name]
        final, step = (
            {c.model: sts.Predictor.load(workdir / "models" / c.name) for c in own if c.scale == scale}
            for scale in ("final", "step")
        )
        files += draw_scene(workdir / "figures" / name, sensor, scene, final, step)
        if "mvae" in final:
            parts = {"train": scene.train, "validation": scene.validation, "test": scene.test}
            found = evaluation.probe(final["mvae"], scene.data, parts, dataset.class_names(scene.collection))
            texts.append(evaluation.probes_table(found, title=f"{name}: {NAMES['mvae']}, final-step"))
        jax.clear_caches()
    storage.write_bytes(workdir / "probes.md", "\n".join(texts).encode())
    evaluate.record(workdir, "figures", checksums, [*files, workdir / "probes.md"])


def draw_scene(
    folder: Path,
    sensor: sts.Sensor,
    scene: cells.Scene,
    final: Mapping[str, sts.Predictor],
    step: Mapping[str, sts.Predictor],
) -> list[Path]:
    """Draw held-out trajectories of a scenario with its final-step and one-step models. Returns the files."""
    scenario, names, drawn = scene.collection.scenario, dataset.class_names(scene.collection), []
    test = scene.test.take(figures.one_of_each(scene.test, names, SHOWN))
    every = np.arange(len(test.object))
    look: dict[str, Any] = {"scenario": scenario, "names": names}

    def path(stem: str) -> Path:
        drawn.append(folder / f"{stem}.png")
        return drawn[-1]

    drawings = {model: DRAWN if model in cells.STATE else 0 for model in final}
    ends = {
        model: evaluation.predict(p, p.modalities, test, scenario, num_samples=drawings[model])
        for model, p in final.items()
    }
    some = every[: SHOWN // 3]
    for model in (model for model in SHEETS if model in ends):
        for stem, items in ((model, some), (f"{model}-large", every)):
            title = f"{scene.name}: {NAMES[model]}, the last frame from the first"
            shown = test.take(items), evaluation.take(ends[model], items)
            drawing.draw_predictions(path(f"predictions-{stem}"), scene.collection, sensor, *shown, title)
    papers = {NAMES[model]: ends[model] for model in cells.PAPER if model in ends}
    if papers:
        title = f"{scene.name}: the paper's models, the last frame from the first one"
        figures.models_sheet(path("models"), test, papers, some, **look, title=title)
    for model, predictor in final.items():
        if model in CROSSED and {"visual", "tactile"} <= set(predictor.modalities):
            touch, vision = (
                evaluation.predict(predictor, (name,), test, scenario, num_samples=drawings[model])
                for name in ("tactile", "visual")
            )
            title = f"{scene.name}: {NAMES[model]}, each stream from the other one"
            figures.crossed_sheet(path(f"crossed-{model}"), test, touch, vision, some, **look, title=title)
    time, curves = scene.data.trajectory["time"][test.trajectory[0]], dict[str, evaluation.Curve]()
    for model in (model for model in SHEETS if model in step):
        stride = step[model].stride or 1
        times = np.arange(stride, len(time), stride)
        more = {"steps": len(times), "num_samples": COURSES if model in cells.STATE else 0}
        rolled = evaluation.rollout(step[model], step[model].modalities, test, scenario, **more)
        strip, title = scene.data.strip(int(test.trajectory[0])), f"{scene.name}: {NAMES[model]}, rolled out"
        figures.rollout_strip(
            path(f"rollout-{model}"), time, strip, rolled, 0, stride=stride, direct=ends.get(model), title=title
        )
        truths = [scene.data.pairs(test.trajectory, frames=(0, int(t))) for t in times]
        curves[f"{NAMES[model]}, rolled out"] = evaluation.error_curve(time[times], zip(rolled, truths, strict=True))
        copies = ((evaluation.Predicted(x.visual[:, 0], x.tactile[:, 0], x.pose[:, 0]), x) for x in truths)
        curves["copy of the input"] = evaluation.error_curve(time[times], copies)
        if model in ends:
            direct = ends[model]
            if model in cells.STATE:  # the mean of as many samples as that of the roll-out, for the pose too
                direct = evaluation.predict(final[model], final[model].modalities, test, scenario, num_samples=COURSES)
                assert direct.samples is not None
                assert direct.samples.pose is not None
                direct = direct._replace(pose=evaluation.metrics.centre(direct.samples.pose))
            curves[f"{NAMES[model]}, final-step"] = evaluation.error_curve(time[-1:], [(direct, test)])
    if curves:
        figures.error_curves(path("errors"), curves, test.object, title=f"{scene.name}: errors over time")
    return drawn


def notes(config: Config) -> list[str]:
    """What the cells have in common, for the table."""
    lines = [
        f"Ceiling: {config.rerolls} re-rolls of the hidden values of each of the first {config.num_rerolled} held-out "
        "starts. With more held-out trajectories, its BCE and its excess are those of other items than in the other "
        "rows. Its skill is that of the same items as its constant."
    ]
    for family, schedule in (
        ("the paper's models", config.training),
        ("the state-space models", config.state_training),
    ):
        length = f"{schedule.epochs} epochs" if schedule.steps is None else f"{schedule.steps} gradient steps"
        lines.append(f"Every cell of {family}: {length}, batch {schedule.batch_size}.")
    return lines


def ending(workdir: Path) -> str:
    """What the terminal shows at the end: the verdicts, and where the results are."""
    lines = [line for line in (workdir / "claims.md").read_text().splitlines() if line.startswith(("## ", "- "))]
    return "\n".join([*lines, f"table:  {workdir / 'table1.md'}", f"claims: {workdir / 'claims.md'}"])


def _minutes(seconds: float) -> str:
    minutes = seconds / 60
    if minutes >= 2 * 24 * 60:
        return f"{minutes / 60 / 24:.0f} days"
    return f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.1f} h"


if __name__ == "__main__":
    with on_one_line(debug="debug" in run.options(sys.argv[1:])):
        default = Args(Path("runs/table1"), run.chosen_preset(PRESETS, sys.argv[1:]))
        args = tyro.cli(Args, default=default, description=__doc__, config=(tyro.conf.AvoidSubcommands,))
        sts.enable_compilation_cache()
        main(run.with_epochs(args.config, run.options(sys.argv[1:])), args.workdir)
