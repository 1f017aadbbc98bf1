"""Several bodies in one image: each has its own equilibrium on the gel, and the nearest surface of all is drawn.

`group` puts the faces of all bodies in one list, in which unused faces are left out. Faces that are large compared with
the sensor, such as those of a floor, are clipped at the depth `Camera.near`, because a face with a corner nearer to the
pinhole is not drawn. What is nearer than this depth neither presses nor hides the sky.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sts_jax import geometry, optics, tactile
from sts_jax.objects.body import Body, is_traced
from sts_jax.rendering.drawing import Surface, images_of
from sts_jax.rendering.equilibrium import Resting, moved, safe, sheared, underside
from sts_jax.rendering.loop import looped
from sts_jax.sensor import Sensor

LONGEST = 0.01  # m, default of `group`
_MARGIN = 1e-4  # clipped faces begin at the depth `near (1 + _MARGIN)`, so that rounding puts no corner before it


class _Attributes(NamedTuple):
    """Values at the corners of faces, as in `Body`."""

    normals: Float[Array, "s 3 3"]
    colors: Float[Array, "s 3 3"]
    uv: Float[Array, "s 3 2"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Group:
    """Bodies in one list of vertices and one of faces.

    The list of vertices continues with four vertices for each large face, the corners of its clipped part. The list of
    faces begins with two faces for each large face. The numbers of faces, vertices and texels are padded to powers of
    two, so that similar groups share compiled programs.
    """

    vertices: Float[Array, "v 3"]  # each in its body's mesh frame (m)
    vertex_owner: Int[Array, "w"]  # body of each vertex
    faces: Int[Array, "f 3"]  # vertex indices. The last face is always padding
    owner: Int[Array, "f"]  # body of each face
    two_sided: Bool[Array, "f"]  # True if the face is also visible from behind
    surface: _Attributes  # of the faces that are not clipped
    large: tuple[Int[Array, "l 3"], _Attributes] | None  # faces that are clipped, None if there are none
    texels: optics.Texels
    of_body: Int[Array, "n m"]  # indices of each body's faces, filled up with the last face


class Drawn(NamedTuple):
    """Images of several bodies, with the fields of `Frame`."""

    visual: Float[Array, "h w 3"]
    tactile: Float[Array, "h w 3"]
    depth: Float[Array, "h w"]
    segmentation: Bool[Array, "h w"]
    pose: Float[Array, "n 7"]
    balanced: Bool[Array, "n"]
    pressure: Float[Array, "r c"]
    window: Float[Array, "4"]
    body: Int[Array, "h w"]
    shear: Float[Array, "r c 2"] | None


class _Placed(NamedTuple):
    """Vertices in the sensor frame."""

    points: Float[Array, "w 3"]  # m
    shares: Float[Array, "l 4 3"] | None  # weights of a large face's corners in those of its clipped part


def group(bodies: Sequence[Body], longest: float = LONGEST) -> Group:
    """Put the faces of bodies of any size classes and textures in one list, for `draw_group`.

    Args:
        bodies: Traced bodies are possible. Their padding faces are kept, and their faces are not clipped.
        longest: Faces with an edge longer than this are clipped at `Camera.near` (m).
    """
    parts = [_Part.of(body, longest) for body in bodies]
    traced = is_traced(list(bodies))
    xp: Any = jnp if traced else np

    def joined(values: Sequence[Any], length: int, fill: Any = 0) -> Any:
        """All rows of several arrays, filled up to a length."""
        row = np.broadcast_to(np.asarray(fill, values[0].dtype), values[0].shape[1:])
        return xp.concatenate([*values, np.broadcast_to(row, (length - sum(map(len, values)), *row.shape))])

    def attributes(of_parts: Sequence[np.ndarray], length: int) -> list[Any]:
        """Normals, colours and texture coordinates of the chosen faces of each body."""
        return [
            joined([xp.asarray(getattr(b, name))[k] for b, k in zip(bodies, of_parts, strict=True)], length, fill)
            for name, fill in (("normals", np.array([0.0, 0, 1])), ("colors", 0.0), ("uv", 0.0))
        ]

    counts = np.array([[len(part.vertices), len(part.small), len(part.large)] for part in parts])
    totals = counts.sum(axis=0).tolist()
    starts = np.cumsum(counts, axis=0) - counts
    num_vertices, num_small, num_large = _power(totals[0]), _power(totals[1] + 1), _power(totals[2])
    shifted = [xp.asarray(part.faces) + start for part, start in zip(parts, starts[:, 0], strict=True)]
    small, large = ([part.small for part in parts], [part.large for part in parts])
    small_faces, large_faces = (
        joined([faces[k] for faces, k in zip(shifted, chosen, strict=True)], length)
        for chosen, length in ((small, num_small), (large, num_large))
    )
    # Of a large face, the clipped part has the corners 0, 1, 2 and 3, and the faces (0, 1, 2) and (0, 2, 3).
    clipped = num_vertices + 4 * np.arange(num_large)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    faces = xp.concatenate([clipped.reshape(-1, 3), small_faces])
    index, last = np.arange(len(bodies)), len(bodies) - 1
    of_vertex, of_small, of_large = (
        np.pad(np.repeat(index, n), (0, length - sum(n)), constant_values=last)
        for n, length in zip(counts.T, (num_vertices, num_small, num_large), strict=True)
    )
    owner = np.concatenate([np.repeat(of_large, 2), of_small])
    rows = [
        np.concatenate([2 * b + np.arange(2 * m), 2 * num_large + a + np.arange(n)])
        for (_, a, b), (_, n, m) in zip(starts, counts, strict=True)
    ]
    most = _power(max(map(len, rows)))
    sides = np.array([len(body.texture) for body in bodies])
    texels = len(bodies) if (sides == 1).all() else _power(int((sides**2).sum()))
    fields = {
        "vertices": joined([part.vertices for part in parts], num_vertices),
        "vertex_owner": np.concatenate([of_vertex, np.repeat(of_large, 4)]).astype(np.int32),
        "faces": faces.astype(np.int32),
        "owner": owner.astype(np.int32),
        "two_sided": xp.stack([body.two_sided for body in bodies])[owner],
        "surface": _Attributes(*attributes(small, num_small)),
        "large": (large_faces.astype(np.int32), _Attributes(*attributes(large, num_large))) if num_large else None,
        "texels": optics.Texels(
            joined([xp.asarray(body.texture).reshape(-1, 3) for body in bodies], texels),
            xp.asarray(np.cumsum(sides**2) - sides**2, np.int32),
            xp.asarray(sides, np.int32),
        ),
        "of_body": np.array([np.pad(r, (0, most - len(r)), constant_values=len(owner) - 1) for r in rows], np.int32),
    }
    with contextlib.nullcontext() if traced else jax.ensure_compile_time_eval():
        return Group(**jax.tree.map(jnp.asarray, fields))


class _Part(NamedTuple):
    """Used vertices and faces of one body."""

    vertices: Any
    faces: Any
    small: Int[np.ndarray, "s"]  # indices of the faces that are drawn as they are
    large: Int[np.ndarray, "l"]  # indices of the faces that are clipped

    @classmethod
    def of(cls, body: Body, longest: float) -> "_Part":
        if is_traced(body):
            return cls(body.vertices, body.faces, np.arange(len(body.faces)), np.zeros(0, int))
        vertices, faces = np.asarray(body.vertices), np.asarray(body.faces)
        used = np.flatnonzero((faces != faces[:, :1]).any(axis=1))
        corners = vertices[faces[used]]
        long = (np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2) > longest).any(axis=1)
        return cls(vertices[: faces.max(initial=0) + 1], faces, used[~long], used[long])


def _power(number: int) -> int:
    """Smallest power of two that is at least `number`, or 0."""
    return 1 << (number - 1).bit_length() if number else 0


def draw_group(
    sensor: Sensor,
    group: Group,
    poses: Float[Array, "n 7"],
    wrenches: Float[Array, "n 6"] | None,
    *,
    resolution: tuple[int, int],
    crop: bool = False,
    moving_edges: bool = False,
    sound: Bool[Array, ""] | bool = True,
) -> Drawn:
    """Draw several bodies, without the checks of `sense`. If `sound` is False, the images show the empty sensor."""
    resting, shares = _balance(sensor, jnp.asarray(sound), group, poses, wrenches)
    images = _draw(sensor, group, resting, shares, resolution=resolution, crop=crop, moving_edges=moving_edges)
    return Drawn(
        visual=images.visual,
        tactile=images.tactile,
        depth=images.depth,
        segmentation=images.segmentation,
        pose=resting.shown,
        balanced=resting.balanced,
        pressure=resting.pressure,
        window=images.window,
        body=images.body,
        shear=resting.shear,
    )


def _balanced(
    sensor: Sensor,
    sound: Bool[Array, ""],
    group: Group,
    poses: Float[Array, "n 7"],
    wrenches: Float[Array, "n 6"] | None,
) -> tuple[Resting, Float[Array, "l 4 3"] | None]:
    """Let each body sink and tilt until the gel balances its wrench. See `rendering.equilibrium`."""
    gel, number = sensor.gel, len(poses)
    lowest = sensor.camera.near * (1 + _MARGIN) - sensor.camera.distance
    finite, safe_poses, wrenches = jax.vmap(functools.partial(safe, sound))(poses, wrenches)
    placed = _placed(group, safe_poses, finite, lowest)
    points = placed.points
    own = points[: len(group.vertices), 2], group.vertex_owner[: len(group.vertices)]
    present = finite & (jax.ops.segment_max(*own, number) > 0)
    ahead = (points[:, 2] >= lowest) & present[group.vertex_owner]
    heights = underside(gel, group.faces, group.two_sided, points, ahead)[1]
    if wrenches is None:
        pressing = touching = present
        touching &= jax.ops.segment_min(jnp.where(ahead, points[:, 2], 0), group.vertex_owner, number) < 0
    else:
        pressing = touching = present & (wrenches[:, 2] > 0)
    each = looped(_contact), (None, None, None, None, 0, 0, 0, 0)
    contact, shear = jax.vmap(*each)(
        sensor, group, points, ahead, group.of_body, jnp.arange(number), touching, wrenches
    )
    balanced_poses = jax.vmap(moved)(safe_poses, contact)
    shown_poses = jnp.where(jnp.any(touching), balanced_poses, safe_poses)
    placed = jax.lax.cond(
        jnp.any(touching) | ~jnp.all(present), lambda: _placed(group, shown_poses, present, lowest), lambda: placed
    )
    return (
        Resting(
            points=placed.points,
            pose=balanced_poses,
            shown=jnp.where(finite[:, None], balanced_poses, poses),
            heights=heights,
            present=jnp.any(present),
            pressing=pressing,
            balanced=contact.balanced & finite,
            pressure=jnp.sum(contact.pressure, axis=0),
            shear=None if shear is None else jnp.sum(shear, axis=0),
        ),
        placed.shares,
    )


_balance = jax.jit(looped(_balanced))


def _contact(
    sensor: Sensor,
    group: Group,
    points: Float[Array, "v 3"],
    ahead: Bool[Array, "v"],
    chosen: Int[Array, "m"],
    index: Int[Array, ""],
    touching: Bool[Array, ""],
    wrench: Float[Array, "6"] | None,
) -> tuple[tactile.Equilibrium, Float[Array, "r c 2"] | None]:
    """Equilibrium of one of the bodies, and shear of the skin. Without contact, nothing is computed on a CPU."""
    gel, markers = sensor.gel, sensor.markers

    def press() -> tuple[tactile.Equilibrium, Float[Array, "r c 2"] | None]:
        mine = ahead & (group.vertex_owner == index)
        # All other vertices are put at the body's highest point, so that extents need no mask.
        highest = points[jnp.argmax(jnp.where(mine, points[:, 2], -jnp.inf))]
        here = jnp.where(mine[:, None], points, highest[None, :])
        heights = underside(gel, group.faces[chosen], group.two_sided[chosen], here, mine)[0]
        contact = tactile.indent(gel, heights) if wrench is None else tactile.settle(gel, heights, wrench)
        return contact, sheared(gel, markers, contact.pressure, wrench)

    def leave() -> tuple[tactile.Equilibrium, Float[Array, "r c 2"] | None]:
        nothing = tactile.Equilibrium(jnp.float32(0), jnp.zeros(2), jnp.zeros(gel.cells), jnp.bool_(True))
        return nothing, sheared(gel, markers, nothing.pressure, None)

    return jax.lax.cond(touching, press, leave)


def _placed(
    group: Group, poses: Float[Array, "n 7"], there: Bool[Array, "n"], lowest: Float[Array, ""] | float
) -> _Placed:
    """Vertices in the sensor frame, and the corners of the clipped faces. Bodies that are not there are far below."""
    owner = group.vertex_owner[: len(group.vertices)]
    x, y, z = group.vertices.T
    turn = geometry.quat_to_matrix(poses[:, 3:])
    parts = [turn[owner, k, 0] * x + turn[owner, k, 1] * y + turn[owner, k, 2] * z + poses[owner, k] for k in range(3)]
    points = jnp.stack([jnp.where(there[owner], part, lowest - 1) for part in parts], axis=-1)
    if group.large is None:
        return _Placed(points, None)
    corners = points[group.large[0]]
    shares, cut = _clip(corners[..., 2], lowest)
    clipped = _mixed(shares, corners)
    # Rounding must not put a corner below the plane at which the faces are cut.
    height = jnp.where(cut, lowest, clipped[..., 2])
    clipped = jnp.concatenate([clipped[..., :2], height[..., None]], axis=-1)
    return _Placed(jnp.concatenate([points, clipped.reshape(-1, 3)]), shares)


def _clip(heights: Float[Array, "l 3"], lowest: Float[Array, ""] | float) -> tuple[Array, Bool[Array, "l 4"]]:
    """Clip triangles at a height, of which the part above remains, a triangle or a quadrilateral.

    Returns:
        Weights (l, 4, 3) of the three corners of a triangle in the four corners of its remaining part, and True for
        corners on the cut. A triangle that lies below remains whole.
    """
    above = heights > lowest
    count = jnp.sum(above, axis=1, keepdims=True)
    # Begin at the corner that is alone on its side.
    alone = jnp.argmax(above == (count == 1), axis=1)[:, None]
    height = jnp.take_along_axis(heights, (alone + jnp.arange(3)[None, :]) % 3, axis=1)
    crosses = (count == 1) | (count == 2)
    rise = jnp.where(crosses, height[:, 1:] - height[:, :1], 1)
    share = jnp.where(crosses, (lowest - height[:, :1]) / rise, 0)
    zero, one = jnp.zeros_like(share[:, 0]), jnp.ones_like(share[:, 0])
    first, following, previous = ((jnp.stack(w, -1)) for w in ((one, zero, zero), (zero, one, zero), (zero, zero, one)))
    next_cut = jnp.stack([1 - share[:, 0], share[:, 0], zero], axis=-1)
    last_cut = jnp.stack([1 - share[:, 1], zero, share[:, 1]], axis=-1)
    corner = jnp.stack([first, next_cut, last_cut, last_cut], axis=1)
    quad = jnp.stack([following, previous, last_cut, next_cut], axis=1)
    whole = jnp.stack([first, following, previous, previous], axis=1)
    count = count[..., None]
    weights = jnp.where(count == 1, corner, jnp.where(count == 2, quad, whole))
    back = (jnp.arange(3)[None, :] - alone) % 3
    fourth = jnp.arange(4)[None, :]
    cut = ((count[..., 0] == 1) & (fourth > 0)) | ((count[..., 0] == 2) & (fourth > 1))
    return jnp.take_along_axis(weights, back[:, None, :], axis=2), cut


def _mixed(shares: Float[Array, "l 4 3"], values: Float[Array, "l 3 k"]) -> Float[Array, "l 4 k"]:
    """Values at the corners of clipped faces from those at the corners of the faces."""
    first, second, third = (shares[:, :, k, None] * values[:, None, k] for k in range(3))
    return first + second + third


@functools.partial(jax.jit, static_argnames=("resolution", "crop", "moving_edges"))
def _draw(
    sensor: Sensor,
    group: Group,
    resting: Resting,
    shares: Float[Array, "l 4 3"] | None,
    *,
    resolution: tuple[int, int],
    crop: bool,
    moving_edges: bool,
) -> Any:
    def drawn(sensor: Sensor, group: Group, resting: Resting, shares: Array | None) -> Any:
        surface = _surface(group, shares)
        return images_of(sensor, surface, resting, resolution=resolution, crop=crop, moving_edges=moving_edges)

    return looped(drawn)(sensor, group, resting, shares)


def _surface(group: Group, shares: Float[Array, "l 4 3"] | None) -> Surface:
    """All faces, with the attributes of the clipped ones."""
    surface = group.surface
    if group.large is not None and shares is not None:

        def whole(large: Float[Array, "l 3 k"], small: Float[Array, "s 3 k"]) -> Float[Array, "f 3 k"]:
            corners = _mixed(shares, large)
            pairs = jnp.stack([corners[:, :3], corners[:, jnp.array([0, 2, 3])]], axis=1)
            return jnp.concatenate([pairs.reshape(-1, *small.shape[1:]), small])

        surface = jax.tree.map(whole, group.large[1], surface)
    return Surface(group.faces, *surface, group.texels, group.two_sided, group.owner)
