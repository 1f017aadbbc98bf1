"""Evaluates the models of the paper's Table 2, and writes the table and a figure of predictions."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

import sts_jax as sts
from experiments.shared import results, transfer
from experiments.shared.config import TITLES
from experiments.shared.progress import say
from experiments.shared.recorded import NAMES, Config, Recorded
from sts_jax import evaluation, storage
from sts_jax.evaluation import Predicted
from sts_jax.training import records

MVAE = "mvae-without-pose"
FLOOR = "the truth itself (entropy)"


def evaluate(config: Config, data: Recorded, workdir: Path, folder: Path) -> str:
    """Score the models on the validation trajectories, write the results, and return the table.

    The results are `metrics.json`, `table.md` and `figures/`. `metrics.json` records the checksums of all inputs and
    results. While all checksums match, nothing is evaluated again.

    Args:
        config: Configuration of the experiment.
        data: Recorded trajectories.
        workdir: Work directory from which the trajectories were read.
        folder: Folder with the trained models, which receives the results.

    Returns:
        The table in Markdown.
    """
    done, table = folder / "metrics.json", folder / "table.md"
    models = {name: folder / "models" / name for name in NAMES}
    inputs = {"config.json": storage.digest(dataclasses.asdict(config)), "dataset": data.identity}
    judged = {**models, transfer.NAME: transfer.FOLDER}
    inputs |= {f"models/{name}": results.identity(path) for name, path in judged.items()}
    reason = results.stale(done, inputs)
    if reason is None:
        return table.read_text()
    if done.exists():
        say(f"evaluate: again, because {reason}")
    predicted = predictions(models, data)
    simulated = transfer.predictions(config, data, workdir)
    if simulated is not None:
        predicted[transfer.TITLE] = simulated
    summary = evaluation.image_summary(
        {**evaluation.image_baselines(data.train, data.validation), **predicted}, data.validation
    )
    logs = {TITLES[name]: records.read(path / records.NAME) for name, path in models.items()}
    figures = [folder / "figures" / name for name in ("predictions.png", "training.png")]
    draw(config, data, predicted, figures[0])
    evaluation.figures.training_curves(figures[1], logs)
    text = as_table(config, data, summary, logs)
    storage.write_bytes(table, text.encode())
    results.write(done, {"source": data.source, **summary}, inputs, [table, *figures])
    return text


def predictions(models: Mapping[str, Path], data: Recorded) -> dict[str, Predicted]:
    """Predict the validation trajectories with each model, from each subset of its inputs.

    Returns:
        The predictions. The keys are the titles of the rows in the table.
    """
    found = {}
    first = {stream: getattr(data.validation, stream)[:, 0].astype(np.float32) / 255 for stream in evaluation.STREAMS}
    for name, path in models.items():
        predictor = sts.Predictor.load(path)
        for given, subset in evaluation.subsets(predictor.modalities).items():
            out = predictor(**{stream: first[stream] for stream in subset})
            title = TITLES[name] if len(subset) == len(predictor.modalities) else f"{TITLES[name]}, {given} alone"
            visual, tactile = (None if image is None else np.asarray(image) for image in (out.visual, out.tactile))
            found[title] = Predicted(visual, tactile)
    return found


def draw(config: Config, data: Recorded, predicted: Mapping[str, Predicted], path: Path) -> None:
    """Draw input images of the first validation trajectories, and predicted and true images of the object at rest."""
    held = data.validation
    labels = [f"#{number}" for number in held.number[: config.num_shown]]

    def truth(stream: str, moment: int) -> np.ndarray:
        return getattr(held, stream)[: len(labels), moment] / 255

    def guess(name: str, stream: str) -> np.ndarray:
        return getattr(predicted[TITLES[name]], stream)[: len(labels)]

    def simulated(stream: str) -> dict[str, np.ndarray]:
        own = predicted.get(transfer.TITLE)
        return {} if own is None else {"simulated training": getattr(own, stream)[: len(labels)]}

    groups = [
        {"visual": truth("visual", 0), "tactile": truth("tactile", 0)},
        {
            "VAE visual only": guess("vae-visual", "visual"),
            "MVAE": guess(MVAE, "visual"),
            **simulated("visual"),
            "truth": truth("visual", 1),
        },
        {
            "VAE tactile only": guess("vae-tactile", "tactile"),
            "MVAE": guess(MVAE, "tactile"),
            **simulated("tactile"),
            "truth": truth("tactile", 1),
        },
    ]
    evaluation.figures.comparison(
        path,
        groups,
        labels,
        title=f"Images of {data.source}: the first {len(labels)} of {len(held.number)} validation trajectories",
        heads=("held, the input", "at rest, visual", "at rest, tactile"),
    )


def as_table(config: Config, data: Recorded, summary: dict, logs: Mapping[str, list[dict]]) -> str:
    """Write the table of the models' scores (Table 2 of the paper) as text in Markdown.

    Args:
        config: Configuration of the experiment.
        data: Recorded trajectories.
        summary: Scores with 95 % intervals, from `evaluation.image_summary`.
        logs: Training logs by the title of the model.
    """
    names = [FLOOR, *dict.fromkeys(name for own in summary.values() for name in own["predictors"])]
    heads = ["predictor"]
    for stream in summary:
        heads += [f"{stream} BCE (x1e-4)", f"{stream} skill", f"{stream} skill against the copy"]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for name in names:
        cells = []
        for own in summary.values():
            found = own["predictors"].get(name)
            if name == FLOOR:
                cells += [f"{1e4 * own['floor']:.0f}", "1", "1"]
            elif found is None:
                cells += ["NA", "NA", "NA"]
            else:
                bce = {key: 1e4 * value for key, value in found["bce"].items()}
                cells.append(f"{bce['value']:.0f} [{bce['low']:.0f}, {bce['high']:.0f}]")
                cells += [
                    f"{found[key]['value']:.3f} [{found[key]['low']:.3f}, {found[key]['high']:.3f}]"
                    for key in ("skill", "skill_copy")
                ]
        lines.append(f"| {' | '.join([name, *cells])} |")
    num = len(data.train.number), len(data.validation.number)
    steps = ", ".join(f"{name} {log[-1]['step'] if log else 0}" for name, log in logs.items())
    return "\n".join(
        [
            f"# Table 2: the resting state predicted from the held one, on images of {data.source}",
            "",
            f"{sum(num)} trajectories, {num[0]} for training and {num[1]} for validation. Whole pad at "
            f"{config.image_size}x{config.image_size}. In brackets: 95 % intervals, bootstrapped over validation "
            "trajectories. BCE is the binary cross-entropy per pixel and channel. Its smallest value is the entropy "
            "of the true images. Skill is 1 - excess / excess of the constant, and the last column of a stream "
            "replaces the constant by the copy of the input, where excess is the BCE above its smallest value.",
            "",
            *lines,
            "",
            f"Gradient steps: {steps}, batch {config.training.batch_size}.",
            "",
            f"{transfer.TITLE}: the library's model `{transfer.NAME}` from both held images. It has seen no image of "
            "this sensor, and its training objects are other cameras.",
            "",
        ]
    )
