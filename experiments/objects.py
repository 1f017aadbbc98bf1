"""Draw a picture of procedural objects, one row per class, and print how well their collision hulls fit.

    python -m experiments.objects --out sheet.png --seed 0 --num 10

`--view below` shows the objects as the sensor sees them. `--shuffle` draws them in random order without names, so
that other people can try to recognise them. A line is printed for each object: its size, its number of faces, the
number of vertices of its collision hull, and the largest distances by which the surface lies outside the hull and the
hull outside the surface. With `--parts`, each object whose hull fits badly is first decomposed into convex parts.
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
from experiments.shared import drawing, terminal
from sts_jax import optics, storage

DISTANCE = 0.42  # distance from the camera to the object (m)
FIELD = 0.36  # field of view (rad). At this distance, 150 mm fill the picture
EYES = {  # direction from the object to the camera: x right, y back, z up
    "quarter": (-0.45, -0.75, 0.5),
    "side": (-0.45, -0.85, 0.2),
    "above": (0.0, -0.05, 1.0),
    "below": (0.0, -0.05, -1.0),
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Options of the command line: the objects in the picture, the direction of the view, and the picture's path."""

    out: Path = Path("objects.png")  # path of the picture
    seed: int = 0  # seed of the objects
    num: int = 10  # number of objects per class
    categories: tuple[str, ...] = sts.objects.CATEGORIES  # object classes to draw
    view: Literal["quarter", "side", "above", "below"] = "quarter"  # direction from which the objects are seen
    size: int = 160  # side of one object's picture (pixels)
    parts: bool = False  # decompose an object into convex parts if its convex hull fits badly
    # draw the objects in random order, with numbers instead of names. The names are written to OUT with the suffix .txt
    shuffle: bool = False


@jax.jit(static_argnames=("size",))
def portrait(body: sts.objects.Body, direction: jax.Array, *, size: int) -> jax.Array:
    """Render an object in front of a white background, from a direction (3,). Flat objects are seen from higher up."""
    extent = jnp.max(body.vertices, 0) - jnp.min(body.vertices, 0)
    flat = (extent[2] < 0.3 * jnp.maximum(extent[0], extent[1])) & (direction[2] > 0) & (direction[2] < 0.9)
    direction = direction + jnp.where(flat, jnp.array([0.0, 0.0, 0.5]), jnp.zeros(3))
    middle = (jnp.max(body.vertices, 0) + jnp.min(body.vertices, 0)) / 2
    eye = middle + DISTANCE * direction / jnp.linalg.norm(direction)
    mesh, view = (body.vertices, body.faces, body.normals, body.colors), {"eye": eye, "target": middle, "fov": FIELD}
    return optics.photograph(*mesh, **view, resolution=(size, size), two_sided=body.two_sided)


def describe(category: str, number: int, body: sts.objects.Body, *, parts: bool) -> str:
    """Describe one object in one line. With `parts`, an object whose hull fits badly is decomposed first."""
    facts = sts.objects.facts(body, apart := sts.objects.gaps(body))
    if parts and apart[1] > sts.objects.HOLLOW:
        body = sts.objects.decompose(body)
        facts = [*sts.objects.facts(body, sts.objects.gaps(body)), f"as one hull {facts[-1]}"]
    return f"{category}  {number}: " + "; ".join(facts)


def main(config: Config) -> None:
    """Make the objects, print their descriptions, and draw them in one picture."""
    terminal.check_numbers(config, num=(1, 1000), seed=terminal.SEEDS, size=terminal.SIDES)
    if not config.categories:
        raise ValueError("--categories is empty, but it must name at least one class, such as bottle")
    families = {category: sts.objects.find_family(category) for category in config.categories}
    drawing.check_picture(config.out)
    key = jax.random.key(config.seed)
    drawn = [
        (category, sts.objects.make(jax.random.fold_in(jax.random.fold_in(key, family.seed), number), category))
        for category, family in families.items()
        for number in range(config.num)
    ]
    if config.shuffle:
        order = np.asarray(jax.random.permutation(key, len(drawn)))
        drawn = [drawn[i] for i in order]
        lines = [f"{i + 1} {category}" for i, (category, _) in enumerate(drawn)]
        storage.write_bytes(config.out.with_suffix(".txt"), ("\n".join(lines) + "\n").encode())

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
    drawing.write_figure(config.out, figure, dpi=100)
    pyplot.close(figure)


if __name__ == "__main__":
    with terminal.on_one_line():
        main(tyro.cli(Config))
