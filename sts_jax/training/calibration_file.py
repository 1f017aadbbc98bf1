"""Read and write `calibration.json`, the calibration of a state-space model in the model's folder.

A calibration has the numbers that correct the predicted density of the final pose, see `statespace.Calibration`. The
file also has a checksum of its own content, and a checksum of the model's other files at the time of the fit. The file
is written atomically. If the process is interrupted during the write, the previous file (if any) stays unchanged.
"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from sts_jax import statespace, storage
from sts_jax.training import manifest

NAME = "calibration.json"
_FORMAT = 1


def write(folder: Path, calibration: statespace.Calibration, inputs: tuple[str, ...], data: int | None = None) -> None:
    """Write the calibration of a model's current checkpoint to `calibration.json`.

    Args:
        folder: Folder of the model.
        calibration: Numbers that correct the model's predictions, from `statespace.fit_calibration`.
        inputs: Inputs of the model, `Config.inputs`.
        data: Checksum of the validation data to which the calibration was fitted, from `Arrays.checksum`. None if it is
            unknown.

    Raises:
        OSError: The file cannot be written.
    """
    subsets = {}
    for number, row in enumerate(np.asarray(calibration).T.tolist()):
        members = [name for i, name in enumerate(inputs) if number & 2**i]
        subsets[" and ".join(members) or "no input"] = dict(zip(calibration._fields, row, strict=True))
    content = {"format": _FORMAT, "weights": _weights(folder), "data": data, "subsets": subsets}
    storage.write_json(folder / NAME, {**content, "checksum": storage.digest(content)})


def read(folder: Path) -> tuple[statespace.Calibration, int | None] | None:
    """Read the calibration of a model's current checkpoint.

    Args:
        folder: Folder of the model.

    Returns:
        The calibration, and the checksum of the validation data to which it was fitted (None if unknown). If the folder
        has no calibration, or if the model's files changed after the fit, the result is None.

    Raises:
        DamagedFileError: `calibration.json` is damaged, or was written by another version of sts_jax.
    """
    path = folder / NAME
    remedy = (
        "restore the file from a copy, or delete the file and calibrate again (training.calibrate, or an experiment "
        "with --only train)"
    )
    if not path.exists():
        return None
    content: Any = storage.read_json(path, remedy)
    if not isinstance(content, dict) or content.pop("checksum", None) != storage.digest(content):
        raise storage.DamagedFileError(f"{path} was changed or damaged (its checksum differs): {remedy}.")
    if content["format"] != _FORMAT:
        raise storage.DamagedFileError(f"{path} was written by another version of sts_jax: {remedy}.")
    if content["weights"] != _weights(folder):
        return None
    default = {"contrast": statespace.CONTRAST}  # older files lack the contrast
    rows = [[(default | row)[name] for name in statespace.Calibration._fields] for row in content["subsets"].values()]
    return statespace.Calibration(*jnp.asarray(rows, jnp.float32).T), content["data"]


def _weights(folder: Path) -> str | None:
    """A checksum of the files that the manifest lists, or None without a manifest."""
    listed = manifest.read(folder)
    return None if listed is None else storage.digest(sorted(listed.files.items()))
