"""The sensor file of a commissioned sensor: the constants of `sts_jax.Sensor`, and the device as the object `device`.

`python -m experiments.commission` writes its folder: `sensor.json`, raw images of the empty pad, and the manifest.
"""

import dataclasses
import hashlib
import os
import shutil
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
from jaxtyping import UInt8
from pydantic import Field

from sts_jax import storage
from sts_jax.hardware.camera import CameraConfig, public
from sts_jax.hardware.lens import Lens
from sts_jax.sensor import Sensor
from sts_jax.storage import Finite

NAME = "sensor.json"  # name of the sensor file in a folder
BACKGROUNDS = "background_visual.png", "background_tactile.png"  # raw images of the empty pad, lights off and on

_AGAIN = "copy its whole folder again, or run `python -m experiments.commission` again"

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Settling = Annotated[float, Field(gt=0, lt=60)]
Level = Annotated[int, Field(ge=0, le=255)]
Text = Annotated[str, Field(pattern=r"\S")]
Raw = UInt8[np.ndarray, "height width 3"]


@dataclasses.dataclass(frozen=True)
class Device:
    """The description of a real sensor: the camera, the LED controller, the lens and the measured settings."""

    camera: Text  # path in /dev/v4l/by-id, or URL. The user name and the password of a URL are removed
    fps: Positive  # frame rate of the camera (frames per second)
    leds: Text  # serial number of the LED controller
    lens: Lens  # lens and pose of the camera, with the width and height of the raw images
    settle_on_s: Settling  # time from the acknowledgement that the light is on to the first frame with all of it (s)
    settle_off_s: Settling  # time from the acknowledgement that the light is off to the first frame without it (s)
    levels: tuple[Level, Level, Level, Level]  # duty cycles of the four LED channels in the tactile stream
    commissioned: Annotated[str, Field(pattern=r"^\d{4}-\d\d-\d\d")]  # date of the commissioning, ISO 8601
    exposure_visual: Finite | None = None  # exposure of the visual stream in the driver's unit, None: not set
    exposure_tactile: Finite | None = None  # exposure of the tactile stream in the driver's unit, None: not set
    fourcc: str | None = None  # pixel format of the camera, such as "MJPG", None: the driver's default
    white_balance: Finite | None = None  # white balance of the camera (K), None: not set
    focus: Finite | None = None  # focus in the driver's unit, None: not set
    lens_from: Literal["board", "ideal"] = "board"  # calibrated from images of a board, or assumed as `Lens.ideal`

    def __post_init__(self) -> None:
        object.__setattr__(self, "camera", public(self.camera))

    @property
    def exposures(self) -> tuple[float, float] | None:
        """Exposures of the visual and the tactile stream in the driver's unit, or None if one is not set."""
        if self.exposure_visual is None or self.exposure_tactile is None:
            return None
        return self.exposure_visual, self.exposure_tactile

    def camera_config(self, source: str | None = None) -> CameraConfig:
        """The camera's configuration with the visual exposure. Only settings of a local device are locked.

        `source` is another path or URL of the same camera, such as its URL with a password.
        """
        config = CameraConfig(source or self.camera, self.lens.width, self.lens.height, fps=self.fps)
        if config.kind != "device":
            return dataclasses.replace(config, lock=False)
        return dataclasses.replace(
            config,
            fourcc=self.fourcc,
            exposure=self.exposure_visual,
            white_balance=self.white_balance,
            focus=self.focus,
        )

    def save(self, path: str | os.PathLike, sensor: Sensor, backgrounds: tuple[Raw, Raw] | None = None) -> None:
        """Write the sensor file, the raw images of the empty pad, and at last the manifest.

        Args:
            sensor: Constants of the simulated sensor, whose `camera` describes the rectified view.
            backgrounds: Images of the empty pad without and with light. None: those in the folder stay.
        """
        file, shape, content = sensor_file(path), (self.lens.height, self.lens.width, 3), dataclasses.asdict(self)
        storage.decode(Device, content, "device")
        manifest = storage.read_manifest(file.parent, _AGAIN) if backgrounds is None else None
        written = {}
        for name, image in zip(BACKGROUNDS, backgrounds or (), strict=False):
            if image.shape != shape:
                raise ValueError(f"a background has shape {image.shape}, but the lens {shape}")
            written[name] = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()
        written[file.name] = storage.json_bytes({**sensor.constants(), "device": content})
        checksums = {name: hashlib.sha256(data).hexdigest() for name, data in written.items()}
        files = checksums if manifest is None else {**manifest.files, **checksums}
        written[storage.MANIFEST] = storage.json_bytes(storage.Manifest(files, {}).content)
        storage.write_together(file.parent, written)

    @classmethod
    def load(cls, path: str | os.PathLike) -> "Device":
        """Read the device from a sensor file or its folder, and compare all files with the manifest."""
        file = sensor_file(path)
        checksums(file)
        content = storage.read_json(file, _AGAIN)
        device = content.get("device") if isinstance(content, dict) else None
        if device is None:
            raise ValueError(f"{file} describes no device, but a simulated sensor: {_AGAIN}.")
        try:
            return storage.decode(cls, device, "device")
        except ValueError as error:
            raise ValueError(f"{file}: {error}: {_AGAIN}.") from error

    def backgrounds(self, path: str | os.PathLike) -> tuple[Raw, Raw] | None:
        """Raw images of the empty pad without and with light, beside a sensor file. None if none were recorded."""
        file = sensor_file(path)
        if not set(BACKGROUNDS) <= checksums(file).keys():
            return None
        paths = [str(file.with_name(name)) for name in BACKGROUNDS]
        visual, tactile = (np.asarray(cv2.imread(path, cv2.IMREAD_COLOR_RGB)) for path in paths)
        return visual, tactile

    def check_identity(self, *, camera: str | None = None, leds: str | None = None) -> None:
        """Raise a ValueError if the given camera (path or URL) or controller (serial number) is another one."""
        camera, leds = self.camera if camera is None else public(camera), leds or self.leds
        if (camera, leds) != (self.camera, self.leds):
            raise ValueError(
                f"the sensor file describes camera {self.camera} and LED controller {self.leds}, but the images are of "
                f"camera {camera} and LED controller {leds}: load the sensor file of these, or make one with "
                "`python -m experiments.commission`."
            )


