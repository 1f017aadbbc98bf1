"""Geometry of mesh files: polygons, orientation, repeated faces, thick walls, size and mass."""

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from object_files import surface

from sts_jax import geometry, objects
from sts_jax.objects.polygons import cut

# Outlines (mm), counter-clockwise: concave, with straight and repeated corners, with a hole, and touching itself.
OUTLINES = {
    "letter": [[0, 0], [60, 0], [60, 15], [15, 15], [15, 45], [60, 45], [60, 60], [0, 60]],
    "dart": [[10, 10], [0, 40], [0, 0], [40, 0]],
    "straight": [[0, 0], [20, 0], [30, 0], [30, 30], [15, 10], [0, 30], [0, 20], [0, 10]],
    "repeated": [[0, 0], [40, 0], [40, 0], [10, 10], [10, 10], [0, 40], [0, 40]],
    "hole": [[0, 0], [40, 0], [40, 40], [0, 40], [0, 0], [10, 10], [10, 30], [30, 30], [30, 10], [10, 10]],
    "bridge": [
        [0, 0],
        [40, 0],
        [40, 40],
        [0, 40],
        [0, 20],
        [8, 20],
        [8, 30],
        [32, 30],
        [32, 10],
        [8, 10],
        [8, 20],
        [0, 20],
    ],
    "touching": [[0, 0], [40, 0], [40, 40], [20, 0], [0, 40]],
}


def volume(body: objects.Body) -> float:
    """Volume that the contents can fill (m^3)."""
    return float(np.linalg.det(np.asarray(body.interior, float)).sum()) / 6


def shoelace(outline: np.ndarray) -> float:
    x, y = outline.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def prism(outline: list[list[int]], height: float = 0.01) -> tuple[np.ndarray, list[list[int]]]:
    """Vertices (m) and polygons of a prism over an outline (mm)."""
    flat = np.array(outline, float) * 1e-3
    low, number = np.c_[flat, np.zeros(len(flat))], len(flat)
    sides = [[i, (i + 1) % number, number + (i + 1) % number, number + i] for i in range(number)]
    return np.concatenate([low, np.add(low, [0, 0, height])]), [
        list(range(number))[::-1],
        list(range(number, 2 * number)),
        *sides,
    ]


def write(path: Path, vertices: np.ndarray, polygons: list[list[int]]) -> Path:
    """Write polygons as OBJ, OFF, PLY in ASCII (.a.ply) or binary PLY."""
    rows = [" ".join(map(repr, map(float, vertex))) for vertex in vertices]
    sized = [" ".join(map(str, [len(polygon), *polygon])) for polygon in polygons]
    head = [f"element vertex {len(rows)}", *(f"property float {axis}" for axis in "xyz")]
    head += [f"element face {len(sized)}", "property list uchar int vertex_indices", "end_header"]
    if path.suffix == ".obj":
        counted = [[i - len(rows) for i in polygon] for polygon in polygons[:2]]  # indices that count backwards
        counted += [[i + 1 for i in polygon] for polygon in polygons[2:]]
        path.write_text("\n".join([*("v " + row for row in rows), *("f " + " ".join(map(str, f)) for f in counted)]))
    elif path.suffix == ".off":
        path.write_text("\n".join(["OFF", f"{len(rows)} {len(sized)} 0", *rows, *sized]))
    elif ".a." in path.name:
        path.write_text("\n".join(["ply", "format ascii 1.0", *head, *rows, *sized]) + "\n")
    else:
        faces = (struct.pack(f">B{len(polygon)}i", len(polygon), *polygon) for polygon in polygons)
        top = "\n".join(["ply", "format binary_big_endian 1.0", *head]).encode() + b"\n"
        path.write_bytes(top + vertices.astype(">f4").tobytes() + b"".join(faces))
    return path


@pytest.mark.parametrize("kind", ["x.obj", "x.off", "x.a.ply", "x.ply"])
@pytest.mark.parametrize("name", OUTLINES)
def test_a_prism_over_a_concave_outline_has_the_volume_and_area_of_its_formula(tmp_path, name, kind):
    outline = np.array(OUTLINES[name]) * 1e-3
    body = objects.load(write(tmp_path / kind, *prism(OUTLINES[name])), density=2.0, strict=True)
    around = np.linalg.norm(outline - np.roll(outline, -1, axis=0), axis=1).sum()
    np.testing.assert_allclose(volume(body), shoelace(outline) * 0.01, rtol=1e-4)
    np.testing.assert_allclose(body.shell_mass, 2 * (2 * shoelace(outline) + around * 0.01), rtol=1e-4)


