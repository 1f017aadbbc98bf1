"""Preprocessing of measurements for the networks, stored with every model."""

import dataclasses
import io
import json
from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sts_jax import _files, geometry
from sts_jax.training import manifest


@dataclasses.dataclass(frozen=True)
class Preprocessing:
    """The view that a model was trained on, its units of pose and condition, and its criterion for a touch."""

    resolution: tuple[int, int] = (64, 64)  # height, width (pixels)
    crop: bool = False  # the square around the object instead of the whole pad
    position_scale: float = 0.05  # m, divisor of positions, which makes them as large as entries of a rotation matrix
    # A matrix is a continuous function of the rotation, and rotated points are linear in it. A quaternion jumps where
    # its sign changes (Zhou et al. 2019, "On the Continuity of Rotation Representations in Neural Networks").
    rotation: Literal["matrix", "quaternion"] = "matrix"
    mask_blank_touch: bool = True  # a touch without contact is no input (False: the blank image is, as in the paper)
    touch_threshold: float = 3 / 255  # an image is a touch if a pixel differs from the blank image by more than this
    absent: tuple[str, ...] = ()  # modalities that no training input had
    condition_scale: tuple[float, ...] = ()  # SI units, divisors of the numbers of the scenario's condition

    def __post_init__(self) -> None:
        if self.rotation not in ("matrix", "quaternion"):
            raise ValueError(f"rotation must be 'matrix' or 'quaternion', got {self.rotation!r}")

    @property
    def pose_size(self) -> int:
        """Number of entries in the code of a pose."""
        return 3 + {"matrix": 9, "quaternion": 4}[self.rotation]

    def encode_pose(self, pose: Float[Array, "*n 7"]) -> Float[Array, "*n code"]:
        """Encode a pose (m, quaternion) for the networks as `pose_size` numbers."""
        position, quat = pose[..., :3] / self.position_scale, geometry.quat_canonical(pose[..., 3:])
        if self.rotation == "matrix":
            quat = geometry.quat_to_matrix(quat).reshape(*quat.shape[:-1], 9)
        return jnp.concatenate([position, quat], axis=-1)

    def decode_pose(self, code: Float[Array, "*n code"]) -> Float[Array, "*n 7"]:
        """Decode the output of a network to a pose: metres and a unit quaternion with `w >= 0`.

        Nine numbers that are not a rotation matrix are replaced by the nearest one. Zeros become the identity.
        """
        quat = code[..., 3:]
        if self.rotation == "matrix":
            quat = geometry.quat_from_matrix(quat.reshape(*quat.shape[:-1], 3, 3))
        else:
            quat = geometry.quat_canonical(quat)
        given = jnp.any(code[..., 3:] != 0, -1, keepdims=True)
        quat = jnp.where(given, quat, jnp.array([1.0, 0, 0, 0]))
        return jnp.concatenate([code[..., :3] * self.position_scale, quat], axis=-1)

    def encode_condition(self, condition: Float[Array, "*n c"]) -> Float[Array, "*n c"]:
        """Encode a condition (SI units) for the networks."""
        return condition / jnp.array(self.condition_scale, jnp.float32)

    def touched(self, tactile: Float[Array, "*n h w 3"], blank: Float[Array, "h w 3"]) -> Bool[Array, "*n"]:
        """Whether a tactile image differs somewhere from the blank one, or True if blank touches are not masked."""
        if not self.mask_blank_touch:
            return jnp.ones(tactile.shape[:-3], bool)
        return jnp.max(jnp.abs(tactile - blank), axis=(-3, -2, -1)) > self.touch_threshold


def save_blank(folder: Path, visual: np.ndarray, tactile: np.ndarray) -> None:
    """Write `folder/blank.npz`, the images of the untouched sensor. An existing file is not changed.

    Args:
        folder: the model's folder.
        visual: `uint8 (height, width, 3)`.
        tactile: `uint8 (height, width, 3)`.

    Raises:
        OSError: the file cannot be written.
    """
    path = folder / "blank.npz"

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:  # NumPy adds `.npz` to a name without it
            np.savez(file, visual=visual, tactile=tactile)

    new = not path.exists()
    if new:
        _files.write_whole(path, write)
    listed = manifest.read(folder)
    if listed is not None and (new or path.name not in listed.files):
        manifest.add(folder, path.name)


def load_blank(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the visual and the tactile image of the untouched sensor, `uint8 (height, width, 3)` each.

    Raises:
        FileNotFoundError: the file is missing.
        TornFileError: the file is damaged.
    """
    path = folder / "blank.npz"
    if not path.exists():
        raise FileNotFoundError(f"{path} is missing: start the training again, or write it with training.save_blank.")
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as arrays:
            images = arrays["visual"], arrays["tactile"]
        if any(image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 for image in images):
            raise ValueError(f"images of {images[0].dtype} {images[0].shape} and {images[1].dtype} {images[1].shape}")
    except Exception as error:  # zipfile, zlib and NumPy raise many types for damaged archives
        raise _files.TornFileError(
            f"{path} is damaged ({type(error).__name__}: {error}): delete it and start the training again, which "
            "writes it anew."
        ) from error
    return images


def preprocessing_from_json(content: dict) -> Preprocessing:
    """The inverse of `dataclasses.asdict`, also after a round trip through JSON.

    Raises:
        ValueError: a field is missing, unknown or of another type.
    """
    try:
        content = json.loads(json.dumps(content))
        content["resolution"] = tuple(content["resolution"])
        content["absent"] = tuple(content["absent"])
        content["condition_scale"] = tuple(content.get("condition_scale", ()))  # older models have no condition
        return Preprocessing(**content)
    except (KeyError, TypeError) as error:
        raise ValueError(
            f"{content!r} is no preprocessing ({type(error).__name__}: {error}): give dataclasses.asdict of a "
            "training.Preprocessing as preprocessing= to training.train."
        ) from error
