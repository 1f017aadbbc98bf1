"""Collect trajectories of the real sensor, and review them.

    python -m experiments.real collect --camera /dev/v4l/by-id/... --leds /dev/ttyACM0    # opens a page for the browser
    python -m experiments.real collect --sensor runs/commission/sensor.json --leds /dev/ttyACM0 --count 500
    python -m experiments.real collect --camera http://127.0.0.1:8080/video --leds PATH --headless --automatic
    python -m experiments.real collect --twin --count 100   # the digital twin, on a virtual clock
    python -m experiments.real review                       # lists the trajectories
    python -m experiments.real review --sheet review.png    # draws the last 20
    python -m experiments.real review --discard 3 17

`collect` guides a person through trajectories: place the object in an unstable pose, hold it, release it, wait until it
rests. The initial and the final pair of images are saved as they happen, raw and uncropped, into `WORKDIR/dataset`. An
interruption loses nothing that was confirmed. The same command continues with the next number.
"""

import signal
import warnings
from typing import Annotated

import tyro

import sts_jax as sts
from experiments.shared import errors
from experiments.shared.collecting import Collect, collect
from experiments.shared.reviewing import Review, review


def main(config: Collect | Review) -> None:
    """Run a sub-command, with errors on one line."""
    with errors.on_one_line(debug=config.debug):
        try:
            if isinstance(config, Collect):
                collect(config)
            else:
                review(config)
        except KeyboardInterrupt:
            raise SystemExit("stopped") from None


def _terminated(*_: object) -> None:
    raise KeyboardInterrupt  # so that what was taken is written, as after Ctrl+C


if __name__ == "__main__":
    sts.enable_compilation_cache()
    signal.signal(signal.SIGTERM, _terminated)
    warnings.formatwarning = lambda message, *_, **__: f"note: {message}\n"
    main(
        tyro.cli(
            Annotated[Collect, tyro.conf.subcommand("collect")] | Annotated[Review, tyro.conf.subcommand("review")],
            description=__doc__,
        )
    )
