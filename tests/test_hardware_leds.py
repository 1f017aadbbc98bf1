"""The LED controller: lines of the protocol, the host against faults on the line, and the firmware in a simulator."""

import concurrent.futures
import importlib.resources
import itertools
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import pytest
import serial
from led_simulator import Simulated, until, usb_port
from serial.tools import list_ports_common

from benchmarks.instruments.peers import Peer
from sts_jax import hardware
from sts_jax.hardware import protocol
from sts_jax.hardware.leds import checked_levels

ON = (255, 0, 128, 1)
PAGE = Path(__file__).parents[1] / "docs" / "hardware" / "protocol.md"
FIRMWARE = Path(str(importlib.resources.files("sts_jax"))) / "hardware" / "firmware"
REQUESTS = [
    protocol.Hello(1),
    protocol.Hello(65535, 65535),
    protocol.Set(65535, (255, 255, 255, 255)),
    protocol.Ping(10),
    protocol.Watch(12, 10_000),
]
REPLIES = [
    protocol.Controller(1, 1, "1.0.0", "atmega328p", "0123456789ABCDEF", 4),
    protocol.State(7, ON, 3, 0),
    protocol.State(65535, (255,) * 4, 2**32 - 1, 65535, 2**32 - 1),
    protocol.Watch(11, 100),
    protocol.Refused(5, protocol.Code.VERSION, "protocol 1"),
    protocol.TurnedOff(0, 12),
]


@pytest.fixture
def peer(tmp_path):
    peers = Peer(tmp_path / "port")
    yield peers
    peers.vanish()


def connect(path, **options):
    return hardware.Leds.connect(str(path), **({"timeout_s": 20.0, "answer_s": 20.0, "watchdog_ms": 10_000} | options))


# ---- Protocol


def bitwise_checksum(text):
    """CRC-16/CCITT-FALSE, bit by bit."""
    value = 0xFFFF
    for byte in text:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1) ^ (0x1021 if value & 0x8000 else 0)
        value &= 0xFFFF
    return value


def test_checksum_equals_the_published_value_and_a_bitwise_computation():
    assert protocol.checksum(b"123456789") == 0x29B1  # check value of CRC-16/CCITT-FALSE
    rng = random.Random(0)
    for text in map(rng.randbytes, range(60)):
        assert protocol.checksum(text) == bitwise_checksum(text)


LINES = {
    **{protocol.encode_request(x): (x, protocol.decode_request) for x in REQUESTS},
    **{protocol.encode_reply(x): (x, protocol.decode_reply) for x in REPLIES},
}


def test_messages_survive_the_line():
    for line, (message, decode) in LINES.items():
        assert decode(line) == message
        assert type(decode(line)) is type(message)


@pytest.mark.parametrize("line", LINES, ids=str)
def test_damaged_lines_are_rejected(line):
    """One or two neighbouring bits are flipped, bytes are swapped, or the line is cut, joined or extended."""
    rng = random.Random(0)
    flips = [width << bit for width, bit in itertools.product((1, 3), range(8 * len(line) - 1))]
    damaged = [(int.from_bytes(line) ^ flip).to_bytes(len(line)) for flip in flips]
    damaged += [line[:end] for end in range(len(line))] + [line[start:] for start in range(1, len(line))]
    damaged += [line + line, line[:-1] + line, line + b" ", b" " + line, line[:-1] + b"\r\n", line.lower()]
    for _ in range(200):
        i, j = sorted(rng.sample(range(len(line)), 2))
        damaged.append(line[:i] + line[j : j + 1] + line[i + 1 : j] + line[i : i + 1] + line[j + 1 :])
    for text in damaged:
        if text != line:
            with pytest.raises(protocol.ProtocolError):
                protocol.decode(text)


@pytest.mark.parametrize(
    ("code", "sequence", "texts"),
    [
        (protocol.Code.ARGUMENTS, 0, ["0 PING", "65536 PING", "01 PING", " 1 PING", "PING"]),
        (protocol.Code.COMMAND, 2, ["2", "2 ping", "2  PING"]),
        (protocol.Code.ARGUMENTS, 3, ["3 PING ", "3 PING 1", "3 WATCH 99", "3 WATCH 10001", "3 WATCH"]),
        (protocol.Code.ARGUMENTS, 4, [f"4 SET 1 2 3{end}" for end in ("", " 4 5", " 4 ", " 256", " -1", " +1", " 04")]),
        (protocol.Code.ARGUMENTS, 6, ["6 SET 1 2 3 4294967297", "6 HELLO", "6 HELLO x"]),
    ],
)
def test_bad_requests_name_the_line_and_the_error_code(code, sequence, texts):
    for text in texts:
        line = protocol.encode(text)
        with pytest.raises(protocol.ProtocolError, match=re.escape(repr(line))) as caught:
            protocol.decode_request(line)
        assert (caught.value.code, caught.value.sequence) == (code, sequence)


