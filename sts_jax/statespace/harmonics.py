"""Functions on the unit sphere as sums of real spherical harmonics, and their rotation with an object.

A function is given by its coefficients, one for each harmonic. The harmonics are sorted by degree n = 0, 1, 2, ...,
and within a degree by order m = 0, 1, -1, ..., n, -n. A harmonic of order m > 0 is proportional to the cosine of m
times the angle about the z axis, and a harmonic of order m < 0 to the sine of -m times this angle. The harmonics are
homogeneous polynomials of the direction d, and their mean square over the sphere is 1. A rotation matrix R turns the
function f into the function d -> f(R^T d).
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def number(degree: int) -> int:
    """The number of spherical harmonics of the degrees 0 to `degree`."""
    return (degree + 1) ** 2


def basis(direction: Float[Array, "*n 3"], degree: int) -> Float[Array, "*n k"]:
    """Evaluate all real spherical harmonics of the degrees 0 to `degree`.

    Args:
        direction: Unit vectors. If a vector has another length s, the values of degree n are multiplied by `s**n`.
        degree: Largest degree.
    """
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    square = x**2 + y**2 + z**2
    cosine, sine = [jnp.ones_like(x)], [jnp.zeros_like(x)]
    for _ in range(degree):
        cosine.append(x * cosine[-1] - y * sine[-1])
        sine.append(x * sine[-1] + y * cosine[-2])
    polar: dict[tuple[int, int], Float[Array, "*n"]] = {}
    for m in range(degree + 1):
        polar[m, m] = jnp.full_like(x, float(math.prod(range(1, 2 * m, 2))))
        for n in range(m + 1, degree + 1):
            before = polar.get((n - 2, m), jnp.zeros_like(x))
            polar[n, m] = ((2 * n - 1) * z * polar[n - 1, m] - (n + m - 1) * square * before) / (n - m)
    harmonics = []
    for n, m in _orders(degree):
        scale = math.sqrt((2 - (m == 0)) * (2 * n + 1) * math.factorial(n - abs(m)) / math.factorial(n + abs(m)))
        harmonics.append(scale * polar[n, abs(m)] * (cosine[m] if m >= 0 else sine[-m]))
    return jnp.stack(harmonics, axis=-1)


def values(
    coefficients: Float[Array, "n c k"], rotation: Float[Array, "n 3 3"], directions: Float[np.ndarray, "j 3"]
) -> Float[Array, "n c j"]:
    """Rotate c functions of each of n objects, and evaluate them at j fixed directions: `f(R^T d)`.

    Args:
        coefficients: Coefficients of k spherical harmonics.
        rotation: Rotation matrices R. For a mean of several matrices, the result is approximately the mean of the
            results.
        directions: Unit vectors d.
    """
    degree = math.isqrt(coefficients.shape[-1]) - 1
    return jnp.einsum("nck,njk->ncj", coefficients, basis(jnp.asarray(directions) @ rotation, degree))


def reflected(count: int) -> Float[np.ndarray, "3 k"]:
    """Factors of k coefficients under the reflections x -> -x, y -> -y and z -> -z."""
    n, m = np.array(_orders(math.isqrt(count) - 1)).T
    return np.where(np.stack([(m + (m < 0)) % 2, m < 0, (n + m) % 2]), -1, 1).astype(np.float32)


def turn(angle: Float[Array, "n 2"], coefficients: Float[Array, "n c k"]) -> Float[Array, "n c k"]:
    """Rotate functions about the z axis. `angle` has the cosine and the sine of each rotation angle."""
    cosine, sine, partner = _about_vertical(angle, coefficients.shape[-1])
    return cosine * coefficients + sine * coefficients[..., partner]


def turn_variance(angle: Float[Array, "n 2"], variance: Float[Array, "n c k"]) -> Float[Array, "n c k"]:
    """Variances of coefficients after `turn`, if they are independent before. Covariances are left out."""
    cosine, sine, partner = _about_vertical(angle, variance.shape[-1])
    return cosine**2 * variance + sine**2 * variance[..., partner]


def _orders(degree: int) -> list[tuple[int, int]]:
    """Degree n and order m of each harmonic, in the sequence of the coefficients."""
    return [(n, m) for n in range(degree + 1) for m in (0, *(s * a for a in range(1, n + 1) for s in (1, -1)))]


def _about_vertical(angle: Float[Array, "n 2"], count: int) -> tuple[Array, Array, np.ndarray]:
    """The terms of a rotation about the z axis: `cosine * coefficients + sine * coefficients[..., partner]`.

    The partner of a coefficient has the same degree and the opposite order. `cosine` and `sine` are (n, 1, k).
    """
    orders = _orders(math.isqrt(count) - 1)
    partner = np.array([orders.index((n, -m)) for n, m in orders])
    powers = [jnp.stack([jnp.ones_like(angle[:, 0]), jnp.zeros_like(angle[:, 0])], axis=-1)]
    for _ in range(orders[-1][0]):
        cos, sin = powers[-1][:, 0], powers[-1][:, 1]
        powers.append(
            jnp.stack([angle[:, 0] * cos - angle[:, 1] * sin, angle[:, 0] * sin + angle[:, 1] * cos], axis=-1)
        )
    cosine = jnp.stack([powers[abs(m)][:, 0] for _, m in orders], axis=-1)
    # sin(m (b - a)) = sin(m b) cos(m a) - cos(m b) sin(m a), so that a sine adds to its cosine with a minus sign.
    sine = jnp.stack([powers[abs(m)][:, 1] * (-1 if m > 0 else 1 if m < 0 else 0) for _, m in orders], axis=-1)
    return cosine[:, None], sine[:, None], partner
