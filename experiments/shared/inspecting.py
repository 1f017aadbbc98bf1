"""The page of `experiments.inspect`: counts, ranges, contact sheets, a film and suspicious frames of a dataset."""

import base64
import enum
import html
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from string import Template

import numpy as np
from PIL import Image

from sts_jax import dataset, physics, storage
from sts_jax.sensor import Sensor

PAGE = Path(__file__).with_name("inspect_page.html")
TILE, FILM = 128, 320  # largest sides of an image in a contact sheet and in the film (pixels)
QUALITY = 92  # quality of the pictures (WebP), at which faint imprints survive
SUSPECTS = 24  # largest number of suspects of a kind that are drawn. Others are listed
LISTED = 500  # largest number of suspects of a kind that are listed
POINTS = 400  # largest number of trajectories of an outcome on the map of the pad
BARS = 30  # number of bars in a histogram


class Described:
    """The names of classes and outcomes, and the parts of the split, of the trajectories of a dataset."""

    def __init__(self, data: dataset.Dataset):
        self.collection = collection_of(data)
        kind = getattr(physics, data.collection["scenario"]["name"], None)
        known: Iterable[enum.IntEnum] = physics.Outcome
        self.quantities: tuple[physics.Quantity, ...] = ()
        if is_ours := isinstance(kind, type) and issubclass(kind, physics.Scenario):  # and not a scenario of the user
            known, self.quantities = kind.outcomes, kind.quantities
        names = {int(outcome): outcome.name.lower().replace("_", " ") for outcome in known}
        numbers = data.trajectory["outcome"].tolist()
        if not set(numbers) <= set(names):
            names |= {number: f"outcome {number}" for number in sorted(set(numbers) - set(names))}
        self.outcomes = [names[number] for number in numbers]
        self.outcome_names = [name for name in names.values() if is_ours or name in self.outcomes]
        labels = dataset.class_names(self.collection)
        self.classes = [labels[body] for body in data.trajectory["body"].tolist()]
        self.class_names = list(dict.fromkeys(labels))
        part = np.empty(self.collection.num_objects, object)
        for name, members in data.split.items():
            part[members] = name
        self.parts = part[data.trajectory["body"]].tolist()
        self.part_names = list(data.split)

    def words(self, trajectory: int) -> str:
        """Number, class, outcome and part of a trajectory."""
        return f"#{trajectory} {self.classes[trajectory]}: {self.outcomes[trajectory]} ({self.parts[trajectory]})"


def collection_of(data: dataset.Dataset) -> dataset.Collection:
    """The description of a dataset, with the default scenario."""
    content = data.collection
    meshes = content["meshes"]
    return dataset.Collection(
        categories=tuple(content["categories"]),
        meshes=None if meshes is None else storage.decode(dataset.Meshes, meshes, "meshes"),
        parts=content["parts"],
        num_objects=content["num_objects"],
        resolution=tuple(content["resolution"]),
        crop=content["crop"],
        seed=content["seed"],
    )


def sensor_of(data: dataset.Dataset) -> Sensor:
    """The sensor of a dataset."""
    return Sensor.load(data.shards[0].parent / "sensor.json")


def default_trajectory(data: dataset.Dataset, described: Described) -> int | None:
    """The trajectory of the film: one with all frames and the most informative outcome, or None without images."""
    chosen = data.full_trajectories() if len(data.full_trajectories()) else data.rendered()
    rank = [described.outcome_names.index(described.outcomes[index]) for index in chosen]
    return int(chosen[np.argmin(rank)]) if len(chosen) else None


def page(
    data: dataset.Dataset,
    source: str,
    suspects: Sequence[dataset.Suspect],
    *,
    num: int,
    trajectory: int | None,
    notes: Iterable[str],
) -> str:
    """Draw a dataset on one HTML page, which needs no other file.

    Args:
        source: The name of the dataset on the command line.
        suspects: From `find_suspects`.
        num: Number of trajectories on the contact sheet of each outcome.
        trajectory: Trajectory of the film, None for none.
        notes: What was not examined, one sentence each.
    """
    described = Described(data)
    count, name = len(described.outcomes), data.collection["scenario"]["name"]
    title = f"{name}: {count:,} trajectories"
    body = [
        f"<h1>{html.escape(title)}</h1>",
        f'<p class="from">{html.escape(source)}, identity {data.identity[:16]}</p>',
        _verdict(suspects, notes),
        "<h2>Counts</h2>",
        f'<div class="columns"><div>{_counts(data)}</div><div>{_by_part(described, "outcome")}</div></div>',
        f"<h2>Classes</h2>{_by_part(described, 'class')}",
        f"<h2>Ranges</h2>{_ranges(data, described)}",
        f'<h2>Distributions</h2><div class="charts">{_charts(data, described)}</div>',
        f"<h2>Places on the pad</h2>{_places(data, described)}",
        "<h2>Contact sheets</h2>",
        *_sheets(data, described, num),
    ]
    if trajectory is not None:
        body.append(_film(data, described, trajectory))
    body.append(_suspects(data, described, suspects, source))
    return Template(PAGE.read_text()).substitute(title=html.escape(title), body="\n".join(body))


