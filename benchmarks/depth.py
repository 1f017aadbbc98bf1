"""Accuracy of rendered depth compared with embree's ray tracing: ten objects in ten poses each, at four image sizes.

    python -m benchmarks.depth    # about two minutes on two CPU cores

Four objects are procedural, four are loaded from miniworld's meshes (Apache 2.0), one is a concave bowl and one a thin
sheet. A pixel is interior if the rays of its 3x3 neighbourhood all hit the object and the depths of these rays differ
by less than 1 mm. `tests/test_frame_depth.py` tests some of these cases.
"""

import dataclasses
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
import tyro

import sts_jax as sts
from benchmarks.instruments.truth import body_mesh, embree, interior, neighbours, public_meshes
from sts_jax import geometry, objects

SIZES = ((64, 64), (97, 53), (200, 200), (480, 640))
PROCEDURAL = ("fork", "scissors", "watch", "camera")
LOADED = ("potion", "key", "office_chair", "duckie")
MADE = ("bowl", "sheet")
POSES = ("touching", "above", "out of view")
NUM_POSES = (4, 3, 3)


class Difference(NamedTuple):
    """Pixel counts and the largest interior error from the comparison of a depth image with embree's depth image."""

    interior: int
    interior_beyond_10um: int
    interior_beyond_100um: int
    elsewhere: int  # on the object in both images
    elsewhere_beyond_1mm: int
    silhouette: int  # with a 3x3 neighbourhood that embree hits in part
    silhouette_differs: int  # on the object in one of the images only
    strays: int  # of `silhouette_differs`, with a 3x3 neighbourhood that embree hits fully or not at all
    worst: float  # m, largest error in the interior


def make(name: str) -> objects.Body:
    """Make the object with the given name, one of the ten objects of this benchmark. They are 50 to 130 mm long."""
    if name in PROCEDURAL:
        return objects.make(jax.random.key(5), name)
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder:
        warnings.simplefilter("ignore")  # open meshes and missing materials
        if name in LOADED:
            meshes = public_meshes()
            body = objects.load(meshes / f"{name}.obj", longest_side=0.08, up="y")
            return dataclasses.replace(body, texture=jnp.ones((1, 1, 3)))
        if name == "bowl":
            profile = [(0.0, 0.0), (20, 0), (36, 12), (40, 30), (38, 30), (34, 13), (19, 2), (0, 2)]
            mesh = trimesh.creation.revolve(np.array(profile) * 1e-3, sections=48)
        else:  # a bent sheet without thickness
            x, y = np.meshgrid(np.linspace(-0.04, 0.04, 17), np.linspace(-0.03, 0.03, 13))
            k = (np.arange(12)[:, None] * 17 + np.arange(16)).ravel()
            faces = np.concatenate([np.stack([k, k + 1, k + 18], 1), np.stack([k, k + 18, k + 17], 1)])
            mesh = trimesh.Trimesh(np.stack([x, y, 8 * x**2 - 5 * y**2], -1).reshape(-1, 3), faces, process=False)
        path = Path(folder) / f"{name}.ply"
        mesh.export(path)
        return objects.load(path, mass=0.1, hollow=False)


def places(body: objects.Body, rng: np.random.Generator, kind: str) -> tuple[jax.Array, jax.Array]:
    """Sample a random pose of an object, and compute the wrench of the pad on the object."""
    quat = rng.normal(size=4)
    quat /= np.linalg.norm(quat)
    points = np.asarray(geometry.transform(jnp.asarray([0, 0, 0, *quat], jnp.float32), body.vertices))
    low = -points[:, 2].min()
    if kind == "touching":
        x, y, z = *rng.uniform(-0.03, 0.03, 2), low + rng.uniform(-3e-4, 0)
    elif kind == "above":
        x, y, z = *rng.uniform(-0.03, 0.03, 2), low + rng.uniform(0.001, 0.08)
    else:
        x, y = rng.permutation([rng.choice([-1, 1]) * rng.uniform(0.06, 0.09), rng.uniform(-0.05, 0.05)])
        # At least 5 mm of the object are above the pad's face, because objects wholly below it have fallen off.
        z = max(low + rng.uniform(-0.03, 0.02), 0.005 - points[:, 2].max())
    force = float(kind == "touching")
    lowest = points[points[:, 2].argmin()]
    wrench = [0, 0, force, (y + lowest[1]) * force, -(x + lowest[0]) * force, 0]
    return jnp.asarray([x, y, z, *quat], jnp.float32), jnp.asarray(wrench, jnp.float32)


