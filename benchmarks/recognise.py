"""Draw a picture that tests whether people can match predicted images of objects at rest with the true images.

    python -m benchmarks.recognise runs/freefall --out recognise.png           # about a minute
    python -m benchmarks.recognise runs/freefall --given visual pose --first 20

The upper rows show one sample of the last visual image of each of ten held-out trajectories (A to J), the lower rows
the true last images in another order (1 to 10). The command prints the answers. With random answers, a person has one
correct pair on average.
"""

import dataclasses
from pathlib import Path
from typing import Annotated

import jax
import matplotlib.pyplot as plt
import numpy as np
import tyro

import sts_jax as sts
from experiments.shared import drawing, run
from sts_jax import dataset

NUMBER = 10


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    workdir: Annotated[run.Folder, tyro.conf.Positional]  # work directory of an experiment with trained models
    out: Path = Path("recognise.png")  # file of the picture
    given: tuple[str, ...] = ()  # input modalities (default: all inputs of the model)
    first: int = 0  # index of the first trajectory in the held-out list, from 0
    seed: int = 0  # seed of the samples and of the order of the true images


def main(args: Args) -> str:
    """Draw predicted images (A to J) and true images (1 to 10) in one picture, and return the correct pairs as text."""
    data = dataset.load(args.workdir / "dataset")
    rows = data.members("test")[args.first : args.first + NUMBER]
    if args.first < 0 or len(rows) < NUMBER:
        raise ValueError(f"--first must leave at least {NUMBER} held-out trajectories, got {args.first}")
    pairs = data.pairs(rows)
    predictor = sts.Predictor.load(args.workdir / "models" / "statespace")
    given = args.given or predictor.modalities
    inputs = {name: getattr(pairs, name)[:, 0] / (1 if name == "pose" else 255) for name in given}
    condition = pairs.condition if pairs.condition.shape[1] else None
    found = predictor(**inputs, condition=condition, key=jax.random.key(args.seed), num_samples=16)
    assert found.samples is not None
    assert found.samples.visual is not None
    predicted = np.asarray(found.samples.visual[0])
    truth = dataset.reduced(pairs, predicted.shape[1]).visual[:, 1]
    order = np.random.default_rng(args.seed).permutation(NUMBER)
    figure, axes = plt.subplots(4, -(-NUMBER // 2), figsize=(12, 10), layout="constrained")
    letters = "ABCDEFGHIJ"[:NUMBER]
    titles = [*(f"prediction {letter}" for letter in letters), *(f"true end {number + 1}" for number in range(NUMBER))]
    for axis, image, title in zip(axes.ravel(), [*predicted, *truth[order]], titles, strict=True):
        axis.imshow(image, interpolation="nearest")
        axis.set_title(title)
        axis.axis("off")
    drawing.write_figure(args.out, figure, dpi=80)
    answers = " ".join(f"{letter}{int(np.flatnonzero(order == k)[0]) + 1}" for k, letter in enumerate(letters))
    return f"{args.out}: from {' and '.join(given)}, held-out {rows[0]} to {rows[-1]}\nanswers: {answers}"


if __name__ == "__main__":
    print(main(tyro.cli(Args, description=__doc__)))
