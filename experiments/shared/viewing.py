"""A trajectory of a dataset for the viewer of rerun (`write_rrd`)."""

import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from experiments.shared.drawing import make_folder
from experiments.shared.inspecting import collection_of, sensor_of
from sts_jax import dataset, objects, optics
from sts_jax.sensor import Sensor
from sts_jax.storage import write_whole


def check_installed() -> None:
    """Raise an ImportError with the remedy if the package `rerun-sdk` is missing."""
    try:
        import rerun  # noqa: F401
    except ImportError as error:
        raise ImportError("--rrd needs the package rerun-sdk: pip install -e '.[view]'") from error


def write_rrd(path: Path, data: dataset.Dataset, trajectory: int) -> None:
    """Write both streams, the pose with the object's mesh, and the wrench of a trajectory to a file of rerun.

    The time line `time` has the seconds of the trajectory, and `frame` the numbers of its frames. Images exist for the
    stored frames, and everything else for all frames.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    one = {name: leaf[trajectory] for name, leaf in data.trajectory.items()}
    (body,) = dataset.make_bodies(collection_of(data), np.array([one["body"]]))
    sensor, images = sensor_of(data), data.strip(trajectory)
    stored = np.sort(data.frames[data.frames[:, 0] == trajectory, 1]).tolist()
    layout = rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial2DView(origin="visual", name="visual: light off"),
                rrb.Spatial2DView(origin="tactile", name="tactile: light on"),
            ),
            rrb.Vertical(
                rrb.Spatial3DView(origin="pad", name="pose"),
                rrb.TimeSeriesView(origin="force", name="force (N)"),
                rrb.TimeSeriesView(origin="moment", name="moment (N m)"),
                row_shares=[2, 1, 1],
            ),
        ),
        collapse_panels=True,
    )
    make_folder(path.parent)

    def write(temporary: Path) -> None:
        with rr.RecordingStream("sts_jax", recording_id=f"{data.identity[:16]}-{trajectory}") as stream:
            stream.save(temporary, default_blueprint=layout)
            _log_scene(stream, body, sensor)
            for frame, time in enumerate(one["time"].tolist()):
                stream.set_time("frame", sequence=frame)
                stream.set_time("time", duration=time)
                if frame in stored:
                    for name in ("visual", "tactile"):
                        stream.log(name, _png(getattr(images, name)[stored.index(frame)]))
                position, quat = one["pose"][frame, :3], one["pose"][frame, [4, 5, 6, 3]]
                stream.log("pad/object", rr.Transform3D(translation=position, quaternion=quat))
                for kind, part in (("force", slice(3)), ("moment", slice(3, 6))):
                    for axis, value in zip("xyz", one["wrench"][frame, part].tolist(), strict=True):
                        stream.log(f"{kind}/{axis}", rr.Scalars(value))
            stream.flush()

    write_whole(path, write)


def _png(image: np.ndarray) -> Any:
    """An image of rerun, compressed without loss."""
    import rerun as rr

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG")
    return rr.EncodedImage(contents=buffer.getvalue(), media_type="image/png")


def _log_scene(stream: Any, body: objects.Body, sensor: Sensor) -> None:
    """Log what does not change: the object's mesh, and the pad as a box below z = 0."""
    import rerun as rr

    corners = np.asarray(body.faces)
    colors = np.asarray(optics.to_srgb(body.colors)) * 255
    mesh = rr.Mesh3D(
        vertex_positions=np.asarray(body.vertices)[corners].reshape(-1, 3),
        vertex_normals=np.asarray(body.normals).reshape(-1, 3),
        vertex_colors=colors.reshape(-1, 3).astype(np.uint8),
        triangle_indices=np.arange(corners.size).reshape(-1, 3),
    )
    stream.log("pad/object/mesh", mesh, static=True)
    x, y, z = *np.asarray(sensor.gel.size), float(sensor.gel.thickness)
    stream.log("pad/skin", rr.Boxes3D(half_sizes=[[x / 2, y / 2, z / 2]], centers=[[0, 0, -z / 2]]), static=True)
