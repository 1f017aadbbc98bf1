"""The paper's Table 2: reads recorded trajectories, trains three models on them, and evaluates these models."""

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import tyro

import sts_jax as sts
from experiments.shared.collecting import Collect, collect
from experiments.shared.config import MODELS, MOST, TITLES, check_warmup
from experiments.shared.evaluate import identity, record, stale
from experiments.shared.run import Job, Stage, train_model
from experiments.shared.terminal import Bar, say
from sts_jax import evaluation, hardware, storage, training
from sts_jax.evaluation import Predicted
from sts_jax.hardware import SensorView, twin
from sts_jax.predict import MODELS as SHIPPED
from sts_jax.training import TrainConfig

NAMES = ("vae-visual", "vae-tactile", "mvae-without-pose")  # the rows of the paper's Table 2
SIMULATED = "released"  # model of the library that was trained on simulated images only
SIMULATED_TITLE = "state-space model, simulated training"
FLOOR = "the truth itself (entropy)"
LEAST = 5  # smallest number of trajectories, so that one of them can be held out


@dataclasses.dataclass(frozen=True)
class Config:
    """Options to train and evaluate the models of the paper's Table 2 on recorded trajectories."""

    training: TrainConfig  # options of the training
    # number of trajectories that the digital twin collects if the work directory has none of a device
    count: int = 100
    size: tuple[int, int] = (640, 480)  # width and height of the twin's images (pixels)
    # numbers of gradient steps, one for each of the three models. None: each is trained for training.epochs epochs
    steps: tuple[int, int, int] | None = None
    # modalities that the models learn to predict when only some modalities are given: all of them, or only the given
    # ones (own, as in the paper)
    targets: Literal["all", "own"] = "all"
    # also train with the final pair as an input, so that the models learn that an object at rest stays at rest
    rest: bool = True
    shifts: int = 15  # number of shifted copies of each training trajectory
    largest_shift: int = 8  # largest shift of a copy (pixels). In images of 64 pixels, one pixel is 2.3 mm wide
    image_size: int = 64  # side of the images that are used and predicted (pixels). The paper uses 64
    held_out: float = 0.2  # share of the trajectories for validation. The paper uses 0.2
    seed: int = 0  # seed of the split into training and validation
    num_shown: int = 6  # number of validation trajectories in the figure


@dataclasses.dataclass(frozen=True)
class Train:
    """Train the models of the paper's Table 2 on recorded trajectories, and write the table."""

    # configuration of the preset. Each of its fields is an option
    config: Annotated[Config, tyro.conf.arg(name="")]
    workdir: Path = Path("runs/real")  # work directory with the folder `dataset` and the sensor file `sensor.json`
    name: str = "table2"  # folder in the work directory for the results
    preset: Literal["smoke", "default", "paper"] = "default"  # set of default values for the options
    only: Stage | None = None  # run only this stage of the experiment
    debug: bool = False  # show the traceback of every error


class Recorded(NamedTuple):
    """Recorded trajectories and images of the empty pad. All images are rectified to the view of `Sensor.camera`."""

    train: hardware.RecordedImages  # training trajectories
    validation: hardware.RecordedImages  # validation trajectories
    empty: dict[str, np.ndarray]  # image of the empty pad for each stream, uint8 (size, size, 3)
    identity: str  # checksum of the trajectories and the sensor file
    source: str  # description of the sensor, for titles


def main(args: Train) -> None:
    """Collect trajectories of the digital twin if there are too few, train, evaluate, and print the table."""
    config, workdir, folder = args.config, args.workdir, args.workdir / args.name
    check(config)
    sts.enable_compilation_cache()
    if args.only in (None, "collect") and (count := missing(config, workdir)):
        say(f"collect: {count} trajectories of the digital twin into {workdir / 'dataset'}")
        collect(Collect(workdir, twin=True, count=config.count, size=config.size, seed=twin_seed(workdir)))
    if args.only == "collect":
        return
    data = read(config, workdir)
    with storage.lock(folder, finished=True):
        storage.claim(folder / "config.json", {**dataclasses.asdict(config), "trajectories": data.identity})
        if args.only in (None, "train"):
            for job in jobs(config, data):
                train_model(job, folder / "models" / job.name, config.targets)
        if args.only in (None, "evaluate"):
            print(evaluate(config, data, workdir, folder))


