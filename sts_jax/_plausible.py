"""Inputs that are in range but probably wrong: images in another channel order, noise, poses of another image.

Each function returns a message, or None for a plausible input. The thresholds were measured on valid images of all
classes and scenarios, of objects of 5 to 150 mm, and of the digital twin. The messages have no numbers, so that Python
shows each of them once for each line of a program.
"""

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from sts_jax.tactile import Gel

_DARK = 0.05  # largest value in a black image
_FLAT = 2 / 255  # largest difference of values in an image of one colour
_ROUGH = 0.04  # least median difference of neighbouring pixels in an image of noise
_SAME = 10 / 255  # largest difference of a pixel that shows the empty sensor
_UNSEEN = 1.5 / 255  # largest difference of the whole image of an empty sensor
_DEVIATIONS = 7.0  # both limits in standard deviations of the noise, if that is larger
_LEAST = 0.1  # least share of pixels that reveals another version of the empty sensor
_FEW = 0.02  # largest share of pixels of the empty sensor in an image of another sensor
# An object may cover the whole view. Then either all pixels have nearly its colour, or it has a texture.
_PLAIN = 0.1  # largest spread of the brightness along the border of an image with a background
_INSIDE = 0.13  # least difference in brightness of an object from this background
_VIVID = 0.3  # least spread of the brightness of an image that no texture explains
# Largest distance of a pose from the middle of the object's outline along x and y, in half sides of the outline, and
_SPREAD = 0.3
_OFF = 0.01  # m, to be added to it
_APART = 0.012  # m, largest distance of a pose from an outline that the image cuts off
_ITEMS = 16  # least number of quaternions that reveals their order
_OUTSIDE = 0.05  # largest distance of a contact from the object in the other image, in sides of the image
_FARTHEST = 1.0  # m, largest coordinate of a pose in `sense`
_OVERLOAD = 3.0  # largest force in multiples of the force that the whole pad bears
_VERSIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "has the channel order BGR: this library needs RGB, image[..., ::-1]": lambda x: x[..., ::-1],
    "is mirrored (left and right): undo it with image[:, ::-1]": lambda x: x[:, ::-1],
    "is mirrored (top and bottom): undo it with image[::-1]": lambda x: x[::-1],
    "is upside down: undo it with np.rot90(image, 2)": lambda x: x[::-1, ::-1],
    "is rotated or mirrored: undo it with np.rot90(image)": lambda x: np.rot90(x, -1),
    "is rotated or mirrored: undo it with np.rot90(image, -1)": np.rot90,
    "is transposed: undo it with np.swapaxes(image, 0, 1)": lambda x: np.swapaxes(x, 0, 1),
}

Image = Float[np.ndarray, "h w 3"]


