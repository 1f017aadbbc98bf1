"""The digital twin of the sensor: a simulated camera and LED controller that stand in for the real devices."""

from sts_jax.hardware.twin.device import Made, State, Twin
from sts_jax.hardware.twin.faults import Fault
from sts_jax.hardware.twin.hand import Hand
from sts_jax.hardware.twin.lights import Light, LightHistory
from sts_jax.hardware.twin.log import Exposure, read_log
from sts_jax.hardware.twin.photometry import Blender, Ends, Imperfections, Warp
from sts_jax.hardware.twin.scene import ObjectScene, Phase, Picture, Scene, Seen
from sts_jax.hardware.twin.server import Served
from sts_jax.hardware.twin.view import lens_warp
from sts_jax.hardware.twin.virtual import CAMERA, VirtualSensor

__all__ = [
    "CAMERA",
    "Blender",
    "Ends",
    "Exposure",
    "Fault",
    "Hand",
    "Imperfections",
    "Light",
    "LightHistory",
    "Made",
    "ObjectScene",
    "Phase",
    "Picture",
    "Scene",
    "Seen",
    "Served",
    "State",
    "Twin",
    "VirtualSensor",
    "Warp",
    "lens_warp",
    "read_log",
]
