"""`Recorder` and `Replay`: what is played back is what was recorded."""

import dataclasses
import itertools
import json
import math
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
from recording_writer import ORIGIN, PERIOD_S, SIZE, shot, write
from test_experiments_real import sensor_file

from benchmarks.instruments.sensor_peer import SensorPeer
from sts_jax import hardware
from sts_jax.storage import DamagedFileError

FAST = 50.0  # recorded seconds in a second


@pytest.fixture
def folder(tmp_path):
    made = tmp_path / "recording"
    assert list(write(made, range(12))) == list(range(12))
    return made


def until_end(take):
    """All results of a function until the replay has ended."""
    found = []
    try:
        while True:
            found.append(take())
    except hardware.EndOfVideoError:
        return found


def played(replay, **options):
    """All images until the end."""
    shots = replay.stream(**options)
    return until_end(lambda: next(shots))


def test_a_replay_equals_the_recording_in_every_pixel_and_time(folder):
    with hardware.Replay(folder, speed=None) as replay:
        found = played(replay)
        with pytest.raises(hardware.EndOfVideoError, match=r"ended after 12 images: call connect.*loop=True"):
            replay.read()
    assert len(found) == 12
    for number, one in enumerate(found):
        truth = shot(number)
        np.testing.assert_array_equal(one.image, truth.image)
        assert not one.image.flags.writeable
        shift_s = one.time_s - truth.time_s
        assert shift_s == pytest.approx(found[0].time_s - 100, abs=1e-6)
        assert one.until_s - one.time_s == pytest.approx(0.01, abs=1e-6)
        assert one.time_s - one.before.acknowledged_s == pytest.approx(0.1, abs=1e-6)
        assert (one.stream, one.sequence, one.epoch) == (truth.stream, truth.sequence, truth.epoch)
        assert (one.before.levels, one.before.counter, one.before.boot) == (truth.before.levels, number, 7)


def test_jpeg_recordings_are_near_the_truth(tmp_path):
    smooth = cv2.GaussianBlur(shot(0).image, (0, 0), 5)
    with hardware.Recorder(tmp_path / "jpeg", ORIGIN, encoding="jpeg") as recorder:
        recorder.add(dataclasses.replace(shot(0), image=smooth))
    with hardware.Replay(tmp_path / "jpeg", speed=None) as replay:
        error = next(replay.stream()).image.astype(float) - smooth
    assert 0 < np.abs(error).max() <= 8


