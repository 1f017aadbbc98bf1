"""`STS`: which light was on is judged by the peer's log of each frame, never by the host's label."""

import dataclasses
import itertools
import threading
import time

import numpy as np
import pytest

from benchmarks.instruments.peers import DARK, LIT, SIZE, SensorPeer
from sts_jax import hardware
from sts_jax.hardware.sts import Settling, Switch, settling_times, switched_share

SETTLING = Settling(visual_s=0.1, tactile_s=0.1)


def config(url, **changes):
    return hardware.CameraConfig(url, *SIZE, **{"lock": False, "timeout_s": 5.0, **changes})


@pytest.fixture
def peer(tmp_path):
    made = SensorPeer(tmp_path / "leds")
    yield made
    made.stop()


@pytest.fixture
def sensor(peer):
    given = config(peer.url, frozen_after_s=None)
    with hardware.STS(camera=given, leds=peer.path, settling=SETTLING).connect(0.2) as made:
        yield made


def judged(peer, *pairs):
    """Whether the frame of each image had its stream's light during all of its exposure."""
    shots = [shot for pair in pairs for shot in (pair.visual, pair.tactile)]
    assert [shot.stream for shot in shots] == ["visual", "tactile"] * len(pairs)
    return all(peer.judged(shot.image, lit=shot.stream == "tactile") for shot in shots)


@pytest.mark.parametrize(("lag_s", "exposure_s"), [(0.015, 0.002), (0.05, 0.016), (0.12, 0.016)])
def test_pairs_are_of_the_right_light(tmp_path, lag_s, exposure_s):
    peer = SensorPeer(tmp_path / "leds", lag_s=lag_s, exposure_s=exposure_s)
    with hardware.STS(camera=config(peer.url), leds=peer.path).connect(0.2) as sensor:
        assert min(sensor.settling.visual_s, sensor.settling.tactile_s) > lag_s + exposure_s
        pairs = [sensor.read() for _ in range(12)]
    peer.stop()
    assert judged(peer, *pairs)
    for pair in pairs:
        assert abs(int(pair.visual.image[60:, 60].mean()) - DARK) <= 3
        assert abs(int(pair.tactile.image[60:, 60].mean()) - LIT) <= 3
    assert len({shot.sequence for pair in pairs for shot in (pair.visual, pair.tactile)}) == 24


def test_an_object_that_moves_is_not_taken_for_the_light():
    """An object covers a quarter of the view and moves far, and the light changes each block by 3 of 255 only."""
    random = np.random.default_rng(0)
    empty = random.uniform(80, 160, (24, 32, 3)).astype(np.float32)
    light = 3 * random.choice([-1, 1], empty.shape).astype(np.float32)

    def view(lit, column, thickness):
        """The object is dark without the light, and shows its contact only with the light."""
        image = empty + lit * light + random.normal(0, 0.2, empty.shape).astype(np.float32)
        image[:, column : column + thickness] -= 20 if lit else 70
        return image

    dark, lit, before = view(0, 2, 8), view(1, 2, 2), view(0, 2, 8)
    moved, switched = view(0, 20, 8), view(1, 20, 2)
    assert np.abs(moved - before).mean() > 3 * np.abs(light).mean()
    assert abs(switched_share(moved, before, lit - dark)) < 0.2
    assert switched_share(switched, before, lit - dark) == pytest.approx(1, abs=0.2)
    assert switched_share(moved, lit, dark - lit) == pytest.approx(1, abs=0.2)
    assert switched_share(before, before, np.zeros_like(before)) == 0


def test_settling_time_of_known_switches_is_that_of_the_last_mixed_frame():
    dark, lit = np.zeros((24, 32, 3), np.float32), np.full((24, 32, 3), 100, np.float32)
    mixes = np.array([0, 0, 0.3, 0.97, 0.995, 1], np.float32)[:, None, None, None]
    delays = np.array([-0.01, 0.01, 0.03, 0.05, 0.07, 0.09], np.float32)
    on, off = Switch(delays, dark + mixes * lit), Switch(delays + 0.001, lit - mixes * lit)
    found = settling_times([on, on], [off], period_s=0.02)
    np.testing.assert_allclose((found.tactile_s, found.visual_s), (0.07, 0.071), rtol=1e-5)
    with pytest.raises(hardware.LightError, match="wiring"):
        settling_times([on], [on], period_s=0.02)


