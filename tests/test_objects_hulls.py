"""Hulls, resting faces, convex parts, and the gaps between the visible surface and the collision geometry."""

import sys

import jax
import numpy as np
import pytest
import trimesh

from sts_jax import objects
from sts_jax.objects import rest_poses
from sts_jax.objects.hulls import convex_hull, outside_hull
from sts_jax.objects.parts import convex_parts, surface_gaps


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


@pytest.mark.parametrize("limit", [32, 64])
def test_a_die_with_round_edges_keeps_the_faces_on_which_it_rests(limit):
    edges = trimesh.creation.icosphere(subdivisions=2, radius=0.0016).vertices
    points = (trimesh.creation.box((0.0128,) * 3).vertices[:, None] + edges).reshape(-1, 3)
    ups, share = rest_poses(convex_hull(points, limit=limit), np.zeros(3))
    np.testing.assert_allclose(np.abs(ups).max(axis=1), 1, atol=1e-6)
    assert len(share) == 6
    assert share.min() > 0.1


def test_directions_are_a_fibonacci_lattice_on_the_unit_sphere():
    step = np.arange(128) + 0.5
    angle, z = np.pi * (1 + np.sqrt(5)) * step, 1 - 2 * step / 128
    expected = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)
    np.testing.assert_allclose(objects.DIRECTIONS, expected, atol=1e-5)


def test_the_support_of_a_hull_is_the_furthest_corner():
    body = objects.make(jax.random.key(0), "mouse")
    corners = np.asarray(body.hulls, float).reshape(-1, 3)
    np.testing.assert_allclose(objects.support(body), (objects.DIRECTIONS @ corners.T).max(axis=1), atol=1e-7)


def corner_piece() -> trimesh.Trimesh:
    """An L of two arms, 100 and 80 mm long and 20 mm thick, in the plane y = 0. Its cavity is x > 20 mm, z > 20 mm."""
    outline = np.array([[0, 0], [0.1, 0], [0.1, 0.02], [0.02, 0.02], [0.02, 0.08], [0, 0.08]])
    front = np.insert(outline, 1, -0.02, axis=1)
    back = np.insert(outline, 1, 0.02, axis=1)
    caps = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    ring = np.arange(6)
    after = (ring + 1) % 6
    sides = np.concatenate([np.stack([ring, after + 6, after], 1), np.stack([ring, ring + 6, after + 6], 1)])
    return trimesh.Trimesh(np.vstack([front, back]), np.vstack([caps, caps[:, ::-1] + 6, sides]))


def inside(points: np.ndarray, parts: list[np.ndarray]) -> np.ndarray:
    """Whether points are inside any part: the hull of a part and a point inside it has the volume of the part."""
    volumes = [trimesh.convex.convex_hull(part).volume for part in parts]
    grown = [[trimesh.convex.convex_hull(np.vstack([part, point])).volume for part in parts] for point in points]
    return (np.array(grown) <= np.array(volumes) * (1 + 1e-9)).any(axis=1)


def test_parts_leave_the_cavity_free_and_the_hull_does_not():
    mesh = corner_piece()
    free, filled = [[0.03, 0, 0.03], [0.04, 0.01, 0.03], [0.025, 0, 0.05]], [[0.09, 0, 0.01], [0.01, 0, 0.07]]
    parts = convex_parts(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    assert 2 <= len(parts) <= 8
    assert all(4 <= len(part) <= 32 for part in parts)
    assert inside(np.array(free), [mesh.convex_hull.vertices]).all()
    assert not inside(np.array(free), parts).any()
    assert inside(np.array(filled), parts).all()


def test_gaps_of_known_shapes():
    mesh = trimesh.creation.box((0.06, 0.04, 0.02))
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    assert surface_gaps(vertices, faces, [vertices]) == pytest.approx((0, 0), abs=1e-9)
    # A hull 1 mm smaller all round: the corners stick out by its diagonal. One 2 mm higher stands off by as much.
    small = vertices - 0.001 * np.sign(vertices)
    assert surface_gaps(vertices, faces, [small])[0] == pytest.approx(0.001 * 3**0.5, rel=1e-6)
    high = vertices + np.array([0, 0, 0.002]) * (vertices[:, 2:] > 0)
    assert surface_gaps(vertices, faces, [high]) == pytest.approx((0, 0.002), abs=1e-9)
    # Two halves that meet, or lie within, are the whole: their common face is inside.
    halves = [np.where((vertices[:, :1] * sign < 0), [0, 1, 1], 1) * vertices for sign in (1, -1)]
    assert surface_gaps(vertices, faces, halves) == pytest.approx((0, 0), abs=1e-6)


def test_the_gap_of_an_open_sheet_is_measured_on_both_sides():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.04)
    sheet = trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] < 0])
    for faces in (sheet.faces, sheet.faces[:, ::-1]):
        gaps = surface_gaps(np.asarray(sheet.vertices), np.asarray(faces), [np.asarray(sheet.convex_hull.vertices)])
        assert gaps == pytest.approx((0, 0.04), rel=0.05, abs=1e-9)  # the middle of the open side


def test_decomposition_changes_only_the_hulls_and_equal_meshes_have_equal_parts(tmp_path, monkeypatch):
    corner_piece().export(tmp_path / "corner.stl")
    whole, body = objects.load(tmp_path / "corner.stl"), objects.load(tmp_path / "corner.stl", parts=True)
    assert body.hulls.shape == (objects.PART_CLASSES[1], objects.HULL_CLASSES[0], 3)
    assert len(np.unique(np.asarray(body.hulls), axis=0)) == 2
    np.testing.assert_array_equal(body.hulls[2:], np.broadcast_to(body.hulls[1], body.hulls[2:].shape))
    for name in ("vertices", "faces", "colors", "shell_mass", "shell_inertia", "interior", "category"):
        np.testing.assert_array_equal(getattr(body, name), getattr(whole, name))
    np.testing.assert_array_equal(objects.decompose(whole).hulls, body.hulls)
    # On the hull's slanted side from (100, 20) to (20, 80), the point furthest from both arms is equally far from them.
    along = np.linspace(0, 1, 100_001)
    truth = np.minimum(0.06 * along, 0.08 - 0.08 * along).max()
    assert objects.gaps(whole)[1] == pytest.approx(truth, rel=0.01)
    assert max(objects.gaps(body)) < 0.002
    monkeypatch.setitem(sys.modules, "coacd", None)
    with pytest.raises(ImportError, match=r"coacd.*pip install coacd"):
        objects.decompose(whole)


def test_a_library_decomposes_where_the_hull_is_wrong(tmp_path):
    corner_piece().export(tmp_path / "corner.stl")
    trimesh.creation.box((0.06, 0.04, 0.02)).export(tmp_path / "box.stl")
    listed = objects.library(tmp_path, parts=True, cache=tmp_path / "kept")
    box, corner = (objects.read(listed, index) for index in (0, 1))
    assert (len(box.body.hulls), len(corner.body.hulls)) == (1, 8)
    assert objects.decompose(box.body) is box.body
    assert box.gaps == pytest.approx((0, 0), abs=1e-6)
    assert " in 2 parts; " in objects.survey(listed)[1]
    assert objects.read(listed, 1).gaps == corner.gaps
    assert len(objects.read(objects.library(tmp_path, cache=tmp_path / "kept"), 1).body.hulls) == 1