def _verdict(suspects: Sequence[dataset.Suspect], notes: Iterable[str]) -> str:
    kinds = {kind: sum(one.kind == kind for one in suspects) for kind in dataset.KINDS}
    found = ", ".join(f"{number:,} {kind}" for kind, number in kinds.items() if number)
    text = f'<a href="#suspects">Suspicious frames</a>: {found}.' if found else "No suspicious frames were found."
    return f'<p class="verdict{" bad" if found else ""}">{" ".join([text, *map(html.escape, notes)])}</p>'


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table. The cells are HTML, and may begin with a `<td`."""

    def cell(text: str) -> str:
        return text if text.startswith("<td") else f"<td>{text}</td>"

    top = f"<thead><tr>{''.join(f'<th>{text}</th>' for text in head)}</tr></thead>" if any(head) else ""
    lines = "".join(f"<tr>{''.join(map(cell, row))}</tr>" for row in rows)
    return f'<div class="wide"><table>{top}<tbody>{lines}</tbody></table></div>'


def _counts(data: dataset.Dataset) -> str:
    collection, trajectory = data.collection, data.trajectory
    count, frames = trajectory["time"].shape
    height, width = collection["resolution"]
    rows = [
        ("trajectories", f"{count:,}"),
        ("objects", f"{len(np.unique(trajectory['body'])):,}"),
        *((f"objects for {part}", f"{len(members):,}") for part, members in data.split.items()),
        ("frames per trajectory", f"{frames:,} ({collection['scenario']['rate']:g} per s)"),
        ("trajectories with images", f"{len(data.rendered()):,}"),
        ("with images of every frame", f"{len(data.full_trajectories()):,}"),
        ("stored frames", f"{len(data.frames):,}"),
        ("views", f"{len(data.view['body']):,}"),
        ("resolution", f"{height} x {width}{', cropped' if collection['crop'] else ''}"),
        (
            "settled at the end",
            f"{int(trajectory['settled'].sum()):,} <small>{trajectory['settled'].mean():.1%}</small>",
        ),
        ("drawn again", f"{int(trajectory['resampled'].sum()):,}"),
    ]
    return _table(("", ""), rows)


def _by_part(described: Described, what: str) -> str:
    """A table of the counts and shares of outcomes or classes in each part of the split."""
    values, names = {
        "outcome": (described.outcomes, described.outcome_names),
        "class": (described.classes, described.class_names),
    }[what]
    value, part = np.array(values), np.array(described.parts)
    columns = [part == name for name in described.part_names] + [np.ones(len(part), bool)]

    def cell(here: np.ndarray, name: str) -> str:
        number, share = int((here & (value == name)).sum()), np.mean(value[here] == name) if here.any() else 0.0
        return f'<td class="bar" style="--share:{share:.1%}">{number:,} <small>{share:.1%}</small></td>'

    rows = [(html.escape(name), *(cell(here, name) for here in columns)) for name in names]
    rows.append(("all", *(f"{int(here.sum()):,}" for here in columns)))
    return _table((what, *described.part_names, "all"), rows)


def _numbers(data: dataset.Dataset, described: Described) -> dict[str, np.ndarray]:
    return dataset.quantities(data.trajectory, data.hidden, data.solid, described.quantities)


def _ranges(data: dataset.Dataset, described: Described) -> str:
    rows = []
    for name, values in _numbers(data, described).items():
        points = np.percentile(values, (0, 5, 50, 95, 100))
        rows.append((html.escape(name), *(f"{value:.4g}" for value in (*points, values.mean()))))
    return _table(("per trajectory", "least", "5 %", "median", "95 %", "largest", "mean"), rows)


def _charts(data: dataset.Dataset, described: Described) -> str:
    shown = ("largest force (N)", "force in the last frame (N)", "time until rest (s)", "mass (kg)")
    numbers = _numbers(data, described)
    return "".join(_histogram(name, numbers[name]) for name in shown)


def _histogram(name: str, values: np.ndarray) -> str:
    """A histogram as SVG, whose last bar also has all values beyond the 99th percentile."""
    low, high = float(values.min()), float(np.percentile(values, 99))
    high = high if high > low else low + 1.0
    counts, _ = np.histogram(np.minimum(values, high), BARS, (low, high))
    tallest, width = max(int(counts.max()), 1), 300 / BARS
    bars = "".join(
        f'<rect x="{i * width:.1f}" y="{100 - 100 * n / tallest:.1f}" width="{width - 1:.1f}" '
        f'height="{100 * n / tallest:.1f}"><title>{n}</title></rect>'
        for i, n in enumerate(counts.tolist())
    )
    more = "+" if values.max() > high else ""
    return (
        f'<figure><svg viewBox="0 0 300 118" role="img" aria-label="Histogram of {html.escape(name)}">'
        f'<g fill="var(--accent)">{bars}</g><path d="M0 100.5H300" stroke="var(--line)"/>'
        f'<text x="0" y="114">{low:.3g}</text><text x="150" y="114" text-anchor="middle">{(low + high) / 2:.3g}</text>'
        f'<text x="300" y="114" text-anchor="end">{high:.3g}{more}</text></svg>'
        f"<figcaption>{html.escape(name)}, highest bar {tallest:,}</figcaption></figure>"
    )


def _places(data: dataset.Dataset, described: Described) -> str:
    """A map of the first and last positions of some trajectories of each outcome, within twice the pad's size."""
    charts = []
    width, height = (1e3 * float(side) for side in sensor_of(data).gel.size)
    for name in described.outcome_names:
        members = _spread(np.flatnonzero(np.array(described.outcomes) == name), POINTS)
        if not len(members):
            continue
        places = 1e3 * data.trajectory["pose"][members][:, [0, -1], :2].astype(float)
        dots = "".join(
            f'<circle cx="{x:.0f}" cy="{y:.0f}" r="2" {look}/>'
            for end, look in ((0, 'fill="none" stroke="currentColor" opacity=".45"'), (1, 'fill="var(--accent)"'))
            for x, y in places[:, end].tolist()
            if abs(x) < width and abs(y) < height
        )
        charts.append(
            f'<figure><svg viewBox="{-width:g} {-height:g} {2 * width:g} {2 * height:g}" role="img" '
            f'aria-label="Positions: {html.escape(name)}"><rect x="{-width / 2:g}" y="{-height / 2:g}" '
            f'width="{width:g}" height="{height:g}" fill="var(--soft)" stroke="var(--line)"/>{dots}</svg>'
            f"<figcaption>{html.escape(name)}: first (rings) and last positions (dots)</figcaption></figure>"
        )
    return f'<div class="charts">{"".join(charts)}</div>'


