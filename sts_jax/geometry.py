"""Quaternions, poses and vectors.

A quaternion is `[w, x, y, z]`, shape `(4,)`, with unit length. A pose is a position (m) and a quaternion, shape `(7,)`.
It maps points of an object's mesh frame to the sensor frame. All functions have finite gradients, also at zero and at
the identity. Arguments whose shapes start with `*n` may have any leading axes.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sts_jax._checked import checked

AnyArray = Array | np.ndarray


def norm(x: Float[AnyArray, "*n d"]) -> Float[Array, "*n"]:
    """Euclidean norm over the last axis, with zero gradient at zero."""
    square = jnp.sum(x * x, axis=-1)
    ok = square > 0
    return jnp.where(ok, jnp.sqrt(jnp.where(ok, square, 1)), 0)


def normalize(x: Float[AnyArray, "*n d"]) -> Float[Array, "*n d"]:
    """`x` divided by its norm, or zero with zero gradient where `x` is zero."""
    length = norm(x)[..., None]
    ok = length > 0
    return jnp.where(ok, x / jnp.where(ok, length, 1), 0)


@checked
def quat_multiply(a: Float[AnyArray, "*#n 4"], b: Float[AnyArray, "*#n 4"]) -> Float[Array, "... 4"]:
    """Hamilton product: the rotation `b`, followed by the rotation `a`."""
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


@checked
def quat_inverse(q: Float[AnyArray, "*n 4"]) -> Float[Array, "*n 4"]:
    """Inverse rotation: the conjugate [w, -x, -y, -z]."""
    return jnp.concatenate([q[..., :1], -q[..., 1:]], axis=-1)


@checked
def quat_canonical(q: Float[AnyArray, "*n 4"]) -> Float[Array, "*n 4"]:
    """Normalise a quaternion, and negate it if `w < 0`, which does not change the rotation."""
    q = normalize(q)
    return jnp.where(q[..., :1] < 0, -q, q)


@checked
def quat_to_matrix(q: Float[AnyArray, "*n 4"]) -> Float[Array, "*n 3 3"]:
    """Rotation matrix R. It rotates a column vector v to R v."""
    w, x, y, z = jnp.moveaxis(q, -1, 0)
    rows = [
        jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return jnp.stack(rows, -2)


@checked
def quat_from_matrix(matrix: Float[AnyArray, "*n 3 3"]) -> Float[Array, "*n 4"]:
    """Quaternion, with `w >= 0`, of a rotation matrix, or of the rotation nearest to any other matrix.

    The nearest rotation R has the largest `sum(R * matrix)`. Its quaternion is the eigenvector of the largest
    eigenvalue of Davenport's matrix K (Markley and Mortari 2000, "Quaternion attitude estimation using vector
    observations").
    """
    m = matrix
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    z = jnp.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], axis=-1)
    corner = m + m.swapaxes(-1, -2) - jnp.tensordot(trace, jnp.eye(3), 0)
    top = jnp.concatenate([trace[..., None], z], axis=-1)[..., None, :]
    k = jnp.concatenate([top, jnp.concatenate([z[..., :, None], corner], axis=-1)], axis=-2)
    return quat_canonical(_largest_eigenvector(k))


@jax.custom_jvp
def _largest_eigenvector(matrix: Float[Array, "*n 4 4"]) -> Float[Array, "*n 4"]:
    """Unit eigenvector of the largest eigenvalue of symmetric matrices, with a gradient also if others are equal."""
    values, vectors = _eigh(matrix)
    return _column(vectors, jnp.argmax(values, axis=-1))


@_largest_eigenvector.defjvp
def _largest_eigenvector_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # dv = sum_i v_i (v_i . dA v) / (lambda - lambda_i), over the eigenvectors v_i other than v, the one of the largest
    # eigenvalue lambda. A term is set to 0 if lambda_i is equal to lambda. The derivative of an eigendecomposition
    # divides by the differences of all pairs of eigenvalues, and for a rotation three of them are equal.
    values, vectors = _eigh(primals[0])
    which = jnp.argmax(values, axis=-1)
    largest = _column(vectors, which)
    top = jnp.take_along_axis(values, which[..., None], axis=-1)
    gap = top - values
    simple = gap > 1e-6 * jnp.abs(top)
    turned = jnp.einsum("...ij,...j->...i", tangents[0], largest)
    along = jnp.einsum("...ik,...i->...k", vectors, turned)
    along = jnp.where(simple, along / jnp.where(simple, gap, 1), 0)
    return largest, jnp.einsum("...ik,...k->...i", vectors, along)


def _column(matrix: Float[Array, "*n 4 4"], which: Int[Array, "*n"]) -> Float[Array, "*n 4"]:
    return jnp.take_along_axis(matrix, which[..., None, None], axis=-1)[..., 0]


def _eigh(matrix: Float[Array, "*n 4 4"]) -> tuple[Float[Array, "*n 4"], Float[Array, "*n 4 4"]]:
    """Eigenvalues and eigenvectors (columns) of symmetric matrices, by Jacobi's cyclic rotations.

    `jnp.linalg.eigh` calls LAPACK, which on a CPU waits for threads of the pool in which it runs: two programs that run
    at the same time can stop for ever. After five sweeps the error is that of float32. (Golub and Van Loan, "Matrix
    Computations", section 8.5)
    """

    def sweep(_: Int[Array, ""], parts: tuple[list, list]) -> tuple[list, list]:
        a, v = parts
        for p, q in ((0, 1), (2, 3), (0, 2), (1, 3), (0, 3), (1, 2)):
            # The smaller root of the rotation's tangent, in a form that needs no division by a[p][q]
            twice, apart = 2 * a[p][q], a[q][q] - a[p][p]
            below = jnp.abs(apart) + jnp.sqrt(apart * apart + twice * twice)
            tangent = jnp.where(apart < 0, -twice, twice) / jnp.where(below > 0, below, 1)
            cos = jax.lax.rsqrt(1 + tangent * tangent)
            sin = tangent * cos
            a = _rotated(_transposed(_rotated(_transposed(a), p, q, cos, sin)), p, q, cos, sin)
            v = _rotated(v, p, q, cos, sin)
        return a, v

    a = [[matrix[..., i, j] for j in range(4)] for i in range(4)]
    v = [[jnp.full_like(a[0][0], i == j) for j in range(4)] for i in range(4)]
    a, v = jax.lax.fori_loop(0, 5, sweep, (a, v))
    return jnp.stack([a[i][i] for i in range(4)], axis=-1), jnp.stack([jnp.stack(row, axis=-1) for row in v], axis=-2)


def _rotated(rows: list[list[Array]], p: int, q: int, cos: Array, sin: Array) -> list[list[Array]]:
    """Rotate the columns p and q of a matrix, given by its numbers."""
    turned = [list(row) for row in rows]
    for row, new in zip(rows, turned, strict=True):
        new[p], new[q] = cos * row[p] - sin * row[q], sin * row[p] + cos * row[q]
    return turned


def _transposed(rows: list[list[Array]]) -> list[list[Array]]:
    return [list(column) for column in zip(*rows, strict=True)]


@checked
def quat_from_rotvec(v: Float[AnyArray, "*n 3"]) -> Float[Array, "*n 4"]:
    """Quaternion of a rotation vector (rad): the rotation about `v` by the angle `|v|`."""
    half = 0.5 * norm(v)[..., None]
    return jnp.concatenate([jnp.cos(half), 0.5 * v * jnp.sinc(half / jnp.pi)], axis=-1)


@checked
def quat_to_rotvec(q: Float[AnyArray, "*n 4"]) -> Float[Array, "*n 3"]:
    """Rotation vector (rad) of a quaternion: the unit axis times the angle in [0, pi]."""
    q = quat_canonical(q)
    sine = norm(q[..., 1:])[..., None]
    small = sine < 1e-6
    half = jnp.arctan2(sine, q[..., :1])
    return q[..., 1:] * jnp.where(small, 2.0, 2 * half / jnp.where(small, 1, sine))


def random_quat(key: PRNGKeyArray) -> Float[Array, "4"]:
    """Draw a quaternion with `w >= 0` from the uniform distribution of rotations."""
    return quat_canonical(jax.random.normal(key, (4,)))


@checked
def transform(pose: Float[AnyArray, "7"], points: Float[AnyArray, "*n 3"]) -> Float[Array, "*n 3"]:
    """Transform points (m) from the mesh frame to the sensor frame. For several poses use `jax.vmap`."""
    # Component by component, because a matrix product is several times slower on a CPU and less precise on some GPUs.
    x, y, z = (points[..., k] for k in range(3))
    rows = zip(quat_to_matrix(pose[3:]), pose[:3], strict=True)
    return jnp.stack([row[0] * x + row[1] * y + row[2] * z + shift for row, shift in rows], axis=-1)


@checked
def pose_to_matrix(pose: Float[AnyArray, "*n 7"]) -> Float[Array, "*n 4 4"]:
    """Homogeneous matrix of a pose: it maps points (x, y, z, 1) of the mesh frame to the sensor frame."""
    top = jnp.concatenate([quat_to_matrix(pose[..., 3:]), pose[..., :3, None]], axis=-1)
    bottom = jnp.broadcast_to(jnp.array([0.0, 0, 0, 1]), (*pose.shape[:-1], 1, 4))
    return jnp.concatenate([top, bottom.astype(top.dtype)], axis=-2)


@checked
def pose_from_matrix(matrix: Float[AnyArray, "*n 4 4"]) -> Float[Array, "*n 7"]:
    """Pose, with `w >= 0`, of a homogeneous matrix. See `quat_from_matrix` if its 3x3 part is not a rotation.

    A matrix that mirrors is an error, except in traced code.
    """
    if not isinstance(matrix, jax.core.Tracer):
        determinant = np.linalg.det(np.asarray(matrix[..., :3, :3], float))
        if (determinant < 0).any():
            raise ValueError(
                f"the matrix mirrors (its 3x3 part has the determinant {determinant.min():.3g}), so it has no pose: "
                "change the sign of one axis, or of one column"
            )
    return jnp.concatenate([matrix[..., :3, 3], quat_from_matrix(matrix[..., :3, :3])], axis=-1)


@checked
def pose_multiply(a: Float[AnyArray, "*#n 7"], b: Float[AnyArray, "*#n 7"]) -> Float[Array, "... 7"]:
    """Composition of two poses: `b` is applied first, then `a`, as in the product of their matrices."""
    quat = quat_multiply(a[..., 3:], b[..., 3:])
    turned = jnp.einsum("...ij,...j->...i", quat_to_matrix(a[..., 3:]), b[..., :3], precision="highest")
    return jnp.concatenate([turned + a[..., :3], quat_canonical(quat)], axis=-1)


@checked
def pose_inverse(pose: Float[AnyArray, "*n 7"]) -> Float[Array, "*n 7"]:
    """Inverse of a pose: it maps points of the sensor frame to the mesh frame."""
    quat = quat_inverse(pose[..., 3:])
    position = -jnp.einsum("...ij,...j->...i", quat_to_matrix(quat), pose[..., :3], precision="highest")
    return jnp.concatenate([position, quat_canonical(quat)], axis=-1)