@pytest.mark.parametrize("encoding", ["png", "jpeg"])
def test_the_videos_open_without_the_library(tmp_path, encoding):
    """OpenCV's FFmpeg reads the Matroska files, with their times."""
    assert len(list(write(tmp_path / "made", range(20), encoding=encoding))) == 20
    for stream in ("visual", "tactile"):
        video = cv2.VideoCapture(str(tmp_path / "made" / f"{stream}.mkv"), cv2.CAP_FFMPEG)
        assert (video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (SIZE[1], SIZE[0])
        for number in range(stream == "tactile", 20, 2):
            good, image = video.read()
            assert good
            # OpenCV counts from the first image of the video
            seen_s = PERIOD_S * (number - (stream == "tactile"))
            assert video.get(cv2.CAP_PROP_POS_MSEC) == pytest.approx(1000 * seen_s, abs=1)
            if encoding == "png":
                np.testing.assert_array_equal(image[..., ::-1], shot(number).image)
        assert not video.read()[0]


@pytest.mark.slow
def test_a_killed_recording_keeps_every_image_that_was_added(tmp_path):
    for attempt, images in enumerate((1, 7, 40)):
        made = tmp_path / str(attempt)
        command = [sys.executable, "tests/recording_writer.py", str(made)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            for _ in range(images):
                last = int(process.stdout.readline())
            process.kill()
            rest = process.stdout.read().split("\n")[:-1]  # complete lines
            last = int(rest[-1]) if rest else last
        with hardware.Replay(made, speed=None) as replay:
            found = played(replay)
        for number, one in enumerate(found):
            np.testing.assert_array_equal(one.image, shot(number).image)
        assert last + 1 <= len(found) <= last + 2  # the last one may have been recorded but not printed


def test_an_interrupted_write_loses_its_image_only(folder):
    """As if the process had been killed while it wrote an image, or the line of an image."""
    with (folder / "visual.mkv").open("ab") as video:
        video.write(b"\x1f\x43\xb6\x75\x01\x00\x00\x00")
    with (folder / "frames.jsonl").open("ab") as lines:
        lines.write(b'{"stream": "visual", "tim')
    with hardware.Replay(folder, speed=None) as replay:
        assert [one.sequence // 3 for one in played(replay)] == list(range(12))


def test_a_full_disk_keeps_what_was_recorded(tmp_path, monkeypatch):
    made, write_to = tmp_path / "made", __import__("os").write
    with hardware.Recorder(made, ORIGIN) as recorder:
        recorder.add(shot(0))

        def full(file, data):
            if len(data) < 500:
                raise OSError(28, "No space left on device")
            return write_to(file, data[:500])

        with monkeypatch.context() as patched:
            patched.setattr("os.write", full)
            with pytest.raises(OSError, match=r"cannot write .*visual.mkv: .*Free some disk space.* is kept"):
                recorder.add(shot(2))
        recorder.add(shot(4))
    with hardware.Replay(made, speed=None) as replay:
        shots = replay.stream()
        np.testing.assert_array_equal(next(shots).image, shot(0).image)
        np.testing.assert_array_equal(next(shots).image, shot(4).image)


def test_a_recorder_refuses_bad_input(folder, tmp_path):
    with pytest.raises(FileExistsError, match="is not an empty folder: give the name of a new folder"):
        hardware.Recorder(folder, ORIGIN)
    with pytest.raises(ValueError, match="encoding must be one of png, jpeg, got 'gif'"):
        hardware.Recorder(tmp_path / "new", ORIGIN, encoding="gif")
    with (
        hardware.Recorder(tmp_path / "new", ORIGIN) as recorder,
        pytest.raises(
            ValueError, match=r"has shape \(4, 4, 3\), but all images of this recording must have shape \(48, 64, 3\)"
        ),
    ):
        recorder.add(dataclasses.replace(shot(0), image=np.zeros((4, 4, 3), np.uint8)))


def test_pairs_follow_the_recorded_order(tmp_path):
    """An image belongs to the next one of the other stream, unless the camera or the controller was lost between."""
    with hardware.Recorder(tmp_path / "made", ORIGIN) as recorder:
        for number, epoch in [(0, 0), (1, 0), (3, 0), (2, 0), (4, 0), (6, 0), (7, 0), (8, 0), (9, 1), (10, 1)]:
            one = shot(number, epoch=epoch)
            recorder.add(dataclasses.replace(one, time_s=200 + recorder.counts["visual"] + recorder.counts["tactile"]))
    with hardware.Replay(tmp_path / "made", speed=None) as replay:
        pairs = until_end(replay.read)
    found = [(pair.visual.sequence // 3, pair.tactile.sequence // 3) for pair in pairs]
    assert found == [(0, 1), (2, 3), (6, 7), (10, 9)]


def test_streams_can_be_chosen(folder):
    def numbers(**options):
        with hardware.Replay(folder, speed=None) as replay:
            return [one.sequence // 3 for one in played(replay, **options)]

    assert numbers(duty=0.0) == [0, 2, 4, 6, 8, 10]
    assert numbers(duty=1.0) == [1, 3, 5, 7, 9, 11]
    assert numbers(duty=0.5) == list(range(1, 12))  # begins with a tactile image, as a sensor does
    assert numbers(duty=0.5, dwell=2) == [1, 3, 4, 6, 7, 9, 10]


def test_images_come_at_their_times(folder):
    """At 10 times the speed, and never before their time. `read` returns none from before the call."""
    with hardware.Replay(folder, speed=10.0) as replay:
        shots = replay.stream()
        for one in shots:
            assert time.monotonic() >= one.time_s
            if one.sequence == 9:
                break
        called_s = time.monotonic()
        pair = replay.read()
        assert min(pair.visual.time_s, pair.tactile.time_s) >= called_s
        assert time.monotonic() >= max(pair.visual.time_s, pair.tactile.time_s)


def test_late_readers_miss_images(folder):
    with hardware.Replay(folder, speed=1.0) as replay:
        replay._start_s -= 0.4  # as if 0.4 s had passed, of which the buffer covers the last 0.25 s
        first = next(replay.stream())
        assert first.sequence // 3 >= 3
        assert replay.skipped == first.sequence // 3


def test_the_newest_pair_and_stale_ones(folder):
    with hardware.Replay(folder, speed=1.0, loop=True) as replay:
        replay._start_s += 1000.0
        with pytest.raises(hardware.StaleFrameError, match="tactile image is available yet"):
            replay.read_latest()
        replay._start_s = time.monotonic() - 4.5 * PERIOD_S  # the image 4 has come, but not its partner
        newest = replay.read_latest(60_000)
        assert newest.tactile.sequence // 3 >= 3  # later if this machine is slow
        assert newest.tactile.sequence == newest.visual.sequence + 3
        again = replay.read_latest(60_000)
        assert again.visual.time_s >= newest.visual.time_s
        assert replay.async_read().visual.time_s >= again.visual.time_s
        assert replay.async_read().visual.time_s > again.visual.time_s  # none is returned twice
        replay._start_s = time.monotonic() - 1.25 - 1e5 * 12 * PERIOD_S  # laps that nobody has read
        assert replay.read_latest(60_000).visual.epoch >= 99_999
        with pytest.raises(hardware.StaleFrameError, match=r"is [0-9]+ ms old, but at most 0.001 ms are allowed"):
            replay.read_latest(0.001)


def test_a_stale_pair_after_the_end_is_the_end(folder):
    with hardware.Replay(folder, speed=FAST) as replay:
        replay._start_s -= 100
        assert replay.async_read().tactile.sequence // 3 == 11
        for read in (replay.read_latest, replay.async_read, replay.read):
            with pytest.raises(hardware.EndOfVideoError):
                read()


def test_a_loop_counts_connections(folder):
    with hardware.Replay(folder, speed=None, loop=True) as replay:
        found = [one for one, _ in zip(replay.stream(), range(30), strict=False)]
    assert [one.sequence // 3 for one in found] == [*range(12), *range(12), *range(6)]
    assert [one.epoch for one in found] == [0] * 12 + [1] * 12 + [2] * 6
    assert all(b.time_s > a.time_s for a, b in itertools.pairwise(found))


@pytest.mark.parametrize("speed", [None, 20.0])
def test_waiting_until_still_uses_recorded_time(tmp_path, speed):
    """A view that moves until image 30, and is still afterwards: the window of 0.5 s ends 5 visual images later."""
    with hardware.Recorder(tmp_path / "made", ORIGIN) as recorder:
        for number in range(0, 120, 2):
            image = np.full((*SIZE, 3), 50 + 5 * min(number, 30), np.uint8)
            image[:36] = 20
            recorder.add(dataclasses.replace(shot(number), image=image))
    with hardware.Replay(tmp_path / "made", speed=speed) as replay:
        number = replay.wait_until_still(window_s=0.499).sequence // 3
        assert number == 40 if speed is None else number >= 40
    with hardware.Replay(tmp_path / "made", speed=speed) as replay, pytest.raises(hardware.NotStillError):
        replay.wait_until_still(0.8)
    with hardware.Replay(tmp_path / "made", speed=speed) as replay:
        with pytest.raises(hardware.CameraError, match=r"has visual images only, .* read them with stream"):
            replay.read()
        with pytest.raises(hardware.CameraError, match="has visual images only"):
            replay.stream(0.5)


def test_images_of_different_connections_form_no_pairs(tmp_path):
    with hardware.Recorder(tmp_path / "made", ORIGIN) as recorder:
        for number in range(4):
            recorder.add(dataclasses.replace(shot(number), epoch=number))
    with hardware.Replay(tmp_path / "made", speed=None) as replay:
        assert len(list(itertools.islice(replay.stream(), 4))) == 4
        with pytest.raises(hardware.CameraError, match="was connected again between them, so they form no pairs"):
            replay.read()


def test_a_gap_exceeds_a_timeout(tmp_path):
    with hardware.Recorder(tmp_path / "made", ORIGIN) as recorder:
        recorder.add(shot(0))
        recorder.add(dataclasses.replace(shot(1), time_s=1e4))
    with (
        hardware.Replay(tmp_path / "made").connect(0.5) as replay,
        pytest.raises(hardware.LightError, match=r"available in .* ms, but timeout_ms is 500: raise timeout_ms"),
    ):
        replay.read(500)


def damaged(path, old, new):
    text = path.read_bytes()
    assert old in text
    path.write_bytes(text.replace(old, new, 1))


def test_damaged_recordings_are_named(folder, tmp_path):
    def refused(error, match):
        with pytest.raises(error, match=match), hardware.Replay(folder, speed=None) as replay:
            list(replay.stream())

    with pytest.raises(FileNotFoundError, match=r"holds no recording \(recording.json is missing\)"):
        hardware.Replay(tmp_path / "none").connect()
    with pytest.raises(hardware.CameraNotConnectedError, match="is not connected: call connect"):
        hardware.Replay(folder).read()
    lines = (folder / "frames.jsonl").read_text()
    video = (folder / "tactile.mkv").read_bytes()

    (folder / "tactile.mkv").write_bytes(video[:-20_000])
    refused(
        DamagedFileError, r"tactile.mkv is truncated: it has [345] of the 6 images .*delete .*number of lines: [123]\)"
    )
    (folder / "tactile.mkv").unlink()
    refused(
        FileNotFoundError, r"tactile.mkv cannot be read .*\. Number of images that frames.jsonl lists .* video: 6\."
    )
    changed = bytearray(video)
    changed[-100] ^= 1
    (folder / "tactile.mkv").write_bytes(changed)
    refused(DamagedFileError, "image 12 of .* is damaged, because its checksum differs")
    (folder / "tactile.mkv").write_bytes(video)

    damaged(folder / "frames.jsonl", b'"sequence": 9,', b'"sequenc')
    refused(DamagedFileError, "frames.jsonl, line 4, is damaged .*or remove this line")
    (folder / "frames.jsonl").write_text(lines.replace('"time_s": 100.2', '"time_s": NaN', 1))
    refused(DamagedFileError, "line 5, is damaged .*time_s must be finite, got nan")
    (folder / "frames.jsonl").write_text(lines.replace('"time_s": 100.2', '"time_s": 10.2', 1))
    refused(DamagedFileError, "line 5, has an earlier time")
    (folder / "frames.jsonl").write_text("")
    refused(ValueError, "lists no image")
    (folder / "frames.jsonl").unlink()
    refused(FileNotFoundError, "frames.jsonl cannot be read")

    head = json.loads((folder / "recording.json").read_text())
    assert head["settling"] == {"visual_s": 0.1, "tactile_s": 0.2}
    (folder / "recording.json").write_text(json.dumps({**head, "format": 9}))
    refused(ValueError, "has format 9, but this version of sts_jax reads format 1")
    (folder / "recording.json").write_text("{")
    refused(DamagedFileError, r"recording.json cannot be read as JSON .*copy the recording again")


@pytest.mark.parametrize("value", [0, -1, math.nan, math.inf])
def test_bad_options_are_named(tmp_path, value):
    with pytest.raises(ValueError, match="speed must be > 0 and finite, or None, got"):
        hardware.Replay(tmp_path, speed=value)
    with pytest.raises(ValueError, match=r"fps is 30, but it must be None for a recording"):
        hardware.Replay(tmp_path, fps=30)
    with pytest.raises(ValueError, match="fps must be > 0"):
        hardware.Replay((tmp_path / "a", tmp_path / "b"), fps=value).connect()


def make_video(path, frames, *, lit=False, fps=25.0):
    """A video whose frames have a grey value that follows from their number."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, SIZE[::-1])
    for number in range(frames):
        writer.write(np.full((*SIZE, 3), grey(number, lit), np.uint8))
    writer.release()
    return path


def grey(number, lit):
    return 40 + 10 * (number % 8) + 100 * lit


@pytest.fixture
def videos(tmp_path):
    return make_video(tmp_path / "visual.mp4", 20), make_video(tmp_path / "tactile.mp4", 20, lit=True)


def test_plain_videos_are_replayed_as_pairs(videos):
    last_s = None
    with hardware.Replay(videos, speed=None, loop=True) as replay:
        for number in range(45):
            pair = replay.read()
            assert abs(float(pair.visual.image.mean()) - grey(number % 20, False)) < 4
            assert abs(float(pair.tactile.image.mean()) - grey(number % 20, True)) < 4
            assert pair.visual.time_s == pair.tactile.time_s
            assert math.isnan(pair.visual.until_s)
            assert math.isnan(pair.tactile.before.acknowledged_s)
            if last_s is not None:
                assert pair.visual.time_s - last_s == pytest.approx(1 / 25, abs=1e-6)
            last_s = pair.visual.time_s
    with hardware.Replay(videos, speed=None, fps=10) as replay:
        first, second = replay.read(), replay.read()
    assert second.visual.time_s - first.visual.time_s == pytest.approx(0.1)


def test_bad_videos_are_named(videos, tmp_path):
    visual, tactile = videos

    def refused(error, match, *paths):
        with pytest.raises(error, match=match), hardware.Replay(paths, speed=None) as replay:
            list(replay.stream())

    refused(hardware.CameraNotFoundError, "there is no file .*none.mp4", tmp_path / "none.mp4", tactile)
    short = make_video(tmp_path / "short.mp4", 17)
    refused(ValueError, "visual.mp4 has 20 frames, but .*short.mp4 has 17: cut both", visual, short)
    torn = tmp_path / "torn.mp4"
    torn.write_bytes(visual.read_bytes()[:-200])
    refused(hardware.CameraOpenError, "torn.mp4 cannot be read as a video: it is damaged", torn, tactile)
    refused(hardware.CameraOpenError, "is a folder: give a video file", tmp_path, tactile)
    for name in ("one.avi", "two.avi"):  # the header of an AVI file stands at its start
        writer = cv2.VideoWriter(str(tmp_path / name), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, SIZE[::-1])
        for number in range(20):
            writer.write(shot(number).image)
        writer.release()
    data = (tmp_path / "one.avi").read_bytes()
    (tmp_path / "one.avi").write_bytes(data[: len(data) // 2])
    match = "one.avi ends or is damaged at frame [0-9]+, but its header states 20"
    refused(hardware.CameraOpenError, match, tmp_path / "one.avi", tmp_path / "two.avi")


def test_a_recorded_sensor_replays_with_its_sensor_file(tmp_path):
    """Against a sensor's devices: the light of each replayed image is the one in the log of the camera."""
    peer = SensorPeer(tmp_path / "leds")
    try:
        file = sensor_file(peer, tmp_path / "sensor.json")
        with (
            hardware.STS.from_file(file, leds=peer.path) as sensor,
            hardware.Recorder(tmp_path / "made", hardware.Origin.of(sensor), file=file) as recorder,
        ):
            for one, _ in zip(sensor.stream(0.5), range(10), strict=False):
                recorder.add(one)
        replay = hardware.Replay.from_file(tmp_path / "made", speed=None)
        assert replay.device == hardware.Device.load(file)
        assert replay.device.backgrounds(tmp_path / "made")[1].mean() == pytest.approx(210)
        with replay:
            found = played(replay)
        assert len(found) == 10
        for one in found:
            assert peer.judged(one.image, lit=one.stream == "tactile")
            assert one.before.acknowledged_s < one.time_s < one.until_s
    finally:
        peer.stop()
