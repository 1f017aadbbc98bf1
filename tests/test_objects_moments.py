import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from sts_jax.objects import fill_moments
from sts_jax.objects.assembly import solid_moments, surface_moments

FILLS = np.linspace(0, 1, 33)
_TABLE = jax.jit(jax.vmap(fill_moments, in_axes=(None, 0, None)))


def filled(mesh: trimesh.Trimesh, up: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> np.ndarray:
    """Moments [1, x, y, z, xx, yy, zz, xy, xz, yz] about the origin at each of FILLS."""
    found = _TABLE(jnp.asarray(mesh.triangles, jnp.float32), FILLS, jnp.asarray(up) / np.linalg.norm(up))
    volume, centre, second = (np.asarray(x, float) for x in found)
    full = second + volume[:, None, None] * centre[:, :, None] * centre[:, None]
    return np.c_[volume, volume[:, None] * centre, full[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]]


def box(a: float, b: float, c: float, centre: tuple[float, float, float]) -> np.ndarray:
    """Moments of a solid box, by hand."""
    x, y, z = centre
    squares = [a * a / 12 + x * x, b * b / 12 + y * y, c * c / 12 + z * z]
    return a * b * c * np.array([1, x, y, z, *squares, x * y, x * z, y * z])


def twisted() -> trimesh.Trimesh:
    """Closed, not convex, in no special attitude and away from the origin."""
    mesh = trimesh.creation.torus(0.03, 0.012, major_sections=24, minor_sections=10)
    turn = trimesh.transformations.rotation_matrix(0.7, [1.0, 0.4, 0.2])
    mesh.apply_transform(turn)
    mesh.apply_translation([0.02, -0.05, 0.04])
    return mesh


def test_fills_of_a_box_are_the_closed_form():
    mesh = trimesh.creation.box((0.06, 0.04, 0.1))
    mesh.apply_translation([0.01, 0.02, 0.03])
    table = filled(mesh)
    truth = [box(0.06, 0.04, 0.1 * s, (0.01, 0.02, -0.02 + 0.05 * s)) for s in FILLS]
    np.testing.assert_allclose(table, truth, rtol=1e-5, atol=1e-12)


def test_fills_of_a_lying_prism_are_those_of_the_clipped_polygon():
    # A cylinder of 64 sides along y: the filled part is the segment of the polygon, cut here by trapezoids.
    mesh = trimesh.creation.cylinder(radius=0.02, height=0.08, sections=64)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    table = filled(mesh)
    angle = np.linspace(0, 2 * np.pi, 65)
    outline = trimesh.creation.cylinder(radius=0.02, height=0.08, sections=64).vertices
    assert np.isclose(np.linalg.norm(outline[:, :2], axis=1).max(), 0.02)
    z = np.linspace(-0.02, 0.02, 400_001)
    corners = 0.02 * np.stack([np.cos(angle), np.sin(angle)], 1)
    right = corners[corners[:, 0] >= -1e-12]
    right = right[np.argsort(right[:, 1])]
    width = 2 * np.interp(z, right[:, 1], right[:, 0]) * 0.08
    step = z[1] - z[0]

    def running(values: np.ndarray) -> np.ndarray:
        return np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * step)])

    volume = running(width)
    for column, values in ((0, width), (3, width * z), (6, width * z * z), (4, width**3 / (12 * 0.08**2))):
        truth = np.interp(FILLS * volume[-1], volume, running(values))
        np.testing.assert_allclose(table[:, column], truth, atol=3e-5 * np.abs(truth).max())


def test_fills_of_a_sphere_are_its_caps():
    radius = 0.03
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    table = filled(mesh)
    for k in (4, 16, 25):
        roots = np.roots([-np.pi / 3, np.pi * radius, 0, -k / 32 * 4 / 3 * np.pi * radius**3])
        height = float(next(r.real for r in roots if abs(r.imag) < 1e-9 and 0 < r.real < 2 * radius))
        centre = -3 * (2 * radius - height) ** 2 / (4 * (3 * radius - height))
        np.testing.assert_allclose(table[k, 3] / table[k, 0], centre, atol=2e-3 * radius)


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (0.0, 0.0, -2.0), (0.3, -0.8, 0.5)])
def test_fills_of_a_ring_agree_with_samples(direction):
    mesh = twisted()
    up = np.array(direction) / np.linalg.norm(direction)
    table = filled(mesh, direction)
    rng = np.random.default_rng(0)
    low, high = mesh.bounds
    points = rng.uniform(low, high, (200_000, 3))
    points = points[mesh.contains(points)]
    points = points[np.argsort(points @ up)]
    for k in (1, 8, 20, 32):
        part = points[: len(points) * k // 32]
        np.testing.assert_allclose(table[k, 0], mesh.volume * k / 32, rtol=1e-5)
        noise = 5 / np.sqrt(len(part))
        centre = table[k, 1:4] / table[k, 0]
        assert (abs(centre - part.mean(0)) < noise * part.std(0)).all()
        i, j = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
        square = part[:, i] * part[:, j]
        assert (abs(table[k, 4:] / table[k, 0] - square.mean(0)) < noise * square.std(0)).all()


def test_fills_along_opposite_directions_add_up_to_the_whole():
    mesh = twisted()
    up, down = filled(mesh, (0.2, 0.3, 0.9)), filled(mesh, (-0.2, -0.3, -0.9))
    np.testing.assert_allclose(up + down[::-1], np.broadcast_to(up[-1], up.shape), rtol=1e-5, atol=1e-11)


def test_whole_solid_agrees_with_trimesh():
    mesh = twisted()
    total = solid_moments(mesh.triangles).sum(0)
    np.testing.assert_allclose(total[0], mesh.volume)
    np.testing.assert_allclose(total[1:4] / total[0], mesh.center_mass)
    central = total[4:7] - total[0] * (total[1:4] / total[0]) ** 2
    np.testing.assert_allclose(central.sum() - central, np.diag(mesh.moment_inertia), rtol=1e-6)


def test_surface_moments_agree_with_samples():
    mesh = twisted()
    total = surface_moments(mesh.triangles).sum(0)
    points = trimesh.sample.sample_surface(mesh, 200_000, seed=1)[0]
    np.testing.assert_allclose(total[0], mesh.area)
    np.testing.assert_allclose(total[1:4] / total[0], points.mean(0), atol=3e-4)
    np.testing.assert_allclose(total[4:7] / total[0], (points**2).mean(0), atol=3e-5)


def test_an_empty_and_a_missing_interior_weigh_nothing():
    for triangles in (trimesh.creation.box((0.1, 0.1, 0.1)).triangles, np.zeros((8, 3, 3))):
        volume, centre, second = fill_moments(jnp.asarray(triangles, jnp.float32), 0.0)
        assert volume == 0
        np.testing.assert_array_equal(second, 0)
        np.testing.assert_allclose(centre, 0, atol=1e-7)
