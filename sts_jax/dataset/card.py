"""The data card of a dataset: a Markdown page in the form of Hugging Face cards, with the figures of the dataset."""

import dataclasses
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import Any

import numpy as np

from sts_jax.dataset.collection import PARTS, Collection, class_names
from sts_jax.physics import Quantity
from sts_jax.physics.roll import SLOW_SPEED, SLOW_TURN
from sts_jax.sensor import Sensor

CARD = "README.md"
_SIZES = {
    10**3: "n<1K",
    10**4: "1K<n<10K",
    10**5: "10K<n<100K",
    10**6: "100K<n<1M",
    10**7: "1M<n<10M",
    10**8: "10M<n<100M",
}


def quantities(
    trajectory: Mapping[str, np.ndarray],
    hidden: Mapping[str, np.ndarray],
    solid: Mapping[str, np.ndarray],
    conditions: Sequence[Quantity] = (),
) -> dict[str, np.ndarray]:
    """Numbers that describe each of n trajectories, float `(n,)` by their names and units.

    Args:
        trajectory: Fields of `physics.Trajectory` by name, each `(n, ...)`, such as `Dataset.trajectory`.
        hidden: Fields of `physics.Hidden` by name, each `(n, ...)`.
        solid: `mass`, `(n,)`.
        conditions: `Scenario.quantities`, to include the numbers of the condition.
    """
    speed, turn = (np.linalg.norm(trajectory["velocity"][..., part], axis=-1) for part in (slice(3), slice(3, 6)))
    moving, time = (speed > SLOW_SPEED) | (turn > SLOW_TURN), trajectory["time"]
    rest = np.minimum(np.where(moving, np.arange(1, time.shape[1] + 1), 0).max(1), time.shape[1] - 1)
    force = np.linalg.norm(trajectory["wrench"][..., :3], axis=-1)
    names = [f"{q.name}{axis} ({q.unit})" for q in conditions for axis in ((" x", " y") if q.vector else ("",))]
    return {
        "mass (kg)": solid["mass"],
        "fill": hidden["fill"],
        "shell mass over its nominal mass": hidden["shell_scale"],
        "friction": hidden["friction"],
        "largest force (N)": force.max(1),
        "force in the last frame (N)": force[:, -1],
        "time until rest (s)": np.take_along_axis(time, rest[:, None], 1)[:, 0],
        "number of touches": trajectory["touches"],
        **dict(zip(names, trajectory["condition"].T, strict=False)),
    }


def card(
    collection: Collection,
    sensor: Sensor,
    split: Mapping[str, np.ndarray],
    tables: Iterable[Mapping[str, np.ndarray]],
    *,
    version: str,
) -> str:
    """Write the data card of a dataset. The same arguments give the same text.

    Args:
        split: Indices of the objects in each part, from `split_objects`.
        tables: The arrays of each shard. Only one shard needs to be in memory.
        version: Version of the library that collects the dataset.
    """
    figures = _Figures(collection, split)
    for table in tables:
        figures.add(table)
    scenario = dataclasses.asdict(collection.scenario)
    name, (height, width) = type(collection.scenario).__name__, collection.resolution
    total = figures.outcomes.total()
    size = next((text for limit, text in _SIZES.items() if total < limit), "100M<n<1B")
    source = _source(collection)
    changed = list(_changes(Sensor().constants(), sensor.constants()))
    lines = [
        "---",
        f"pretty_name: {name} on a See-Through-your-Skin sensor",
        "license: other",
        "license_name: see-the-section-licence",
        "task_categories:\n- robotics",
        "tags:\n- tactile\n- visuotactile\n- simulation\n- see-through-your-skin\n- sts_jax",
        f"size_categories:\n- {size}",
        "viewer: false",
        "---",
        "",
        f"# {name} on a See-Through-your-Skin sensor",
        "",
        f"{total:,} simulated trajectories of {figures.objects:,} objects on a transparent tactile pad, each with "
        f"{collection.scenario.frames} frames at {collection.scenario.rate:g} frames/s. Each stored frame has a visual "
        "image (light off: the view through the skin), a tactile image (light on: the skin itself) and the "
        "segmentation of the object. Poses, velocities and wrenches exist for all frames.",
        "",
        *_table(
            ("", ""),
            [
                ("trajectories", f"{total:,}"),
                ("with images", f"{figures.rendered:,}"),
                ("with images of every frame", f"{figures.full:,}"),
                ("stored frames", f"{figures.frames:,}"),
                ("images", f"{2 * figures.frames + figures.views:,}"),
                ("views (visual images of further poses)", f"{figures.views:,}"),
                ("resolution", f"{height} x {width} pixels, 8 bits"),
                ("region", "square around the object" if collection.crop else "whole pad"),
                ("settled at the end", _share(figures.settled, total)),
                ("draws that were discarded and drawn again", f"{figures.resampled:,}"),
                ("objects that could not be used", f"{figures.left_out:,}"),
            ],
        ),
        "",
        "## Outcomes",
        "",
        *_by_part(figures.outcomes, [collection.scenario.named(int(o)) for o in collection.scenario.outcomes]),
        "",
        "## Classes",
        "",
        *_by_part(figures.classes, list(dict.fromkeys(class_names(collection)))),
        "",
        "The split is by object: no object is in two parts. Its parts have "
        + ", ".join(f"{len(split[part]):,} ({part})" for part in PARTS)
        + " objects.",
        "",
        "## Ranges",
        "",
        *_table(
            ("per trajectory", "least", "mean", "largest"),
            [(key, *(f"{x:.4g}" for x in (low, sum_ / total, high))) for key, (low, sum_, high) in figures.ranges()],
        ),
        "",
        f"An object is at rest while it moves more slowly than {SLOW_SPEED:g} m/s and {SLOW_TURN:g} rad/s. For one "
        "that never rests, the time is that of the last frame. A force is the mean over the interval before a frame.",
        "",
        "## How it was made",
        "",
        f"`sts_jax` {version}, physics engine `{collection.engine}`, seed {collection.seed}. `collection.json` and "
        "`sensor.json` determine every byte of the data.",
        "",
        *_table((f"option of the scenario {name}", "value"), [(f"`{k}`", _value(v)) for k, v in _flat(scenario)]),
        "",
        "The sensor is the library's default one."
        if not changed
        else "The sensor is the library's default one, except for these constants:",
        *(["", *_table(("constant", "value"), [(f"`{k}`", _value(v)) for k, v in changed])] if changed else []),
        "",
        "## Load it",
        "",
        "```python",
        "from sts_jax import dataset",
        "",
        'data = dataset.load("FOLDER")  # verifies all files',
        'pairs = data.pairs(data.members("train"))  # first and last frames: visual, tactile, pose, outcome, ...',
        "images = data.strip(int(data.rendered()[0]))  # all stored images of one trajectory",
        "```",
        "",
        "`python -m experiments.inspect FOLDER` draws the dataset on a page. The page `docs/datasets.md` of `sts_jax` "
        "describes the files, and exports to other formats.",
        "",
        "## Licence",
        "",
        f"The data was generated by `sts_jax`, whose code has the licence Apache-2.0. {source} `sts_jax` puts the data "
        "under no licence: whoever publishes this dataset chooses one and enters it at the top of this page.",
        "",
    ]
    return "\n".join(lines)


