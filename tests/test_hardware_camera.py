"""The camera against a motion JPEG server with injected faults, and against a fake device of OpenCV."""

import concurrent.futures
import re
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.instruments.peers import SIZE, MotionJpeg, number_of
from sts_jax.hardware import (
    CameraConfig,
    CameraError,
    CameraLostError,
    CameraTimeoutError,
    FrameSizeError,
    FrozenCameraError,
    OpenCVCamera,
    find_cameras,
    opencv,
)
from sts_jax.hardware.camera import Pace, stable_path

SOON_S = 20.0  # generous limit of waits


@pytest.fixture(autouse=True)
def no_thread_is_left():
    yield
    assert wait_until(lambda: not camera_threads())


@pytest.fixture
def server():
    server = MotionJpeg()
    yield server
    server.mode = "live"
    server.stop()


def camera_threads():
    return [thread for thread in threading.enumerate() if thread.name.startswith("sts_jax ")]


def wait_until(condition):
    end = time.monotonic() + SOON_S
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)
    return condition()


def config(source, **changes):
    return CameraConfig(**{"source": source, "width": SIZE[0], "height": SIZE[1], "lock": False} | changes)


def connected(server, **changes):
    return OpenCVCamera(config(server.url, **changes)).connect(warmup_s=0)


def next_error(camera, kind, timeout_ms=400):
    """Read until there is an error of a kind. Frames that come before it are valid."""
    end = time.monotonic() + SOON_S
    while time.monotonic() < end:
        try:
            assert camera.async_read(timeout_ms).image.shape == (SIZE[1], SIZE[0], 3)
        except kind as error:
            return error
        except CameraTimeoutError:
            pass
    raise AssertionError(f"no {kind.__name__}")


def next_frame(camera):
    """Read until there is a frame."""
    end = time.monotonic() + SOON_S
    while True:
        try:
            return camera.async_read(1000)
        except CameraError:
            if time.monotonic() > end:
                raise


# Frames


def test_read_never_returns_a_frame_that_was_served_before_the_call(server):
    with connected(server) as camera:
        assert not camera.async_read().delayed
        for pause in (0.0, 0.01, 0.1, 0.003) * 5:
            time.sleep(pause)
            called = time.monotonic()
            frame = camera.read()
            assert frame.time_s > called
            assert server.served[number_of(frame.image)] > called


def test_read_discards_frames_that_the_network_held_back(server):
    with connected(server) as camera:
        for _ in range(10):  # the period must be measured
            camera.async_read()
        server.mode = "held"
        time.sleep(0.3)
        threading.Timer(0.1, lambda: setattr(server, "mode", "live")).start()
        called = time.monotonic()
        frame = camera.read()
        assert server.served[number_of(frame.image)] > called


def test_async_read_returns_every_frame_in_order_and_without_a_buffer_the_newest(server):
    with connected(server, buffer=50) as camera:
        time.sleep(0.4)
        frames = [camera.async_read() for _ in range(30)]
        assert camera.statistics.skipped == 0
    assert np.all(np.diff([(number_of(frame.image), frame.sequence) for frame in frames], axis=0) == 1)
    assert np.all(np.diff([frame.time_s for frame in frames]) > 0)
    with connected(server) as camera:
        assert wait_until(lambda: camera.statistics.skipped > 5)


def test_read_latest_returns_the_newest_frame_at_once_unless_it_is_old(server):
    with connected(server, buffer=50, timeout_s=0.5) as camera:
        camera.read()
        time.sleep(0.3)
        newest = camera.read_latest()
        assert camera.read_latest(max_age_ms=1000).sequence >= newest.sequence
        assert camera.async_read().sequence < newest.sequence  # the queue is as before
        with pytest.raises(CameraTimeoutError, match="more than max_age_ms=0"):
            camera.read_latest(max_age_ms=0)


def test_images_are_rgb_and_read_only():
    server = MotionJpeg(colour=(0, 0, 255))  # red for OpenCV
    with connected(server) as camera:
        image = camera.read().image
    server.stop()
    np.testing.assert_allclose(image[40:, 40:].reshape(-1, 3).mean(0), [255, 0, 0], atol=15)
    assert image.dtype == np.uint8
    assert not image.flags.writeable


JITTER = 0.1 * np.arange(200) + np.random.default_rng(0).uniform(0, 0.06, 200)
JITTER[50:53] = [5.16, 5.2, 5.25]  # late, and made up for


