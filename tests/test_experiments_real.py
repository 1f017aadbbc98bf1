"""The commands `real collect` and `real review`, against a sensor's devices without a sensor."""

import contextlib
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from led_simulator import WAIT_S
from page_client import ask
from player import Player
from session_writer import ORIGIN, pair
from test_hardware_collecting import check

import sts_jax as sts
from benchmarks.instruments.peers import DARK, LIT, SIZE, SensorPeer
from experiments import real
from experiments.shared.page import CollectPage
from experiments.shared.terminal import Terminal
from sts_jax import hardware, storage
from sts_jax.hardware import Action, Stage


@pytest.fixture
def peer(tmp_path):
    made = SensorPeer(tmp_path / "leds")
    yield made
    made.stop()


def run(peer, player, workdir, *options, until_line=None):
    """Play what the command `collect` asks for, until it ends, or kill it after a line. All lines and the exit code."""
    command = [sys.executable, "-m", "experiments.real", "collect", "--workdir", str(workdir), "--headless"]
    command += ["--automatic", "--sensor", str(sensor_file(peer, workdir / "bench")), "--leds", peer.path]
    command += ["--count", "3", "--guide.empty-s", "0.2", "--guide.hold-s", "0.2", "--guide.rest-s", "0.4", *options]
    words = {"Take everything off": Stage.CLEAR, "Place the": Stage.PLACE, "Release the": Stage.RELEASE}
    root, lines, pipe = Path(__file__).parents[1], [], subprocess.PIPE
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])}
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stderr=pipe, text=True, cwd=root, env=environment
    ) as process:
        timer = threading.Timer(10 * WAIT_S, process.kill)
        timer.start()
        for line in process.stderr:
            lines.append(line)
            for text, stage in words.items():
                if text in line:
                    player.follow(stage)
            if until_line is not None and until_line in line:
                process.kill()
        timer.cancel()
    return lines, process.returncode


@pytest.mark.slow
def test_collecting_is_resumed_after_a_kill(peer, tmp_path):
    player = Player(peer)
    run(peer, player, tmp_path, until_line="[1 of 3]")
    peer.leds.controller._apply((0, 0, 0, 0))  # the watchdog
    dataset = tmp_path / "dataset"
    kept = hardware.load_recordings(dataset).numbers
    assert kept == (0,)
    player.peer.camera.spot = None
    player.count = hardware.list_recordings(dataset)[-1].number + 1
    lines, code = run(peer, player, tmp_path, "--note", "box")
    assert code == 0, lines
    assert any("has 1 confirmed trajectories" in line for line in lines)
    read = hardware.load_recordings(dataset)
    assert len(read) == 3
    for trajectory in read:
        check(trajectory, trajectory.number)
    assert [trajectory.note for trajectory in read] == ["", "box", "box"]


def sensor_file(peer, folder):
    """The file of the peer's sensor, with its backgrounds and settling."""
    serial_number, levels = peer.leds.controller._serial_number, (255, 255, 255, 255)
    device = hardware.Device(peer.url, 60.0, serial_number, hardware.Lens.ideal(*SIZE), 0.1, 0.1, levels, "2026-05-31")
    dark, lit = (np.full((SIZE[1], SIZE[0], 3), level, np.uint8) for level in (DARK, LIT))
    device.save(folder, sts.Sensor(), (dark, lit))
    return folder


def view(stage=Stage.REVIEW, number=0, **changes):
    taken = pair(0, "initial")
    values = {
        **{"pair": taken, "stage": stage, "instruction": "Do.", "contact": True, "still": True, "number": number},
        **{"confirmed": 4, "problem": None, "initial": taken, "final": None},
    }
    return hardware.View(**{**values, **changes})


@pytest.fixture
def page():
    with contextlib.closing(CollectPage("127.0.0.1", 0, count=5)) as made:
        yield made


def test_the_page_shows_a_view(page):
    assert b"<title>Collect trajectories</title>" in ask(page, "GET", "/")[1]
    assert json.loads(ask(page, "GET", "/view")[1]) == {
        "count": 5,
        "starting": "connecting",
        "ended": False,
        "waiting": True,
    }
    assert ask(page, "GET", "/end/initial/visual.jpg")[0] == 404
    page.show(view())
    facts = json.loads(ask(page, "GET", "/view")[1])
    assert facts["age_s"] >= 0
    expected = {"stage": "review", "number": 0, "confirmed": 4, "count": 5, "ends": ["initial"]}
    assert {name: facts[name] for name in expected} == expected
    assert ask(page, "GET", "/end/initial/tactile.jpg")[1].startswith(b"\xff\xd8")
    for path in ("/end/final/tactile.jpg", "/end/initial/pair.json", "/end/__class__/visual.jpg", "/../real.py"):
        assert ask(page, "GET", path)[0] == 404


def test_buttons_count_only_for_the_stage_that_was_shown(page):
    page.show(view())
    good = {"action": "confirm", "stage": "review", "number": 0}
    for body in ({**good, "stage": "release"}, {**good, "number": 1}, {**good, "action": "delete"}, {}, [1]):
        assert ask(page, "POST", "/action", body, **{"X-Collect": "1"})[0] == 409
    assert page.action() is None
    assert ask(page, "POST", "/action", good, **{"X-Collect": "1"})[0] == 204
    assert page.action() is Action.CONFIRM
    assert page.action() is None
    stop = {"action": "stop", "stage": "hold", "number": None}
    assert ask(page, "POST", "/action", stop, **{"X-Collect": "1"})[0] == 204
    assert page.action() is Action.STOP


