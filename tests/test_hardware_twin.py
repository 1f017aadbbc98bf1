"""The digital twin: light over exposures, photometry against `expose`, scene, virtual clock, and second clients."""

import dataclasses
import json
import random
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import serial
from led_simulator import until

import sts_jax as sts
from experiments.shared.device import TwinConfig, make_twin
from sts_jax import hardware
from sts_jax.hardware import Lens, protocol, twin

ON, OFF = (255,) * 4, (0,) * 4
CLIENT = Path(__file__).parent / "twin_client.py"
PERFECT = twin.Imperfections(leakage=0, vignetting=0, read_noise=0, full_well=1e12, rise_s=0, jpeg_quality=100)


def picture(height=48, width=64):
    """A red view under a blue light."""
    ramp = np.linspace(0.2, 1, width)[None, :, None] * np.ones((height, 1, 1))
    return twin.Picture(ramp * [0.8, 0.3, 0.1], ramp * [0.1, 0.3, 0.8])


# ---- Light


@pytest.mark.parametrize("rise_s", [0.0, 0.004, 0.3])
def test_light_of_an_interval_equals_small_steps(rise_s):
    rng, history = random.Random(0), twin.LightHistory(rise_s)
    times, step = np.arange(-0.1, 1.2, 1e-5), 1e-5
    starts = sorted(rng.uniform(0, 1) for _ in range(8))
    changes = [(start, tuple(rng.choice([0, 255, rng.randrange(256)]) for _ in range(4))) for start in starts]
    for change in changes:
        history.set(*change)
    target, share, shares = 0.0, 0.0, np.empty(len(times))
    for i, time_s in enumerate(times):
        while changes and changes[0][0] <= time_s:
            target = sum(changes.pop(0)[1]) / 1020
        share = target if rise_s == 0 else share + (target - share) * step / rise_s
        shares[i] = share
    for _ in range(40):
        start = rng.uniform(-0.1, 1.0)
        end = start + rng.uniform(0.001, 0.15)
        chosen = shares[(times >= start) & (times < end)]
        light = history.over(start, end)
        assert light.light == pytest.approx(chosen.mean(), abs=0.015)
        assert light.lowest == pytest.approx(chosen.min(), abs=0.003)
        assert light.highest == pytest.approx(chosen.max(), abs=0.003)


# ---- Photometry


@pytest.mark.parametrize(("exposure", "leakage"), [(1.0, 0.0), (0.3, 0.2), (4.0, 0.2)])
def test_a_frame_without_imperfections_equals_expose(exposure, leakage):
    sensor = sts.Sensor()
    sensor = dataclasses.replace(sensor, room=dataclasses.replace(sensor.room, exposure=exposure))
    rng, empty = np.random.default_rng(0), jnp.zeros((32, 48))
    visual, tactile = (jnp.asarray(rng.random((32, 48, 3)) ** 2, jnp.float32) for _ in range(2))
    pose = jnp.zeros(7), jnp.asarray(True), jnp.zeros((4, 4)), jnp.zeros(4), jnp.full((32, 48), -1)
    frame = sts.Frame(visual, tactile, empty, empty > 0, *pose)
    blender = twin.Blender(dataclasses.replace(PERFECT, leakage=leakage), sensor=sensor)
    ends = blender.ends(np.asarray(visual), np.asarray(tactile))
    for light in (0.0, 0.03, 0.5, 1.0):
        expected = 255 * np.asarray(sts.expose(sensor, frame, leakage + (1 - leakage) * light))
        assert np.abs(blender.frame(ends, light) - expected).max() <= 1.1  # rounding, and noise of 1e-6


@pytest.mark.parametrize("value", [0.2, 0.6])
def test_noise_has_the_stated_deviation_in_linear_light(value):
    constants = twin.Imperfections(leakage=0, vignetting=0, read_noise=0.01, full_well=2000.0)
    blender = twin.Blender(constants, seed=1)
    flat = np.full((200, 200, 3), float(sts.optics.to_srgb(jnp.asarray(value))))
    image = blender.frame(blender.ends(flat, flat), 0.0)
    found = np.asarray(sts.optics.to_linear(jnp.asarray(image) / 255), float)
    assert found.mean() == pytest.approx(value, abs=0.002)
    assert found.std() == pytest.approx(np.hypot(0.01, np.sqrt(value / 2000)), rel=0.05)


