import dataclasses
import re

import jax.numpy as jnp
import matplotlib.image
import pytest

import sts_jax as sts
from experiments import objects

pytestmark = pytest.mark.slow


def test_the_contact_sheet_shows_the_objects(tmp_path):
    out = tmp_path / "sheet.png"
    objects.main(objects.Config(out=out, num=2, categories=("bottle", "fork"), size=40))
    image = matplotlib.image.imread(out)[..., :3]
    assert image.shape == (340, 320, 3)
    assert (image.min(2) < 0.7).mean() > 0.02  # something is drawn
    assert list(tmp_path.iterdir()) == [out]


def test_a_shuffled_sheet_comes_with_its_answers(tmp_path):
    out = tmp_path / "sheet.png"
    objects.main(objects.Config(out=out, num=2, categories=("watch", "spoon"), size=20, view="below", shuffle=True))
    lines = (tmp_path / "sheet.txt").read_text().split("\n")
    assert sorted(line.split()[1] for line in lines if line) == ["spoon", "spoon", "watch", "watch"]


def test_the_gaps_of_each_object_are_printed(tmp_path, capsys, monkeypatch):
    def decompose(body):
        return dataclasses.replace(body, hulls=jnp.concatenate([body.hulls, 0.9 * body.hulls]))

    monkeypatch.setattr(sts.objects, "decompose", decompose)  # it takes seconds per object and has its own tests
    config = objects.Config(out=tmp_path / "sheet.png", num=2, categories=("bottle", "fork"), size=20)
    objects.main(config)
    lines = capsys.readouterr().out.splitlines()[1:]
    assert [line.partition(":")[0] for line in lines] == ["bottle  1", "bottle  2", "fork  1", "fork  2"]
    ends = [re.fullmatch(r".*: \d+ x \d+ x \d+; \d+ faces; \d+ vertices; ([\d.]+) / ([\d.]+)", line) for line in lines]
    assert all(ends)
    hollow = [float(end[2]) > 1e3 * sts.objects.HOLLOW for end in ends]
    assert any(hollow)
    objects.main(dataclasses.replace(config, parts=True))
    after = capsys.readouterr().out.splitlines()[1:]
    for line, before, apart in zip(after, lines, hollow, strict=True):
        assert line == before if not apart else line.endswith(f"; as one hull {before.rpartition('; ')[2]}")
        assert ("in 2 parts" in line) == apart


@pytest.mark.parametrize(("options", "message"), [({"categories": ("teapot",)}, "teapot"), ({"num": 0}, "num is 0")])
def test_unknown_classes_and_zero_objects_are_refused(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        objects.main(objects.Config(out=tmp_path / "a.png", **options))
