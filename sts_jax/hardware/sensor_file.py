"""The file of a commissioned sensor. It contains the constants of `sts_jax.Sensor` and the description of the device.

Commissioning is the measurement of a real sensor by `python -m experiments.commission`, which writes this file.
"""

import dataclasses
import datetime
import hashlib
import io
import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sts_jax import storage
from sts_jax.hardware import protocol
from sts_jax.hardware.camera import CameraConfig
from sts_jax.hardware.lens import Lens

VERSION = 1  # version of the format of the JSON object "device"
NAME = "sensor.json"  # name of the sensor file in a folder

Stream = Literal["visual", "tactile"]

_COMMISSION = "run `python -m experiments.commission`"


class SensorFileError(ValueError):
    """Raised if a sensor file is damaged, incomplete or of another version. The message names the file and a remedy."""


class WrongDeviceError(SensorFileError):
    """Raised if the connected camera or LED controller is not the one that the sensor file describes.

    The message names the devices of the sensor file, and each connected device that differs.
    """


@dataclasses.dataclass(frozen=True)
class Background:
    """The file name and the checksum of a background image, which is a raw image of the empty pad.

    The image is a PNG file in the folder of the sensor file.

    Raises:
        ValueError: `name` is empty or contains a folder, or `sha256` is not a checksum.
    """

    name: str  # name of the PNG file, without folder
    sha256: str  # SHA-256 of the PNG file, 64 hexadecimal digits

    def __post_init__(self) -> None:
        if not self.name or self.name != Path(self.name).name:
            raise ValueError(f"name of a background must be a file name without a folder, got {self.name!r}")
        if not re.fullmatch("[0-9a-f]{64}", self.sha256):
            raise ValueError(
                f"sha256 of {self.name} must have 64 hexadecimal digits in lower case, got {self.sha256!r}"
            )