@pytest.mark.parametrize(
    ("times", "nominal", "rate", "dropped"),
    [
        ([0.05 * n + 0.002 * (n % 3) for n in range(60) if n not in (20, 30, 31, 40, 41, 42)], None, 20, 6),
        ([*0.1 * np.arange(20), 2.3, 2.31, 2.32, 2.33, 2.4], None, 10, 0),  # four frames arrive together, none is lost
        ([*0.1 * np.arange(10), *(5.0 + 0.002 * np.arange(41)), *(5.1 + 0.1 * np.arange(9))], None, 10, 0),  # held back
        ([*0.1 * np.arange(10), *(1.5 + 0.02 * np.arange(100))], None, 50, None),  # faster after a gap
        (JITTER, 10.0, 10, 0),
    ],
)
def test_rate_and_lost_frames_follow_from_the_times(times, nominal, rate, dropped):
    pace = Pace(nominal)
    estimates = [pace.arrived(time_s) for time_s in times]
    assert pace.rate == pytest.approx(rate, rel=0.1)
    assert not pace.delayed
    assert dropped is None or pace.dropped == dropped
    if dropped:
        assert [lost for lost in estimates if lost] == [1, 2, 3]


def test_frames_that_may_have_waited_are_marked():
    """The frames of 1.0 to 1.5 s arrive together at 1.52 s, the camera misses one, and then is found again."""
    pace, held = Pace(None), []
    for time_s in [*0.1 * np.arange(10), *(1.52 + 0.002 * np.arange(6)), 1.6, 1.7, 1.9, 2.0, 5.0, 5.002, 5.1, 5.2]:
        if time_s == 5.0:
            pace.interrupted()
        pace.arrived(time_s)
        held.append(pace.delayed)
    assert np.flatnonzero(held).tolist() == [10, 11, 12, 13, 14, 15, 20, 21]


def test_two_threads_never_get_the_same_frame(server):
    with connected(server, buffer=10) as camera, concurrent.futures.ThreadPoolExecutor(2) as pool:
        sequences = pool.map(lambda _: camera.async_read().sequence, range(40))
        assert len(set(sequences)) == 40


# Faults


@pytest.mark.parametrize(
    ("mode", "error", "message"),
    [
        ("stall", CameraLostError, "was lost.* check its cable or its server"),
        ("stopped", CameraLostError, "was lost"),
        ("repeat", FrozenCameraError, "the same image"),
        ("small", FrameSizeError, "80 x 60 pixels, but 160 x 120"),
        ("damaged", CameraTimeoutError, r"within 400 ms .[1-9]\d* damaged"),
    ],
)
def test_faults_are_named_until_they_end(server, mode, error, message):
    with connected(server, timeout_s=1.0, frozen_after_s=0.3) as camera:
        before, lost = camera.read(), error is CameraLostError
        if mode == "stopped":
            server.stop()
        server.mode = mode
        assert re.search(message, str(next_error(camera, error)))
        assert camera.is_connected != lost
        if lost:
            with pytest.raises(CameraLostError):
                camera.read(100)  # a call during the loss waits for its own time
        server.mode = "live"
        if mode == "stopped":
            server.start()
        after = next_frame(camera)
        assert (before.epoch, after.epoch, after.repeats) == (0, lost, 0)
        assert after.sequence > before.sequence
        assert after.time_s > before.time_s


@pytest.mark.parametrize(("mode", "frozen_after_s"), [("repeat", None), ("black", 0.2), ("white", 0.2)])
def test_repeated_images_on_request_and_black_or_white_images_are_not_refused(server, mode, frozen_after_s):
    with connected(server, frozen_after_s=frozen_after_s) as camera:
        assert not camera.read().black
        server.mode = mode
        first = camera.read()
        assert wait_until(lambda: camera.async_read().sequence > first.sequence + 60)  # longer than the default limit
        last = camera.read()
        assert np.array_equal(first.image, last.image)
        assert (last.black, last.repeats > 20) == (mode == "black", mode != "repeat")


def test_disconnect_ends_a_read_in_another_thread(server):
    with concurrent.futures.ThreadPoolExecutor() as pool:
        camera = connected(server, timeout_s=1.0)
        reading = pool.submit(lambda: [camera.read(60_000) for _ in range(10_000)])
        server.mode = "stall"
        camera.disconnect()
        assert "not connected" in str(reading.exception(SOON_S))


