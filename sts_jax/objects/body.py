"""`Body`: a rigid object as arrays of its visible surface, its collision geometry and its mass properties."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from sts_jax._checked import in_32_bits

# Size classes, to which the arrays of a body are padded. Two bodies of the same classes have arrays of equal shapes, so
# they share compiled programs. A padding face is (0, 0, 0), so it has no area and covers no pixel. Padding vertices and
# padding hulls repeat the last one, so that extents need no mask. There are as many vertices as faces. A padding
# triangle of the interior has all corners at the origin, so it encloses no volume.
FACE_CLASSES = (1024, 4096, 16384, 131072)
PART_CLASSES = (1, 8)
HULL_CLASSES = (32, 64)
TEXTURE_CLASSES = (1, 256, 1024)
PAD = 0.15  # m, side of the paper's pad, and longest side of an object on it
SMALLEST = 0.005  # m, longest side of the smallest object on it. A smaller mesh probably has another unit
LEVEL_STEPS = 30  # bisection steps for the level of the contents, more than float32 can resolve

Direction = Float[Array | np.ndarray, "3"] | tuple[float, float, float]

CATEGORIES = ("bottle", "camera", "webcam", "mouse", "scissors", "fork", "spoon", "watch")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Body:
    """A rigid object in its own mesh frame, as a pytree whose leaves are all arrays.

    The object is a shell, whose interior can be filled with contents such as water (`rigid`). The origin lies inside
    the convex hull. The object usually stands or lies with +z up. The albedo at a point of a face is the texture's
    value times the colour that is interpolated between the corners (as in glTF), in linear light.
    """

    vertices: Float[Array, "*n v 3"]  # Vertices of the visible surface (m).
    faces: Int[Array, "*n f 3"]  # Vertex indices of each face, counter-clockwise seen from outside.
    normals: Float[Array, "*n f 3 3"]  # Unit normal at each corner of each face.
    colors: Float[Array, "*n f 3 3"]  # Colour at each corner of each face, in linear light, [0, 1].
    uv: Float[Array, "*n f 3 2"]  # Texture coordinates at each corner of each face. v is 0 at the texture's top row.
    texture: Float[Array, "*n t t 3"]  # Texture in linear light, [0, 1].
    two_sided: Bool[Array, "*n"]  # True if faces are also visible from behind, as on open surfaces.
    hulls: Float[Array, "*n p h 3"]  # Vertices of the convex parts that collide (m), one part unless decomposed.
    shell_mass: Float[Array, "*n"]  # Mass of the empty object (kg).
    shell_com: Float[Array, "*n 3"]  # Centre of mass of the empty object (m).
    shell_inertia: Float[Array, "*n 3 3"]  # Inertia of the empty object about its centre of mass, mesh axes (kg m^2).
    interior: Float[Array, "*n i 3 3"]  # Triangles of the closed surface around the contents (m), zeros if solid.
    contents_density: Float[Array, "*n"]  # Density of the contents (kg/m^3), 0 for solid objects.
    category: Int[Array, "*n"]  # Index into CATEGORIES, or -1 for an object of no category.
    origin: Float[Array, "*n 3"]  # Where the origin of the mesh file, or of the class's shape, lies (m).

    def check(self) -> None:
        """Raise a ValueError unless this is a single body with finite values and valid indices, not traced by `jit`."""
        if jnp.ndim(self.vertices) != 2:
            shape = jnp.shape(self.vertices)
            raise ValueError(f"vertices has the shape {shape}, but it must be (v, 3): use jax.vmap for stacked bodies")
        for field in dataclasses.fields(self):
            values = np.asarray(getattr(self, field.name))
            if values.dtype.kind == "f" and not np.isfinite(values).all():
                number = int((~np.isfinite(values)).sum())
                problem = f"{field.name} has values that are not finite ({number:,} of {values.size:,})"
                if values.ndim == 0:
                    problem = f"{field.name} is {values}"
                raise ValueError(f"{problem}, but all values must be finite: repair the mesh, or omit the body")
        faces = np.asarray(self.faces)
        if faces.size and not 0 <= faces.min() <= faces.max() < len(self.vertices):
            raise ValueError(
                f"faces has indices from {faces.min()} to {faces.max()}, but with {len(self.vertices)} vertices they "
                f"must be from 0 to {len(self.vertices) - 1}"
            )
        check_category(int(self.category))

    def __repr__(self) -> str:
        arrays = [isinstance(leaf, np.ndarray | np.generic | jax.Array) for leaf in vars(self).values()]
        if not all(arrays) or is_traced(self):
            shapes = (f"{field.name}={_form(getattr(self, field.name))}" for field in dataclasses.fields(self))
            return f"Body({', '.join(shapes)})"
        if np.ndim(self.vertices) != 2:
            return (
                f"Body(bodies of shape {np.shape(self.shell_mass)}, {np.shape(self.faces)[-2]} faces and hulls of "
                f"{' x '.join(map(str, np.shape(self.hulls)[-3:-1]))} points each)"
            )
        category = int(self.category)
        name = CATEGORIES[category] if 0 <= category < len(CATEGORIES) else "mesh"
        size = " x ".join(f"{1e3 * side:.0f}" for side in np.ptp(np.asarray(self.vertices), axis=0))
        faces = int(np.asarray(self.faces).any(axis=1).sum())
        parts = np.unique(np.asarray(self.hulls), axis=0)
        hull = f"hull of {len(np.unique(parts.reshape(-1, 3), axis=0))} points"
        hull += f" in {len(parts)} parts" if len(parts) > 1 else ""
        triangles = np.asarray(self.interior, float)
        volume = np.einsum("fi,fi->", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])) / 6
        full = float(self.contents_density) * volume
        holds = f"holds {full:.3g} kg in {1e6 * volume:.3g} ml" if full > 0 else "solid"
        return f"Body({name}, {size} mm, {float(self.shell_mass):.3g} kg, {holds}, {faces:,} faces, {hull})"


def size_class(count: int, classes: tuple[int, ...]) -> int:
    """Return the smallest of the ascending `classes` that is at least `count`."""
    return next(size for size in classes if count <= size)


def pad(array: np.ndarray, size: int, value: np.ndarray | float) -> np.ndarray:
    """Append rows of `value`, a row or a number, until the array has `size` rows."""
    padding = np.broadcast_to(np.asarray(value, array.dtype), (size - len(array), *array.shape[1:]))
    return np.concatenate([array, padding])


def check_category(category: int) -> None:
    """Raise a ValueError unless a category is an index into `CATEGORIES`, or -1."""
    if not -1 <= category < len(CATEGORIES):
        raise ValueError(
            f"category is {category!r}, but it must be -1 (an object of no category) or an index into "
            f"objects.CATEGORIES (0 to {len(CATEGORIES) - 1}), such as CATEGORIES.index('mouse')"
        )


def is_traced(tree: object) -> bool:
    """Return whether any leaf of a pytree is a JAX tracer."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def _form(leaf: object) -> str:
    return f"{leaf.dtype}{list(leaf.shape)}" if hasattr(leaf, "shape") and hasattr(leaf, "dtype") else repr(leaf)


