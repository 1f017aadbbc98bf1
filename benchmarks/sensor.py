"""Frames per second of `sense` beside embree's depth of the same meshes and poses.

    python -m benchmarks.sensor

Both in turn, medians, and their ratio (ours over embree's): the ratio is what to compare between machines. Embree
gives depth alone, with every ray of an image in one call and its scene built beforehand; `sense` gives the balance of
the gel, both streams, depth and segmentation. About two minutes on two CPU cores.
"""

import functools
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

import sts_jax as sts
from sts_jax import _math, objects, optics

SIZES = ((64, 64), (200, 200), (480, 640))
CATEGORIES = ("bottle", "scissors", "watch")
POSES = 16  # of each object: resting on the pad, turned about the vertical
REPEATS = 7


def resting(body: objects.Body) -> tuple[jax.Array, jax.Array]:
    """Poses on the pad, upright, and the wrenches that carry the weight."""
    mass, com, _ = objects.rigid(body, 0.5, 1.0)
    angles = jnp.linspace(0, 2 * jnp.pi, POSES, endpoint=False)
    low = jnp.min(body.vertices[body.faces.ravel(), 2])
    quats = jax.vmap(lambda a: _math.quat_from_rotvec(jnp.stack([0 * a, 0 * a, a])))(angles)
    poses = jnp.concatenate([jnp.full((POSES, 1), 0.01), jnp.zeros((POSES, 1)), jnp.full((POSES, 1), -low), quats], 1)
    places = jax.vmap(_math.transform)(poses, jnp.broadcast_to(com, (POSES, 3)))
    force = mass * 9.81
    zero = jnp.zeros(POSES)
    return poses, jnp.stack([zero, zero, zero + force, places[:, 1] * force, -places[:, 0] * force, zero], 1)


def embree(body: objects.Body, poses: jax.Array, shape: tuple[int, int]) -> Callable[[], object]:
    """Depth of every pose, scenes and rays made beforehand."""
    camera = sts.Sensor().camera
    faces = np.asarray(body.faces)
    faces = faces[np.any(faces != faces[:, :1], axis=1)]
    scenes = []
    for pose in poses:
        scenes.append(EmbreeScene())
        TriangleMesh(scenes[-1], np.asarray(_math.transform(pose, body.vertices))[faces])
    slopes = np.asarray(jnp.stack(optics.rays(camera, optics.full_window(camera, shape), shape), -1)).reshape(-1, 2)
    directions = np.concatenate([slopes, np.ones((len(slopes), 1), np.float32)], -1)
    origins = np.tile(np.array([[0, 0, -camera.distance]], np.float32), (len(slopes), 1))
    return lambda: [scene.run(origins, directions, query="DISTANCE") for scene in scenes]


def median_seconds(*works: Callable[[], object]) -> list[float]:
    """Median seconds of each, run in turn so that a busy machine slows all alike."""
    seconds = []
    for _ in range(REPEATS + 1):
        row = []
        for work in works:
            start = time.perf_counter()
            jax.block_until_ready(work())
            row.append(time.perf_counter() - start)
        seconds.append(row)
    return [float(s) for s in np.median(seconds[1:], axis=0)]


def frame(body: objects.Body, shape: tuple[int, int], inputs: tuple[jax.Array, jax.Array]) -> sts.Frame:
    """One whole frame."""
    return sts.sense(sts.Sensor(), body, *inputs, resolution=shape)


def main() -> None:
    """Print one row per object and size."""
    print(f"{'object':10} {'faces':>6} {'image':>9} {'embree /s':>10} {'map /s':>8} {'vmap /s':>8} {'ratio':>6}")
    for category in CATEGORIES:
        body = objects.make(jax.random.key(0), category)
        poses, wrenches = resting(body)
        faces = int(jnp.sum(jnp.any(body.faces != body.faces[:, :1], axis=1)))
        for shape in SIZES:
            one = functools.partial(frame, body, shape)
            inputs = (poses, wrenches)
            mapped, batched = jax.jit(functools.partial(jax.lax.map, one)), jax.jit(jax.vmap(one))
            theirs, by_map, by_vmap = median_seconds(
                embree(body, poses, shape), functools.partial(mapped, inputs), functools.partial(batched, inputs)
            )
            ratio = theirs / min(by_map, by_vmap)
            rates = f"{POSES / theirs:10.0f} {POSES / by_map:8.1f} {POSES / by_vmap:8.1f} {ratio:6.2f}"
            print(f"{category:10} {faces:6} {shape[0]:4}x{shape[1]:<4} {rates}", flush=True)


if __name__ == "__main__":
    main()
