import matplotlib.image
import pytest

from experiments import objects


def test_contact_sheet(tmp_path):
    out = tmp_path / "sheet.png"
    objects.main(objects.Config(out=out, num=2, categories=("bottle", "fork"), size=40))
    image = matplotlib.image.imread(out)[..., :3]
    assert image.shape == (340, 320, 3)
    assert (image.min(2) < 0.7).mean() > 0.02  # something is drawn
    assert list(tmp_path.iterdir()) == [out]


def test_shuffled_sheet_has_its_answers_beside_it(tmp_path):
    out = tmp_path / "sheet.png"
    objects.main(objects.Config(out=out, num=2, categories=("watch", "spoon"), size=20, view="below", shuffle=True))
    lines = (tmp_path / "sheet.txt").read_text().split("\n")
    assert sorted(line.split()[1] for line in lines if line) == ["spoon", "spoon", "watch", "watch"]


def test_errors(tmp_path):
    with pytest.raises(ValueError, match="teapot"):
        objects.main(objects.Config(out=tmp_path / "a.png", categories=("teapot",)))
    with pytest.raises(ValueError, match="num is 0"):
        objects.main(objects.Config(out=tmp_path / "a.png", num=0))
