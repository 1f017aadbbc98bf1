"""`VirtualSensor`: reads visual and tactile images from a `Twin` (a simulated sensor) on a virtual clock."""

import numpy as np

from sts_jax.hardware import protocol
from sts_jax.hardware.collecting import Action, AutomaticPerson, View
from sts_jax.hardware.guide import Stage
from sts_jax.hardware.leds import Lit
from sts_jax.hardware.proof import LightError, Pair, Settling, Shot, Stream, Switch, settling, thumbnail
from sts_jax.hardware.session import Origin, Session
from sts_jax.hardware.sts import checked_levels
from sts_jax.hardware.twin.device import Twin

CAMERA = "twin"  # name of the camera in sessions and sensor files
_SWITCHES = 8  # number of switches in each direction from which the settling times are measured
_UNSEEN_S = 3.0  # time without a visible contact after which the next held pose is tried (s)
_UNSEEN = 10  # held poses in a row without a visible contact after which the hand gives up
_UNMOVED_S = 3.0  # time without motion after a release after which the object counts as resting where it was (s)
_WATCH_S = 1.0  # time after a switch during which frames are watched (s). The light must not change after it
# Share of the frame period by which the start of each measured switch advances, so that the switches sample the whole
# period. It is the golden ratio, whose multiples are spread evenly.
_PHASE = 0.618
_ATTEMPTS = 10  # images of one stream without a proof of their light after which an error is raised