def test_vignetting_takes_its_share_in_the_corners():
    blender = twin.Blender(dataclasses.replace(PERFECT, vignetting=0.4))
    ends = blender.ends(*np.ones((2, 41, 61, 3)))
    assert ends.visual[20, 30] == pytest.approx(65535)
    assert ends.visual[[0, 0, -1, -1], [0, -1, 0, -1]] == pytest.approx(0.6 * 65535, abs=1)


def test_the_lens_is_that_of_distorted():
    lens, pinhole = Lens.ideal(80, 60), sts.Sensor().camera
    smooth = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (60, 80, 3), np.uint8), (0, 0), 3)
    blender = twin.Blender(PERFECT, lens=lens)
    image = blender.frame(blender.ends(*2 * [smooth / 255]), 0.0)
    linear = (65535 * np.asarray(sts.optics.to_linear(jnp.asarray(smooth) / 255))).round().astype(np.uint16)
    raw = hardware.distorted(lens, pinhole, linear, outside=0) / 65535
    assert np.abs(image - 255 * np.asarray(sts.optics.to_srgb(jnp.asarray(raw)))).max() <= 1.1
    assert (image[:2, :2] == 0).all()


# ---- Virtual clock


def run(seed, path):
    """Captures with random switches. Returns the switches, the truths and the images."""
    rng = random.Random(seed)
    constants = twin.Imperfections(lag_s=rng.uniform(0.015, 0.12), jitter_s=0.01, rise_s=0.0, exposure_s=0.015)
    changes, frames = [], []
    with twin.Twin(picture(), rate=60, imperfections=constants, seed=seed, log=path) as device:
        for _ in range(40):
            changes.append(device.set(rng.choice([ON, OFF, (255, 0, 128, 1)])))
            device.step(rng.uniform(0, 0.1))
            for _ in range(rng.randrange(5)):
                frames.append(device.capture())
                assert frames[-1][0].end_s + constants.lag_s <= frames[-1][0].due_s <= device.now_s
    return changes, *zip(*frames, strict=True)


def test_log_agrees_with_the_acknowledged_lights_and_repeats_with_the_seed(tmp_path):
    changes, truths, images = run(1, tmp_path / "log")
    assert twin.read_log(tmp_path / "log") == list(truths)
    pure = mixed = 0
    for truth in truths:
        for lit, following in zip(changes, [*changes[1:], None], strict=True):
            if lit.acknowledged_s <= truth.start_s and (following is None or truth.end_s <= following.sent_s):
                assert truth.light == truth.lowest == truth.highest == sum(lit.levels) / 1020
                pure += 1
        mixed += truth.lowest < truth.highest
    assert min(pure, mixed) > 0
    _, again, same = run(1, tmp_path / "again")
    assert again == truths
    np.testing.assert_array_equal(images, same)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: twin.Imperfections(leakage=1.5), r"leakage must be finite and in \[0, 1\.0\], got 1\.5"),
        (lambda path: twin.Imperfections(full_well=0.0), r"full_well and jpeg_quality must be > 0"),
        (lambda path: twin.Twin(picture(), rate=100.0), r"rate must be in .*imperfections.exposure_s = 83"),
        (lambda path: twin.Twin(picture()).command("hold"), "does not change"),
        (lambda path: twin.Twin(picture()).choose("fork"), "has no object to replace by a fork: use an ObjectScene"),
        (lambda path: (device := twin.Twin(picture())).step(1.0) or twin.Served(device), "make a new Twin"),
        (lambda path: twin.Served(twin.Twin(picture()), link=path), "not a symbolic link"),
        (lambda path: make_twin(TwinConfig(object_class="unicorn")), "must be one of"),
    ],
)
def test_wrong_values_are_named(make, message, tmp_path):
    (tmp_path / "leds").write_text("precious")
    with pytest.raises((ValueError, RuntimeError, FileExistsError), match=message):
        make(tmp_path / "leds")
    assert (tmp_path / "leds").read_text() == "precious"


