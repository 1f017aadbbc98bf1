"""`experiments.demo`: the buttons that move the object of a twin, what happened after a release, and how it ends."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from led_simulator import WAIT_S, until
from page_client import ask

import sts_jax as sts
from experiments.shared.device import TwinHand
from experiments.shared.live import SIDE, Predicted, Seen
from experiments.shared.page import CollectPage, DemoPage
from sts_jax.hardware import Stage, View, twin

HELD, LAST = (0.0, 0.0, 0.05, 1.0, 0.0, 0.0, 0.0), (0.03, 0.04, 0.0, 1.0, 0.0, 0.0, 0.0)
PREDICTED = np.array([0.03, 0.01, 0.0, 1, 0, 0, 0], np.float32)  # 30 mm from `LAST`
MOVES_S = 0.3
BUTTON = {"X-Collect": "1"}


class FakeScene(twin.Scene):
    """A scene without images, whose object moves from `HELD` to `last`."""

    def __init__(self):
        self.events, self.chosen, self.last = [(0.0, twin.Phase.EMPTY, None)], [], LAST

    def at(self, time_s):
        since_s, phase, pose = self.events[-1]
        if phase is twin.Phase.MOVING and time_s > since_s + MOVES_S:
            return twin.Seen(twin.Phase.STILL, 0, 1, self.last)
        return twin.Seen(phase, 0, 0, pose)

    def ends(self, seen, blender):
        raise AssertionError("no camera reads")

    def command(self, command, time_s):
        after = {
            "hold": (twin.Phase.HELD, HELD),
            "release": (twin.Phase.MOVING, HELD),
            "clear": (twin.Phase.EMPTY, None),
        }
        if command == "release" and self.at(time_s).phase is not twin.Phase.HELD:
            raise ValueError("send 'hold' first")
        self.events.append((time_s, *after[command]))

    def choose(self, category, seed):
        self.chosen.append((category, seed))


@pytest.fixture
def served():
    scene = FakeScene()
    with twin.Twin(scene) as device, twin.Served(device) as server:
        yield scene, server


@pytest.fixture
def page(served):
    with contextlib.closing(DemoPage("127.0.0.1", 0, title="a twin", classes=sts.objects.CATEGORIES)) as made:
        made.hand = TwinHand(served[1].url)
        yield made


def at_last(condition):
    """Wait longer than `until`, for a program that compiles."""
    deadline = time.monotonic() + 10 * WAIT_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def predicted(page):
    """Show a new prediction."""
    image, now_s = np.zeros((SIDE, SIDE, 3), np.uint8), time.monotonic()
    chances = [("rests", 0.9), ("fell off", 0.1)]
    found = Predicted(image, image, image, image, chances, False, True, False, now_s, pose=PREDICTED)
    page.show(Seen(image, image, now_s, found))


def view(page):
    return json.loads(ask(page, "GET", "/view")[1])


def press(page, **content):
    return ask(page, "POST", "/action", content, **BUTTON)[0]


def until_done(page):
    until(lambda: view(page)["hand"]["doing"] is None)
    return view(page)["hand"]


def held(page):
    """Wait until a release is possible, which needs a prediction from images of the held object."""

    def ready():
        predicted(page)
        return "release" in view(page)["hand"]["can"]

    until(ready)


def test_hold_release_and_what_happened(page, served):
    scene, _ = served
    assert view(page)["waiting"]
    predicted(page)
    assert view(page)["hand"] == {"phase": "empty", "doing": None, "problem": None, "can": ["hold", "clear"]}
    assert press(page, hand="hold", **{"class": "fork", "seed": 3}) == 204
    assert until_done(page)["phase"] == "held"
    assert scene.chosen == [("fork", 3)]
    np.testing.assert_array_equal(page.hand.body.vertices, sts.objects.make(jax.random.key(3), "fork").vertices)
    held(page)
    assert view(page)["happened"] is None
    assert press(page, hand="release", **{"class": "spoon", "seed": 0}) == 204
    assert view(page)["let_go"]
    assert press(page, hand="hold") == 409  # the release still runs
    hand = until_done(page)
    assert (hand["phase"], hand["can"]) == ("still", ["hold", "clear"])
    happened = view(page)["happened"]
    assert happened.pop("error_mm") == pytest.approx(30, abs=1e-3)
    assert happened == {"fell_off": False}
    assert scene.chosen == [("fork", 3)]  # only `hold` chooses
    assert press(page, hand="hold") == 204
    assert until_done(page)["phase"] == "held"
    assert not view(page)["let_go"]
    assert view(page)["happened"] is None
    held(page)
    assert press(page, hand="release") == 204
    until_done(page)
    assert press(page, hand="clear") == 204
    assert until_done(page)["phase"] == "empty"
    assert not view(page)["let_go"]


def test_an_object_that_falls_off(page, served):
    served[0].last = (0.1, 0.0, -0.02, 1.0, 0.0, 0.0, 0.0)
    predicted(page)
    press(page, hand="hold")
    until_done(page)
    held(page)
    press(page, hand="release")
    until_done(page)
    assert view(page)["happened"]["fell_off"]


def test_a_release_needs_a_prediction_of_the_held_object(page):
    predicted(page)
    press(page, hand="hold")
    assert until_done(page)["can"] == ["hold", "clear"]  # the prediction is older
    assert press(page, hand="release") == 409
    held(page)


def test_refused_actions(page, served):
    predicted(page)
    for content in (
        {"hand": "jump"},
        {"hand": "hold", "class": "unicorn"},
        {"hand": "hold", "class": "fork", "seed": -1},
        {"hand": "hold", "class": "fork", "seed": "x"},
        {},
        [],
        "hold",
        {"hand": ["hold"]},
    ):
        assert ask(page, "POST", "/action", content, **BUTTON)[0] == 409, content
    assert ask(page, "POST", "/action", {"hand": "hold"})[0] == 403  # without the header of the page
    assert ask(page, "POST", "/action", {"hand": "hold"}, Origin="http://evil.example", **BUTTON)[0] == 403
    assert ask(page, "POST", "/action", {"hand": "hold"}, Host="evil.example", **BUTTON)[0] == 403
    assert served[0].events[-1][1] is twin.Phase.EMPTY
    assert page._server.is_local


def test_an_error_of_the_twin_is_shown(page):
    page.hand.start("release")
    until(lambda: page.hand.doing is None)
    predicted(page)
    assert view(page)["hand"]["problem"] == "send 'hold' first"


def test_the_collect_page_has_the_buttons_of_a_twin(served):
    with contextlib.closing(CollectPage("127.0.0.1", 0, count=None)) as page:
        page.show(View(None, Stage.PLACE, "Place", False, True, None, 0, None, None, None))
        assert view(page)["hand"] is None
        assert press(page, hand="hold") == 409
        page.hand = TwinHand.of_camera(served[1].camera)
        assert view(page)["hand"] == {"phase": "empty", "doing": None, "problem": None}
        assert press(page, hand="hold") == 204
        assert until_done(page)["phase"] == "held"
        assert press(page, action="stop", stage="place", number=None) == 204
        for camera in (0, "/dev/video0", served[1].url + "/state", "http://127.0.0.1:1/camera"):
            assert TwinHand.of_camera(camera) is None


@pytest.mark.slow
def test_the_command_in_a_process_ends_with_all_that_it_has_started(tmp_path):
    """From the start over a held and a released fork to Ctrl-C."""
    command = [sys.executable, "-m", "experiments.demo", "--no-browser", "--port", "0"]
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        cwd=Path(__file__).parents[1],
        start_new_session=True,
    ) as process:
        try:
            port = int(process.stderr.readline().split("http://127.0.0.1:")[1].split("/")[0])
            page = type("Page", (), {"host": "127.0.0.1", "port": port})
            starting = view(page)
            assert starting["waiting"]
            assert "twin" in starting["starting"]
            at_last(lambda: not view(page)["waiting"])
            children = list(map(int, Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()))
            assert children
            assert list(tmp_path.iterdir())
            assert press(page, hand="hold", **{"class": "fork", "seed": 1}) == 204
            at_last(lambda: "release" in view(page)["hand"]["can"])
            assert sum(chance for _, chance in view(page)["outcomes"]) == pytest.approx(1, abs=1e-3)
            assert press(page, hand="release") == 204
            at_last(lambda: view(page)["happened"] is not None)
            assert 0 < view(page)["happened"]["error_mm"] < 300
            process.send_signal(signal.SIGTERM)  # a shell in the background lets programs ignore Ctrl-C
            printed = process.stderr.read()
            assert process.wait(WAIT_S) == 0
        finally:
            process.kill()
    assert "stopped\n" in printed
    assert not list(tmp_path.iterdir())
    assert not any(Path(f"/proc/{child}").exists() for child in children)
    with pytest.raises(OSError, match="refused"):
        view(page)
