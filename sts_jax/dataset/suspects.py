"""Suspicious frames of a dataset, which a person should look at: `find_suspects`."""

import hashlib
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sts_jax.dataset.loading import Dataset
from sts_jax.dataset.records import Images
from sts_jax.sensor import Sensor

DARK = 16  # brightest value of a black image, of 255
CLIPPED = 0.1  # least share of the pixels of a clipped image that have the value 255 in some channel
UNCHANGED = 2  # largest difference of a blank touch from the untouched skin, of 255
FELT = 0.05  # N, least force that must leave an imprint
EDGE = 0.005  # m, an object that leans on this border of the pad's face hangs over the pad's edge and may leave none
MOVED = 0.005  # m, identical images of a trajectory are suspicious if the object has moved farther
MOST = 64  # frames without contact that are compared
BATCH = 2**26  # bytes of images that are in memory at a time

KINDS = {
    "black": f"no pixel of an image is brighter than {DARK} of 255",
    "clipped": f"more than {CLIPPED:.0%} of an image's pixels are saturated (255)",
    "blank touch": f"the pad pushes up with at least {FELT:g} N, but the tactile image shows the untouched skin",
    "unseen": "the object touches the pad, but the visual image does not show it",
    "duplicate": "an image is identical to one of another trajectory, or of another place of the object",
}


class Suspect(NamedTuple):
    """A frame that looks faulty."""

    kind: str  # one of KINDS
    trajectory: int  # index of the trajectory in the dataset
    frame: int  # index of the frame in the trajectory
    row: int  # index into `Dataset.frames`
    reason: str  # what was found, in words


def find_suspects(
    data: Dataset,
    sensor: Sensor,
    untouched: np.ndarray | None,
    *,
    rows: np.ndarray | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[Suspect]:
    """Find frames that look faulty, see `KINDS`. All images are read once.

    Args:
        sensor: Sensor of the dataset, whose `gel.size` is the size of the pad.
        untouched: Tactile image of the untouched pad, uint8 `(height, width, 3)`, such as from `find_untouched` or
            `empty_frame`. None: blank touches are not searched.
        rows: Indices into `data.frames` of the frames to examine, int `(n,)`. None: all.
        progress: Called with the number of examined frames.

    Returns:
        The suspects, ordered by kind, trajectory and frame.
    """
    rows = np.arange(len(data.frames)) if rows is None else np.sort(rows)
    found: list[Suspect] = []
    size = max(1, BATCH // (6 * int(np.prod(data.collection["resolution"]))))
    hashes: dict[str, dict[bytes, list[int]]] = {"visual": {}, "tactile": {}}
    opened: dict = {}
    for start in range(0, len(rows), size):
        some = rows[start : start + size]
        images = data.images(some, opened=opened)
        trajectory, frame = data.frames[some].T
        wrench, contact = (data.trajectory[name][trajectory, frame] for name in ("wrench", "contact"))
        force = np.linalg.norm(wrench[:, :3], axis=-1)
        touched = contact & (force >= FELT)
        pressed = contact & (wrench[:, 2] >= FELT)
        # The centre of pressure is (-My, Mx) / Fz.
        inside = np.array(sensor.gel.size) / 2 - EDGE
        pressed &= (np.abs(wrench[:, [4, 3]]) <= inside * wrench[:, 2:3]).all(1)
        seen = np.asarray(images.segmentation.any((1, 2)))
        blank = np.zeros(len(some), bool)
        if untouched is not None:
            difference = np.maximum(images.tactile, untouched) - np.minimum(images.tactile, untouched)
            blank = difference.max((1, 2, 3)) <= UNCHANGED
        for i, row in enumerate(some.tolist()):
            reasons = _of_frame(images, i)
            if pressed[i] and blank[i]:
                reasons.append(("blank touch", f"no imprint at {wrench[i, 2]:.2f} N"))
            if touched[i] and not seen[i]:
                reasons.append(("unseen", f"no pixel shows the object, which presses with {force[i]:.2f} N"))
            found += [Suspect(kind, int(trajectory[i]), int(frame[i]), row, reason) for kind, reason in reasons]
            for stream, shows in (("visual", seen[i]), ("tactile", touched[i] and not blank[i])):
                if shows:
                    key = hashlib.blake2b(getattr(images, stream)[i].tobytes(), digest_size=16).digest()
                    hashes[stream].setdefault(key, []).append(row)
        if progress is not None:
            progress(start + len(some))
    found += _duplicates(data, hashes)
    return sorted(found, key=lambda one: (list(KINDS).index(one.kind), one.trajectory, one.frame))


def find_untouched(data: Dataset) -> np.ndarray | None:
    """The tactile image of the untouched pad, uint8 `(height, width, 3)`, as most frames without contact show it.

    None if each stored frame has contact, or if frames without contact differ, as cropped ones of some sensors.
    """
    trajectory, frame = data.frames.T
    free = np.flatnonzero(~data.trajectory["contact"][trajectory, frame])[:MOST]
    if not len(free):
        return None
    images, counts = np.unique(data.images(free).tactile, axis=0, return_counts=True)
    untouched: np.ndarray = images[counts.argmax()]
    return untouched if counts.max() > len(free) / 2 else None


def _of_frame(images: Images, index: int) -> list[tuple[str, str]]:
    """The kinds and reasons for which the images of one frame are suspicious by themselves."""
    reasons = []
    for stream in ("visual", "tactile"):
        image = getattr(images, stream)[index]
        if (brightest := int(image.max())) <= DARK:
            reasons.append(("black", f"{stream} image: brightest value {brightest}"))
        if brightest == 255 and (share := float((image == 255).any(-1).mean())) > CLIPPED:
            reasons.append(("clipped", f"{stream} image: {share:.0%} of the pixels are saturated"))
    return reasons


def _duplicates(data: Dataset, hashes: dict[str, dict[bytes, list[int]]]) -> list[Suspect]:
    """Frames with the image of an earlier frame, of another trajectory or of another place of the object."""
    reasons: dict[int, list[str]] = {}
    for stream, groups in hashes.items():
        for first, *others in (rows for rows in groups.values() if len(rows) > 1):
            source, at = data.frames[first]
            for row in others:
                trajectory, frame = data.frames[row]
                position = data.trajectory["pose"][..., :3]
                far = np.linalg.norm(position[trajectory, frame] - position[source, at]) > MOVED
                if trajectory != source or far:
                    reasons.setdefault(row, []).append(f"{stream} image of trajectory {source}, frame {at}")
    return [
        Suspect("duplicate", int(data.frames[row, 0]), int(data.frames[row, 1]), row, ", ".join(why))
        for row, why in reasons.items()
    ]