# ---- Scene


@pytest.fixture(scope="module")
def held():
    """A small camera, in a view of few pixels."""
    body = sts.objects.make(jax.random.key(0), "camera")
    return body, twin.ObjectScene(body, resolution=(24, 32), seed=2)


@pytest.mark.slow
def test_object_is_held_moves_and_lies_still_as_simulated(held):
    body, scene = held
    frames = []
    with twin.Twin(scene, imperfections=PERFECT) as device:
        for count, name in [(3, "clear"), (3, "hold"), (80, "release"), (3, "clear")]:
            device.command(name)
            frames += [device.capture()[0] for _ in range(count)]
    assert list(dict.fromkeys(truth.phase for truth in frames)) == ["empty", "held", "moving", "still"]
    assert frames[-1].phase == "empty"
    trajectory = sts.physics.simulate(
        jax.random.fold_in(jax.random.key(2), 0), body, scene.sensor, scene.scenario, num=4
    )
    number = int(np.flatnonzero(trajectory.settled)[0])
    for truth in frames:
        if truth.pose is not None:
            np.testing.assert_array_equal(truth.pose, np.asarray(trajectory.pose[number, truth.frame]))
    moving = [truth.frame for truth in frames if truth.phase == "moving"]
    assert moving[0] == 0
    assert moving == sorted(moving)
    assert all(truth.frame == 59 for truth in frames if truth.phase == "still")


@pytest.mark.slow
def test_ends_are_the_frame_of_sense(held):
    body, scene = held
    blender = twin.Blender(PERFECT)
    fresh = twin.ObjectScene(body, resolution=(24, 32), seed=2)
    ends = fresh.ends(twin.Seen(twin.Phase.STILL, 1, 59, None), blender)
    motion = fresh._motion(1)
    pose, wrench = (jnp.asarray(array[59]) for array in (motion.pose, motion.wrench))
    frame = sts.sense(scene.sensor, body, pose, wrench, resolution=(24, 32))
    for light in (0.0, 0.4, 1.0):
        expected = 255 * np.asarray(sts.expose(scene.sensor, frame, light))
        assert np.abs(blender.frame(ends, light) - expected).max() <= 1.1
    empty = fresh.ends(twin.Seen(twin.Phase.EMPTY, -1, 0, None), blender)
    assert empty.visual.std() < ends.visual.std()


@pytest.mark.slow
def test_two_cameras_see_the_same_scene_each_with_its_own_response(held):
    _, scene = held
    seen = twin.Seen(twin.Phase.EMPTY, -1, 0, None)
    clean, dark = (twin.Blender(dataclasses.replace(PERFECT, vignetting=share)) for share in (0, 0.6))
    own = [twin.ObjectScene(held[0], resolution=(24, 32)).ends(seen, blender) for blender in (clean, dark)]
    for blender, ends in zip((clean, dark), own, strict=True):
        np.testing.assert_array_equal(scene.ends(seen, blender), ends)
    assert own[0].visual.mean() > 1.05 * own[1].visual.mean()


@pytest.mark.slow
def test_an_object_that_fell_off_is_not_seen(held):
    body, _ = held
    fallen = twin.ObjectScene(body, resolution=(24, 32), seed=2)
    fallen._motion(0)
    beside, below = np.array([[0, -0.13, -0.07, 1, 0, 0, 0], [0, 0, -0.1, 1, 0, 0, 0]], np.float32)
    blender = twin.Blender(PERFECT)
    empty = fallen.ends(twin.Seen(twin.Phase.EMPTY, -1, 0, None), blender)
    for number, pose in enumerate((beside, below)):
        fallen._motions[number] = fallen._motions[0]._replace(pose=np.tile(pose, (60, 1)))
        ends = fallen.ends(twin.Seen(twin.Phase.STILL, number, 59, tuple(pose.tolist())), blender)
        np.testing.assert_array_equal(ends, empty)


