"""The calibration of a trained state-space model on trajectories that its training did not see."""

import os
from pathlib import Path

from flax import nnx

from sts_jax import _files, statespace
from sts_jax.training import calibration
from sts_jax.training.arrays import Arrays
from sts_jax.training.learners import learner
from sts_jax.training.model import Model, load


def calibrate(workdir: str | os.PathLike[str], arrays: Arrays) -> Model:
    """Fit the calibration of a trained state-space model and write `calibration.json`, see `statespace.calibration`.

    A model that was calibrated on the same trajectories is only read.

    Args:
        workdir: the folder of the model.
        arrays: the trajectories, from `state_moments`, of objects that are in no training set.

    Returns:
        The model with its calibration.

    Raises:
        FileNotFoundError: the folder holds no trained model.
        ValueError: the model is of another kind, or the arrays do not fit it.
        OSError: a file is damaged or cannot be written.
        LockedError: another process works in the folder.
    """
    folder = Path(workdir)
    model = load(folder)
    if not isinstance(model.config, statespace.Config):
        raise ValueError(f"{folder} holds a model of the kind mvae, but only a state-space model can be calibrated")
    learner(model.config).check(arrays)
    there, data = calibration.read(folder), arrays.checksum()
    if there is not None and there[1] == data:
        return model
    params, _ = nnx.split_state(model.state, nnx.Param, nnx.BatchStat)
    found = statespace.fit_calibration(
        model.graphdef,
        params,
        arrays.inputs,
        arrays.targets,
        arrays.empty,
        present=arrays.present,
        condition=arrays.condition,
    )
    with _files.lock(folder):
        calibration.write(folder, found, model.config.inputs, data)
    return model._replace(calibration=found)
