"""Writes the golden files of `test_golden.py`: python -m tests.golden.make FOLDER_OF_A_SMOKE_RUN (see that file)."""

import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sts_jax as sts
from sts_jax import dataset

HERE = Path(__file__).parent
MODELS = ("freefall", "inclined", "perturbed", "released")


def inputs() -> dict[str, np.ndarray]:
    """Both images (uint8) and the pose of a bottle that leans in the air above the pad."""
    body = sts.objects.make(jax.random.key(3), "bottle")
    pose = np.array([0.01, -0.015, 0.05, 0.8, 0.5, 0.2, 0.27], np.float32)
    pose[3:] /= np.linalg.norm(pose[3:])
    frame = sts.sense(sts.Sensor(), body, jnp.asarray(pose), resolution=(128, 128))
    return {"visual": np.round(np.asarray(frame.visual) * 255).astype(np.uint8), "pose": pose}


def predictions(given: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What the shipped models predict from vision, and from vision and pose."""
    made = {}
    for name in MODELS:
        predict = sts.Predictor.load(name)
        width = predict.model.config.condition
        condition = {} if not width else {"condition": np.full(width, 2.0, np.float32)}
        image = {"visual": given["visual"].astype(np.float32) / 255}
        for title, known in (("vision", image), ("vision-pose", {**image, "pose": given["pose"]})):
            out = predict(**known, **condition)
            made[f"{name}/{title}/pose"] = np.asarray(out.pose)
            made[f"{name}/{title}/outcome"] = np.asarray(out.outcome_probability)
            for stream in ("visual", "tactile"):  # means of 8 x 8 blocks
                picture = np.asarray(getattr(out, stream))
                side = picture.shape[0] // 8
                made[f"{name}/{title}/{stream}"] = picture.reshape(side, 8, side, 8, 3).mean((1, 3))
    return made


def smoke(workdir: Path) -> dict:
    """First and last poses, losses and metrics of `python -m experiments.freefall --preset smoke`."""
    data = dataset.load(workdir / "dataset")
    log = (workdir / "models" / "statespace" / "metrics.jsonl").read_text().splitlines()
    metrics = json.loads((workdir / "metrics.json").read_text())["predictors"]
    pairs = data.pairs(data.rendered())
    return {
        "ends": np.asarray(data.trajectory["pose"])[:, [0, -1]].round(6).tolist(),
        "image_means": {
            name: getattr(pairs, name).mean((2, 3, 4), dtype=np.float64).round(3).tolist()
            for name in ("visual", "tactile")
        },
        "losses": [json.loads(line)["loss"] for line in log],
        "metrics": {
            title: {name: entry["value"] for name, entry in row.items() if isinstance(entry, dict) and "value" in entry}
            for title, row in metrics.items()
        },
    }


if __name__ == "__main__":
    given = inputs()
    np.savez_compressed(HERE / "predictions.npz", **given, **predictions(given))
    (HERE / "smoke.json").write_text(json.dumps(smoke(Path(sys.argv[1]))) + "\n")
