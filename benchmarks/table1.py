"""Recompute three cells of Table 1 from the stored models and datasets, with arithmetic of its own.

    python -m benchmarks.table1 runs/table1     # about five minutes on two CPU cores

The command predicts the last frames of the held-out trajectories with the stored models, computes the cross-entropies
in float64, and compares them with `metrics.json`. Without --cells it takes a final-step and a one-step model of the
paper, and a state-space model.
"""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro

import sts_jax as sts
from sts_jax import dataset, evaluation, statespace, storage

STREAMS = ("visual", "tactile")
HALF_LEVEL = 1 / 510  # predicted values are limited to half a grey level from 0 and 1
TOLERANCE = 1e-6  # largest difference of a cross-entropy (nats per pixel and channel)
_CHUNK = 16  # items predicted at once


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    workdir: Annotated[Path, tyro.conf.Positional]  # work directory of experiments.table1
    cells: tuple[str, ...] = ()  # names such as freefall/mvae-final-seed0 (empty: one of each kind)


def main(args: Args) -> str:
    """Compare the cells, and return a table. A difference above the tolerance is an error."""
    sts.enable_compilation_cache()
    metrics, settings = (
        storage.read_json(args.workdir / name, "run experiments.table1 again")
        for name in ("metrics.json", "config.json")
    )
    lines = ["| cell | weights | stream | metrics.json | recomputed |", "|---" * 5 + "|"]
    for name in args.cells or _one_of_each_kind(metrics):
        scenario, _, model = name.partition("/")
        key, _, seed = model.rpartition("-seed")
        key, _, scale = key.rpartition("-")
        data = dataset.load(args.workdir / "datasets" / scenario)
        test = data.pairs(evaluation.rows_of(data, metrics["split"])["test"])
        for weights, folder in (("last", "."), ("best", "best")):
            found = recomputed(args.workdir / "models" / name / folder, test, settings["num_samples"])
            for stream, value in found.items():
                stored = _stored(metrics, scenario, key, scale, int(seed), weights, stream)
                lines.append(f"| {name} | {weights} | {stream} | {stored:.7f} | {value:.7f} |")
                if not abs(stored - value) <= TOLERANCE:
                    raise ValueError(
                        f"{name}, {weights} weights, {stream}: metrics.json has {stored}, but it is {value}"
                    )
    return "\n".join(lines)


def recomputed(folder: Path, test: dataset.Pairs, num_samples: int) -> dict[str, float]:
    """Mean cross-entropy of each stream (nats per pixel and channel) of a model from all its inputs."""
    keys = jax.random.split(jax.random.key(0), len(test.object))
    predictor, total, count = sts.Predictor.load(folder), dict.fromkeys(STREAMS, 0.0), dict.fromkeys(STREAMS, 0)
    for start in range(0, len(test.object), _CHUNK):
        part = test.take(slice(start, start + _CHUNK))
        frame = {"visual": part.visual[:, 0] / 255, "tactile": part.tactile[:, 0] / 255, "pose": part.pose[:, 0]}
        given: dict[str, Any] = {name: frame[name] for name in predictor.modalities}
        more: dict[str, Any] = {"condition": part.condition if part.condition.shape[1] else None}
        if isinstance(predictor.model.config, statespace.Config):
            more |= {"key": keys[start : start + _CHUNK], "num_samples": num_samples}
        if predictor.stride is not None:
            assert part.frame is not None
            first, last = part.frame[0]
            out = predictor.rollout(given, int(last - first) // predictor.stride, **more)
            images = {name: None if (x := getattr(out, name)) is None else np.asarray(x)[:, -1] for name in STREAMS}
        else:
            out = predictor(**given, **more) if given else predictor.prior((len(part.object),))
            images = {name: getattr(out, name) for name in STREAMS}
        for stream, image in images.items():
            if image is not None:
                p = np.clip(np.asarray(image, np.float64), HALF_LEVEL, 1 - HALF_LEVEL)
                x = getattr(part, stream)[:, 1].astype(np.float64) / 255
                total[stream] -= float((x * np.log(p) + (1 - x) * np.log(1 - p)).sum())
                count[stream] += x.size
    return {stream: total[stream] / count[stream] for stream in STREAMS if count[stream]}


def _one_of_each_kind(metrics: dict[str, Any]) -> list[str]:
    """A final-step and a one-step cell of the paper's models and a state-space cell, as far as they exist."""
    names = [
        f"{one['scenario']}/{row['side']['model']}-{row['side']['scale']}-seed{one['seeds'][0]}"
        for one in metrics["scenarios"]
        for row in one["rows"]
        if row["bce_of_seed"] and row["side"]["model"] not in ("constant", "copy", "ceiling")
    ]
    kinds = [("statespace" in name, "-step-" in name) for name in names]
    wanted = [(False, False), (False, True), (True, False)]
    return [names[kinds.index(kind)] for kind in wanted if kind in kinds]


def _stored(
    metrics: dict[str, Any], scenario: str, model: str, scale: str, seed: int, weights: str, stream: str
) -> float:
    """The cross-entropy of a cell in `metrics.json`."""
    one = next(one for one in metrics["scenarios"] if one["scenario"] == scenario)
    side = {"model": model, "scale": scale, "given": "all inputs"}
    for row in one["rows"]:
        if (row["side"], row["weights"], row["stream"]) == (side, weights, stream):
            return float(row["bce_of_seed"][one["seeds"].index(seed)])
    raise KeyError(f"metrics.json has no {model} at {scale} of {scenario}")


if __name__ == "__main__":
    print(main(tyro.cli(Args, description=__doc__)))
