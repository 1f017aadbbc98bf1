"""Rotations, poses and vectors: the geometry of the sensor frame.

A quaternion is `[w, x, y, z]`, shape `(4,)`, unit length. A pose is a position (m), then a quaternion, shape `(7,)`. It
maps points of the mesh frame to the sensor frame. All functions broadcast over leading axes and have finite gradients,
also at zero and at the identity. They accept lists of numbers, and raise a ValueError for an array of the wrong shape.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


def norm(x: Float[Array, "*n d"]) -> Float[Array, "*n"]:
    """Euclidean norm over the last axis, with zero gradient at zero."""
    square = jnp.sum(x * x, axis=-1)
    ok = square > 0
    return jnp.where(ok, jnp.sqrt(jnp.where(ok, square, 1)), 0)


def normalize(x: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
    """`x` divided by its norm, or zero with zero gradient where `x` is zero."""
    length = norm(x)[..., None]
    ok = length > 0
    return jnp.where(ok, x / jnp.where(ok, length, 1), 0)


def quat_multiply(a: Float[Array, "*n 4"], b: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
    """Hamilton product: the rotation `b`, then the rotation `a`."""
    a, b = _checked("a", a, 4), _checked("b", b, 4)
    aw, ax, ay, az = jnp.moveaxis(a, -1, 0)
    bw, bx, by, bz = jnp.moveaxis(b, -1, 0)
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def quat_inverse(q: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
    """Inverse of a unit quaternion: its conjugate."""
    q = _checked("q", q, 4)
    return jnp.concatenate([q[..., :1], -q[..., 1:]], axis=-1)


def quat_canonical(q: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
    """The unit quaternion of the same rotation with `w >= 0`."""
    q = _checked("q", q, 4)
    q = normalize(q)
    return jnp.where(q[..., :1] < 0, -q, q)


def quat_to_matrix(q: Float[Array, "*n 4"]) -> Float[Array, "*n 3 3"]:
    """Rotation matrix of a unit quaternion."""
    q = _checked("q", q, 4)
    w, x, y, z = jnp.moveaxis(q, -1, 0)
    rows = [
        jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return jnp.stack(rows, -2)


def quat_from_matrix(matrix: Float[Array, "*n 3 3"]) -> Float[Array, "*n 4"]:
    """Unit quaternion with `w >= 0` of a rotation matrix, or of the rotation nearest to any other 3x3 matrix.

    The nearest rotation R has the largest `sum(R * matrix)`. Its quaternion is the eigenvector of the largest
    eigenvalue of Davenport's K (Markley and Mortari 2000, "Quaternion attitude estimation using vector observations").
    """
    m = _checked("matrix", matrix, 3, 3)
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    z = jnp.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], axis=-1)
    corner = m + m.swapaxes(-1, -2) - jnp.tensordot(trace, jnp.eye(3), 0)
    top = jnp.concatenate([trace[..., None], z], axis=-1)[..., None, :]
    k = jnp.concatenate([top, jnp.concatenate([z[..., :, None], corner], axis=-1)], axis=-2)
    return quat_canonical(_largest_eigenvector(k))


@jax.custom_jvp
def _largest_eigenvector(matrix: Float[Array, "*n 4 4"]) -> Float[Array, "*n 4"]:
    """Unit eigenvector of the largest eigenvalue of symmetric matrices. The other eigenvalues may be equal."""
    return jnp.linalg.eigh(matrix)[1][..., :, -1]


@_largest_eigenvector.defjvp
def _largest_eigenvector_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # dv = sum_i v_i (v_i . dA v) / (lambda - lambda_i) over the other eigenvectors. A term is 0 if its eigenvalue is
    # equal to the largest. The derivative of `eigh` cannot be used, because it divides by the differences of all pairs,
    # and for a rotation three eigenvalues are equal.
    values, vectors = jnp.linalg.eigh(primals[0])
    largest = vectors[..., :, -1]
    gap = values[..., -1:] - values[..., :-1]
    simple = gap > 1e-6 * jnp.abs(values[..., -1:])
    turned = jnp.einsum("...ij,...j->...i", tangents[0], largest)
    along = jnp.einsum("...ik,...i->...k", vectors[..., :, :-1], turned)
    along = jnp.where(simple, along / jnp.where(simple, gap, 1), 0)
    return largest, jnp.einsum("...ik,...k->...i", vectors[..., :, :-1], along)


def quat_from_rotvec(v: Float[Array, "*n 3"]) -> Float[Array, "*n 4"]:
    """Quaternion of the rotation by `|v|` radians about `v`, differentiable at zero."""
    v = _checked("v", v, 3)
    half = 0.5 * norm(v)[..., None]
    return jnp.concatenate([jnp.cos(half), 0.5 * v * jnp.sinc(half / jnp.pi)], axis=-1)


def quat_to_rotvec(q: Float[Array, "*n 4"]) -> Float[Array, "*n 3"]:
    """Rotation vector (rad) of a unit quaternion: the axis times the angle, which is at most pi."""
    q = _checked("q", q, 4)
    q = quat_canonical(q)
    sine = norm(q[..., 1:])[..., None]
    small = sine < 1e-6
    half = jnp.arctan2(sine, q[..., :1])
    return q[..., 1:] * jnp.where(small, 2.0, 2 * half / jnp.where(small, 1, sine))


def random_quat(key: PRNGKeyArray) -> Float[Array, "4"]:
    """A uniformly drawn rotation with `w >= 0`."""
    return quat_canonical(jax.random.normal(key, (4,)))


def transform(pose: Float[Array, "7"], points: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Points of the mesh frame in the sensor frame."""
    pose, points = _checked("pose", pose, 7), _checked("points", points, 3)
    if pose.ndim != 1:
        raise ValueError(f"pose has the shape {pose.shape}, but it must be (7,): use jax.vmap for several poses")
    # Component by component, because a matrix product is several times slower on a CPU and rounds on some GPUs.
    x, y, z = (points[..., k] for k in range(3))
    rows = zip(quat_to_matrix(pose[3:]), pose[:3], strict=True)
    return jnp.stack([row[0] * x + row[1] * y + row[2] * z + shift for row, shift in rows], axis=-1)