def stack(bodies: Sequence[Body]) -> Body:
    """Stack bodies of one size class into one `Body` with a leading axis, for `jax.vmap`."""
    if not bodies:
        raise ValueError("bodies is empty, but stack needs at least one body")
    shapes = [[jnp.shape(leaf) for leaf in jax.tree.leaves(body)] for body in bodies]
    for index, shape in enumerate(shapes):
        if shape != shapes[0]:
            raise ValueError(
                f"the arrays of body {index} and body 0 have different shapes ({bodies[index]!r}, {bodies[0]!r}): "
                "stack only bodies of one size class"
            )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *bodies)


@in_32_bits
def mirror(body: Body) -> Body:
    """Mirror a body, or every body in a result of `stack`, by changing the sign of all y coordinates."""
    flip = jnp.array([1.0, -1, 1])
    corners = jnp.array([0, 2, 1])  # so that faces stay counter-clockwise from outside
    return dataclasses.replace(
        body,
        vertices=body.vertices * flip,
        faces=body.faces[..., corners],
        normals=body.normals[..., corners, :] * flip,
        colors=body.colors[..., corners, :],
        uv=body.uv[..., corners, :],
        hulls=body.hulls * flip,
        shell_com=body.shell_com * flip,
        shell_inertia=body.shell_inertia * jnp.outer(flip, flip),
        interior=body.interior[..., corners, :] * flip,
        origin=body.origin * flip,
    )