class VirtualSensor:
    """Reads pairs of visual and tactile images from a `Twin` (a simulated sensor) that runs on a virtual clock.

    `hardware.collect` accepts a `VirtualSensor` in place of `hardware.STS`.

    ```python
    body = sts_jax.objects.make(jax.random.key(0), "bottle")
    with Twin(ObjectScene(body)) as twin:
        sensor = VirtualSensor(twin)
        pair = sensor.read()
    ```

    Each image is exposed under one constant light, as with `STS`. To ensure this, `read` waits for the settling time
    after each switch of the lights. The settling time begins when the LED controller confirms the switch. Frames that
    arrive after the settling time show only the new light. `read` takes one of these frames, and asks the
    controller if the lights have changed since the switch. If they have changed, `read` switches the lights again and
    takes another frame. Frames that arrive during the settling time are not rendered. Faults of the camera are not
    detected.
    """

    def __init__(
        self,
        twin: Twin,
        *,
        levels: protocol.Levels = (255, 255, 255, 255),
        settling: Settling | None = None,
    ):
        """Connect to a twin, and measure its settling times unless they are given.

        Args:
            twin: Twin that runs on a virtual clock. The scene must be at rest if the settling times are measured.
            levels: Duty cycles of the four LED channels in the tactile stream, 0 to 255. At least one level must be
                above 0. In the visual stream, all LEDs are off.
            settling: Settling times of an earlier measurement. Default: they are measured now.

        Raises:
            ValueError: A level is out of range, or all levels are 0.
            LightError: The lights do not change the image.
            RuntimeError: The twin runs on the real clock.
        """
        self._twin = twin
        self._levels = checked_levels(levels)
        self._stream: Stream = "visual"
        self._lit: Lit | None = None  # the controller's answer to the last switch
        _, image = twin.capture()
        self._size = image.shape[1], image.shape[0]
        self._settling = self._measured() if settling is None else settling

    @property
    def settling(self) -> Settling:
        """The times (s) for which `read` waits: `visual_s` after the lights go off, `tactile_s` after they go on."""
        return self._settling

    @property
    def levels(self) -> protocol.Levels:
        """Duty cycles of the four LED channels in the tactile stream, 0 (off) to 255 (always on)."""
        return self._levels

    @property
    def origin(self) -> Origin:
        """Description of this sensor for `hardware.Session`: the devices, the image size and the LED levels."""
        return Origin(CAMERA, self._twin.serial_number, *self._size, self._levels)

    def read(self) -> Pair:
        """Take a visual and a tactile image. Both are frames that arrive after this method was called.

        Returns:
            The visual and the tactile image.

        Raises:
            LightError: The LED controller did not confirm in any of ten attempts that the lights stayed constant.
        """
        first = self._stream
        one = self._shot(first)
        two = self._shot("tactile" if first == "visual" else "visual")
        return Pair(one, two) if first == "visual" else Pair(two, one)

    def _shot(self, stream: Stream) -> Shot:
        """Take an image of one stream that arrives after the call, see `read`."""
        settled_s = self._settling.visual_s if stream == "visual" else self._settling.tactile_s
        for _ in range(_ATTEMPTS):
            if self._lit is None or self._stream != stream:
                self._set(stream)
            before = self._lit
            assert before is not None
            self._twin.step(max(0.0, before.acknowledged_s + settled_s - self._twin.now_s))
            exposure, image = self._twin.capture()
            time_s = self._twin.now_s
            after = self._twin.ping()
            if after.unchanged_since(before):
                image.flags.writeable = False
                return Shot(image, stream, time_s, exposure.index, 0, before, after.sent_s)
            self._lit = None
        raise LightError(
            f"the lights changed in each of {_ATTEMPTS} attempts to take a {stream} image. The settling time is "
            f"{settled_s:g} s, but the LED controller turns its lights off after 1 s without a request: give "
            "`VirtualSensor` settling times below 1 s (argument `settling`)"
        )

    def _set(self, stream: Stream) -> Lit:
        """Set the levels of a stream, and remember the controller's answer."""
        self._lit = self._twin.set(self._levels if stream == "tactile" else protocol.DARK)
        self._stream = stream
        return self._lit

    def _measured(self) -> Settling:
        """Measure the settling times from the frames after switches at several phases of the exposure."""
        period_s = 1 / self._twin.rate
        on: list[Switch] = []
        off: list[Switch] = []
        for number in range(_SWITCHES):
            phase_s = period_s * (_PHASE * number % 1)  # counted from a frame, because `_watched` ends at one
            self._twin.step(phase_s)
            on.append(self._watched("tactile"))
            self._twin.step(phase_s)
            off.append(self._watched("visual"))
        return settling(on, off, period_s)

    def _watched(self, stream: Stream) -> Switch:
        """Switch the lights, and collect thumbnails of the frames that arrive in the second afterwards."""
        lit = self._set(stream)
        delays: list[float] = []
        looks: list[np.ndarray] = []
        while not delays or delays[-1] < _WATCH_S:
            _, image = self._twin.capture()
            self._twin.ping()  # so that the watchdog leaves the lights on
            delays.append(self._twin.now_s - lit.acknowledged_s)
            looks.append(thumbnail(image))
        return Switch(np.array(delays, np.float32), np.array(looks, np.float32))


class Hand(AutomaticPerson):
    """Replaces the person in `hardware.collect`: moves the object of a `Twin` and confirms every trajectory.

    If no contact is seen within 3 s, the hand tries the first pose of the next trajectory, and the number stays unused
    in the session. A trajectory has the same number in session and scene if the scene was made with
    `ObjectScene(first=hardware.next_recording(folder))`.
    """

    def __init__(self, twin: Twin, session: Session, *, patience_s: float = 60.0):
        """Prepare the hand.

        Args:
            twin: Twin whose object the hand moves.
            session: Session that receives the trajectories.
            patience_s: Longest time without a new instruction, > 0 (s on the twin's clock).
        """
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
        entered, self._seen = view.stage is not self._seen, view.stage
        self._now_s = self._twin.now_s
        if entered or view.problem is not None:
            self._since_s = self._now_s
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
                f"hardware.collect has shown `{view.instruction}` for {self._now_s - self._since_s:.1f} s (contact: "
                f"{view.contact}, still: {view.still}), and {self._unseen} held poses in a row had no visible contact: "
                f"change its config (GuideConfig), or increase patience_s ({self._patience_s:g} s)"
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
