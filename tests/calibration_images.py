"""Images of a printed board through a known fisheye lens, computed ray by ray without the library's lens functions."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sts_jax.hardware import Lens

LENS = Lens(
    width=640,
    height=480,
    fx=291.0,
    fy=287.5,
    cx=331.2,
    cy=228.7,
    k=(-0.04, 0.012, -0.007, 0.0012),
    rotation=(0.05, -0.08, 0.03),
    translation=(0.003, -0.004, 0.103),
)
SAMPLES = 3  # per pixel and direction
PIXELS_PER_M = 10_000  # of the print


def camera_rays(lens):
    """Unit vectors of the camera frame for the samples of all pixels. The polynomial is inverted by interpolation."""
    x = (np.arange(lens.width * SAMPLES) + 0.5) / SAMPLES - 0.5
    y = (np.arange(lens.height * SAMPLES) + 0.5) / SAMPLES - 0.5
    x, y = np.meshgrid((x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy)
    distance = np.hypot(x, y)
    angles = np.linspace(0, 1.55, 20_000)
    angle = np.interp(distance, angles + sum(k * angles ** (3 + 2 * i) for i, k in enumerate(lens.k)), angles)
    ratio = np.sin(angle) / np.maximum(distance, 1e-12)
    return np.stack([ratio * x, ratio * y, np.cos(angle)], axis=-1).astype(np.float32)


def printed(board):
    """The board alone, and its middle in pixel coordinates."""
    width, height = (round(side * PIXELS_PER_M) for side in board.size)
    return board.opencv().generateImage((width, height)), ((width - 1) / 2, (height - 1) / 2)


def board_view(rays, print_, middle, rotation, translation):
    """Render a board whose pose in the camera frame is given by a rotation vector and the position of its centre."""
    matrix = Rotation.from_rotvec(rotation).as_matrix().astype(np.float32)
    local, origin = rays @ matrix, (-np.asarray(translation) @ matrix).astype(np.float32)
    depth = -origin[2] / np.where(np.abs(local[..., 2]) > 1e-6, local[..., 2], 1e-6)
    x = (origin[0] + depth * local[..., 0]) * PIXELS_PER_M + middle[0]
    y = (origin[1] + depth * local[..., 1]) * PIXELS_PER_M + middle[1]
    x[depth < 0] = -1e4
    x, y = (np.clip(c, -1e4, 3e4).astype(np.float32) for c in (x, y))
    paper = np.pad(print_, 60, constant_values=255)
    picture = cv2.remap(paper, x + 60, y + 60, cv2.INTER_AREA, borderMode=cv2.BORDER_CONSTANT, borderValue=90)
    shape = rays.shape[1] // SAMPLES, rays.shape[0] // SAMPLES
    return cv2.resize(picture, shape, interpolation=cv2.INTER_AREA)


def degraded(image, rng, *, blur=0.7, noise=3.0):
    """Blur an image (standard deviation in pixels), lower its contrast, add noise (standard deviation of 255)."""
    picture = cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur) * 0.7 + 20
    return (picture + noise * rng.standard_normal(image.shape)).clip(0, 255).round().astype(np.uint8)
