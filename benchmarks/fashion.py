"""Log evidence of the MVAE on Fashion-MNIST images and labels, beside the published one.

    apt-get install dataset-fashion-mnist
    python -m benchmarks.fashion                # half an hour on two CPU cores, can be stopped and started again
    python -m benchmarks.fashion --epochs 1     # minutes

The loss is the sum of the bounds of all three subsets of image and label, each of which predicts its own members. The
published values are those of Wu and Goodman (2018), table 2, for the same loss (the sub-sampled bound), with other
networks. The images are padded from 28x28 to 32x32 pixels with black. The evidence includes the padding, and is
therefore slightly too low.

Images are grey, and their binary cross-entropy is not normalised. The command also prints the largest possible value,
which is minus the mean entropy of the pixels.
"""

import dataclasses
import gzip
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from sts_jax import mvae, training

DATA = Path("/usr/share/datasets/fashion-mnist")  # folder of Debian's package
PUBLISHED = {"log p(x)": -232.5, "log p(x, y)": -233.0}
CLASSES = 10
BATCH = 50  # test images whose evidence is computed at once


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    workdir: Path = Path("runs/fashion")  # folder of the model
    data: Path = DATA  # folder of the four files of the data set
    epochs: int = 20  # passes over the 60,000 training images
    latent: int = 64  # components of the latent (Wu and Goodman: 64)
    widths: tuple[int, int, int, int] = (32, 64, 128, 256)  # channels after each convolution
    hidden: int = 512  # width between two fully connected layers
    items: int = 500  # number of test images
    num: int = 1000  # number of importance samples


def read(folder: Path, part: str) -> tuple[np.ndarray, np.ndarray]:
    """Read the images, uint8 `(n, 32, 32, 1)`, and labels, one-hot `(n, 10)`, of the part `train` or `t10k`."""
    with gzip.open(folder / f"{part}-images-idx3-ubyte.gz") as file:
        images = np.frombuffer(file.read(), np.uint8, offset=16).reshape(-1, 28, 28, 1)
    with gzip.open(folder / f"{part}-labels-idx1-ubyte.gz") as file:
        labels = np.frombuffer(file.read(), np.uint8, offset=8)
    return np.pad(images, ((0, 0), (2, 2), (2, 2), (0, 0))), np.eye(CLASSES, dtype=np.float32)[labels]


def train(args: Args, images: np.ndarray, labels: np.ndarray) -> training.Model:
    """Train the model, or continue its training. The weight of the label is 10, as in the code of Wu and Goodman."""
    modalities = (
        mvae.Modality("image", "image", images.shape[1:], start=float(images.mean() / 255)),
        mvae.Modality("label", "category", (CLASSES,), weight=10.0),
    )
    config = mvae.Config(modalities, latent=args.latent, hidden=args.hidden, widths=args.widths)
    values = {"image": images, "label": labels}
    schedule = training.TrainConfig(
        epochs=args.epochs, batch_size=100, learning_rate=1e-3, schedule="cosine", beta_warmup=0.4
    )

    def show(done: int, total: int, record: dict[str, float]) -> None:
        if done % 200 == 0 or done == total:
            print(f"step {done} of {total}, loss {record['loss']:.1f}", flush=True)

    arrays = training.Arrays(inputs=values, targets=values)
    return training.train(schedule, config, arrays, workdir=args.workdir, targets="own", progress=show)


def evidence(model: training.Model, images: np.ndarray, labels: np.ndarray, num: int) -> dict[str, np.ndarray]:
    """Importance-sampled log evidence of each test image (nats)."""

    def batch(part: dict[str, np.ndarray]) -> np.ndarray:
        values = {name: jnp.asarray(value) for name, value in part.items()}
        return np.asarray(mvae.log_evidence(model.graphdef, model.state, jax.random.key(0), values, values, num=num))

    both = {"image": images.astype(np.float32) / 255, "label": labels}
    result = {}
    for title, names in (("log p(x)", ("image",)), ("log p(x, y)", ("image", "label"))):
        parts = ({name: both[name][i : i + BATCH] for name in names} for i in range(0, len(images), BATCH))
        result[title] = np.concatenate([batch(part) for part in parts])
    return result


def ceiling(images: np.ndarray) -> float:
    """Largest possible mean of `log p(x)`: minus the entropy of the grey pixels (nats)."""
    x = images.astype(np.float64) / 255
    return float(np.mean(np.sum(np.log(x**x) + np.log((1 - x) ** (1 - x)), axis=(1, 2, 3))))


def main(args: Args) -> None:
    """Train the model, and print its evidence beside the published one."""
    model = train(args, *read(args.data, "train"))
    images, labels = (part[: args.items] for part in read(args.data, "t10k"))
    print(f"\nlargest possible log p(x): {ceiling(images):.2f}")
    for name, values in evidence(model, images, labels, args.num).items():
        error = values.std() / np.sqrt(len(values))
        print(f"{name}: {values.mean():.2f} +- {error:.2f}, published {PUBLISHED[name]:.1f}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
