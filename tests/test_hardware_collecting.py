"""Collecting from a sensor's devices without a sensor. A player places and releases an object as the guide asks for."""

import errno

import numpy as np
import pytest
from player import Player

from benchmarks.instruments.peers import DARK, LIT, SIZE, SensorPeer
from sts_jax import hardware, storage
from sts_jax.hardware import Action, Stage
from sts_jax.hardware.sts import Settling

GUIDE = hardware.GuideConfig(empty_s=0.2, hold_s=0.2, rest_s=0.4)
SETTLING = Settling(visual_s=0.1, tactile_s=0.1)


class Playing(hardware.AutomaticPerson):
    """Confirms, discards the trajectories in `bad`, and moves the object."""

    def __init__(self, player, bad=(), stop_after=None):
        super().__init__()
        self.player, self.bad, self.stop_after = player, set(bad), stop_after
        self.views = []

    def show(self, view):
        super().show(view)
        self.views.append(view)
        if view.problem is None:
            self.player.follow(view.stage)

    def action(self):
        view = self.views[-1]
        if self.stop_after is not None and self.stop_after(view):
            return Action.STOP
        if view.stage is Stage.REVIEW and view.number in self.bad:
            return Action.DISCARD
        return super().action()


@pytest.fixture
def peer(tmp_path):
    made = SensorPeer(tmp_path / "leds")
    yield made
    made.stop()


@pytest.fixture
def sensor(peer):
    camera = hardware.CameraConfig(peer.url, *SIZE, lock=False)
    with hardware.STS(camera=camera, leds=peer.path, settling=SETTLING).connect(0.2) as made:
        yield made


def collect(sensor, folder, person, count):
    with hardware.Session(folder, hardware.Origin.of(sensor)) as session:
        return hardware.collect(sensor, session, person, config=GUIDE, trusted=True, count=count)


def check(trajectory, number):
    """The images show trajectory `number` of the player, in the right lights."""
    for pair, place in ((trajectory.initial, Player.start(number)), (trajectory.final, Player.end(number))):
        for shot, level in ((pair.visual, DARK), (pair.tactile, LIT)):
            assert np.abs(np.subtract(Player.place_of(shot.image), place[:2])).max() <= 1
            assert abs(float(np.median(shot.image)) - level) < 3
            assert shot.before.levels == ((0, 0, 0, 0) if shot.stream == "visual" else (255, 255, 255, 255))
            assert shot.before.acknowledged_s < shot.time_s < shot.until_s
    assert trajectory.initial.tactile.time_s < trajectory.final.visual.time_s


def test_trajectories_are_collected_discarded_continued_and_stopped(peer, sensor, tmp_path):
    player = Player(peer)
    person = Playing(player, bad=[0])
    assert collect(sensor, tmp_path / "session", person, 1) == 1
    assert {view.stage for view in person.views} == set(Stage)
    assert collect(sensor, tmp_path / "session", Playing(player), 2) == 1
    stopping = Playing(player, stop_after=lambda view: view.stage is Stage.STILL)
    assert collect(sensor, tmp_path / "session", stopping, None) == 0  # the initial pair is kept
    standings = {entry.number: entry.standing for entry in hardware.list_recordings(tmp_path / "session")}
    assert standings == {0: "discarded", 1: "confirmed", 2: "confirmed", 3: "incomplete"}
    for trajectory in hardware.load_recordings(tmp_path / "session"):
        check(trajectory, trajectory.number)


@pytest.mark.parametrize("fails", ["write_folder", "write_manifest"])
def test_a_full_disk_is_shown_and_loses_nothing(peer, sensor, tmp_path, monkeypatch, fails):
    person, problems, write = Playing(Player(peer)), [], getattr(storage, fails)

    def full(path, *content):
        if path.name in ("initial", "final", "00000") and len(problems) < 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, *content)

    def show(view, shown=person.show):
        shown(view)
        if view.problem is not None:
            problems.append(view)

    monkeypatch.setattr(storage, fails, full)
    person.show = show
    assert collect(sensor, tmp_path / "session", person, 2) == 2
    assert "No space left on device" in problems[0].problem
    assert problems[0].stage is (Stage.HOLD if fails == "write_folder" else Stage.REVIEW)
    assert problems[0].confirmed == 0
    for trajectory in hardware.load_recordings(tmp_path / "session"):
        check(trajectory, trajectory.number)


@pytest.mark.slow
def test_a_camera_that_returns_interrupts_nothing_confirmed(peer, sensor, tmp_path):
    person = Playing(Player(peer))
    problems = []

    def show(view, shown=person.show):
        if view.stage is Stage.HOLD and not problems and peer.camera.running:
            peer.camera.stop()
        shown(view)
        if view.problem is not None:
            problems.append(view.problem)
            if not peer.camera.running:
                peer.camera.start()

    person.show = show
    sensor._timeout_s = 1.0
    assert collect(sensor, tmp_path / "session", person, 1) == 1
    assert problems
    (trajectory,) = hardware.load_recordings(tmp_path / "session")
    check(trajectory, 0)


def test_a_camera_that_stays_away_ends_collecting(peer, sensor, tmp_path):
    person = Playing(Player(peer))
    sensor._timeout_s = 0.5
    with hardware.Session(tmp_path / "session", hardware.Origin.of(sensor)) as session:
        peer.camera.stop()
        with pytest.raises((hardware.CameraError, hardware.LightError)):
            hardware.collect(sensor, session, person, config=GUIDE, trusted=True, patience_s=1.0)
    peer.camera.start()
    assert person.views[-1].problem is not None
