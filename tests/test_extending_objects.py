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


@pytest.fixture
def code(tmp_path, monkeypatch) -> list[str]:
    """The code of the page after its first block, which becomes the module `torus` in the working directory."""
    module, *rest = blocks("A ninth object class")
    (tmp_path / "torus.py").write_text(module)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "torus", raising=False)
    return rest


def ring(rng: np.random.Generator) -> list[shapes.Part]:
    path = np.column_stack([shapes.circle(30.0, 48), np.zeros(48)])
    rings = shapes.sweep(path, shapes.circle(10.0, 24), (0, 0, 1), closed=True)
    return [shapes.loft(rings, colors.vivid(rng), closed=True, interior=True)]


RING = objects.Family("ring", seed=9, parts=ring)


def test_a_family_gives_the_same_object_by_its_name_and_as_a_value():
    one = objects.make(jax.random.key(3), f"{__name__}:RING")
    other = objects.make(jax.random.key(3), objects.find_family(f"{__name__}:RING"))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)
    assert int(one.category) == -1


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


def test_families_with_different_seeds_draw_different_numbers():
    same, other = (objects.Family("ring", seed=seed, parts=ring) for seed in (9, 10))
    key = jax.random.key(0)
    colour = [np.asarray(objects.make(key, family).colors[0]) for family in (RING, same, other)]
    np.testing.assert_array_equal(colour[0], colour[1])
    assert np.abs(colour[0] - colour[2]).max() > 0.01


@pytest.mark.parametrize(
    ("category", "message"),
    [
        ("teapot", r"category is 'teapot', but it must be one of bottle, .*watch, or 'module:NAME'"),
        ("torus:", "category is 'torus:', but it must be one of"),
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
        (lambda parts: shapes.scaled(parts, 160), "longest side must be 5 to 150 mm, got 160 mm"),
        (lambda parts: shapes.scaled(parts, np.nan), "all vertices must be finite, got nan"),
        (lambda parts: [part._replace(interior=False) for part in parts] * 60, "138,240 faces .* at most 131,072"),
    ],
)
def test_parts_that_make_no_body_are_refused(change, message):
    bad = objects.Family("bad", seed=0, parts=lambda rng: change(ring(rng)))
    with pytest.raises(ValueError, match=message):
        objects.make(jax.random.key(0), bad)


@pytest.mark.parametrize("seed", [-1, True])
def test_an_invalid_seed_is_refused(seed):
    with pytest.raises(ValueError, match=f"family ring: seed must be a whole number >= 0, got {seed!r}"):
        objects.Family("ring", seed, ring)


@pytest.mark.slow
def test_the_code_of_the_page_simulates_renders_and_collects_the_new_class(code):
    names: dict = {}
    for block in code:
        exec(block, names)
    assert names["fall"].pose.shape == (4, 60, 7)
    seen = np.asarray(names["frame"].segmentation)
    assert 0.01 < seen.mean() < 0.6
    data, collection = names["data"], names["collection"]
    assert dataset.class_names(collection) == ("bottle", "torus:TORUS") * 3
    assert data.collection["categories"] == ["bottle", "torus:TORUS"]
    np.testing.assert_array_equal(data.trajectory["body"], np.arange(6))
    pairs = data.pairs(np.arange(6))
    body = objects.make(jax.random.fold_in(jax.random.key(collection.seed), 1), "torus:TORUS")
    np.testing.assert_array_equal(pairs.support[1], objects.support(body))
    assert pairs.visual.std(axis=(2, 3)).min() > 0
    assert dataset.collect(collection, names["sensor"], Path("rings")) == dataset.Collected(0, ())  # nothing to do
