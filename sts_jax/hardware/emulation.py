"""The LED controller's behaviour without a board: lines in, lines out, on a clock that the caller chooses.

The tests compare it with the firmware, which runs in a simulator of its chip.
"""

from sts_jax.hardware import protocol

_TEXTS = {
    protocol.Code.CHECKSUM: "checksum",
    protocol.Code.COMMAND: "command",
    protocol.Code.ARGUMENTS: "arguments",
    protocol.Code.VERSION: f"protocol {protocol.VERSION}",
    protocol.Code.LENGTH: "length",
}


class EmulatedController:
    """A controller of the protocol. It is neither thread-safe nor connected to a port."""

    def __init__(self, *, now_s: float = 0.0, boot: int = 1, serial_number: str = "EMULATED"):
        """Boot with all lights off.

        Args:
            now_s: Time of the boot (s), on the clock of all later calls.
            boot: Number of the boot, 0 to 65535. A real controller counts its boots.
            serial_number: At most 16 letters, digits, dots, hyphens and underscores.
        """
        self.levels = protocol.DARK
        self.counter = 0
        self.boot = boot
        self.watch_ms = protocol.DEFAULT_WATCH_MS
        self._serial_number = serial_number
        self._boot_s = self._valid_s = now_s
        self._pending = b""
        self._answered: tuple[bytes, bytes] | None = None  # the last request that was executed, and its answer

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Take bytes of the host.

        Args:
            data: Any number of bytes. An incomplete line is kept until its rest comes.
            now_s: Current time (s).

        Returns:
            The lines that the controller sends, or no bytes.
        """
        sent = self.tick(now_s)
        *lines, self._pending = (self._pending + data).split(b"\n")
        self._pending = self._pending[: protocol.LONGEST_LINE]  # enough to see that the line is too long
        return sent + b"".join(self._answer(line + b"\n", now_s) for line in lines if line)

    def tick(self, now_s: float) -> bytes:
        """Let time pass. Returns the line of the watchdog if it turned the lights off, or no bytes."""
        if self.levels == protocol.DARK or now_s - self._valid_s < self.watch_ms / 1000:
            return b""
        self._apply(protocol.DARK)
        return protocol.encode_reply(protocol.TurnedOff(self.counter))

    def _answer(self, line: bytes, now_s: float) -> bytes:
        if self._answered is not None and line == self._answered[0]:
            self._valid_s = now_s
            return self._answered[1]
        try:
            reply = protocol.encode_reply(self._execute(protocol.decode_request(line), now_s))
        except protocol.ProtocolError as error:
            return protocol.encode_reply(protocol.Refused(error.sequence, error.code, _TEXTS[error.code]))
        self._valid_s = now_s
        self._answered = line, reply
        return reply

    def _execute(self, request: protocol.Request, now_s: float) -> protocol.Reply:
        match request:
            case protocol.Hello(sequence, version):
                if version != protocol.VERSION:
                    raise protocol.ProtocolError(f"version {version}", protocol.Code.VERSION, sequence)
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
                return protocol.Watching(sequence, period_ms)

    def _apply(self, levels: protocol.Levels) -> None:
        if levels != self.levels:
            self.levels = levels
            self.counter += 1
