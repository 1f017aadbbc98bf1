"""The camera against real sources: a motion JPEG server with injected faults, and video files."""

import dataclasses
import os
import random
import re
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.instruments.camera_server import SIZE, MotionJpeg, draw, number_of
from sts_jax.hardware import (
    CameraBusyError,
    CameraConfig,
    CameraError,
    CameraLostError,
    CameraNotConnectedError,
    CameraNotFoundError,
    CameraOpenError,
    CameraPermissionError,
    CameraTimeoutError,
    EndOfVideoError,
    FrameSizeError,
    FrozenCameraError,
    OpenCVCamera,
    StaleFrameError,
    find_cameras,
    is_black,
    opencv,
)
from sts_jax.hardware import (
    camera as cameras,
)

FRAMES = 40  # of the test video
SOON_S = 20.0  # generous limit of waits


@pytest.fixture(autouse=True)
def own_locks(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("run")))


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


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    path = tmp_path_factory.mktemp("video") / "numbers.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 50, SIZE)
    for number in range(FRAMES):
        writer.write(draw(number))
    writer.release()
    return path


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


def read_file(camera, pauses=(0.0,)):
    """All frames of a file, with pauses between the calls, and the error at its end."""
    found = []
    try:
        while True:
            found.append(camera.async_read())
            time.sleep(pauses[len(found) % len(pauses)])
    except EndOfVideoError as error:
        return found, error


# Frames


def test_read_never_returns_a_frame_that_was_served_before_the_call(server):
    with connected(server) as camera:
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


def test_async_read_returns_new_frames_in_order(server):
    with connected(server) as camera:
        frames_read = [camera.async_read() for _ in range(40)]
    sequences = [frame.sequence for frame in frames_read]
    times = [frame.time_s for frame in frames_read]
    numbers = [number_of(frame.image) for frame in frames_read]
    assert np.all(np.diff(sequences) > 0)
    assert np.all(np.diff(times) > 0)
    assert np.array_equal(np.diff(numbers), np.diff(sequences))  # each frame of the server has one number here
    assert {frame.epoch for frame in frames_read} == {0}


def test_a_buffer_keeps_every_frame_for_a_slow_reader(server):
    with connected(server, buffer=50) as camera:
        time.sleep(0.4)
        numbers = [number_of(camera.async_read().image) for _ in range(20)]
        assert camera.statistics.skipped == 0
    assert np.all(np.diff(numbers) == 1)


def test_frames_that_nobody_fetches_are_counted_as_skipped(server):
    with connected(server) as camera:
        assert wait_until(lambda: camera.statistics.skipped > 5)
        assert camera.statistics.dropped == 0


def test_images_are_rgb_and_read_only():
    server = MotionJpeg(colour=(0, 0, 255))  # red for OpenCV
    try:
        with connected(server) as camera:
            image = camera.read().image
    finally:
        server.stop()
    assert image.dtype == np.uint8
    red, green, blue = image[40:, 40:].reshape(-1, 3).mean(0)
    assert red > 240
    assert green < 15
    assert blue < 15
    with pytest.raises(ValueError, match="read-only"):
        image[0, 0] = 0


def test_lost_frames_are_counted_from_the_times(server):
    with connected(server, buffer=200) as camera:
        assert wait_until(lambda: camera.statistics.rate is not None)
        start = server.number + 20
        server.skipped = set(range(start, start + 40))
        server.mode = "skip"
        frame = camera.async_read()
        while number_of(frame.image) < start + 40:
            frame = camera.async_read()
        assert 20 < frame.dropped < 80  # 40, if the machine is not busy
        assert camera.statistics.dropped >= frame.dropped


def test_gaps_in_the_times_are_lost_frames():
    pace = opencv.Pace(None)
    numbers = [n for n in range(60) if n not in (20, 30, 31, 40, 41, 42)]
    estimates = {n: pace.arrived(0.05 * n + 0.002 * (n % 3)) for n in numbers}
    assert {n: lost for n, lost in estimates.items() if lost} == {21: 1, 32: 2, 43: 3}
    assert pace.dropped == 6
    assert pace.rate == pytest.approx(20, rel=0.1)