def cases(body: objects.Body, seed: int, numbers: Sequence[int] = NUM_POSES) -> Iterator[tuple[jax.Array, jax.Array]]:
    """Sample random poses of an object, and compute the wrench of the pad on the object in each pose."""
    rng = np.random.default_rng(seed)
    for kind, number in zip(POSES, numbers, strict=True):
        for _ in range(number):
            yield places(body, rng, kind)


def difference(depth: np.ndarray, truth: np.ndarray) -> Difference:
    """Compare a depth image with the depth image of the ray tracer Embree."""
    seen, hit = np.isfinite(depth), np.isfinite(truth)
    inner = interior(truth)
    other = hit & seen & ~inner
    error = np.abs(np.where(hit & seen, depth, 1e9) - np.where(hit & seen, truth, 1e9))
    error[hit != seen] = np.inf
    around = neighbours(hit)
    boundary = np.any(around, 0) & ~np.all(around, 0)
    return Difference(
        interior=int(inner.sum()),
        interior_beyond_10um=int((error[inner] > 1e-5).sum()),
        interior_beyond_100um=int((error[inner] > 1e-4).sum()),
        elsewhere=int(other.sum()),
        elsewhere_beyond_1mm=int((error[other] > 1e-3).sum()),
        silhouette=int(boundary.sum()),
        silhouette_differs=int((seen != hit).sum()),
        strays=int(((seen != hit) & ~boundary).sum()),
        worst=float(error[inner].max(initial=0)),
    )


def total(differences: Sequence[Difference]) -> Difference:
    """Combine the results of `difference` for several images."""
    added = {name: sum(getattr(d, name) for d in differences) for name in Difference._fields if name != "worst"}
    return Difference(**added, worst=max(d.worst for d in differences))


def measure(
    names: Sequence[str], shape: tuple[int, int], numbers: Sequence[int] = NUM_POSES, *, first_seed: int = 0
) -> dict[str, Difference]:
    """Compare the depth in rendered frames with the depth that the ray tracer embree computes."""
    sensor = sts.Sensor()
    sense = jax.jit(lambda *inputs: sts.sense(sensor, *inputs, resolution=shape))
    found = {}
    for name in names:
        body = make(name)
        rows = []
        for pose, wrench in cases(body, first_seed + len(name), numbers):
            frame = sense(body, pose, wrench)
            two_sided = bool(body.two_sided)
            truth = embree(body_mesh(body, frame.pose), sensor.camera, shape, two_sided=two_sided)
            rows.append(difference(np.asarray(frame.depth, float), truth))
        found[name] = total(rows)
    return found


def describe(d: Difference) -> str:
    """Format the depth errors of rendered images as a row of the table. The reference is the ray tracer embree."""
    rest = max(d.elsewhere, 1)
    return (
        f"{d.interior:9} {100 * (1 - d.interior_beyond_10um / max(d.interior, 1)):9.4f} {d.interior_beyond_100um:7} "
        f"{1e6 * d.worst:9.2f} {d.elsewhere:9} {100 * (1 - d.elsewhere_beyond_1mm / rest):8.3f} "
        f"{d.silhouette:9} {d.silhouette_differs:8} {d.strays:7}"
    )


def main() -> None:
    """Print how far rendered depths differ from the depths of embree's ray tracing."""
    print(f"{'':28} interior  % <10 um  >100um  worst um elsewhere  % <1 mm silhouette  differs  strays")
    for shape in SIZES:
        found = measure(PROCEDURAL + LOADED + MADE, shape)
        for name, d in (found | {"all": total(list(found.values()))}).items():
            print(f"{shape[1]:4}x{shape[0]:<4} {name:17} {describe(d)}", flush=True)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
