"""Start a digital twin of the sensor, with its LED controller on a serial port and its camera on an HTTP server.

    python -m experiments.twin --port twin-leds                         # serial port with a fixed name
    python -m experiments.twin --resolution 1232 1640 --rate 5          # image size of the paper's camera

The command prints the addresses of the twin and runs until Ctrl-C. The first start compiles for about two minutes.
Later starts take about 20 s.
"""

import contextlib
import sys
import threading

import tyro

import sts_jax as sts
from experiments.shared import interrupts, terminal
from experiments.shared.device import TwinConfig, make_twin
from sts_jax.hardware import twin


def main(config: TwinConfig) -> None:
    """Let other programs use the twin until Ctrl-C, SIGTERM or, with `attached`, the end of the standard input."""
    print("preparing the first images ...", flush=True)
    with (
        make_twin(config) as device,
        twin.Served(device, link=config.port, host=config.host, http_port=config.http_port) as served,
        interrupts.in_order(),
    ):
        print(f"{served.description}\nCtrl-C ends it.", flush=True)
        if config.attached:
            sys.stdin.read()
        else:
            threading.Event().wait()


if __name__ == "__main__":
    sts.enable_compilation_cache()
    with terminal.on_one_line(), contextlib.suppress(KeyboardInterrupt):
        main(tyro.cli(TwinConfig, description=__doc__))