@dataclasses.dataclass(frozen=True)
class Device:
    """The description of a real sensor: the camera, the LED controller, the lens and the measured settings.

    `python -m experiments.commission` measures the sensor and stores the description in a sensor file.

    Raises:
        ValueError: A field is out of range.
    """

    camera: str  # path in /dev/v4l/by-id, or URL. The user name and the password of a URL are removed
    fps: float  # frame rate of the camera (frames per second)
    leds: str  # serial number of the LED controller
    lens: Lens  # lens and pose of the camera, with the width and height of the raw images
    settle_on_s: float  # time from the acknowledgement that the light is on to the first frame that shows it fully (s)
    settle_off_s: float  # time from the acknowledgement that the light is off to the first frame fully without it (s)
    levels: protocol.Levels  # duty cycles of the four LED channels in the tactile stream, 0 to 255
    commissioned: str  # date of the commissioning, ISO 8601
    exposure_visual: float | None = None  # exposure of the visual stream in the driver's unit, None: not set
    exposure_tactile: float | None = None  # exposure of the tactile stream in the driver's unit, None: not set
    background_visual: Background | None = None  # image of the empty pad without light, None: not recorded
    background_tactile: Background | None = None  # image of the empty pad with light, None: not recorded
    fourcc: str | None = None  # pixel format of the camera, such as "MJPG", None: the driver's default
    white_balance: float | None = None  # white balance of the camera (K), None: not set
    focus: float | None = None  # focus in the driver's unit, None: not set
    lens_from: str = "board"  # "board": calibrated from images of a board, "ideal": assumed to be `Lens.ideal`

    def __post_init__(self) -> None:
        object.__setattr__(self, "camera", _public(self.camera))
        for name in ("camera", "leds"):
            if not getattr(self, name).strip():
                raise ValueError(f"{name} must not be empty")
        if not (self.fps > 0 and math.isfinite(self.fps)):
            raise ValueError(f"fps must be > 0 and finite, got {self.fps}")
        if self.lens_from not in ("board", "ideal"):
            raise ValueError(f"lens_from must be 'board' or 'ideal', got {self.lens_from!r}")
        for name in (
            "settle_on_s",
            "settle_off_s",
            "exposure_visual",
            "exposure_tactile",
            "white_balance",
            "focus",
        ):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise ValueError(f"{name} must be finite, got {value}")
        for name in ("settle_on_s", "settle_off_s"):
            if not 0 < getattr(self, name) < 60:
                raise ValueError(f"{name} must be in (0, 60) s, got {getattr(self, name)}")
        if not all(0 <= level <= 255 for level in self.levels) or not any(self.levels):
            raise ValueError(f"levels must be in 0..255 and not all 0, got {self.levels}")
        try:
            datetime.datetime.fromisoformat(self.commissioned)
        except ValueError as error:
            raise ValueError(f"commissioned must be a date such as 2026-05-31, got {self.commissioned!r}") from error

    @property
    def width(self) -> int:
        """Width of the raw images (pixels)."""
        return self.lens.width

    @property
    def height(self) -> int:
        """Height of the raw images (pixels)."""
        return self.lens.height

    @property
    def exposures(self) -> tuple[float, float] | None:
        """Exposures of the visual and the tactile stream, in the unit of the camera's driver.

        If either exposure is not set, the result is None instead of a tuple.
        """
        if self.exposure_visual is None or self.exposure_tactile is None:
            return None
        return self.exposure_visual, self.exposure_tactile

    def camera_config(self, source: str | None = None) -> CameraConfig:
        """Return the camera configuration that this `Device` describes, with the exposure for visual images.

        If the source is a network stream or a video file, the configuration contains only the image size and the frame
        rate. Its field `lock` is then False, because only the settings of a camera device can be locked.

        Args:
            source: Another path or URL of the same camera, such as its URL with a password. None: the path or URL in
                the attribute `camera`.
        """
        config = CameraConfig(self.camera if source is None else source, self.width, self.height, fps=self.fps)
        if config.kind != "device":
            return dataclasses.replace(config, lock=False)
        return dataclasses.replace(
            config,
            fourcc=self.fourcc,
            exposure=self.exposure_visual,
            white_balance=self.white_balance,
            focus=self.focus,
        )

    def save(
        self,
        path: str | os.PathLike,
        constants: Mapping[str, Any],
        *,
        visual: NDArray[np.uint8] | None = None,
        tactile: NDArray[np.uint8] | None = None,
    ) -> "Device":
        """Write a sensor file and the background images that it refers to.

        `Device.load` reads the device from the sensor file, and `sts_jax.Sensor.load` reads the constants. The images
        are written before the sensor file, and no file is ever written partially. If the folder contains an older
        sensor file and the process is killed after a new image was written, the older sensor file does not match the
        new image. `Device.load` then raises an error.

        Args:
            path: Path of the file, ending in .json, or of a folder, in which the file is named `sensor.json`.
            constants: The constants of the simulated sensor, from `sts_jax.Sensor.constants()`. Their field `camera`
                describes the rectified view.
            visual: Raw image of the empty pad without light, RGB, shape (height, width, 3), uint8. None: the attribute
                `background_visual` and its existing image file are kept.
            tactile: Raw image of the empty pad with light, RGB, shape (height, width, 3), uint8. None: the attribute
                `background_tactile` and its existing image file are kept.

        Returns:
            A copy of this device that refers to the written background images.

        Raises:
            SensorFileError: The file of a kept background is missing or damaged.
            ValueError: An image is not uint8, or its shape is not (height, width, 3) with the size for which the lens
                was calibrated. Or `constants` are not the constants of a simulated sensor.
            OSError: A file cannot be written.
        """
        if "camera" not in constants or "device" in constants:
            raise ValueError(
                "constants must be the constants of a simulated sensor, with the field 'camera' and without the field "
                f"'device', got the fields {list(constants)}: pass `sts_jax.Sensor.load(...).constants()`"
            )
        file = sensor_file(path)
        for stream, image in (("visual", visual), ("tactile", tactile)):
            if image is not None:
                self._check_image(stream, image)
        device = dataclasses.replace(
            self,
            background_visual=self.background_visual if visual is None else _written(file, "visual", visual),
            background_tactile=self.background_tactile if tactile is None else _written(file, "tactile", tactile),
        )
        device._check_backgrounds(file)
        storage.write_json(file, {**constants, "device": {"version": VERSION, **dataclasses.asdict(device)}})
        return device

    @classmethod
    def load(cls, path: str | os.PathLike) -> "Device":
        """Read the device from a sensor file, and compare the background images with the checksums in the file.

        Args:
            path: Path of the sensor file or of its folder.

        Returns:
            The device.

        Raises:
            FileNotFoundError: There is no such file.
            SensorFileError: The file cannot be read, is not JSON, describes no device, or was written in another
                version of the format. Or a field is missing, unknown or out of range. Or a background image is missing
                or damaged.
        """
        file = sensor_file(path)
        try:
            values = storage.read_json(file, f"{_COMMISSION} again")
        except storage.DamagedFileError as error:
            raise SensorFileError(str(error)) from error
        device = values.get("device") if isinstance(values, dict) else None
        if not isinstance(device, dict):
            raise SensorFileError(
                f"{file} describes no device, so it belongs to a simulated sensor. To make the file of a real sensor, "
                f"{_COMMISSION}."
            )
        version = device.pop("version", None)
        if version != VERSION:
            raise SensorFileError(
                f"{file} has format {version!r} (field device.version), but this version of sts_jax reads format "
                f"{VERSION}. Use the version of sts_jax that wrote the file, or {_COMMISSION} again."
            )
        try:
            loaded = storage.decode(cls, device, "device")
        except ValueError as error:
            raise SensorFileError(f"{file}: {error}. Correct the file, or {_COMMISSION} again.") from error
        loaded._check_backgrounds(file)
        return loaded

    def background(self, path: str | os.PathLike, stream: Stream) -> NDArray[np.uint8]:
        """Read the image of the empty pad in one stream.

        Args:
            path: Path of the sensor file or of its folder.
            stream: "visual" (without light) or "tactile" (with light).

        Returns:
            Raw RGB image, shape (height, width, 3), uint8.

        Raises:
            SensorFileError: No background is recorded for this stream, or its image file is missing or damaged.
            ValueError: The image does not have the `height` and `width` of this device.
        """
        background = self._named(stream)
        if background is None:
            raise SensorFileError(f"{sensor_file(path)} has no {stream} background. To record one, {_COMMISSION}.")
        image = _checked_image(sensor_file(path).with_name(background.name), background)
        self._check_image(stream, image)
        return image

    def check_identity(self, *, camera: str | None = None, leds: str | None = None) -> None:
        """Raise an error if the connected camera or LED controller is not the one that is named in this `Device`.

        Args:
            camera: Path or URL of the connected camera. None: the camera is not compared.
            leds: Serial number of the connected LED controller. None: the controller is not compared.

        Raises:
            WrongDeviceError: The camera or the controller differs.
        """
        found = []
        if camera is not None and _public(camera) != self.camera:
            found.append(f"camera {_public(camera)}")
        if leds is not None and leds != self.leds:
            found.append(f"LED controller {leds}")
        if found:
            raise WrongDeviceError(
                f"the sensor file describes camera {self.camera} and LED controller {self.leds}, but the connected "
                f"sensor has {' and '.join(found)}. Load the sensor file of the connected sensor. If there is no such "
                f"file, {_COMMISSION}."
            )

    def _named(self, stream: Stream) -> Background | None:
        """The background of a stream, or None if it is not recorded."""
        return self.background_visual if stream == "visual" else self.background_tactile

    def _check_image(self, stream: str, image: NDArray[np.uint8]) -> None:
        shape = (self.height, self.width, 3)
        if image.dtype != np.uint8 or image.shape != shape:
            raise ValueError(
                f"the {stream} background must be a raw image, uint8 of shape {shape}, got {image.dtype} of shape "
                f"{image.shape}"
            )

    def _check_backgrounds(self, file: Path) -> None:
        for background in (self.background_visual, self.background_tactile):
            if background is not None:
                _checked_content(file.with_name(background.name), background)


