"""Sessions on disk: nothing that was confirmed is lost, nothing half-written counts, and damage is found."""

import dataclasses
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import session_writer
from session_writer import ORIGIN, pair

from sts_jax import hardware, storage
from sts_jax.hardware import Session, Settling


def add(session, *, confirm=True, final=True):
    session.check_ready()
    number = session.begin()
    session.save(number, "initial", pair(number, "initial"))
    if final:
        session.save(number, "final", pair(number, "final"))
    if confirm:
        session.confirm(number, f"note {number}")
    return number


def standings(folder):
    return {entry.number: entry.standing for entry in hardware.list_recordings(folder)}


def test_reading_returns_what_was_saved(tmp_path):
    saved = {end: pair(0, end) for end in ("initial", "final")}
    with Session(tmp_path, ORIGIN, settling=Settling(0.1, 0.2)) as session:
        assert session.begin() == 0
        for end, taken in saved.items():
            session.save(0, end, taken)
        session.confirm(0, "on its edge")
        assert session.confirmed == 1
        read = hardware.load_recordings(tmp_path)  # while another part of the program collects
    (trajectory,) = read
    for end, stream in ((end, stream) for end in saved for stream in ("visual", "tactile")):
        one, two = (getattr(taken, stream) for taken in (getattr(trajectory, end), saved[end]))
        np.testing.assert_array_equal(one.image, two.image)
        assert dataclasses.replace(one, image=two.image).__dict__ == two.__dict__
    assert (trajectory.number, trajectory.note, len(read), read.origin) == (0, "on its edge", 1, ORIGIN)
    images = read.images(lambda image: image[::2])
    np.testing.assert_array_equal(images.tactile[0, 1], saved["final"].tactile.image[::2])
    np.testing.assert_array_equal(images.visual[0, 0], saved["initial"].visual.image[::2])
    facts = storage.read_manifest(tmp_path / "trajectories/00000/initial", "").facts
    assert facts["settling"] == {"visual_s": 0.1, "tactile_s": 0.2}
    assert facts["visual"]["taken"].endswith("+00:00")


def test_resuming_continues_with_the_next_number(tmp_path):
    for expected in range(3):
        with Session(tmp_path, ORIGIN) as session:
            assert session.confirmed == expected
            assert add(session) == expected
    with Session(tmp_path, ORIGIN) as session:
        session.discard(2)
        assert session.confirmed == 2
    with Session(tmp_path, ORIGIN) as session:
        assert add(session) == 3  # numbers of discarded trajectories are not used again
    assert standings(tmp_path) == {0: "confirmed", 1: "confirmed", 2: "discarded", 3: "confirmed"}


def test_discarding_and_restoring(tmp_path):
    with Session(tmp_path, ORIGIN) as session:
        numbers = [add(session), add(session, confirm=False), add(session, confirm=False, final=False)]
        session.discard(session.begin())  # nothing of it was saved
        with pytest.raises(storage.LockedError, match=r"is in use by .*: close what uses the folder"):
            hardware.discard_recording(tmp_path, 0)
    assert numbers == [0, 1, 2]
    hardware.discard_recording(tmp_path, 0)
    assert standings(tmp_path) == {0: "discarded", 1: "unconfirmed", 2: "incomplete"}
    with pytest.raises(ValueError, match="no confirmed trajectory"):
        hardware.load_recordings(tmp_path).images()
    hardware.restore_recording(tmp_path, 0)
    hardware.confirm_recording(tmp_path, 1, "later")
    with pytest.raises(FileNotFoundError, match="it has no final pair"):
        hardware.confirm_recording(tmp_path, 2)
    with pytest.raises(FileNotFoundError, match="list the trajectories"):
        hardware.restore_recording(tmp_path, 7)
    assert [(trajectory.number, trajectory.note) for trajectory in hardware.load_recordings(tmp_path)] == [
        (0, "note 0"),
        (1, "later"),
    ]


def test_a_session_of_another_sensor_and_other_folders_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no session"):
        hardware.load_recordings(tmp_path)
    Session(tmp_path / "session", ORIGIN).close()
    with pytest.raises(ValueError, match=r"was recorded with leds = '0123', but this sensor has leds = '0124'"):
        Session(tmp_path / "session", dataclasses.replace(ORIGIN, leds="0124"))
    Session(tmp_path / "session", ORIGIN).close()  # the lock was released
    storage.write_manifest(tmp_path, {}, {"shards": 3})
    with pytest.raises(ValueError, match=r"holds no session .*origin.camera is missing"):
        hardware.list_recordings(tmp_path)


@pytest.fixture(scope="module")
def two_trajectories(tmp_path_factory):
    folder = tmp_path_factory.mktemp("session")
    with Session(folder, ORIGIN) as session:
        add(session)
        add(session)
    return folder


@pytest.fixture
def folder(two_trajectories, tmp_path):
    return Path(shutil.copytree(two_trajectories, tmp_path / "session"))


def refused(folder, name):
    """The damage of trajectory 0 is found and named, the other trajectory is not affected."""
    read = hardware.load_recordings(folder)
    with pytest.raises(storage.DamagedFileError, match=rf"{name}.*discard trajectory 0"):
        read[0]
    assert read[1].number == 1