def _spread(members: np.ndarray, most: int) -> np.ndarray:
    """At most `most` of some indices, evenly spread."""
    return members if len(members) <= most else members[np.linspace(0, len(members) - 1, most).astype(int)]


def _sheets(data: dataset.Dataset, described: Described, num: int) -> list[str]:
    """The contact sheet of each outcome: both streams of the first and the last frame of some trajectories."""
    rendered, lines = data.rendered(), []
    last = data.trajectory["time"].shape[1] - 1
    lines.append("<p>Visual and tactile image of the first frame, then of the last frame.</p>")
    for name in described.outcome_names:
        members = rendered[[described.outcomes[index] == name for index in rendered]] if len(rendered) else rendered
        if not len(members):
            continue
        some = _spread(members, num)
        rows = data.stored(np.repeat(some, 2), np.tile([0, last], len(some)))
        images = data.images(rows)
        lines.append(f"<h3>{html.escape(name)}: {len(some):,} of {len(members):,}</h3>")
        tiles = [
            _figure(
                [each for i in (2 * k, 2 * k + 1) for each in (images.visual[i], images.tactile[i])], described, index
            )
            for k, index in enumerate(some.tolist())
        ]
        lines.append(f'<div class="tiles">{"".join(tiles)}</div>')
    return lines


def _figure(pictures: Sequence[np.ndarray], described: Described, trajectory: int, words: str = "") -> str:
    text = html.escape(described.words(trajectory) + words)
    return f'<figure><img src="{picture(pictures, TILE)}" alt="{text}"><figcaption>{text}</figcaption></figure>'


