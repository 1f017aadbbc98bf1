"""Work directories of recorded trajectories with drawn images, in seconds and without a simulation."""

import numpy as np

import sts_jax as sts
from sts_jax import hardware
from sts_jax.hardware import Lit, Pair, Shot

LEVELS = (255, 255, 255, 255)
SIZE = (96, 128)  # height and width of the raw images, pixels
LENS = hardware.Lens.ideal(SIZE[1], SIZE[0])
SQUARE = 9  # pixels, side of the object in a view of 64 x 64


def drawn(place, colour, noise=None):
    """A view of 64 x 64 with a square at a place (row, column), or of the empty pad for None."""
    image = np.full((64, 64, 3), 170.0)
    if place is not None:
        row, column = place
        image[row : row + SQUARE, column : column + SQUARE] = colour
    if noise is not None:
        image = image + noise.normal(0, 1, image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def raw(view):
    """The raw image of a camera that sees a view."""
    return hardware.distorted(LENS, sts.Sensor().camera, view, outside=170.0)


def pair(visual, tactile):
    """A pair of raw images."""

    def shot(image, stream):
        return Shot(image, stream, 1.0, 1, 1, Lit(LEVELS if stream == "tactile" else (0,) * 4, 1, 1, 0.1, 0.2), 2.0)

    return Pair(shot(visual, "visual"), shot(tactile, "tactile"))


def record(workdir, count, *, leds="0123", sensor_file=True, seed=0):
    """Record trajectories in which a square moves by ten rows, with a sensor file. Returns their first places."""
    random = np.random.default_rng(seed)
    places = random.integers(4, 40, (count, 2))
    workdir.mkdir(exist_ok=True)
    if sensor_file:
        device = hardware.Device("camera", 30.0, leds, LENS, 0.1, 0.1, LEVELS, "2026-05-31", lens_from="ideal")
        empty = raw(drawn(None, None))
        device.save(workdir, sts.Sensor(), (empty, empty))
    origin = hardware.Origin("camera", leds, SIZE[1], SIZE[0], LEVELS)
    with hardware.Session(workdir / "dataset", origin) as session:
        for row, column in places:
            number = session.begin()
            for end, place in (("initial", (row, column)), ("final", (row + 10, column))):
                images = (raw(drawn(place, colour, random)) for colour in ((60, 60, 60), (220, 90, 40)))
                session.save(number, end, pair(*images))
            session.confirm(number)
    return places
