"""Skill of the library's trained models on images of the twin, as `experiments.live` predicts them.

    python -m benchmarks.live

The skill of all trajectories together is 1 - mean squared error / mean squared error of the mean last image of the
other trajectories. No model was trained with the twin's noise, vignetting and leaking light, and only the model
`released` was trained on the twin's scenario.
"""

import dataclasses
import math

import numpy as np
import tyro

import sts_jax as sts
from experiments.shared.device import TwinConfig, make_twin
from experiments.shared.live import Views
from sts_jax import hardware

MODELS = ("freefall", "inclined", "perturbed", "released")
LIT, DARK = (255, 255, 255, 255), (0, 0, 0, 0)
SETTLED_S = 0.2  # s, time between a switch of the light and an image
MOVES_S = 4.0  # s, time between the release and the images at rest
SIDE = 64  # pixels, side of the images that are compared

Pair = tuple[np.ndarray, np.ndarray]  # visual and tactile image of the camera


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    trajectories: int = 100  # number of trajectories
    seed: int = 0  # seed of the twin's object, motion and noise


def collect(args: Args) -> tuple[Pair, list[Pair], list[Pair]]:
    """Record trajectories of the digital twin."""
    # The images during the motion are not read, so one pose per second of the motion is rendered.
    with make_twin(TwinConfig(motion_rate=1.0, seed=args.seed)) as device:

        def pair() -> Pair:
            images = []
            for levels in (DARK, LIT):
                device.set(levels)
                device.step(SETTLED_S)
                images.append(device.capture()[1])
            return images[0], images[1]

        empty, held, rest = pair(), [], []
        for _ in range(args.trajectories):
            device.command("hold")
            device.step(SETTLED_S)
            held.append(pair())
            device.command("release")
            for _ in range(round(MOVES_S / SETTLED_S)):  # a ping every 0.2 s keeps the watchdog from firing
                device.step(SETTLED_S)
                device.ping()
            rest.append(pair())
    return empty, held, rest


def seen(
    views: Views, predictor: sts.Predictor, pairs: list[Pair], index: int, size: tuple[int, int] | None = None
) -> np.ndarray:
    """Convert the visual or the tactile images of some pairs to inputs of a model."""
    images = np.stack([views.prepared(*pair, predictor.empty)[index] for pair in pairs])
    height, width = size or images.shape[1:3]
    step = images.shape[1] // height
    return images.reshape(len(pairs), height, step, width, step, 3).mean((2, 4)).astype(np.float32)


def skill(found: np.ndarray, truth: np.ndarray) -> float:
    """Skill of predicted images."""
    others = (truth.sum(0) - truth) / (len(truth) - 1)
    return 1 - float(((found - truth) ** 2).mean() / ((others - truth) ** 2).mean())


def main(args: Args) -> None:
    """Record trajectories of the digital twin, and print a table with the skill of every model."""
    empty, held, rest = collect(args)
    pinhole, (height, width) = sts.Sensor().camera, empty[0].shape[:2]
    lens = hardware.Lens.ideal(width, height, distance=float(pinhole.distance), field_of_view=math.radians(160))
    size = (SIDE, SIDE)
    print(f"{args.trajectories} trajectories. Skill of the images at rest:\n")
    print("| backgrounds | prediction | from | visual | tactile | `fell off`, mean |\n|---|---|---|---|---|---|")
    for divided in (False, True):
        views = Views(lens, pinhole, empty, divided)
        word = "divided out" if divided else "kept"
        for name in MODELS:
            predictor = sts.Predictor.load(name)
            truth = [seen(views, predictor, rest, index, size) for index in (0, 1)]
            if name == MODELS[0]:
                copied = [skill(seen(views, predictor, held, index, size), truth[index]) for index in (0, 1)]
                print(f"| {word} | copy of the input | both | {copied[0]:.3f} | {copied[1]:.3f} | |")
            width_ = predictor.model.config.condition
            condition = np.zeros((len(held), width_), np.float32) if width_ else None
            for touch in (False, True) if "tactile" in predictor.modalities else (False,):
                found = predictor(
                    visual=seen(views, predictor, held, 0),
                    tactile=seen(views, predictor, held, 1) if touch else None,
                    condition=condition,
                )
                assert found.visual is not None
                assert found.tactile is not None
                scores = [skill(np.asarray(image), truth[i]) for i, image in enumerate((found.visual, found.tactile))]
                assert found.outcome_probability is not None
                off = float(found.outcome_probability[:, 1 if name == "freefall" else -1].mean())
                given = "visual and tactile" if touch else "visual"
                print(f"| {word} | {name} | {given} | {scores[0]:.3f} | {scores[1]:.3f} | {off:.2f} |", flush=True)


if __name__ == "__main__":
    sts.enable_compilation_cache()
    main(tyro.cli(Args, description=__doc__))
