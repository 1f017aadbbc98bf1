"""Scissors, partly open: two blades with one finger ring each."""

import numpy as np

from sts_jax.objects import colors, shapes
from sts_jax.objects.assembly import STEEL
from sts_jax.objects.shapes import Part


def parts(rng: np.random.Generator) -> list[Part]:
    """Return the parts (mm) of random scissors that lie on the table with their tips towards +y."""
    longest = rng.uniform(80, 130)  # mm
    blade = rng.uniform(42, 66)  # mm, from the pivot to the tip
    half = np.radians(rng.uniform(12, 40)) / 2  # rad, half the angle between the blades
    broad = rng.uniform(7, 11)  # mm, width of a blade at the pivot
    ring = rng.uniform(8.5, 12)  # mm, half the width of a finger hole
    oval = rng.uniform(1.0, 1.6)  # length of the finger hole over its width
    shank = rng.uniform(10, 20)  # mm, from the pivot to the ring
    tube = rng.uniform(2.2, 3.0)  # mm, half the thickness of the ring in the plane
    deep = rng.uniform(2.6, 3.6)  # mm, half the height of the ring
    steel = colors.steel(rng)
    grip = colors.vivid(rng) if rng.uniform() < 0.8 else colors.dark(rng)

    thick = 2.0
    outline = np.array([[-0.45, -6], [0.45, -6], [0.5, 0.35 * blade], [-0.28, blade], [-0.42, blade]])
    outline[:, 0] *= broad
    cutting = shapes.loft(shapes.rings(outline, [(1.0, 0.0), (1.0, thick)]), steel, density=STEEL)
    # The finger ring, with upright outer walls, and the shank that joins it to the blade.
    hole = shapes.ellipse(ring, ring * oval, 12) @ shapes.rotation_about_z(-0.6 * half)[:2, :2].T
    hole += [-0.95 * (ring + tube), -(shank + ring * oval)]
    path = np.column_stack([hole, np.zeros(12)])
    wall = np.array([[tube, -0.75 * deep], [tube, 0.75 * deep], [0.2 * tube, deep], [-tube, 0.5 * deep]])
    wall = np.vstack([wall, [[-tube, -0.5 * deep], [0.2 * tube, -deep]]])
    hoop = shapes.loft(shapes.sweep(path, wall, (0, 0, 1), closed=True), grip, closed=True)
    route = np.linspace(0, 1, 4)[:, None] * path[np.argmax(path @ [0.3, 1.0, 0.0])]
    widths, heights = np.linspace(0.9 * broad, 2.4 * tube, 4), np.linspace(thick, 1.5 * deep, 4)
    slim = np.stack([shapes.rectangle(w, h) for w, h in zip(widths, heights, strict=True)])
    shaft = shapes.loft(shapes.sweep(route, slim, (0, 0, 1)), [steel, grip, grip])
    right = [shapes.move(part, spin=-half) for part in (cutting, hoop, shaft)]
    left = [shapes.mirrored(part) for part in right]
    left[0] = shapes.move(left[0], (0, 0, -thick))
    screw = shapes.lathe([(2.9, -thick - 0.5), (2.9, thick + 0.5)], colors.grey(0.35), num=10, density=0.0)
    return shapes.scaled([*right, *left, screw], longest)
