"""Trained models: loading them from their folders, and the calibration of state-space models."""

import contextlib
import os
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from sts_jax import mvae, statespace, storage
from sts_jax.training import folder
from sts_jax.training.arrays import Arrays, Config, check

KINDS: dict[str, Any] = {"mvae": mvae, "statespace": statespace}  # package of each `kind` in `config.json`


class Model(NamedTuple):
    """A trained model. `graphdef` and `state` are the first two arguments of `mvae.predict` or `statespace.sample`."""

    config: Config  # configuration of the model
    graphdef: nnx.GraphDef[Any]  # definition of the model
    state: nnx.State  # parameters and running batch statistics
    step: int  # gradient steps done
    settings: dict[str, Any]  # content of config.json: `model`, `training`, `preprocessing`, ...
    calibration: statespace.Calibration | None = None  # from `calibrate`, for state-space models

    def __repr__(self) -> str:
        config, count = self.config, sum(x.size for x in jax.tree.leaves(self.state))
        if isinstance(config, mvae.Config):
            parts = ", ".join(f"{m.name} {m.kind} {m.shape}" for m in config.modalities) + f"; latent={config.latent}"
        else:
            parts = f"{', '.join(config.inputs)}; look={config.look}, outcomes={config.outcomes}"
        return f"Model({parts}, condition={config.condition}, {count:,} numbers, step={self.step})"


def load(workdir: str | os.PathLike[str], *, calibrated: bool = True) -> Model:
    """Load a model, after comparing its files with their checksums. A training may run in the folder meanwhile.

    Args:
        workdir: Folder of the model, the `workdir` of `train`.
        calibrated: False leaves out the calibration, and does not read its file.
    """
    workdir = Path(workdir)
    while True:
        before = folder.manifest(workdir)
        try:
            return _load(workdir, calibrated)
        except (OSError, ValueError):
            if folder.manifest(workdir) == before:
                raise
            # A training replaced the checkpoint while it was read. The loop reads the new one.


def _load(workdir: Path, calibrated: bool) -> Model:
    path = workdir / folder.CONFIG
    if not path.exists():
        raise FileNotFoundError(f"{workdir} has no config.json: give the folder of a trained model")
    step = folder.verified(workdir)
    if step is None:
        raise FileNotFoundError(f"{workdir} has no checkpoint: run its training until the first checkpoint is written")
    settings = storage.read_json(path, f"delete {workdir} and train again")
    try:
        kind = KINDS[settings["kind"]]
        config = kind.Config.from_json(settings["model"])
        graphdef, params, stats = jax.eval_shape(lambda: kind.init(jax.random.key(0), config))
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(
            f"{path} does not describe a model that this version of sts_jax can load ({error!r}): train again"
        ) from error
    like = folder.TrainState(params, stats, None, jnp.int32(0))
    weights = folder.read(workdir, step, like)
    fitted = folder.read_calibration(workdir) if calibrated else None
    state = nnx.merge_state(weights.params, weights.stats)
    return Model(config, graphdef, state, step, settings, fitted[0] if fitted else None)


def calibrate(workdir: str | os.PathLike[str], arrays: Arrays) -> Model:
    """Fit the calibration of a trained state-space model, and write it to `calibration.json` in the model's folder.

    See `statespace.fit_calibration`. If the model was calibrated on the same arrays before, nothing is fitted or
    written.

    Args:
        arrays: Trajectories of objects that the model was not trained on, from `state_arrays`.
    """
    path = Path(workdir)
    model = load(path, calibrated=False)
    if not isinstance(model.config, statespace.Config):
        raise ValueError(f"{path} has an mvae model, but only a state-space model can be calibrated")
    check(model.config, arrays)
    checksum = arrays.checksum()
    with contextlib.suppress(storage.DamagedFileError):  # it is fitted again
        fitted = folder.read_calibration(path)
        if fitted is not None and fitted[1] == checksum:
            return model._replace(calibration=fitted[0])
    params, _ = nnx.split_state(model.state, nnx.Param, nnx.BatchStat)
    calibration = statespace.fit_calibration(
        model.graphdef,
        params,
        arrays.inputs,
        arrays.targets,
        arrays.empty,
        present=arrays.present,
        condition=arrays.condition,
    )
    with storage.lock(path):
        folder.save_calibration(path, calibration, model.config.inputs, checksum)
    return model._replace(calibration=calibration)