def check(config: Config) -> None:
    """Check the fields of the configuration before any work."""
    if not 0 < config.held_out < 1:
        raise ValueError(f"held_out must be a share above 0 and below 1, got {config.held_out}")
    for name, least in (("count", LEAST), ("num_shown", 1), ("shifts", 0)):
        if not least <= getattr(config, name) <= MOST:
            raise ValueError(f"{name} must be >= {least} and <= {MOST}, got {getattr(config, name)}")
    for number in config.steps or ():
        dataclasses.replace(config.training, steps=number)  # raises an error for a number out of range
    check_warmup(config.training, "training", config.steps)
    dataclasses.replace(config.training, seed=config.seed)
    if not 0 <= config.largest_shift < config.image_size:
        raise ValueError(f"largest_shift must be 0 to {config.image_size - 1} pixels, got {config.largest_shift}")
    # This raises an error if no network exists for images of this size.
    training.paper_model(("visual",), training.Preprocessing((config.image_size, config.image_size)))


def missing(config: Config, workdir: Path) -> int:
    """The number of trajectories that the digital twin still has to collect, 0 for trajectories of other devices."""
    if not (workdir / "dataset" / storage.MANIFEST).exists():
        return config.count
    recordings = hardware.load_recordings(workdir / "dataset")
    return max(config.count - len(recordings), 0) if recordings.origin.camera == twin.CAMERA else 0


def twin_seed(workdir: Path) -> int:
    """The seed of the twin whose sensor file a work directory has, or 0."""
    exists = (workdir / hardware.sensor_file.NAME).exists()
    number = hardware.Device.load(workdir).leds.removeprefix("TWIN") if exists else ""
    return int(number) if number.isdecimal() else 0


def read(config: Config, workdir: Path) -> Recorded:
    """Read the confirmed trajectories of a work directory, rectify the images, and hold out validation trajectories."""
    recordings = hardware.load_recordings(workdir / "dataset")
    if len(recordings) < LEAST:
        raise ValueError(
            f"the number of confirmed trajectories in {recordings.folder} must be >= {LEAST}, got {len(recordings)}: "
            "collect more, or confirm existing ones with `python -m experiments.real review --confirm NUMBER`"
        )
    device, camera = hardware.Device.load(workdir), sts.Sensor.load(workdir / "sensor.json").camera
    backgrounds = device.backgrounds(workdir)
    if backgrounds is None:
        raise ValueError(
            f"{workdir} has no images of the empty pad, which are needed to find contacts: copy all files that "
            "`python -m experiments.commission` wrote into the work directory"
        )

    def rectified(image: np.ndarray) -> np.ndarray:
        return hardware.rectified(device.lens, camera, image, (config.image_size, config.image_size))

    with Bar() as bar:
        images = recordings.images(rectified, lambda done, total: bar("read", done, total))
    order = np.random.default_rng(config.seed).permutation(len(recordings))
    cut = min(max(round((1 - config.held_out) * len(order)), 1), len(order) - 1)
    train, validation = (
        hardware.RecordedImages(*(leaf[np.sort(rows)] for leaf in images)) for rows in (order[:cut], order[cut:])
    )
    # The serial number of a twin's LED controller begins with TWIN.
    is_twin = recordings.origin.leds.startswith("TWIN")
    source = "a digital twin" if is_twin else f"the sensor {recordings.origin.camera}"
    content = {"dataset": recordings.identity, "sensor": hardware.sensor_file.checksums(workdir)}
    empty = dict(zip(evaluation.STREAMS, map(rectified, backgrounds), strict=True))
    return Recorded(train, validation, empty, storage.digest(content), source)


def jobs(config: Config, data: Recorded) -> Iterator[Job]:
    """Prepare the training of each of the three models."""
    size, blank = (config.image_size, config.image_size), data.empty["tactile"]
    preprocessing = training.touch_of_noisy_images(training.Preprocessing(size), data.train.tactile[:, 0], blank)
    visual, tactile = (augmented(config, getattr(data.train, name), data.empty[name]) for name in ("visual", "tactile"))
    for number, name in enumerate(NAMES):
        modalities = MODELS["paper"][name]
        arrays, completed = training.image_arrays(visual, tactile, modalities, preprocessing, blank)
        if completed.absent:
            raise ValueError(
                "none of the initial tactile images for training shows a contact: compare those of `python -m "
                "experiments.real review --sheet review.png` with the tactile background of the sensor file"
            )
        schedule = config.training
        if config.steps is not None:
            schedule = dataclasses.replace(schedule, steps=config.steps[number])
        yield Job(name, schedule, training.paper_model(modalities, completed), arrays, completed, data.empty)


