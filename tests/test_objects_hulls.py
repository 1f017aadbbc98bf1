import math

import jax
import numpy as np
import pytest
import trimesh

from sts_jax import objects
from sts_jax.objects import rest_poses
from sts_jax.objects.hulls import convex_hull, outside_hull


def test_a_box_rests_on_six_faces_and_a_leaning_one_on_those_below_its_balance():
    corners = trimesh.creation.box((0.06, 0.04, 0.1)).vertices
    ups, share = rest_poses(corners, np.zeros(3))
    np.testing.assert_allclose(sorted(map(tuple, ups)), sorted(map(tuple, np.r_[np.eye(3), -np.eye(3)])), atol=1e-9)
    # The solid angle of a rectangle a x b at distance d: 4 atan(a b / (4 d sqrt(d^2 + a^2 / 4 + b^2 / 4))).
    for up, part in zip(ups, share, strict=True):
        d = np.array([0.06, 0.04, 0.1]) @ np.abs(up) / 2
        a, b = np.array([0.06, 0.04, 0.1])[np.abs(up) < 0.5]
        solid = 4 * np.arctan(a * b / (4 * d * np.sqrt(d**2 + a**2 / 4 + b**2 / 4)))
        np.testing.assert_allclose(part, solid / (4 * np.pi), rtol=1e-6)
    sheared = corners + np.outer(corners[:, 2] + 0.05, [0.5, 0, 0])  # the balance is over 25 mm of 30
    assert max(rest_poses(sheared, np.array([0.025, 0, 0]))[0] @ [0, 0, 1]) > 0.99
    assert max(rest_poses(sheared, np.array([0.032, 0, 0]))[0] @ [0, 0, 1]) < 0.99


def test_a_hull_within_the_limit_is_exact_and_a_simplified_one_keeps_the_outermost_vertices():
    points = trimesh.creation.box((0.1, 0.05, 0.02)).subdivide().subdivide().vertices
    hull = convex_hull(points)
    assert len(hull) == 8
    assert outside_hull(points, hull).max() < 1e-12
    points = trimesh.creation.icosphere(subdivisions=4, radius=0.05).vertices
    hull = convex_hull(points)
    assert len(hull) == 64
    assert 1e-3 < outside_hull(points, hull).max() < 4e-3  # a sphere is the worst there is
    assert {tuple(p) for p in hull} <= {tuple(p) for p in points}
    with pytest.raises(ValueError, match="plane"):
        convex_hull(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]))


def test_outside_hull_is_the_distance():
    hull = trimesh.creation.box((2.0, 2.0, 2.0)).vertices
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.5, 0, 0], [1.3, 1.4, 0], [2.0, 2, 2]])
    np.testing.assert_allclose(outside_hull(points, hull), [0, 0, 0.5, 0.5, np.sqrt(3)], atol=1e-9)


def test_directions_are_unit_vectors_spread_over_the_sphere():
    directions = objects.DIRECTIONS
    assert (directions.shape, directions.dtype) == ((128, 3), np.float32)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(directions.mean(0), 0, atol=0.01)
    np.testing.assert_allclose(directions.T @ directions / 128, np.eye(3) / 3, atol=0.01)
    step = 37.5
    angle, z = math.pi * (1 + math.sqrt(5)) * step, 1 - 2 * step / 128
    expected = [math.sqrt(1 - z * z) * math.cos(angle), math.sqrt(1 - z * z) * math.sin(angle), z]
    np.testing.assert_allclose(directions[37], expected, atol=1e-6)


def test_the_support_of_a_hull_is_the_furthest_corner():
    body = objects.make(jax.random.key(0), "mouse")
    corners = np.asarray(body.hulls, float).reshape(-1, 3)
    np.testing.assert_allclose(objects.support(body), (objects.DIRECTIONS @ corners.T).max(axis=1), atol=1e-7)
