"""Normals of a surface given by a grid of points."""

import functools
import operator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def surface_normals(
    points: tuple[Float[Array, "a b *n"], Float[Array, "a b *n"], Float[Array, "a b *n"]],
) -> Float[Array, "h w *n 3"]:
    """Unit normals of a surface given by a grid of points.

    A normal is the axis along which the 3x3 neighbourhood of a point has the least variance (See-Through-your-Skin
    paper, supplement "Simulator Details").

    Args:
        points: x, y and z of the points in the sensor frame (m), with any batch axes behind rows and columns.

    Returns:
        Normals with z <= 0, towards the camera. The outermost rows and columns have none, so h = a - 2 and w = b - 2.
    """
    height, width = (n - 2 for n in points[0].shape[:2])
    # Differences from the middle point, in millimetres, preserve the precision of float32.
    padded = [1e3 * part for part in points]
    planes = [part[1:-1, 1:-1] for part in padded]
    near = [
        [padded[k][i : i + height, j : j + width] - planes[k] for k in range(3)]
        for i in range(3)
        for j in range(3)
        if (i, j) != (1, 1)
    ]
    total = [functools.reduce(operator.add, (n[k] for n in near)) for k in range(3)]

    def covariance(i: int, j: int) -> Float[Array, "h w *n"]:
        return functools.reduce(operator.add, (n[i] * n[j] for n in near)) / 9 - total[i] * total[j] / 81

    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    normal = smallest_eigenvector(*(covariance(i, j) for i, j in pairs))
    away = normal[2] > 0
    return jnp.stack([jnp.where(away, -n, n) for n in normal], axis=-1)


@jax.custom_jvp
def smallest_eigenvector(
    xx: Float[Array, "*n"],
    yy: Float[Array, "*n"],
    zz: Float[Array, "*n"],
    xy: Float[Array, "*n"],
    xz: Float[Array, "*n"],
    yz: Float[Array, "*n"],
) -> tuple[Float[Array, "*n"], Float[Array, "*n"], Float[Array, "*n"]]:
    """Unit eigenvector of the smallest eigenvalue of symmetric 3x3 matrices A, in closed form.

    With `m = trace(A) / 3`, `s = sqrt(trace((A - m I)^2) / 6)` and `h = det((A - m I) / s) / 2`, the smallest
    eigenvalue is `lambda = m + s b`, where b is the smallest root of `b^3 - 3 b = 2 h`. A polynomial in `sqrt(1 - h)`
    approximates b, and one Newton step improves it. Let lambda_1 and lambda_2 be the other eigenvalues and v the
    eigenvector. Then `adj(A - lambda I) = (lambda_1 - lambda) (lambda_2 - lambda) v v^T`, and v is the largest column
    of this matrix, divided by its length.

    The derivative exists if lambda differs from lambda_1 and from lambda_2, even if lambda_1 equals lambda_2. If lambda
    equals lambda_1 or lambda_2, the result is an arbitrary unit vector with zero gradient. The signs of the vectors are
    arbitrary. Six separate arrays of elements are faster on a CPU than one.
    """
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = jnp.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    s = 1 / jnp.where(spread > 0, spread, 1)
    half_det = (a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)) * (0.5 * s * s * s)
    h = jnp.clip(half_det, -1, 1)
    r = jnp.sqrt(1 - h)
    root = -1 + r * (-0.81649658 + r * (0.10895821 + r * (-0.02969152 + r * 0.00519827)))
    slope = 3 * root * root - 3
    root = root - jnp.where(slope > 1e-3, (root * (root * root - 3) - 2 * h) / jnp.where(slope > 1e-3, slope, 1), 0)
    shift = spread * root
    a, b, c = a - shift, b - shift, c - shift
    # Elements of the adjugate: p (0, 0), q (1, 1), t (2, 2), u (0, 1), v (0, 2), w (1, 2).
    p, q, t = b * c - yz * yz, a * c - xz * xz, a * b - xy * xy
    u, v, w = xz * yz - xy * c, xy * yz - xz * b, xy * xz - a * yz
    third, second = (t >= p) & (t >= q), q >= p
    x = jnp.where(third, v, jnp.where(second, u, p))
    y = jnp.where(third, w, jnp.where(second, q, u))
    z = jnp.where(third, t, jnp.where(second, w, v))
    size = jnp.maximum(jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.abs(z))
    nonzero = size > 0
    scale = 1 / jnp.where(nonzero, size, 1)
    x, y, z = x * scale, y * scale, jnp.where(nonzero, z * scale, 1)
    length = 1 / jnp.sqrt(x * x + y * y + z * z)
    return x * length, y * length, z * length


@smallest_eigenvector.defjvp
def _smallest_eigenvector_jvp(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[tuple, tuple]:
    # dv = -(A - lambda I)^+ dA v, where ^+ is the pseudo-inverse. It is computed as the inverse of a 2x2 matrix on the
    # plane orthogonal to v. p and q are an orthonormal basis of this plane (Duff et al. 2017, "Building an Orthonormal
    # Basis, Revisited").
    v = smallest_eigenvector(*primals)
    sign = jnp.where(v[2] < 0, -1.0, 1.0).astype(v[2].dtype)
    k = -1 / (sign + v[2])
    m = v[0] * v[1] * k
    p = (1 + sign * v[0] * v[0] * k, sign * m, -sign * v[0])
    q = (m, sign + v[1] * v[1] * k, -v[1])

    def between(left: tuple, elements: tuple, right: tuple) -> Array:
        xx, yy, zz, xy, xz, yz = elements
        x, y, z = left
        a, b, c = right
        return xx * x * a + yy * y * b + zz * z * c + xy * (x * b + y * a) + xz * (x * c + z * a) + yz * (y * c + z * b)

    value = between(v, primals, v)
    pp, qq, pq = between(p, primals, p) - value, between(q, primals, q) - value, between(p, primals, q)
    det = pp * qq - pq * pq
    simple = det > 1e-6 * (pp + qq) ** 2
    inverse = jnp.where(simple, 1 / jnp.where(simple, det, 1), 0)
    tp, tq = between(p, tangents, v), between(q, tangents, v)
    along_p, along_q = (qq * tp - pq * tq) * inverse, (pp * tq - pq * tp) * inverse
    return v, tuple(-(along_p * p[i] + along_q * q[i]) for i in range(3))
