"""The digital twin of the sensor: a simulated camera and LED controller that stand in for the real devices."""

from sts_jax.hardware.twin.device import CAMERA as CAMERA
from sts_jax.hardware.twin.device import Exposure as Exposure
from sts_jax.hardware.twin.device import Twin as Twin
from sts_jax.hardware.twin.device import VirtualSensor as VirtualSensor
from sts_jax.hardware.twin.device import read_log as read_log
from sts_jax.hardware.twin.photometry import Blender as Blender
from sts_jax.hardware.twin.photometry import Imperfections as Imperfections
from sts_jax.hardware.twin.photometry import LightHistory as LightHistory
from sts_jax.hardware.twin.scene import ObjectScene as ObjectScene
from sts_jax.hardware.twin.scene import Phase as Phase
from sts_jax.hardware.twin.scene import Picture as Picture
from sts_jax.hardware.twin.scene import Scene as Scene
from sts_jax.hardware.twin.scene import Seen as Seen
from sts_jax.hardware.twin.served import COMMANDS as COMMANDS
from sts_jax.hardware.twin.served import Served as Served
