"""Skill of the library's trained models on images of the digital twin.

    python -m benchmarks.live

In the digital twin, a hand holds an object in an unstable pose and lets go. Each model predicts the images of the
object at rest from the images of the held object, as `experiments.live` does. The command prints the skill of the
predicted images: one number for all trajectories together, computed from mean squared errors. The skill is 1 if each
predicted image equals the true last image. It is 0 if the prediction for each trajectory is the mean of the last images
of all other trajectories. No model was trained with the twin's noise, vignetting and leaking light. The twin's object
moves as in the scenario `physics.Released`. Only the model `released` was trained on this scenario, with objects of the
same class as the twin's object.
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
    """Record trajectories of the digital twin.

    Returns:
        A pair of images of the empty pad, a list of pairs of the held object, and a list of pairs of the object at
        rest. A pair is a visual and a tactile image. Each list has one pair per trajectory.
    """
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
    """Convert the visual or the tactile images of some pairs to inputs of a model.

    Args:
        views: Conversion from raw images of the digital twin (a simulated sensor) to the view of the pinhole camera
            `Sensor.camera`.
        predictor: The model.
        pairs: List of `n` pairs. A pair is a visual and a tactile raw image of the digital twin.
        index: 0 for the visual stream, 1 for the tactile stream.
        size: Height and width of the result, divisors of the height and width of the model's inputs. Each pixel is the
            mean of a block of pixels. Default: the size of the model's inputs.

    Returns:
        Images in [0, 1], `(n, height, width, 3)`.
    """
    images = np.stack([views.prepared(*pair, predictor.empty)[index] for pair in pairs])
    height, width = size or images.shape[1:3]
    step = images.shape[1] // height
    return images.reshape(len(pairs), height, step, width, step, 3).mean((2, 4)).astype(np.float32)


def skill(found: np.ndarray, truth: np.ndarray) -> float:
    """Skill of predicted images.

    Args:
        found: Predicted images, `(n, side, side, 3)`.
        truth: True images, of the same shape.

    Returns:
        `1 - e / e0`, where `e` is the mean squared error of the predictions, and `e0` is the mean squared error of a
        prediction of each image by the mean of the other true images.
    """
    others = (truth.sum(0) - truth) / (len(truth) - 1)
    return 1 - float(((found - truth) ** 2).mean() / ((others - truth) ** 2).mean())


def main(args: Args) -> None:
    """Record trajectories of the digital twin, and print a table with the skill of every model.

    The skill is a score of the predicted images. It is 1 if each predicted image equals the true last image. It is 0 if
    the prediction for each trajectory is the mean of the last images of all other trajectories.

    In the rows with `kept`, the images contain the background of the twin, such as its vignetting. In the rows with
    `divided out`, this background is replaced by the background of the model's training images (`hardware.relit`).
    """
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
