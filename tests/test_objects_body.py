import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from object_files import surface

from sts_jax import objects
from sts_jax.objects import fill_moments
from sts_jax.objects.assembly import corner_normals, solid_moments, surface_moments


def brute(body: objects.Body, solid: trimesh.Trimesh, fill: float, scale: float, up: np.ndarray):
    """Mass, centre and inertia of samples: the shell's on the surface, the contents' lowest share of the volume."""
    rng = np.random.default_rng(0)
    shell = trimesh.sample.sample_surface(solid, 100_000, seed=2)[0]
    low, high = solid.bounds
    inside = rng.uniform(low, high, (300_000, 3))
    inside = inside[solid.contains(inside)]
    inside = inside[np.argsort(inside @ up)][: int(len(inside) * fill)]
    shell_mass = float(body.shell_mass) * scale
    contents_mass = float(body.contents_density) * solid.volume * fill
    weights = np.concatenate(
        [np.full(len(shell), shell_mass / len(shell)), np.full(len(inside), contents_mass / max(len(inside), 1))]
    )
    points = np.concatenate([shell, inside])
    mass = weights.sum()
    com = weights @ points / mass
    offset = points - com
    square = np.einsum("p,pi,pj->ij", weights, offset, offset)
    return mass, com, np.trace(square) * np.eye(3) - square


@pytest.fixture(scope="module")
def jar(tmp_path_factory) -> tuple[objects.Body, trimesh.Trimesh]:
    """A closed, lopsided solid whose surface is both shell and interior."""
    mesh = trimesh.creation.torus(0.025, 0.012, major_sections=20, minor_sections=12)
    mesh.vertices[:, 2] *= 1 + 8 * mesh.vertices[:, 0]
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.5, [1, 1, 0]))
    path = tmp_path_factory.mktemp("jar") / "jar.stl"
    mesh.export(path)
    body = objects.load(path)
    return body, surface(body)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.3, -0.8, 0.5)])
@pytest.mark.parametrize(("fill", "scale"), [(0.0, 1.1), (0.13, 0.9), (0.5, 1.1), (0.87, 0.9), (1.0, 1.1)])
def test_mass_properties_agree_with_samples(jar, fill, scale, up):
    body, solid = jar
    up = np.array(up) / np.linalg.norm(up)
    mass, com, inertia = jax.jit(objects.rigid)(body, fill, scale, jnp.asarray(up, jnp.float32))
    true_mass, true_com, true_inertia = brute(body, solid, fill, scale, up)
    np.testing.assert_allclose(mass, true_mass, rtol=1e-4)
    np.testing.assert_allclose(com, true_com, atol=2e-4)
    np.testing.assert_allclose(inertia, true_inertia, atol=0.015 * np.trace(true_inertia))


def test_repr_describes_a_body_in_one_line_also_while_traced(jar):
    body, solid = jar
    size = " x ".join(f"{1e3 * side:.0f}" for side in solid.extents)
    held = rf"holds \S+ kg in {1e6 * solid.volume:.3g} ml"
    assert re.fullmatch(rf"Body\(mesh, {size} mm, \S+ kg, {held}, 480 faces, hull of \d+ points\)", repr(body))
    assert repr(objects.stack([body, body])).startswith("Body(bodies of shape (2,), 1024 faces")
    seen = []
    jax.jit(lambda body: seen.append(repr(body)))(body)
    assert "vertices=float32[1024, 3]" in seen[0]


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("colors", np.nan, r"colors has values that are not finite \(9,216 of 9,216\)"),
        ("shell_mass", np.inf, "shell_mass is inf, but all values must be finite"),
        ("faces", 1024, "faces has indices from 1024 to 1024, but with 1024 vertices"),
        ("category", 8, r"category is 8, but it must be -1 .* or an index into objects.CATEGORIES \(0 to 7\)"),
    ],
)
def test_check_refuses_an_invalid_body_and_names_the_field(name, value, message):
    body = objects.make(jax.random.key(0), "fork")
    body.check()
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(body, **{name: jnp.full_like(getattr(body, name), value)}).check()
    with pytest.raises(ValueError, match=r"shape \(2, 1024, 3\), but it must be \(v, 3\): use jax.vmap for"):
        objects.stack([body, body]).check()


def test_the_gradient_of_rigid_is_finite_and_equals_finite_differences():
    body = objects.make(jax.random.key(2), "camera")
    up = jnp.array([0.6, 0.0, 0.8])
    height = jax.jit(lambda fill: objects.rigid(body, fill, 1.0, up)[1] @ up)
    grad = jax.jit(jax.grad(height))
    assert all(np.isfinite(grad(fill)) for fill in (0.0, 0.3, 1.0))
    np.testing.assert_allclose(grad(0.3), (height(0.32) - height(0.28)) / 0.04, rtol=0.02)
    np.testing.assert_allclose(grad(0.8), (height(0.82) - height(0.78)) / 0.04, rtol=0.02)


