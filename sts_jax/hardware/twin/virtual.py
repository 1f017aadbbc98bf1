"""`VirtualSensor`: the proof of light of `STS` on the virtual clock of a `Twin`, and `Hand`, which moves its object."""

from collections.abc import Sequence

from sts_jax.hardware import protocol
from sts_jax.hardware.camera import Captured
from sts_jax.hardware.collecting import Action, AutomaticPerson, View
from sts_jax.hardware.guide import Stage
from sts_jax.hardware.proof import Pair, ProvenFrames, Settling
from sts_jax.hardware.session import Origin, Session
from sts_jax.hardware.sts import checked_levels
from sts_jax.hardware.twin.device import Twin

CAMERA = "twin"  # name of the camera in sessions and sensor files
_SWITCHES = 8  # number of switches in each direction from which the settling times are measured
_WATCH_S = 1.0  # time after the first switch in each direction during which frames are watched (s)
_TIMEOUT_S = 10.0  # longest wait for a pair (s)
_UNSEEN_S = 3.0  # time without a visible contact after which the next held pose is tried (s)
_UNSEEN = 10  # held poses in a row without a visible contact after which the hand gives up
_UNMOVED_S = 3.0  # time without motion after a release after which the object counts as resting where it was (s)


class _Device:
    """Camera, LED controller and clock of a twin as `ProvenFrames` uses them."""

    source = CAMERA

    def __init__(self, twin: Twin):
        self._twin = twin
        self.set, self.ping, self.sleep = twin.set, twin.ping, twin.step

    def async_read(self, timeout_ms: float | None = None) -> Captured:
        del timeout_ms  # a virtual frame always arrives
        exposure, image = self._twin.capture()
        image.flags.writeable = False
        time_s = self._twin.now_s
        self.ping()  # keeps the lights on, as the thread of `hardware.Leds` does
        return Captured(image, time_s, exposure.index)

    def monotonic(self) -> float:
        return self._twin.now_s

    def reconnect(self, *, limit_s: float) -> None:
        raise AssertionError("a virtual controller is never lost")


class VirtualSensor:
    """Reads pairs from a `Twin` on its virtual clock. `hardware.collect` accepts it in place of `hardware.STS`."""

    def __init__(self, twin: Twin, *, levels: Sequence[int] = (255, 255, 255, 255), settling: Settling | None = None):
        """Connect to a twin, and measure its settling times unless they are given. The scene must then be at rest.

        Args:
            twin: Twin that runs on a virtual clock.
            levels: Duty cycles of the four LED channels in the tactile stream, 0 to 255.
            settling: Settling times of an earlier measurement.
        """
        self.levels: protocol.Levels = checked_levels(levels)
        self._twin, device = twin, _Device(twin)
        limits = {"timeout_s": _TIMEOUT_S, "reconnect_s": _TIMEOUT_S}
        self._frames = ProvenFrames(device, device, levels=self.levels, exposures=None, clock=device, **limits)
        height, width, _ = twin.capture()[1].shape
        self.origin = Origin(CAMERA, twin.serial_number, width, height, self.levels)  # for `hardware.Session`
        if settling is not None:
            self._frames.see_both(settling)
        self.settling = self._frames.measure_settling(_SWITCHES, _WATCH_S) if settling is None else settling

    def read(self) -> Pair:
        """Take a visual and a tactile image, whose frames arrive after the start of this call."""
        return self._frames.pair(self._twin.now_s + _TIMEOUT_S)


class Hand(AutomaticPerson):
    """Replaces the person in `hardware.collect`: moves the object of a `Twin` and confirms every trajectory.

    If no contact is seen within 3 s, the hand tries the first pose of the next trajectory, and the number stays unused
    in the session. A trajectory has the same number in session and scene if the scene was made with
    `ObjectScene(first=hardware.next_recording(folder))`.
    """

    def __init__(self, twin: Twin, session: Session, *, patience_s: float = 60.0):
        """Prepare the hand, which waits for a new instruction for at most `patience_s` (s on the twin's clock)."""
        super().__init__()
        self._twin, self._session = twin, session
        self._patience_s = patience_s
        self._seen: Stage | None = None  # stage of the last view
        self._since_s = self._now_s = 0.0  # begin of that stage, and time of the last view (s)
        self._placed = False  # True if the object is on the pad
        self._held_s: float | None = None  # time since which the object is held without a problem of the session (s)
        self._unseen = 0  # held poses in a row without a visible contact

    def show(self, view: View) -> None:
        """Move the object as the newest instruction requires. Raises an error if the collection does not go on."""
        super().show(view)
        self._now_s = self._twin.now_s
        if view.stage is not self._seen or view.problem is not None:
            self._seen, self._since_s = view.stage, self._now_s
        if view.problem is not None and self._held_s is not None:
            self._held_s = self._now_s
        match view.stage:
            case Stage.CLEAR if self._placed:
                self._twin.command("clear")
                self._placed, self._held_s = False, None
            case Stage.PLACE:
                self._place()
            case Stage.RELEASE if self._held_s is not None:
                self._twin.command("release")
                self._held_s, self._unseen = None, 0
        if self._now_s - self._since_s > self._patience_s or self._unseen == _UNSEEN:
            raise ValueError(
                f"no progress after `{view.instruction}` for {self._now_s - self._since_s:.1f} s and {self._unseen} "
                f"held poses without visible contact (contact: {view.contact}, still: {view.still}): change GuideConfig"
            )

    def action(self) -> Action | None:
        """Confirm a trajectory that waits for its review, or a release after which nothing has moved for 3 s."""
        if self._seen is Stage.RELEASE and self._now_s - self._since_s > _UNMOVED_S:
            return Action.CONFIRM
        return super().action()

    def _place(self) -> None:
        """Hold the object in the next pose, unless the guide may still see the contact of the current one."""
        if self._held_s is None:
            self._placed, self._held_s = True, self._now_s
            self._twin.command("hold")
        elif self._now_s - self._held_s > _UNSEEN_S:
            self._held_s = self._now_s
            self._unseen += 1
            self._session.begin()
            self._twin.command("hold")