def test_a_camera_connects_again_after_disconnect(server):
    camera = OpenCVCamera(config(server.url))
    for _ in range(2):
        assert camera.connect(warmup_s=0) is camera
        assert camera.is_connected
        assert camera.read().epoch == 0
        with pytest.raises(CameraError, match="is connected already"):
            camera.connect()
        camera.disconnect()
        camera.disconnect()
        assert not camera.is_connected
        for call in (camera.read, camera.async_read, camera.read_latest):
            with pytest.raises(CameraError, match=r"call connect\(\)"):
                call()


# Opening


@pytest.mark.parametrize("mode", ["missing", "text", "hang", "stall", "stopped"])
def test_a_server_without_video_is_named(server, mode):
    if mode == "stopped":
        server.stop()
    server.mode = mode
    with pytest.raises(CameraError, match=r"http://.* cannot be opened: check the address"):
        connected(server, timeout_s=0.5)
    if mode == "stopped":
        server.start()


def test_what_a_stream_cannot_do_is_named(server):
    with pytest.raises(FrameSizeError, match=r"160 x 120 pixels, but 1640 x 1232 .* give CameraConfig a size"):
        connected(server, width=1640, height=1232)
    with pytest.raises(UserWarning, match=r"AUTO_EXPOSURE and AUTO_WB of a stream cannot.*lock=False"):
        connected(server, lock=True)
    assert not camera_threads()
    with connected(server, width=None, height=None) as camera:
        assert camera.read().image.shape == (SIZE[1], SIZE[0], 3)
        with pytest.raises(CameraError, match="set the exposure at its server"):
            camera.set_exposure(80)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"source": 987}, r"camera 987 cannot be opened: it is missing, .* Cameras found: "),
        ({"source": "/dev/null"}, r"/dev/null cannot be opened: .*group video, or it is no camera"),
        ({"source": "rtsp://user:secret@127.0.0.1:1/live", "timeout_s": 0.5}, "^rtsp://127.0.0.1:1/live cannot be"),
        ({"source": -1}, "index >= 0"),
        ({"source": ""}, "a path or a URL, got ''"),
        ({"height": None}, "both be None, got 160 x None"),
        ({"width": 0}, "width must be > 0 and finite, got 0"),
        ({"timeout_s": float("inf")}, "timeout_s must be > 0 and finite"),
        ({"fourcc": "JPEGS"}, "four characters"),
    ],
)
def test_a_source_that_does_not_open_and_invalid_values_are_named(changes, message):
    with pytest.raises((CameraError, ValueError), match=message):
        OpenCVCamera(config(**{"source": 0} | changes)).connect()


# Devices


class Device:
    """A V4L2 device of OpenCV, which this test machine lacks. Unplugged, it returns no frames and cannot be opened.

    Values are whole, and the exposure is ignored while its control is automatic.
    """

    plugged, stuck, late = True, (), 0

    def __init__(self, **values):
        self.values = {getattr(cv2, f"CAP_PROP_{name}"): value for name, value in values.items()}

    def get(self, prop):
        return float(self.values.get(prop, -1))

    def set(self, prop, value):
        automatic = prop == cv2.CAP_PROP_EXPOSURE and self.values.get(cv2.CAP_PROP_AUTO_EXPOSURE) == 3
        if prop in self.values and prop not in self.stuck and not automatic:
            self.values[prop] = round(value)

    def isOpened(self):
        return self.plugged

    def grab(self):
        if self.late:  # frames that wait in the driver
            self.late -= 1
        else:
            time.sleep(0.01)
            self.values[cv2.CAP_PROP_POS_MSEC] = 5e6 + 1000 * time.monotonic()
        return self.plugged

    def retrieve(self):
        return True, np.random.default_rng().integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8)

    def release(self):
        pass


@pytest.fixture
def device(monkeypatch):
    automatic = {"AUTO_EXPOSURE": 3, "EXPOSURE": 157, "AUTO_WB": 1, "WB_TEMPERATURE": 4600}
    size = {"FRAME_WIDTH": 0, "FRAME_HEIGHT": 0, "FPS": 100, "POS_MSEC": 5e6, "FOURCC": 0}
    device = Device(**automatic, **size)
    monkeypatch.setattr(opencv, "_open", lambda config: device)
    return device


