"""Trained models, and functions that load them from a folder. The state of the optimiser is not read."""

import os
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from sts_jax import mvae, statespace, storage
from sts_jax.training import calibration_file, manifest
from sts_jax.training.checkpoint import Weights, read, verified
from sts_jax.training.learners import Config, learner

# The configuration class of each `kind` in `config.json`
KINDS: dict[str, type[Config]] = {"mvae": mvae.Config, "statespace": statespace.Config}


class Model(NamedTuple):
    """A trained model.

    `graphdef` and `state` are the first two arguments of the functions `mvae.predict` (for an `mvae` model) and
    `statespace.sample` (for a state-space model).
    """

    config: Config  # configuration of the model
    graphdef: nnx.GraphDef[Any]  # definition of the model
    state: nnx.State  # parameters and running batch statistics
    step: int  # gradient steps done
    settings: dict[str, Any]  # content of config.json: `model`, `training`, `preprocessing`, ...
    calibration: statespace.Calibration | None = None  # from `calibrate`, for state-space models

    def __repr__(self) -> str:
        config, numbers = self.config, sum(x.size for x in jax.tree.leaves(self.state))
        if isinstance(config, mvae.Config):
            made = ", ".join(f"{m.name} {m.kind} {m.shape}" for m in config.modalities) + f"; latent={config.latent}"
        else:
            made = f"{', '.join(config.inputs)}; look={config.look}, outcomes={config.outcomes}"
        return f"Model({made}, condition={config.condition}, {numbers:,} numbers, step={self.step})"


def load(workdir: str | os.PathLike[str]) -> Model:
    """Load a trained model from its folder.

    First, all files are compared with their checksums. You can also load the model while a training runs in the folder.
    The optimiser of the training does not matter, because the state of the optimiser is not read.

    Args:
        workdir: Folder of the model, which was the `workdir` of `train`.

    Returns:
        The model at its current checkpoint.

    Raises:
        FileNotFoundError: The folder has no `config.json` or no checkpoint.
        OSError: A file is damaged, missing or not listed in `manifest.json`.
        ValueError: The model was written by another version of sts_jax, or the folder has no `manifest.json`.
    """
    workdir = Path(workdir)
    while True:
        before = manifest.read(workdir)
        try:
            return _load(workdir)
        except (OSError, ValueError):
            if manifest.read(workdir) == before:
                raise
            # A training replaced the checkpoint while it was read. The loop reads the new one.


def _load(workdir: Path) -> Model:
    path = workdir / "config.json"
    if not path.exists():
        raise FileNotFoundError(f"{workdir} has no config.json: give the folder of a trained model, or train one there")
    checkpoint = verified(workdir)
    settings = storage.read_json(path, f"delete {workdir} and train again")
    if checkpoint is None:
        raise FileNotFoundError(f"{workdir} has no checkpoint: run its training until the first checkpoint is written")
    try:
        kind = settings.get("kind", "mvae")  # version 0.1 had no other kind
        model = KINDS[kind].from_json(settings["model"])
        like = jax.eval_shape(lambda: Weights(*learner(model).init(jax.random.key(0))[1:], jnp.zeros((), jnp.int32)))
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(
            f"{path} does not describe a model that this version of sts_jax can load ({type(error).__name__}: "
            f"{error}): use the version that trained the model, or delete {workdir} and train again"
        ) from error
    weights = read(checkpoint, like)
    graphdef = nnx.graphdef(nnx.eval_shape(lambda: _module(model)))
    own = calibration_file.read(workdir)
    state = nnx.merge_state(weights.params, weights.stats)
    return Model(model, graphdef, state, int(weights.step), settings, None if own is None else own[0])


def _module(model: Config) -> nnx.Module:
    return mvae.MVAE(model) if isinstance(model, mvae.Config) else statespace.Model(model, nnx.Rngs(0))
