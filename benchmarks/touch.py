"""Accuracy of a regression that estimates the mass of held-out objects from their uint8 tactile images at rest.

    python -m benchmarks.touch          # about a minute, for the dataset of runs/freefall
    python -m benchmarks.touch FOLDER   # another dataset of procedural objects of all classes

A ridge regression of the logarithm of the mass on simple features of the image is fitted to the training objects. The
features are computed from the number of the imprint's pixels and from their darkness. The command uses the
last images of objects that rest on the pad. It prints the accuracy on held-out objects, and the share of imprint pixels
that are saturated (value 0 or 255 in a channel). It writes no files.
"""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import tyro

from sts_jax import dataset, objects, physics


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    dataset: tyro.conf.Positional[Path] = Path("runs/freefall/dataset")  # folder of a dataset of procedural objects


def features(tactile: np.ndarray, blank: np.ndarray) -> np.ndarray:
    """Compute 11 features of the imprint in each image, from the number and the darkness of the imprint's pixels.

    The imprint consists of the pixels whose value in any channel differs by more than 3 (of 255) from `blank`.
    The darkness of a pixel in a channel is -log(value / value in `blank`). For each pixel, `most` is the
    maximum of its darkness over the channels, but at least 0. `mean` is the mean over the channels. The features are:

    - the logarithms of four quantities of the imprint: the sum of `most`, the sum of `mean`, the sum of the positive
      values of `mean`, and the number of pixels
    - the squares of these four logarithms
    - log(sum of `most`) * log(number of pixels)
    - the largest `most` and the largest `mean` of the image

    Args:
        tactile: Tactile images, uint8 `(n, h, w, 3)`.
        blank: Tactile image of the untouched sensor, uint8 `(h, w, 3)`.

    Returns:
        Features, `(n, 11)`.
    """
    ratio = np.clip(tactile.astype(np.float64), 1, 255) / blank.astype(np.float64)
    darkness = np.clip(-np.log(ratio).min(-1), 0, None)
    signed = -np.log(ratio).mean(-1)
    touched = np.abs(tactile.astype(int) - blank).max(-1) > 3
    size = touched.sum((1, 2))
    sums = [(darkness * touched).sum((1, 2)), np.clip((signed * touched).sum((1, 2)), 0.05, None), size + 1.0]
    sums += [(np.clip(signed, 0, None) * touched).sum((1, 2)) + 0.05]
    columns = [np.log(np.clip(s, 0.05, None)) for s in sums] + [darkness.max((1, 2)), signed.max((1, 2))]
    x = np.stack(columns, 1)
    return np.concatenate([x, x[:, :4] ** 2, x[:, :1] * x[:, 2:3]], 1)


def ridge(x: np.ndarray, y: np.ndarray, x_new: np.ndarray, penalty: float = 1.0) -> np.ndarray:
    """Predict `y` at `x_new` by ridge regression on standardised features.

    Args:
        x: Training features, `(n, k)`.
        y: Training targets, `(n,)`.
        x_new: Features of the items to predict, `(m, k)`.
        penalty: Weight of the squared coefficients.

    Returns:
        The predictions, `(m,)`.
    """
    centre, scale, level = x.mean(0), x.std(0), y.mean()
    a, b = (x - centre) / scale, (x_new - centre) / scale
    return level + b @ np.linalg.solve(a.T @ a + penalty * np.eye(a.shape[1]), a.T @ (y - level))


def saturated(tactile: np.ndarray, blank: np.ndarray) -> np.ndarray:
    """Find out which pixels of imprints are saturated.

    An imprint consists of the pixels of which a channel differs from `blank` by more than 3 (of 255).

    Args:
        tactile: Tactile images, uint8 `(n, h, w, 3)`.
        blank: Tactile image of the untouched sensor, uint8 `(h, w, 3)`.

    Returns:
        One Boolean for each pixel of the imprints in all images. It is True if a channel of the pixel is 0 or 255.
    """
    touched = np.abs(tactile.astype(int) - blank).max(-1) > 3
    return np.any((tactile == 0) | (tactile == 255), -1)[touched]


def main(args: Args) -> None:
    """Fit a regression that estimates the mass of an object from its tactile image, and print its accuracy.

    The accuracy is the R2 and the standard deviation of the error for the logarithm of the mass of held-out objects.
    The command also prints the share of imprint pixels that are saturated (value 0 or 255 in a channel).
    """
    data = dataset.load(args.dataset)
    collection = dataset.Collection(num_objects=data.collection["num_objects"], seed=data.collection["seed"])
    bodies = dataset.make_bodies(collection, np.arange(collection.num_objects))
    owner = data.trajectory["body"]
    mass, _, _ = jax.vmap(objects.rigid)(
        jax.tree.map(lambda x: x[owner], objects.stack(bodies)), data.hidden["fill"], data.hidden["shell_scale"]
    )
    log_mass = np.log(np.asarray(mass))
    rests = (data.trajectory["outcome"] == int(physics.Outcome.RESTS)) & data.trajectory["settled"]
    rests &= data.trajectory["contact"][:, -1]
    x, y, imprints = {}, {}, []
    for part in ("train", "test"):
        pairs = data.pairs(np.array([i for i in data.members(part) if rests[i]]))
        tactile = pairs.tactile[:, 1]
        blank = np.median(pairs.tactile[:, 0], axis=0).astype(np.uint8)
        x[part], y[part] = features(tactile, blank), log_mass[pairs.trajectory]
        imprints.append(saturated(tactile, blank))
    error = y["test"] - ridge(x["train"], y["train"], x["test"])
    explained = 1 - np.mean(error**2) / y["test"].var()
    print(f"log mass from uint8 touch, {len(error)} held-out rests: R2 {explained:.3f}, rmse {error.std():.3f}")
    print(f"imprint pixels at 0 or 255 in a channel: {100 * np.concatenate(imprints).mean():.2f} %")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
