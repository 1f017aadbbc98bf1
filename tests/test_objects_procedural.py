import jax
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from sts_jax import objects
from sts_jax._checked import check_key
from sts_jax.objects.hulls import outside_hull
from sts_jax.objects.procedural import FAMILIES

KEYS = [3, 17, 400]
SOLID = ("scissors", "fork", "spoon")


def real_faces(body: objects.Body) -> np.ndarray:
    faces = np.asarray(body.faces)
    return faces[faces.any(axis=1)]


@pytest.fixture(scope="module")
def bodies() -> dict[str, list[objects.Body]]:
    return {c: [objects.make(jax.random.key(k), c) for k in KEYS] for c in objects.CATEGORIES}


def test_the_seeds_of_the_families_never_change():
    names = ("bottle", "camera", "webcam", "mouse", "scissors", "fork", "spoon", "watch")
    assert names == objects.CATEGORIES
    assert [(name, family.seed) for name, family in FAMILIES.items()] == list(zip(names, range(8), strict=True))


@pytest.mark.parametrize("category", objects.CATEGORIES)
def test_a_body_fits_its_size_classes_and_the_pad_and_its_hull_consists_of_visible_vertices(bodies, category):
    for body in bodies[category]:
        assert body.vertices.shape == body.faces.shape == (objects.FACE_CLASSES[0], 3)
        assert body.hulls.shape[:2] in {(1, size) for size in objects.HULL_CLASSES}
        assert body.texture.shape == (1, 1, 3)
        assert objects.CATEGORIES[int(body.category)] == category
        body.check()
        vertices, hull = np.asarray(body.vertices, float), np.unique(np.asarray(body.hulls[0], float), axis=0)
        assert 0.050 - 1e-6 <= np.ptp(vertices, axis=0).max() <= 0.130 + 1e-6
        assert outside_hull(vertices, hull).max() < 1e-4
        seen = vertices[np.unique(real_faces(body))]
        assert {tuple(p) for p in hull} <= {tuple(p) for p in seen}


@pytest.mark.parametrize("category", objects.CATEGORIES)
def test_mjx_keeps_every_corner_of_the_hull(bodies, category):
    for body in bodies[category]:
        shape = ConvexHull(np.unique(np.asarray(body.hulls[0], float), axis=0))
        assert (shape.equations[:, 3] < -1e-3).all()  # the origin is inside, by a millimetre and more
        _, face = np.unique(np.round(shape.equations, 4), axis=0, return_inverse=True)
        corners = [len(np.unique(shape.simplices[face.ravel() == i])) for i in range(face.max() + 1)]
        assert max(corners) <= 20  # MJX thins out faces of more


@pytest.mark.parametrize("category", objects.CATEGORIES)
def test_normals_point_outwards_colours_are_in_range_and_the_mass_follows_from_the_area(bodies, category):
    for body in bodies[category]:
        faces, normals, colors = real_faces(body), np.asarray(body.normals, float), np.asarray(body.colors)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-5)
        a, b, c = np.moveaxis(np.asarray(body.vertices, float)[faces], 1, 0)
        flat = np.cross(b - a, c - a)
        assert (np.einsum("fki,fi->fk", normals[: len(faces)], flat) > 0).all()
        assert 0 <= colors.min() <= colors.max() <= 1
        different = len(np.unique(colors[: len(faces)].reshape(-1, 3), axis=0))
        assert different >= (1 if category == "fork" else 2)  # a fork may be all steel
        heaviest = 5.9 if category in (*SOLID, "watch") else 1.2
        assert 0.8 < float(body.shell_mass) / (np.linalg.norm(flat, axis=1).sum() / 2) < heaviest + 1e-6
        assert np.asarray(body.interior).any() == (body.contents_density == 1000) == (category not in SOLID)
        moments = np.linalg.eigvalsh(np.asarray(body.shell_inertia, float))
        assert moments[0] > 0
        assert moments[0] + moments[1] > moments[2] * (1 - 1e-5)


@pytest.mark.parametrize("category", objects.CATEGORIES)
def test_equal_keys_give_equal_objects_and_other_keys_others(bodies, category):
    one, other, _ = bodies[category]
    again = objects.make(jax.random.key(KEYS[0]), category)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(again), strict=True))
    assert not np.array_equal(one.vertices, other.vertices)


@pytest.mark.parametrize("category", objects.CATEGORIES)
def test_a_body_is_stable_in_the_attitude_in_which_it_is_made(bodies, category):
    for body in bodies[category]:
        hull = np.asarray(body.hulls[0], float)
        foot = hull[hull[:, 2] < hull[:, 2].min() + 1.5e-3, :2]
        for fill in (0.0, 0.5, 1.0):
            com = np.asarray(objects.rigid(body, fill, 1.0)[1], float)
            around = np.sort(np.arctan2(*(foot - com[:2]).T))
            assert np.diff(np.append(around, around[0] + 2 * np.pi)).max() < np.pi  # the balance is over the foot


def test_a_key_of_the_older_kind_is_accepted_and_several_keys_are_refused():
    old, new = objects.make(jax.random.PRNGKey(3), "bottle"), objects.make(jax.random.key(3), "bottle")
    np.testing.assert_array_equal(old.vertices, new.vertices)
    with pytest.raises(TypeError, match=r"key has shape \(2,\), but it must be one key"):
        check_key(jax.random.split(jax.random.key(0)))
