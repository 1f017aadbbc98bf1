"""The drawn skin: surface normals of a grid of points, Phong's reflectance, darkening by depth.

Images are float32, (height, width, 3). Nothing here clips to [0, 1]: a pixel adds up its light first.
"""

import dataclasses
import functools
import operator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sts_jax import _math

Scalar = float | Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Lights:
    """Directional lights in the gel's plane, one from each edge: red, green, blue, white (the original's)."""

    # unit vectors from the skin towards the lights, sensor frame: left, right, top, bottom edge of the image
    directions: Float[Array, "*n m 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([[-1.0, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]])
    )
    # intensity per channel, diffuse and specular alike (paper, supplement: 1.0 in each light's own channels)
    colors: Float[Array, "*n m 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Phong:
    """Reflectance of the skin's inner side."""

    ambient: Scalar = 0.8  # k_a (paper, supplement "Simulator Details")
    diffuse: Scalar = 1.0  # k_d (paper, as above)
    specular: Scalar = 0.5  # k_s (paper, as above)
    shininess: Scalar = 5.0  # alpha (paper, as above)
    ambient_color: tuple[Scalar, Scalar, Scalar] = (0.8725, 0.8725, 1.0)  # i_a: a flat gel is (178, 178, 204) / 255
    darkening: Scalar = 0.001  # m, depth at which the skin is 1/e as bright; the paper names the mask, not its shape


def surface_normals(
    points: tuple[Float[Array, "a b"], Float[Array, "a b"], Float[Array, "a b"]],
) -> Float[Array, "h w 3"]:
    """Unit normals of a grid of points: the axis of least covariance of each point's 3x3 neighbourhood.

    Args:
        points: x, y, z in the sensor frame (m), with one more point on each side: `a b` is `h+2 w+2`.

    Returns:
        Unit normals towards the camera (z <= 0) (paper, supplement "Simulator Details").
    """
    height, width = (n - 2 for n in points[0].shape)
    # Differences from the middle point in millimetres: float32 keeps its digits.
    padded = [1e3 * part for part in points]
    planes = [part[1:-1, 1:-1] for part in padded]
    near = [
        [padded[k][i : i + height, j : j + width] - planes[k] for k in range(3)]
        for i in range(3)
        for j in range(3)
        if (i, j) != (1, 1)
    ]
    total = [functools.reduce(operator.add, (n[k] for n in near)) for k in range(3)]

    def covariance(i: int, j: int) -> Float[Array, "h w"]:
        return functools.reduce(operator.add, (n[i] * n[j] for n in near)) / 9 - total[i] * total[j] / 81

    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    normal = _math.smallest_eigenvector(*(covariance(i, j) for i, j in pairs))
    away = normal[2] > 0
    return jnp.stack([jnp.where(away, -n, n) for n in normal], axis=-1)


def phong(phong: Phong, lights: Lights, normals: Float[Array, "h w 3"]) -> Float[Array, "h w 3"]:
    """Phong's reflection of the lights by the skin.

        I = k_a i_a + sum_m (k_d (L_m . N) i_m + k_s (R_m . V)^alpha i_m),   R_m = 2 (L_m . N) N - L_m

    with both products clipped at 0. V is the optical axis, as for a distant viewer: a skin that lies flat is then
    uniform, whatever its place.

    Args:
        phong: the skin's constants.
        lights: directions need not be of unit length.
        normals: unit, towards the camera.

    Returns:
        Image, not clipped (paper, equation "phong").
    """
    nx, ny, nz = (normals[..., k] for k in range(3))
    directions, colors = _math.normalize(lights.directions), lights.colors
    image = [jnp.broadcast_to(jnp.asarray(phong.ambient * i, jnp.float32), nx.shape) for i in phong.ambient_color]
    for m in range(directions.shape[0]):
        incidence = directions[m, 0] * nx + directions[m, 1] * ny + directions[m, 2] * nz
        towards = directions[m, 2] - 2 * incidence * nz  # R . V with V = (0, 0, -1)
        shines = towards > 0
        highlight = jnp.where(shines, jnp.exp(phong.shininess * jnp.log(jnp.where(shines, towards, 1))), 0)
        strength = phong.diffuse * jnp.maximum(incidence, 0) + phong.specular * highlight
        image = [channel + strength * colors[m, k] for k, channel in enumerate(image)]
    return jnp.stack(image, axis=-1)


def darken(phong: Phong, depth: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Brightness of the skin by how deep it is pressed, `exp(-depth / darkening)` (m)."""
    return jnp.exp(-depth / phong.darkening)
