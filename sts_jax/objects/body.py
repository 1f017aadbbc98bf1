"""One rigid object as arrays: what is seen, what collides, what it weighs."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, ScalarLike

# Padding classes. Two bodies of one class have leaves of equal shape, so whatever is compiled for one serves the
# other. A padding face is (0, 0, 0): it has no area and covers no pixel. A padding vertex (of `vertices`, which are
# as many as the faces, or of `hull`) repeats the last one, so that extents need no mask.
FACE_CLASSES = (1024, 4096, 16384, 131072)
HULL_CLASSES = (32, 64)
TEXTURE_CLASSES = (1, 256, 1024)
# Fill levels at which the contents' moments are tabulated: 0, 1/32, ... 1 of the interior's volume.
NUM_FILLS = 33

CATEGORIES = ("bottle", "camera", "webcam", "mouse", "scissors", "fork", "spoon", "watch")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Body:
    """A rigid object in its own mesh frame (m, kg), array leaves only.

    The origin lies inside the convex hull; +z is the object's up axis where it has one. The albedo at a point is
    its texture's value times its interpolated corner colour (as in glTF), in linear light.

    The hidden contents are tabulated so that mass, centre of mass and inertia follow from a fill by one
    interpolation: row k of `contents` holds, for the lowest k / (NUM_FILLS - 1) of the interior's volume along +z,
    `[V, Vx, Vy, Vz, Vxx, Vyy, Vzz, Vxy, Vxz, Vyz]`, the integrals of 1, x, y, z, x^2, ... over the filled part.
    """

    vertices: Float[Array, "*n v 3"]  # m
    faces: Int[Array, "*n f 3"]  # counter-clockwise seen from outside
    normals: Float[Array, "*n f 3 3"]  # unit normal at each corner of each face
    colors: Float[Array, "*n f 3 3"]  # [0, 1], at each corner of each face
    uv: Float[Array, "*n f 3 2"]  # [0, 1], texture coordinates of each corner; v = 0 is the texture's top row
    texture: Float[Array, "*n t t 3"]  # [0, 1]
    two_sided: Bool[Array, "*n"]  # open surfaces are seen from behind too
    hull: Float[Array, "*n h 3"]  # m, vertices of the convex collision hull
    shell_mass: Float[Array, "*n"]  # kg, of the empty object
    shell_com: Float[Array, "*n 3"]  # m
    shell_inertia: Float[Array, "*n 3 3"]  # kg m^2, about the shell's centre of mass, mesh axes
    contents: Float[Array, "*n k 10"]  # m^3, m^4, m^5; see above; zeros for solid things
    contents_density: Float[Array, "*n"]  # kg/m^3; 0 for solid things
    category: Int[Array, "*n"]  # index into CATEGORIES, -1 for a loaded mesh


def stack(bodies: Sequence[Body]) -> Body:
    """Bodies of one class as one `Body` with a leading axis, for `jax.vmap`.

    Args:
        bodies: at least one body; all of the same classes.

    Returns:
        The leaves stacked along a new first axis.

    Raises:
        ValueError: there is no body, or two bodies are of different classes.
    """
    if not bodies:
        raise ValueError("stack needs at least one body, got none")
    shapes = [[jnp.shape(leaf) for leaf in jax.tree.leaves(body)] for body in bodies]
    for index, shape in enumerate(shapes):
        if shape != shapes[0]:
            raise ValueError(
                f"body {index} is of another class than body 0 ({len(bodies[index].faces)} faces, "
                f"{len(bodies[index].hull)} hull vertices, texture {len(bodies[index].texture)}; body 0 has "
                f"{len(bodies[0].faces)}, {len(bodies[0].hull)}, {len(bodies[0].texture)}): stack each class by itself"
            )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *bodies)


def mirror(body: Body) -> Body:
    """The body's mirror image: y becomes -y in the mesh frame, for one body or with leading axes."""
    flip = jnp.array([1.0, -1, 1])
    corners = jnp.array([0, 2, 1])  # so that faces stay counter-clockwise from outside
    # V, Vx, Vy, Vz, Vxx, Vyy, Vzz, Vxy, Vxz, Vyz
    moments = jnp.array([1.0, 1, -1, 1, 1, 1, 1, -1, 1, -1])
    return dataclasses.replace(
        body,
        vertices=body.vertices * flip,
        faces=body.faces[..., corners],
        normals=body.normals[..., corners, :] * flip,
        colors=body.colors[..., corners, :],
        uv=body.uv[..., corners, :],
        hull=body.hull * flip,
        shell_com=body.shell_com * flip,
        shell_inertia=body.shell_inertia * jnp.outer(flip, flip),
        contents=body.contents * moments,
    )


def rigid(
    body: Body, fill: ScalarLike, shell_scale: ScalarLike
) -> tuple[Float[Array, ""], Float[Array, "3"], Float[Array, "3 3"]]:
    """Mass, centre of mass and inertia of a body whose contents fill it to a share of the interior's volume.

    With the shell's mass m_s and second moments J_s = int r r^T dm, and the contents' V, V_r, V_rr at the fill:
    m = s m_s + rho V, m c = s m_s c_s + rho V_r, I = tr(J) 1 - J - m (|c|^2 1 - c c^T), J = s J_s + rho V_rr.
    The table is interpolated linearly between its rows.

    Args:
        body: one body.
        fill: share of the interior's volume, 0 to 1; clipped.
        shell_scale: factor on the shell's mass.

    Returns:
        mass (kg), centre of mass (m, mesh frame), inertia about the centre of mass (kg m^2, mesh axes).
    """
    rows = body.contents.shape[0] - 1
    level = jnp.clip(jnp.asarray(fill, body.contents.dtype), 0, 1) * rows
    low = jnp.clip(jnp.floor(level).astype(jnp.int32), 0, rows - 1)
    share = level - low
    row = body.contents_density * (body.contents[low] * (1 - share) + body.contents[low + 1] * share)

    shell = body.shell_mass * shell_scale
    mass = shell + row[0]
    com = (shell * body.shell_com + row[1:4]) / mass
    xx, yy, zz, xy, xz, yz = row[4:]
    second = jnp.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    # Both parts about the common centre of mass, so that nothing large cancels in float32.
    offset = body.shell_com - com
    drop = jnp.where(row[0] > 0, row[1:4] / jnp.where(row[0] > 0, row[0], 1), com)
    second = second - row[0] * jnp.outer(drop, drop) + row[0] * jnp.outer(drop - com, drop - com)
    eye = jnp.eye(3, dtype=second.dtype)
    inertia = (
        body.shell_inertia * shell_scale
        + shell * (offset @ offset * eye - jnp.outer(offset, offset))
        + jnp.trace(second) * eye
        - second
    )
    return mass, com, inertia
