"""The geometry of a MuJoCo model as bodies that can be drawn, in NumPy on the host.

All visible geoms of a MuJoCo body become one `Body` in the frame of that body (`xpos`, `xquat`). MuJoCo moves and turns
a mesh so that its frame is its inertial frame. The compiled pose of its geom undoes this.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax
import mujoco
import numpy as np
from jaxtyping import Float, Int
from PIL import Image
from scipy.spatial.transform import Rotation

from sts_jax.objects.assembly import corner_normals
from sts_jax.objects.body import FACE_CLASSES, TEXTURE_CLASSES, Body, pad, size_class
from sts_jax.objects.colors import linear
from sts_jax.objects.materials import combined

SAGITTA = 2e-5  # m, a round geom is drawn as a polyhedron inside it, which is at most about this far from it
SIDES = (16, 72)  # fewest and most sides of the polygon that is drawn for a circle
UNPAINTED = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's default colour. A geom of this colour has that of its material
_TYPE = mujoco.mjtGeom
# The images of a cube map, from above to below, are those of the sides +x, -x, +y, -y, +z and -z. Rows: the coordinates
# that are to the right and downwards in the image, and their signs (OpenGL).
_CUBE_AXES = np.array([[2, 1], [2, 1], [0, 2], [0, 2], [0, 1], [0, 1]])
_CUBE_SIGNS = np.array([[-1, -1], [1, -1], [1, 1], [1, -1], [1, -1], [-1, -1]])


class Surface(NamedTuple):
    """Triangles of a geom in its own frame."""

    vertices: Float[np.ndarray, "v 3"]  # m
    faces: Int[np.ndarray, "f 3"]  # counter-clockwise from outside
    uv: Float[np.ndarray, "f 3 2"] | None = None  # coordinates of a 2D texture, None for a projection along z


def visible(model: mujoco.MjModel, groups: Iterable[int] | None) -> Int[np.ndarray, "k"]:
    """Ids of the geoms that are drawn.

    With `groups`, all geoms of these groups. Else the visual geoms of each body, which collide with nothing, and the
    geoms of this body in the same groups, or all its geoms if none is visual. Geoms with opacity 0 are never drawn.
    """
    opaque = np.array([rgba(model, geom)[3] > 0 for geom in range(model.ngeom)], bool)
    if groups is not None:
        return np.flatnonzero(opaque & np.isin(model.geom_group, list(groups)))
    visual = opaque & (model.geom_contype == 0) & (model.geom_conaffinity == 0)
    has_visual = np.isin(model.geom_bodyid, model.geom_bodyid[visual])
    place = model.geom_bodyid * (1 + model.geom_group.max(initial=0)) + model.geom_group
    return np.flatnonzero(opaque & (np.isin(place, place[visual]) | ~has_visual))


def body_of(model: mujoco.MjModel, geoms: Iterable[int] | Int[np.ndarray, "k"]) -> Body:
    """Geoms of one MuJoCo body as a `Body` in that body's frame, padded to a size class. It has no mass and no hull."""
    geoms = [int(geom) for geom in geoms]
    surfaces = [surface(model, geom) for geom in geoms]
    size = [max(len(one.faces), len(one.vertices)) for one in surfaces]
    if sum(size) > FACE_CLASSES[-1]:
        raise ValueError(
            f"body {model.body(model.geom_bodyid[geoms[0]]).name!r} has {sum(size):,} faces, most of them in geom "
            f"{geom_name(model, geoms[int(np.argmax(size))])}, but at most {FACE_CLASSES[-1]:,} can be drawn: decimate "
            "the mesh, leave the body out with `hide`, or give it a simpler shape with `bodies`"
        )
    turns = [Rotation.from_quat(model.geom_quat[geom], scalar_first=True) for geom in geoms]
    vertices: list[np.ndarray] = []
    faces, normals, colors = [], [], []
    for geom, turn, one in zip(geoms, turns, surfaces, strict=True):
        faces.append(one.faces + sum(len(part) for part in vertices))
        vertices.append(turn.apply(one.vertices) + model.geom_pos[geom])
        normals.append(_normals(vertices[-1], one.faces))
        colors.append(np.broadcast_to(linear(rgba(model, geom)[:3]), (len(one.faces), 3, 3)))
    uv, texture = _texture(model, geoms, surfaces)
    count, single = size_class(sum(size), FACE_CLASSES), np.float32
    none = single(0)
    arrays = dict(
        vertices=single(pad(np.concatenate(vertices), count, vertices[-1][-1])),
        faces=pad(np.concatenate(faces), count, 0.0).astype(np.int32),
        normals=single(pad(np.concatenate(normals), count, np.array([0.0, 0.0, 1.0]))),
        colors=single(pad(np.concatenate(colors), count, 0.0)),
        uv=single(pad(uv, count, 0.0)),
        texture=single(texture),
        two_sided=np.bool_(False),
        hulls=np.zeros((1, 1, 3), single),
        shell_mass=none,
        shell_com=np.zeros(3, single),
        shell_inertia=np.zeros((3, 3), single),
        interior=np.zeros((1, 3, 3), single),
        contents_density=none,
        category=np.int32(-1),
        origin=np.zeros(3, single),
    )
    return Body(**jax.device_put(arrays))


