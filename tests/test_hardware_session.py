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
from damage import damaged
from session_writer import ORIGIN, pair

from sts_jax import hardware, storage
from sts_jax.hardware import Session

OTHER = dataclasses.replace(ORIGIN, leds="0124")
FILES = [
    "manifest.json",
    *(f"{e}/{n}" for e in ("initial", "final") for n in ("manifest.json", "visual.png", "tactile.png")),
]


def add(session, *, confirm=True, final=True):
    session.check_ready()
    number = session.begin()
    for end in ("initial", "final") if final else ("initial",):
        session.save(number, end, pair(number, end))
    if confirm:
        session.confirm(number, f"note {number}")
    return number


def standings(folder):
    return {entry.number: entry.standing for entry in hardware.list_recordings(folder)}


def check(trajectory):
    """The images are those that were written."""
    for end in ("initial", "final"):
        for stream in ("visual", "tactile"):
            one, two = (getattr(taken, stream) for taken in (getattr(trajectory, end), pair(trajectory.number, end)))
            np.testing.assert_array_equal(one.image, two.image)


def test_reading_returns_what_was_saved(tmp_path):
    saved = {end: pair(0, end) for end in ("initial", "final")}
    with Session(tmp_path, ORIGIN) as session:
        assert session.begin() == 0
        for end, taken in saved.items():
            session.save(0, end, taken)
        session.confirm(0, "on its edge")
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


def test_a_session_is_continued_and_its_trajectories_discarded_restored_and_confirmed_later(tmp_path):
    for expected in range(2):
        with Session(tmp_path, ORIGIN) as session:
            assert session.confirmed == expected
            assert add(session) == expected
    with Session(tmp_path, ORIGIN) as session:
        assert [add(session, confirm=False), add(session, confirm=False, final=False)] == [2, 3]
    before = hardware.load_recordings(tmp_path).identity
    with Session(tmp_path) as session:
        session.discard(1)
        assert session.confirmed == 1
        assert add(session) == 4  # numbers of discarded trajectories are not used again
    assert standings(tmp_path) == {0: "confirmed", 1: "discarded", 2: "unconfirmed", 3: "incomplete", 4: "confirmed"}
    assert hardware.load_recordings(tmp_path).identity != before
    with Session(tmp_path) as session:
        session.restore(1)
        session.discard(4)
        assert session.confirmed == 2
        assert hardware.load_recordings(tmp_path).identity == before
        session.confirm(2, "later")
        for number in (0, 2):
            with pytest.raises(FileExistsError, match=f"trajectory {number} is confirmed already"):
                session.confirm(number)
    notes = [(trajectory.number, trajectory.note) for trajectory in hardware.load_recordings(tmp_path)]
    assert notes == [(0, "note 0"), (1, "note 1"), (2, "later")]


@pytest.mark.parametrize(
    ("call", "error", "match"),
    [
        (lambda folder: hardware.load_recordings(folder.parent), FileNotFoundError, "holds no session"),
        (lambda folder: Session(folder.parent), FileNotFoundError, "holds no session"),
        (lambda folder: Session(folder, OTHER), ValueError, "leds = '0123', but the current settings have leds"),
        (lambda folder: hardware.load_recordings(folder).images(), ValueError, "no confirmed trajectory"),
        (lambda folder: Session(folder).confirm(0), FileNotFoundError, "it has no final pair"),
        (lambda folder: Session(folder).restore(7), FileNotFoundError, "list the trajectories"),
        (lambda folder: (Session(folder), Session(folder)), storage.LockedError, "is in use by .*: close what uses"),
        (
            lambda folder: (storage.write_manifest(folder, {}, {"shards": 3}), Session(folder)),
            storage.DamagedFileError,
            r"is that of another folder .*facts.camera is missing.*give the folder of a session",
        ),
    ],
)
def test_what_is_no_session_and_what_it_cannot_do_is_named(tmp_path, call, error, match):
    with Session(tmp_path / "session", ORIGIN) as session:
        add(session, confirm=False, final=False)
    with pytest.raises(error, match=match):
        call(tmp_path / "session")
    assert not (tmp_path / "manifest.json").exists()


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


@pytest.mark.parametrize("name", FILES)
def test_flipped_bits_and_truncated_missing_and_exchanged_files_are_found(folder, name):
    path, other = (folder / "trajectories" / number / name for number in ("00000", "00001"))
    for kind in damaged(path, other):
        if name == "manifest.json" and kind in ("exchanged", "missing"):
            # The manifest of another trajectory names it. Without a manifest, the trajectory is not confirmed.
            refused(folder, "trajectory 1") if kind == "exchanged" else None
        else:
            refused(folder, name)
    assert len(list(hardware.load_recordings(folder))) == 2


def test_damage_of_the_manifest_of_the_session_is_found(folder):
    for kind in damaged(folder / "manifest.json"):
        for use in (hardware.load_recordings, hardware.list_recordings, Session):
            with pytest.raises(OSError, match=r"manifest.json (.*restore it from a backup|is missing)") as error:
                use(folder)
            assert isinstance(error.value, storage.DamagedFileError) == (kind != "missing")


def test_exchanged_pairs_foreign_trajectories_and_damage_before_the_confirmation_are_found(folder, tmp_path):
    path = folder / "trajectories/00000"
    for one, two in (("initial", "x"), ("final", "initial"), ("x", "final")):
        (path / one).rename(path / two)
    refused(folder, "initial/.*")
    shutil.rmtree(path)
    with Session(tmp_path / "other", OTHER) as session:
        add(session)
        add(session, confirm=False)
        image = tmp_path / "other/trajectories/00001/final/visual.png"
        image.write_bytes(image.read_bytes()[:-1] + b"x")
        session.confirm(1)
    shutil.copytree(tmp_path / "other/trajectories/00000", path)
    refused(folder, "another sensor")
    with pytest.raises(storage.DamagedFileError, match=r"final/visual\.png"):
        hardware.load_recordings(tmp_path / "other")[1]


def test_a_full_disk_loses_nothing(small_disk):
    ballast, folder = small_disk / "ballast", small_disk / "session"
    with Session(folder, ORIGIN) as session:
        add(session)
        ballast.write_bytes(bytes(shutil.disk_usage(small_disk).free - 16384))
        with pytest.raises(OSError, match="only 0 MB are free"):
            session.check_ready()
        number = session.begin()
        with pytest.raises(OSError, match=r"cannot write .*No space left.*Free some disk space"):
            session.save(number, "initial", pair(number, "initial"))
        assert standings(folder) == {0: "confirmed", 1: "incomplete"}
        ballast.unlink()
        for end in ("initial", "final"):
            session.save(number, end, pair(number, end))
        session.confirm(number)
    check(hardware.load_recordings(folder)[1])


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
            time.sleep(moments.uniform(0, 0.08))
            os.kill(int(first.split()[1]), signal.SIGKILL)
            while (line := run.stdout.readline()) != "killed\n":
                reported.add(int(line))
            partial += len(list(tmp_path.glob("trajectories/*/.*.partial")))
    assert kills < 40 or (reported and partial)  # some kills came in the middle of a pair
    Session(tmp_path, ORIGIN).close()
    read = hardware.load_recordings(tmp_path)
    assert reported <= set(read.numbers)  # nothing that was confirmed is lost
    for trajectory in read:
        check(trajectory)
    for folder_of_pair in tmp_path.glob("trajectories/*/[if]*l"):  # initial and final: no half pair, confirmed or not
        storage.verify(folder_of_pair, storage.read_manifest(folder_of_pair, ""), "")
    assert not list(tmp_path.glob("trajectories/*/.*.partial"))
