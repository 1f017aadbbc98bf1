"""A software emulation of the LED controller, for places without hardware. Tests compare it with the real firmware."""

from sts_jax.hardware import protocol


class EmulatedController:
    """An emulated LED controller without a clock: each call passes the current time. Not thread-safe."""

    def __init__(self, *, now_s: float = 0.0, boot: int = 1, serial_number: str = "EMULATED"):
        """Boot the controller with all lights off.

        Args:
            now_s: Time of the boot, on the same clock as in all later calls (s).
            boot: Number of the boot, 0 to 65535. A real controller counts its boots.
            serial_number: Serial number of the controller, at most 16 letters, digits, dots, hyphens and underscores.
        """
        self.levels = protocol.DARK  # levels that are applied now
        self.counter = 0  # number of changes of the levels since the boot
        self.boot = boot
        self.watch_ms = protocol.DEFAULT_WATCH_MS  # period of the watchdog (ms)
        self._serial_number = serial_number
        self._boot_s = self._valid_s = now_s  # times of the boot and of the last valid request (s)
        self._pending = b""  # bytes of an incomplete line
        self._answered: tuple[bytes, bytes] | None = None  # the last request that was executed, and its answer

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Process any number of bytes from the host, and return the lines that the controller sends."""
        sent = self.tick(now_s)
        *lines, self._pending = (self._pending + data).split(b"\n")
        self._pending = self._pending[: protocol.LONGEST_LINE]  # enough to see that the line is too long
        return sent + b"".join(self._answer(line + b"\n", now_s) for line in lines if line)

    def tick(self, now_s: float) -> bytes:
        """Turn the lights off if the watchdog's period has passed, and return the line that reports it."""
        if self.levels == protocol.DARK or now_s - self._valid_s < self.watch_ms / 1000:
            return b""
        self._apply(protocol.DARK)
        return protocol.encode_reply(protocol.TurnedOff(0, self.counter))

    def _answer(self, line: bytes, now_s: float) -> bytes:
        """The reply to one line. A repeated line gets the same reply again and is not executed."""
        if self._answered is not None and line == self._answered[0]:
            self._valid_s = now_s
            return self._answered[1]
        try:
            reply = protocol.encode_reply(self._execute(protocol.decode_request(line), now_s))
        except protocol.ProtocolError as error:
            text = f"protocol {protocol.VERSION}" if error.code is protocol.Code.VERSION else error.code.name.lower()
            return protocol.encode_reply(protocol.Refused(error.sequence, error.code, text))
        self._valid_s = now_s
        self._answered = line, reply
        return reply

    def _execute(self, request: protocol.Request, now_s: float) -> protocol.Reply:
        match request:
            case protocol.Hello(sequence, version):
                if version != protocol.VERSION:
                    raise protocol.ProtocolError(f"unknown version {version}", protocol.Code.VERSION, sequence)
                names = "emulated", "emulation", self._serial_number
                return protocol.Controller(sequence, protocol.VERSION, *names, channels=protocol.CHANNELS)
            case protocol.Set(sequence, levels):
                self._apply(levels)
                return protocol.State(sequence, self.levels, self.counter, self.boot)
            case protocol.Ping(sequence):
                uptime_ms = int(1000 * (now_s - self._boot_s)) % 2**32
                return protocol.State(sequence, self.levels, self.counter, self.boot, uptime_ms)
            case protocol.Watch(sequence, period_ms):
                self.watch_ms = period_ms
                return request

    def _apply(self, levels: protocol.Levels) -> None:
        if levels != self.levels:
            self.levels = levels
            self.counter += 1
