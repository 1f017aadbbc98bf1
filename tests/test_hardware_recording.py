"""`Recorder` and `Replay`: what is played back is what was recorded."""

import contextlib
import dataclasses
import itertools
import json
import math
import shutil
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from damage import damaged
from session_writer import ORIGIN, PERIOD_S, SIZE, record, shot

import sts_jax as sts
from sts_jax import hardware, storage
from sts_jax.storage import DamagedFileError


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded") / "recording"
    assert list(record(folder, range(12))) == list(range(12))
    return folder


@pytest.fixture
def folder(recorded, tmp_path):
    return Path(shutil.copytree(recorded, tmp_path / "recording"))


@pytest.fixture
def interrupted(folder):
    """The recording as a kill leaves it."""
    storage.write_manifest(folder, {}, storage.read_manifest(folder, "").facts)
    return folder


def played(source, **options):
    with hardware.Replay(source, **{"speed": None, **options}) as replay:
        return list(replay.stream())


def numbers(shots):
    return [one.sequence // 3 for one in shots]


def test_a_replay_equals_the_recording_in_every_pixel_and_time(folder):
    found = played(folder)
    assert len(found) == 12
    for number, one in enumerate(found):
        truth = shot(number)
        np.testing.assert_array_equal(one.image, truth.image)
        assert not one.image.flags.writeable
        assert one.time_s - truth.time_s == pytest.approx(found[0].time_s - 100, abs=1e-6)
        assert one.until_s - one.time_s == pytest.approx(0.01, abs=1e-6)
        assert one.time_s - one.before.acknowledged_s == pytest.approx(0.1, abs=1e-6)
        assert (one.stream, one.sequence, one.epoch) == (truth.stream, truth.sequence, truth.epoch)
        assert (one.before.levels, one.before.counter, one.before.boot) == (truth.before.levels, number, 7)


@pytest.mark.parametrize("encoding", ["ffv1", "mjpeg"])
def test_the_videos_open_without_the_library(tmp_path, encoding):
    """OpenCV reads the Matroska files, with their times."""
    smooth = [dataclasses.replace(one, image=cv2.GaussianBlur(one.image, (0, 0), 5)) for one in map(shot, range(20))]
    with hardware.Recorder(tmp_path / "made", ORIGIN, encoding=encoding) as recorder:
        for one in smooth:
            recorder.add(one)
    for stream in ("visual", "tactile"):
        video = cv2.VideoCapture(str(tmp_path / "made" / f"{stream}.mkv"), cv2.CAP_FFMPEG)
        for number in range(stream == "tactile", 20, 2):
            good, image = video.read()
            assert good
            # OpenCV counts from the first image of the video
            seen_s = PERIOD_S * (number - (stream == "tactile"))
            assert video.get(cv2.CAP_PROP_POS_MSEC) == pytest.approx(1000 * seen_s, abs=1)
            error = np.abs(image[..., ::-1].astype(float) - smooth[number].image).max()
            assert error == 0 if encoding == "ffv1" else 0 < error <= 8
        assert not video.read()[0]


@pytest.mark.parametrize("encoding", ["ffv1", "mjpeg"])
def test_images_of_the_same_millisecond_are_recorded(tmp_path, encoding):
    times = [100.0, 100.1, 100.1002, 100.1002, 100.2]
    with hardware.Recorder(tmp_path / "made", ORIGIN, encoding=encoding) as recorder:
        for number, time_s in enumerate(times):
            recorder.add(dataclasses.replace(shot(2 * number), time_s=time_s))
    found = played(tmp_path / "made")
    np.testing.assert_allclose([one.time_s - found[0].time_s for one in found], np.subtract(times, 100), atol=1e-6)
    assert numbers(found) == [0, 2, 4, 6, 8]


def test_an_interrupted_recording_ends_at_its_last_complete_image(interrupted):
    """Both files cut at many places, as if the process had been killed there."""
    video, lines = (interrupted / name for name in ("tactile.mkv", "frames.jsonl"))
    whole, every = video.read_bytes(), lines.read_bytes()
    assert numbers(played(interrupted)) == list(range(12))
    random = np.random.default_rng(0)
    for size in (*random.integers(1000, len(whole), 30), len(whole) - 1):
        video.write_bytes(whole[:size])
        found = played(interrupted)
        tactile = [number for number in numbers(found) if number % 2]
        assert numbers(found) == sorted([0, 2, 4, 6, 8, 10, *tactile])
        assert len(tactile) >= int(6 * (size - 1000) / len(whole)) - 1
        for number, one in zip(numbers(found), found, strict=True):
            np.testing.assert_array_equal(one.image, shot(number).image)
    video.write_bytes(whole)
    for size in (*random.integers(1000, len(every), 10), len(every) - 1):
        lines.write_bytes(every[:size])
        assert numbers(played(interrupted)) == list(range(every[:size].count(b"\n")))
    video.unlink()  # the process was killed before the first tactile image
    assert numbers(played(interrupted)) == [0, 2, 4, 6, 8, 10]


def test_a_full_disk_keeps_what_was_recorded(small_disk):
    recorder = hardware.Recorder(small_disk / "made", ORIGIN)

    def fill():
        for number in itertools.count():
            recorder.add(shot(number))

    with pytest.raises(OSError, match=r"cannot record to .*Free some disk space.* before are kept"):
        fill()
    with pytest.raises(ValueError, match="has ended: make a new one"):
        fill()
    number = sum(recorder.counts.values())
    recorder.close()
    found = played(small_disk / "made")
    assert number - 4 <= len(found) <= number
    for one in found:
        np.testing.assert_array_equal(one.image, shot(one.sequence // 3).image)


def test_pairs_follow_the_recorded_order(tmp_path):
    """An image belongs to the next one of the other stream, unless the camera or the controller was lost between."""
    with hardware.Recorder(tmp_path / "made", ORIGIN) as recorder:
        for number, epoch in [(0, 0), (1, 0), (3, 0), (2, 0), (4, 0), (6, 0), (7, 0), (8, 0), (9, 1), (10, 1)]:
            one = shot(number, epoch=epoch)
            recorder.add(dataclasses.replace(one, time_s=200 + recorder.counts["visual"] + recorder.counts["tactile"]))
        with pytest.raises(ValueError, match=r"shape \(4, 4, 3\), but all"):
            recorder.add(dataclasses.replace(one, image=np.zeros((4, 4, 3), np.uint8)))
    with hardware.Replay(tmp_path / "made", speed=None) as replay:
        pairs = [replay.read() for _ in range(4)]
        with pytest.raises(EOFError, match="has no further pair of images"):
            replay.read()
    assert [(*numbers([pair.visual, pair.tactile]),) for pair in pairs] == [(0, 1), (2, 3), (6, 7), (10, 9)]


def test_images_come_at_their_times_and_late_readers_miss_some(folder):
    """At twice the speed, and never before their time. `read` returns none from before the call."""
    with hardware.Replay(folder, speed=2.0) as replay:
        for one in itertools.islice(replay.stream(), 4):
            assert time.monotonic() >= one.time_s
        called_s = time.monotonic()
        pair = replay.read()
        assert called_s <= min(pair.visual.time_s, pair.tactile.time_s)
        assert time.monotonic() >= max(pair.visual.time_s, pair.tactile.time_s)
    with hardware.Replay(folder, speed=1.0) as replay:
        replay._shots = replay._play(time.monotonic() - 0.4)  # the buffer covers the last 0.25 s
        (first,) = numbers([next(replay.stream())])
        assert first >= 3
        assert replay.skipped == first


@pytest.mark.parametrize("name", ["manifest.json", "frames.jsonl", "visual.mkv", "tactile.mkv"])
def test_flipped_bits_and_truncated_missing_and_exchanged_files_are_found(folder, tmp_path, name):
    list(record(tmp_path / "other", range(2, 12)))
    for kind in damaged(folder / name, tmp_path / "other" / name):
        if name == "manifest.json":  # that of another recording lists other videos
            expected = {"missing": "holds no recording", "exchanged": "frames.jsonl"}.get(kind, "manifest.json")
        else:
            expected = rf"{name}.*copy the recording again"
        with pytest.raises(OSError, match=expected) as error:
            hardware.Replay(folder)
        assert isinstance(error.value, DamagedFileError) == ((name, kind) != ("manifest.json", "missing"))
    assert len(played(folder)) == 12


@pytest.mark.parametrize(
    ("old", "new"),
    [('"sequence": 9,', '"sequenc'), ('"sequence": 9,', '"sequence": 8,'), ('"stream": "tactile"', '"stream": "a"')],
)
def test_a_damaged_line_of_an_interrupted_recording_is_named(interrupted, old, new):
    lines = (interrupted / "frames.jsonl").read_text().splitlines(keepends=True)
    assert old in lines[3]
    lines[3] = lines[3].replace(old, new)
    (interrupted / "frames.jsonl").write_text("".join(lines))
    with pytest.raises(DamagedFileError, match=r"frames.jsonl, line 4, is damaged"):
        played(interrupted)


def test_a_line_without_checksums_is_read(interrupted):
    lines = [json.loads(line) for line in (interrupted / "frames.jsonl").read_text().splitlines()]
    older = [{name: x for name, x in line.items() if name not in ("checksum", "pixels")} for line in lines]
    (interrupted / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in older))
    assert len(played(interrupted)) == 12


def test_flipped_bits_in_the_images_of_an_interrupted_recording_are_found(interrupted):
    truth = [one.image for one in played(interrupted)]
    for kind in damaged(interrupted / "visual.mkv", flips=10):
        with contextlib.suppress(OSError, ValueError):
            assert kind in ("flipped", "truncated", "missing")
            assert all(map(np.array_equal, truth, [one.image for one in played(interrupted)])) or kind != "flipped"


@pytest.mark.parametrize(
    ("call", "error", "match"),
    [
        (lambda folder: hardware.Recorder(folder, ORIGIN), FileExistsError, "is not an empty folder: give the name"),
        (lambda folder: list(record(folder / "n", [])) or hardware.Replay(folder / "n"), ValueError, "has no image"),
        (lambda folder: hardware.Replay(folder / "none"), FileNotFoundError, "holds no recording"),
        (lambda folder: hardware.Replay(folder).read(), RuntimeError, "is not connected: call connect"),
        (lambda folder: hardware.Replay(folder, speed=math.nan), ValueError, "speed must be > 0 and finite"),
    ],
)
def test_bad_input_is_named(folder, call, error, match):
    with pytest.raises(error, match=match):
        call(folder)


def test_a_recording_has_a_copy_of_the_sensor_file(tmp_path):
    lens = hardware.Lens.ideal(*SIZE[::-1])
    device = hardware.Device("camera", 30.0, "0123", lens, 0.1, 0.1, (255,) * 4, "2026-05-31", lens_from="ideal")
    device.save(tmp_path / "bench", sts.Sensor(), (np.zeros((*SIZE, 3), np.uint8), np.full((*SIZE, 3), 9, np.uint8)))
    with hardware.Recorder(tmp_path / "made", ORIGIN, file=tmp_path / "bench") as recorder:
        recorder.add(shot(0))
        recorder.add(shot(2))
        assert hardware.Replay(tmp_path / "made").device == device  # before the recording ends
    assert len(played(tmp_path / "made")) == 2
    assert hardware.Replay(tmp_path / "made").device.backgrounds(tmp_path / "made")[1].mean() == 9
    (tmp_path / "made/background_tactile.png").write_bytes(b"")
    with pytest.raises(DamagedFileError, match=r"background_tactile\.png"):
        hardware.Replay(tmp_path / "made")