def test_any_polygon_is_cut_whatever_its_plane_and_bend():
    rng = np.random.default_rng(0)
    angle = np.sort(rng.uniform(0, 2 * np.pi, 80))
    star = np.stack([np.cos(angle), np.sin(angle)], axis=1) * rng.uniform(0.3, 1, (80, 1))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    for bend, exact in ((0.0, 1e-9), (0.05, 0.05)):
        points = np.c_[star, bend * star[:, 0] ** 2] @ turn.T + 5
        triangles = points[cut(points, [len(points)])]
        area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
        assert area.sum() / 2 == pytest.approx(shoelace(star), rel=exact)
        same = {frozenset(map(tuple, triangle)) for triangle in triangles}
        for again in (np.roll(points, 7, axis=0), points[::-1]):
            assert {frozenset(map(tuple, triangle)) for triangle in again[cut(again, [len(again)])]} == same


def test_polygons_are_cut_together_as_each_alone():
    """Convex and concave ones of three to seven corners, one at a point, one with NaN, and two without a face."""
    rng, polygons = np.random.default_rng(0), []
    for size in rng.integers(3, 8, 200):
        angle = 2 * np.pi * (np.arange(size) + rng.uniform(0, 0.4, size)) / size
        radius = np.where(rng.random(size) < 0.1, 0.3, 1)
        flat = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)
        polygons.append(flat[:: rng.choice([-1, 1])] @ np.linalg.qr(rng.normal(size=(3, 3)))[0])
    polygons += [np.zeros((5, 3)), np.full((4, 3), np.nan), np.eye(3)[:2], np.zeros((0, 3)), np.eye(3)]
    sizes = [len(polygon) for polygon in polygons]
    alone = [cut(polygon, [size]) for polygon, size in zip(polygons, sizes, strict=True)]
    together = cut(np.concatenate(polygons), sizes)
    starts = np.repeat(np.cumsum(sizes) - sizes, list(map(len, alone)))
    np.testing.assert_array_equal(together, np.concatenate(alone) + starts[:, None])


def test_a_polygon_that_crosses_itself_is_refused(tmp_path):
    vertices, polygons = prism([[0, 0], [40, 40], [40, 0], [0, 30]])
    with pytest.raises(ValueError, match=r"x\.obj: .*a face of 4 corners near .* crosses itself: split it"):
        objects.load(write(tmp_path / "x.obj", vertices, polygons))


def test_the_triangles_of_a_ply_polygon_keep_its_colours(tmp_path):
    vertices, polygons = prism(OUTLINES["letter"])
    path = write(tmp_path / "x.a.ply", vertices, polygons)
    text = path.read_text().replace(
        "end_header", "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header"
    )
    lines = text.splitlines()
    first = len(lines) - len(polygons)
    lines[first:] = [f"{line} {255 * (row == 1)} 0 {255 * (row != 1)}" for row, line in enumerate(lines[first:])]
    path.write_text("\n".join(lines) + "\n")
    body = objects.load(path)
    drawn = surface(body)
    top = (drawn.triangles[..., 2] > drawn.vertices[:, 2].mean()).all(axis=1)
    np.testing.assert_allclose(np.asarray(body.colors)[: len(top), :, 0], np.tile(top[:, None], 3), atol=1e-6)
    assert top.sum() == 6


def box(*size: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0), inward: bool = False) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(np.array(size) * 1e-3, trimesh.transformations.translation_matrix(np.array(at) * 1e-3))
    if inward:
        mesh.invert()
    return mesh


def saved(folder: Path, *meshes: trimesh.Trimesh) -> Path:
    trimesh.util.concatenate(meshes).export(folder / "mesh.ply")
    return folder / "mesh.ply"


@pytest.mark.parametrize("outer", [False, True])
@pytest.mark.parametrize("inner", [False, True])
def test_each_closed_part_is_turned_outwards_and_a_cavity_inwards(tmp_path, outer, inner):
    cavity, beside = box(30, 20, 10, inward=inner), box(20, 20, 20, at=(50, 0, 0), inward=inner)
    body = objects.load(saved(tmp_path, box(60, 40, 30, inward=outer), cavity, beside), strict=True)
    assert volume(body) == pytest.approx((60 * 40 * 30 - 30 * 20 * 10 + 20**3) * 1e-9, rel=1e-5)
    assert surface(body).volume == pytest.approx(volume(body), rel=1e-5)
    assert not body.two_sided


