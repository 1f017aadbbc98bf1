"""Commissioning against a sensor of a pseudo-terminal and a motion JPEG server that shows rendered boards."""

import dataclasses
import functools
import math
import time

import calibration_images
import cv2
import numpy as np
import pytest
from led_simulator import usb_port
from PIL import Image
from serial.tools import list_ports_common

import sts_jax as sts
from benchmarks.instruments.peers import DARK, LIT, Peer, SeenLights, SensorPeer
from experiments import commission
from experiments.shared import commissioning
from experiments.shared.terminal import on_one_line
from sts_jax import hardware, storage
from sts_jax.hardware import Device, opencv

WIDTH, HEIGHT = 640, 480
PINHOLE = sts.Sensor().camera
TRUE = dataclasses.replace(calibration_images.LENS, rotation=(0.02, -0.03, 0.03))
# Board to camera: rotation vector (rad), position of the board's centre (m). In the first pose it lies on the pad.
POSES = [
    (TRUE.rotation, TRUE.translation),
    ((0.5, 0.0, 0.0), (0.0, 0.0, 0.15)),
    ((-0.5, 0.1, 0.0), (0.08, 0.06, 0.13)),
    ((0.0, 0.5, 0.2), (-0.08, 0.06, 0.14)),
    ((0.1, -0.5, 0.1), (0.09, -0.05, 0.13)),
    ((0.2, 0.4, 0.3), (-0.08, -0.05, 0.13)),
]


class SeenBoards(SeenLights):
    """The camera. `board` is the number of the board that it sees, or None. The images have noise."""

    def __init__(self, lights, pictures):
        rng = np.random.default_rng(0)
        self.board, self.pictures = None, pictures
        self.noises = [rng.integers(0, 5, (HEIGHT, WIDTH, 3), np.uint8) for _ in range(3)]
        super().__init__(lights, fps=30, lag_s=0.01, exposure_s=0.01, size=(WIDTH, HEIGHT))

    def _frame(self, mode):
        end_s = time.monotonic() - self.lag_s
        _, mean = self.lights.shares(end_s - self.exposure_s, end_s)
        plain = np.full((HEIGHT, WIDTH, 3), DARK + mean * (LIT - DARK), np.uint8)
        image = cv2.add(plain if self.board is None else self.pictures[self.board], self.noises[self.number % 3])
        return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 97])[1].tobytes()


class BoardPeer(SensorPeer):
    """A sensor whose camera can see the board."""

    def __init__(self, path, pictures):
        super().__init__(path)
        self.camera.stop()
        self.camera = SeenBoards(self.lights, pictures)


@pytest.fixture(scope="module")
def pictures():
    rays, printed = calibration_images.camera_rays(TRUE), calibration_images.printed(hardware.Board())
    views = [calibration_images.board_view(rays, *printed, *pose) for pose in POSES]
    return [cv2.cvtColor((20 + 0.7 * view).astype(np.uint8), cv2.COLOR_GRAY2BGR) for view in views]


@pytest.fixture
def peer(tmp_path, pictures):
    made = BoardPeer(tmp_path / "leds", pictures)
    yield made
    made.stop()


@pytest.fixture
def config(tmp_path):
    return commission.Config(
        camera="http://127.0.0.1:9/video",
        leds=str(tmp_path / "leds"),
        out=tmp_path / "bench",
        width=WIDTH,
        height=HEIGHT,
        pictures=len(POSES),
    )