def surface(model: mujoco.MjModel, geom: int) -> Surface:
    """Triangles of a geom of any type."""
    kind, size, data = _TYPE(model.geom_type[geom]), model.geom_size[geom], int(model.geom_dataid[geom])
    if kind == _TYPE.mjGEOM_PLANE:
        if not size[:2].all():
            raise ValueError(
                f"geom {geom_name(model, geom)} is a plane without size, which cannot be drawn: give it a size, "
                'such as size="1 1 .1", or leave it out with `hide`'
            )
        corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
        return _flat_sides(corners, np.array([[0, 1, 2, 3]]), size * [1, 1, 0])
    if kind == _TYPE.mjGEOM_BOX:
        corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(8, 3)
        sides = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
        return _flat_sides(corners, sides, size)
    if kind in (_TYPE.mjGEOM_MESH, _TYPE.mjGEOM_SDF):
        return _mesh(model, geom, data)
    if kind == _TYPE.mjGEOM_HFIELD:
        return _height_field(model, data)
    if kind == _TYPE.mjGEOM_CYLINDER:
        turned = _revolved(np.array([[0.0, -1], [1, -1], [1, 1], [0, 1]]), np.array([1.0, 0, 0, 0]), _sides(size[0]))
        caps = np.ptp(turned.vertices[turned.faces][..., 2], axis=1) == 0
        assert turned.uv is not None
        turned.uv[caps] = 0.5 + 0.5 * turned.vertices[turned.faces[caps]][..., :2]
        return turned._replace(vertices=turned.vertices * size[[0, 0, 1]])
    around = _sides(size.max() if kind == _TYPE.mjGEOM_ELLIPSOID else size[0])
    angle = np.linspace(-np.pi / 2, np.pi / 2, around // 2 + 1)
    profile, v = np.stack([np.cos(angle), np.sin(angle)], axis=1), np.linspace(1, 0, len(angle))
    profile[[0, -1], 0] = 0
    if kind == _TYPE.mjGEOM_CAPSULE:
        quarter, straight = around // 4, size[1] / size[0]
        move = np.repeat([-straight, straight], quarter + 1)
        profile = np.concatenate([profile[: quarter + 1], profile[quarter:]]) + np.stack([0 * move, move], axis=1)
        v = np.tile(np.linspace(1, 0, quarter + 1), 2)
        v[quarter + 1] = 0
    turned = _revolved(profile, v, around)
    return turned._replace(vertices=turned.vertices * (size if kind == _TYPE.mjGEOM_ELLIPSOID else size[0]))


def rgba(model: mujoco.MjModel, geom: int) -> Float[np.ndarray, "4"]:
    """Colour of a geom, or of its material if the geom has MuJoCo's default colour."""
    own, material = model.geom_rgba[geom], model.geom_matid[geom]
    return model.mat_rgba[material] if material >= 0 and np.allclose(own, UNPAINTED) else own


def geom_name(model: mujoco.MjModel, geom: int) -> str:
    """A geom's name, or its number and body, for messages."""
    name, owner = model.geom(geom).name, model.body(model.geom_bodyid[geom]).name
    return repr(name) if name else f"{geom} (without name, of body {owner!r})"


def _triangles(quads: Int[np.ndarray, "q 4"]) -> Int[np.ndarray, "f 3"]:
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _sides(radius: float) -> int:
    """Number of sides of a polygon within SAGITTA of a circle, a multiple of 4."""
    wanted = np.pi / np.arccos(1 - min(SAGITTA / radius, 0.5))
    return int(np.clip(4 * np.ceil(wanted / 4), *SIDES))


def _flat_sides(
    corners: Float[np.ndarray, "v 3"], sides: Int[np.ndarray, "q 4"], size: Float[np.ndarray, "3"]
) -> Surface:
    """A box of half this size, or some of its sides. On each side, the texture is as large as the side."""
    faces = _triangles(sides)
    place = corners[faces]
    axis = np.argmin(np.ptp(place, axis=1), axis=1)
    across = np.take_along_axis(place, np.array([[1, 2], [0, 2], [0, 1]])[axis][:, None], axis=2)
    return Surface(corners * size, faces, 0.5 + across * [0.5, -0.5])


def _revolved(profile: Float[np.ndarray, "p 2"], v: Float[np.ndarray, "p"], sides: int) -> Surface:
    """Surface of revolution about z of a profile with the columns radius and z, from its lowest point to its top.

    The texture coordinate u is the angle, and `v` that of the profile. Where `v` does not decrease, it restarts at 1.
    """
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angle), np.sin(angle), np.ones(sides)], axis=1)
    vertices = (ring * profile[:, None, [0, 0, 1]]).reshape(-1, 3)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(len(profile) - 1), np.arange(sides), indexing="ij"))
    after = (j + 1) % sides
    low, high = i * sides, (i + 1) * sides
    faces = _triangles(np.stack([low + j, low + after, high + after, high + j], axis=1))
    start = np.where(v[i] > v[i + 1], v[i], 1)
    uv = np.stack([np.stack([j, j + 1, j + 1, j]) / sides, np.stack([start, start, v[i + 1], v[i + 1]])], axis=-1)
    uv = np.concatenate([uv[[0, 1, 2]], uv[[0, 2, 3]]], axis=1).swapaxes(0, 1)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    some = area > 1e-9 * area.max()  # else a triangle at a pole with two equal corners
    return Surface(vertices, faces[some], uv[some])