def test_frames_that_are_only_late_are_not_counted_as_lost():
    pace = opencv.Pace(None)
    times = [0.1 * i for i in range(20)] + [2.3, 2.31, 2.32, 2.33, 2.4]  # four frames arrive together
    estimates = [pace.arrived(time_s) for time_s in times]
    assert estimates[20] == 3
    assert sum(estimates) == 3
    assert pace.dropped == 0
    assert pace.rate == pytest.approx(10)


def test_frames_that_a_network_held_back_are_known():
    """The frames of 1.0 to 1.5 s arrive together at 1.52 s, and then the camera misses one."""
    pace, held = opencv.Pace(None), []
    times = [*0.1 * np.arange(10), *(1.52 + 0.002 * np.arange(6)), 1.6, 1.7, 1.9, 2.0]
    for time_s in times:
        pace.arrived(time_s)
        held.append(pace.delayed)
    assert held == [10 <= i < 16 for i in range(20)]


def test_frames_that_a_network_held_back_do_not_change_the_measured_rate():
    pace = opencv.Pace(None)
    for time_s in [*0.1 * np.arange(10), *(5.0 + 0.002 * np.arange(41)), *(5.1 + 0.1 * np.arange(9))]:
        pace.arrived(time_s)
    assert pace.rate == pytest.approx(10, rel=0.01)
    assert pace.dropped == 0


def test_a_camera_that_becomes_faster_after_a_gap_is_measured_again():
    pace = opencv.Pace(None)
    for time_s in [*0.1 * np.arange(10), *(1.5 + 0.02 * np.arange(100))]:
        pace.arrived(time_s)
    assert pace.rate == pytest.approx(50)
    assert not pace.delayed


def test_the_first_frame_after_an_interruption_may_have_waited():
    pace, delayed = opencv.Pace(10.0), []
    for time_s in (0.0, 0.1, 0.2):
        pace.arrived(time_s)
    pace.interrupted()
    for time_s in (3.0, 3.002, 3.1, 3.2):
        pace.arrived(time_s)
        delayed.append(pace.delayed)
    assert delayed == [True, True, False, False]


def test_jitter_is_not_counted_as_loss():
    pace = opencv.Pace(10.0)
    times = 0.1 * np.arange(200) + np.random.default_rng(0).uniform(0, 0.06, 200)
    times[50:53] = [5.16, 5.2, 5.25]  # late, and made up for
    for time_s in times:
        pace.arrived(time_s)
        assert not pace.delayed
    assert pace.dropped == 0
    for time_s in times[-1] + [0.2, 0.3, 0.4]:  # one frame is missing
        pace.arrived(time_s)
    assert pace.dropped == 1


def test_read_latest_refuses_an_old_frame(server):
    with connected(server) as camera:
        frame = camera.read()
        assert camera.read_latest(max_age_ms=5000).sequence >= frame.sequence
        server.mode = "stall"
        assert wait_until(lambda: time.monotonic() - camera.read_latest(1e6).time_s > 0.3)
        with pytest.raises(StaleFrameError, match=r"ms old, but at most 100 ms"):
            camera.read_latest(max_age_ms=100)
        server.mode = "live"


def test_two_threads_never_get_the_same_frame(server):
    got = [[], []]

    def work(mine):
        mine.extend(camera.async_read().sequence for _ in range(20))

    with connected(server, buffer=10) as camera:
        threads = [threading.Thread(target=work, args=(mine,)) for mine in got]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert len(set(got[0] + got[1])) == 40


# Faults


def test_a_stalled_stream_is_a_timeout_and_then_a_loss(server):
    with connected(server, timeout_s=1.0) as camera:
        camera.read()
        server.mode = "stall"
        error = next_error(camera, CameraTimeoutError, timeout_ms=100)
        assert re.search(r"within 100 ms.*the last one", str(error))
        error = next_error(camera, CameraLostError)
        assert "check its cable or its server" in str(error)
        assert not camera.is_connected
        server.mode = "live"
        assert next_frame(camera).epoch == 1