@pytest.mark.parametrize(
    "text",
    [
        "1 OK",
        *(f"1 OK SET 1 2 3 {end}" for end in ("4 5", "4 5 65536", "256 5 6")),
        *(f"1 OK PING 1 2 3 4 {end}" for end in ("5 6", "4294967296 6 7")),
        "1 OK WATCH 5",
        *(f"1 OK HELLO 1 1.0 {end}" for end in ("uno", "uno X 3", "uno X/Y 4")),
        "0 OK SET 1 2 3 4 5 6",
        *("1 ERR 9 text", "1 ERR 0 text", "1 ERR 1"),
        *("1 OFF watchdog 5", "0 OFF watchdog 0", "hello"),
    ],
)
def test_bad_replies_are_rejected(text):
    with pytest.raises(protocol.ProtocolError, match="not a reply"):
        protocol.decode_reply(protocol.encode(text))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: protocol.decode(protocol.encode("x" * 60)), "at most 64 bytes"),
        (lambda: protocol.decode(protocol.encode("1 PING*")), "must consist of a text"),
        (lambda: protocol.encode_request(protocol.Set(1, (0, 0, 0, 300))), "wrong number or range of arguments"),
        (lambda: checked_levels((1, 2, 3)), "levels must be 4 integers"),
        (lambda: checked_levels((0, 0, 0, 256)), "levels must be 4 integers"),
        (lambda: checked_levels((0, 0, 0, -1)), "levels must be 4 integers"),
    ],
)
def test_bad_values_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_the_emulated_controller_gives_the_answers_of_the_page():
    exchanges = re.findall(r"```text\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len(exchanges) >= 3
    for exchange in exchanges:
        device = protocol.EmulatedController(boot=17, serial_number="1A2B3C4D")
        now, answers = 0.0, []
        for direction, text in re.findall(r"^([<>]) (.*)$", exchange, re.MULTILINE):
            if direction == ">":
                assert not answers, text
                now += 0.25
                answers = device.receive(text.encode() + b"\n", now)
            else:
                now += 0 if answers else 60
                answer, _, answers = (answers or device.tick(now)).decode().partition("\n")
                names = r"1\.0\.0 atmega328p|emulated emulation"  # firmware and board
                assert re.sub(names + r"|\*.*", "", answer) == re.sub(names + r"|\*.*", "", text)
                protocol.decode_reply(text.encode() + b"\n")
                answers = answers.encode()
        assert not answers


# ---- Host


FAULTS = ["deaf", "damaged", "lost", "late", "doubled", "garbled", "cut", "joined", "noise", "watchdog", "stale"]


@pytest.mark.parametrize("first", FAULTS)
def test_each_request_is_executed_once_whatever_happens_to_its_answer(peer, first, monkeypatch):
    monkeypatch.setattr("sts_jax.hardware.leds.REPEAT_S", 0.03)
    with connect(peer.path) as leds:
        for i, second in enumerate([*FAULTS, "none"]):
            levels = (1 + i, 2, 3, 4)
            counter = peer.controller.counter
            peer.faults = [first, second]
            lit = leds.set(levels)
            assert (lit.levels, lit.counter) == (levels, counter + 1)
            assert peer.controller.counter == counter + 1
            peer.faults = []
            assert leds.ping().unchanged_since(lit)


def test_a_silent_controller_gives_a_timeout_and_works_again_later(peer):
    with connect(peer.path, answer_s=0.3) as leds:
        peer.faults = ["deaf"] * 100
        with pytest.raises(hardware.LedTimeoutError, match=r"no valid answer to .* SET 255 .*within 0\.3 s.*Nothing"):
            leds.set(ON)
        peer.faults.clear()
        leds._answer_s = 20.0
        assert leds.set(ON).levels == ON


def test_a_write_that_pyserial_calls_late_is_no_error(peer, monkeypatch):
    write = serial.Serial.write

    def late(self, data):  # pyserial behaves so if the process is suspended between the system call and the clock
        write(self, data)
        raise serial.SerialTimeoutException("Write timeout")

    with connect(peer.path) as leds:
        monkeypatch.setattr(serial.Serial, "write", late)
        assert leds.set(ON).levels == ON


def test_threads_share_a_controller(peer):
    with connect(peer.path, watchdog_ms=100) as leds, concurrent.futures.ThreadPoolExecutor(4) as pool:
        levels = [(number % 4, number, 0, 1) for number in range(80)]
        assert [lit.levels for lit in pool.map(leds.set, levels)] == levels
        assert leds.ping().counter == 80


def test_a_controller_that_restarts_gets_the_watchdog_period_again(peer):
    with connect(peer.path, watchdog_ms=5000) as leds:
        lit = leds.set(ON)
        peer.controller = protocol.EmulatedController(boot=2, now_s=peer.controller._valid_s)
        now = leds.ping()
        assert now.levels == protocol.DARK
        assert not now.unchanged_since(lit)
        assert peer.controller.watch_ms == 5000


def test_a_vanished_port_is_named_and_found_again(peer, tmp_path):
    leds = connect(peer.path)
    leds.set(ON)
    peer.faults = ["vanish"]
    with pytest.raises(hardware.DisconnectedError, match=r"port is gone.*reconnect\(\)"):
        leds.set(ON)
    with pytest.raises(hardware.DisconnectedError, match=r"EMULATED was not found.*Ports tried: .*port.*took 0\.2 s"):
        leds.reconnect(limit_s=0.2)
    returned = Peer(tmp_path / "port")
    leds.reconnect(limit_s=60.0)
    assert leds.set(ON).levels == ON == returned.controller.levels
    leds.close()
    assert returned.controller.levels == protocol.DARK
    returned.vanish()


def test_a_controller_is_found_under_another_name(tmp_path, monkeypatch):
    other, mine = Peer(tmp_path / "other", serial_number="OTHER"), Peer(tmp_path / "mine", serial_number="MINE")
    ports = [usb_port(other.path, "77"), usb_port(mine.path, "55")]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: ports)
    leds = connect(mine.path)
    mine.vanish()
    back = Peer(tmp_path / "new", serial_number="MINE")
    ports[:] = [usb_port(other.path, None), usb_port(back.path, "99")]
    leds.reconnect(limit_s=60.0)
    assert leds.port == str(back.path)
    assert leds.set(ON).levels == back.controller.levels
    leds.close()
    other.vanish()
    back.vanish()


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (2, r"cannot open /dev/ttyACM0: .*No such file.* Ports found: /dev/ttyACM0 \(Arduino Uno\), /dev/ttyS0"),
        (13, "usermod -aG dialout"),
        (11, "it is in use: close the other program"),
    ],
)
def test_a_port_that_cannot_be_opened_is_named(monkeypatch, number, message):
    plain = list_ports_common.ListPortInfo("/dev/ttyS0")
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [plain, usb_port("/dev/ttyACM0", "55")])
    error = serial.SerialException(number, os.strerror(number))
    monkeypatch.setattr(serial, "serial_for_url", mock.Mock(side_effect=error))
    with pytest.raises(hardware.LedError, match=message):
        connect("/dev/ttyACM0")


