"""Webcams: a ball or a bar with a lens, on a stalk with a flat foot."""

import numpy as np

from sts_jax.objects import colors, shapes
from sts_jax.objects.shapes import Part


def parts(rng: np.random.Generator) -> list[Part]:
    """Return the parts (mm) of a random webcam whose lens faces -y."""
    longest = rng.uniform(55, 90)  # mm
    ball = rng.uniform() < 0.5  # the head is a ball for half of the webcams, else a bar
    head = rng.uniform(13, 18)  # half the height of the head
    stretch = rng.uniform(2.1, 3.2)  # half the width of a bar over half its height
    neck = head * rng.uniform(0.4, 1.2)  # length of the stalk between foot and head
    foot = head * rng.uniform(1.1, 1.7)  # half the width of the foot
    foot_depth = rng.uniform(0.7, 1.0)  # depth of the foot over its width
    eye = head * rng.uniform(0.5, 0.68)  # radius of the lens
    shell = colors.dark(rng) if rng.uniform() < 0.4 else colors.pale(rng) if rng.uniform() < 0.5 else colors.vivid(rng)
    trim, base = colors.vivid(rng) if rng.uniform() < 0.5 else colors.steel(rng), colors.dark(rng)

    thick, shallow = 5.0, 2.5
    h = head if ball else 0.65 * head
    centre = thick + neck + 0.93 * h
    if ball:
        front, back = -0.74 * h, 0.8 * h
        profile = [(0.52 * h, -0.84 * h), (0.93 * h, -0.36 * h), (0.97 * h, 0.25 * h), (0.72 * h, 0.74 * h)]
        skull = shapes.lathe(profile, shell, num=12, interior=True)
    else:
        front, back, eye = -0.5 * head, 0.45 * head, min(eye, 0.8 * h)
        outline = shapes.ellipse(stretch * h, h, 12, 3.5)
        levels = [(0.9, -0.5 * head), (1.0, -0.25 * head), (0.95, 0.5 * head)]
        skull = shapes.loft(shapes.rings(outline, levels), shell, interior=True)
    glass = [(eye, 0.0), (eye, shallow), (0.82 * eye, shallow), (0.62 * eye, 1.0), (0.3 * eye, 1.2)]
    lens = shapes.lathe(glass, [trim, trim, colors.BLACK, colors.GLASS], num=12, ends=(None, colors.GLINT))
    pieces = [shapes.move(skull, (0, 0, centre), axis="-y"), shapes.move(lens, (0, front, centre), axis="-y")]
    if not ball:
        green = colors.linear(np.array([0.1, 0.9, 0.25]))
        pieces.append(shapes.decal(shapes.circle(1.5, 8), green, (eye + 3.0, front, centre), axis="-y"))
        slot, ink = shapes.rectangle(0.5 * h, 0.16 * h), colors.GLINT * 0.3 if shell.mean() < 0.1 else colors.BLACK
        for side in (-1, 1):  # microphones
            for row in (-1, 0, 1):
                place = (side * 0.66 * stretch * h, front, centre + row * 0.36 * h)
                pieces.append(shapes.decal(slot, ink, place, axis="-y"))
    # A round stalk on a flat foot, and the cable behind the stalk.
    stalk = [(4.4, thick), (3.4, thick + 0.5 * neck), (4.6, centre - 0.6 * h)]
    plate = shapes.rings(shapes.ellipse(foot, foot * foot_depth, 12, 2.6), [(1.0, 0.0), (0.84, thick)])
    t = np.linspace(0, 1, 7)
    path = np.stack([0 * t, back + 7 * np.sin(2.2 * t), centre - (centre - 2) * t**1.3], axis=1)
    pieces += [
        shapes.lathe(stalk, base, num=10, ends=(None, None)),
        shapes.loft(plate, base, ends=(base, base * 1.5)),
        shapes.decal(shapes.circle(0.45 * foot, 12), base * 2.5 + 0.03, axis="-z"),
        shapes.loft(shapes.sweep(path, shapes.circle(1.5, 6), (1, 0, 0)), colors.BLACK),
    ]
    return shapes.scaled(pieces, longest)
