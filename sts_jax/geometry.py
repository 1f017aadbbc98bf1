"""Quaternions, poses and vectors.

A quaternion is `[w, x, y, z]`, shape `(4,)`, with unit length. A pose is a position (m) and a quaternion, shape `(7,)`.
It maps points of an object's mesh frame to the sensor frame. All functions have finite gradients, also at zero and at
the identity. Arguments whose shapes start with `*n` may have any leading axes.

The functions of quaternions, matrices and poses accept lists of numbers too, and raise a ValueError if the last axes of
an argument have the wrong sizes.
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
    """Hamilton product of two quaternions [w, x, y, z]: the rotation `b`, followed by the rotation `a`."""
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
    """Quaternion of the inverse rotation: the conjugate [w, -x, -y, -z] of the unit quaternion `q`, [w, x, y, z]."""
    q = _checked("q", q, 4)
    return jnp.concatenate([q[..., :1], -q[..., 1:]], axis=-1)


def quat_canonical(q: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
    """Normalise a quaternion [w, x, y, z], and negate it if `w < 0`, which does not change the rotation."""
    q = _checked("q", q, 4)
    q = normalize(q)
    return jnp.where(q[..., :1] < 0, -q, q)


def quat_to_matrix(q: Float[Array, "*n 4"]) -> Float[Array, "*n 3 3"]:
    """Rotation matrix R of a unit quaternion [w, x, y, z]. It rotates a column vector v to R v."""
    q = _checked("q", q, 4)
    w, x, y, z = jnp.moveaxis(q, -1, 0)
    rows = [
        jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return jnp.stack(rows, -2)


def quat_from_matrix(matrix: Float[Array, "*n 3 3"]) -> Float[Array, "*n 4"]:
    """Unit quaternion [w, x, y, z] of a rotation matrix, with `w >= 0`.

    For any other 3x3 matrix, the result is the quaternion of the nearest rotation. The nearest rotation is the rotation
    matrix R with the largest `sum(R * matrix)`. Its quaternion is the eigenvector of the largest eigenvalue of
    Davenport's matrix K (Markley and Mortari 2000, "Quaternion attitude estimation using vector observations").
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
    """Unit eigenvector of the largest eigenvalue of symmetric matrices, with a gradient also if others are equal."""
    return jnp.linalg.eigh(matrix)[1][..., :, -1]


@_largest_eigenvector.defjvp
def _largest_eigenvector_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # dv = sum_i v_i (v_i . dA v) / (lambda - lambda_i), over the eigenvectors v_i other than v, the one of the largest
    # eigenvalue lambda. A term is set to 0 if lambda_i is equal to lambda. The derivative of `eigh` cannot be used,
    # because it divides by the differences of all pairs of eigenvalues, and for a rotation three of them are equal.
    values, vectors = jnp.linalg.eigh(primals[0])
    largest = vectors[..., :, -1]
    gap = values[..., -1:] - values[..., :-1]
    simple = gap > 1e-6 * jnp.abs(values[..., -1:])
    turned = jnp.einsum("...ij,...j->...i", tangents[0], largest)
    along = jnp.einsum("...ik,...i->...k", vectors[..., :, :-1], turned)
    along = jnp.where(simple, along / jnp.where(simple, gap, 1), 0)
    return largest, jnp.einsum("...ik,...k->...i", vectors[..., :, :-1], along)


def quat_from_rotvec(v: Float[Array, "*n 3"]) -> Float[Array, "*n 4"]:
    """Quaternion [w, x, y, z] of a rotation vector (rad): the rotation about `v` by the angle `|v|`."""
    v = _checked("v", v, 3)
    half = 0.5 * norm(v)[..., None]
    return jnp.concatenate([jnp.cos(half), 0.5 * v * jnp.sinc(half / jnp.pi)], axis=-1)


def quat_to_rotvec(q: Float[Array, "*n 4"]) -> Float[Array, "*n 3"]:
    """Rotation vector (rad) of a unit quaternion [w, x, y, z]: the unit axis times the angle in [0, pi]."""
    q = _checked("q", q, 4)
    q = quat_canonical(q)
    sine = norm(q[..., 1:])[..., None]
    small = sine < 1e-6
    half = jnp.arctan2(sine, q[..., :1])
    return q[..., 1:] * jnp.where(small, 2.0, 2 * half / jnp.where(small, 1, sine))