def test_a_second_press_does_not_count_for_the_next_stage(page):
    page.show(view())
    good = {"action": "confirm", "stage": "review", "number": 0}
    for next_stage, left in ((Stage.CLEAR, None), (Stage.REVIEW, Action.CONFIRM)):
        assert ask(page, "POST", "/action", good, **{"X-Collect": "1"})[0] == 204
        assert page.action() is Action.CONFIRM
        assert ask(page, "POST", "/action", good, **{"X-Collect": "1"})[0] == 204  # before the next view
        page.show(view(next_stage, number=0 if left else None))
        assert page.action() is left
        page.show(view())
    stop = {"action": "stop", "stage": "review", "number": 0}
    assert ask(page, "POST", "/action", stop, **{"X-Collect": "1"})[0] == 204
    page.show(view(Stage.CLEAR, number=None))
    assert page.action() is Action.STOP


def test_other_sites_can_neither_see_nor_press(page):
    page.show(view())
    good = {"action": "confirm", "stage": "review", "number": 0}
    assert ask(page, "POST", "/action", good)[0] == 403  # a form of another site has no such header
    assert ask(page, "GET", "/view", Host="evil.example")[0] == 403
    assert ask(page, "POST", "/action", good, **{"X-Collect": "1", "Host": "evil.example"})[0] == 403
    assert ask(page, "GET", "/view", Host=f"localhost:{page.port}")[0] == 200
    assert page.action() is None


@pytest.mark.parametrize(
    ("host", "text"), [("127.0.0.1", "only this computer can watch and press"), ("0.0.0.0", "EVERY computer")]
)
def test_the_page_states_where_it_listens(capsys, host, text):
    CollectPage(host, 0).close()
    assert f"listens on {host}, so {text}" in capsys.readouterr().err


def test_lines_act_in_the_stage_that_the_person_has_seen(monkeypatch, capsys):
    receiver, sender = os.pipe()
    with os.fdopen(receiver) as pipe:
        monkeypatch.setattr(sys, "stdin", pipe)
        terminal = Terminal(7)
        terminal.show(view(Stage.HOLD))
        os.write(sender, b"\n")
        terminal.show(view(Stage.RELEASE))
        assert terminal.action() is None  # it was written in another stage
        terminal.show(view(Stage.RELEASE))
        os.write(sender, b"help\n\r\nD\nq\n")
        assert [terminal.action() for _ in range(3)] == [Action.CONFIRM, Action.DISCARD, Action.STOP]
        os.write(sender, b"x\n")
        assert terminal.action() is None
        os.close(sender)
        assert terminal.action() is Action.STOP
    assert "[4 of 7] trajectory 0: Do." in capsys.readouterr().err


@pytest.fixture
def workdir(tmp_path):
    with hardware.Session(tmp_path / "dataset", ORIGIN) as session:
        for number in range(3):
            for end in ("initial", "final"):
                session.save(number, end, pair(number, end))
            if number < 2:
                session.confirm(number, f"note {number}")
    return tmp_path


def test_reviewing(workdir, capsys):
    real.main(real.Review(workdir))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:2] == ["0", "confirmed"]
    assert lines[0].endswith("note 0")
    assert lines[3].startswith("2 confirmed of 3 in ")
    real.main(real.Review(workdir, discard=(0,), confirm=(2,), note="late"))
    assert hardware.load_recordings(workdir / "dataset").numbers == (1, 2)
    real.main(real.Review(workdir, restore=(0,), sheet=workdir / "sheet.png"))
    assert (workdir / "sheet.png").stat().st_size > 10_000
    real.main(real.Review(workdir, check=True))
    assert "3 of 3 confirmed trajectories are undamaged" in capsys.readouterr().out
    (workdir / "dataset/trajectories/00001/final/visual.png").write_bytes(b"")
    with pytest.raises(SystemExit):
        real.main(real.Review(workdir, check=True))
    caught = capsys.readouterr()
    assert "discard trajectory 1" in caught.err
    assert "2 of 3 confirmed" in caught.out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "--sensor is missing: give the sensor file"),
        ({"sensor": Path("none.json"), "count": 0}, "count is 0, but it must be from 1 to"),
        ({"sensor": Path("none.json")}, "none.json"),
        ({"sensor": Path("none.json"), "size": (320, 240)}, "--size is .*, but the sensor file none.json determines"),
        ({"twin": True, "camera": "/dev/video0"}, "--camera and --twin exclude each other"),
        ({"twin": True, "size": (0, 480)}, r"size is \(0, 480\), but it must be from 1"),
    ],
)
def test_bad_options_are_named(tmp_path, options, message):
    with pytest.raises(SystemExit, match=message):
        real.main(real.Collect(tmp_path, headless=True, automatic=True, **options))


def test_a_work_directory_has_one_user_and_leftovers_of_a_kill_are_deleted(tmp_path):
    collect = real.Collect(tmp_path, sensor=Path("none.json"), headless=True)
    with storage.lock(tmp_path), pytest.raises(SystemExit, match="is in use by"):
        real.main(collect)
    (tmp_path / ".sensor.json.1.partial").write_text("{")
    with pytest.raises(SystemExit, match=r"none\.json"):
        real.main(collect)
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".partial"] == []


def test_unknown_trajectories_and_folders_are_named(workdir, tmp_path):
    for review, message in (
        (real.Review(workdir, discard=(9,)), "00009 does not exist"),
        (real.Review(workdir, sheet=workdir / "a.png", numbers=(2,)), r"confirmed trajectories \[2\]"),
        (real.Review(tmp_path / "none"), "holds no session"),
    ):
        with pytest.raises(SystemExit, match=message):
            real.main(review)
