"""Outlines of an object at some poses, as the sensor's camera sees it."""

import functools
import math

import jax
import numpy as np
from jaxtyping import Array
from matplotlib.axes import Axes
from PIL import Image, ImageDraw

from sts_jax import geometry, optics
from sts_jax.objects import Body

MOST = 16  # largest number of poses whose outlines are drawn
COLOUR = "tab:orange"  # of all that is predicted
_WIDTH, _FAINT = 0.5, 0.35  # points, width of an outline, and opacity of one of many
_FINE = 256  # pixels, least height of the picture in which outlines are found
_SAMPLES = 4  # samples along each side of a pixel of this picture


def silhouettes(
    camera: optics.Camera, body: Body, poses: np.ndarray, *, window: Array | np.ndarray, shape: tuple[int, int]
) -> np.ndarray:
    """Pixels that show a body at k poses, as shares of their area, float (k, height, width).

    As in `sense`, a body that is wholly inside the sensor (z < 0), or at a pose that is not finite, is not drawn.

    Args:
        poses: Mesh frame in the sensor frame, (k, 7): position (m) and quaternion.
        window: Part of the gel's outer face that the image shows (m), such as `Frame.window`.
        shape: Height and width of the image (pixels).
    """
    fine, faces = (_SAMPLES * shape[0], _SAMPLES * shape[1]), np.unique(np.asarray(body.faces), axis=0)
    masks = np.zeros((len(poses), *shape), np.float32)
    for mask, pose in zip(masks, poses, strict=True):
        points, pixels, depth = map(np.asarray, _projected(camera, window, fine, body.vertices, pose))
        if not np.isfinite(points).all() or points[:, 2].max() < 0:
            continue
        picture = Image.new("L", fine[::-1])
        draw = ImageDraw.Draw(picture)
        for triangle in pixels[faces[(depth[faces] > camera.near).all(1)]]:
            draw.polygon(np.round(triangle).ravel().tolist(), fill=255)
        mask[:] = np.asarray(picture, np.float32).reshape(shape[0], _SAMPLES, shape[1], _SAMPLES).mean((1, 3)) / 255
    return masks


@functools.partial(jax.jit, static_argnames="shape")
def _projected(
    camera: optics.Camera, window: Array, shape: tuple[int, int], vertices: Array, pose: Array
) -> tuple[Array, Array, Array]:
    """Vertices in the sensor frame, their pixels and their depths."""
    points = geometry.transform(pose, vertices)
    return points, *optics.to_pixels(camera, window, shape, points)


def draw_outlines(
    axis: Axes,
    camera: optics.Camera,
    body: Body,
    poses: np.ndarray,
    *,
    window: Array | np.ndarray,
    shape: tuple[int, int],
) -> None:
    """Draw translucent outlines of a body at the first `MOST` of k poses over an image of the sensor.

    Args:
        axis: Axes with the image, drawn by `imshow`.
        shape: Height and width of the image (pixels).

    The other arguments are those of `silhouettes`.
    """
    scale = math.ceil(_FINE / shape[0])
    fine = (scale * shape[0], scale * shape[1])
    masks = silhouettes(camera, body, poses[:MOST], window=window, shape=fine)
    rows, columns = ((np.arange(side) + 0.5) / scale - 0.5 for side in fine)
    limits = axis.axis()
    for mask in masks[masks.any((1, 2))]:
        axis.contourf(columns, rows, mask, [0.5, 2], colors=[COLOUR], alpha=0.4 / len(masks))
        axis.contour(columns, rows, mask, [0.5], colors=[COLOUR], alpha=max(_FAINT, 1 / len(masks)), linewidths=_WIDTH)
    axis.axis(limits)
