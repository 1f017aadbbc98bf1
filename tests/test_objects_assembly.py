import numpy as np
import trimesh

from sts_jax.objects.assembly import corner_normals


def test_corner_normals_are_smooth_on_a_ball_and_sharp_on_a_box():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    normals = corner_normals(ball.vertices, ball.faces)
    np.testing.assert_allclose(normals, ball.vertices[ball.faces], atol=2e-2)
    cube = trimesh.creation.box((1.0, 1.0, 1.0))
    normals = corner_normals(cube.vertices, cube.faces)
    np.testing.assert_allclose(normals, np.repeat(cube.face_normals[:, None], 3, axis=1), atol=1e-12)


def test_corner_normals_of_faces_without_area_are_finite():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]])
    normals = corner_normals(vertices, np.array([[0, 1, 2], [0, 1, 3]]))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1)