def held(folder, pictures, number=None):
    """A folder of PNG files, the first pictures of the board."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, picture in enumerate(pictures[:number]):
        Image.fromarray(picture).save(folder / f"{i:03d}.png")
    return folder


def measure_briefly(monkeypatch):
    """Fewer switches and pairs, and a shorter search for the controller."""
    brief = functools.partialmethod(hardware.STS.measure_settling, 3, watch_s=0.5)
    monkeypatch.setattr(hardware.STS, "measure_settling", brief)
    monkeypatch.setattr(hardware.Leds, "connect", functools.partial(hardware.Leds.connect, timeout_s=1.0))
    monkeypatch.setattr(commissioning, "PAIRS", 5)


def hands(peer, monkeypatch, *, stop_at=None):
    """Replace the person: shows the next board at each request, and interrupts at one of them."""
    asked = []

    def wait(text, every):
        asked.append(text)
        if text.startswith(("Lay", "Hold")):
            number = len(list(peer.folder.glob("*.png")))
            if number == stop_at:
                raise KeyboardInterrupt
            peer.camera.board = number
            time.sleep(0.3)
        else:
            peer.camera.board = None

    monkeypatch.setattr(commissioning, "wait", wait)
    return asked


@pytest.mark.slow
def test_an_interrupted_run_resumes_and_writes_a_file_that_opens_the_sensor(peer, config, monkeypatch, capsys):
    config = dataclasses.replace(config, camera=peer.url)
    peer.folder = config.out / "board"
    hands(peer, monkeypatch, stop_at=4)
    measure_briefly(monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        commission.main(config)
    assert peer.leds.controller.levels == (0, 0, 0, 0)
    kept = {path.name: path.read_bytes() for path in peer.folder.glob("*.png")}
    assert sorted(kept) == ["000.png", "001.png", "002.png", "003.png"]
    assert not (config.out / "sensor.json").exists()

    peer.camera.board = None
    capsys.readouterr()
    asked = hands(peer, monkeypatch)
    commission.main(config)
    printed = capsys.readouterr().err
    assert len(asked) == 1 + len(POSES) - len(kept)
    assert all((peer.folder / name).read_bytes() == content for name, content in kept.items())
    assert "4 pictures of an earlier run are kept" in printed
    assert printed.count("left to the server") == 2

    device = Device.load(config.out)
    assert (device.camera, device.leds, device.levels) == (peer.url, "EMULATED", (255, 255, 255, 255))
    assert (device.lens_from, device.exposures) == ("board", None)
    assert device.settle_on_s > peer.camera.lag_s + peer.camera.exposure_s
    np.testing.assert_allclose(device.lens.center, TRUE.center, atol=1e-3)
    assert abs(float(np.median(device.backgrounds(config.out)[0])) - DARK - 2) <= 2
    assert abs(float(np.median(device.backgrounds(config.out)[1])) - LIT - 2) <= 2
    assert sts.Sensor.load(config.out / "sensor.json").constants() == sts.Sensor().constants()

    peer.camera.board = None
    with hardware.STS.from_file(config.out, leds=peer.path) as sensor:
        assert sensor.device == device
        assert sensor.settling == hardware.Settling(device.settle_off_s, device.settle_on_s)
        pair = sensor.read()
    assert abs(float(np.median(pair.visual.image)) - DARK - 2) <= 3
    assert abs(float(np.median(pair.tactile.image)) - LIT - 2) <= 3
    view = hardware.rectified(device.lens, PINHOLE, pair.tactile.image, (60, 80))
    assert view.min() > 150  # no part of the view is outside of the raw image

    with pytest.raises(ValueError, match=r"camera http://127\.0\.0\.1:9/video"):
        hardware.STS.from_file(config.out, camera="http://127.0.0.1:9/video", leds=peer.path)
    with pytest.raises(hardware.LedError, match="EMULATED was not found"):
        hardware.STS.from_file(config.out).connect()
    camera = hardware.OpenCVCamera(hardware.CameraConfig("http://127.0.0.1:9/video"))
    with (
        hardware.Leds.connect(peer.path) as leds,
        pytest.raises(ValueError, match=r"board/camera.json was made with camera = .*choose another folder"),
    ):
        commissioning.claim_folder(config, camera, leds)


def test_a_folder_has_one_user_and_leftovers_of_a_kill_are_deleted(config, monkeypatch):
    left = config.out / "board" / ".camera.json.1.partial"
    with storage.lock(config.out), pytest.raises(SystemExit, match="bench is in use by"), on_one_line():
        commission.main(config)
    left.parent.mkdir()
    left.write_text("{")
    monkeypatch.setattr(hardware.Leds, "connect", functools.partial(hardware.Leds.connect, timeout_s=0.1))
    with pytest.raises(hardware.LedError):
        commission.main(config)
    assert not left.exists()


def test_another_controller_on_the_port_is_refused(tmp_path, peer):
    device = Device(peer.url, 30.0, "OTHER", TRUE, 0.1, 0.1, (255, 255, 255, 255), "2026-05-31")
    device.save(tmp_path / "bench", sts.Sensor())
    with pytest.raises(ValueError, match=r"LED controller OTHER, but .* LED controller EMULATED"):
        hardware.STS.from_file(tmp_path / "bench", leds=peer.path).connect()
    hardware.Leds.connect(peer.path).close()  # the port is free again


def test_the_controller_is_found_by_its_own_serial_number(tmp_path, monkeypatch):
    peers = [Peer(tmp_path / name, serial_number=name) for name in ("AAA", "BBB")]
    found = [usb_port(peer.path, None) for peer in peers]
    monkeypatch.setattr(hardware.leds, "find_controllers", lambda: found)
    try:
        with hardware.Leds.find("BBB") as leds:
            assert leds.port == str(tmp_path / "BBB")
        with pytest.raises(hardware.LedError, match=r"CCC was not found.*AAA \(controller AAA\)"):
            hardware.Leds.find("CCC")
    finally:
        for peer in peers:
            peer.vanish()


# ---- The lens


def test_the_lens_is_fitted_from_a_folder(config, pictures, capsys):
    held(config.out / "board", pictures)
    lens = commissioning.calibrate(config, None, PINHOLE)
    np.testing.assert_allclose(lens.center, TRUE.center, atol=5e-4)
    printed = capsys.readouterr().err
    assert "6 pictures" in printed
    assert printed.count("corners, error 0.") == len(POSES)


def test_a_view_that_the_camera_does_not_see_is_refused(config):
    with pytest.raises(hardware.CalibrationError, match=r"sensor's view reaches 5\d"):
        hardware.check_view(TRUE, PINHOLE, math.radians(40))
    shifted = dataclasses.replace(hardware.Lens.ideal(WIDTH, HEIGHT), cx=60.0)
    with pytest.raises(hardware.CalibrationError, match=r"\d% of .*middle left.* outside .*centre of the pad"):
        hardware.check_view(shifted, PINHOLE)
    with pytest.raises(hardware.CalibrationError, match="larger field of view"):
        commission.main(dataclasses.replace(config, ideal_lens=90.0))
    corners = hardware.FoundCorners(np.arange(2), np.array([[1.0, 1.0], [WIDTH - 1.0, HEIGHT / 2]]))
    assert hardware.covered([corners], (WIDTH, HEIGHT)) == ("top left", "middle right")


def test_few_or_wrong_pictures_name_their_folder(config, pictures):
    held(config.out / "board", pictures, 3)
    with pytest.raises(hardware.CalibrationError, match=r"board failed: .*but 6 must.*000.png.*raise --pictures"):
        commissioning.calibrate(dataclasses.replace(config, pictures=3), None, PINHOLE)
    with pytest.raises(ValueError, match=r"000.png has 640 x 480 pixels, but --width is 1640 and --height is 480"):
        commissioning.calibrate(dataclasses.replace(config, width=1640), None, PINHOLE)


class Handheld:
    """A sensor whose camera returns given images. It is its own camera."""

    def __init__(self, images):
        self.images, self.camera = list(images), self

    def stream(self, duty):
        yield duty

    def read(self):
        return hardware.Captured(self.images.pop(0), 0.0, 0)


def test_pictures_without_or_with_a_moving_board_are_not_kept(config, pictures, capsys):
    blank, there = np.full_like(pictures[0], 90), pictures[0]
    moved, corners = np.roll(there, 4, axis=1), {}
    sensor = Handheld([blank, blank, moved, there, there, there])
    for _ in range(3):
        commissioning.take(dataclasses.replace(config, every=0.0), sensor, corners)
    assert [line.split(",")[0] for line in capsys.readouterr().err.splitlines() if line[0] == " "] == [
        "  picture not kept: 0 corners of the board were found",
        "  picture not kept: the board moved while the picture was taken: hold it still",
        "  000.png: 64 corners",
    ]
    folder = config.out / "board"
    assert list(corners) == [path.name for path in folder.iterdir()] == ["000.png"]
    read = commissioning.read_board(config, folder / "000.png")
    np.testing.assert_array_equal(read.pixels, corners["000.png"].pixels)


def test_a_deleted_picture_of_the_board_on_the_pad_is_taken_again_first(config, pictures, monkeypatch):
    asked, corners = [], {"001.png": None, "002.png": None}
    monkeypatch.setattr(commissioning, "wait", lambda text, every: asked.append(text))
    monkeypatch.setattr(commissioning, "coverage", lambda *_: "")
    sensor = Handheld([image for image in (pictures[0], pictures[3]) for _ in range(2)])
    for _ in range(2):
        commissioning.take(config, sensor, corners)
    assert [text.split()[0] for text in asked] == ["Lay", "Hold"]
    assert sorted(corners) == ["000.png", "001.png", "002.png", "003.png"]
    expected = hardware.find_board(pictures[0], hardware.Board()).pixels
    np.testing.assert_array_equal(corners["000.png"].pixels, expected)


# ---- The exposure


class Metered(hardware.OpenCVCamera):
    """A device whose images are as bright as its exposure times the light, up to 255."""

    def __init__(self, light, settable=True):
        super().__init__(hardware.CameraConfig(0))
        self.light, self.exposure, self.settable = light, 150.0, settable

    @property
    def locked(self):
        return {"exposure": self.exposure}

    def set_exposure(self, exposure):
        self.exposure = float(round(exposure))
        return self.exposure if self.settable else None

    def read(self, timeout_ms=None):
        image = np.full((8, 8, 3), min(self.exposure * self.light, 255), np.uint8)
        return hardware.Captured(image, 0.0, 0)


@pytest.mark.parametrize(("light", "limit"), [(0.8, None), (1.3, None), (40.0, None), (0.1, 300), (400.0, 1)])
def test_exposure_is_bright_and_not_saturated_within_the_limits(monkeypatch, light, limit):
    monkeypatch.setattr(hardware.sts, "LAG_S", 0.0)
    exposure, brightness = hardware.choose_exposure(Metered(light), longest=300)
    assert brightness == pytest.approx(min(exposure * light, 255), abs=1)
    assert 170 <= brightness <= 230 if limit is None else exposure == limit
    with pytest.raises(hardware.CameraError, match="does not support a manual exposure"):
        hardware.choose_exposure(Metered(light, settable=False), longest=300)


class Video:
    """A V4L2 device of OpenCV that sees the lights and shows its exposure. The left of its view is never dark."""

    def __init__(self, controller):
        values = {"AUTO_EXPOSURE": 3, "EXPOSURE": 40, "AUTO_WB": 1, "WB_TEMPERATURE": 4600, "FPS": 100}
        self.values = {getattr(cv2, f"CAP_PROP_{name}"): value for name, value in values.items()}
        self.values |= {cv2.CAP_PROP_FRAME_WIDTH: 0, cv2.CAP_PROP_FRAME_HEIGHT: 0}
        self.controller, self.number = controller, 0

    def get(self, prop):
        return float(self.values.get(prop, -1))

    def set(self, prop, value):
        if prop in self.values:
            self.values[prop] = round(value)
        return prop in self.values

    def isOpened(self):
        return True

    def grab(self):
        time.sleep(0.01)
        self.number += 1
        return True

    def retrieve(self):
        light = np.full((48, 64, 3), 8.0 * sum(self.controller.levels) / 1020)
        light[:, :40] += 2.0
        image = np.minimum(self.get(cv2.CAP_PROP_EXPOSURE) * light, 255).astype(np.uint8)
        image[:8, :8] = self.number % 2
        return True, image

    def release(self):
        pass


@pytest.mark.slow
def test_each_stream_of_a_device_has_its_exposure(peer, config, monkeypatch, capsys):
    device = Video(peer.leds.controller)
    monkeypatch.setattr(opencv, "_open", lambda config: device)
    measure_briefly(monkeypatch)
    config = dataclasses.replace(config, camera="0", width=64, height=48, ideal_lens=160.0, every=0.0)
    commission.main(config)
    assert "NOT calibrated" in capsys.readouterr().err
    found = Device.load(config.out)
    assert (found.camera, found.lens_from) == ("/dev/video0", "ideal")
    assert found.white_balance == 4600
    assert found.exposures is not None
    assert found.exposures[0] > 3 * found.exposures[1]
    for background in found.backgrounds(config.out):
        assert 170 <= hardware.brightness(background) <= 230
    with hardware.STS.from_file(config.out, leds=peer.path) as sensor:
        for _ in range(3):
            pair = sensor.read()
            assert pair.visual.image[20, 20, 0] == round(min(2 * found.exposures[0], 255))
            assert pair.tactile.image[20, 20, 0] == round(min(10 * found.exposures[1], 255))


# ---- Options and devices


def test_devices_are_listed(config, monkeypatch, capsys):
    camera = hardware.FoundCamera("/dev/v4l/by-id/usb-A-index0", "A")
    ports = [usb_port("/dev/ttyACM0", "55"), list_ports_common.ListPortInfo("/dev/ttyS0")]
    monkeypatch.setattr(hardware, "find_cameras", lambda: [camera])
    for found, line in ((ports, "/dev/ttyACM0 (Arduino Uno, serial number 55)"), ([], "none was found: connect one")):
        monkeypatch.setattr(hardware, "find_controllers", lambda found=found: found)
        commission.main(dataclasses.replace(config, leds=None))
        assert capsys.readouterr().out.splitlines() == [
            "cameras, give one as --camera:",
            "  /dev/v4l/by-id/usb-A-index0 (A)",
            "USB serial ports, give one as --leds:",
            f"  {line}",
        ]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ideal_lens": 0.0}, "field_of_view must be .* got 0"),
        ({"pictures": 3}, "pictures must be >= 6, got 3"),
        ({"ruler": 10.0}, "ruler must be .* got 10"),
        ({"width": 0}, "width must be > 0"),
    ],
)
def test_bad_options_are_named(config, changes, message):
    with pytest.raises(ValueError, match=message):
        commission.main(dataclasses.replace(config, **changes))


def test_a_missing_keyboard_is_named(monkeypatch):
    def closed(text):
        raise EOFError

    monkeypatch.setattr("builtins.input", closed)
    with pytest.raises(ValueError, match="give --every SECONDS"):
        commissioning.wait("Take everything off the pad.", None)
