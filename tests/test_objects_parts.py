"""Convex parts, and the gaps between the visible surface and the collision geometry."""

import sys

import numpy as np
import pytest
import trimesh

from sts_jax import objects
from sts_jax.objects.parts import convex_parts, surface_gaps

pytestmark = pytest.mark.slow


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
    with pytest.raises(ImportError, match=r"coacd.*install -e '\.\[meshes\]'"):
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
