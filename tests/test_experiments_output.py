"""An output path that cannot be written is an error before any work, and pictures are written atomically."""

import pathlib
import tempfile

import pytest
from matplotlib.figure import Figure
from PIL import Image

import sts_jax as sts
from experiments import fit, objects, sense, show
from experiments.shared import drawing


def forbidden(*_, **__):
    raise PermissionError(13, "Permission denied")


@pytest.fixture
def no_work(monkeypatch):
    def work(*_, **__):
        raise AssertionError("an object was made before the output path was checked")

    monkeypatch.setattr(sts.objects, "make", work)
    monkeypatch.setattr(show.dataset, "make_bodies", work)


MAINS = {
    "sense": lambda out: sense.main(sense.Config("bottle", out=out)),
    "fit": lambda out: fit.main(fit.Config("bottle", out=out)),
    "objects": lambda out: objects.main(objects.Config(out=out)),
}


@pytest.mark.parametrize("name", MAINS)
@pytest.mark.usefixtures("no_work")
def test_a_picture_that_cannot_be_written_is_refused_before_any_work(name, tmp_path, monkeypatch):
    for path, kind, message in (
        (tmp_path, IsADirectoryError, "is a folder: give the name of a picture"),
        (tmp_path / "nowhere" / "a.png", FileNotFoundError, r"nowhere of a\.png does not exist: make this folder"),
        (tmp_path / "a.xyz", ValueError, r"has the suffix '\.xyz', but it must be one of \.png"),
    ):
        with pytest.raises(kind, match=message):
            MAINS[name](path)
    monkeypatch.setattr(tempfile, "TemporaryFile", forbidden)  # whoever runs the tests may write everywhere
    with pytest.raises(PermissionError, match=r"cannot be written to \(Permission denied\): give another path"):
        MAINS[name](tmp_path / "a.png")
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("no_work")
def test_a_folder_that_cannot_be_written_is_refused_before_any_work(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "inner"):
        with pytest.raises(OSError, match=r"cannot be made \(.*\): give another path"):
            show.main(show.Config("perturbed", out=path))
    monkeypatch.setattr(tempfile, "TemporaryFile", forbidden)
    with pytest.raises(PermissionError, match=r"cannot be written to \(Permission denied\)"):
        show.main(show.Config("perturbed", out=tmp_path / "new"))


def test_a_path_that_can_be_written_leaves_no_trace(tmp_path):
    drawing.check_picture(tmp_path / "a.PNG")
    assert not list(tmp_path.iterdir())
    (tmp_path / "old.jpg").write_bytes(b"old")
    drawing.check_picture(tmp_path / "old.jpg")
    assert (tmp_path / "old.jpg").read_bytes() == b"old"
    drawing.make_folder(tmp_path / "a" / "b")
    assert not list((tmp_path / "a" / "b").iterdir())


@pytest.mark.parametrize(("name", "form"), [("a.png", "PNG"), ("a.JPG", "JPEG"), ("a.webp", "WEBP"), ("a.tif", "TIFF")])
def test_pictures_and_figures_have_the_format_of_their_suffix(name, form, tmp_path):
    drawing.write_picture(tmp_path / name, Image.new("RGB", (6, 4)))
    drawing.write_figure(tmp_path / f"figure-{name}", Figure(figsize=(1, 0.5)), dpi=40)
    for path, size in ((tmp_path / name, (6, 4)), (tmp_path / f"figure-{name}", (40, 20))):
        with Image.open(path) as picture:
            assert (picture.format, picture.size) == (form, size)


def test_a_pdf_and_a_figure_without_suffix_are_written(tmp_path):
    drawing.write_picture(tmp_path / "a.pdf", Image.new("RGB", (6, 4)))
    drawing.write_figure(tmp_path / "b.pdf", Figure(), dpi=40)
    drawing.write_figure(tmp_path / "c", Figure(), dpi=40)
    starts = [(tmp_path / name).read_bytes()[:4] for name in ("a.pdf", "b.pdf", "c")]
    assert starts == [b"%PDF", b"%PDF", b"\x89PNG"]


WRITERS = {
    "picture": lambda path: drawing.write_picture(path, Image.new("RGB", (6, 4))),
    "figure": lambda path: drawing.write_figure(path, Figure(), dpi=40),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_a_picture_that_cannot_be_replaced_is_named_and_kept(kind, tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    path.write_bytes(b"old")
    monkeypatch.setattr(pathlib.Path, "replace", forbidden)
    with pytest.raises(OSError, match=r"cannot write .*a\.png: Permission denied\. Check the permissions"):
        WRITERS[kind](path)
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [b"old"]