class _Figures:
    """Counts and ranges of a dataset, summed over its shards."""

    def __init__(self, collection: Collection, split: Mapping[str, np.ndarray]):
        self._names = np.array(class_names(collection))
        self._outcomes = {int(o): collection.scenario.named(int(o)) for o in collection.scenario.outcomes}
        self._conditions = collection.scenario.quantities
        self._part = np.empty(collection.num_objects, object)
        for part in PARTS:
            self._part[split[part]] = part
        self.outcomes: Counter[tuple[str, str]] = Counter()  # trajectories by part and outcome
        self.classes: Counter[tuple[str, str]] = Counter()  # trajectories by part and class
        self.objects = self.frames = self.views = self.rendered = self.full = 0
        self.settled = self.resampled = self.left_out = 0
        self._ranges: dict[str, tuple[float, float, float]] = {}

    def add(self, table: Mapping[str, np.ndarray]) -> None:
        """Add the trajectories of a shard."""
        groups: dict[str, dict[str, np.ndarray]] = {"trajectory": {}, "hidden": {}, "solid": {}, "view": {}}
        for name, values in table.items():
            if "/" in name:
                group, _, field = name.partition("/")
                groups[group][field] = values
        trajectory, body = groups["trajectory"], groups["trajectory"]["body"]
        part = self._part[body].tolist()
        self.outcomes.update(zip(part, (self._outcomes[n] for n in trajectory["outcome"].tolist()), strict=True))
        self.classes.update(zip(part, self._names[body].tolist(), strict=True))
        stored = np.bincount(table["frames"][:, 0], minlength=len(body))
        self.objects += len(np.unique(body))
        self.frames += len(table["frames"])
        self.views += len(groups["view"]["body"])
        self.rendered += int((stored > 0).sum())
        self.full += int((stored == trajectory["time"].shape[1]).sum())
        self.settled += int(trajectory["settled"].sum())
        self.resampled += int(trajectory["resampled"].sum())
        self.left_out += len(table["left_out"])
        numbers = quantities(trajectory, groups["hidden"], groups["solid"], self._conditions)
        for name, values in numbers.items():
            low, sum_, high = self._ranges.get(name, (np.inf, 0.0, -np.inf))
            values = values.astype(np.float64)
            self._ranges[name] = min(low, values.min()), sum_ + values.sum(), max(high, values.max())

    def ranges(self) -> Iterator[tuple[str, tuple[float, float, float]]]:
        """The least value, the sum and the largest value of each quantity."""
        yield from self._ranges.items()


def _by_part(counts: Counter[tuple[str, str]], names: list[str]) -> list[str]:
    """A table of the counts and shares of some names in each part of the split and in all."""
    rows, sums = [], {part: sum(counts[part, name] for name in names) for part in PARTS}
    for name in names:
        numbers = [counts[part, name] for part in PARTS]
        rows.append((name, *map(_share, numbers, sums.values()), _share(sum(numbers), sum(sums.values()))))
    rows.append(("sum", *(f"{n:,}" for n in sums.values()), f"{sum(sums.values()):,}"))
    return _table(("trajectories", *PARTS, "all"), rows)


def _share(number: int, total: int) -> str:
    return f"{number:,} ({number / max(total, 1):.1%})"


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in (head, ("---",) * len(head), *rows)]


def _source(collection: Collection) -> str:
    """Where the shapes of the objects come from."""
    if collection.meshes is None:
        return "All objects are procedural, and the data contains nothing made by others."
    folder, count = PurePath(collection.meshes.folder).name, len(collection.meshes.names)
    return f"Its images show {count:,} objects from mesh files (folder `{folder}`), whose own licences apply to them."


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The dotted names and the values of nested dictionaries."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """The fields of nested dictionaries that differ, with their new values."""
    before = dict(_flat(old))
    yield from ((name, value) for name, value in _flat(new) if name not in before or before[name] != value)


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list | tuple):
        text = ", ".join(_value(each) for each in value)
        return f"({text})" if len(text) < 80 else f"{len(value)} values"
    return str(value)