def _mesh(model: mujoco.MjModel, geom: int, data: int) -> Surface:
    first, count = model.mesh_faceadr[data], model.mesh_facenum[data]
    if not count:
        raise ValueError(
            f"geom {geom_name(model, geom)} uses the mesh {model.mesh(data).name!r}, which has no faces: give it "
            "faces, or leave it out with `hide`"
        )
    vertices = model.mesh_vert[model.mesh_vertadr[data] :][: model.mesh_vertnum[data]].astype(np.float64)
    chosen, uv = slice(first, first + count), None
    if model.mesh_texcoordnum[data]:
        own = model.mesh_texcoord[model.mesh_texcoordadr[data] :][: model.mesh_texcoordnum[data]]
        uv = own[model.mesh_facetexcoord[chosen]].astype(np.float64)
    return Surface(vertices, model.mesh_face[chosen], uv)


def _height_field(model: mujoco.MjModel, data: int) -> Surface:
    """The surface of a height field, with side walls and bottom."""
    rows, columns = int(model.hfield_nrow[data]), int(model.hfield_ncol[data])
    half_x, half_y, top, bottom = model.hfield_size[data]
    heights = model.hfield_data[model.hfield_adr[data] :][: rows * columns].reshape(rows, columns) * top
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
    index = np.arange(rows * columns).reshape(rows, columns)
    cells = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1).reshape(-1, 4)
    rim = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    above = np.stack([x, y, heights], axis=-1).reshape(-1, 3)
    below = above[rim] * [1, 1, 0] - [0, 0, bottom]
    lower = len(above) + np.arange(len(rim))
    walls = np.stack([np.roll(rim, -1), rim, lower, np.roll(lower, -1)], axis=1)
    corners = len(above) + np.cumsum([0, columns - 1, rows - 1, columns - 1])
    return Surface(np.concatenate([above, below]), _triangles(np.concatenate([cells, walls, corners[None, ::-1]])))