def random_quat(key: PRNGKeyArray) -> Float[Array, "4"]:
    """Draw a quaternion [w, x, y, z] with `w >= 0` from the uniform distribution of rotations."""
    return quat_canonical(jax.random.normal(key, (4,)))


def transform(pose: Float[Array, "7"], points: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Transform points from the mesh frame to the sensor frame.

    Args:
        pose: One pose: position (m) and unit quaternion [w, x, y, z]. For several poses use `jax.vmap`.
        points: Points in the mesh frame (m).

    Returns:
        The points in the sensor frame (m).

    Raises:
        ValueError: `pose` or `points` has the wrong shape.
    """
    pose, points = _checked("pose", pose, 7), _checked("points", points, 3)
    if pose.ndim != 1:
        raise ValueError(f"pose has the shape {pose.shape}, but it must be (7,): for several poses use jax.vmap")
    # Component by component, because a matrix product is several times slower on a CPU and less precise on some GPUs.
    x, y, z = (points[..., k] for k in range(3))
    rows = zip(quat_to_matrix(pose[3:]), pose[:3], strict=True)
    return jnp.stack([row[0] * x + row[1] * y + row[2] * z + shift for row, shift in rows], axis=-1)


def pose_to_matrix(pose: Float[Array, "*n 7"]) -> Float[Array, "*n 4 4"]:
    """Homogeneous 4x4 matrix of a pose: it maps points (x, y, z, 1) of the mesh frame to the sensor frame.

    A pose is a position (m) and a unit quaternion [w, x, y, z].
    """
    pose = _checked("pose", pose, 7)
    top = jnp.concatenate([quat_to_matrix(pose[..., 3:]), pose[..., :3, None]], axis=-1)
    bottom = jnp.broadcast_to(jnp.array([0.0, 0, 0, 1]), (*pose.shape[:-1], 1, 4))
    return jnp.concatenate([top, bottom.astype(top.dtype)], axis=-2)


def pose_from_matrix(matrix: Float[Array, "*n 4 4"]) -> Float[Array, "*n 7"]:
    """Pose of a homogeneous 4x4 matrix, as a position (m) and a unit quaternion [w, x, y, z] with `w >= 0`.

    If the upper left 3x3 matrix is not a rotation, the pose has the nearest rotation.
    """
    matrix = _checked("matrix", matrix, 4, 4)
    return jnp.concatenate([matrix[..., :3, 3], quat_from_matrix(matrix[..., :3, :3])], axis=-1)


def pose_multiply(a: Float[Array, "*n 7"], b: Float[Array, "*n 7"]) -> Float[Array, "*n 7"]:
    """Composition of two poses: `b` is applied first, then `a`.

    The matrix of the composition is the matrix of `a` times the matrix of `b`. A pose is a position (m) and a unit
    quaternion [w, x, y, z].
    """
    a, b = _checked("a", a, 7), _checked("b", b, 7)
    quat = quat_multiply(a[..., 3:], b[..., 3:])
    turned = jnp.einsum("...ij,...j->...i", quat_to_matrix(a[..., 3:]), b[..., :3], precision="highest")
    return jnp.concatenate([turned + a[..., :3], quat_canonical(quat)], axis=-1)


def pose_inverse(pose: Float[Array, "*n 7"]) -> Float[Array, "*n 7"]:
    """Inverse of a pose. The inverse maps points of the sensor frame to the mesh frame.

    A pose is a position (m) and a unit quaternion [w, x, y, z].
    """
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
            raise ValueError(
                f"{name} is {value!r}, but it must be an array of numbers of shape {_shape(tail)}"
            ) from error
    if value.shape[max(value.ndim - len(tail), 0) :] != tail:
        raise ValueError(f"{name} has the shape {value.shape}, but it must be {_shape(tail)}")
    return value


def _shape(tail: tuple[int, ...]) -> str:
    """Text of a shape with any leading axes, such as "(..., 4)"."""
    return f"(..., {', '.join(map(str, tail))})"