@pytest.mark.parametrize(
    ("talk", "message"),
    [
        (b"", "Nothing was received"),
        (b"$GPGGA,092750.000,5321.6802,N*76\r\n", r"Received b'\$GPGGA.*another device"),
        (protocol.encode("1 OK SET 0 0 0 0 0 0"), "no valid answer"),
        (protocol.encode("0 ERR 1 checksum"), "no valid answer"),
        (b"\x00" * 4000, "another device"),
    ],
    ids=["silence", "text", "answers to nobody", "refusals of nothing", "flood"],
)
def test_another_device_is_described(tmp_path, talk, message):
    other = Peer(tmp_path / "port", talk=talk)
    with pytest.raises(hardware.LedError, match=message):
        connect(other.path, timeout_s=0.4)
    other.vanish()


def test_another_version_of_the_protocol_is_named(peer, monkeypatch):
    def newer(line, now_s):
        return protocol.encode(line.decode().split(" ")[0] + " OK HELLO 2 2.0 more")

    monkeypatch.setattr(peer.controller, "receive", newer)
    with pytest.raises(hardware.LedError, match=r"version 2 of the protocol instead of 1\. Flash"):
        connect(peer.path)


def test_two_programs_cannot_share_a_port(peer):
    with connect(peer.path), pytest.raises(serial.SerialException, match="exclusively lock"):
        serial.Serial(str(peer.path), exclusive=True)
    with serial.Serial(str(peer.path), exclusive=True), pytest.raises(hardware.LedError, match="in use: close the"):
        connect(peer.path)