def test_a_lost_stream_is_found_again_with_a_new_epoch(server):
    with connected(server, timeout_s=2.0) as camera:
        before = camera.read()
        server.stop()
        next_error(camera, CameraLostError)
        with pytest.raises(CameraLostError):
            camera.read_latest()
        with pytest.raises(CameraLostError):  # a call during the loss waits for its own time
            camera.read(100)
        server.start()
        after = next_frame(camera)
        assert camera.is_connected
        assert (before.epoch, after.epoch) == (0, 1)
        assert after.sequence > before.sequence
        assert after.time_s > before.time_s
        assert camera.statistics.losses == 1


def test_a_repeated_image_is_a_frozen_camera_until_it_changes(server):
    with connected(server, frozen_after_s=0.3) as camera:
        server.mode = "repeat"
        error = next_error(camera, FrozenCameraError)
        assert "the same image" in str(error)
        for call in (camera.read, camera.read_latest):
            with pytest.raises(FrozenCameraError):
                call()
        server.mode = "live"
        assert next_frame(camera).repeats == 0
        assert camera.statistics.repeated > 5


def test_repeated_images_are_allowed_on_request(server):
    with connected(server, frozen_after_s=None) as camera:
        server.mode = "repeat"
        assert wait_until(lambda: camera.async_read().repeats > 60)  # longer than the limit of the default


def test_black_images_are_counted_and_not_refused(server):
    with connected(server, frozen_after_s=0.2) as camera:
        assert not camera.read().black
        server.mode = "black"
        assert wait_until(lambda: camera.async_read().black)
        assert wait_until(lambda: camera.read().repeats > 20)  # longer than the limit
        assert camera.statistics.black > 20
        assert is_black(camera.read().image)


def test_a_change_of_size_is_an_error_and_never_a_resize(server):
    with connected(server) as camera:
        server.mode = "small"
        error = next_error(camera, FrameSizeError)
        assert "80 x 60 pixels, but 160 x 120" in str(error)
        assert camera.statistics.wrong_size > 0
        server.mode = "live"
        next_frame(camera)


def test_damaged_frames_never_reach_the_caller(server):
    with connected(server, timeout_s=5.0) as camera:
        server.mode = "damaged"
        error = next_error(camera, CameraTimeoutError)
        assert wait_until(lambda: camera.statistics.damaged > 5)
        with pytest.raises(CameraTimeoutError, match=r"[1-9]\d* damaged"):
            camera.read(100)
        assert error is not None
        server.mode = "live"
        assert next_frame(camera).epoch == 0  # the connection was kept


def test_disconnect_ends_a_read_in_another_thread(server):
    caught = []

    def work():
        try:
            while True:
                camera.read(60_000)
        except CameraError as error:
            caught.append(error)

    camera = connected(server, timeout_s=1.0)
    thread = threading.Thread(target=work)
    thread.start()
    server.mode = "stall"
    camera.disconnect()
    thread.join(SOON_S)
    assert not thread.is_alive()
    assert isinstance(caught[0], CameraNotConnectedError)
    assert not camera_threads()


def test_a_camera_connects_again_after_disconnect(server):
    camera = OpenCVCamera(config(server.url))
    for _ in range(3):
        assert camera.connect(warmup_s=0) is camera
        assert camera.is_connected
        assert camera.read().epoch == 0
        with pytest.raises(CameraError, match="is connected already"):
            camera.connect()
        camera.disconnect()
        camera.disconnect()
        assert not camera.is_connected
        with pytest.raises(CameraNotConnectedError, match=r"call connect\(\)"):
            camera.read()


