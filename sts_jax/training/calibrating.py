"""Fit the calibration of a trained state-space model, on trajectories of objects that it was not trained on.

The calibration corrects the predicted probabilities of the outcomes and the predicted density of the final pose, and
sets the contrast of sampled images.
"""

import os
from pathlib import Path

from flax import nnx

from sts_jax import statespace, storage
from sts_jax.training import calibration_file
from sts_jax.training.arrays import Arrays
from sts_jax.training.learners import learner
from sts_jax.training.model import Model, load


def calibrate(workdir: str | os.PathLike[str], arrays: Arrays) -> Model:
    """Fit the calibration of a trained state-space model, and write it to `calibration.json` in the model's folder.

    For new objects, the predicted density of the final pose is too narrow, and the predicted outcomes can be too
    certain or too uncertain. The calibration corrects the density and the probabilities of the outcomes. The fit also
    chooses the contrast, which is the sharpness of the outlines in sampled images, see `statespace.fit_calibration`. If
    the model was calibrated on the same arrays before, nothing is fitted or written.

    Args:
        workdir: Folder of the model.
        arrays: Trajectories of objects that the model was not trained on, from `state_arrays`.

    Returns:
        The model with its calibration.

    Raises:
        FileNotFoundError: The folder has no trained model.
        ValueError: The model is not a state-space model, or the names, shapes or values of the arrays do not fit the
            model.
        OSError: A file is damaged or cannot be written.
        LockedError: Another process works in the folder.
    """
    folder = Path(workdir)
    model = load(folder)
    if not isinstance(model.config, statespace.Config):
        raise ValueError(
            f"{folder} has a model of the kind mvae, but only a state-space model can be calibrated: give the folder "
            "of a state-space model"
        )
    learner(model.config).check(arrays)
    there, data = calibration_file.read(folder), arrays.checksum()
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
    with storage.lock(folder):
        calibration_file.write(folder, found, model.config.inputs, data)
    return model._replace(calibration=found)
