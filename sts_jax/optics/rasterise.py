"""A z-buffer in plain JAX: the nearest face at each pixel, for triangles of any size on the screen.

Every face is cut into rows of pixels, and long rows into runs of a few pixels. A loop takes the list of runs in chunks,
and each chunk column by column, so the work grows with the covered pixels and not with the number of faces times
pixels. Each step is one scatter-min of a 32-bit key, with the depth in the high bits and the index of the face in the
low ones. The choice of the face has no gradient. Values interpolated from the chosen face have one.

Pixel coordinates are (column, row), whole numbers at pixel centres, x to the right and y down. `order` is smaller for
nearer points and affine across a face on the screen: -1/depth in the view of a pinhole, depth in a parallel view.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from sts_jax import _math

_SLACK = 1e-4  # pixels by which faces are enlarged, so that no pixel centre on a shared edge is missed
_GROUP = 1024  # faces cut at a time
_RUN = 8  # pixels of the longest run
_Corner = tuple[Array, Array, Array]  # column, row, order
_NOTHING = np.uint32(0xFFFFFFFF)


def rasterise(
    points: Float[Array, "v 2"],
    order: Float[Array, "v"],
    faces: Int[Array, "f 3"],
    keep: Bool[Array, "v"],
    two_sided: Bool[Array, ""],
    shape: tuple[int, int],
    *,
    within: ScalarLike | None = None,
    chunk: int = 1024,
) -> Int[Array, "*layers h w"]:
    """Index of the nearest face at every pixel centre.

    Args:
        points: vertices on the screen, (column, row) in pixels.
        order: of each vertex, smaller is nearer.
        faces: corner indices, counter-clockwise seen from outside the object in a right-handed frame. Padding faces at
            the end, whose corners are all one vertex, cost next to nothing.
        keep: vertices that can be drawn. A face needs all three.
        two_sided: whether faces are visible from behind too.
        shape: (height, width) of the image, pixels.
        within: an order. If given, the faces with a corner nearer than this have an image of their own too.
        chunk: runs drawn at a time.

    Returns:
        Face indices, -1 where no face is visible. With `within` two such images, (2, h, w): of the near faces, and of
        all. No gradient.
    """
    height, width = shape
    layers = () if within is None else (2,)
    pixels = math.prod((*layers, *shape))
    num_faces = faces.shape[0]
    points, order, within = jax.lax.stop_gradient((points, order, within))
    points_x, points_y = points[:, 0], points[:, 1]
    nearest, last = _math.least(jnp.where(keep, order, jnp.inf)), _math.most(jnp.where(keep, order, -jnp.inf))

    group = min(_GROUP, num_faces)
    different = (faces[:, 0] != faces[:, 1]) | (faces[:, 0] != faces[:, 2])
    real = _math.most(jnp.where(different, jnp.arange(1, num_faces + 1, dtype=jnp.int32), 0))

    def corners_of(chosen: Int[Array, "n"]) -> tuple[_Corner, _Corner, _Corner]:
        a, b, c = ((points_x[k], points_y[k], order[k]) for k in faces[chosen].T)
        return a, b, c

    def collect(state: tuple[Array, Array, Array, list[Array]]) -> tuple[Array, Array, Array, list[Array]]:
        """List the faces of a group that have runs: number of the first run, index of the face, runs per row."""
        base, count, total, lists = state
        face = jnp.minimum(base, num_faces - group) + jnp.arange(group, dtype=jnp.int32)
        a, b, c = corners_of(face)
        area = _cross(a, b, c)
        # Seen along +z with x right and y down, a face towards the camera is counter-clockwise: negative area.
        drawn = jnp.where(two_sided, area != 0, area < 0) & jnp.all(keep[faces[face]], axis=1)
        left, right = _lowest(a[0], b[0], c[0]), _highest(a[0], b[0], c[0])
        top, bottom = _lowest(a[1], b[1], c[1]), _highest(a[1], b[1], c[1])
        tall = bottom - top
        widest = jnp.abs(area) / jnp.where(tall > 0, tall, 1)
        # A face that is nearly flat on the screen has rows as wide as the face.
        widest = jnp.where(tall > 1e-3, jnp.minimum(widest, right - left), right - left)
        outside = (jnp.ceil(left - _SLACK) > width - 1) | (jnp.floor(right + _SLACK) < 0)
        empty = jnp.ceil(left - _SLACK) > jnp.floor(right + _SLACK)
        columns = jnp.clip(jnp.floor(widest + 2 * _SLACK) + 1, 0, width)
        rows = jnp.clip(jnp.floor(bottom + _SLACK), -1, height - 1) - _first_row(top, height) + 1
        drawn &= (face >= base) & ~outside & ~empty & (rows > 0)
        across = jnp.ceil(columns / _RUN)
        number = jnp.where(drawn, rows * across, 0).astype(jnp.int32)
        nth, upto = _math.running_sum(number > 0), jnp.cumsum(number, dtype=jnp.int32)
        place = jnp.where(number > 0, count + nth - 1, num_faces + chunk)
        found = total + upto - number, face, across.astype(jnp.int32)
        lists = [all_.at[place].set(new, mode="drop") for all_, new in zip(lists, found, strict=True)]
        return base + group, count + nth[-1], total + upto[-1], lists

    zero = jnp.int32(0)
    none = jnp.full(num_faces + chunk, jnp.iinfo(jnp.int32).max, jnp.int32)
    start = zero, zero, zero, [none] * 3
    _, _, total, (first_run, listed, in_a_row) = jax.lax.while_loop(lambda state: state[0] < real, collect, start)

    face_bits = max((num_faces - 1).bit_length(), 1)
    levels = 2.0 ** min(32 - face_bits, 23) - 2
    scale = levels / jnp.where(last > nearest, last - nearest, 1)

    def body(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        base, current, image = state
        run = base + jnp.arange(chunk, dtype=jnp.int32)
        # Every listed face has a run, so at most `chunk` faces begin in this chunk: the next ones of the list.
        begins = jax.lax.dynamic_slice(first_run, (current + 1,), (chunk,)) - base
        of = current + _math.running_sum(jnp.zeros(chunk, jnp.int32).at[begins].add(1, mode="drop"))
        following = of[-1] + (first_run[of[-1] + 1] == base + chunk)
        begin, face, across = first_run[of], listed[of], in_a_row[of]
        a, b, c = corners_of(face)
        (x0, y0, o0), (x1, y1, o1), (x2, y2, o2) = a, b, c
        area = _cross(a, b, c)
        safe_area = jnp.where(area == 0, 1, area)
        slope_x = ((o1 - o0) * (y2 - y0) - (o2 - o0) * (y1 - y0)) / safe_area
        slope_y = ((o2 - o0) * (x1 - x0) - (o1 - o0) * (x2 - x0)) / safe_area
        top, bottom = _lowest(y0, y1, y2), _highest(y0, y1, y2)
        line = jnp.floor((run - begin + 0.5) / across)  # exact, for whole numbers below 2^22
        row = _first_row(top, height) + line
        # A row runs from the face's left edges to its right edges, and not beyond its corners. A face within one row's
        # slack covers that row from end to end.
        flat = bottom - top <= 1e-3
        at = jnp.clip(row, top, bottom)
        starts, stops = [], []
        for (px, py, _), (qx, qy, _) in ((a, b), (b, c), (c, a)):
            rise = qy - py
            crossing = px + (at - py) * ((qx - px) / jnp.where(rise == 0, 1, rise))
            starts.append(jnp.where(rise * area < 0, crossing, -jnp.inf))
            stops.append(jnp.where(rise * area > 0, crossing, jnp.inf))
        start = jnp.maximum(_lowest(x0, x1, x2), jnp.where(flat, -jnp.inf, _highest(*starts)))
        stop = jnp.minimum(_highest(x0, x1, x2), jnp.where(flat, jnp.inf, _lowest(*stops)))
        column = jnp.maximum(jnp.ceil(start - _SLACK), 0) + _RUN * (run - begin - line * across)
        length = jnp.clip(jnp.minimum(jnp.floor(stop + _SLACK), width - 1) - column + 1, 0, _RUN)
        length = jnp.where(run < total, length, 0).astype(jnp.int32)
        value = o0 + slope_x * (column - x0) + slope_y * (row - y0)
        least, most = _lowest(o0, o1, o2), _highest(o0, o1, o2)
        pixel = row.astype(jnp.int32) * width + column.astype(jnp.int32)
        if within is not None:
            pixel += jnp.where(least < within, 0, height * width)

        def step(along: Int[Array, ""], image: Array) -> Array:
            level = jnp.clip((jnp.clip(value + slope_x * along, least, most) - nearest) * scale, 0, levels)
            key = (level.astype(jnp.uint32) << face_bits) | face.astype(jnp.uint32)
            return image.at[jnp.where(along < length, pixel + along, pixels)].min(key, mode="drop")

        # The same number of steps for every chunk, because under `vmap` a loop of variable length copies the image.
        return base + chunk, following, jax.lax.fori_loop(0, _RUN, step, image)

    blank = jnp.full(pixels, _NOTHING)
    _, _, image = jax.lax.while_loop(lambda state: state[0] < total, body, (zero, zero, blank))
    if within is not None:
        near, far = image.reshape(2, height * width)
        image = jnp.stack([near, jnp.minimum(near, far)])
    winner = (image & jnp.uint32(2**face_bits - 1)).astype(jnp.int32)
    return jnp.where(image == _NOTHING, -1, winner).reshape(*layers, *shape)


def barycentrics(
    corners: Sequence[tuple[Float[Array, "*n"], Float[Array, "*n"]]],
    column: Float[Array, "*n"],
    row: Float[Array, "*n"],
) -> tuple[Float[Array, "*n"], Float[Array, "*n"], Float[Array, "*n"]]:
    """Weights of a face's corners at a point on the screen, affine on the screen.

    Args:
        corners: the three corners, (column, row) in pixels.
        column: of the point, pixels.
        row: of the point, pixels.

    Returns:
        Weights that sum to 1, none below 0 even where rounding puts a point outside its face. A face without area has
        (1, 0, 0).
    """
    # Relative to the point, because with absolute pixels float32 errs by per cents on slivers.
    a, b, c = ((x - column, y - row) for x, y in corners)
    area = _cross(a, b, c)
    ok = area != 0
    area = jnp.where(ok, area, 1)
    first = jnp.clip((b[0] * c[1] - c[0] * b[1]) / area, 0, 1)
    second = jnp.clip((c[0] * a[1] - a[0] * c[1]) / area, 0, 1 - first)
    return jnp.where(ok, first, 1), jnp.where(ok, second, 0), jnp.where(ok, 1 - first - second, 0)


def pixel_centres(shape: tuple[int, int]) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Columns and rows of an image's pixels."""
    row, column = jnp.meshgrid(*(jnp.arange(n, dtype=jnp.float32) for n in shape), indexing="ij")
    return column, row


def _cross(a: tuple[Array, ...], b: tuple[Array, ...], c: tuple[Array, ...]) -> Array:
    return (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])


def _first_row(top: Array, height: int) -> Array:
    return jnp.clip(jnp.ceil(top - _SLACK), 0, height)


def _lowest(a: Array, b: Array, c: Array) -> Array:
    return jnp.minimum(jnp.minimum(a, b), c)


def _highest(a: Array, b: Array, c: Array) -> Array:
    return jnp.maximum(jnp.maximum(a, b), c)