@pytest.mark.slow
def test_a_hundred_random_faults_lead_to_errors_and_back_to_frames(server):
    rng = random.Random(0)
    expected = {
        "stall": (CameraLostError, CameraTimeoutError),
        "repeat": FrozenCameraError,
        "small": FrameSizeError,
        "damaged": CameraTimeoutError,
        "close": CameraLostError,
        "refuse": CameraLostError,
    }
    epoch, number, sequence = 0, 0, -1
    with connected(server, timeout_s=1.0, frozen_after_s=0.3) as camera:
        for _ in range(100):
            fault = rng.choice(list(expected))
            if fault == "refuse":
                server.stop()
            else:
                server.mode = fault
            next_error(camera, expected[fault], timeout_ms=200)
            server.mode = "live"
            if fault == "refuse":
                server.start()
            frame = next_frame(camera)
            called = time.monotonic()
            while True:
                try:
                    frame = camera.read()
                    break
                except CameraError:
                    called = time.monotonic()
            assert server.served[number_of(frame.image)] > called
            assert number_of(frame.image) > number
            assert frame.sequence > sequence
            assert frame.epoch >= epoch
            epoch, number, sequence = frame.epoch, number_of(frame.image), frame.sequence
    assert not camera_threads()


# Opening


@pytest.mark.parametrize(
    ("mode", "message"),
    [
        ("missing", "answers 404 Not Found"),
        ("text", "content of type text/html"),
        ("hang", "has not answered within 0.5 s"),
        ("stall", "no video could be read within 0.5 s"),
    ],
)
def test_a_server_without_video_is_named(server, mode, message):
    server.mode = mode
    with pytest.raises(CameraOpenError, match=message):
        connected(server, timeout_s=0.5)


def test_a_refused_connection_is_named(server):
    server.stop()
    try:
        with pytest.raises(CameraOpenError, match=r"refuses the connection: start its server"):
            connected(server)
    finally:
        server.start()


def test_a_stream_of_another_size_is_refused(server):
    with pytest.raises(FrameSizeError, match=r"160 x 120 pixels, but 1640 x 1232 .* set width=160, height=120"):
        connected(server, width=1640, height=1232)


def test_a_stream_warns_that_its_exposure_is_not_locked(server):
    with pytest.warns(UserWarning, match=r"AUTO_EXPOSURE and AUTO_WB cannot be turned off.*lock=False"):
        connected(server, lock=True).disconnect()


def test_a_warning_that_is_an_error_leaves_no_thread(server):
    with pytest.raises(UserWarning, match="AUTO_EXPOSURE"):
        connected(server, lock=True)
    assert not camera_threads()


def test_a_password_is_not_shown():
    name = CameraConfig("rtsp://user:secret@10.0.0.1/live").name
    assert "secret" not in name
    assert "10.0.0.1/live" in name


def environment():
    """The environment of another process that imports the same package."""
    path = str(Path(opencv.__file__).parents[2])
    return os.environ | {"PYTHONPATH": os.pathsep.join([path, os.environ.get("PYTHONPATH", "")])}


OTHER_PROCESS = """
import sys
from sts_jax.hardware import CameraConfig, OpenCVCamera
camera = OpenCVCamera(CameraConfig(sys.argv[1], width=160, height=120, lock=False)).connect(0)
print("connected", flush=True)
sys.stdin.read()
"""


def test_a_camera_in_another_process_is_refused_with_its_id(server):
    command = [sys.executable, "-c", OTHER_PROCESS, server.url]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment()) as process:
        assert process.stdout.readline() == b"connected\n"
        with pytest.raises(CameraBusyError, match=f"in use by process {process.pid} .*disconnect the camera"):
            connected(server)
        process.stdin.close()
        assert process.wait(SOON_S) == 0  # without a disconnect
    connected(server).disconnect()


