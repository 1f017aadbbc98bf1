"""Serial ports: listing, opening for one process alone, and the errors of the LED controller."""

import contextlib
import dataclasses
import errno
import os
from pathlib import Path

import serial
from serial.tools import list_ports

from sts_jax.hardware import protocol

READ_S = 0.02  # longest wait of one read
WRITE_S = 0.2  # longest wait of one write


class LedError(OSError):
    """An error of the LED controller or its port. The message states what was found and the remedy."""


class PortNotFoundError(LedError):
    """There is no such port. The message lists the ports that were found."""


class PortPermissionError(LedError):
    """The user may not open the port."""


class PortInUseError(LedError):
    """Another process has opened the port. The message names it."""


class NotALedControllerError(LedError):
    """The device on the port gave no valid answer. The message describes the bytes that were received."""


class WrongVersionError(LedError):
    """The controller speaks another version of the protocol."""


class LedTimeoutError(LedError):
    """The controller gave no valid answer in time."""


class DisconnectedError(LedError):
    """The port has vanished."""


@dataclasses.dataclass(frozen=True)
class Port:
    """A serial port of this machine."""

    device: str  # the name to connect to, such as /dev/ttyACM0
    description: str
    serial_number: str | None  # of the USB device. The controller's own serial number is known after `connect`
    vendor: int | None  # USB vendor
    product: int | None  # USB product


def find_controllers() -> list[Port]:
    """List the serial ports to which a controller may be connected, with their USB serial numbers.

    No port is opened, because opening resets most boards. Ports of USB devices come first.
    """
    found = [
        Port(port.device, port.description or "", port.serial_number or None, port.vid, port.pid)
        for port in list_ports.comports()
    ]
    return sorted(found, key=lambda port: (port.vendor is None, port.device))


def open_port(name: str, baud: int = protocol.BAUD) -> serial.Serial:
    """Open a serial port for this process alone.

    Args:
        name: Device or URL of pyserial.
        baud: Rate (baud).

    Raises:
        PortNotFoundError: There is no such port.
        PortPermissionError: The user may not open it.
        PortInUseError: Another process, or another part of this one, has opened it.
        NotALedControllerError: It is not a serial port.
        LedError: It cannot be opened for another reason.
    """
    try:
        return serial.serial_for_url(name, baudrate=baud, timeout=READ_S, write_timeout=WRITE_S, exclusive=True)
    except ValueError as error:
        raise PortNotFoundError(f"{name!r} is not a port or a URL of pyserial ({error}). {_ports_found()}") from error
    except OSError as error:
        raise _opening_error(name, error) from error


def _opening_error(name: str, error: OSError) -> LedError:
    """The error for a port that cannot be opened, by the number of the system's error."""
    match error.errno:
        case errno.ENOENT | errno.ENODEV | errno.ENXIO:
            return PortNotFoundError(f"there is no port {name}. {_ports_found()}")
        case errno.EACCES | errno.EPERM:
            group = _group(name)
            return PortPermissionError(
                f"no permission to open {name}: add your user to its group with `sudo usermod -aG {group} $USER` "
                f"(the group is usually dialout), then log in again."
            )
        case errno.EAGAIN | errno.EBUSY:
            users = ", ".join(users_of(name)) or "another process"
            return PortInUseError(f"{name} is in use by {users}: close the other program, or choose another port.")
        case errno.ENOTTY | errno.EISDIR:
            return NotALedControllerError(f"{name} is not a serial port. {_ports_found()}")
    if os.path.exists(name) and not Path(name).is_char_device():
        return NotALedControllerError(f"{name} is not a serial port. {_ports_found()}")
    return LedError(f"cannot open {name}: {error}. Unplug the controller, plug it in again, and retry.")


def _ports_found() -> str:
    found = ", ".join(f"{port.device} ({port.description})" for port in find_controllers())
    return f"Ports found: {found}." if found else "No serial ports were found: connect the controller by USB."


def _group(name: str) -> str:
    """The group that owns a device, or dialout if it is unknown."""
    with contextlib.suppress(OSError, KeyError, ImportError):
        import grp  # not on Windows

        group = grp.getgrgid(os.stat(name).st_gid).gr_name
        return "dialout" if group == "root" else group
    return "dialout"


def users_of(name: str) -> list[str]:
    """The processes that have opened a device, as far as this user may see them. Linux only, elsewhere empty."""
    target, users, own = os.path.realpath(name), [], False
    for folder in Path("/proc").glob("[0-9]*/fd"):
        with contextlib.suppress(OSError):
            if any(_points_to(link, target) for link in folder.iterdir()):
                if folder.parent.name == str(os.getpid()):
                    own = True
                    continue
                command = (folder.parent / "comm").read_text().strip()
                users.append(f"process {folder.parent.name} ({command})")
    return sorted(users) or ["another part of this process"] * own


def _points_to(link: Path, target: str) -> bool:
    with contextlib.suppress(OSError):
        return os.readlink(link) == target
    return False