@pytest.mark.parametrize(("duty", "dwell"), [(0.0, 1), (0.25, 1), (0.5, 3), (1.0, 1)])
def test_stream_dwells_and_has_the_share_of_tactile_images(peer, sensor, duty, dwell):
    images = sensor.stream(duty, dwell=dwell)
    shots = [next(images) for _ in range(12)]
    assert sum(shot.stream == "tactile" for shot in shots) == round(12 * duty)
    assert all(len({shot.stream for shot in shots[i : i + dwell]}) == 1 for i in range(0, 12, dwell))
    assert all(peer.judged(shot.image, lit=shot.stream == "tactile") for shot in shots)


def test_lights_that_go_off_in_between_are_noticed(peer, sensor):
    """The watchdog fires while frames are taken. No image has the wrong label."""
    stopped = threading.Event()

    def disturb():
        while not stopped.wait(0.35):
            peer.leds.fire_watchdog()

    thread = threading.Thread(target=disturb)
    thread.start()
    try:
        assert judged(peer, *(sensor.read() for _ in range(5)))
    finally:
        stopped.set()
        thread.join()
    assert sensor.discarded > 0


@pytest.mark.parametrize("mode", ["stall", "held"])
def test_late_frames_do_not_pass_as_new(peer, sensor, mode):
    for _ in range(3):
        sensor.read()
        peer.camera.mode = mode
        threading.Timer(0.4, lambda: setattr(peer.camera, "mode", "live")).start()
        assert judged(peer, sensor.read(), sensor.read())


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ("blind", hardware.LightError, "check that the LEDs light up"),
        ("lost", hardware.CameraLostError, "was lost"),
        ("black", hardware.LightError, "frames are black now"),
        ("repeat", hardware.LightError, "enough frames arrive"),
    ],
)
def test_faults_are_named_and_pass(peer, fault, error, message):
    with hardware.STS(camera=config(peer.url, frozen_after_s=30), leds=peer.path, settling=SETTLING) as sensor:
        last = sensor.read()
        if fault == "lost":
            peer.camera.stop()
        elif fault == "blind":
            peer.camera.blind = True
            time.sleep(0.3)  # on a busy computer, earlier frames are still on their way, and a pair from these is right
        else:
            peer.camera.mode = fault
        with pytest.raises(error, match=message):
            sensor.read(timeout_ms=800)
        if fault == "lost":
            peer.camera.start()
        peer.camera.mode, peer.camera.blind = "live", False
        pair = sensor.read()
        assert judged(peer, pair)
        assert pair.visual.sequence > last.tactile.sequence


def disturb_once(monkeypatch, peer, sensor, late=()):
    """The watchdog fires before the next proof. Returns two lists: the answers before it, and then late lights."""
    proof, fired, lights = sensor._proof, [], []

    def disturbed(before, then):
        if not fired:
            fired.append(before)
            peer.leds.fire_watchdog()
            lights.extend(late)
        return proof(before, then)

    monkeypatch.setattr(sensor, "_proof", disturbed)
    return fired, lights


@pytest.mark.parametrize("first", ["visual", "tactile"])
def test_the_watchdog_is_not_mistaken_for_a_switch(peer, sensor, monkeypatch, first):
    """The lights go off just before the request that is to turn them off or on."""
    sensor.read()
    while sensor._stream != first:
        next(sensor.stream(first == "tactile"))
    fired, _ = disturb_once(monkeypatch, peer, sensor)
    pair = sensor.read()
    assert (getattr(pair, first).before.counter > fired[0].counter) == (first == "tactile")
    assert judged(peer, pair)


def test_late_frames_of_two_switches_are_not_mixed_up(peer, sensor, monkeypatch):
    """The watchdog fires, the lights are set again, and only then the frames around the watchdog's switch arrive."""
    last = sensor.read().tactile
    sequence = itertools.count(last.sequence + 1000)
    fired, late = disturb_once(monkeypatch, peer, sensor, late=[0.0, 0.7, 1.0])

    def async_read(timeout_ms):
        time.sleep(2 * SETTLING.tactile_s if len(late) == 3 else 0.02)
        light = late.pop() if late else peer.leds.controller.levels != (0, 0, 0, 0)
        image = np.full((SIZE[1], SIZE[0], 3), round(DARK + light * (LIT - DARK)), np.uint8)
        return hardware.Captured(image, time.monotonic(), next(sequence), last.epoch)

    monkeypatch.setattr(sensor.camera, "async_read", async_read)
    pair = sensor.read()
    assert fired[0].levels == (255, 255, 255, 255)
    assert not late
    assert (pair.visual.image == DARK).all()
    assert (pair.tactile.image == LIT).all()