def test_a_camera_that_is_open_twice_in_one_process_is_refused(server):
    with connected(server), pytest.raises(CameraBusyError, match=f"process {os.getpid()}"):
        connected(server)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.avi", b"", "is empty"),
        ("noise.avi", bytes(range(256)) * 20, "cannot be read as a video"),
        ("text.txt", b"hello\n" * 100, "is a picture, a text file, or a video whose header lacks"),
        ("picture.png", cv2.imencode(".png", draw(3))[1].tobytes(), "is a picture, a text file, or a video whose"),
    ],
)
def test_a_file_that_is_no_video_is_named(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(CameraOpenError, match=message):
        OpenCVCamera(config(tmp_path / name)).connect()


def test_a_missing_source_is_named(tmp_path):
    with pytest.raises(CameraNotFoundError, match=r"no file .*gone\.avi.*Check the path"):
        OpenCVCamera(config(tmp_path / "gone.avi")).connect()
    with pytest.raises(CameraNotFoundError, match=r"no device /dev/video987\. (No cameras|Cameras) "):
        OpenCVCamera(config(987)).connect()
    with pytest.raises(CameraOpenError, match="is a folder"):
        OpenCVCamera(config(tmp_path)).connect()
    with pytest.raises(CameraOpenError, match="/dev/null is not a camera"):
        OpenCVCamera(config("/dev/null")).connect()


def test_a_device_without_permission_names_the_group(monkeypatch, video):
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # a test may run as root, who may open everything
    with pytest.raises(CameraPermissionError, match=r"/dev/null: add your user to the group video"):
        OpenCVCamera(config("/dev/null")).connect()
    with pytest.raises(CameraPermissionError, match="chmod"):
        OpenCVCamera(config(video)).connect()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"source": -1}, "index >= 0"),
        ({"source": ""}, "source is empty"),
        ({"height": None}, "both be None, got 160 x None"),
        ({"width": 0}, "width must be >= 1, got 0"),
        ({"fps": 0.0}, "fps must be > 0"),
        ({"timeout_s": float("inf")}, "timeout_s must be > 0 and finite"),
        ({"in_flight": -1}, "in_flight must be >= 0"),
        ({"fourcc": "JPEGS"}, "four characters"),
    ],
)
def test_invalid_values_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(config("x.avi"), **changes)


# Video files


def test_a_file_is_read_completely_and_then_ends(video):
    with OpenCVCamera(config(video, realtime=False)) as camera:
        read, error = read_file(camera, pauses=(0.0, 0.002, 0.004))
        assert "40 frames" in str(error)
        assert not camera.is_connected
        with pytest.raises(EndOfVideoError):
            camera.read()
    assert [number_of(frame.image) for frame in read] == list(range(FRAMES))
    assert [frame.sequence for frame in read] == list(range(FRAMES))


def test_a_file_is_played_at_its_own_rate(video):
    with OpenCVCamera(config(video, buffer=FRAMES)) as camera:
        read, _ = read_file(camera)
        lost = camera.statistics.dropped
    numbers = np.array([number_of(frame.image) for frame in read])
    times = np.array([frame.time_s for frame in read])
    assert numbers[0] == 0
    assert len(read) + lost == FRAMES
    assert np.all(times - times[0] >= numbers / 50 - 0.01)  # never early. A busy machine may be late


def test_a_file_has_the_rate_asked_for_and_reports_frames_left_out(video):
    with OpenCVCamera(config(video, fps=2000.0, buffer=FRAMES)) as camera:
        read, _ = read_file(camera)
    numbers = [number_of(frame.image) for frame in read]
    left_out = [0, *np.diff(numbers) - 1]
    assert sum(left_out) <= sum(frame.dropped for frame in read)
    assert len(read) + sum(frame.dropped for frame in read) == FRAMES


def test_a_file_in_its_own_size_is_rgb(tmp_path):
    path = tmp_path / "red.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (64, 48))
    for _ in range(3):
        writer.write(np.full((48, 64, 3), (0, 0, 255), np.uint8))
    writer.release()
    with OpenCVCamera(CameraConfig(path, width=None, height=None, realtime=False)) as camera:
        image = camera.read().image
    assert image.shape == (48, 64, 3)
    assert image[..., 0].min() > 240
    assert image[..., 1:].max() < 15


