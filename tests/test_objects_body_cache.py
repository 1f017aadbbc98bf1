from pathlib import Path

import pytest
import shapenet_folder as shapenet
from object_files import box, leaves, mixed_folder

from sts_jax import objects
from sts_jax.objects import libraries


@pytest.fixture
def folder(tmp_path) -> Path:
    return mixed_folder(tmp_path / "things")


def test_the_cache_returns_the_same_bytes_without_loading_again(folder, tmp_path, monkeypatch):
    plain = [leaves(body) for body in objects.bodies(objects.library(folder))[0]]
    listed = objects.library(folder, cache=tmp_path / "kept")
    usable, text = objects.survey(listed)
    assert len(list((tmp_path / "kept").iterdir())) == len(listed.items)
    monkeypatch.setattr(libraries, "load", None)  # nothing is made twice
    assert [leaves(body) for body in objects.bodies(usable)[0]] == plain
    assert objects.survey(listed) == (usable, text)


def test_a_torn_file_of_the_cache_is_replaced(folder, tmp_path):
    listed = objects.library(folder, cache=tmp_path / "kept")
    whole = leaves(objects.read(listed, 1).body)
    (place,) = (tmp_path / "kept").iterdir()
    content = place.read_bytes()
    for torn in (content[: len(content) // 2], b"", b"\x80 no archive", content[:-200] + bytes(200)):
        place.write_bytes(torn)
        assert leaves(objects.read(listed, 1).body) == whole
        assert place.read_bytes() == content
    assert list((tmp_path / "kept").iterdir()) == [place]


def test_a_changed_file_image_or_setting_is_another_entry_of_the_cache(tmp_path):
    shapenet.build(tmp_path, [shapenet.row("a", "Watch")], {"a": box((2, 1, 1))}, {"a": (9, 9, 9)})
    cache = tmp_path / "kept"

    def count(**settings) -> int:
        objects.read(objects.library(tmp_path, cache=cache, **settings), 0)
        return len(list(cache.iterdir()))

    assert [count(), count()] == [1, 1]
    image = tmp_path / "models-textures" / "textures" / "a.png"
    image.write_bytes(image.read_bytes() + b"\0")
    assert count() == 2
    mesh = tmp_path / "models-OBJ" / "models" / "a.obj"
    mesh.write_text(mesh.read_text() + "# end\n")
    assert count() == 3
    assert [count(longest_side=0.05), count(faces=64), count(largest=0.06)] == [4, 5, 6]
