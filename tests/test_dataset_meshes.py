"""Datasets of mesh files: usable objects are collected, and all others are left out with a reason."""

import dataclasses

import numpy as np
import pytest
import trimesh

import sts_jax as sts
from sts_jax import dataset, physics

pytestmark = pytest.mark.slow

SCENARIO = physics.Perturbed(frames=3)


@pytest.fixture
def folder(tmp_path):
    """Three boxes, three cans, a leaning can that falls over by itself, and a torn file."""
    for i in range(3):
        for label, mesh in (
            ("box", trimesh.creation.box((0.03 + 0.01 * i, 0.04, 0.05))),
            ("can", trimesh.creation.cylinder(0.02 + 0.005 * i, 0.06, sections=12)),
        ):
            (tmp_path / label).mkdir(exist_ok=True)
            mesh.export(tmp_path / label / f"{i}.stl")
    leaning = trimesh.creation.box((0.02, 0.02, 0.08))
    leaning.vertices[:, 0] += 0.8 * leaning.vertices[:, 2]
    leaning.export(tmp_path / "can" / "leaning.stl")
    (tmp_path / "box" / "torn.stl").write_bytes((tmp_path / "box" / "0.stl").read_bytes()[:200])
    return tmp_path


def collection(meshes: dataset.Meshes) -> dataset.Collection:
    return dataset.Collection(SCENARIO, meshes=meshes, num_objects=6, num_per_object=1, num_full=0, objects_per_shard=3)


def test_usable_objects_and_others_are_listed(folder):
    lines: list[str] = []
    meshes, listing = dataset.survey_meshes(folder, SCENARIO, progress=lines.append)
    assert meshes.names == tuple(f"{label}/{i}.stl" for label in ("box", "can") for i in range(3))
    assert meshes.labels == ("box",) * 3 + ("can",) * 3
    assert "box/torn.stl" in listing
    assert "can/leaning.stl: left out of Perturbed: it does not stand upright" in listing
    assert len(lines) == 8
    on_slope, _ = dataset.survey_meshes(folder, physics.Inclined())
    assert "can/leaning.stl" in on_slope.names

    one = collection(meshes)
    assert dataset.class_names(one) == meshes.labels
    bodies = dataset.make_bodies(one, np.array([2, 4]))
    np.testing.assert_allclose(np.ptp(bodies[0].vertices, axis=0), [0.05, 0.04, 0.05], atol=1e-6)
    np.testing.assert_allclose(np.ptp(bodies[1].vertices, axis=0)[2], 0.06, atol=1e-6)

    half, _ = dataset.survey_meshes(folder, SCENARIO, classes=("box",), scale=0.5, up="y")
    small = dataset.make_bodies(collection(half), np.array([2]))[0]
    np.testing.assert_allclose(np.ptp(small.vertices, axis=0), [0.025, 0.025, 0.02], atol=1e-6)

    cans, listing = dataset.survey_meshes(folder, SCENARIO, classes=("can",))
    assert set(cans.labels) == {"can"}
    assert "torn" not in listing
    with pytest.raises(ValueError, match=r"`classes` contains cup, but .* has box, can"):
        dataset.survey_meshes(folder, SCENARIO, classes=("can", "cup"))

    (folder / "box" / "1.stl").write_bytes((folder / "box" / "2.stl").read_bytes())
    assert dataset.survey_meshes(folder, SCENARIO)[0].digest != meshes.digest


def test_the_limits_follow_the_pad_of_the_sensor(tmp_path):
    """A box of 60 mm is scaled down for a pad of 50 mm, a cube of 3 mm is accepted there, and one of 10 mm as well."""
    for side in (3, 10, 60):
        trimesh.creation.box([side * 1e-3] * 3).export(tmp_path / f"{side:02d}.stl")
    usual, _ = dataset.survey_meshes(tmp_path, SCENARIO)
    assert usual.names == ("10.stl", "60.stl")
    meshes, listing = dataset.survey_meshes(tmp_path, SCENARIO, pad=0.05)
    assert meshes.names == ("03.stl", "10.stl", "60.stl")
    assert "scaled down to 0.04 m" in listing
    one = dataclasses.replace(collection(meshes), num_objects=3)
    sides = [np.ptp(body.vertices, axis=0)[0] for body in dataset.make_bodies(one, np.arange(3))]
    np.testing.assert_allclose(sides, [0.003, 0.01, 0.04], rtol=1e-5)