def test_stacked_bodies_can_be_mapped_over():
    bodies = [objects.make(jax.random.key(k), c) for k, c in enumerate(("bottle", "fork", "watch"))]
    several = objects.stack(bodies)
    mass, _, _ = jax.vmap(lambda body: objects.rigid(body, 0.5, 1.0))(several)
    np.testing.assert_allclose(mass, [float(objects.rigid(b, 0.5, 1.0)[0]) for b in bodies], rtol=1e-6)
    with pytest.raises(ValueError, match="at least one"):
        objects.stack([])
    with pytest.raises(ValueError, match="arrays of body 1 and body 0 have different shapes"):
        objects.stack([bodies[0], dataclasses.replace(bodies[0], hulls=bodies[0].hulls[:, :4])])


def test_a_mirrored_body_is_that_of_the_mirrored_mesh(jar, tmp_path):
    _, solid = jar
    other = solid.copy()
    other.vertices *= [1, -1, 1]
    other.invert()  # counter-clockwise from outside again
    for name, mesh in (("one", solid), ("other", other)):
        mesh.export(tmp_path / f"{name}.stl")
    body, truth = (objects.load(tmp_path / f"{name}.stl") for name in ("one", "other"))
    got = objects.mirror(body)
    assert surface(got).volume == pytest.approx(solid.volume)
    for a, b in zip(objects.rigid(got, 0.4, 1.1), objects.rigid(truth, 0.4, 1.1), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(np.ptp(got.hulls[0], 0), np.ptp(truth.hulls[0], 0), rtol=1e-5)
    assert (np.einsum("fi,fci->fc", surface(got).face_normals, np.asarray(got.normals)[: len(solid.faces)]) > 0).all()
    for a, b in zip(jax.tree.leaves(body), jax.tree.leaves(objects.mirror(got)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_fills_of_a_box_are_the_closed_form():
    mesh = trimesh.creation.box((0.06, 0.04, 0.1))
    mesh.apply_translation([0.01, 0.02, 0.03])
    interior = jnp.asarray(mesh.triangles, jnp.float32)
    for fill in np.linspace(0, 1, 9):
        volume, centre, second = fill_moments(interior, fill)
        np.testing.assert_allclose(volume, 0.06 * 0.04 * 0.1 * fill, rtol=1e-5, atol=1e-12)
        if fill:
            np.testing.assert_allclose(centre, [0.01, 0.02, -0.02 + 0.05 * fill], atol=1e-6)
        squares = np.array([0.06, 0.04, 0.1 * fill]) ** 2 / 12
        np.testing.assert_allclose(second, float(volume) * np.diag(squares), rtol=1e-4, atol=1e-12)
    assert fill_moments(jnp.zeros((8, 3, 3)), 1.0)[0] == 0


def test_moments_of_a_solid_and_of_a_surface_agree_with_trimesh():
    mesh = trimesh.creation.torus(0.03, 0.012, major_sections=24, minor_sections=10)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1.0, 0.4, 0.2]))
    mesh.apply_translation([0.02, -0.05, 0.04])
    total = solid_moments(mesh.triangles).sum(0)
    np.testing.assert_allclose(total[0], mesh.volume)
    np.testing.assert_allclose(total[1:4] / total[0], mesh.center_mass)
    central = total[4:7] - total[0] * (total[1:4] / total[0]) ** 2
    np.testing.assert_allclose(central.sum() - central, np.diag(mesh.moment_inertia), rtol=1e-6)
    total = surface_moments(mesh.triangles).sum(0)
    points = trimesh.sample.sample_surface(mesh, 200_000, seed=1)[0]
    np.testing.assert_allclose(total[0], mesh.area)
    np.testing.assert_allclose(total[1:4] / total[0], points.mean(0), atol=3e-4)
    np.testing.assert_allclose(total[4:7] / total[0], (points**2).mean(0), atol=3e-5)


def test_corner_normals_are_smooth_on_a_ball_sharp_on_a_box_and_finite_without_area():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    np.testing.assert_allclose(corner_normals(ball.vertices, ball.faces), ball.vertices[ball.faces], atol=2e-2)
    cube = trimesh.creation.box((1.0, 1.0, 1.0))
    normals = corner_normals(cube.vertices, cube.faces)
    np.testing.assert_allclose(normals, np.repeat(cube.face_normals[:, None], 3, axis=1), atol=1e-12)
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]])
    normals = corner_normals(vertices, np.array([[0, 1, 2], [0, 1, 3]]))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1)