@pytest.mark.slow
def test_another_object_is_held_from_the_next_hold_on():
    camera, fork = (sts.objects.make(jax.random.key(seed), name) for seed, name in ((0, "camera"), (5, "fork")))
    scene, blender, truths = twin.ObjectScene(camera, resolution=(24, 32), seed=2), twin.Blender(PERFECT), []
    with twin.Twin(scene, imperfections=PERFECT) as device:
        for command in ("hold", "choose", "release", "hold"):
            if command == "choose":
                device.choose("fork", 5)
            else:
                device.command(command)
            device.step(0.1)
            truths.append(device.capture()[0])
    assert [truth.trajectory for truth in truths] == [0, 0, 0, 1]
    for truth, body in zip(truths, [camera, camera, camera, fork], strict=True):
        pose, wrench = jnp.asarray(truth.pose), jnp.asarray(scene._motion(truth.trajectory).wrench[truth.frame])
        expected = 255 * np.asarray(sts.sense(scene.sensor, body, pose, wrench, resolution=(24, 32)).visual)
        assert np.abs(blender.frame(scene.ends(truth, blender), 0.0) - expected).max() <= 1.1


def test_closing_waits_for_a_command_that_renders():
    scene, begun, rendered = picture(), threading.Event(), threading.Event()
    scene.prepare = lambda command, blender: begun.set() or rendered.wait(60)
    scene.command = lambda command, time_s: None
    device = twin.Twin(scene)
    device.run_on(time.monotonic)
    command = threading.Thread(target=device.command, args=("release",))
    closing = threading.Thread(target=device.close)
    command.start()
    assert begun.wait(60)
    closing.start()
    closing.join(0.1)
    assert closing.is_alive()
    rendered.set()
    closing.join(60)
    assert not closing.is_alive()
    command.join(60)


# ---- Served to other processes


@pytest.fixture
def served(tmp_path):
    """A served picture."""
    before = set(threading.enumerate())
    constants = twin.Imperfections(exposure_s=0.03, lag_s=0.05)
    with (
        twin.Twin(picture(), imperfections=constants) as device,
        twin.Served(device, link=tmp_path / "leds") as server,
    ):
        yield device, server
    until(lambda: set(threading.enumerate()) <= before)
    assert not (tmp_path / "leds").is_symlink()


def post(server, path):
    with urllib.request.urlopen(urllib.request.Request(server.url + path, method="POST"), timeout=300) as answer:
        return json.load(answer)


@pytest.mark.parametrize(
    ("rate", "lag_s", "switches"),
    [
        (30, 0.015, 12),
        (30, 0.12, 12),
        *(pytest.param(60, lag_s, 60, marks=pytest.mark.slow) for lag_s in (0.015, 0.12)),
    ],
)
def test_second_client_confirms_the_light_of_every_frame(rate, lag_s, switches, tmp_path):
    constants = twin.Imperfections(exposure_s=0.9 / rate, lag_s=lag_s)
    files = {"log": tmp_path / "log", "record": tmp_path / "record.mjpeg"}
    with (
        twin.Twin(picture(120, 160), rate=rate, imperfections=constants, **files) as device,
        twin.Served(device) as server,
    ):
        options = {"port": server.port, "camera": server.camera, "switches": switches, **files}
        words = [str(word) for name, value in options.items() for word in (f"--{name}", value)]
        done = subprocess.run([sys.executable, CLIENT, *words], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    summary = json.loads(done.stdout)
    assert summary["frames"] == 6 * switches
    assert min(summary["on"], summary["off"], summary["mixed"]) > 0
    for dark_first, (blue, green, red) in ((True, summary["dark_bgr"]), (False, summary["bright_bgr"])):
        assert (red > 2 * green > 2 * blue) if dark_first else (blue > 2 * green > 2 * red)  # OpenCV's order


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        ("/state", {"Host": "evil.example"}),  # DNS rebinding
        ("/camera", {"Host": "evil.example:80"}),
        ("/camera", {"Sec-Fetch-Site": "cross-site"}),
        ("/hold", {"Origin": "http://evil.example"}),
        ("/hold", {"Origin": "null"}),
    ],
)
def test_pages_of_other_sites_are_refused(served, path, headers):
    _, server = served
    request = urllib.request.Request(server.url + path, headers=headers, method="POST" if path == "/hold" else "GET")
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(request, timeout=30)
    with refused.value as answer:
        assert answer.code == 403


