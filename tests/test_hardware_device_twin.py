"""`STS` against the digital twin. Which light was on is judged by the twin's log, never by the host's label."""

import zlib

import cv2
import jax
import numpy as np
import pytest

import sts_jax as sts
from sts_jax import hardware
from sts_jax.hardware import twin


def checksum(image):
    return zlib.crc32(np.ascontiguousarray(image))


def recorded(path):
    """The checksums of the recorded frames, by their place in the log."""
    _, *parts = path.read_bytes().split(b"\xff\xd8\xff")  # the beginning of a JPEG image
    images = (cv2.imdecode(np.frombuffer(b"\xff\xd8\xff" + part, np.uint8), cv2.IMREAD_COLOR_RGB) for part in parts)
    return {checksum(image): place for place, image in enumerate(images)}


@pytest.mark.slow
@pytest.mark.parametrize("lag_s", [0.015, 0.12])
def test_pairs_of_a_held_and_released_object_are_of_the_right_light(tmp_path, lag_s):
    body = sts.objects.make(jax.random.key(0), "camera")
    scene = twin.ObjectScene(body, resolution=(120, 160))
    made = twin.Twin(
        scene,
        rate=60,
        imperfections=twin.Imperfections(lag_s=lag_s, exposure_s=0.016),
        log=tmp_path / "log.jsonl",
        record=tmp_path / "record.mjpeg",
    )
    with made, twin.Served(made) as served:
        camera = hardware.CameraConfig(served.camera, 160, 120, lock=False, timeout_s=30)
        with hardware.STS(camera=camera, leds=str(served.port)) as sensor:
            shots = []
            for command in ("hold", "release", "hold", "release"):
                made.command(command)
                for _ in range(10):
                    pair = sensor.read()
                    shots += [pair.visual, pair.tactile]
            sensor.wait_until_still(60)
    log, places = twin.read_log(tmp_path / "log.jsonl"), recorded(tmp_path / "record.mjpeg")
    phases = set()
    for shot in shots:
        exposure = log[places[checksum(shot.image)]]
        wanted = 1.0 if shot.stream == "tactile" else 0.0
        assert abs(exposure.lowest - wanted) + abs(exposure.highest - wanted) < 1e-6
        phases.add(exposure.phase)
    assert {"held", "still"} <= phases or {"held", "moving"} <= phases
