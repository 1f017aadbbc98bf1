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


MAINS = {
    "sense": lambda out: sense.main(sense.Config("bottle", out=out)),
    "fit": lambda out: fit.main(fit.Config("bottle", out=out)),
    "objects": lambda out: objects.main(objects.Config(out=out)),
    "show": lambda out: show.main(show.Config("perturbed", out=out)),
}


@pytest.mark.parametrize("name", MAINS)
def test_a_path_that_cannot_be_written_is_refused_before_any_work(name, tmp_path, monkeypatch):
    def work(*_, **__):
        raise AssertionError("an object was made before the output path was checked")

    monkeypatch.setattr(sts.objects, "make", work)
    monkeypatch.setattr(show.dataset, "make_bodies", work)
    (tmp_path / "file").write_text("")
    wrong = {tmp_path / "file" / "a.png": "cannot write to the folder .*: give another path"}
    if name != "show":
        wrong |= {path: "must be the name of a picture that ends in one of" for path in (tmp_path, tmp_path / "a.xyz")}
    for path, message in wrong.items():
        with pytest.raises((OSError, ValueError), match=message):
            MAINS[name](path)
    monkeypatch.setattr(tempfile, "TemporaryFile", forbidden)  # whoever runs the tests may write everywhere
    with pytest.raises(PermissionError, match=r"cannot write to the folder .*Permission denied"):
        MAINS[name](tmp_path / "a.png")


def test_the_check_of_a_path_leaves_no_trace(tmp_path):
    (tmp_path / "old.jpg").write_bytes(b"old")
    for name in ("a.PNG", "old.jpg"):
        drawing.check_picture(tmp_path / name)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]


@pytest.mark.parametrize(("name", "form"), [("a.png", "PNG"), ("a.JPG", "JPEG"), ("a.webp", "WEBP"), ("a.tif", "TIFF")])
def test_pictures_and_figures_have_the_format_of_their_suffix(name, form, tmp_path):
    drawing.write_picture(tmp_path / name, Image.new("RGB", (6, 4)))
    drawing.write_figure(tmp_path / f"figure-{name}", Figure(figsize=(1, 0.5)), dpi=40)
    drawing.write_figure(tmp_path / "without", Figure(), dpi=40)
    for path, size in ((tmp_path / name, (6, 4)), (tmp_path / f"figure-{name}", (40, 20))):
        with Image.open(path) as picture:
            assert (picture.format, picture.size) == (form, size)
    assert (tmp_path / "without").read_bytes()[1:4] == b"PNG"


def test_a_picture_that_cannot_be_replaced_is_named_and_kept(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    path.write_bytes(b"old")
    monkeypatch.setattr(pathlib.Path, "replace", forbidden)
    with pytest.raises(OSError, match=r"cannot write .*a\.png: Permission denied\. Check the permissions"):
        drawing.write_picture(path, Image.new("RGB", (6, 4)))
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [b"old"]
