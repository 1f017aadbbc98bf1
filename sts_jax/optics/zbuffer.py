"""A z-buffer in plain JAX: the nearest face at each pixel, for triangles of any size on the screen.

Every face is cut into rows of pixels, and long rows into runs of a few pixels. An outer loop processes the runs in
chunks. For each chunk, an inner loop draws one pixel of every run per step. The work therefore grows with the number of
covered pixels and not with the product of faces and pixels. Each step is one scatter-min of 32-bit keys, with the
depth in the high bits and the index of the face in the low bits. The choice of the face has no gradient. Values that
are interpolated on the chosen face have gradients.

Pixel coordinates are (column, row), whole numbers at pixel centres, with columns to the right and rows downwards. The
order of a point is smaller for nearer points and affine across a face on the screen: -1 / depth in the view of a
pinhole, and depth in a parallel projection.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, ScalarLike, UInt32

from sts_jax import _cpu_reductions

_SLACK = 1e-4  # pixels by which faces are enlarged, so that no pixel centre on a shared edge is missed
_ROUNDING = 1e-6, 0.25  # the same for vertices far beyond the image: share of the largest coordinate, and at most this
_OUTSIDE = 1e-6  # a point is outside a face if its negative weights sum to more than this
_GROUP = 1024  # number of faces that are cut into runs at a time
_RUN = 8  # largest number of pixels in a run
_NOTHING = np.uint32(0xFFFFFFFF)  # key of a pixel without a face

_Corner = tuple[Array, Array, Array]  # column, row, order


class _Screen(NamedTuple):
    """The triangles to draw."""

    column: Float[Array, "v"]  # columns of the vertices (pixels)
    row: Float[Array, "v"]  # rows of the vertices (pixels)
    order: Float[Array, "v"]  # orders of the vertices
    keep: Bool[Array, "v"]  # True for vertices whose faces can be drawn
    faces: Int[Array, "f 3"]  # vertex indices
    two_sided: Bool[Array, "*f"]  # True if faces, or each face, are also visible from behind
    slack: ScalarLike  # pixels by which faces are enlarged

    def corners(self, chosen: Int[Array, "n"]) -> tuple[_Corner, _Corner, _Corner]:
        a, b, c = ((self.column[k], self.row[k], self.order[k]) for k in self.faces[chosen].T)
        return a, b, c


class _Runs(NamedTuple):
    """State of the loop over groups of faces: the list of faces that have runs. Runs are numbered from 0."""

    next_face: Int[Array, ""]  # first face of the next group
    listed: Int[Array, ""]  # number of listed faces
    total: Int[Array, ""]  # number of runs of the listed faces
    first: Int[Array, "n"]  # first run of each listed face
    face: Int[Array, "n"]  # index of each listed face
    per_row: Int[Array, "n"]  # number of runs in each row of the face


class _Canvas(NamedTuple):
    """State of the loop over chunks of runs: the keys that are drawn so far."""

    next_run: Int[Array, ""]  # first run of the next chunk
    listed: Int[Array, ""]  # place in the list of the face with which the next chunk begins
    image: UInt32[Array, "p"]  # smallest key at each pixel


class _Spans(NamedTuple):
    """The runs of one chunk."""

    pixel: Int[Array, "r"]  # index of the first pixel
    length: Int[Array, "r"]  # number of pixels, at most `_RUN`
    face: Int[Array, "r"]  # index of the face
    value: Float[Array, "r"]  # order at the first pixel
    slope: Float[Array, "r"]  # change of the order per pixel
    least: Float[Array, "r"]  # smallest order of the face's corners
    most: Float[Array, "r"]  # largest order of the face's corners


def rasterise(
    points: Float[Array, "v 2"],
    order: Float[Array, "v"],
    faces: Int[Array, "f 3"],
    keep: Bool[Array, "v"],
    two_sided: Bool[Array, "*f"],
    shape: tuple[int, int],
    *,
    within: ScalarLike | None = None,
    distant: bool = False,
    chunk: int = 1024,
) -> Int[Array, "*layers h w"]:
    """Find the nearest face at every pixel centre.

    Args:
        points: Columns and rows of the vertices on the screen (pixels).
        order: Order of each vertex.
        faces: Vertex indices, counter-clockwise as seen from outside the object in a right-handed frame. Padding faces,
            with three equal corners, cost almost nothing.
        keep: Mask of the vertices. A face is drawn only if the mask is True for all its corners.
        two_sided: If True, faces are also visible from behind. One flag, or one for each face.
        shape: Height and width of the image (pixels).
        within: Limit in units of `order`, or None. A face is near if one of its corners has a smaller order.
        distant: If True, vertices may lie so far beyond the image that rounding of their coordinates would leave cracks
            between faces. Faces are then enlarged by this rounding.
        chunk: Number of runs that are drawn at a time.

    Returns:
        Index of the nearest face at each pixel, -1 where no face is visible. With `within`, the shape is (2, h, w): the
        image of only the near faces, then the image of all faces.
    """
    points, order, within = jax.lax.stop_gradient((points, order, within))
    slack: ScalarLike = _SLACK
    if distant:
        most = _cpu_reductions.maximum(jnp.where(keep, jnp.max(jnp.abs(points), axis=1), 0))
        slack = jnp.clip(_ROUNDING[0] * most, _SLACK, _ROUNDING[1])
    screen = _Screen(points[:, 0], points[:, 1], order, keep, faces, two_sided, slack)
    image = _draw(screen, _list_runs(screen, shape, chunk), shape, within, chunk)
    if within is not None:
        near, far = image.reshape(2, math.prod(shape))
        image = jnp.stack([near, jnp.minimum(near, far)])
    winner = (image & jnp.uint32(2 ** _face_bits(faces) - 1)).astype(jnp.int32)
    layers = () if within is None else (2,)
    return jnp.where(image == _NOTHING, -1, winner).reshape(*layers, *shape)


def _face_bits(faces: Int[Array, "f 3"]) -> int:
    """Number of bits of a key that store the index of a face."""
    return max((faces.shape[0] - 1).bit_length(), 1)


def _list_runs(screen: _Screen, shape: tuple[int, int], chunk: int) -> _Runs:
    """List all faces that have runs, one group of faces at a time."""
    faces = screen.faces
    num_faces = faces.shape[0]
    group = min(_GROUP, num_faces)
    different = (faces[:, 0] != faces[:, 1]) | (faces[:, 0] != faces[:, 2])
    real = _cpu_reductions.maximum(jnp.where(different, jnp.arange(1, num_faces + 1, dtype=jnp.int32), 0))

    def append(runs: _Runs) -> _Runs:
        face = jnp.minimum(runs.next_face, num_faces - group) + jnp.arange(group, dtype=jnp.int32)
        per_row, number = _count_runs(screen, face, runs.next_face, shape)
        nth, upto = _cpu_reductions.cumsum(number > 0), jnp.cumsum(number, dtype=jnp.int32)
        place = jnp.where(number > 0, runs.listed + nth - 1, num_faces + chunk)
        return _Runs(
            runs.next_face + group,
            runs.listed + nth[-1],
            runs.total + upto[-1],
            runs.first.at[place].set(runs.total + upto - number, mode="drop"),
            runs.face.at[place].set(face, mode="drop"),
            runs.per_row.at[place].set(per_row, mode="drop"),
        )

    zero = jnp.int32(0)
    none = jnp.full(num_faces + chunk, jnp.iinfo(jnp.int32).max, jnp.int32)
    return jax.lax.while_loop(
        lambda runs: runs.next_face < real, append, _Runs(zero, zero, zero, first=none, face=none, per_row=none)
    )


def _count_runs(
    screen: _Screen, face: Int[Array, "n"], first_face: Int[Array, ""], shape: tuple[int, int]
) -> tuple[Int[Array, "n"], Int[Array, "n"]]:
    """Count the runs per row and the runs of each face. Faces that are not drawn have 0 runs.

    Faces before `first_face` are part of an earlier group and are not drawn again.
    """
    height, width = shape
    slack = screen.slack
    two_sided = screen.two_sided if screen.two_sided.ndim == 0 else screen.two_sided[face]
    a, b, c = screen.corners(face)
    area = _cross(a, b, c)
    # Seen along +z with x right and y down, a face towards the camera is counter-clockwise: negative area.
    drawn = jnp.where(two_sided, area != 0, area < 0) & jnp.all(screen.keep[screen.faces[face]], axis=1)
    left, right = _lowest(a[0], b[0], c[0]), _highest(a[0], b[0], c[0])
    top, bottom = _lowest(a[1], b[1], c[1]), _highest(a[1], b[1], c[1])
    tall = bottom - top
    widest = jnp.abs(area) / jnp.where(tall > 0, tall, 1)
    # The rows of a face that is nearly a horizontal line on the screen are as wide as the face.
    widest = jnp.where(tall > 1e-3, jnp.minimum(widest, right - left), right - left)
    outside = (jnp.ceil(left - slack) > width - 1) | (jnp.floor(right + slack) < 0)
    empty = jnp.ceil(left - slack) > jnp.floor(right + slack)
    columns = jnp.clip(jnp.floor(widest + 2 * slack) + 1, 0, width)
    rows = jnp.clip(jnp.floor(bottom + slack), -1, height - 1) - _first_row(top, height, slack) + 1
    drawn &= (face >= first_face) & ~outside & ~empty & (rows > 0)
    per_row = jnp.ceil(columns / _RUN)
    number = jnp.where(drawn, rows * per_row, 0).astype(jnp.int32)
    return per_row.astype(jnp.int32), number


def _draw(
    screen: _Screen, runs: _Runs, shape: tuple[int, int], within: ScalarLike | None, chunk: int
) -> UInt32[Array, "p"]:
    """Draw the smallest key at each pixel. With `within`, the near faces and the other faces have separate images."""
    pixels = math.prod(shape) * (1 if within is None else 2)
    nearest = _cpu_reductions.minimum(jnp.where(screen.keep, screen.order, jnp.inf))
    last = _cpu_reductions.maximum(jnp.where(screen.keep, screen.order, -jnp.inf))
    face_bits = _face_bits(screen.faces)
    levels = 2.0 ** min(32 - face_bits, 23) - 2
    scale = levels / jnp.where(last > nearest, last - nearest, 1)

    def draw_chunk(canvas: _Canvas) -> _Canvas:
        spans, listed = _spans(screen, runs, canvas, shape, within, chunk)

        def step(along: Int[Array, ""], image: Array) -> Array:
            value = jnp.clip(spans.value + spans.slope * along, spans.least, spans.most)
            level = jnp.clip((value - nearest) * scale, 0, levels)
            key = (level.astype(jnp.uint32) << face_bits) | spans.face.astype(jnp.uint32)
            return image.at[jnp.where(along < spans.length, spans.pixel + along, pixels)].min(key, mode="drop")

        # Every chunk has the same number of steps, because under `vmap` a loop of variable length copies the image.
        return _Canvas(canvas.next_run + chunk, listed, jax.lax.fori_loop(0, _RUN, step, canvas.image))

    blank = _Canvas(jnp.int32(0), jnp.int32(0), jnp.full(pixels, _NOTHING))
    return jax.lax.while_loop(lambda canvas: canvas.next_run < runs.total, draw_chunk, blank).image


def _spans(
    screen: _Screen, runs: _Runs, canvas: _Canvas, shape: tuple[int, int], within: ScalarLike | None, chunk: int
) -> tuple[_Spans, Int[Array, ""]]:
    """Return the runs of the next chunk, and the place in the list of the face with which the following one begins."""
    height, width = shape
    run = canvas.next_run + jnp.arange(chunk, dtype=jnp.int32)
    # Every listed face has a run, so at most `chunk` faces begin in this chunk: the next ones of the list.
    begins = jax.lax.dynamic_slice(runs.first, (canvas.listed + 1,), (chunk,)) - canvas.next_run
    of = canvas.listed + _cpu_reductions.cumsum(jnp.zeros(chunk, jnp.int32).at[begins].add(1, mode="drop"))
    following = of[-1] + (runs.first[of[-1] + 1] == canvas.next_run + chunk)
    begin, face, per_row = runs.first[of], runs.face[of], runs.per_row[of]

    corners = screen.corners(face)
    (x0, y0, o0), (x1, y1, o1), (x2, y2, o2) = corners
    area = _cross(*corners)
    safe_area = jnp.where(area == 0, 1, area)
    slope_x = ((o1 - o0) * (y2 - y0) - (o2 - o0) * (y1 - y0)) / safe_area
    slope_y = ((o2 - o0) * (x1 - x0) - (o1 - o0) * (x2 - x0)) / safe_area
    line = jnp.floor((run - begin + 0.5) / per_row)  # exact, for whole numbers below 2^22
    row = _first_row(_lowest(y0, y1, y2), height, screen.slack) + line
    start, stop = _row_ends(corners, area, row)
    column = jnp.maximum(jnp.ceil(start - screen.slack), 0) + _RUN * (run - begin - line * per_row)
    length = jnp.clip(jnp.minimum(jnp.floor(stop + screen.slack), width - 1) - column + 1, 0, _RUN)
    length = jnp.where(run < runs.total, length, 0).astype(jnp.int32)
    value = o0 + slope_x * (column - x0) + slope_y * (row - y0)
    least, most = _lowest(o0, o1, o2), _highest(o0, o1, o2)
    pixel = row.astype(jnp.int32) * width + column.astype(jnp.int32)
    if within is not None:
        pixel += jnp.where(least < within, 0, height * width)
    return _Spans(pixel, length, face, value, slope_x, least, most), following


def _row_ends(
    corners: tuple[_Corner, _Corner, _Corner], area: Float[Array, "r"], row: Float[Array, "r"]
) -> tuple[Float[Array, "r"], Float[Array, "r"]]:
    """Columns at which a row of a face starts and stops, from its left edges to its right edges.

    A face that is nearly a horizontal line covers its row from its leftmost to its rightmost corner.
    """
    a, b, c = corners
    top, bottom = _lowest(a[1], b[1], c[1]), _highest(a[1], b[1], c[1])
    flat = bottom - top <= 1e-3
    at = jnp.clip(row, top, bottom)
    starts, stops = [], []
    for (px, py, _), (qx, qy, _) in ((a, b), (b, c), (c, a)):
        rise = qy - py
        crossing = px + (at - py) * ((qx - px) / jnp.where(rise == 0, 1, rise))
        starts.append(jnp.where(rise * area < 0, crossing, -jnp.inf))
        stops.append(jnp.where(rise * area > 0, crossing, jnp.inf))
    start = jnp.maximum(_lowest(a[0], b[0], c[0]), jnp.where(flat, -jnp.inf, _highest(*starts)))
    stop = jnp.minimum(_highest(a[0], b[0], c[0]), jnp.where(flat, jnp.inf, _lowest(*stops)))
    return start, stop


def barycentrics(
    corners: Sequence[tuple[Float[Array, "*n"], Float[Array, "*n"]]],
    column: Float[Array, "*n"],
    row: Float[Array, "*n"],
) -> tuple[Float[Array, "*n"], Float[Array, "*n"], Float[Array, "*n"]]:
    """Barycentric weights of points on the screen, each in a face of its own.

    Args:
        corners: Columns and rows of the three corners of each point's face, as three pairs (pixels).
        column: Columns of the points (pixels).
        row: Rows of the points (pixels).

    Returns:
        Three weights >= 0 that sum to 1, even if rounding puts a point outside its face. A face without area has the
        weights (1, 0, 0).
    """
    # Relative to the point, because on thin faces absolute coordinates cause errors of several per cent in float32.
    a, b, c = ((x - column, y - row) for x, y in corners)
    area = _cross(a, b, c)
    ok = area != 0
    area = jnp.where(ok, area, 1)
    first, second = (b[0] * c[1] - c[0] * b[1]) / area, (c[0] * a[1] - a[0] * c[1]) / area
    total = jnp.maximum(first, 0) + jnp.maximum(second, 0) + jnp.maximum(1 - first - second, 0)
    # The weights of a point outside are scaled. On a sliver, a cut at 1 would change the others too much.
    scale = jnp.where(total > 1 + _OUTSIDE, 1 / total, 1)
    first = jnp.clip(scale * first, 0, 1)
    second = jnp.clip(scale * second, 0, 1 - first)
    return jnp.where(ok, first, 1), jnp.where(ok, second, 0), jnp.where(ok, 1 - first - second, 0)


def pixel_centres(shape: tuple[int, ...]) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Column and row of each pixel of an image with the shape (height, width)."""
    row, column = jnp.meshgrid(*(jnp.arange(n, dtype=jnp.float32) for n in shape), indexing="ij")
    return column, row


def _cross(a: tuple[Array, ...], b: tuple[Array, ...], c: tuple[Array, ...]) -> Array:
    return (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])


def _first_row(top: Array, height: int, slack: ScalarLike) -> Array:
    return jnp.clip(jnp.ceil(top - slack), 0, height)


def _lowest(a: Array, b: Array, c: Array) -> Array:
    return jnp.minimum(jnp.minimum(a, b), c)


def _highest(a: Array, b: Array, c: Array) -> Array:
    return jnp.maximum(jnp.maximum(a, b), c)