def pose_to_matrix(pose: Float[Array, "*n 7"]) -> Float[Array, "*n 4 4"]:
    """Homogeneous 4x4 matrix of a pose."""
    pose = _checked("pose", pose, 7)
    top = jnp.concatenate([quat_to_matrix(pose[..., 3:]), pose[..., :3, None]], axis=-1)
    bottom = jnp.broadcast_to(jnp.array([0.0, 0, 0, 1]), (*pose.shape[:-1], 1, 4))
    return jnp.concatenate([top, bottom.astype(top.dtype)], axis=-2)


def pose_from_matrix(matrix: Float[Array, "*n 4 4"]) -> Float[Array, "*n 7"]:
    """Pose of a homogeneous 4x4 matrix, with `w >= 0`."""
    matrix = _checked("matrix", matrix, 4, 4)
    return jnp.concatenate([matrix[..., :3, 3], quat_from_matrix(matrix[..., :3, :3])], axis=-1)


def pose_multiply(a: Float[Array, "*n 7"], b: Float[Array, "*n 7"]) -> Float[Array, "*n 7"]:
    """Composition of two poses: the pose `b`, then the pose `a`. Its matrix is the product of their matrices."""
    a, b = _checked("a", a, 7), _checked("b", b, 7)
    quat = quat_multiply(a[..., 3:], b[..., 3:])
    turned = jnp.einsum("...ij,...j->...i", quat_to_matrix(a[..., 3:]), b[..., :3], precision="highest")
    return jnp.concatenate([turned + a[..., :3], quat_canonical(quat)], axis=-1)


def pose_inverse(pose: Float[Array, "*n 7"]) -> Float[Array, "*n 7"]:
    """The pose that maps the sensor frame into the mesh frame."""
    pose = _checked("pose", pose, 7)
    quat = quat_inverse(pose[..., 3:])
    position = -jnp.einsum("...ij,...j->...i", quat_to_matrix(quat), pose[..., :3], precision="highest")
    return jnp.concatenate([position, quat_canonical(quat)], axis=-1)


def _checked(name: str, value: Any, *tail: int) -> Array:
    """Convert a value to an array, and check that its last axes have the sizes `tail`."""
    if not hasattr(value, "shape"):
        try:
            value = jnp.asarray(value, float)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name} is {value!r}, but it must be an array of {_shape(tail)} numbers") from error
    if value.shape[max(value.ndim - len(tail), 0) :] != tail:
        raise ValueError(f"{name} has the shape {value.shape}, but it must be {_shape(tail)}")
    return value


def _shape(tail: tuple[int, ...]) -> str:
    return f"(..., {', '.join(map(str, tail))})"