@pytest.mark.parametrize(
    "name",
    [
        "manifest.json",
        *(f"{end}/{name}" for end in ("initial", "final") for name in ("manifest.json", "visual.png", "tactile.png")),
    ],
)
def test_flipped_bits_and_truncated_missing_and_exchanged_files_are_found(folder, name):
    path, other = (folder / "trajectories" / number / name for number in ("00000", "00001"))
    data, places = path.read_bytes(), np.random.default_rng(0)
    for place in (0, len(data) - 2, *places.integers(0, len(data), 20)):
        path.write_bytes(data[:place] + bytes([data[place] ^ 1 << places.integers(0, 7)]) + data[place + 1 :])
        refused(folder, name)
    path.write_bytes(data[:-20])
    refused(folder, name)
    path.write_bytes(other.read_bytes())
    refused(folder, "trajectory 1" if name == "manifest.json" else name)
    path.unlink()
    if name != "manifest.json":  # without it, the trajectory is not confirmed
        refused(folder, name)
    path.write_bytes(data)
    assert len(list(hardware.load_recordings(folder))) == 2


def test_a_flipped_bit_in_the_manifest_of_the_session_is_found(folder):
    path = folder / "manifest.json"
    data = path.read_bytes()
    for place in np.random.default_rng(0).integers(0, len(data) - 1, 20):
        path.write_bytes(data[:place] + bytes([data[place] ^ 2]) + data[place + 1 :])
        for use in (hardware.load_recordings, hardware.list_recordings, lambda folder: Session(folder, ORIGIN)):
            with pytest.raises(storage.DamagedFileError, match=r"manifest.json .*restore it from a backup"):
                use(folder)


def test_exchanged_pairs_foreign_trajectories_and_damage_before_the_confirmation_are_found(folder, tmp_path):
    path = folder / "trajectories/00000"
    for one, two in (("initial", "x"), ("final", "initial"), ("x", "final")):
        (path / one).rename(path / two)
    refused(folder, "initial/.*")
    shutil.rmtree(path)
    with Session(tmp_path / "other", dataclasses.replace(ORIGIN, leds="0124")) as session:
        add(session)
        add(session, confirm=False)
    shutil.copytree(tmp_path / "other/trajectories/00000", path)
    refused(folder, "another sensor")
    hardware.discard_recording(folder, 0)
    assert len(list(hardware.load_recordings(folder))) == 1
    image = tmp_path / "other/trajectories/00001/final/visual.png"
    image.write_bytes(image.read_bytes()[:-1] + b"x")
    hardware.confirm_recording(tmp_path / "other", 1)
    with pytest.raises(storage.DamagedFileError, match=r"final/visual\.png"):
        hardware.load_recordings(tmp_path / "other")[1]


def test_a_full_disk_loses_nothing(small_disk):
    ballast, folder = small_disk / "ballast", small_disk / "session"
    with Session(folder, ORIGIN) as session:
        add(session)
        ballast.write_bytes(bytes(os.statvfs(small_disk).f_bavail * os.statvfs(small_disk).f_bsize - 16384))
        with pytest.raises(OSError, match="only 0 MB are free"):
            session.check_ready()
        number = session.begin()
        with pytest.raises(OSError, match=r"cannot write .*No space left.*Free some disk space"):
            session.save(number, "initial", pair(number, "initial"))
        assert standings(folder) == {0: "confirmed", 1: "incomplete"}
        with pytest.raises(FileNotFoundError, match="it has no initial pair"):
            session.confirm(number)
        ballast.unlink()
        for end in ("initial", "final"):
            session.save(number, end, pair(number, end))
        session.confirm(number)
        assert session.confirmed == 2
    np.testing.assert_array_equal(hardware.load_recordings(folder)[1].final.visual.image, pair(1, "final").visual.image)


@pytest.mark.parametrize("kills", [3, pytest.param(40, marks=pytest.mark.slow)])
def test_killing_the_writer_loses_no_confirmed_pair(tmp_path, kills):
    moments, reported, partial = random.Random(kills), set(), 0
    path = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    with subprocess.Popen(
        [sys.executable, session_writer.__file__, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    ) as run:
        for _ in range(kills):
            run.stdin.write("start\n")
            run.stdin.flush()
            first = run.stdout.readline()
            assert first.startswith("ready "), f"{first!r} instead of ready. Exit code {run.poll()}"
            writer = int(first.split()[1])
            time.sleep(moments.uniform(0, 0.08))
            os.kill(writer, signal.SIGKILL)
            while (line := run.stdout.readline()) != "killed\n":
                reported.add(int(line))
            partial += len(list(tmp_path.glob("trajectories/*/.*.partial")))
    assert kills < 40 or (reported and partial)  # some kills came in the middle of a pair
    read = hardware.load_recordings(tmp_path)
    assert reported <= set(read.numbers)  # nothing that was confirmed is lost
    for trajectory in read:
        for end in ("initial", "final"):
            found, made = getattr(trajectory, end), pair(trajectory.number, end)
            np.testing.assert_array_equal(found.visual.image, made.visual.image)
            np.testing.assert_array_equal(found.tactile.image, made.tactile.image)
    for folder_of_pair in tmp_path.glob("trajectories/*/[if]*l"):  # initial and final: no half pair, confirmed or not
        storage.verify(folder_of_pair, storage.read_manifest(folder_of_pair, ""), "")
    Session(tmp_path, ORIGIN).close()
    assert not list(tmp_path.glob("trajectories/*/.*.partial"))