def test_reversed_faces_within_a_part_are_turned_and_keep_their_colours(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    paint = np.where(ball.vertices[:, 2:] > 0, [[255, 0, 0, 255]], [[0, 0, 255, 255]])
    ball.visual.vertex_colors = paint
    truth = ball.volume
    ball.faces = np.where(
        np.random.default_rng(0).random(len(ball.faces))[:, None] < 0.3, ball.faces[:, ::-1], ball.faces
    )
    body = objects.load(saved(tmp_path, ball), strict=True)
    assert volume(body) == pytest.approx(truth, rel=1e-5)
    drawn = surface(body)
    red = np.asarray(body.colors)[: len(drawn.faces), :, 0]
    np.testing.assert_allclose(
        red[abs(drawn.triangles[..., 2]) > 1e-5], (drawn.triangles[..., 2] > 0)[abs(drawn.triangles[..., 2]) > 1e-5]
    )


@pytest.mark.parametrize("inward", [False, True])
def test_repeated_faces_of_a_closed_surface_are_dropped_with_a_warning(tmp_path, inward):
    once = objects.load(saved(tmp_path, box(60, 40, 30)))
    with pytest.warns(UserWarning, match=r"mesh\.ply: 12 repeated faces are dropped"):
        twice = objects.load(saved(tmp_path, box(60, 40, 30), box(60, 40, 30, inward=inward)), strict=True)
    assert volume(twice) == pytest.approx(volume(once))
    assert twice.shell_mass == once.shell_mass


def test_the_two_sides_of_an_open_sheet_stay(tmp_path):
    bowl = trimesh.creation.icosphere(subdivisions=2, radius=0.04)
    bowl.update_faces(bowl.triangles_center[:, 2] < 0)
    behind = bowl.copy()
    behind.invert()
    one = objects.load(saved(tmp_path, bowl), mass=0.1)
    both = objects.load(saved(tmp_path, bowl, behind), mass=0.1)
    assert len(surface(both).faces) == 2 * len(surface(one).faces)


def test_repeated_polygons_are_dropped_whatever_their_first_corner(tmp_path):
    vertices, polygons = prism(OUTLINES["letter"])
    again = [polygon[3:] + polygon[:3] for polygon in polygons[::2]] + [polygon[::-1] for polygon in polygons[1::2]]
    with pytest.warns(UserWarning, match="28 repeated faces are dropped"):
        body = objects.load(write(tmp_path / "x.obj", vertices, polygons + again))
    assert volume(body) == pytest.approx(shoelace(np.array(OUTLINES["letter"]) * 1e-3) * 0.01, rel=1e-4)


def test_the_origin_of_the_file_places_a_body_by_the_frame_of_its_file(tmp_path):
    mesh = box(60, 40, 30, at=(100, -20, 5))
    body = objects.load(saved(tmp_path, mesh), up="y")
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # y of the file is z of the body
    frame = np.array([0.01, 0.02, 0.03, 0.8, 0, 0.6, 0])  # pose of the turned frame of the file
    pose = geometry.pose_multiply(frame, np.array([*-np.asarray(body.origin), 1, 0, 0, 0]))
    placed = np.asarray(geometry.transform(pose, surface(body).vertices.astype(np.float32)))
    truth = np.asarray(geometry.transform(frame, (mesh.vertices @ turn.T).astype(np.float32)))
    np.testing.assert_allclose(np.sort(placed, axis=0), np.sort(truth, axis=0), atol=1e-6)
    np.testing.assert_allclose(objects.mirror(body).origin, body.origin * np.array([1, -1, 1]))


@pytest.mark.parametrize("kind", ["obj", "stl", "glb"])
@pytest.mark.parametrize(("side", "pad"), [(5, 150), (150, 150), (1, 30), (30, 30), (300, 300)])
def test_cubes_of_the_limits_of_a_pad_are_accepted(tmp_path, kind, side, pad):
    box(side, side, side, at=(7.7, 3.1, 0.3)).export(tmp_path / f"cube.{kind}")
    body = objects.load(tmp_path / f"cube.{kind}", pad=pad * 1e-3)
    assert np.ptp(surface(body).vertices, axis=0) == pytest.approx(side * 1e-3, rel=1e-5)
    objects.load(tmp_path / f"cube.{kind}", longest_side=side * 1e-3, pad=pad * 1e-3)


@pytest.mark.parametrize(
    ("size", "arguments", "message"),
    [
        ((31, 10, 10), {"pad": 0.03}, r"longest side is 0\.031 m, but it must be at most 0\.03 m, the width of the"),
        ((4.9, 3, 3), {}, "longest side is 4.9 mm, but it must be at least 5 mm"),
        ((60, 40, 30), {"pad": 0.0}, "pad must be a positive number of metres"),
        ((60, 40, 30), {"mass": 300.0}, r"mass=300 makes an object of 300 kg in 72 ml, .* lead: mass is in kilograms"),
        ((60, 40, 30), {"density": 7800.0}, r"density=7800 .* lead: density is in kilograms per square metre"),
        ((86, 54, 0.02), {}, r"the object is 0\.02 mm thick, .* at least 0\.1 mm: thicken the mesh"),
        ((86, 54, 1e-4), {"mass": 0.001}, r"the object is 0\.0001 mm thick"),
        ((86, 0.05, 0.05), {}, r"the object is 0\.05 mm thick"),
    ],
)
def test_an_impossible_size_mass_or_thickness_is_named(tmp_path, size, arguments, message):
    box(*size).export(tmp_path / "x.obj")
    with pytest.raises(ValueError, match=rf"x\.obj: (the )?{message}"):
        objects.load(tmp_path / "x.obj", **arguments)


def test_a_dense_body_of_lead_is_accepted(tmp_path):
    assert objects.load(saved(tmp_path, box(20, 20, 20)), mass=0.09).shell_mass == pytest.approx(0.09)


SECTIONS = 32


def lathe(*outline: tuple[float, float]) -> trimesh.Trimesh:
    """A solid of revolution of an outline (mm), counter-clockwise."""
    return trimesh.creation.revolve(np.array(outline) * 1e-3, sections=SECTIONS)


def disc(radius: float) -> float:
    """Area of a section of a `lathe` (mm^2)."""
    return SECTIONS / 2 * np.sin(2 * np.pi / SECTIONS) * radius**2


CUP = lathe((0, 0), (30, 0), (30, 80), (28, 80), (28, 4), (0, 4))


@pytest.mark.parametrize("turn", [(0, (1, 0, 0)), (90, (1, 0, 0)), (180, (1, 0, 0)), (90, (0, 1, 0))])
def test_contents_fill_the_cavity_of_a_cup_whose_wall_counts_once(tmp_path, turn):
    cup = CUP.copy()
    cup.apply_transform(trimesh.transformations.rotation_matrix(np.deg2rad(turn[0]), turn[1]))
    body = objects.load(saved(tmp_path, cup), density=2.0, strict=True)
    assert volume(body) == pytest.approx(disc(28) * 76e-9, rel=1e-4)
    assert body.shell_mass == pytest.approx(cup.area, rel=1e-5)  # 2 kg/m^2 on one of two sides
    for up in ((0.0, 0.0, 1.0), (0.6, 0.0, 0.8)):
        assert objects.fill_moments(body.interior, 0.5, up)[0] == pytest.approx(disc(28) * 38e-9, rel=1e-3)


@pytest.mark.parametrize(
    ("mesh", "content"),
    [
        (lathe((0, 0), (30, 0), (30, 80), (20, 80), (20, 10), (0, 10)), disc(20) * 70),  # thicker than the cavity
        (lathe((0, 0), (30, 0), (30, 60), (12, 80), (12, 100), (10, 100), (10, 80), (28, 60), (28, 3), (0, 3)), None),
        (
            trimesh.util.concatenate(
                [lathe((0, 0), (30, 0), (30, 80), (0, 80)), lathe((0, 2), (28, 2), (28, 78), (0, 78))]
            ),
            disc(28) * 76,
        ),
        (trimesh.creation.torus(0.03, 0.01), trimesh.creation.torus(0.03, 0.01).volume * 1e9),  # holds nothing
    ],
    ids=["thick", "bottle", "sealed", "torus"],
)
def test_contents_of_other_shapes(tmp_path, mesh, content):
    if content is None:  # of the bottle: a cylinder, a cone and the neck
        content = disc(28) * 57 + (disc(28) + disc(10) + disc(1) * 280) * 20 / 3 + disc(10) * 20
    assert volume(objects.load(saved(tmp_path, mesh), strict=True)) == pytest.approx(content * 1e-9, rel=1e-4)


def test_an_uneven_rim_spills_at_its_lowest_point(tmp_path):
    cup = CUP.copy()
    x, y, z = cup.vertices.T
    cup.vertices = np.c_[x, y, z + np.where(z > 0.079, 0.004 * np.sin(2 * np.arctan2(y, x)), 0)]
    assert volume(objects.load(saved(tmp_path, cup))) == pytest.approx(disc(28) * 72e-9, rel=2e-3)


def test_a_solid_cup_and_a_cup_of_a_mass_hold_nothing(tmp_path):
    for arguments in ({"mass": 0.2}, {"hollow": False}):
        assert objects.load(saved(tmp_path, CUP), **arguments).contents_density == 0