def picture(images: Sequence[np.ndarray], side: int) -> str:
    """Images side by side as a data URI, each reduced to at most `side` pixels.

    Args:
        images: uint8 `(height, width, 3)` each, of one shape.
    """
    height, width = images[0].shape[:2]
    scale = min(1.0, side / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    whole = Image.new("RGBA", (len(images) * (size[0] + 2) - 2, size[1]))
    for index, image in enumerate(images):
        small = Image.fromarray(image) if scale == 1 else Image.fromarray(image).resize(size, Image.Resampling.BOX)
        whole.paste(small, (index * (size[0] + 2), 0))
    buffer = io.BytesIO()
    whole.save(buffer, "WEBP", quality=QUALITY)
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def _film(data: dataset.Dataset, described: Described, trajectory: int) -> str:
    """A player for the stored frames of a trajectory, with a curve of the force."""
    images, one = data.strip(trajectory), {name: leaf[trajectory] for name, leaf in data.trajectory.items()}
    stored = np.sort(data.frames[data.frames[:, 0] == trajectory, 1]).tolist()
    force, end = np.linalg.norm(one["wrench"][:, :3], axis=-1), max(float(one["time"][-1]), 1e-9)
    most = max(float(force.max()), 1e-9)
    frames = []
    for i, frame in enumerate(stored):
        x, y, z = 1e3 * one["pose"][frame, :3]
        touch = "in contact" if one["contact"][frame] else "no contact"
        text = (
            f"frame {frame}, {one['time'][frame]:.2f} s, {force[frame]:.2f} N, {touch}, "
            f"position ({x:.0f}, {y:.0f}, {z:.0f}) mm"
        )
        shown = picture([images.visual[i], images.tactile[i]], FILM)
        frames.append({"image": shown, "text": text, "x": round(300 * float(one["time"][frame]) / end, 1)})
    points = " ".join(
        f"{300 * t / end:.1f},{40 - 38 * n / most:.1f}"
        for t, n in zip(one["time"].tolist(), force.tolist(), strict=True)
    )
    step = 1e3 * end / max(len(one["time"]) - 1, 1) if len(stored) == len(one["time"]) else 1000
    return (
        f'<section id="film" data-ms="{step:.0f}"><h2>Film of {html.escape(described.words(trajectory))}</h2>'
        '<img alt="Visual and tactile image of one frame"><div class="controls"><button>Play</button>'
        f'<input type="range" min="0" max="{len(stored) - 1}" value="0" aria-label="Frame"></div><p id="now"></p>'
        f'<svg viewBox="0 0 300 42" role="img" aria-label="Force over time"><polyline points="{points}" fill="none" '
        f'stroke="var(--accent)" stroke-width="1"/><path id="cursor" d="M0 0V40" stroke="currentColor" '
        f'stroke-width=".7"/></svg><p>Force: at most {most:.2f} N within {end:.2f} s</p>'
        f'<script type="application/json" id="frames">{json.dumps(frames)}</script></section>'
    )


def _suspects(data: dataset.Dataset, described: Described, suspects: Sequence[dataset.Suspect], source: str) -> str:
    """The suspicious frames of each kind."""
    lines = ['<h2 id="suspects">Suspicious frames</h2>']
    for kind, meaning in dataset.KINDS.items():
        members = [one for one in suspects if one.kind == kind]
        if not members:
            continue
        lines.append(f"<h3>{html.escape(f'{kind}: {len(members):,}')}</h3><p>{html.escape(meaning)}</p>")
        drawn = members[:SUSPECTS]
        images = data.images(np.array([one.row for one in drawn], np.int64))
        tiles = [
            _figure(
                [images.visual[i], images.tactile[i]], described, one.trajectory, f", frame {one.frame}. {one.reason}"
            )
            for i, one in enumerate(drawn)
        ]
        lines.append(f'<div class="tiles">{"".join(tiles)}</div>')
        if len(members) > len(drawn):
            listed = [f"<li>{html.escape(named(one))}</li>" for one in members[SUSPECTS:][:LISTED]]
            lines.append(f"<details><summary>{len(listed):,} more</summary><ul>{''.join(listed)}</ul></details>")
    if not suspects:
        kinds = "".join(f"<li>{kind}: {html.escape(meaning)}</li>" for kind, meaning in dataset.KINDS.items())
        lines.append(f"<p>None. These kinds were searched:</p><ul>{kinds}</ul>")
    else:
        command = f"python -m experiments.inspect {source} --trajectory {suspects[0].trajectory}"
        lines.append(f"<p>The film of another trajectory: <code>{html.escape(command)}</code></p>")
    return "\n".join(lines)


def named(one: dataset.Suspect) -> str:
    """A suspect in one line."""
    return f"{one.kind}: trajectory {one.trajectory}, frame {one.frame}: {one.reason}"
