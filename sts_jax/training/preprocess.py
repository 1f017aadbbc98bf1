"""Encoding of images, poses and conditions for the networks, and a contact test for tactile images."""

import dataclasses
import functools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from sts_jax import geometry, storage
from sts_jax._checked import checked

# The contact test of noisy images has the same values as that of the collection of recordings (`hardware.GuideConfig`).
_NOISY_BLOCK = 2  # pixels, side of a block
_NOISY_BLOCKS = 3  # least number of blocks that differ
_DEVIATIONS = 6.0  # threshold in standard deviations of a block's mean
_SMALLEST, _LARGEST = 3.0, 24.0  # limits of the threshold, in steps of 1/255
_NORMAL = 1.4826  # standard deviation of a normal distribution divided by its median absolute deviation


@dataclasses.dataclass(frozen=True)
class Preprocessing:
    """The encoding of images, poses and conditions for a model, and its contact test, as `config.json` stores it."""

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
    # number of frames from the input to the target of a one-step model (None: the target is the last frame)
    stride: int | None = None
    period: float = 0.0  # s, time from the input to the target of a one-step model

    def __post_init__(self) -> None:
        if self.rotation not in ("matrix", "quaternion"):
            raise ValueError(f"rotation must be 'matrix' or 'quaternion', got {self.rotation!r}")
        if self.touch_block < 1 or any(side % self.touch_block for side in self.resolution):
            raise ValueError(f"touch_block must divide resolution {self.resolution}, got {self.touch_block}")
        valid = self.period == 0 if self.stride is None else self.stride >= 1 and 0 < self.period < np.inf
        if not valid:
            raise ValueError(
                f"stride={self.stride} and period={self.period}: give a stride >= 1 with a period > 0 (s) for a "
                "one-step model, or neither"
            )

    @property
    def pose_size(self) -> int:
        """Number of values in an encoded pose: 12 with a rotation matrix, 7 with a quaternion."""
        return 3 + {"matrix": 9, "quaternion": 4}[self.rotation]

    @functools.partial(jax.jit, static_argnums=0)
    def encode_pose(self, pose: Float[Array, "*n 7"]) -> Float[Array, "*n code"]:
        """Encode poses for the networks: positions divided by `position_scale`, and rotations.

        A rotation is the nine entries of its matrix row by row, or a unit quaternion with `w >= 0`, see `rotation`.
        """
        position, quat = pose[..., :3] / self.position_scale, geometry.quat_canonical(pose[..., 3:])
        if self.rotation == "matrix":
            quat = geometry.quat_to_matrix(quat).reshape(*quat.shape[:-1], 9)
        return jnp.concatenate([position, quat], axis=-1)

    @functools.partial(jax.jit, static_argnums=0)
    def decode_pose(self, code: Float[Array, "*n code"]) -> Float[Array, "*n 7"]:
        """Decode poses from the output of a network: the inverse of `encode_pose`.

        The result has the nearest rotation to the code, or the identity if all numbers of the rotation are 0.
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
        """Divide conditions (SI units) by their typical sizes `condition_scale`."""
        if condition.shape[-1] != len(self.condition_scale):
            raise ValueError(
                f"the condition has {condition.shape[-1]} numbers, but condition_scale={self.condition_scale} has "
                f"{len(self.condition_scale)}: make the preprocessing with scenario.condition_scale"
            )
        return condition / jnp.array(self.condition_scale, jnp.float32)

    def encode(self, name: str, values: Float[Array, "..."]) -> Float[Array, "..."]:
        """Encode poses, images in [0, 1] or the values of a measurement (SI units). Images are returned unchanged."""
        if name == "pose":
            return self.encode_pose(values)
        scale = dict(self.scales).get(name)
        return values if scale is None else values / scale

    def decode(self, name: str, code: Float[Array, "..."]) -> Float[Array, "..."]:
        """Decode the output of an `mvae` network: the inverse of `encode`, where images are logits."""
        if name == "pose":
            return self.decode_pose(code)
        scale = dict(self.scales).get(name)
        return jax.nn.sigmoid(code) if scale is None else code * scale

    def touched(self, tactile: Float[Array, "*n h w 3"], blank: Float[Array, "h w 3"]) -> Bool[Array, "*n"]:
        """Find the tactile images in [0, 1] that show a contact. If `mask_blank_touch` is False, all do.

        The change of a block of `touch_block` x `touch_block` pixels is its mean colour minus that of the same block in
        the blank image, and minus the median change of all blocks if `touch_level` is True. An image shows a contact if
        the change of at least `touch_blocks` blocks exceeds `touch_threshold` in any channel.
        """
        if not self.mask_blank_touch:
            return jnp.ones(tactile.shape[:-3], bool)
        change = _block_means(tactile - blank, self.touch_block)
        if self.touch_level:
            change = change - jnp.median(change, axis=(-3, -2), keepdims=True)
        differs = jnp.any(jnp.abs(change) > self.touch_threshold, axis=-1)
        return jnp.sum(differs, axis=(-2, -1)) >= self.touch_blocks

    @classmethod
    def from_json(cls, content: Any) -> "Preprocessing":
        """Make a preprocessing from the JSON values of `dataclasses.asdict`."""
        if (
            not isinstance(content, dict) or "resolution" not in content
        ):  # it has a default value, but every model stores it
            raise ValueError(f"field preprocessing.resolution is missing, got {content!r}")
        return storage.decode(cls, content, "preprocessing")


@checked
def touch_of_noisy_images(
    preprocessing: Preprocessing, tactile: UInt8[np.ndarray, "n h w 3"], blank: UInt8[np.ndarray, "h w 3"]
) -> Preprocessing:
    """Adapt the contact test `Preprocessing.touched` to the noise of a camera's images.

    At least three blocks of 2 x 2 pixels must change by more than six standard deviations of the noise in their mean.

    Args:
        preprocessing: Preprocessing whose other fields are kept.
        tactile: Images of the empty pad, or of contacts on less than half of the pad.
        blank: Tactile image of the empty sensor, a mean over many frames.
    """
    if blank.shape[:2] != preprocessing.resolution or not len(tactile):
        raise ValueError(
            f"got {len(tactile)} images of {blank.shape[:2]} pixels: give at least one of {preprocessing.resolution}"
        )
    change = _block_means(tactile.astype(np.float32) - blank, _NOISY_BLOCK)
    change = change - np.median(change, axis=(-3, -2), keepdims=True)
    noise = _NORMAL * float(np.median(np.abs(change)))
    threshold = min(max(_DEVIATIONS * noise, _SMALLEST), _LARGEST) / 255
    return dataclasses.replace(
        preprocessing, touch_threshold=threshold, touch_block=_NOISY_BLOCK, touch_blocks=_NOISY_BLOCKS, touch_level=True
    )


def _block_means(images: Any, side: int) -> Any:
    """Means over blocks of `side` x `side` pixels. `images` is a NumPy or JAX array (*n, h, w, 3)."""
    if side == 1:
        return images
    height, width = images.shape[-3] // side, images.shape[-2] // side
    return images.reshape(*images.shape[:-3], height, side, width, side, 3).mean((-4, -2))
