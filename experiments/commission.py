"""Commission a real sensor: measure its camera, lights and lens, and write the sensor file.

    python -m experiments.commission                                    # list cameras and serial ports
    python -m experiments.commission --print-board board.pdf            # write the calibration board
    python -m experiments.commission --camera /dev/video0 --leds /dev/ttyACM0 --out bench

The command chooses one exposure for the visual images (lights off) and one for the tactile images (lights on). It
measures the time from a change of the lights to the first frame that shows only the new lights, records images of the
empty pad, and calibrates the lens from pictures of the printed calibration board. The command writes OUT/sensor.json,
which `Sensor.load` and `hardware.STS.from_file` read. Pictures of the board are kept in OUT/board, so the same command
continues after an interruption.
"""

import dataclasses
import shlex
from pathlib import Path

import tyro

from experiments.shared import commissioning, terminal
from sts_jax import hardware


@dataclasses.dataclass(frozen=True)
class Config(commissioning.Config):
    """Options of the command line: devices, output folder, and whether to calibrate the lens or assume an ideal one."""

    print_board: Path | None = None  # write the board to this PDF or PNG file and stop


def find(config: Config) -> str:
    """Find the devices that the options do not name.

    Returns:
        A text that lists the cameras and USB serial ports among which the user must choose, and the command to run
        next.

    Raises:
        ValueError: `camera` is None and no camera was found, or `leds` is None and no USB serial port was found.
    """
    found, lines, words = hardware.find_sensors(), [], ["python", "-m", "experiments.commission"]
    ports = [port for port in found.ports if port.vendor is not None]
    cameras = [str(camera) for camera in found.cameras]
    for option, given, there, names, remedy in (
        ("--camera", config.camera, cameras, [c.source for c in found.cameras], "connect one, or give the URL of one"),
        (
            "--leds",
            config.leds,
            [f"{port.device} ({port.description}, serial number {port.serial_number})" for port in ports],
            [port.device for port in ports],
            "connect the controller by USB, or give the name of another port",
        ),
    ):
        if given is not None:
            words += [option, given]
            continue
        kind = {"--camera": "camera", "--leds": "USB serial port"}[option]
        if not there:
            raise ValueError(f"no {kind} was found: {remedy} with {option}")
        lines += [f"{kind}s:", *(f"  {line}" for line in there)]
        words += [option, names[0] if len(names) == 1 else option[2:].upper()]
    return "\n".join([*lines, f"next: {shlex.join([*words, '--out', str(config.out)])}"])


def main(config: Config) -> None:
    """Measure the camera, the lights and the lens of a sensor, and write the sensor file.

    With `print_board`, only write the calibration board. If at least one of `camera` and `leds` is None, only list the
    devices to choose from.
    """
    if config.print_board is not None:
        hardware.save_board(config.print_board)
        print(f"{config.print_board}: print it at 100 % on A4. The ruler on the page must measure 100 mm")
        return
    if config.camera is None or config.leds is None:
        print(find(config))
        return
    commissioning.commission(config)


if __name__ == "__main__":
    arguments = tyro.cli(Config, description=__doc__)
    try:
        with terminal.on_one_line():
            main(arguments)
    except KeyboardInterrupt:
        number = len(list((arguments.out / "board").glob("*.png")))
        raise SystemExit(
            f"interrupted. Number of kept pictures of the board: {number}. Run the command again to continue"
        ) from None
