"""All constants of one sensor."""

import dataclasses

import jax

from sts_jax.optics import Camera, Room
from sts_jax.tactile import Gel, Lights, Phong


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sensor:
    """An STS sensor; every constant is a field, the defaults are the paper's where it gives one."""

    camera: Camera = dataclasses.field(default_factory=Camera)
    gel: Gel = dataclasses.field(default_factory=Gel)
    lights: Lights = dataclasses.field(default_factory=Lights)
    phong: Phong = dataclasses.field(default_factory=Phong)
    room: Room = dataclasses.field(default_factory=Room)
    # images with a shorter side below this (pixels) are sampled at half a pixel's distance and filtered
    fine_below: int = dataclasses.field(default=128, metadata={"static": True})
