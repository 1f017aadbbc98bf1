"""Draw a contact sheet of procedural objects, one row per class, and print how well their collision hulls fit.

    python -m experiments.objects --out sheet.png --seed 0 --num 10

About half a minute on two CPU cores for 8 x 10 objects. `--view side` is the view of a person, `--view below` that of
the sensor. `--shuffle` draws the objects in random order without names, so that others can try to recognise them.
Prints a line per object: size, faces, collision hull, and how far the surface sticks out of the hull at most / how far
the hull stands off the surface. `--parts` first decomposes objects whose hull fits badly into convex parts (some ten
seconds each).
"""

import dataclasses
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib import pyplot

import sts_jax as sts
from experiments.shared import errors, output
from sts_jax import optics

DISTANCE = 0.42  # m, from the camera to the object
FIELD = 0.36  # rad, so that 150 mm fill the frame
EYES = {  # direction to the camera: x right, y back, z up
    "quarter": (-0.45, -0.75, 0.5),
    "side": (-0.45, -0.85, 0.2),
    "above": (0.0, -0.05, 1.0),
    "below": (0.0, -0.05, -1.0),
}


@dataclasses.dataclass(frozen=True)
class Config:
    """A contact sheet of procedural objects."""

    out: Path = Path("objects.png")  # the picture
    seed: int = 0
    num: int = 10  # objects per class
    categories: tuple[str, ...] = sts.objects.CATEGORIES
    view: Literal["quarter", "side", "above", "below"] = "quarter"
    size: int = 160  # pixels, side of one object's picture
    parts: bool = False  # convex parts for objects whose hull fits badly
    shuffle: bool = False  # random order, numbers instead of names (the answers go to OUT with suffix .txt)


@jax.jit(static_argnames=("size",))
def portrait(body: sts.objects.Body, direction: jax.Array, *, size: int) -> jax.Array:
    """One body on white, (size, size, 3). Flat objects are shown from higher up."""
    extent = jnp.max(body.vertices, 0) - jnp.min(body.vertices, 0)
    flat = (extent[2] < 0.3 * jnp.maximum(extent[0], extent[1])) & (direction[2] > 0) & (direction[2] < 0.9)
    direction = direction + jnp.where(flat, jnp.array([0.0, 0.0, 0.5]), jnp.zeros(3))
    middle = (jnp.max(body.vertices, 0) + jnp.min(body.vertices, 0)) / 2
    eye = middle + DISTANCE * direction / jnp.linalg.norm(direction)
    return optics.photograph(
        body.vertices,
        body.faces,
        body.normals,
        body.colors,
        eye=eye,
        target=middle,
        fov=FIELD,
        resolution=(size, size),
        two_sided=body.two_sided,
    )


def describe(category: str, number: int, body: sts.objects.Body, *, parts: bool) -> str:
    """The line of one object, as in `sts.objects.describe`, with `parts` decomposed as in `dataset.make_bodies`."""
    found = sts.objects.facts(body, apart := sts.objects.gaps(body))
    if parts and apart[1] > sts.objects.HOLLOW:
        body = sts.objects.decompose(body)
        found = [*sts.objects.facts(body, sts.objects.gaps(body)), f"as one hull {found[-1]}"]
    return f"{category}  {number}: " + "; ".join(found)


def main(config: Config) -> None:
    """Make the objects, print their descriptions, render them, and compose the sheet."""
    if config.num < 1:
        raise ValueError(f"num is {config.num}, but it must be at least 1 object per class")
    families = {category: sts.objects.find_family(category) for category in config.categories}
    output.check_picture(config.out)
    key = jax.random.key(config.seed)
    drawn = []
    for category, family in families.items():
        for number in range(config.num):
            own = jax.random.fold_in(jax.random.fold_in(key, family.seed), number)
            drawn.append((category, sts.objects.make(own, category)))
    if config.shuffle:
        order = np.asarray(jax.random.permutation(key, len(drawn)))
        drawn = [drawn[i] for i in order]
        lines = [f"{i + 1} {category}" for i, (category, _) in enumerate(drawn)]
        config.out.with_suffix(".txt").write_text("\n".join(lines) + "\n")

    print("class  number: size (mm); faces; collision hull; gaps (mm)")
    for index, (category, body) in enumerate(drawn):
        number = index if config.shuffle else index % config.num
        print(describe(category, number + 1, body, parts=config.parts), flush=True)

    rows = len(config.categories)
    figure, axes = pyplot.subplots(rows, config.num, figsize=(1.6 * config.num, 1.7 * rows), squeeze=False)
    direction = jnp.array(EYES[config.view])
    for index, (axis, (category, body)) in enumerate(zip(axes.ravel(), drawn, strict=True)):
        axis.imshow(np.asarray(portrait(body, direction, size=config.size)), interpolation="none")
        axis.set_title(str(index + 1) if config.shuffle else category, fontsize=7, pad=1)
        axis.axis("off")
    figure.subplots_adjust(0.005, 0.005, 0.995, 0.985, 0.02, 0.08)
    figure.savefig(config.out, dpi=100)
    pyplot.close(figure)


if __name__ == "__main__":
    with errors.on_one_line():
        main(tyro.cli(Config))