def augmented(config: Config, images: np.ndarray, empty: np.ndarray) -> np.ndarray:
    """Add `config.shifts` shifted copies of image pairs (n, 2, size, size, 3), and copies that begin at rest."""
    random, far = np.random.default_rng(config.seed), config.largest_shift
    parts = [images]
    for _ in range(config.shifts):
        parts.append(training.shifted(images, empty, random.integers(-far, far + 1, (len(images), 2))))
    if config.rest:
        parts += [part[:, [1, 1]] for part in parts]
    return np.concatenate(parts)


def evaluate(config: Config, data: Recorded, workdir: Path, folder: Path) -> str:
    """Score the models on the validation trajectories, write the results, and return a short text for the terminal."""
    metrics, table = folder / "metrics.json", folder / "table.md"
    models = {name: folder / "models" / name for name in NAMES}
    inputs = {"config.json": storage.digest(dataclasses.asdict(config)), "dataset": data.identity}
    judged = {**models, SIMULATED: SHIPPED / SIMULATED}
    inputs |= {f"models/{name}": identity(path) for name, path in judged.items()}
    reason = stale(folder, "evaluation", inputs)
    if reason is None:
        return ending(data, storage.read_json(metrics, f"delete {metrics}"), folder)
    if metrics.exists():
        say(f"evaluate: again, because {reason}")
    predicted = predictions(models, data)
    transfer = transferred(config, data, workdir)
    if transfer is not None:
        predicted[SIMULATED_TITLE] = transfer
    baselines = evaluation.image_baselines(data.train, data.validation)
    summary = evaluation.image_summary({**baselines, **predicted}, data.validation)
    logs = {TITLES[name]: training.records(path) for name, path in models.items()}
    figures = [folder / "figures" / name for name in ("predictions.png", "training.png")]
    draw(config, data, predicted, figures[0])
    evaluation.figures.training_curves(figures[1], logs)
    text = as_table(config, data, summary, logs)
    storage.write_bytes(table, text.encode())
    storage.write_json(metrics, {"source": data.source, **summary})
    record(folder, "evaluation", inputs, [metrics, table, *figures])
    return ending(data, summary, folder)


def ending(data: Recorded, summary: Mapping[str, Any], folder: Path) -> str:
    """What the terminal shows at the end: a short table, where the results are, and what to do next."""
    scores = [summary[stream]["predictors"] for stream in evaluation.STREAMS]
    rows = [["predictor", *(f"{stream} skill" for stream in evaluation.STREAMS)]]
    for name in dict.fromkeys(name for stream in scores for name in stream):
        cells = [(stream.get(name) or {}).get("skill") for stream in scores]
        rows.append([name, *("-" if cell is None else f"{cell['value']:.3f}" for cell in cells)])
    return "\n".join(
        [
            f"{len(data.validation.number)} held-out trajectories of {data.source}. "
            "Skill is 0 for the mean image and 1 for the true image",
            evaluation.aligned(rows),
            f"table:   {folder / 'table.md'} has intervals and explains the metrics",
            f"figures: {folder / 'figures'}",
            f'next:    sts.Predictor.load("{folder / "models" / "mvae-without-pose"}") in Python predicts from images',
        ]
    )


def predictions(models: Mapping[str, Path], data: Recorded) -> dict[str, Predicted]:
    """Predict the validation trajectories with each model, from each subset of its inputs, by title of the row."""
    rows, first = {}, _held(data)
    for name, path in models.items():
        predictor = sts.Predictor.load(path)
        for given, subset in evaluation.subsets(predictor.modalities).items():
            out = predictor(**{stream: first[stream] for stream in subset})  # type: ignore[arg-type]
            title = TITLES[name] if len(subset) == len(predictor.modalities) else f"{TITLES[name]}, {given} alone"
            visual, tactile = (None if image is None else np.asarray(image) for image in (out.visual, out.tactile))
            rows[title] = Predicted(visual, tactile)
    return rows


