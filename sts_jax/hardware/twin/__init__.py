"""The digital twin of the sensor: a simulated camera and LED controller that stand in for the real devices."""

from sts_jax.hardware.twin.device import Exposure, State, Twin, TwinFrame, read_log
from sts_jax.hardware.twin.photometry import Blender, Ends, Imperfections, Light, LightHistory
from sts_jax.hardware.twin.scene import ObjectScene, Phase, Picture, Scene, Seen
from sts_jax.hardware.twin.served import Served
from sts_jax.hardware.twin.virtual import CAMERA, Hand, VirtualSensor

__all__ = [
    "CAMERA",
    "Blender",
    "Ends",
    "Exposure",
    "Hand",
    "Imperfections",
    "Light",
    "LightHistory",
    "ObjectScene",
    "Phase",
    "Picture",
    "Scene",
    "Seen",
    "Served",
    "State",
    "Twin",
    "TwinFrame",
    "VirtualSensor",
    "read_log",
]
