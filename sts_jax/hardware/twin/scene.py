"""The scene in front of the twin's camera: an empty pad, or an object that is held, moving or at rest."""

import abc
import bisect
import dataclasses
import enum
import functools
import math
import threading
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sts_jax import physics
from sts_jax.frame import placed_wrongly, sense
from sts_jax.hardware.twin.photometry import Blender, Ends
from sts_jax.objects import Body, make
from sts_jax.sensor import Sensor

MOTION_RATE = 10.0  # rendered poses per second of a moving object, in views of up to _MOTION_PIXELS
_MOTION_PIXELS = 640 * 480  # a larger view takes longer to render, so it has proportionally fewer poses, at least 1
STILL_M = 0.0002  # largest distance of an object at rest from its last position (m)
STILL_RAD = 0.01  # largest angle of an object at rest from its last orientation (rad)
_BATCH = 16  # trajectories that are simulated together
_ATTEMPTS = 2  # batches without a settled trajectory after which an error is raised
_EVENTS = 64  # remembered changes of the scene. An exposure is at most a few changes old when its frame is made
_NOWHERE = np.array([0, 0, -1, 1, 0, 0, 0], np.float32)  # pose of an object that is not in view


class Phase(enum.StrEnum):
    """What the object does."""

    EMPTY = "empty"  # no object is on the pad
    HELD = "held"  # a hand, which is not rendered, holds the object on the pad in an unstable pose
    MOVING = "moving"  # the object was released and moves
    STILL = "still"  # the object is at rest, or has left the pad


@dataclasses.dataclass(frozen=True)
class Seen:
    """The state of a scene at one time."""

    phase: Phase
    trajectory: int  # number of the current trajectory, from 0. In an empty scene, number of the last one, or -1
    frame: int  # index of the rendered pose in the trajectory
    pose: tuple[float, ...] | None  # object's position (m) and quaternion (w, x, y, z), or None without an object


class Scene(abc.ABC):
    """Base class of scenes. `Twin` never calls `at` and `command` at the same time."""

    sensor: Sensor | None = None  # exposure and view of the images. None: `Sensor()`

    @abc.abstractmethod
    def at(self, time_s: float) -> Seen:
        """Return the state at a time (s), which may lie a few commands before the newest one."""

    @abc.abstractmethod
    def ends(self, seen: Seen, blender: Blender) -> Ends:
        """Return the images of the scene in the state `seen`, from `blender.ends`."""

    def prepare(self, command: str, blender: Blender) -> None:  # noqa: B027, few scenes need it
        """Render the images that a command will need. May be called from any thread."""

    def command(self, command: str, time_s: float) -> None:
        """Change the scene from a time on (s), which does not decrease between calls."""
        raise ValueError(f"command is {command!r}, but a {type(self).__name__} does not change: use an ObjectScene")

    def choose(self, category: str, seed: int) -> None:
        """Replace the object from the next command `hold` on. Must not run at the same time as `prepare`."""
        raise ValueError(f"a {type(self).__name__} has no object to replace by a {category}: use an ObjectScene")


class Picture(Scene):
    """A scene that never changes, such as a calibration board: its sRGB images with the LEDs off and at full power."""

    def __init__(self, visual: np.ndarray, tactile: np.ndarray):
        """Store the images, in [0, 1], shape (height, width, 3)."""
        self._ends = functools.cache(lambda blender: blender.ends(np.asarray(visual), np.asarray(tactile)))

    def at(self, time_s: float) -> Seen:
        """Return the only state."""
        del time_s
        return Seen(Phase.STILL, 0, 0, None)

    def ends(self, seen: Seen, blender: Blender) -> Ends:
        """Return the two images, converted once."""
        del seen
        return self._ends(blender)


class _Motion(NamedTuple):
    """One simulated trajectory."""

    body: Body
    pose: np.ndarray  # mesh frame in the sensor frame: position (m) and quaternion, shape (frames, 7)
    wrench: np.ndarray  # force (N) and moment (N m) of the pad on the object, shape (frames, 6)
    rate: float  # frame rate of the simulation (frames/s)
    rest: int  # first frame from which on the object is at rest

    def drawn(self, elapsed_s: float, motion_rate: float) -> int:
        """Index of the pose that is rendered at a time after the release (s). An object at rest is in the last pose."""
        frame = round(int(elapsed_s * motion_rate) * self.rate / motion_rate)
        return frame if elapsed_s * self.rate < self.rest and frame < self.rest else len(self.pose) - 1

    def all_drawn(self, motion_rate: float) -> set[int]:
        """Indices of all poses that are rendered after the release."""
        steps = int(self.rest / self.rate * motion_rate) + 1
        return {len(self.pose) - 1, *(self.drawn(step / motion_rate, motion_rate) for step in range(steps))}