@pytest.mark.parametrize("settling", [SETTLING, None])
def test_no_contrast_is_named_and_devices_are_closed(peer, settling):
    peer.camera.blind = True
    sensor = hardware.STS(camera=config(peer.url), leds=peer.path, settling=settling)
    with pytest.raises(hardware.LightError, match="wiring and levels"):
        sensor.connect(0.1)
    assert not sensor.camera.is_connected
    with pytest.raises(hardware.CameraError, match=r"call connect\(\) first"):
        sensor.read()


class Backend:
    """A camera of ten lines that sees the lights of a controller."""

    source, is_connected, number = "backend", False, 0

    def __init__(self, peer):
        self.peer = peer

    def connect(self, warmup_s=1.0):
        self.is_connected = True

    def async_read(self, timeout_ms=None):
        lit, self.number = any(self.peer.leds.controller.levels), self.number + 1
        time.sleep(0.01)
        return hardware.Captured(np.full((48, 64, 3), 60 + 100 * lit, np.uint8), time.monotonic(), self.number)

    def disconnect(self):
        self.is_connected = False


def test_a_camera_of_another_backend_is_a_sensor(peer):
    camera = Backend(peer)
    assert isinstance(camera, hardware.Camera)
    with hardware.STS(camera=camera, leds=peer.path) as sensor:
        assert sensor.settling.tactile_s < 0.1
        for _ in range(5):
            pair = sensor.read()
            assert (pair.visual.image == 60).all()
            assert (pair.tactile.image == 160).all()
        with pytest.raises(hardware.CameraError, match="backend does not support a manual exposure"):
            hardware.STS(camera=camera, leds=sensor.leds, exposures=(1.0, 2.0)).connect()
    assert not camera.is_connected


def test_open_devices_are_connected_when_the_block_begins(peer):
    with hardware.Leds.connect(peer.path) as leds:
        camera = Backend(peer)
        camera.connect()
        with hardware.STS(camera=camera, leds=leds, settling=SETTLING) as sensor:
            pair = sensor.read()
            assert (pair.visual.image.max(), pair.tactile.image.min()) == (60, 160)
            with sensor as same:
                assert same is sensor


def test_a_controller_that_returns_is_found_again_and_extends_the_limit(tmp_path, peer):
    given = config(peer.url, frozen_after_s=None)
    with hardware.STS(camera=given, leds=peer.path, settling=SETTLING, timeout_s=1.0).connect(0.2) as sensor:
        sensor.read()
        peer.unplug()
        threading.Timer(2.5, lambda: peer.plug_in(tmp_path / "leds")).start()
        assert judged(peer, sensor.read())  # longer than the limit of a pair, 2 s


def test_a_sensor_of_an_open_controller_connects_again(peer):
    leds = hardware.Leds.connect(peer.path)
    sensor = hardware.STS(camera=config(peer.url, frozen_after_s=None), leds=leds, settling=SETTLING)
    for _ in range(2):
        with sensor.connect(0.2):
            assert judged(peer, sensor.read())
        assert peer.leds.controller.levels == (0, 0, 0, 0)
        sensor.disconnect()  # does nothing


def test_wait_until_still(peer, sensor):
    peer.camera.numbered, peer.camera.moving = False, True
    with pytest.raises(TimeoutError, match=r"within 0\.8 s, there was no period of 0\.3 s without movement"):
        sensor.wait_until_still(0.8, window_s=0.3)
    threading.Timer(0.4, lambda: setattr(peer.camera, "moving", False)).start()
    shot = sensor.wait_until_still(20, window_s=0.3)
    assert shot.stream == "visual"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: hardware.STS(camera=0, leds="/dev/null", levels=(255,)), "4 integers"),
        (lambda: hardware.STS(camera=0, leds="/dev/null").stream(1.5), r"duty, .*, must be in \[0, 1\], got 1.5"),
        (lambda: hardware.STS(camera=0, leds="/dev/null").stream(dwell=0), "dwell must be >= 1, got 0"),
        (lambda: Settling(0.0, 1.0), r"visual_s must be in \(0, 60\) s, got 0"),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_each_reconnection_during_a_pair_extends_its_deadline(sensor, monkeypatch):
    """The controller is lost in the second image, and the images before and after the loss form no pair."""
    pair, left_s = sensor.read(), []

    def shot(stream, deadline, **options):
        left_s.append(deadline - sensor._worked_s())
        image = getattr(pair, stream)
        if len(left_s) == 2:
            sensor._lost_s += 5.0
            return dataclasses.replace(image, epoch=image.epoch + 1)
        return image

    monkeypatch.setattr(sensor, "_shot", shot)
    again = sensor.read(timeout_ms=100_000)
    assert (again.visual, again.tactile) == (pair.visual, pair.tactile)
    np.testing.assert_allclose(left_s, [100, 100, 105, 105], atol=2)
