"""Preprocessing of images, poses and scenario conditions for the networks, and a contact test for tactile images.

A scenario condition consists of the known quantities of a trajectory, such as the acceleration of the pad. The
`config.json` of a trained model contains the values of the fields of its `Preprocessing`.
"""

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from sts_jax import geometry, storage

# The contact test of noisy images. It has the same values as the contact test of the collection of recordings
# (`hardware.GuideConfig`).
_NOISY_BLOCK = 2  # pixels, side of a block
_NOISY_BLOCKS = 3  # least number of blocks that differ
_DEVIATIONS = 6.0  # threshold in standard deviations of a block's mean
_SMALLEST, _LARGEST = 3.0, 24.0  # limits of the threshold, in steps of 1/255
_NORMAL = 1.4826  # standard deviation of a normal distribution divided by its median absolute deviation


@dataclasses.dataclass(frozen=True)
class Preprocessing:
    """The encoding of images, poses and scenario conditions for a model, and the test for a contact in tactile images.

    A scenario condition has the known quantities of a trajectory, such as the acceleration of the pad.

    Raises:
        ValueError: A field has a value that is not allowed. The message names the field.
    """

    resolution: tuple[int, int] = (64, 64)  # height and width of the images (pixels)
    crop: bool = False  # True: images show the square around the object. False: images show the whole pad
    position_scale: float = 0.05  # m, divisor of positions, so that they are as large as entries of a rotation matrix
    # A matrix is a continuous function of the rotation, and rotated points are linear in it. A quaternion jumps where
    # its sign changes (Zhou et al. 2019, "On the Continuity of Rotation Representations in Neural Networks").
    rotation: Literal["matrix", "quaternion"] = "matrix"
    mask_blank_touch: bool = True  # a tactile image without contact is not an input (False: it is, as in the paper)
    touch_threshold: float = 3 / 255  # a block differs from the blank image if a channel differs by more than this
    # The defaults are for simulated images. `touch_of_noisy_images` sets the touch fields for images of a camera.
    touch_block: int = 1  # pixels, side of the square blocks whose means are compared with the blank image
    touch_blocks: int = 1  # least number of differing blocks in an image with a contact
    touch_level: bool = False  # subtract the median change first, so that a change of all light is not a contact
    absent: tuple[str, ...] = ()  # modalities that no training sample had as an input
    condition_scale: tuple[float, ...] = ()  # SI units, divisors of the numbers of the scenario's condition
    # (name, scale) of each further modality that is a vector (`dataset.Measurement`), scale in SI units
    scales: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        if self.rotation not in ("matrix", "quaternion"):
            raise ValueError(f"rotation must be 'matrix' or 'quaternion', got {self.rotation!r}")
        if self.touch_block < 1 or any(side % self.touch_block for side in self.resolution):
            raise ValueError(
                f"touch_block must divide the height and the width of resolution {self.resolution}, got "
                f"{self.touch_block}"
            )
        if self.touch_blocks < 1:
            raise ValueError(f"touch_blocks must be >= 1, got {self.touch_blocks}")

    @property
    def pose_size(self) -> int:
        """Number of values in an encoded pose: 12 with a rotation matrix, 7 with a quaternion."""
        return 3 + {"matrix": 9, "quaternion": 4}[self.rotation]

    def encode_pose(self, pose: Float[Array, "*n 7"]) -> Float[Array, "*n code"]:
        """Encode poses for the networks.

        Args:
            pose: Position (m) and quaternion (w, x, y, z) of each pose. This method normalises the quaternions.

        Returns:
            Position divided by `position_scale`, followed by the nine entries of the rotation matrix row by row. If
            `rotation` is `quaternion`, the position is followed by the unit quaternion (w, x, y, z) with `w >= 0`.
        """
        position, quat = pose[..., :3] / self.position_scale, geometry.quat_canonical(pose[..., 3:])
        if self.rotation == "matrix":
            quat = geometry.quat_to_matrix(quat).reshape(*quat.shape[:-1], 9)
        return jnp.concatenate([position, quat], axis=-1)

    def decode_pose(self, code: Float[Array, "*n code"]) -> Float[Array, "*n 7"]:
        """Decode poses from the output of a network.

        Args:
            code: Encoded poses, as from `encode_pose`. The field `rotation` of this `Preprocessing` states whether the
                poses contain rotation matrices or quaternions. An inexact rotation matrix is replaced by the nearest
                rotation matrix. A quaternion is normalised. If all numbers of the rotation are 0, the identity is used.

        Returns:
            Position (m) and unit quaternion (w, x, y, z) with `w >= 0` of each pose.
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
        """Encode conditions for the networks.

        Args:
            condition: Known quantities of the scenario such as an acceleration, c numbers for each item (SI units).

        Returns:
            The numbers, each divided by its typical size in the field `condition_scale`.
        """
        return condition / jnp.array(self.condition_scale, jnp.float32)

    def encode(self, name: str, values: Float[Array, "..."]) -> Float[Array, "..."]:
        """Encode the values of a modality for the networks.

        Args:
            name: Name of the modality.
            values: Poses, images in [0, 1], or the values of a further modality (SI units). A further modality is
                defined by a `dataset.Measurement`.

        Returns:
            The result of `encode_pose` for the modality `pose`. The numbers of a further modality are divided by its
            scale in the field `scales`. Images are returned unchanged.
        """
        if name == "pose":
            return self.encode_pose(values)
        scale = dict(self.scales).get(name)
        return values if scale is None else values / scale

    def decode(self, name: str, code: Float[Array, "..."]) -> Float[Array, "..."]:
        """Decode the output of an `mvae` network for a modality.

        Args:
            name: Name of the modality.
            code: Output of the network (logits for images).

        Returns:
            Poses from `decode_pose` for the modality `pose`, numbers in SI units for a measurement
            (`dataset.Measurement`) that is a vector, and images in [0, 1] for all other modalities.
        """
        if name == "pose":
            return self.decode_pose(code)
        scale = dict(self.scales).get(name)
        return jax.nn.sigmoid(code) if scale is None else code * scale

    def touched(self, tactile: Float[Array, "*n h w 3"], blank: Float[Array, "h w 3"]) -> Bool[Array, "*n"]:
        """Find the tactile images that show a contact.

        Args:
            tactile: Tactile images in [0, 1].
            blank: Tactile image of the empty sensor in [0, 1].

        Returns:
            True for images in which at least `touch_blocks` blocks differ from the blank image. A block is a square
            with a side of `touch_block` pixels. The change of a block is its mean colour minus the mean colour of the
            same block in the blank image. If `touch_level` is True, the median change of all blocks of the image is
            subtracted from each change, separately for each channel. A block differs if the magnitude of its change
            exceeds `touch_threshold` in any channel. If `mask_blank_touch` is False, the result is True for all images.
        """
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
    """Adapt the contact test `Preprocessing.touched` to the noise of a camera's images.

    In the adapted test, an image shows a contact if at least three blocks of 2 x 2 pixels differ from the blank image
    by more than a threshold. The threshold is six times the standard deviation of the noise in the mean of a block, but
    at least 3/255 and at most 24/255.

    The estimate of the standard deviation uses the differences between the block means of the images and of the blank
    image. The median is subtracted from the differences of each channel of an image, so a uniform change of the light
    has no effect. The estimate is 1.4826 times the median magnitude of the differences after this subtraction. Contacts
    on less than half of the pad hardly change the estimate. If the light has changed unevenly since the blank image
    was taken, the estimate is larger.

    Args:
        preprocessing: Preprocessing whose fields are kept, except the four fields of the contact test.
        tactile: Images of the empty pad, or of contacts on less than half of the pad.
        blank: Tactile image of the empty sensor, a mean over many frames.

    Returns:
        The preprocessing with new values of `touch_threshold`, `touch_block`, `touch_blocks` and `touch_level`.

    Raises:
        ValueError: `tactile` has no images, or the images have another resolution than the preprocessing.
    """
    shape = (*preprocessing.resolution, 3)
    if tactile.shape[1:] != shape or blank.shape != shape or not len(tactile):
        raise ValueError(
            f"tactile has shape {tactile.shape} and blank has shape {blank.shape}, but tactile must have shape (n, "
            f"{', '.join(map(str, shape))}) with n >= 1, and blank must have shape {shape}: resize the images to "
            "preprocessing.resolution"
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
    """Means over blocks of `side` x `side` pixels. `images` is a NumPy or JAX array (*n, h, w, 3)."""
    if side == 1:
        return images
    height, width = images.shape[-3] // side, images.shape[-2] // side
    return images.reshape(*images.shape[:-3], height, side, width, side, 3).mean((-4, -2))


def preprocessing_from_json(content: dict) -> Preprocessing:
    """Make a `Preprocessing` from the result of `dataclasses.asdict`, or from the same values read from a JSON file.

    Args:
        content: Values of the fields of a `Preprocessing` by name.

    Returns:
        The preprocessing.

    Raises:
        ValueError: The values do not describe a preprocessing.
    """
    try:
        if "resolution" not in content:  # it has a default value, but every model stores it
            raise ValueError("field preprocessing.resolution is missing")
        return storage.decode(Preprocessing, content, "preprocessing")
    except (TypeError, ValueError) as error:  # TypeError: a value that JSON does not have
        raise ValueError(
            f"the stored preprocessing is not valid ({type(error).__name__}: {error}): train the model with "
            "training.train(..., preprocessing=dataclasses.asdict(p)), where p is a training.Preprocessing. The stored "
            f"preprocessing is {content!r}"
        ) from error
