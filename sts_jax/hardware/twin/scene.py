"""The scene over time: an empty pad, an object that is held, moves after its release, and lies still."""

import abc
import bisect
import enum
import math
import threading
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sts_jax import physics
from sts_jax.frame import sense
from sts_jax.hardware.twin.photometry import Blender, Ends
from sts_jax.objects import Body
from sts_jax.sensor import Sensor

MOTION_RATE = 10.0  # drawn poses per second of a moving object, up to the size below
_MOTION_PIXELS = 640 * 480  # a larger view takes longer to render and has proportionally fewer poses, at least 1
STILL_M = 0.0002  # m, an object whose origin remains within this distance of its last place is still
STILL_RAD = 0.01  # rad, the same for its orientation
_BATCH = 16  # trajectories that are simulated at once
_ATTEMPTS = 2  # batches without a settled trajectory before giving up
_EVENTS = 64  # remembered changes of the scene. Exposures lie at most a few of them back
_NOWHERE = np.array([0, 0, -1, 1, 0, 0, 0], np.float32)  # pose of an object that is not in view


class Phase(enum.StrEnum):
    """Phase of the scene."""

    EMPTY = "empty"  # no object is on the pad
    HELD = "held"  # a hand holds the object on the pad in an unstable pose. The hand is not drawn
    MOVING = "moving"  # it was let go
    STILL = "still"  # it is at rest, or has left the pad


class Seen(NamedTuple):
    """The scene at one moment."""

    phase: Phase
    trajectory: int  # number of the trajectory, from 0. With an empty pad that of the last one, or -1
    frame: int  # index of the drawn pose in the trajectory
    pose: tuple[float, ...] | None  # mesh frame in the sensor frame (m, quaternion), or None without an object


class Scene(abc.ABC):
    """The contents of the twin's view. `Twin` calls `at` and `command` one at a time."""

    exposure: float = 1.0  # of the visual stream over that of the tactile one, `Room.exposure`

    @abc.abstractmethod
    def at(self, time_s: float) -> Seen:
        """The scene at a time (s), not before the last but a few commands."""

    @abc.abstractmethod
    def ends(self, seen: Seen, blender: Blender) -> Ends:
        """The two ends of the light of a moment. Takes the time of a rendering unless `prepare` was called."""

    def prepare(self, command: str, blender: Blender) -> None:  # noqa: B027, few scenes need it
        """Do the work that a command needs, so that no later call of `ends` takes long. Threads may call it."""

    def command(self, command: str, time_s: float) -> None:
        """Apply `release`, `hold` or `clear` from a time on (s), which must not decrease.

        Raises:
            ValueError: The command is unknown or not possible in the current phase. The message names the remedy.
        """
        raise ValueError(f"command {command!r} is not possible: this scene does not change")

    def start(self, blender: Blender) -> None:  # noqa: B027, few scenes need it
        """Begin to work ahead in a thread. The virtual clock does not need it."""

    def close(self) -> None:  # noqa: B027, few scenes need it
        """End the thread."""


class Picture(Scene):
    """Two constant images, such as a calibration board under both ends of the light."""

    def __init__(self, visual: np.ndarray, tactile: np.ndarray):
        """Keep the images, sRGB in [0, 1], (height, width, 3), of the LEDs off and at full power."""
        self._images = np.asarray(visual), np.asarray(tactile)
        self._ends: tuple[Blender, Ends] | None = None

    def at(self, time_s: float) -> Seen:
        """See `Scene.at`."""
        del time_s
        return Seen(Phase.STILL, 0, 0, None)

    def ends(self, seen: Seen, blender: Blender) -> Ends:
        """See `Scene.ends`."""
        del seen
        if self._ends is None or self._ends[0] is not blender:
            self._ends = blender, blender.ends(*self._images)
        return self._ends[1]


class _Motion(NamedTuple):
    """One simulated trajectory."""

    pose: np.ndarray  # (frames, 7)
    wrench: np.ndarray  # (frames, 6)
    rate: float  # frames/s
    rest: int  # first frame from which on the object is still
    outcome: str

    def drawn(self, elapsed_s: float, motion_rate: float) -> int:
        """The pose that is drawn at a time since the release (s): the last one of the motion's rate."""
        frame = round(int(elapsed_s * motion_rate) * self.rate / motion_rate)
        return frame if elapsed_s * self.rate < self.rest and frame < self.rest else len(self.pose) - 1

    def indices(self, motion_rate: float) -> list[int]:
        """All poses that are drawn, the first one and the one at rest before the others."""
        steps = int(self.rest / self.rate * motion_rate) + 1
        moving = [self.drawn(step / motion_rate, motion_rate) for step in range(steps)]
        return list(dict.fromkeys([0, len(self.pose) - 1, *moving]))