def test_broken_connections_leave_no_trace(served, capfd):
    number = int(served[1].url.rsplit(":", 1)[1])
    for _ in range(5):
        connection = socket.create_connection(("127.0.0.1", number))
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closing sends a reset
        connection.sendall(b"GET /camera HTTP/1.0\r\nHost: 127.0.0.1\r\n\r\n")
        connection.close()
    assert urllib.request.urlopen(served[1].url + "/state", timeout=30).status == 200
    assert capfd.readouterr().err == ""


def test_server_says_who_can_connect_and_names_an_address_in_use(served):
    _, server = served
    assert "only this machine can connect" in server.description
    number = int(server.url.rsplit(":", 1)[1])
    with pytest.raises(OSError, match=f"cannot listen on 127.0.0.1, port {number}"):
        twin.Served(twin.Twin(picture()), http_port=number)
    with twin.Served(twin.Twin(picture()), host="0.0.0.0") as other:
        assert "OTHER MACHINES CAN CONNECT" in other.description


def test_commands_and_state_over_http(held):
    body, _ = held
    scene = twin.ObjectScene(body, resolution=(24, 32), seed=2, motion_rate=2)
    with twin.Twin(scene) as device, twin.Served(device) as server:
        assert post(server, "/hold")["phase"] == "held"
        assert post(server, "/release")["phase"] in ("moving", "still")
        until(lambda: device.state.phase == "still")
        with urllib.request.urlopen(server.url + "/state", timeout=30) as answer:
            assert json.load(answer)["pose"] == list(device.state.pose)
        for path, code, words in (("/release", 400, "send 'hold' first"), ("/jump", 404, "is not one of GET /camera")):
            with pytest.raises(urllib.error.HTTPError) as found:
                post(server, path)
            with found.value as answer:
                assert answer.code == code
                assert words in json.load(answer)["error"]
        for path, code, words in (
            ("/choose?class=unicorn&seed=1", 400, "must be one of"),
            ("/choose?class=fork&seed=x", 400, "'x'"),
            ("/choose?class=fork", 404, "POST /choose?class=bottle&seed=3"),
        ):
            with pytest.raises(urllib.error.HTTPError) as found:
                post(server, path)
            with found.value as answer:
                assert answer.code == code
                assert words in json.load(answer)["error"]
        assert post(server, "/clear")["pose"] is None


def test_watchdog_turns_the_lights_off_after_the_host_has_gone(served):
    device, server = served
    with serial.Serial(server.port, 115200, timeout=30) as port:
        port.write(protocol.encode("1 SET 255 255 255 255"))
        assert port.readline().startswith(b"1 OK SET 255 255 255 255")
        assert port.readline().startswith(b"0 OFF watchdog 2")
    assert device.state.levels == OFF


# ---- Command


@pytest.mark.slow
def test_command_serves_until_it_is_ended(tmp_path):
    link = tmp_path / "leds"
    words = ["--resolution", "24", "32", "--imperfections.lag-s", "0.1", "--field-of-view", "None"]
    words += ["--port", str(link), "--log", str(tmp_path / "log")]
    process = subprocess.Popen(
        [sys.executable, "-m", "experiments.twin", *words], stdout=subprocess.PIPE, text=True, cwd=CLIENT.parents[1]
    )
    try:
        lines = [process.stdout.readline() for _ in range(7)]
        assert str(link) in lines[1]
        capture = cv2.VideoCapture(lines[2].split()[-1], cv2.CAP_FFMPEG)
        assert capture.read()[0]
        capture.release()
        with hardware.Leds.connect(str(link)) as leds:
            assert leds.set(ON).levels == ON
    finally:
        process.terminate()
        assert process.wait(60) == 0
        process.stdout.close()
    assert not link.is_symlink()
    first = twin.read_log(tmp_path / "log")[0]
    assert first.due_s - first.end_s == pytest.approx(0.1)
