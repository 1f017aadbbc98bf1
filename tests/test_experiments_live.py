"""`experiments.live`: what is shown, at which rate, and from which images."""

import contextlib
import dataclasses
import json
import socket
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from led_simulator import WAIT_S
from page_client import ask, streamed
from session_writer import ORIGIN, SIZE, shot

import sts_jax as sts
from experiments import live
from experiments.shared.live import SIDE, Live, Predicted, Seen, Views, follow, outlined, outlines, panel
from experiments.shared.page import LivePage
from sts_jax import hardware

LENS = hardware.Lens.ideal(SIZE[1], SIZE[0])
PINHOLE = sts.Sensor().camera
EMPTY = {"visual": 100, "tactile": 180}  # grey values of the empty pad
POSE = np.array([0.01, -0.02, 0.1, 1, 0, 0, 0], np.float32)


def grey(level, size=SIZE):
    return np.full((*size, 3), level, np.uint8)


def views(divided=True):
    return Views(LENS, PINHOLE, (grey(EMPTY["visual"]), grey(EMPTY["tactile"])), divided)


class StubPredictor:
    """Predicts the image that it was given, mirrored. Samples have other brightnesses. Keeps all inputs."""

    def __init__(self, modalities=("visual", "tactile"), condition=0, outcomes=("rests", "fell off")):
        self.modalities, self.outcomes, self.calls = modalities, outcomes, []
        self.empty = {"visual": np.full((16, 16, 3), 0.6, np.float32), "tactile": np.full((16, 16, 3), 0.7, np.float32)}
        self.model = SimpleNamespace(config=SimpleNamespace(condition=condition))

    def __call__(self, *, visual, tactile, condition, present, key, num_samples):
        self.calls.append((visual, tactile, condition, present))
        levels = np.arange(num_samples, dtype=np.float32)[:, None, None, None] / num_samples
        samples = SimpleNamespace(visual=levels * np.ones_like(visual), tactile=1 - levels * np.ones_like(visual))
        samples.pose = np.tile(POSE, (num_samples, 1))
        chances = np.array([0.75, 0.25])
        return SimpleNamespace(
            visual=visual[:, ::-1], tactile=visual, outcome_probability=chances, pose=POSE, samples=samples
        )


def pair(visual=None, tactile=None, time_s=None):
    """A visual and a tactile image. None: of the empty pad."""
    images = {"visual": visual, "tactile": tactile}
    pixels = {stream: grey(EMPTY[stream]) if image is None else image for stream, image in images.items()}
    now_s = time.monotonic() if time_s is None else time_s
    return [dataclasses.replace(shot(0), image=pixels[stream], stream=stream, time_s=now_s) for stream in EMPTY]


def predicted(predictor, *shots):
    """The prediction from one pair."""
    with Live(predictor, views(), ()) as running:
        running.offer(*shots)
        return wait_for(running, 1)


def wait_for(running, number):
    """Wait until there are `number` predictions. The newest one."""
    limit_s = time.monotonic() + WAIT_S
    while running.made < number:
        assert time.monotonic() < limit_s
        time.sleep(0.002)
    return running.newest


