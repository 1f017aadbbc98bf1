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

import shlex

import tyro

from experiments.shared.commissioning import Config, commission
from experiments.shared.terminal import on_one_line
from sts_jax import hardware


def find(config: Config) -> str:
    """List the cameras and USB serial ports among which the user must choose, and the command to run next."""
    lines, words = [], ["python", "-m", "experiments.commission"]
    ports = [port for port in hardware.find_controllers() if port.vid is not None]
    cameras = {camera.source: str(camera) for camera in hardware.find_cameras()}
    controllers = {p.device: f"{p.device} ({p.description}, serial number {p.serial_number})" for p in ports}
    for option, given, kind, there, remedy in (
        ("--camera", config.camera, "camera", cameras, "connect one, or give the URL of one"),
        (
            *("--leds", config.leds, "USB serial port", controllers),
            "connect the controller by USB, or give the name of another port",
        ),
    ):
        if given is not None:
            words += [option, given]
            continue
        if not there:
            raise ValueError(f"no {kind} was found: {remedy} with {option}")
        lines += [f"{kind}s:", *(f"  {line}" for line in there.values())]
        words += [option, next(iter(there)) if len(there) == 1 else option[2:].upper()]
    return "\n".join([*lines, f"next: {shlex.join([*words, '--out', str(config.out)])}"])


def main(config: Config) -> None:
    """Write the calibration board, list the devices to choose from, or measure the sensor, as the options require."""
    if config.print_board is not None:
        hardware.save_board(config.print_board)
        print(f"{config.print_board}: print it at 100 % on A4. The ruler on the page must measure 100 mm")
    elif config.camera is None or config.leds is None:
        print(find(config))
    else:
        commission(config)


if __name__ == "__main__":
    arguments = tyro.cli(Config, description=__doc__)
    try:
        with on_one_line():
            main(arguments)
    except KeyboardInterrupt:
        number = len(list((arguments.out / "board").glob("*.png")))
        raise SystemExit(
            f"interrupted. Number of kept pictures of the board: {number}. Run the command again to continue"
        ) from None
