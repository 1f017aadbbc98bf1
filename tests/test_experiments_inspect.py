"""The page of `experiments.inspect` against a recount of a made-up dataset."""

import base64
import io
import json
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from made_up_dataset import COLLECTION, FRAMES, Faults, write
from PIL import Image

import sts_jax as sts
from experiments import inspect
from experiments.shared import inspecting
from sts_jax import dataset, hardware

FAULTS = Faults(visual={(2, 3): 0}, tactile={(9, FRAMES - 1): 255})
VOID = {"meta", "img", "input"}


class Page(HTMLParser):
    """The parts of a page: rows of tables by their first cells, addresses, pictures by captions, and text."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.addresses, self.pictures, self.frames = {}, [], {}, ""
        self._open, self._row, self._source = [], [], None
        self.feed(text)
        assert not self._open, "an element is not closed"

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.addresses += [attributes[name] for name in ("src", "href", "data", "action") if name in attributes]
        if tag not in VOID:
            self._open.append((tag, attributes.get("id")))
        if tag == "tr":
            self._row = []
        if tag in ("td", "th"):
            self._row.append("")
        if tag == "img" and "src" in attributes:
            self.pictures[attributes["alt"]] = attributes["src"]

    def handle_endtag(self, tag):
        assert self._open.pop()[0] == tag
        if tag == "tr":
            self.rows.setdefault(self._row[0], self._row[1:])

    def handle_data(self, data):
        tags = [tag for tag, _ in self._open]
        if "td" in tags or "th" in tags:
            self._row[-1] += data
        if self._open and self._open[-1] == ("script", "frames"):
            self.frames += data


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of a dataset, its arrays, and the text of its page."""
    folder = tmp_path_factory.mktemp("made")
    arrays = write(folder / "dataset")
    inspect.main(inspect.Config(str(folder), folder / "page.html"))
    return folder, arrays, (folder / "page.html").read_text()


def picture(uri):
    assert uri.startswith("data:image/webp;base64,")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2]))).convert("RGB"))


def test_counts_are_those_of_a_recount(made):
    _, arrays, text = made
    rows, split = Page(text).rows, dataset.split_objects(COLLECTION)
    body, outcome = arrays["trajectory/body"], arrays["trajectory/outcome"]
    assert rows["trajectories"] == ["20"]
    assert rows["stored frames"] == [str(4 * FRAMES + 16 * 2)]
    assert rows["with images of every frame"] == ["4"]
    assert rows["views"] == ["10"]
    for name, number in {str(o): int(o) for o in COLLECTION.scenario.outcomes}.items():
        for cell, part in zip(rows[name], (*split.values(), np.arange(10)), strict=True):
            here = np.isin(body, part)
            assert cell == f"{(here & (outcome == number)).sum()} {(outcome[here] == number).mean():.1%}"
    for name, remainder in (("bottle", 0), ("fork", 1)):
        for cell, part in zip(rows[name], (*split.values(), np.arange(10)), strict=True):
            assert int(cell.split()[0]) == (np.isin(body, part) & (body % 2 == remainder)).sum()
    force = arrays["trajectory/wrench"][..., 2].max(1)
    stated = [float(cell) for cell in rows["largest force (N)"]]
    np.testing.assert_allclose(stated, [*np.quantile(force, (0, 0.05, 0.5, 0.95, 1)), force.mean()], rtol=1e-3)
    assert "No suspicious frames were found." in text


def test_the_page_needs_no_other_file(made):
    text = made[2]
    for address in Page(text).addresses:
        assert address.startswith(("data:image/webp;base64,", "#")), address[:80]
    assert not re.search(r"https?:|url\(|@import|fetch\(", text)
    assert len(text) < 5e6


def test_contact_sheets_show_both_streams_of_the_first_and_the_last_frame(made):
    folder, _, text = made
    data, shown = dataset.load(folder), Page(text).pictures
    assert len(shown) == 20  # at most 12 of each outcome
    for caption in shown:
        number = int(re.match(r"#(\d+) ", caption)[1])
        images = data.strip(number)
        parts = [x[i] for i in (0, -1) for x in (images.visual, images.tactile)]
        tile = picture(shown[caption])
        for place, part in enumerate(parts):
            left = place * (24 + 2)
            assert np.abs(tile[:, left : left + 24].astype(int) - part).mean() < 6  # WebP