def spotted(level, shift=4):
    image = grey(level)
    cv2.circle(image, (SIZE[1] // 2 + shift, SIZE[0] // 2), 10, (20, 20, 20), -1)
    return image


def test_backgrounds_become_the_untouched_sensor_of_the_model():
    predictor = StubPredictor()
    assert predicted(predictor, *pair()).occupied is False
    visual, tactile, _, present = predictor.calls[-1]
    inside = np.s_[4:12, 4:12]
    np.testing.assert_allclose(visual[inside], 0.6, atol=1e-6)
    np.testing.assert_allclose(tactile[inside], 0.7, atol=1e-6)
    assert not present["tactile"]
    kept = views(divided=False).prepared(grey(100), grey(180), predictor.empty)
    np.testing.assert_allclose(kept.visual[inside], 100 / 255, atol=1e-6)


@pytest.mark.parametrize(
    ("visual", "tactile", "contact", "occupied"),
    [(None, None, False, False), (100, None, False, True), (100, 180, True, True), (None, 180, True, True)],
)
def test_contact_and_occupation(visual, tactile, contact, occupied):
    predictor = StubPredictor()
    shots = pair(visual and spotted(visual), tactile and spotted(tactile))
    found = predicted(predictor, *shots)
    assert (found.contact, found.occupied) == (contact, occupied)
    assert bool(predictor.calls[-1][3]["tactile"]) == contact  # a touch without contact does not count
    assert found.outcomes == [("rests", 0.75), ("fell off", 0.25)]
    assert found.visual.shape == (SIDE, SIDE, 3)


def test_models_without_touch_and_names():
    predictor = StubPredictor(modalities=("visual",), outcomes=())
    found = predicted(predictor, *pair())
    assert predictor.calls[-1][1] is None  # the model takes no touch
    assert [name for name, _ in found.outcomes] == ["outcome 0", "outcome 1"]


def test_images_are_dropped_and_never_queued():
    """While one prediction is made, ten pairs come: only the last of them is predicted from next."""
    started, gate = threading.Event(), threading.Event()

    class Slow(StubPredictor):
        def __call__(self, **inputs):
            if len(self.calls) == 1:  # the first one after the compilation
                started.set()
                assert gate.wait(WAIT_S)
            return super().__call__(**inputs)

    predictor = Slow()
    with Live(predictor, views(), ()) as running:
        running.offer(*pair(grey(100)))
        assert started.wait(WAIT_S)
        for level in range(110, 120):
            running.offer(*pair(grey(level)))
        gate.set()
        assert wait_for(running, 2).latency_ms > 0
        assert running.offered == 11
    levels = [float(call[0][8, 8, 0]) for call in predictor.calls[1:]]
    assert levels == pytest.approx([0.6, 0.6 * 119 / 100], abs=0.01)


def test_an_error_of_the_thread_reaches_the_caller():
    predictor = StubPredictor()
    with Live(predictor, views(), ()) as running:
        predictor.calls = None
        running.offer(*pair())
        running._thread.join(WAIT_S)
        with pytest.raises(AttributeError, match="append"):
            running.offer(*pair())


@pytest.mark.parametrize(
    ("predictor", "condition", "match"),
    [
        (StubPredictor(modalities=("tactile",)), (), "must take visual images"),
        (StubPredictor(condition=3), (1.0, 2.0), "--condition must have 3 values, got 2"),
    ],
)
def test_unfit_models_are_refused(predictor, condition, match):
    with pytest.raises(ValueError, match=match):
        Live(predictor, views(), condition)


AIR, PAD = (100, None), (100, 180)  # levels of the images of an object in the air, and of one that touches the pad


@pytest.mark.parametrize(
    ("modalities", "course", "resting"),
    [
        (("visual",), [(AIR, 4, 3.0)], [False]),
        (("visual",), [(AIR, 4, 3.0), (PAD, 6, 0.9), (PAD, 6, 0.3)], [False, False, True]),
        (("visual",), [(PAD, 4, 2.0), (PAD, 8, 0.6), (PAD, 8, 0.6)], [True, False, True]),  # somebody moves it
        # A hand holds the object on the pad, lets go, and takes it up again.
        (("visual", "tactile"), [(PAD, 4, 3.0), (PAD, 8, 2.0), (PAD, 4, 3.0)], [False, True, False]),
        (("visual", "tactile"), [(PAD, 4, 3.0), (AIR, 8, 3.0), (PAD, 4, 3.0)], [False, False, False]),
    ],
)
def test_an_object_at_rest_is_recognised_and_the_prediction_is_then_the_present(modalities, course, resting):
    predictor, now_s, found = StubPredictor(modalities), 0.0, []
    with Live(predictor, views(), ()) as running:
        for (visual, tactile), shift, lasts_s in course:
            until_s = now_s + lasts_s
            while now_s < until_s:
                now_s += 0.1
                shots = pair(spotted(visual, shift), tactile and spotted(tactile, shift), now_s)
                running.offer(*shots)
                wait_for(running, running.offered)
            found.append(running.newest.resting)
            if running.newest.resting:
                present = running.views.shown(shots[0].image)
                assert all(
                    np.array_equal(getattr(running.newest, name), present) for name in ("visual", "samples_visual")
                )
                assert "at rest" in running.newest.lines()
                assert running.newest.outcomes == []
    assert found == resting


def test_four_samples_are_shown_as_one_image():
    found = predicted(StubPredictor(), *pair(spotted(100), spotted(180)))
    half = SIDE // 2
    for image, levels in ((found.samples_visual, [0, 1, 2, 3]), (found.samples_tactile, [16, 15, 14, 13])):
        parts = image[:half, :half], image[:half, half:], image[half:, :half], image[half:, half:]
        for part, level in zip(parts, levels, strict=True):
            assert abs(float(part[10:-10, 10:-10].mean()) - 255 * level / 16) < 1


def plate(half, up):
    """A square plate of a side 2 `half` (m) with a face that looks up or down, and a hole in its middle."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float32)
    vertices = np.zeros((8, 3), np.float32)
    vertices[:4, :2], vertices[4:, :2] = half * corners, half / 2 * corners
    faces = np.array(
        [[i, (i + 1) % 4, 4 + i] for i in range(4)] + [[(i + 1) % 4, 4 + (i + 1) % 4, 4 + i] for i in range(4)]
    )
    return SimpleNamespace(vertices=vertices, faces=faces if up else faces[:, ::-1], two_sided=np.bool_(False))


def test_outlines_are_those_of_the_pinhole():
    """0.1 m above the pad, everything is half as large as on the pad, whose 0.15 m fill the image."""
    below = np.array([0, 0, -0.2, 1, 0, 0, 0], np.float32)
    (outline,) = outlines(plate(0.03, up=False), np.stack([POSE, below]), PINHOLE)
    lines = sorted((line[:, 0].min(0).tolist(), line[:, 0].max(0).tolist()) for line in outline)
    scale, middle = SIDE / 0.15 / 2, SIDE / 2 + POSE[:2] * SIDE / 0.15 / 2
    expected = [[middle - half * scale, middle + half * scale] for half in (0.03, 0.015)]
    np.testing.assert_allclose(lines, expected, atol=2)
    drawn = outlined(grey(100, (SIDE, SIDE)), (outline,))
    y, x = middle[1].round().astype(int), middle[0].round().astype(int)
    assert (drawn[y, x] == 100).all()  # the hole
    assert drawn[y, x + round(0.0225 * scale), 0] > 105
    (outline,) = outlines(plate(0.03, up=True), POSE[None], PINHOLE)  # the pinhole sees the back of its faces
    assert len(outline) == 0
    image = grey(100)
    assert outlined(image, ()) is image


def test_the_outlines_of_a_known_body_are_drawn_and_its_prediction_stays_after_the_release():
    shots = [one for _ in range(3) for one in pair(spotted(100), spotted(180))]
    hand = SimpleNamespace(body=plate(0.03, up=False), let_go=False)
    with Live(StubPredictor(), views(), ()) as running:
        course = follow(running, iter(shots), hand)
        first = next(course)
        assert first.predicted is None
        wait_for(running, 1)
        hand.let_go = True
        second = next(course)
        assert second.predicted is running.newest
        np.testing.assert_array_equal(second.predicted.pose, POSE)
        assert (second.visual != first.visual).any()
        list(course)
        assert (running.offered, running.made) == (1, 1)
        assert running.summary.startswith("1 predictions, ")


def seen(level=90):
    visual, tactile, image, sample = (grey(level + change, (SIDE, SIDE)) for change in (1, 2, 0, 5))
    outcomes = [("rests", 0.9), ("fell off", 0.1)]
    now_s = time.monotonic()
    found = Predicted(visual, tactile, sample, sample, outcomes, True, True, False, now_s, rate=12.0, latency_ms=80.0)
    return Seen(image, image, now_s, found)


@pytest.fixture
def page():
    with contextlib.closing(LivePage("127.0.0.1", 0, title="A twin")) as made:
        yield made


def test_the_page_shows_a_state_and_only_to_its_own_name(page):
    assert b"<title>Live prediction</title>" in ask(page, "GET", "/")[1]
    page.tell("compiling")
    constants = {"title": "A twin", "ended": False, "starting": "compiling"}
    assert json.loads(ask(page, "GET", "/view")[1]) == {**constants, "waiting": True}
    assert ask(page, "GET", "/mean_visual.jpg")[0] == 404
    page.show(state := seen())
    facts = json.loads(ask(page, "GET", "/view")[1])
    assert 0 <= facts.pop("age_s") < WAIT_S
    assert facts == {
        **constants,
        **{"waiting": False, "contact": True, "occupied": True, "resting": False, "time_s": state.time_s},
        **{"rate": 12.0, "latency_ms": 80.0, "outcomes": [["rests", 0.9], ["fell off", 0.1]]},
    }
    mean = cv2.imdecode(np.frombuffer(ask(page, "GET", "/mean_tactile.jpg")[1], np.uint8), cv2.IMREAD_COLOR)
    assert abs(float(mean.mean()) - 92) < 1
    assert ask(page, "GET", "/view", Host="evil.example")[0] == 403
    for path in ("/other.mjpg", "/outcomes.jpg", "/mean_outcomes.jpg", "/mean_visual.mjpg"):
        assert ask(page, "GET", path)[0] == 404
    assert ask(page, "POST", "/action", {"hand": "hold"}, **{"X-Collect": "1"})[0] == 409  # it has no buttons
    for jpeg in streamed(page, "/samples_tactile.mjpg", [seen(), seen()]):
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert abs(float(image.mean()) - 95) < 1


def test_silent_connections_are_closed(page, monkeypatch):
    monkeypatch.setattr("experiments.shared.page._Handler.timeout", 0.05)
    with socket.create_connection((page.host, page.port), timeout=WAIT_S) as connection:
        assert connection.recv(1) == b""


def test_a_sensor_file_without_backgrounds_is_refused(tmp_path):
    hardware.Device("a", 30.0, "LEDS", LENS, 0.1, 0.1, (255,) * 4, "2026-05-31").save(tmp_path, sts.Sensor())
    with pytest.raises(ValueError, match="no images of the empty pad"):
        Views.load(tmp_path, divided=True)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"camera": "http://127.0.0.1/", "leds": "a"}, "--sensor is missing: give"),
        ({"seconds": 0.0}, "seconds must be > 0, got 0"),
        ({"dwell": 0}, "dwell must be >= 1, got 0"),
        ({"replay": "a", "record": "b"}, "--replay excludes --record"),
        ({"record": Path(__file__).parent}, r"--record .*tests must be a new or an empty folder"),
        ({"save": Path("a.mp4")}, r"a\.mp4 must be the name of a picture that ends in one of \.png"),
    ],
)
def test_bad_options(options, match):
    with pytest.raises(ValueError, match=match):
        live.check(live.Config(**options))


@pytest.mark.slow
def test_a_replay_with_a_model_of_the_library(tmp_path, capsys):
    """The whole command. The recording is of a grey pad with a dark spot, so the images are far from any training."""
    folder = tmp_path / "made"
    device = hardware.Device("http://127.0.0.1:1/camera", 30.0, "LEDS", LENS, 0.1, 0.1, (255,) * 4, "2026-05-31")
    device.save(tmp_path, sts.Sensor(), (grey(100), grey(180)))
    with hardware.Recorder(folder, ORIGIN, file=tmp_path) as recorder:
        for number in range(40):
            recorder.add(dataclasses.replace(shot(number), image=spotted(180 if number % 2 else 100)))
    picture = tmp_path / "live.png"
    config = live.Config(replay=folder, headless=True, save=picture, speed=0.5, loop=True, seconds=6.0, debug=True)
    live.main(config)
    printed = capsys.readouterr()
    assert int(printed.err.split(" predictions, ")[0].split()[-1]) > 10
    assert "contact, topples 0." in printed.out
    assert str(picture) in printed.out
    height, width = panel(seen()).shape[:2]
    written = cv2.imread(str(picture))
    assert (written.shape[0] % height, written.shape[1]) == (0, width)
    assert height < written.shape[0] <= 6 * height
    live.main(dataclasses.replace(config, save=None, loop=False, seconds=None, speed=20.0))
    assert "the replay has ended" in capsys.readouterr().err
