"""Serial ports: listing them, opening one for exclusive use, and the errors of the LED controller."""

import contextlib
import dataclasses
import errno
import os
from pathlib import Path

import serial
from serial.tools import list_ports

from sts_jax.hardware import protocol

READ_S = 0.02  # longest wait of one read (s)
WRITE_S = 0.2  # longest wait of one write (s)


class LedError(OSError):
    """Base class of the errors of the LED controller and of its port. The message states the cause and the remedy."""


class PortNotFoundError(LedError):
    """Raised if a port does not exist, or if no port has the wanted controller. The message lists the ports found."""


class PortPermissionError(LedError):
    """Raised if the user is not allowed to open the serial port. The message names the group that has permission."""


class PortInUseError(LedError):
    """Raised if a process has opened the serial port already. The message names that process if it is known."""


class NotALedControllerError(LedError):
    """Raised if a device is not a serial port, or does not answer the requests as an LED controller does."""


class WrongVersionError(LedError):
    """Raised if the controller uses another version of the protocol. The message names both versions."""


class LedTimeoutError(LedError):
    """Raised if the controller gave no valid answer in time, or accepted no bytes."""


class DisconnectedError(LedError):
    """Raised if the port has vanished or is closed. `Leds.reconnect` searches for the controller again."""


@dataclasses.dataclass(frozen=True)
class Port:
    """A serial port of this machine."""

    device: str  # name for `Leds.connect`, such as /dev/ttyACM0
    description: str  # description by the operating system, may be empty
    serial_number: str | None  # USB serial number, None: unknown. The controller's own one is `Leds.serial_number`
    vendor: int | None  # number of the USB vendor, None: not a USB device
    product: int | None  # number of the USB product, None: not a USB device


def find_controllers() -> list[Port]:
    """List the serial ports of this machine.

    The LED controller may be on any of them. No port is opened, because opening a port restarts most boards.

    Returns:
        The ports. The ports of USB devices come first.
    """
    found = [
        Port(port.device, port.description or "", port.serial_number or None, port.vid, port.pid)
        for port in list_ports.comports()
    ]
    return sorted(found, key=lambda port: (port.vendor is None, port.device))


def open_port(name: str, baud: int = protocol.BAUD) -> serial.Serial:
    """Open a serial port, and lock it against other programs that use this library or pyserial's exclusive mode.

    Args:
        name: Name of the port, such as `/dev/ttyACM0`, or a URL of pyserial, such as `socket://localhost:7000`.
        baud: Rate of the serial line (baud).

    Returns:
        The open port.

    Raises:
        PortNotFoundError: There is no such port.
        PortPermissionError: The user is not allowed to open the port.
        PortInUseError: Another process, or another part of this process, has locked the port.
        NotALedControllerError: The device is not a serial port.
        LedError: The port cannot be opened for another reason.
    """
    try:
        return serial.serial_for_url(name, baudrate=baud, timeout=READ_S, write_timeout=WRITE_S, exclusive=True)
    except ValueError as error:
        raise PortNotFoundError(
            f"{name!r} is neither a port nor a URL of pyserial ({error}). {_ports_found()}"
        ) from error
    except OSError as error:
        raise _opening_error(name, error) from error


def _opening_error(name: str, error: OSError) -> LedError:
    """The error to raise for a port that cannot be opened, chosen by the operating system's error number."""
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
    """A sentence for error messages that lists the serial ports of this machine."""
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
    """Return the processes that have opened a device, as texts such as "process 123 (python)".

    The list contains only processes whose open files the current user is allowed to see. If the current process is
    the only one, the list contains the text "another part of this process". On systems other than Linux, the list is
    empty.

    Args:
        name: Path of the device, such as `/dev/ttyACM0`.
    """
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
    """Return True if a symbolic link leads to the target, and False if it does not or cannot be read."""
    with contextlib.suppress(OSError):
        return os.readlink(link) == target
    return False