def image_problem(name: str, image: Image, blank: Image, *, crop: bool = False) -> str | None:
    """Compare an image with that of the empty sensor, both in [0, 1].

    Args:
        name: `visual`, which must show an object, or `tactile`.
        crop: True if the image shows a window around the object, where only colours can be compared.
    """
    step = max(1, min(image.shape[:2]) // 64)
    small, empty, rows = image[::step, ::step], blank[::step, ::step], image[:: 4 * step]
    if small.max() < _DARK:
        return f"{name} is black: is the lens covered, or is it the first image of a camera?"
    if np.median(np.abs(np.diff(rows, axis=1)).max(-1)) > _ROUGH:
        return f"{name} is noise: give images of the sensor."
    noise = _DEVIATIONS * _noise(rows - blank[:: 4 * step])
    margin = max(_SAME, noise)
    if name == "visual" and _unchanged(image - blank, noise):
        return "visual shows no object in view: it equals the model's image of the empty sensor."

    def like(version: Image) -> np.ndarray:
        if not crop:
            return (np.abs(small - version) <= margin).all(-1)
        return ((small >= version.min((0, 1)) - margin) & (small <= version.max((0, 1)) + margin)).all(-1)

    same = like(empty)
    gains = {}  # by how many pixels another version of the empty sensor agrees better
    for problem, change in _VERSIONS.items():
        version = change(empty)
        if version.shape == empty.shape and np.abs(version - empty).max() > margin:
            gains[problem] = like(version).mean() - same.mean()
    best = max(gains, key=gains.__getitem__, default="")
    if best and gains[best] > _LEAST:
        return f"{name} {best}."
    if not crop and same.mean() < _FEW and _foreign(small):
        return (
            f"{name} does not look like this sensor: hardly a pixel agrees with the model's image of the empty sensor. "
            "Is it BGR, or the image of another sensor or of another light?"
        )
    return None


def _unchanged(change: Image, noise: float) -> bool:
    """Whether neither pixels nor blocks of 4 x 4 pixels, in which noise averages out, change by more than the noise."""
    if np.abs(change).max() > max(_UNSEEN, noise):
        return False
    height, width = (side // 4 for side in change.shape[:2])
    blocks = change[: 4 * height, : 4 * width].reshape(height, 4, width, 4, 3).mean((1, 3))
    return bool(np.abs(blocks).max() <= max(_UNSEEN, noise / 4))


def _noise(change: Image) -> float:
    """Standard deviation of the noise, from second differences along rows, which slopes do not have."""
    return float(np.median(np.abs(np.diff(change, n=2, axis=1)))) / (0.6745 * 6**0.5)


def _foreign(image: Image) -> bool:
    """Whether an image without a pixel of the empty sensor is not that of an object that covers the view."""
    grey = image.mean(-1)
    edges = np.concatenate([grey[0], grey[-1], grey[:, 0], grey[:, -1]])
    margin = max(1, min(grey.shape) // 8)
    inside = np.abs(grey[margin:-margin, margin:-margin] - np.median(edges)) > _INSIDE
    one_colour = np.ptp(image, axis=(0, 1)).max() < _FLAT
    on_background = np.ptp(np.quantile(edges, (0.05, 0.95))) < _PLAIN and inside.any()
    return bool(one_colour or on_background or np.ptp(np.quantile(grey, (0.05, 0.95))) > _VIVID)


def pair_problem(visual: Image, tactile: Image, blank: dict[str, Image]) -> str | None:
    """Compare where two images of the whole pad differ from the empty sensor. An object is seen where it presses."""
    boxes = []
    for image, empty in ((visual, blank["visual"]), (tactile, blank["tactile"])):
        change = image - empty
        change -= np.median(change, axis=(0, 1))  # of all light
        y, x = np.nonzero((np.abs(change) > max(_SAME, _DEVIATIONS * _noise(change))).any(-1))
        if not x.size:
            return None
        boxes.append(np.array([x.min(), y.min(), -1 - x.max(), -1 - y.max()]) / len(image))
    if (boxes[0] - boxes[1]).max() > _OUTSIDE:
        return "tactile has a contact where visual has no object: do they belong together, and is none mirrored?"
    return None


def pose_problem(image: Image, blank: Image, pose: np.ndarray, distance: float, view: float) -> str | None:
    """Compare the position of a pose with the pixels of a visual image that differ from the empty sensor's.

    The origin of the mesh frame lies in the object's convex hull, so that it is seen within the object's outline.

    Args:
        pose: (7,).
        distance: Distance from the pinhole to the gel's outer face (m).
        view: Side of the square of the outer face that the image shows (m).
    """
    changed = (np.abs(image - blank) > _SAME).any(-1)
    if not changed.any():
        return None
    size, (y, x) = len(image), np.nonzero(changed)
    seen = 0.5 + pose[:2] * distance / max(distance + pose[2], 0.2 * distance) / view  # shares of the image
    first, last = np.array([x.min(), y.min()]) / size, np.array([x.max() + 1, y.max() + 1]) / size
    beside = np.maximum(first - np.clip(seen, 0, 1), np.clip(seen, 0, 1) - last).max() * view > _APART
    middles = np.array([[x.mean() + 0.5, y.mean() + 0.5], (first + last) / 2 * size]) / size
    off = np.abs(seen - middles).min(axis=0) - _SPREAD * (last - first) / 2
    if beside or (off[(first > 0) & (last < 1)] * view > _OFF).any():
        return (
            "pose is not that of the object in visual: it lies beside it. Do they belong together? A pose is x, y, z "
            "(m, sensor frame) and a quaternion in the order w, x, y, z, and an image must not be mirrored."
        )
    return None


def placement_problem(
    pose: Float[np.ndarray, "7"],
    wrench: Float[np.ndarray, "6"] | None,
    points: Float[np.ndarray, "v 3"],
    view: Float[np.ndarray, "2"],
    distance: float,
    gel: Gel,
) -> str | None:
    """Examine the pose and the wrench of an object on the sensor, see `sense`.

    Args:
        points: Vertices of the object's collision hulls in the mesh frame (m).
        view: Half the width and half the height of the part of the gel's outer face that the camera sees (m).
        distance: Distance from the pinhole to the gel's outer face (m).
    """
    x, y, z, *quat = pose.tolist()  # floats are faster than small arrays
    if not all(map(math.isfinite, (x, y, z, *quat))):
        return "pose has NaN or infinite numbers: the images show the empty sensor."
    if max(abs(x), abs(y), abs(z)) > _FARTHEST:
        return f"pose has a coordinate beyond {_FARTHEST:g} m: give the position in metres, not in millimetres."
    if not any(quat):
        return "pose has a quaternion of length 0: give a position (m) and a unit quaternion w, x, y, z."
    width, height = map(float, gel.size)
    if wrench is not None:
        numbers = [abs(number) for number in wrench.tolist()]
        if not all(map(math.isfinite, numbers)):
            return "wrench has NaN or infinite numbers: the images show the empty sensor."
        most = _OVERLOAD * float(gel.stiffness) * float(gel.max_depth) * width * height
        if max(numbers[:3]) > most or max(numbers[3:]) > most * max(width, height) / 2:
            return "wrench is far beyond what the pad bears: give the force in N and the moment in N m."
    if z == -_FARTHEST:  # the way to draw the empty sensor
        return None
    placed = Rotation.from_quat(pose[[4, 5, 6, 3]]).as_matrix() @ points.T + pose[:3, None]
    right, down = view / distance
    planes = np.array([[1, 0, -right], [-1, 0, -right], [0, 1, -down], [0, -1, -down], [0, 0, -1]])  # of the view
    if ((planes @ placed).min(axis=1) > (*view.repeat(2), 0)).any():
        return "pose puts the object out of the camera's view: give its position (m) in the sensor frame, z upwards."
    if (placed[2].min() + placed[2].max()) / 2 < -float(gel.thickness) and abs(x) < width / 2 and abs(y) < height / 2:
        return (
            "pose puts the object below the pad: is the quaternion in the order w, x, y, z, and the position that of "
            "the mesh frame in the sensor frame (m)?"
        )
    return None


def order_problem(quats: Float[np.ndarray, "n 4"]) -> str | None:
    """Find quaternions in the order x, y, z, w: only the last number of all of them has the same sign."""
    mixed = [(quats[:, k] > 0).any() and (quats[:, k] < 0).any() for k in range(4)]
    if len(quats) >= _ITEMS and mixed == [True, True, True, False]:
        return "pose seems to have quaternions in the order x, y, z, w: this library needs w, x, y, z."
    return None