@in_32_bits
@jax.jit
def rigid(
    body: Body, fill: ScalarLike, shell_scale: ScalarLike, up: Direction = (0.0, 0.0, 1.0)
) -> tuple[Float[Array, ""], Float[Array, "3"], Float[Array, "3 3"]]:
    """Mass, centre of mass and inertia of a body whose contents fill a share of its interior.

    With the shell (m_s, c_s, I_s), s = `shell_scale`, the contents' density rho, volume V, centre c_c and second
    moments C = int (r - c_c) (r - c_c)^T dV:

        m = s m_s + rho V,    m c = s m_s c_s + rho V c_c,    P(d) = (d . d) E - d d^T
        I = s I_s + rho (tr(C) E - C) + s m_s P(c_s - c) + rho V P(c_c - c)

    Args:
        fill: Share of the interior's volume that is filled from below, clipped to [0, 1].
        shell_scale: Factor on the mass and the inertia of the shell.
        up: Unit vector in the mesh frame that pointed upwards while the contents settled.

    Returns:
        Mass (kg), centre of mass in the mesh frame (m), and inertia about the centre of mass along the mesh axes
        (kg m^2).
    """
    volume, middle, second = fill_moments(body.interior, fill, up)
    shell, contents = body.shell_mass * shell_scale, body.contents_density * volume
    mass = shell + contents
    com = (shell * body.shell_com + contents * middle) / mass

    def steiner(mass: Float[Array, ""], offset: Float[Array, "3"]) -> Float[Array, "3 3"]:
        return mass * (offset @ offset * jnp.eye(3) - jnp.outer(offset, offset))

    inertia = body.shell_inertia * shell_scale + body.contents_density * (jnp.trace(second) * jnp.eye(3) - second)
    return mass, com, inertia + steiner(shell, body.shell_com - com) + steiner(contents, middle - com)


class _Liquid(NamedTuple):
    """The interior of a mesh below a level, as f signed tetrahedra that share a corner."""

    volumes: Float[Array, "f"]  # signed volume of each tetrahedron (m^3)
    corners: Float[Array, "f 3 3"]  # vectors from the common corner to the other three corners (m)
    reference: Float[Array, "3"]  # the common corner (m)
    volume: Float[Array, ""]  # volume of the interior below the level (m^3)


class _Bracket(NamedTuple):
    """An interval of heights along `up` (m) that contains the level of the liquid."""

    low: Array
    high: Array