class ObjectScene(Scene):
    """A scene with one object, which follows simulated trajectories of a scenario.

    The pad is empty at first. The command `hold` places the object in the first pose of the next trajectory, `release`
    lets it go, and `clear` takes it away. Trajectories that end before the object has come to rest are skipped.
    """

    sensor: Sensor

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
        """Prepare the scene. The simulation starts when a trajectory is needed.

        Args:
            scenario: Scenario of the trajectories. Default: `physics.Released()`.
            resolution: (height, width) of the rendered view (pixels).
            motion_rate: Rendered poses per second of a moving object. Default: 10 for views of up to 640 x 480 pixels,
                and proportionally fewer for larger views, but at least 1.
            first: Number of the first trajectory, to continue an earlier scene of the same seed.
        """
        if motion_rate is None:
            motion_rate = max(1.0, MOTION_RATE * min(1.0, _MOTION_PIXELS / math.prod(resolution)))
        if not 0 < motion_rate < math.inf:
            raise ValueError(f"motion_rate must be positive and finite, got {motion_rate}")
        self.sensor = Sensor() if sensor is None else sensor
        self.scenario = physics.Released() if scenario is None else scenario
        self.scenario.check()
        self._body = body
        self._resolution = resolution
        self._motion_rate = motion_rate
        self._key = jax.random.key(seed)
        self._events: list[tuple[float, Phase, int]] = [(-float("inf"), Phase.EMPTY, first - 1)]
        self._batches = 0
        self._motions: list[_Motion] = []  # all trajectories so far, which take a few kilobytes each, and their bodies
        # Images by camera, trajectory and frame. (-1, 0) is the empty pad
        self._rendered: dict[tuple[Blender, int, int], Ends] = {}
        self._working = threading.Lock()  # lets one simulation or rendering run at a time

    def at(self, time_s: float) -> Seen:
        """Return the state of the scene at a time (s)."""
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
        """Return the images of the object's pose, or of the empty pad. Each pose is rendered once."""
        return self._render(-1 if seen.phase is Phase.EMPTY else seen.trajectory, seen.frame, blender)

    def prepare(self, command: str, blender: Blender) -> None:
        """Render the images that a command will need."""
        number = self._events[-1][2]
        match command:
            case "hold":
                self._render(number + 1, 0, blender)
            case "release" if number >= 0:
                for frame in self._motion(number).all_drawn(self._motion_rate):
                    self._render(number, frame, blender)
            case "clear":
                self._render(-1, 0, blender)

    def command(self, command: str, time_s: float) -> None:
        """Hold, release or remove the object from a time on (s)."""
        _, _, number = self._events[-1]
        after = {"hold": (Phase.HELD, number + 1), "release": (Phase.MOVING, number), "clear": (Phase.EMPTY, number)}
        if command not in after:
            raise ValueError(f"command must be 'hold', 'release' or 'clear', got {command!r}")
        if command == "release" and (phase := self.at(time_s).phase) is not Phase.HELD:
            raise ValueError(f"command is 'release', but the phase is '{phase}': send 'hold' first")
        self._events.append((time_s, *after[command]))
        del self._events[:-_EVENTS]
        for key in [key for key in self._rendered if 0 <= key[1] < self._events[-1][2] - 1]:
            del self._rendered[key]

    def choose(self, category: str, seed: int) -> None:
        """Replace the object by `objects.make(jax.random.key(seed), category)`, from the next command `hold` on."""
        body, (_, _, number) = make(jax.random.key(seed), category), self._events[-1]
        with self._working:
            self._body = body
            del self._motions[number + 1 :]
            for key in [key for key in self._rendered if key[1] > number]:
                del self._rendered[key]

    def _motion(self, number: int) -> _Motion:
        """The trajectory with a number, which is simulated if necessary."""
        if number < len(self._motions):  # before the lock, so that nobody waits for a rendering in another thread
            return self._motions[number]
        with self._working:
            unsettled = 0
            while len(self._motions) <= number:
                settled = self._simulate()
                unsettled = 0 if settled else unsettled + _BATCH
                if unsettled == _ATTEMPTS * _BATCH:
                    raise ValueError(f"none of {unsettled} simulated trajectories settled: increase scenario.frames")
                self._motions += settled
            return self._motions[number]

    def _simulate(self) -> list[_Motion]:
        """Simulate the next batch of trajectories, and return those in which the object comes to rest."""
        key = jax.random.fold_in(self._key, self._batches)
        self._batches += 1
        batch = physics.simulate(key, self._body, self.sensor, self.scenario, num=_BATCH)
        settled = [(np.asarray(batch.pose[i]), np.asarray(batch.wrench[i])) for i in np.flatnonzero(batch.settled)]
        return [_Motion(self._body, pose, wrench, self.scenario.rate, _rest(pose)) for pose, wrench in settled]

    def _render(self, trajectory: int, frame: int, blender: Blender) -> Ends:
        """The images of one pose without light and at full light, rendered or from the cache."""
        body, pose, wrench = self._body, _NOWHERE, np.zeros(6, np.float32)
        if trajectory >= 0:
            motion = self._motion(trajectory)
            body, pose, wrench = motion.body, motion.pose[frame], motion.wrench[frame]
        if (ends := self._rendered.get((blender, trajectory, frame))) is not None:
            return ends
        with self._working:
            ends = self._rendered.get((blender, trajectory, frame))  # another thread may have rendered it meanwhile
            if ends is None:
                if placed_wrongly(self.sensor, body, pose, None, self._resolution):  # it fell off, beside or below
                    pose, wrench = _NOWHERE, np.zeros(6, np.float32)
                state = jnp.asarray(pose), jnp.asarray(wrench)
                images = sense(self.sensor, body, *state, resolution=self._resolution)
                ends = blender.ends(np.asarray(images.visual), np.asarray(images.tactile))
                self._rendered[blender, trajectory, frame] = ends
            return ends


def _rest(pose: np.ndarray) -> int:
    """The first frame from which on all poses (frames, 7) are close to the last one."""
    apart = np.linalg.norm(pose[:, :3] - pose[-1, :3], axis=1)
    turned = 2 * np.arccos(np.clip(np.abs(pose[:, 3:] @ pose[-1, 3:]), 0, 1))
    moving = np.flatnonzero((apart > STILL_M) | (turned > STILL_RAD))
    return int(moving[-1]) + 1 if len(moving) else 0