def test_one_mesh_under_several_names_is_one_object(tmp_path):
    """Otherwise it could be trained on under one name and tested on under another."""
    mesh = trimesh.creation.icosphere(2, 0.02)
    mesh.vertices *= [1.0, 1.3, 0.8]
    mesh.export(tmp_path / "a.stl")
    (tmp_path / "b.stl").write_bytes((tmp_path / "a.stl").read_bytes())
    order = np.random.default_rng(0).permutation(len(mesh.faces))
    trimesh.Trimesh(mesh.vertices, mesh.faces[order]).export(tmp_path / "c.obj")  # decimal numbers, another order
    mesh.vertices[0] *= 1.05  # nearly the same is another object
    mesh.export(tmp_path / "d.stl")
    meshes, listing = dataset.survey_meshes(tmp_path, physics.Inclined())
    assert meshes.names == ("a.stl", "d.stl")
    assert "b.stl: the same mesh as a.stl, left out\n" in listing
    assert "c.obj: the same mesh as a.stl, left out\n" in listing


def test_objects_that_are_gone_or_cannot_be_simulated_are_left_out_and_the_others_are_collected(
    folder, tmp_path_factory, monkeypatch
):
    one = collection(dataset.survey_meshes(folder, SCENARIO)[0])
    (folder / "can" / "1.stl").unlink()
    simulate = physics.simulate

    def stumbles(key, bodies, *args, **kwargs):
        for index, body in enumerate(bodies):
            if np.ptp(body.vertices[:, 0]) == pytest.approx(0.04) and np.ptp(body.vertices[:, 2]) < 0.055:
                raise physics.BodyError(index, "trajectory 0 is non-finite")
        return simulate(key, bodies, *args, **kwargs)

    monkeypatch.setattr(physics, "simulate", stumbles)
    out = tmp_path_factory.mktemp("out") / "dataset"
    made = dataset.collect(one, sts.Sensor(), out)
    stumbled, gone = made.left_out
    assert stumbled == "object 1 (box/1.stl): trajectory 0 is non-finite"
    assert gone.startswith("object 4 (can/1.stl): ")
    assert "no longer has can/1.stl: restore" in gone
    assert dataset.collect(one, sts.Sensor(), out) == made  # nothing is left to do, and the result is the same
    data = dataset.load(out)
    np.testing.assert_array_equal(data.trajectory["body"], [0, 2, 3, 5])
    pairs = data.pairs(np.arange(4))
    bodies = dataset.make_bodies(one, data.trajectory["body"])
    group = (dataset.frames_per_call(), 1)  # copies of one frame, because the collection has compiled this program
    for row, (body, wrench) in enumerate(zip(bodies, data.trajectory["wrench"], strict=True)):
        motion = np.tile(pairs.pose[row, :1], group), np.tile(wrench[:1], group)
        shown = dataset.render_uint8(sts.Sensor(), body, *motion, resolution=(64, 64), crop=False)
        assert np.mean(np.asarray(shown[0][0]) != pairs.visual[row, 0]) < 0.01


def test_a_folder_without_usable_objects_and_a_wrong_number_are_refused(folder, tmp_path):
    for path in folder.rglob("*.stl"):
        if "leaning" not in path.name:
            path.unlink()
    with pytest.raises(ValueError, match=r"(?s)no object that can be used.*does not stand upright"):
        dataset.survey_meshes(folder, SCENARIO)
    meshes = dataset.Meshes(str(folder), ("a.stl",) * 5, ("a",) * 5, "")
    wrong = dataclasses.replace(collection(meshes), num_objects=4)
    with pytest.raises(ValueError, match="num_objects=4, but `meshes` has 5 objects"):
        dataset.collect(wrong, sts.Sensor(), tmp_path / "out")
