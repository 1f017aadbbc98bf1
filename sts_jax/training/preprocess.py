"""What happens to a measurement before a network sees it: stored with every checkpoint."""

import dataclasses
import io
import json
import zipfile
from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sts_jax import geometry


@dataclasses.dataclass(frozen=True)
class Preprocessing:
    """The view a model was trained on, its units of pose and condition, and when a touch counts as one."""

    resolution: tuple[int, int] = (64, 64)  # height, width (pixels)
    crop: bool = False  # the square around the object instead of the whole pad
    position_scale: float = 0.05  # m; positions are divided by it, so that they are of the size of a rotation's parts
    # A matrix is a continuous function of the rotation, and what falls, a linear one of the matrix; a quaternion jumps
    # where its sign does (Zhou et al. 2019, "On the Continuity of Rotation Representations in Neural Networks").
    rotation: Literal["matrix", "quaternion"] = "matrix"
    mask_blank_touch: bool = True  # a touch without contact is no input (False: the blank image is fed, as the paper)
    touch_threshold: float = 3 / 255  # a touch is one where a pixel differs from the blank gel by more than this
    absent: tuple[str, ...] = ()  # modalities that no training input ever had
    condition_scale: tuple[float, ...] = ()  # SI; each number of the scenario's condition is divided by its own

    def __post_init__(self) -> None:
        if self.rotation not in ("matrix", "quaternion"):
            raise ValueError(f"rotation={self.rotation!r}; known are 'matrix' and 'quaternion'")

    @property
    def pose_size(self) -> int:
        """Numbers in the code of a pose."""
        return 3 + {"matrix": 9, "quaternion": 4}[self.rotation]

    def encode_pose(self, pose: Float[Array, "*n 7"]) -> Float[Array, "*n code"]:
        """A pose (m, quaternion) as the networks see it: `pose_size` numbers."""
        position, quat = pose[..., :3] / self.position_scale, geometry.quat_canonical(pose[..., 3:])
        if self.rotation == "matrix":
            quat = geometry.quat_to_matrix(quat).reshape(*quat.shape[:-1], 9)
        return jnp.concatenate([position, quat], axis=-1)

    def decode_pose(self, code: Float[Array, "*n code"]) -> Float[Array, "*n 7"]:
        """What a network says as a pose: metres and a unit quaternion with `w >= 0` (identity if it says 0).

        Nine numbers that are no rotation matrix are taken for the nearest one.
        """
        quat = code[..., 3:]
        if self.rotation == "matrix":
            quat = geometry.quat_from_matrix(quat.reshape(*quat.shape[:-1], 3, 3))
        else:
            quat = geometry.quat_canonical(quat)
        said = jnp.any(code[..., 3:] != 0, -1, keepdims=True)
        quat = jnp.where(said, quat, jnp.array([1.0, 0, 0, 0]))
        return jnp.concatenate([code[..., :3] * self.position_scale, quat], axis=-1)

    def encode_condition(self, condition: Float[Array, "*n c"]) -> Float[Array, "*n c"]:
        """A condition (SI units) as the networks see it."""
        return condition / jnp.array(self.condition_scale, jnp.float32)

    def touched(self, tactile: Float[Array, "*n h w 3"], blank: Float[Array, "h w 3"]) -> Bool[Array, "*n"]:
        """Whether a tactile image shows a contact: differs somewhere from the blank gel."""
        if not self.mask_blank_touch:
            return jnp.ones(tactile.shape[:-3], bool)
        return jnp.max(jnp.abs(tactile - blank), axis=(-3, -2, -1)) > self.touch_threshold


def save_blank(folder: Path, visual: np.ndarray, tactile: np.ndarray) -> None:
    """Store what the sensor shows with nothing on it, `uint8 (height, width, 3)` each; once, a second time not."""
    path = folder / "blank.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name("blank.partial.npz")
        np.savez(temporary, visual=visual, tactile=tactile)
        temporary.replace(path)


def load_blank(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """The visual and the tactile image of the empty sensor, `uint8 (height, width, 3)` each.

    Raises:
        FileNotFoundError: The file is missing.
        ValueError: It is torn.
    """
    path = folder / "blank.npz"
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as arrays:
            return arrays["visual"], arrays["tactile"]
    except (zipfile.BadZipFile, KeyError, ValueError, EOFError) as error:
        raise ValueError(
            f"{path} is torn ({error}); delete it and start the training again: it writes it anew."
        ) from error


def preprocessing_from_json(content: dict) -> Preprocessing:
    """The inverse of `dataclasses.asdict`, through JSON."""
    content = json.loads(json.dumps(content))
    content["resolution"] = tuple(content["resolution"])
    content["absent"] = tuple(content["absent"])
    content["condition_scale"] = tuple(content.get("condition_scale", ()))  # older models have no condition
    return Preprocessing(**content)