def test_the_film_has_all_frames_of_a_trajectory(made, tmp_path):
    folder = made[0]
    inspect.main(inspect.Config(str(folder), tmp_path / "page.html", trajectory=3))
    frames = json.loads(Page((tmp_path / "page.html").read_text()).frames)
    data = dataset.load(folder)
    images = data.strip(3)
    assert len(frames) == FRAMES
    for i, frame in enumerate(frames):
        both = picture(frame["image"]).astype(int)
        assert np.abs(both[:, :24] - images.visual[i]).mean() < 6
        assert np.abs(both[:, 26:] - images.tactile[i]).mean() < 6
        assert frame["text"].startswith(f"frame {i}, {i / 31.25:.2f} s, {data.trajectory['wrench'][3, i, 2]:.2f} N")


def test_suspicious_frames_are_printed_and_drawn(tmp_path, capsys):
    write(tmp_path / "dataset", FAULTS)
    inspect.main(inspect.Config(str(tmp_path), tmp_path / "page.html"))
    printed = capsys.readouterr().out
    assert "black: trajectory 2, frame 3: visual image" in printed
    assert f"clipped: trajectory 9, frame {FRAMES - 1}: tactile image" in printed
    assert "2 suspicious" in printed
    text = (tmp_path / "page.html").read_text()
    assert "1 black, 1 clipped." in text
    (caption,) = [caption for caption in Page(text).pictures if "frame 3" in caption]
    assert caption.startswith("#2 ")
    assert picture(Page(text).pictures[caption])[:, :24].max() < 10
    inspect.main(inspect.Config(str(tmp_path), tmp_path / "page.html", examine=2))
    assert "Only 2 of 56 frames were examined." in (tmp_path / "page.html").read_text()


def test_a_session_of_a_real_sensor_is_refused_with_its_command(tmp_path):
    origin = hardware.Origin("camera", "leds", 64, 48, (9, 9, 9, 9))
    with hardware.Session(tmp_path / "dataset", origin):
        pass
    for given in (tmp_path, tmp_path / "dataset"):
        with pytest.raises(ValueError, match=f"experiments.real review --workdir {re.escape(str(tmp_path))} --check"):
            inspect.main(inspect.Config(str(given), tmp_path / "page.html"))


def test_a_wrong_trajectory_is_named(made):
    with pytest.raises(ValueError, match=r"--trajectory 20 does not exist: there are 0 to 19"):
        inspect.main(inspect.Config(str(made[0]), trajectory=20))


def test_a_folder_is_no_page(made, tmp_path):
    with pytest.raises(ValueError, match=r"--out .* is a folder: give the name of a file"):
        inspect.main(inspect.Config(str(made[0]), tmp_path))


def test_the_recording_for_rerun_has_all_frames(made, tmp_path):
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    inspect.main(inspect.Config(str(made[0]), tmp_path / "page.html", trajectory=3, rrd=tmp_path / "one.rrd"))
    counts = {}
    for chunk in RrdReader(str(tmp_path / "one.rrd")).stream().to_chunks():
        counts[chunk.entity_path] = counts.get(chunk.entity_path, 0) + chunk.num_rows
    moving = [
        "/visual",
        "/tactile",
        "/pad/object",
        *(f"/{kind}/{axis}" for kind in ("force", "moment") for axis in "xyz"),
    ]
    assert {name: counts[name] for name in moving} == dict.fromkeys(moving, FRAMES)
    assert counts["/pad/object/mesh"] == 1


def test_without_rerun_the_error_names_the_extra(made, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ImportError, match=r"pip install -e '\.\[view\]'"):
        inspect.main(inspect.Config(str(made[0]), tmp_path / "page.html", rrd=Path("one.rrd")))
    assert not (tmp_path / "page.html").exists()  # the error comes before the work


def test_outcomes_of_a_scenario_of_the_user_have_numbers(made):
    data = dataset.load(made[0])
    data.collection["scenario"]["name"] = "Mine"
    data.trajectory["outcome"][:] = [sts.physics.Outcome.STANDS] * 19 + [100]
    text = inspecting.page(data, "mine", [], num=1, trajectory=None, notes=["A note."])
    rows = Page(text).rows
    assert rows["stands"][-1] == "19 95.0%"
    assert rows["outcome 100"][-1] == "1 5.0%"
    assert "topples" not in rows
    assert "A note." in text