# Devices


class Driver:
    """Properties of a V4L2 device in OpenCV. Values are whole, and ignored while the control is automatic."""

    def __init__(self, stuck=(), **values):
        self.values = {getattr(cv2, f"CAP_PROP_{name}"): value for name, value in values.items()}
        self.stuck = {getattr(cv2, f"CAP_PROP_{name}") for name in stuck}

    def get(self, prop):
        return float(self.values.get(prop, -1))

    def set(self, prop, value):
        automatic = prop == cv2.CAP_PROP_EXPOSURE and self.values.get(cv2.CAP_PROP_AUTO_EXPOSURE) == 3
        if prop not in self.values or prop in self.stuck or automatic:
            return False
        self.values[prop] = round(value)
        return True


class Device(Driver):
    """A V4L2 device of OpenCV, which this test machine lacks. Unplugged, it returns no frames and cannot be opened."""

    plugged = True

    def isOpened(self):
        return self.plugged

    def grab(self):
        time.sleep(0.01)
        self.values[cv2.CAP_PROP_POS_MSEC] += 10
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
    monkeypatch.setattr(opencv, "check_source", lambda config: None)
    monkeypatch.setattr(opencv, "_open", lambda config: device)
    return device


def test_a_device_is_locked_after_its_warm_up_and_again_after_a_loss(device):
    with OpenCVCamera(config(0, lock=True, exposure=80, fourcc="MJPG")).connect(warmup_s=0.05) as camera:
        assert camera.refused == ()
        assert camera.read().dropped == 0
        assert [device.get(getattr(cv2, f"CAP_PROP_{name}")) for name in ("AUTO_EXPOSURE", "EXPOSURE")] == [1, 80]
        assert device.get(cv2.CAP_PROP_AUTO_WB) == 0
        device.plugged = False
        assert next_error(camera, CameraLostError)
        device.set(cv2.CAP_PROP_EXPOSURE, 157)  # a device forgets its settings without power
        device.set(cv2.CAP_PROP_AUTO_WB, 1)
        device.plugged = True
        assert next_frame(camera).epoch == 1
        assert device.get(cv2.CAP_PROP_EXPOSURE) == 80
        assert device.get(cv2.CAP_PROP_AUTO_WB) == 0


def test_the_exposure_of_a_device_is_set_between_frames_and_again_after_a_loss(device):
    with OpenCVCamera(config(0, lock=True)).connect(warmup_s=0.05) as camera:
        assert camera.locked == {"exposure": 157, "white_balance": 4600}
        assert camera.set_exposure(80.4) == 80
        assert camera.locked == {"exposure": 80, "white_balance": 4600}
        device.plugged = False
        assert next_error(camera, CameraLostError)
        device.set(cv2.CAP_PROP_EXPOSURE, 157)
        device.plugged = True
        assert next_frame(camera).epoch == 1
        assert device.get(cv2.CAP_PROP_EXPOSURE) == 80
        device.stuck = {cv2.CAP_PROP_AUTO_EXPOSURE}
        device.values[cv2.CAP_PROP_AUTO_EXPOSURE] = 3
        assert camera.set_exposure(60) is None
        with pytest.raises(ValueError, match="exposure must be > 0, got 0"):
            camera.set_exposure(0)


def test_the_exposure_of_a_stream_is_left_to_its_server(server):
    with connected(server) as camera, pytest.raises(CameraError, match="set it at the server of the stream"):
        camera.set_exposure(80)


def test_a_device_that_refuses_a_setting_is_warned_about(device):
    device.stuck = {cv2.CAP_PROP_AUTO_WB}
    with pytest.warns(UserWarning, match=r"camera 0 did not accept a setting. AUTO_WB: asked for 0, found 1"):
        camera = OpenCVCamera(config(0, lock=True)).connect(warmup_s=0)
    assert camera.refused == ("AUTO_WB: asked for 0, found 1",)
    camera.disconnect()


