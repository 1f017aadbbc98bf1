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

import tyro

from experiments.shared.commissioning import Config, commission
from experiments.shared.terminal import on_one_line
from sts_jax import hardware


def find() -> None:
    """List the cameras and the USB serial ports among which the user must choose."""
    ports = [port for port in hardware.find_controllers() if port.vid is not None]
    controllers = [f"{port.device} ({port.description}, serial number {port.serial_number})" for port in ports]
    for option, kind, devices in (
        ("--camera", "cameras", [str(camera) for camera in hardware.find_cameras()]),
        ("--leds", "USB serial ports", controllers),
    ):
        print(f"{kind}, give one as {option}:", *(devices or ["none was found: connect one"]), sep="\n  ")


def main(config: Config) -> None:
    """Write the calibration board, list the devices to choose from, or measure the sensor, as the options require."""
    if config.print_board is not None:
        hardware.save_board(config.print_board)
        print(f"{config.print_board}: print it at 100 % on A4. The ruler on the page must measure 100 mm")
    elif config.camera is None or config.leds is None:
        find()
    else:
        commission(config)


if __name__ == "__main__":
    arguments = tyro.cli(Config, description=__doc__)
    with on_one_line():
        main(arguments)
