"""Ctrl-C ends a command with one line: while it is imported, in compiled code and where exceptions are lost."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.shared import interrupts, terminal

ROOT = str(Path(interrupts.__file__).parents[2])

BEGIN = """
import time
from experiments.shared import interrupts
interrupts.end_at_once()
print("ready", flush=True)
"""
IN_COMPILED_CODE = "import hashlib\nhashlib.pbkdf2_hmac('sha256', b'', b'', 2**30)"
WHERE_EXCEPTIONS_ARE_LOST = """
import gc
def _xla_gc_callback(*_):
    time.sleep(0.02)
gc.callbacks.append(_xla_gc_callback)
while True:
    gc.collect()
    time.sleep(0.02)
"""
IN_ORDER = (
    """
with interrupts.in_order():
    try:
"""
    + "".join(f"        {line}\n" for line in WHERE_EXCEPTIONS_ARE_LOST.splitlines())
    + """
    finally:
        print("closed", flush=True)
"""
)


@contextlib.contextmanager
def started(*words):
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a test may run in the background of a shell
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, *words], env={**os.environ, "PYTHONPATH": ROOT}, **pipes) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("place", [IN_COMPILED_CODE, WHERE_EXCEPTIONS_ARE_LOST])
def test_ctrl_c_ends_a_command_in_compiled_code_and_where_exceptions_are_lost(place):
    with started("-c", BEGIN + place) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=60) == ("", interrupts.LINE + "\n")
    assert process.returncode == interrupts.CODE == 130


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_devices_are_closed_in_order(number):
    with started("-c", BEGIN + IN_ORDER) as process:
        assert process.stdout.readline() == "ready\n"
        time.sleep(0.2)
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
    assert out == "closed\n"
    assert err.endswith("KeyboardInterrupt\n")  # which `terminal.on_one_line` catches


@pytest.mark.parametrize("wait_s", [0.5, 1.5])
def test_ctrl_c_ends_a_command_while_it_is_imported(wait_s):
    with started("-m", "experiments.freefall", "--help") as process:
        time.sleep(wait_s)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert process.returncode in (0, 130)  # a fast machine has printed the help
    assert err == (interrupts.LINE + "\n") * (process.returncode == 130)


def test_an_interrupt_elsewhere_is_one_line(capsys):
    with pytest.raises(SystemExit) as ended, terminal.on_one_line():
        raise KeyboardInterrupt
    assert ended.value.code == 130
    assert capsys.readouterr().err == interrupts.LINE + "\n"