# ---- Firmware


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The simulator's program, the firmware with a serial number, and the firmware without."""
    for program in ("avr-gcc", "avr-objcopy", "make", "gcc"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is missing: apt-get install gcc-avr avr-libc make gcc libsimavr-dev")
    folder = tmp_path_factory.mktemp("firmware")
    program = folder / "avr_uart_pty"
    source = Path(__file__).with_name("avr_uart_pty.c")
    if subprocess.run(
        ["gcc", "-include", "simavr/sim_avr.h", "-E", "-x", "c", os.devnull], capture_output=True
    ).returncode:
        pytest.skip("simavr's headers are missing: apt-get install libsimavr-dev")
    subprocess.run(["gcc", "-O2", "-Wall", "-I/usr/include/simavr", "-o", program, source, "-lsimavr"], check=True)
    for name in ("SIM-1", ""):
        build = f"BUILD={folder / (name or 'random')}"
        subprocess.run(["make", "--silent", "-C", FIRMWARE, build, f"SERIAL={name}"], check=True)
    return program, folder / "SIM-1" / "leds.hex", folder / "random" / "leds.hex"


class Emulated(Peer):
    """The emulated controller in real time, with the methods of `Simulated`."""

    def wait_for(self, levels):
        until(lambda: self.controller.levels == levels)

    def command(self, letter):
        self.restart()


@pytest.fixture(params=["emulation", pytest.param("chip", marks=pytest.mark.slow)])
def controller(request, tmp_path):
    """A controller on a serial line: the emulation, or the firmware in the simulator of its chip."""
    if request.param == "chip":
        chip = Simulated(*request.getfixturevalue("built")[:2])
        yield chip
        chip.stop()
    else:
        emulated = Emulated(tmp_path / "port", clock=time.monotonic, serial_number="SIM-1")
        yield emulated
        emulated.vanish()


def test_lights_are_set_and_acknowledged(controller):
    with connect(controller.path) as leds:
        assert (leds.serial_number, leds.controller.version, leds.controller.channels) == ("SIM-1", 1, 4)
        for levels in (ON, (1, 2, 3, 4), (255,) * 4, protocol.DARK, (0, 0, 0, 255), [0, 7, 0, 0]):
            before = time.monotonic()
            lit = leds.set(levels)
            controller.wait_for(tuple(levels))
            assert before <= lit.sent_s <= lit.acknowledged_s <= time.monotonic()
            assert leds.ping().unchanged_since(lit)
        assert leds.set(ON).counter == lit.counter + 1
        assert not leds.set([0, 7, 0, 0]).unchanged_since(lit)  # the same levels, after two changes
    controller.wait_for(protocol.DARK)
    leds.close()
    with pytest.raises(hardware.DisconnectedError, match="gone or closed"):
        leds.set(ON)


def test_requests_keep_the_lights_on_and_the_watchdog_turns_them_off_without(controller):
    with connect(controller.path, watchdog_ms=2000) as leds:
        lit = leds.set(ON)
        time.sleep(2.2)
        assert leds.ping().unchanged_since(lit)
        leds._connection.stopped.set()  # no more requests
        leds._thread.join()
        controller.wait_for(ON)
        controller.wait_for(protocol.DARK)
        now = leds.ping()
        assert (now.levels, now.counter, now.boot) == (protocol.DARK, lit.counter + 1, lit.boot)
        leds._stop()


HOST = """
import sys
from sts_jax.hardware import Leds
leds = Leds.connect(sys.argv[1], timeout_s=20.0, answer_s=20.0)
print(leds.set((9, 9, 9, 9)).levels, flush=True)
sys.stdin.read()
"""


def test_lights_go_off_when_the_host_is_killed(controller):
    arguments = [sys.executable, "-c", HOST, str(controller.path)]
    host = subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert host.stdout.readline() == b"(9, 9, 9, 9)\n"
    controller.wait_for((9, 9, 9, 9))
    host.send_signal(signal.SIGKILL)
    host.communicate()
    controller.wait_for(protocol.DARK)


@pytest.mark.parametrize("letter", ["r", "s"], ids=["reset", "clock stops"])
def test_a_restart_turns_the_lights_off_and_counts_as_a_boot(controller, letter):
    with connect(controller.path) as leds:
        lit = leds.set(ON)
        controller.wait_for(ON)
        controller.command(letter)
        controller.wait_for(protocol.DARK)
        now = leds.ping()
        assert (now.levels, now.boot) == (protocol.DARK, (lit.boot + 1) % 2**16)
        assert not now.unchanged_since(lit)


@pytest.mark.slow
def test_firmware_draws_its_serial_number_once(built):
    chip = Simulated(built[0], built[2])
    with connect(chip.path) as leds:
        number, boot = leds.serial_number, leds.ping().boot
        assert re.fullmatch("[0-9A-F]{8}", number)
    chip.command("r")
    with connect(chip.path) as leds:
        assert (leds.serial_number, leds.ping().boot) == (number, boot + 1)
    chip.stop()


def exchanged(port, line):
    """The answer to a line. The newline of the boot is skipped."""
    port.write(line)
    while (answer := port.readline()) == b"\n":
        pass
    return answer


def booted(path):
    """The port of a simulated controller that has booted, with its watchdog at 10 s."""
    port = serial.Serial(path, timeout=0.2, exclusive=True)
    until(lambda: b" OK WATCH " in exchanged(port, protocol.encode("1 WATCH 10000")))
    port.timeout = 0.5
    while port.readline():  # answers to requests that were repeated during the boot
        pass
    port.timeout = 20.0
    return port


def test_a_repeated_request_is_answered_alike_and_not_executed_again(controller):
    with booted(str(controller.path)) as port:
        ping, on = protocol.encode("2 PING"), protocol.encode("4 SET 9 9 9 9")
        first = exchanged(port, ping)
        time.sleep(0.05)
        assert exchanged(port, ping) == first
        assert exchanged(port, protocol.encode("3 PING")).split()[-1] != first.split()[-1]  # the time went on
        exchanged(port, protocol.encode("3 WATCH 100"))
        answer = exchanged(port, on)
        controller.wait_for((9, 9, 9, 9))
        assert port.readline() == protocol.encode("0 OFF watchdog 2")
        controller.wait_for(protocol.DARK)
        assert exchanged(port, on) == answer
        state = protocol.decode_reply(exchanged(port, protocol.encode("5 PING")))
        assert (state.levels, state.counter) == (protocol.DARK, 2)


WORDS = " HELLO SET PING WATCH 1 2 0 00 255 256 9999 10000 10001 x -1"


def random_lines(rng, number):
    """Valid, damaged, malformed and repeated lines."""
    words = WORDS.split(" ")
    lines = []
    for _ in range(number):
        sequence = rng.choice(["0", "65536", "x", *(str(rng.randint(1, 65535)) for _ in range(9))])
        match rng.randrange(6):
            case 0 | 1:
                text = f"{sequence} SET " + " ".join(str(rng.choice([0, 1, 255, rng.randrange(256)])) for _ in range(4))
            case 2:
                text = f"{sequence} PING"
            case _:
                text = " ".join([sequence, *rng.choices(words, k=rng.randrange(8))])
        line = protocol.encode(text[:58])
        match rng.randrange(8):
            case 0:
                line = rng.choice(lines or [line])
            case 1:
                place = rng.randrange(len(line) - 1)
                line = line[:place] + rng.choice([b"*", b"\0", b"\xff", b"q", b""]) + line[place + 1 :]
            case 2:
                line = b"y" * rng.randrange(50, 200) + line
        lines += [line] * rng.choice([1, 1, 1, 2])
    return lines


@pytest.mark.slow
def test_firmware_and_emulation_answer_alike(built):
    """The texts of HELLO and the time since the boot differ, and everything else is the same."""
    chip = Simulated(*built[:2])
    with booted(chip.path) as port:
        state = protocol.decode_reply(exchanged(port, protocol.encode("2 PING")))
        device = protocol.EmulatedController(boot=state.boot)
        device.receive(protocol.encode("1 WATCH 10000"), 0.0)
        device.receive(protocol.encode("2 PING"), 0.0)
        rng = random.Random(5)
        lines = [line for line in random_lines(rng, 400) if line.strip(b"\n") and b"WATCH 9999" not in line]
        for line in lines:
            assert comparable(exchanged(port, line)) == comparable(device.receive(line, 0.0)), line
        assert device.counter > 50
    chip.stop()


def comparable(line):
    reply = protocol.decode_reply(line)
    if isinstance(reply, protocol.Controller):
        return reply.sequence, reply.version, reply.channels
    if isinstance(reply, protocol.State) and reply.uptime_ms is not None:
        return reply.sequence, reply.levels, reply.counter, reply.boot
    return line
