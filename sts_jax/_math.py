"""Reductions in a form that XLA's CPU backend vectorises, and an eigenvector in closed form."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_LANES = 32  # row length in `running_sum`, and half the length from which `_fold` splits a vector


def least(values: Array) -> Array:
    """`jnp.min` of a vector by elementwise minima of its parts, which a CPU vectorises. XLA's own is sequential."""
    return _fold(jnp.minimum, jnp.min, values)


def most(values: Array) -> Array:
    """`jnp.max` of a vector, computed like `least`."""
    return _fold(jnp.maximum, jnp.max, values)


def running_sum(counts: Array) -> Int[Array, "n"]:
    """`jnp.cumsum` of integers whose sum is below 2^24, as products with triangular matrices. Faster on a CPU."""
    size = len(counts)
    rows = -(-size // _LANES)
    table = jnp.pad(counts.astype(jnp.float32), (0, rows * _LANES - size)).reshape(rows, _LANES)
    sums = jnp.matmul(table, jnp.triu(jnp.ones((_LANES, _LANES))), precision=jax.lax.Precision.HIGHEST)
    sums = sums.astype(jnp.int32)
    if rows > 1:
        sums = sums.at[1:].add(running_sum(sums[:-1, -1])[:, None])
    return sums.reshape(-1)[:size]


def positions(flags: Bool[Array, "n"]) -> Int[Array, "n"]:
    """Indices of the set flags in order, padded with n to the length of `flags`."""
    size = len(flags)
    place = jnp.where(flags, running_sum(flags) - 1, size)
    return jnp.full(size, size, jnp.int32).at[place].set(jnp.arange(size, dtype=jnp.int32), mode="drop")


def _fold(pair: Callable[[Array, Array], Array], whole: Callable[[Array], Array], values: Array) -> Array:
    while len(values) >= 2 * _LANES:
        part = len(values) // 8
        parts = [values[k * part : (k + 1) * part] for k in range(8)]
        rest = values[8 * part :]
        values = jnp.concatenate([functools.reduce(pair, parts), rest]) if len(rest) else functools.reduce(pair, parts)
    return whole(values)


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

    The eigenvalue lambda is the smallest root of the characteristic cubic, `mean + spread b` with `b^3 - 3 b = 2 h`,
    computed as a polynomial in `sqrt(1 - h)` and one Newton step. The vector is the largest column of
    `adj(A - lambda I) = (lambda_1 - lambda) (lambda_2 - lambda) v v^T`. The derivative only needs lambda to be simple.
    The other two eigenvalues may be equal, as for points spread evenly in a plane. If lambda is not simple, some unit
    vector is returned, with zero gradient.

    Args:
        xx: with the other five, the elements of A. Separate arrays are faster on a CPU.
        yy: see above.
        zz: see above.
        xy: see above.
        xz: see above.
        yz: see above.

    Returns:
        The vector's three components. Its sign is arbitrary.
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
    # The adjugate: diagonal p, q, t, off-diagonal u (01), v (02), w (12).
    p, q, t = b * c - yz * yz, a * c - xz * xz, a * b - xy * xy
    u, v, w = xz * yz - xy * c, xy * yz - xz * b, xy * xz - a * yz
    third, second = (t >= p) & (t >= q), q >= p
    x = jnp.where(third, v, jnp.where(second, u, p))
    y = jnp.where(third, w, jnp.where(second, q, u))
    z = jnp.where(third, t, jnp.where(second, w, v))
    size = jnp.maximum(jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.abs(z))
    known = size > 0
    scale = 1 / jnp.where(known, size, 1)
    x, y, z = x * scale, y * scale, jnp.where(known, z * scale, 1)
    length = 1 / jnp.sqrt(x * x + y * y + z * z)
    return x * length, y * length, z * length


@smallest_eigenvector.defjvp
def _smallest_eigenvector_jvp(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[tuple, tuple]:
    # dv = -(A - lambda I)^+ dA v, through the inverse of a 2x2 matrix on the plane orthogonal to v, which p and q span
    # (Duff et al. 2017: a basis without singular cases).
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
