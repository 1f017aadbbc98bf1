"""`VirtualSensor`: pairs of images of a twin on its virtual clock, each proven to be of one light."""

import numpy as np

from sts_jax.hardware import protocol
from sts_jax.hardware.leds import Lit
from sts_jax.hardware.session import Origin
from sts_jax.hardware.settling import Settling, Switch, settling, thumbnail
from sts_jax.hardware.shots import LightError, Pair, Shot, Stream
from sts_jax.hardware.sts import checked_levels
from sts_jax.hardware.twin.device import Twin

CAMERA = "twin"  # name of the camera in sessions and sensor files
_SWITCHES = 8  # of each direction, to measure the settling
_WATCH_S = 1.0  # s, longest time after a switch in which the light changes
_PHASE = 0.618  # of a period, by which the phase of the measured switches advances
_ATTEMPTS = 10  # images of one stream, of which the controller proves none


class VirtualSensor:
    """A twin on the virtual clock, read as `hardware.STS` is. `hardware.collect` takes it.

    ```python
    with Twin(ObjectScene(body)) as twin:
        sensor = VirtualSensor(twin)
        pair = sensor.read()
    ```

    As with `STS`, a frame counts as of one light if it arrives later than the settling time after the controller's
    acknowledgement, and if the controller's next answer proves that its lights have not changed in between. The
    settling time is measured from frames. Nobody waits for frames that arrive earlier, so the twin does not make them.
    Faults of the camera are not looked for.
    """

    def __init__(
        self,
        twin: Twin,
        *,
        levels: protocol.Levels = (255, 255, 255, 255),
        settling: Settling | None = None,
    ):
        """Measure the settling times unless they are given.

        Args:
            twin: On the virtual clock, with a scene at rest.
            levels: Duty cycles of the four channels in the tactile stream, 0 to 255. All are 0 in the visual stream.
            settling: From an earlier measurement.

        Raises:
            ValueError: A level is out of range or all are 0.
            NoContrastError: The lights do not change the image.
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
        """The settling times that are in use."""
        return self._settling

    @property
    def levels(self) -> protocol.Levels:
        """Duty cycles of the channels in the tactile stream, 0 to 255."""
        return self._levels

    @property
    def origin(self) -> Origin:
        """The origin of a session."""
        return Origin(CAMERA, self._twin.serial_number, *self._size, self._levels)

    def read(self) -> Pair:
        """Take an image of each stream, as `STS.read`.

        Raises:
            LightError: The lights do not stay on, so no image could be proven to be of one light.
        """
        first = self._stream
        one = self._shot(first)
        two = self._shot("tactile" if first == "visual" else "visual")
        return Pair(one, two) if first == "visual" else Pair(two, one)

    def _shot(self, stream: Stream) -> Shot:
        """An image of one stream that is exposed after the call."""
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
            f"no image of the {stream} stream could be proven to be of one light: lower the settling time of "
            f"{settled_s:g} s, because the controller turns its lights off without a request for a second"
        )

    def _set(self, stream: Stream) -> Lit:
        self._lit = self._twin.set(self._levels if stream == "tactile" else protocol.DARK)
        self._stream = stream
        return self._lit

    def _measured(self) -> Settling:
        """The settling times, from frames after switches at several phases of the exposure."""
        period_s = 1 / self._twin.rate
        on: list[Switch] = []
        off: list[Switch] = []
        for number in range(_SWITCHES):
            phase_s = period_s * (_PHASE * number % 1)  # a watch ends just after a frame
            self._twin.step(phase_s)
            on.append(self._watched("tactile"))
            self._twin.step(phase_s)
            off.append(self._watched("visual"))
        return settling(on, off, period_s)

    def _watched(self, stream: Stream) -> Switch:
        """Switch the lights and collect the frames that arrive afterwards, with thumbnails."""
        lit = self._set(stream)
        delays: list[float] = []
        looks: list[np.ndarray] = []
        while not delays or delays[-1] < _WATCH_S:
            _, image = self._twin.capture()
            self._twin.ping()  # for the watchdog
            delays.append(self._twin.now_s - lit.acknowledged_s)
            looks.append(thumbnail(image))
        return Switch(np.array(delays, np.float32), np.array(looks, np.float32))