def sensor_file(path: str | os.PathLike) -> Path:
    """Return `path` if it ends in .json, otherwise the path of `sensor.json` in the folder `path`."""
    path = Path(path)
    return path if path.suffix.lower() == ".json" else path / NAME


def copy_sensor(path: str | os.PathLike, folder: Path) -> dict[str, str]:
    """Copy an undamaged sensor file as `sensor.json`, with its images and a manifest. Returns the files' checksums."""
    file, copied = sensor_file(path), {}
    folder.mkdir(parents=True, exist_ok=True)
    for name, digest in checksums(file).items():
        copy = NAME if name == file.name else name
        shutil.copyfile(file.with_name(name), folder / copy)
        copied[copy] = digest
    storage.write_manifest(folder, copied)
    return copied


def checksums(path: str | os.PathLike) -> dict[str, str]:
    """Compare a sensor file and its images with the manifest of their folder. Returns their SHA-256 by name."""
    file = sensor_file(path)
    if not file.exists():
        raise FileNotFoundError(f"{file} does not exist: give the folder of a sensor file, or {_AGAIN}")
    manifest = storage.read_manifest(file.parent, _AGAIN)
    if manifest is None:
        raise ValueError(
            f"{file.parent} has no {storage.MANIFEST}, so {file.name} is incomplete or that of a simulated sensor: "
            f"{_AGAIN}."
        )
    names = [file.name, *(name for name in BACKGROUNDS if name in manifest.files)]
    storage.verify(file.parent, manifest, _AGAIN, names)
    return {name: manifest.files[name] for name in names}