@in_32_bits
def fill_moments(
    interior: Float[Array, "i 3 3"], fill: ScalarLike, up: Direction = (0.0, 0.0, 1.0)
) -> tuple[Float[Array, ""], Float[Array, "3"], Float[Array, "3 3"]]:
    """Volume, centre and second moments of the liquid that fills a share of a closed mesh from below.

    The moments are sums over tetrahedra between a reference point and the triangles, clipped to the half-space below
    the liquid. The reference point lies on the liquid's surface, so that the triangles that would cover this surface
    add nothing. Bisection finds the height of the surface.

    Args:
        interior: Triangles of a closed surface (m), counter-clockwise seen from outside.
        fill: Share of the volume that is filled, clipped to [0, 1].
        up: Upward unit vector, perpendicular to the liquid's surface.

    Returns:
        Volume (m^3), centre (m) and second moments about the centre (m^5). Without liquid, the centre is the middle of
        the mesh's bounding box.
    """
    up = jnp.asarray(up, interior.dtype)
    height = interior @ up
    bottom, top = jnp.min(height), jnp.max(height)
    middle = (jnp.min(interior, axis=(0, 1)) + jnp.max(interior, axis=(0, 1))) / 2

    def below(level: Float[Array, ""]) -> _Liquid:
        """Divide the interior below a height along `up` (m) into tetrahedra that share a corner."""
        # A triangle with one corner below the level adds the piece at that corner. A triangle with two corners below
        # adds the whole triangle and subtracts the piece at the corner above.
        reference = middle + (level - middle @ up) * up
        under = height < level
        count = jnp.sum(under, axis=1)
        lone = jnp.argmax(under == (count == 1)[:, None], axis=1)
        order = (lone[:, None] + jnp.arange(3)) % 3
        corner = jnp.take_along_axis(interior, order[:, :, None], axis=1) - reference
        h = jnp.take_along_axis(height, order, axis=1)
        crosses = (count == 1) | (count == 2)
        rise = jnp.where(crosses[:, None], h[:, 1:] - h[:, :1], 1.0)
        share = jnp.where(crosses[:, None], (level - h[:, :1]) / rise, 0.0)[..., None]
        corner = corner.at[:, 1:].set(corner[:, :1] + share * (corner[:, 1:] - corner[:, :1]))
        corners = jnp.concatenate([interior - reference, corner])
        weight = jnp.concatenate([count >= 2, jnp.where(crosses, jnp.where(count == 1, 1, -1), 0)])
        volume = jnp.einsum("fi,fi->f", corners[:, 0], jnp.cross(corners[:, 1], corners[:, 2])) / 6
        return _Liquid(weight * volume, corners, reference, jnp.sum(weight * volume))

    share = jnp.clip(jnp.asarray(fill, interior.dtype), 0, 1)
    target = share * below(top + (top - bottom)).volume

    def halve(_: ScalarLike, bracket: _Bracket) -> _Bracket:
        level = (bracket.low + bracket.high) / 2
        less = below(level).volume < jax.lax.stop_gradient(target)
        return _Bracket(jnp.where(less, level, bracket.low), jnp.where(less, bracket.high, level))

    bracket = jax.lax.fori_loop(0, LEVEL_STEPS, halve, jax.lax.stop_gradient(_Bracket(bottom, top)))
    middle_level = (bracket.low + bracket.high) / 2
    # A Newton step with a constant slope gives the level the derivative of the exact root.
    middle_volume, slope = jax.value_and_grad(lambda level: below(level).volume)(middle_level)
    wide = slope > 0
    level = middle_level + jnp.where(wide, (target - middle_volume) / jnp.where(wide, slope, 1), 0)
    # The level of a full body is above its top, so that rounding cannot exclude the highest corners.
    level = jnp.where(share < 1, level, top + (top - bottom))
    volumes, corners, reference, volume = below(level)
    total = jnp.sum(corners, axis=1)
    filled = volume > 0
    whole = jnp.where(filled, volume, 1.0)
    first = jnp.where(filled, jnp.einsum("f,fi->i", volumes, total) / 4 / whole, 0.0)
    second = jnp.einsum("f,fi,fj->ij", volumes, total, total) + jnp.einsum("f,fki,fkj->ij", volumes, corners, corners)
    second = jnp.where(filled, second / 20 - volume * jnp.outer(first, first), 0.0)
    return jnp.where(filled, volume, 0.0), jnp.where(filled, reference + first, middle), second
