import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapenet_folder
import trimesh
from object_files import surface
from scipy.spatial.transform import Rotation

from sts_jax import objects
from sts_jax.objects.assembly import corner_normals


def hollow(x, y, z):
    """Area of a box and the second moments of this area about its middle, face by face."""
    sizes = np.array([x, y, z])
    area, second = 0.0, np.zeros(3)
    for k in range(3):
        face = 2 * np.prod(np.delete(sizes, k))
        area, second = area + face, second + face * np.where(np.arange(3) == k, sizes**2 / 4, sizes**2 / 12)
    return area, second


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.4, -1.2, 2.0)])
def test_mass_properties_of_a_box_are_the_closed_form(tmp_path, turn):
    sizes, turn = np.array([0.06, 0.04, 0.1]), Rotation.from_rotvec(turn).as_matrix()
    mesh = trimesh.creation.box(sizes)
    mesh.vertices = mesh.vertices @ turn.T + 0.1
    mesh.export(tmp_path / "box.stl")
    body = objects.load(tmp_path / "box.stl")
    area, second = hollow(*sizes)
    for fill, scale in ((0.0, 1.1), (0.13, 0.9), (0.5, 1.1), (0.87, 0.9), (1.0, 1.1)):
        shell, contents = 1.2 * area * scale, 1000 * np.prod(sizes) * fill
        low = np.array([0, 0, (fill - 1) * sizes[2] / 2])  # centre of the contents
        mass, com = shell + contents, contents * low / (shell + contents)
        squares = second * shell / area + contents * (sizes * [1, 1, fill]) ** 2 / 12
        squares += shell * com**2 + contents * (low - com) ** 2
        inertia = turn @ np.diag(squares.sum() - squares) @ turn.T
        got = objects.rigid(body, fill, scale, jnp.asarray(turn[:, 2], jnp.float32))
        np.testing.assert_allclose(got[0], mass, rtol=1e-5)
        np.testing.assert_allclose(got[1], turn @ com, atol=1e-6)
        np.testing.assert_allclose(got[2], inertia, atol=1e-4 * np.trace(inertia))


def test_repr_describes_a_body_in_one_line_also_while_traced():
    body, seen = objects.make(jax.random.key(0), "bottle"), []
    size = " x ".join(f"{1e3 * side:.0f}" for side in surface(body).extents)
    mass = r"\S+ kg, holds \S+ kg in \S+ ml"
    assert re.fullmatch(rf"Body\(bottle, {size} mm, {mass}, \d+ faces, hull of \d+ points\)", repr(body))
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


@pytest.mark.slow
def test_stacked_bodies_can_be_mapped_over():
    bodies = [objects.make(jax.random.key(k), c) for k, c in enumerate(("bottle", "fork", "watch"))]
    several = objects.stack(bodies)
    mass, _, _ = jax.vmap(lambda body: objects.rigid(body, 0.5, 1.0))(several)
    np.testing.assert_allclose(mass, [float(objects.rigid(b, 0.5, 1.0)[0]) for b in bodies], rtol=1e-6)
    with pytest.raises(ValueError, match="arrays of body 1 and body 0 have different shapes"):
        objects.stack([bodies[0], dataclasses.replace(bodies[0], hulls=bodies[0].hulls[:, :4])])


def test_a_mirrored_body_is_that_of_the_mirrored_mesh(tmp_path):
    solid = shapenet_folder.wedge()
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


def test_corner_normals_are_smooth_on_a_ball_sharp_on_a_box_and_finite_without_area():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    np.testing.assert_allclose(corner_normals(ball.vertices, ball.faces), ball.vertices[ball.faces], atol=2e-2)
    cube = trimesh.creation.box((1.0, 1.0, 1.0))
    normals = corner_normals(cube.vertices, cube.faces)
    np.testing.assert_allclose(normals, np.repeat(cube.face_normals[:, None], 3, axis=1), atol=1e-12)
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]])
    normals = corner_normals(vertices, np.array([[0, 1, 2], [0, 1, 3]]))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1)