def test_a_device_is_locked_after_its_warm_up_and_again_after_a_loss(device):
    with OpenCVCamera(config(0, lock=True, fourcc="MJPG")).connect(warmup_s=0.05) as camera:
        assert camera.read().dropped == 0
        assert camera.locked == {"exposure": 157, "white_balance": 4600}
        assert [device.get(prop) for prop in (cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_AUTO_WB)] == [1, 0]
        assert camera.set_exposure(80.4) == 80
        assert camera.locked == {"exposure": 80, "white_balance": 4600}
        device.plugged = False
        assert next_error(camera, CameraLostError)
        device.set(cv2.CAP_PROP_EXPOSURE, 157)  # a device forgets its settings without power
        device.set(cv2.CAP_PROP_AUTO_WB, 1)
        device.plugged = True
        assert next_frame(camera).epoch == 1
        assert [device.get(prop) for prop in (cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_AUTO_WB)] == [80, 0]
        get, device.get = device.get, lambda prop: -1.0  # while the camera is being unplugged
        assert camera.set_exposure(60) is None
        device.get = get
        assert camera.locked == {"exposure": 80, "white_balance": 4600}
        device.stuck = {cv2.CAP_PROP_AUTO_EXPOSURE}
        device.values[cv2.CAP_PROP_AUTO_EXPOSURE] = 3
        assert camera.set_exposure(60) is None
        with pytest.raises(ValueError, match="exposure must be > 0, got 0"):
            camera.set_exposure(0)
    device.stuck = set()
    with OpenCVCamera(config(0, exposure=70)).connect(warmup_s=0) as camera:  # lock=False
        assert camera.locked == {"exposure": 70}
        assert [device.get(prop) for prop in (cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_AUTO_WB)] == [70, 0]


def test_what_a_device_refuses_is_named_with_both_values(device):
    device.stuck = {cv2.CAP_PROP_AUTO_WB}
    with pytest.warns(UserWarning, match=r"camera 0 did not accept a setting. AUTO_WB: asked for 0, found 1"):
        OpenCVCamera(config(0, lock=True)).connect(warmup_s=0).disconnect()
    device.stuck = {cv2.CAP_PROP_FRAME_WIDTH}
    device.values[cv2.CAP_PROP_FRAME_WIDTH] = 640
    with pytest.raises(FrameSizeError, match=r"640 x 120 pixels, but 160 x 120 .*v4l2-ctl -d /dev/video0"):
        OpenCVCamera(config(0)).connect()
    device = Device(AUTO_EXPOSURE=3, EXPOSURE=157)
    device.stuck = {cv2.CAP_PROP_AUTO_EXPOSURE}
    assert opencv.lock(device, {"exposure": 80.0, "focus": 3.0}, current=True)[1] == [
        "AUTO_EXPOSURE: asked for 1, found 3",
        "EXPOSURE: asked for 80, found 157",
        "AUTO_WB: asked for 0, the driver lacks it",
        "AUTOFOCUS: asked for 0, the driver lacks it",
        "FOCUS: asked for 3, the driver lacks it",
    ]


def test_cameras_are_found_by_serial_number_and_number(tmp_path):
    dev, properties = tmp_path / "dev", tmp_path / "sys/class/video4linux"
    for number, index in ((0, 0), (1, 1), (2, 0), (10, 0)):
        (properties / f"video{number}").mkdir(parents=True)
        (properties / f"video{number}/index").write_text(f"{index}\n")
        (properties / f"video{number}/name").write_text(f"Camera {number}\n")
        dev.mkdir(exist_ok=True)
        (dev / f"video{number}").write_bytes(b"")
    (dev / "v4l/by-id").mkdir(parents=True)
    (dev / "v4l/by-id/usb-A_123").symlink_to(dev / "video0")
    found = find_cameras(tmp_path)
    assert [Path(camera.source).name for camera in found] == ["usb-A_123", "video2", "video10"]
    assert str(found[1]).endswith("video2 (Camera 2)")
    assert stable_path(str(dev / "video0"), tmp_path) == found[0].source
    assert stable_path(str(dev / "video2"), tmp_path) == str(dev / "video2")


def test_frames_that_waited_in_the_driver_are_delayed(device):
    with OpenCVCamera(config(0, buffer=30)).connect(warmup_s=0.2) as camera:
        assert not any(camera.async_read().delayed for _ in range(10))
        grab, stalled = device.grab, []

        def stall():
            if not stalled:
                stalled.append(time.sleep(0.3))
                device.late = 4
            return grab()

        device.grab = stall
        shown = [camera.async_read() for _ in range(20)]
        assert sum(frame.delayed for frame in shown) >= 4
        device.late = 0
        device.plugged = False
        assert next_error(camera, CameraLostError)
        device.plugged = True
        assert next_frame(camera).delayed  # the first frame after the camera was found
        assert not camera.read().delayed