class ObjectScene(Scene):
    """An object that is held on the pad and released, once in each trajectory of a scenario.

    The scene begins empty. `hold` places the object in the first pose of the next trajectory, `release` lets it go, and
    `clear` takes it away. From the release on, the poses of the trajectory are drawn at `motion_rate` until the object
    is still. The drawn pose is then the last one.

    Trajectories that have not settled at the end of the simulation are left out.
    """

    def __init__(
        self,
        body: Body,
        *,
        sensor: Sensor | None = None,
        scenario: physics.Scenario | None = None,
        resolution: tuple[int, int] = (480, 640),
        motion_rate: float | None = None,
        seed: int = 0,
        first: int = 0,
    ):
        """Describe the scene. Nothing is simulated yet.

        Args:
            body: The object.
            sensor: Default: the paper's.
            scenario: Starts and motion. Default: `physics.Released`.
            resolution: (height, width) of the rendered view, pixels.
            motion_rate: Drawn poses per second of the motion. Each one is rendered once. Default: 10 up to 640x480
                pixels, and proportionally fewer for larger views.
            seed: Of the trajectories.
            first: Number of the first trajectory, to continue an earlier scene.

        Raises:
            ValueError: A value is out of range.
        """
        if first < 0:
            raise ValueError(f"first must be >= 0, got {first}")
        if motion_rate is None:
            motion_rate = max(1.0, MOTION_RATE * min(1.0, _MOTION_PIXELS / math.prod(resolution)))
        if not 0 < motion_rate < float("inf"):
            raise ValueError(f"motion_rate must be positive and finite, got {motion_rate}")
        self.sensor = Sensor() if sensor is None else sensor
        self.exposure = float(self.sensor.room.exposure)
        self._body = body
        self._scenario = physics.Released() if scenario is None else scenario
        self._scenario.check()
        self._resolution = resolution
        self._motion_rate = motion_rate
        self._key = jax.random.key(seed)
        self._events: list[tuple[float, Phase, int]] = [(-float("inf"), Phase.EMPTY, first - 1)]
        self._batches = 0
        self._motions: list[_Motion] = []  # all so far. Their poses take a few kilobytes each
        self._rendered: dict[tuple[int, int], Ends] = {}  # by trajectory and frame. (-1, 0) is the empty pad
        self._working = threading.Lock()  # one simulation or rendering at a time
        self._wake, self._stop = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def scenario(self) -> physics.Scenario:
        """The scenario that the trajectories follow."""
        return self._scenario

    def outcome(self, trajectory: int) -> str:
        """The outcome of a trajectory in words, as the scenario names it."""
        return self._motion(trajectory).outcome

    def at(self, time_s: float) -> Seen:
        """See `Scene.at`."""
        index = bisect.bisect_right(self._events, time_s, key=lambda event: event[0]) - 1
        since_s, phase, number = self._events[max(index, 0)]
        if phase is Phase.EMPTY:
            return Seen(phase, number, 0, None)
        motion, frame = self._motion(number), 0
        if phase is Phase.MOVING:
            frame = motion.drawn(time_s - since_s, self._motion_rate)
            phase = Phase.STILL if frame == len(motion.pose) - 1 else Phase.MOVING
        return Seen(phase, number, frame, tuple(float(value) for value in motion.pose[frame]))

    def ends(self, seen: Seen, blender: Blender) -> Ends:
        """See `Scene.ends`."""
        if seen.phase is Phase.EMPTY:
            return self._render(-1, 0, blender)
        return self._render(seen.trajectory, seen.frame, blender)

    def prepare(self, command: str, blender: Blender) -> None:
        """See `Scene.prepare`."""
        number = self._events[-1][2]
        match command:
            case "hold":
                self._render(number + 1, 0, blender)
            case "release" if number >= 0:
                for frame in self._motion(number).indices(self._motion_rate):
                    self._render(number, frame, blender)
            case "clear":
                self._render(-1, 0, blender)

    def command(self, command: str, time_s: float) -> None:
        """See `Scene.command`."""
        last_s, _, number = self._events[-1]
        if time_s < last_s:
            raise ValueError(f"time_s must be at least that of the last command, {last_s}, got {time_s}")
        phase = self.at(time_s).phase
        match command:
            case "hold":
                self._events.append((time_s, Phase.HELD, number + 1))
            case "release" if phase is Phase.HELD:
                self._events.append((time_s, Phase.MOVING, number))
            case "clear":
                self._events.append((time_s, Phase.EMPTY, number))
            case "release":
                raise ValueError(f"nothing can be released: the phase is {phase}. Send hold first")
            case _:
                raise ValueError(f"unknown command {command!r}: it must be release, hold or clear")
        del self._events[:-_EVENTS]
        for key in [key for key in self._rendered if 0 <= key[0] < self._events[-1][2] - 1]:
            del self._rendered[key]
        self._wake.set()

    def start(self, blender: Blender) -> None:
        """See `Scene.start`. The thread renders the current trajectory and the first pose of the next one."""
        if self._thread is None:
            self._stop.clear()
            self._wake.set()
            self._thread = threading.Thread(target=self._work, args=(blender,), name="twin's renderer", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """See `Scene.close`. A rendering that has begun is finished first."""
        self._stop.set()
        self._wake.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _work(self, blender: Blender) -> None:
        """Render ahead: the empty pad, the current trajectory, and the beginning of the next one."""
        while not self._stop.is_set():
            self._wake.wait()
            self._wake.clear()
            number = self._events[-1][2]
            for trajectory in (-1, number, number + 1):
                indices = [0] if trajectory < 0 else self._motion(trajectory).indices(self._motion_rate)
                for frame in indices:
                    if self._stop.is_set() or self._wake.is_set():
                        break
                    self._render(trajectory, frame, blender)

    def _motion(self, number: int) -> _Motion:
        if number < len(self._motions):  # without waiting for a rendering
            return self._motions[number]
        with self._working:
            attempts = 0
            while len(self._motions) <= number:
                found = self._simulate()
                attempts = 0 if found else attempts + 1
                if attempts == _ATTEMPTS:
                    raise ValueError(
                        f"none of {_ATTEMPTS * _BATCH} trajectories has settled within {self._scenario.frames} frames: "
                        "give the scenario more frames"
                    )
                self._motions += found
            return self._motions[number]

    def _simulate(self) -> list[_Motion]:
        """Simulate the next batch, and keep the trajectories that have settled."""
        key = jax.random.fold_in(self._key, self._batches)
        self._batches += 1
        found = physics.simulate(key, self._body, self.sensor, self._scenario, num=_BATCH)
        poses, wrenches = np.asarray(found.pose), np.asarray(found.wrench)
        return [
            _Motion(poses[i], wrenches[i], self._scenario.rate, _rest(poses[i]), self._scenario.named(int(outcome)))
            for i, outcome in enumerate(found.outcome)
            if found.settled[i]
        ]

    def _render(self, trajectory: int, frame: int, blender: Blender) -> Ends:
        """The two ends of one pose, from the cache if possible."""
        if (ends := self._rendered.get((trajectory, frame))) is not None:
            return ends
        pose, wrench = _NOWHERE, np.zeros(6, np.float32)
        if trajectory >= 0:
            motion = self._motion(trajectory)
            pose, wrench = motion.pose[frame], motion.wrench[frame]
        with self._working:
            if (ends := self._rendered.get((trajectory, frame))) is not None:
                return ends
            images = sense(self.sensor, self._body, jnp.asarray(pose), jnp.asarray(wrench), resolution=self._resolution)
            ends = blender.ends(np.asarray(images.visual), np.asarray(images.tactile))
            self._rendered[trajectory, frame] = ends
            return ends


def _rest(pose: np.ndarray) -> int:
    """The first frame from which on all poses are close to the last one."""
    apart = np.linalg.norm(pose[:, :3] - pose[-1, :3], axis=1)
    turned = 2 * np.arccos(np.clip(np.abs(pose[:, 3:] @ pose[-1, 3:]), 0, 1))
    moving = np.flatnonzero((apart > STILL_M) | (turned > STILL_RAD))
    return int(moving[-1]) + 1 if len(moving) else 0