def transferred(config: Config, data: Recorded, workdir: Path) -> Predicted | None:
    """Predict with the library's model `released`, which knows simulated images only, if it supports the image size.

    `hardware.relit` adapts the images to the model's training images, and the predictions back to the recorded images.
    """
    predictor = sts.Predictor.load(SIMULATED)
    side, (height, _) = config.image_size, predictor.preprocessing.resolution
    if height % side:
        return None
    large = read(dataclasses.replace(config, image_size=height), workdir)
    recorded, model = SensorView(**_unit(large.empty)), SensorView(**predictor.empty)
    views = _relit(SensorView(**_held(large)), recorded, model)
    out = predictor(visual=views.visual, tactile=views.tactile)
    predicted, step = SensorView(np.asarray(out.visual), np.asarray(out.tactile)), height // side
    if predicted.visual.shape[1:3] != (side, side):
        return None
    small = SensorView(*(image.reshape(side, step, side, step, 3).mean((1, 3)) for image in model))
    back = _relit(predicted, small, SensorView(**_unit(data.empty)))
    return Predicted(back.visual, back.tactile)


def _relit(images: SensorView, given: SensorView, wanted: SensorView) -> SensorView:
    """Adapt n pairs of images from one sensor to another, which are known by their images of the empty pad."""
    views = [hardware.relit(SensorView(*pair), given, wanted) for pair in zip(*images, strict=True)]
    return SensorView(*(np.stack(stream) for stream in zip(*views, strict=True)))


def _held(data: Recorded) -> dict[str, np.ndarray]:
    """The initial images of the validation trajectories."""
    return _unit({stream: getattr(data.validation, stream)[:, 0] for stream in evaluation.STREAMS})


def _unit(images: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Convert uint8 images to float32 in [0, 1]."""
    return {stream: image.astype(np.float32) / 255 for stream, image in images.items()}


def draw(config: Config, data: Recorded, predicted: Mapping[str, Predicted], path: Path) -> None:
    """Draw input images of the first validation trajectories, and predicted and true images of the object at rest."""
    held = data.validation
    labels = [f"#{number}" for number in held.number[: config.num_shown]]
    columns = {"MVAE": TITLES["mvae-without-pose"], "simulated training": SIMULATED_TITLE}

    def truth(stream: str, moment: int) -> np.ndarray:
        return getattr(held, stream)[: len(labels), moment] / 255

    groups = [{"visual": truth("visual", 0), "tactile": truth("tactile", 0)}]
    for stream in ("visual", "tactile"):
        rows = {f"VAE {stream} only": TITLES[f"vae-{stream}"], **columns}
        group = {
            head: getattr(predicted[title], stream)[: len(labels)] for head, title in rows.items() if title in predicted
        }
        groups.append({**group, "truth": truth(stream, 1)})
    evaluation.figures.comparison(
        path,
        groups,
        labels,
        title=f"Images of {data.source}: the first {len(labels)} of {len(held.number)} validation trajectories",
        heads=("held, the input", "at rest, visual", "at rest, tactile"),
    )


def as_table(config: Config, data: Recorded, summary: dict, logs: Mapping[str, list[dict]]) -> str:
    """Write the scores with their 95 % intervals (`evaluation.image_summary`) as a table in Markdown."""

    def cell(x: Mapping[str, Any] | None, factor: float = 1, digits: int = 3) -> str:
        return "NA" if x is None else evaluation.metrics.written(**x, digits=digits, factor=factor)

    titles = ("BCE (x1e-4)", "skill", "skill against the copy")
    heads = ["predictor", *(f"{stream} {title}" for stream in summary for title in titles)]
    rows = [heads, [FLOOR, *(text for x in summary.values() for text in (f"{1e4 * x['floor']:.0f}", "1", "1"))]]
    for name in dict.fromkeys(name for scores in summary.values() for name in scores["predictors"]):
        rows.append([name])
        for scores in summary.values():
            x = scores["predictors"].get(name)
            rows[-1] += ["NA"] * 3 if x is None else [cell(x["bce"], 1e4, 0), cell(x["skill"]), cell(x["skill_copy"])]
    lines = [f"| {' | '.join(row)} |" for row in rows]
    alone = " [-] stands for no interval, because only one trajectory is held out." * any("[-]" in x for x in lines)
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
            f"replaces the constant by the copy of the input, where excess is the BCE above its smallest value.{alone}",
            "",
            lines[0],
            "|---" * len(heads) + "|",
            *lines[1:],
            "",
            f"Gradient steps: {steps}, batch {config.training.batch_size}.",
            "",
            f"{SIMULATED_TITLE}: the library's model `{SIMULATED}` from both held images. It has seen no image of "
            "this sensor, and its training objects are other cameras.",
            "",
        ]
    )
