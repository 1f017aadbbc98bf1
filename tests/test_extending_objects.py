"""The code of docs/extending.md runs, and a class from outside the library behaves as the eight do."""

import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from extending_page import blocks

import sts_jax as sts
from sts_jax import dataset, objects
from sts_jax.objects import colors, shapes

NUMBER = 1


def ring(rng: np.random.Generator) -> list[shapes.Part]:
    path = np.column_stack([shapes.circle(30.0, 48), np.zeros(48)])
    rings = shapes.sweep(path, shapes.circle(10.0, 24), (0, 0, 1), closed=True)
    return [shapes.loft(rings, colors.vivid(rng), closed=True, interior=True)]


RING = objects.Family("ring", seed=9, parts=ring)


def test_a_family_makes_the_same_object_by_its_name_and_as_a_value_and_others_with_another_seed():
    key = jax.random.key(3)
    one, same = objects.make(key, f"{__name__}:RING"), objects.make(key, RING)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(same), strict=True))
    assert int(one.category) == -1
    other = objects.make(key, objects.Family("ring", seed=10, parts=ring))
    assert np.abs(np.asarray(one.colors[0] - other.colors[0])).max() > 0.01


def test_area_volume_and_inertia_of_a_torus_are_the_closed_form():
    body = objects.make(jax.random.key(0), RING)
    major, minor = 0.030, 0.010
    area, volume = 4 * np.pi**2 * major * minor, 2 * np.pi**2 * major * minor**2
    np.testing.assert_allclose(body.shell_mass, 1.2 * area, rtol=0.01)
    np.testing.assert_allclose(objects.fill_moments(body.interior, 1.0)[0], volume, rtol=0.02)
    mass, com, inertia = objects.rigid(body, 1.0, 0.0)
    np.testing.assert_allclose(com, 0, atol=2e-4)  # the origin is the centroid of a hull of few vertices
    np.testing.assert_allclose(inertia[2, 2], mass * (major**2 + 3 / 4 * minor**2), rtol=0.02)
    np.testing.assert_allclose(np.ptp(np.asarray(body.vertices), axis=0), [0.08, 0.08, 0.02], rtol=0.01)
    for axis, depth in ((2, 4 / 3 * minor / np.pi), (0, 2 / np.pi * (major + minor**2 / 4 / major))):
        up = np.eye(3, dtype=np.float32)[axis]
        mass, com, _ = objects.rigid(body, 0.5, 0.0, up)  # half of a torus, lower or to one side
        np.testing.assert_allclose(mass, 500 * volume, rtol=0.02)
        np.testing.assert_allclose(com @ up, -depth, rtol=0.02)


@pytest.mark.parametrize(
    ("category", "message"),
    [
        ("teapot", r"category is 'teapot', but it must be one of bottle, .*watch, or 'module:NAME'"),
        ("no_such_module:RING", "module no_such_module cannot be imported .*No module named .*: install it, or start"),
        (f"{__name__}:NUMBER", "variable NUMBER of .* is of type int: assign a Family"),
        (f"{__name__}:ROUND", "variable ROUND of .*test_extending_objects does not exist: assign"),
    ],
)
def test_an_unknown_category_is_refused_before_anything_is_collected(tmp_path, category, message):
    with pytest.raises(ValueError, match=message):
        objects.make(jax.random.key(0), category)
    collection = dataset.Collection(categories=("bottle", category), num_objects=2)
    with pytest.raises(ValueError, match=message):
        dataset.collect(collection, sts.Sensor(), tmp_path / "new")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda parts: [], r"family bad: parts\(\) must return at least one Part, got none"),
        (lambda parts: parts * 2, r"family bad: at most one part can have interior=True, got 2"),
        (lambda parts: shapes.scaled(parts, 0.08), r"longest side must be 5 to 150 mm, got 0\.08 mm: .*millimetres"),
        (lambda parts: shapes.scaled(parts, np.nan), "all vertices must be finite, got nan"),
        (lambda parts: [part._replace(interior=False) for part in parts] * 60, "138,240 faces .* at most 131,072"),
    ],
)
def test_parts_that_make_no_body_are_refused(change, message):
    bad = objects.Family("bad", seed=0, parts=lambda rng: change(ring(rng)))
    with pytest.raises(ValueError, match=message):
        objects.make(jax.random.key(0), bad)


@pytest.mark.slow
def test_the_code_of_the_page_simulates_renders_and_collects_the_new_class(tmp_path, monkeypatch):
    module, *code = blocks("A ninth object class")
    (tmp_path / "torus.py").write_text(module)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "torus", raising=False)
    names: dict = {}
    for block in code:
        exec(block, names)
    assert names["fall"].pose.shape == (4, 60, 7)
    assert 0.01 < np.asarray(names["frame"].segmentation).mean() < 0.6
    data, collection = names["data"], names["collection"]
    assert dataset.class_names(collection) == ("bottle", "torus:TORUS") * 3
    assert data.collection["categories"] == ["bottle", "torus:TORUS"]
    pairs = data.pairs(np.arange(6))
    body = objects.make(jax.random.fold_in(jax.random.key(collection.seed), 1), "torus:TORUS")
    np.testing.assert_array_equal(pairs.support[1], objects.support(body))
    assert dataset.collect(collection, names["sensor"], Path("rings")) == dataset.Collected(0, ())  # nothing to do
