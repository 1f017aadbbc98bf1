"""Preprocessing of measurements for the networks, stored with every model."""

import dataclasses
import io
import json
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from sts_jax import _files, geometry
from sts_jax.training import manifest

# The contact test of noisy images, with the values of the contact test during a collection (`hardware.GuideConfig`)
_NOISY_BLOCK = 2  # pixels
_NOISY_BLOCKS = 3
_DEVIATIONS = 6.0  # standard deviations of a block's mean
_SMALLEST, _LARGEST = 3.0, 24.0  # of 255, limits of the threshold
_NORMAL = 1.4826  # standard deviation of a normal distribution over its median absolute deviation


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
    touch_threshold: float = 3 / 255  # blocks of a touch differ from those of the blank image by more than this
    # The defaults are for simulated images. `touch_of_noisy_images` sets these fields for images of a camera.
    touch_block: int = 1  # pixels, side of the blocks whose means are compared
    touch_blocks: int = 1  # number of blocks that differ in a touch
    touch_level: bool = False  # subtract the median change first, so that a change of the whole light is no touch
    absent: tuple[str, ...] = ()  # modalities that no training input had
    condition_scale: tuple[float, ...] = ()  # SI units, divisors of the numbers of the scenario's condition

    def __post_init__(self) -> None:
        if self.rotation not in ("matrix", "quaternion"):
            raise ValueError(f"rotation must be 'matrix' or 'quaternion', got {self.rotation!r}")
        if self.touch_block < 1 or any(side % self.touch_block for side in self.resolution):
            raise ValueError(f"touch_block must divide the resolution {self.resolution}, got {self.touch_block}")
        if self.touch_blocks < 1:
            raise ValueError(f"touch_blocks must be >= 1, got {self.touch_blocks}")

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
        change = _block_means(tactile - blank, self.touch_block)
        if self.touch_level:
            change = change - jnp.median(change, axis=(-3, -2), keepdims=True)
        differs = jnp.any(jnp.abs(change) > self.touch_threshold, axis=-1)
        return jnp.sum(differs, axis=(-2, -1)) >= self.touch_blocks


def touch_of_noisy_images(
    preprocessing: Preprocessing, tactile: UInt8[np.ndarray, "n h w 3"], blank: UInt8[np.ndarray, "h w 3"]
) -> Preprocessing:
    """Set the criterion for a touch by the noise of a camera's images.

    A touch differs from the blank image in three blocks of 2 x 2 pixels by more than six standard deviations of the
    noise of a block's mean, and by at least 3 of 255. The noise is 1.4826 times the median absolute difference from the
    blank image, so that contacts on less than half of the pad do not count. Slow changes of the light since the blank
    image count as noise.

    Args:
        preprocessing: The other fields.
        tactile: Images of the empty pad, or with contacts on less than half of it.
        blank: The tactile image of the untouched sensor, a mean over many frames.

    Raises:
        ValueError: The images have another resolution than the preprocessing, or there are none.
    """
    shape = (*preprocessing.resolution, 3)
    if tactile.shape[1:] != shape or blank.shape != shape or not len(tactile):
        raise ValueError(
            f"tactile has shape {tactile.shape} and blank has shape {blank.shape}, but they must be (n, "
            f"{', '.join(map(str, shape))}) with n >= 1 and {shape}: reduce the images to the resolution"
        )
    change = _block_means(tactile.astype(np.float32) - blank, _NOISY_BLOCK)
    change = change - np.median(change, axis=(-3, -2), keepdims=True)
    noise = _NORMAL * float(np.median(np.abs(change)))
    threshold = min(max(_DEVIATIONS * noise, _SMALLEST), _LARGEST) / 255
    return dataclasses.replace(
        preprocessing,
        touch_threshold=threshold,
        touch_block=_NOISY_BLOCK,
        touch_blocks=_NOISY_BLOCKS,
        touch_level=True,
    )


def _block_means(images: Any, side: int) -> Any:
    """Means over blocks of `side` x `side` pixels of images (*n, h, w, 3), of NumPy or JAX."""
    if side == 1:
        return images
    height, width = images.shape[-3] // side, images.shape[-2] // side
    return images.reshape(*images.shape[:-3], height, side, width, side, 3).mean((-4, -2))


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
