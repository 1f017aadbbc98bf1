"""Whether the models that come with the library predict how a digital twin's object comes to rest.

    python -m benchmarks.live

A hand holds the object in an unstable pose and lets go. Each model predicts the images at rest from the images of the
held object, as `experiments.live` does. The skill of an image is 0 for the mean image at rest of the other trajectories
and 1 for the true image, by the mean squared error over all trajectories. The models know neither the twin's noise,
vignetting and leakage. Only `released` was trained on the scenario `Released` and on objects of this class.
"""

import dataclasses
import math

import numpy as np
import tyro

import sts_jax as sts
from experiments import twin
from experiments.shared.live import Backgrounds, Views
from sts_jax import hardware

MODELS = ("freefall", "inclined", "perturbed", "released")
LIT, DARK = (255, 255, 255, 255), (0, 0, 0, 0)
SETTLED_S = 0.2  # s, after a switch of the light
MOVES_S = 4.0  # s, from the release to the images at rest
SIDE = 64  # pixels, at which images are compared

Pair = tuple[np.ndarray, np.ndarray]  # raw images, visual and tactile


@dataclasses.dataclass(frozen=True)
class Args:
    """Number of trajectories."""

    trajectories: int = 100
    seed: int = 0


def collect(args: Args) -> tuple[Pair, list[Pair], list[Pair]]:
    """The empty pad, and the held and the resting object of each trajectory."""
    # Poses between both are not needed, so few are rendered.
    with twin.make(twin.Config(motion_rate=1.0, seed=args.seed)) as device:

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
            for _ in range(round(MOVES_S / SETTLED_S)):  # within the period of the watchdog
                device.step(SETTLED_S)
                device.ping()
            rest.append(pair())
    return empty, held, rest


def seen(
    views: Views, predictor: sts.Predictor, pairs: list[Pair], index: int, size: tuple[int, int] | None = None
) -> np.ndarray:
    """One stream of some pairs as a model takes it, `(n, height, width, 3)`, reduced to a size by block means."""
    images = np.stack([views.prepared(*pair, predictor.empty)[index] for pair in pairs])
    height, width = size or images.shape[1:3]
    step = images.shape[1] // height
    return images.reshape(len(pairs), height, step, width, step, 3).mean((2, 4)).astype(np.float32)


def skill(found: np.ndarray, truth: np.ndarray) -> float:
    """Skill of images `(n, side, side, 3)`."""
    others = (truth.sum(0) - truth) / (len(truth) - 1)
    return 1 - float(((found - truth) ** 2).mean() / ((others - truth) ** 2).mean())


def main(args: Args) -> None:
    """Print the table."""
    empty, held, rest = collect(args)
    pinhole, (height, width) = sts.Sensor().camera, empty[0].shape[:2]
    lens = hardware.Lens.ideal(width, height, distance=float(pinhole.distance), field_of_view=math.radians(160))
    size = (SIDE, SIDE)
    print(f"{args.trajectories} trajectories. Skill of the images at rest:\n")
    print("| backgrounds | prediction | from | visual | tactile | `fell off`, mean |\n|---|---|---|---|---|---|")
    for divided in (False, True):
        views = Views(lens, pinhole, Backgrounds(*empty, divided))
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