def test_a_device_without_the_size_names_both(device):
    device.stuck = {cv2.CAP_PROP_FRAME_WIDTH}
    device.values[cv2.CAP_PROP_FRAME_WIDTH] = 640
    with pytest.raises(FrameSizeError, match=r"640 x 120 pixels, but 160 x 120 .*v4l2-ctl -d /dev/video0"):
        OpenCVCamera(config(0)).connect()


def test_settings_are_locked_at_their_current_values():
    driver = Driver(AUTO_EXPOSURE=3, EXPOSURE=157, AUTO_WB=1, WB_TEMPERATURE=4600, GAIN=5)
    held, refused = opencv.lock(driver, {}, current=True)
    assert held == {"exposure": 157, "white_balance": 4600}
    assert refused == []
    assert driver.get(cv2.CAP_PROP_AUTO_EXPOSURE) == 1
    assert driver.get(cv2.CAP_PROP_AUTO_WB) == 0


def test_settings_take_the_values_asked_for():
    driver = Driver(AUTO_EXPOSURE=3, EXPOSURE=157, AUTO_WB=1, WB_TEMPERATURE=4600, GAIN=5)
    held, refused = opencv.lock(driver, opencv.asked(config(0, exposure=80, gain=2)))
    assert (held, refused) == ({"exposure": 80, "gain": 2}, [])
    assert driver.get(cv2.CAP_PROP_AUTO_WB) == 1


def test_a_refused_setting_is_named_with_both_values():
    driver = Driver(stuck=["AUTO_EXPOSURE"], AUTO_EXPOSURE=3, EXPOSURE=157)
    _, refused = opencv.lock(driver, {"exposure": 80.0, "focus": 3.0}, current=True)
    assert [str(refusal) for refusal in refused] == [
        "AUTO_EXPOSURE: asked for 1, found 3",
        "EXPOSURE: asked for 80, found 157",
        "AUTO_WB: asked for 0, the driver lacks it",
        "AUTOFOCUS: asked for 0, the driver lacks it",
        "FOCUS: asked for 3, the driver lacks it",
    ]


def test_cameras_are_found_by_serial_number_port_and_number(tmp_path):
    dev, properties = tmp_path / "dev", tmp_path / "sys/class/video4linux"
    for number, index in ((0, 0), (1, 1), (2, 0), (10, 0)):
        (properties / f"video{number}").mkdir(parents=True)
        (properties / f"video{number}/index").write_text(f"{index}\n")
        (properties / f"video{number}/name").write_text(f"Camera {number}\n")
        dev.mkdir(exist_ok=True)
        (dev / f"video{number}").write_bytes(b"")
    for folder, name, number in (("by-id", "usb-A_123", 0), ("by-path", "usb-0", 0), ("by-path", "usb-2", 2)):
        (dev / "v4l" / folder).mkdir(parents=True, exist_ok=True)
        (dev / "v4l" / folder / name).symlink_to(dev / f"video{number}")
    with (dev / "video2").open():
        found = find_cameras(tmp_path)
    assert [Path(camera.source).name for camera in found] == ["usb-A_123", "usb-2", "video10"]
    assert [Path(camera.device).name for camera in found] == ["video0", "video2", "video10"]
    assert [camera.users for camera in found] == [(), (os.getpid(),), ()]
    assert "Camera 2, in use by process" in str(found[1])
    assert cameras.stable_path(str(dev / "video0"), tmp_path) == found[0].source
    assert cameras.stable_path(str(dev / "video2"), tmp_path) == str(dev / "video2")


def test_nodes_without_images_are_recognised():
    def capability(whole, own):
        return struct.pack("16s32s32s3I3I", b"uvcvideo", b"Camera", b"usb", 0x60000, whole, own, 0, 0, 0)

    assert cameras.captures(capability(0x84A00001, 0x04200001))
    assert not cameras.captures(capability(0x84A00001, 0x04A00000))  # metadata
    assert cameras.captures(capability(0x04000001, 0))  # an old driver
