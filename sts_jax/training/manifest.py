"""Read and write `manifest.json`, the checksums of the files of a model.

The manifest has the SHA-256 of `config.json`, of `blank.npz` if the folder has one, and of every file of the current
checkpoint. A new checkpoint is written first, then the manifest is replaced as a whole, then the older checkpoint is
deleted. If the process is killed at any time, all files that the manifest lists are complete.
"""

from pathlib import Path
from typing import Any, NamedTuple

from sts_jax import storage

NAME = "manifest.json"
_FORMAT = 1
_BESIDE = ("config.json", "blank.npz")  # files outside the checkpoint that a manifest lists if they exist


class Manifest(NamedTuple):
    """The files of a model and their checksums."""

    step: int | None  # step of the current checkpoint, None before the first checkpoint
    files: dict[str, str]  # SHA-256 (hexadecimal) by path relative to the folder


def checkpoint(folder: Path, step: int) -> Path:
    """Path of the checkpoint of a model at a step: `folder/checkpoints/STEP`, with STEP in eight digits."""
    return folder / "checkpoints" / f"{step:08d}"


def read(folder: Path) -> Manifest | None:
    """Read `manifest.json`, the checksums of a model's files. Return None if the folder has no such file.

    Raises:
        DamagedFileError: The manifest is damaged, or was written by another version of sts_jax.
    """
    path, remedy = folder / NAME, _remedy(folder)
    if not path.exists():
        return None
    content = storage.read_json(path, remedy)
    if not _is_manifest(content):
        raise storage.DamagedFileError(f"{path} is damaged, or was written by another version of sts_jax: {remedy}.")
    return Manifest(content["step"], content["files"])


def write(folder: Path, step: int | None) -> Manifest:
    """Write `manifest.json`, which names the current checkpoint and contains the checksums of the model's files.

    The checksums of `config.json` and `blank.npz` are copied from the previous manifest. If one of these two files is
    damaged already, this function therefore does not hide the damage from later checks.

    Args:
        folder: Folder of the model.
        step: Step of the current checkpoint, or None if there is no checkpoint.

    Returns:
        The new manifest.

    Raises:
        DamagedFileError: The previous manifest is damaged.
        OSError: The manifest cannot be written.
    """
    old = read(folder)
    files = {} if old is None else {name: digest for name, digest in old.files.items() if name in _BESIDE}
    names = _there(folder, step)
    files = {name: files.get(name) or storage.sha256(folder / name) for name in names}
    storage.write_json(folder / NAME, {"format": _FORMAT, "step": step, "files": files})
    return Manifest(step, files)


def add(folder: Path, name: str) -> None:
    """Add the checksum of a model's file to `manifest.json`. Without a manifest, nothing is written.

    Args:
        folder: Folder of the model.
        name: Name of the file in this folder, such as `blank.npz`. The file must not belong to a checkpoint.

    Raises:
        OSError: A file cannot be read or written, or the manifest is damaged.
    """
    old = read(folder)
    if old is not None:
        files = old.files | {name: storage.sha256(folder / name)}
        storage.write_json(folder / NAME, {"format": _FORMAT, "step": old.step, "files": files})


def verify(folder: Path, manifest: Manifest) -> None:
    """Compare the files of a model with their checksums in the manifest.

    Args:
        folder: Folder of the model.
        manifest: Manifest of this folder, from `read`.

    Raises:
        DamagedFileError: A file has changed, is missing or is not listed. The message names the file and the remedy.
    """
    remedy = _remedy(folder)
    for name in _there(folder, manifest.step):
        if name not in manifest.files:
            raise storage.DamagedFileError(
                f"{folder / name} is not listed in {NAME}: the file does not belong to this model. Move the file "
                f"elsewhere, restore {NAME} from a copy, or delete {folder} and train again."
            )
    for name, digest in manifest.files.items():
        path = folder / name
        try:
            found = storage.sha256(path)
        except FileNotFoundError:
            raise storage.DamagedFileError(f"{path} is missing, but {NAME} lists it: {remedy}.") from None
        except (OSError, ValueError) as error:  # ValueError: a damaged manifest may list a name with a null byte
            raise storage.DamagedFileError(f"{path} cannot be read ({error}): {remedy}.") from error
        if found != digest:
            again = ", or delete this file and start the training again" if name == "blank.npz" else ""
            raise storage.DamagedFileError(
                f"{path} is not the file that {NAME} lists: its SHA-256 differs. The file was edited, exchanged or "
                f"damaged: {remedy}{again}."
            )


def _is_manifest(content: Any) -> bool:
    """Return whether a JSON value has the fields of a manifest, and lists the files of its own checkpoint only."""
    if not isinstance(content, dict) or content.keys() != {"format", "step", "files"} or content["format"] != _FORMAT:
        return False
    step, files = content["step"], content["files"]
    if type(step) not in (int, type(None)) or not isinstance(files, dict):
        return False
    of_checkpoint = [name for name in files if name not in _BESIDE]
    if step is None:
        return not of_checkpoint
    prefix = checkpoint(Path(), step).as_posix() + "/"
    return bool(of_checkpoint) and all(name.startswith(prefix) for name in of_checkpoint)


def _there(folder: Path, step: int | None) -> list[str]:
    """The existing files that a manifest has to list, as paths relative to the folder."""
    found = [folder / name for name in _BESIDE if (folder / name).exists()]
    if step is not None:
        found += sorted(path for path in checkpoint(folder, step).rglob("*") if not path.is_dir())
    return [path.relative_to(folder).as_posix() for path in found]


def _remedy(folder: Path) -> str:
    """The remedy with which the error messages end."""
    return f"restore it from a copy, or delete {folder} and train again"