def sensor_file(path: str | os.PathLike) -> Path:
    """Return `path` if it ends in .json, otherwise the path of `sensor.json` in the folder `path`.

    Args:
        path: Path of the sensor file, or of its folder.
    """
    path = Path(path)
    return path if path.suffix.lower() == ".json" else path / NAME


def _public(source: str) -> str:
    """The path or URL of a camera without a user name and a password."""
    return re.sub(r"(?<=://)[^/@]*@", "", source)


def _written(file: Path, stream: Stream, image: NDArray[np.uint8]) -> Background:
    """Write a background image beside the sensor file."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", compress_level=3)
    path = file.with_name(f"background_{stream}.png")
    storage.write_bytes(path, buffer.getvalue())
    return Background(path.name, hashlib.sha256(buffer.getvalue()).hexdigest())


def _checked_content(path: Path, background: Background) -> bytes:
    """Read the file of a background image and compare its checksum."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise SensorFileError(
            f"the background image {path} cannot be read ({error}). Copy the image from the original folder of the "
            f"sensor file, or {_COMMISSION} again."
        ) from error
    if hashlib.sha256(content).hexdigest() != background.sha256:
        raise SensorFileError(
            f"the checksum of the background image {path} differs from the one in the sensor file, so the image is "
            "damaged or belongs to another sensor file. Copy the image from the original folder of the sensor file, or "
            f"{_COMMISSION} again."
        )
    return content


def _checked_image(path: Path, background: Background) -> NDArray[np.uint8]:
    with Image.open(io.BytesIO(_checked_content(path, background))) as image:
        return np.asarray(image)