def _normals(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3 3"]:
    """Normals at the corners, smooth also where vertices are repeated, as at the seams of texture coordinates."""
    places, same = np.unique(vertices, axis=0, return_inverse=True)
    return corner_normals(places, same.reshape(-1)[faces])


def _texture(
    model: mujoco.MjModel, geoms: Sequence[int], surfaces: Sequence[Surface]
) -> tuple[Float[np.ndarray, "f 3 2"], Float[np.ndarray, "t t 3"]]:
    """Texture coordinates of all faces, and the texture that the geoms share."""
    images, uvs = [], []
    for geom, one in zip(geoms, surfaces, strict=True):
        texture = _texture_of(model, geom)
        images.append(None if texture < 0 else _image(model, texture))
        uvs.append(np.zeros((len(one.faces), 3, 2)) if texture < 0 else _coordinates(model, geom, one, texture))
    if len({_texture_of(model, geom) for geom in geoms}) > 1:
        # Cells of one texture do not repeat.
        pairs = [_unrolled(image, uv) for image, uv in zip(images, uvs, strict=True)]
        images, uvs = [image for image, _ in pairs], [uv for _, uv in pairs]
    joined, packed = combined(images, uvs)
    return joined, np.ones((1, 1, 3)) if packed is None else packed


def _texture_of(model: mujoco.MjModel, geom: int) -> int:
    """Id of the texture that gives a geom its colour, or -1."""
    material, role = model.geom_matid[geom], mujoco.mjtTextureRole
    if material < 0:
        return -1
    own = model.mat_texid[material]
    return int(max(own[role.mjTEXROLE_RGB], own[role.mjTEXROLE_RGBA]))


def _image(model: mujoco.MjModel, texture: int) -> np.ndarray:
    """A texture with 8 bits. A cube map is a column of six images."""
    shape = int(model.tex_height[texture]), int(model.tex_width[texture]), int(model.tex_nchannel[texture])
    image = model.tex_data[model.tex_adr[texture] :][: np.prod(shape)].reshape(shape)
    return np.repeat(image[..., :1], 3, axis=-1) if shape[2] < 3 else image[..., :3].copy()


def _coordinates(model: mujoco.MjModel, geom: int, one: Surface, texture: int) -> Float[np.ndarray, "f 3 2"]:
    """Texture coordinates at the corners of a geom's faces, as in MuJoCo's renderer."""
    kind, size, material = _TYPE(model.geom_type[geom]), model.geom_size[geom], model.geom_matid[geom]
    uniform, place = model.mat_texuniform[material], one.vertices[one.faces]
    unit = np.where(size > 0, size, size[0])
    if kind in (_TYPE.mjGEOM_CAPSULE, _TYPE.mjGEOM_CYLINDER):
        unit = size[[0, 0, 1]]
    if model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D:
        repeat = model.mat_texrepeat[material] * (unit[:2] if uniform else 1)
        return place[..., :2] / unit[:2] * repeat * [0.5, -0.5] - 0.5 if one.uv is None else one.uv * repeat
    if kind not in (_TYPE.mjGEOM_MESH, _TYPE.mjGEOM_SDF, _TYPE.mjGEOM_HFIELD) and not uniform:
        place = place / np.where(unit > 0, unit, 1)
    middle = place.mean(axis=1)
    axis = np.abs(middle).argmax(axis=1)
    side = 2 * axis + (middle[np.arange(len(axis)), axis] < 0)
    length = np.abs(np.take_along_axis(place, axis[:, None, None], axis=2))
    across = np.take_along_axis(place, _CUBE_AXES[side][:, None], axis=2) * _CUBE_SIGNS[side][:, None]
    margin = 0.5 / model.tex_width[texture]
    uv = np.clip(across / np.maximum(length, 1e-9) / 2 + 0.5, margin, 1 - margin)
    return np.stack([uv[..., 0], (side[:, None] + uv[..., 1]) / 6], axis=-1)


def _unrolled(image: np.ndarray | None, uv: Float[np.ndarray, "f 3 2"]) -> tuple[np.ndarray | None, np.ndarray]:
    """Repeat an image so that all its texture coordinates lie between 0 and 1."""
    if image is None:
        return None, uv
    low = np.floor(uv.min(axis=(0, 1)) + 1e-6)
    times = np.maximum(np.ceil(uv.max(axis=(0, 1)) - 1e-6) - low, 1).astype(int)
    height, width = (max(min(n, TEXTURE_CLASSES[-1] // t), 1) for n, t in zip(image.shape, times[::-1], strict=False))
    small = np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BOX))
    return np.tile(small, (times[1], times[0], 1)), (uv - low) / times
