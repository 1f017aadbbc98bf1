"""Pairs and collections of the digital twin on its virtual clock. The twin's log decides which light an image shows."""

import random
import zlib

import numpy as np
import pytest

from experiments.shared.collecting import Hand
from sts_jax import hardware
from sts_jax.hardware import Settling, twin
from sts_jax.hardware.twin import photometry

SIZE = (120, 160)
GUIDE = hardware.GuideConfig(empty_s=0.3, hold_s=0.3, rest_s=0.5, pairs=3)
MOVED = 60  # pixels, between the ends of a trajectory


class Spots(twin.Scene):
    """A dark spot under both lights. Trajectory n starts in a column of its own, and its object moves to the right."""

    def __init__(self, *, unseen=(), unmoved=()):
        self.unseen, self.unmoved = unseen, unmoved
        self.events = [(-np.inf, twin.Phase.EMPTY, -1)]

    def column(self, seen):
        moved = seen.phase is twin.Phase.STILL and seen.trajectory not in self.unmoved
        return 20 + 12 * seen.trajectory + MOVED * moved

    def at(self, time_s):
        _, phase, number = [event for event in self.events if event[0] <= time_s][-1]
        return twin.Seen(phase, number, 0, None)

    def command(self, command, time_s):
        number = self.events[-1][2]
        phase = {"hold": twin.Phase.HELD, "release": twin.Phase.STILL, "clear": twin.Phase.EMPTY}[command]
        self.events.append((time_s, phase, number + (command == "hold")))

    def ends(self, seen, blender):
        visual, tactile = np.full((*SIZE, 3), 0.4), np.full((*SIZE, 3), 0.8)
        if seen.phase is not twin.Phase.EMPTY:
            column = self.column(seen)
            visual[40:70, column - 12 : column + 12] = 0.1
            if seen.trajectory not in self.unseen:
                tactile[40:70, column - 12 : column + 12] = 0.2
        return blender.ends(visual, tactile)


def column_of(image):
    """Column of the spot's middle."""
    return np.flatnonzero(image[45:65].mean(axis=(0, 2)) < 0.75 * image[5:30].mean(axis=(0, 2))).mean() + 0.5


def picture(tactile=0.8):
    return twin.Picture(np.full((*SIZE, 3), 0.4), np.full((*SIZE, 3), tactile))


class Logged(twin.Twin):
    """A twin that remembers the truth about each image, by the checksum of the image."""

    def __init__(self, scene, **options):
        super().__init__(scene, **options)
        self.truth = {}

    def make(self, index):
        frame = super().make(index)
        self.truth[zlib.crc32(photometry.decode(frame.jpeg).tobytes())] = frame.exposure
        return frame


def assert_of_one_light(shots, truth):
    for shot in shots:
        exposure = truth[zlib.crc32(shot.image.tobytes())]
        wanted = 1.0 if shot.stream == "tactile" else 0.0
        assert abs(exposure.lowest - wanted) + abs(exposure.highest - wanted) < 1e-6
        assert shot.before.acknowledged_s < exposure.start_s < exposure.end_s < shot.time_s <= shot.until_s
        assert exposure.due_s <= shot.time_s + 1e-9


@pytest.mark.parametrize("lag_s", [0.015, 0.12])
@pytest.mark.parametrize(("rate", "exposure_s"), [(15, 0.06), (60, 0.016)])
def test_no_image_is_of_a_wrong_or_mixed_light(lag_s, rate, exposure_s):
    constants = twin.Imperfections(lag_s=lag_s, exposure_s=exposure_s, jitter_s=0.01)
    chance = random.Random(0)
    with Logged(picture(), rate=rate, imperfections=constants) as made:
        sensor = twin.VirtualSensor(made)
        assert lag_s < sensor.settling.tactile_s < lag_s + exposure_s + 0.01 + 2 / rate
        shots = []
        for _ in range(30):
            made.step(chance.uniform(0, 2 / rate))
            called_s = made.now_s
            pair = sensor.read()
            assert min(pair.visual.time_s, pair.tactile.time_s) > called_s
            shots += [pair.visual, pair.tactile]
    assert_of_one_light(shots, made.truth)


def test_a_settling_that_is_too_short_gives_no_image():
    constants = twin.Imperfections(lag_s=0.1, exposure_s=0.06)
    with Logged(picture(), rate=15, imperfections=constants) as made, pytest.raises(hardware.LightError):
        twin.VirtualSensor(made, settling=Settling(visual_s=0.01, tactile_s=0.01)).read()


def test_an_image_whose_light_another_program_switched_is_not_returned(monkeypatch):
    with Logged(picture(), rate=15) as made:
        sensor = twin.VirtualSensor(made)
        capture, calls = made.capture, []

        def disturbed():
            calls.append(made.state.levels)
            if len(calls) in (2, 3, 7):
                made.set((7, 7, 7, 7))
            return capture()

        monkeypatch.setattr(made, "capture", disturbed)
        pairs = [sensor.read() for _ in range(3)]
    assert_of_one_light([shot for pair in pairs for shot in (pair.visual, pair.tactile)], made.truth)


def test_bad_sensors_are_refused():
    with twin.Twin(picture(tactile=0.4)) as made, pytest.raises(hardware.LightError, match="wiring"):
        twin.VirtualSensor(made)
    with twin.Twin(picture()) as made:
        made.run_on(lambda: 0.0)
        with pytest.raises(RuntimeError, match="real clock"):
            twin.VirtualSensor(made)


def collected(scene, folder, count, **options):
    """Collect by the ordinary loop."""
    with twin.Twin(scene, rate=15) as made:
        sensor = twin.VirtualSensor(made)
        with hardware.Session(folder, sensor.origin) as session:
            person = Hand(made, session, lambda *_: None, count, **options)
            hardware.collect(sensor, session, person, config=GUIDE, trusted=True, count=count)


def assert_spots(folder, numbers, scene):
    """The pairs show the spots of the trajectories with the numbers of the session, at both ends."""
    read = hardware.load_recordings(folder)
    assert read.numbers == tuple(numbers)
    for trajectory in read:
        for pair, phase in ((trajectory.initial, twin.Phase.HELD), (trajectory.final, twin.Phase.STILL)):
            wanted = scene.column(twin.Seen(phase, trajectory.number, 0, None))
            for shot in (pair.visual, pair.tactile):
                assert abs(column_of(shot.image) - wanted) <= 1


def test_the_hand_moves_the_object_as_the_guide_asks_and_leaves_out_a_pose_without_contact(tmp_path):
    scene = Spots(unseen=(2,), unmoved=(1,))
    collected(scene, tmp_path, 3)
    assert_spots(tmp_path, [0, 1, 3], scene)
    assert [str(phase) for _, phase, _ in scene.events[1:7]] == ["held", "still", "empty"] * 2


def test_a_guide_that_waits_for_ever_ends_with_an_error(tmp_path):
    with pytest.raises(ValueError, match=r"Place the object.* and 10 held poses .*still: True\)"):
        collected(Spots(unseen=range(20)), tmp_path / "unseen", 1)
    with pytest.raises(ValueError, match=r"Take everything.* for 0.\d s "):
        collected(Spots(), tmp_path / "impatient", 1, patience_s=0.1)
