"""Datasets behind a URL, such as `s3://bucket/falls`: shards are uploaded, and a reader has a local copy."""

import functools
import os
import secrets
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

import fsspec

from sts_jax.compilation import cache_folder
from sts_jax.dataset.card import CARD
from sts_jax.storage import MANIFEST, Manifest, digest, read_manifest, remedy, sha256

Result = TypeVar("Result")


class Remote:
    """The folder of a dataset behind a URL."""

    def __init__(self, url: str) -> None:
        """Connect to the file system of a URL, for which fsspec may need a driver such as `s3fs`."""
        self.url = url.rstrip("/")
        self._system, self._path = self._do("open", lambda: fsspec.core.url_to_fs(self.url))

    def names(self) -> set[str]:
        """Names of the files in the folder."""

        def listed() -> set[str]:
            self._system.invalidate_cache()
            if not self._system.isdir(self._path):
                return set()
            return {str(name).rpartition("/")[2] for name in self._system.ls(self._path, detail=False)}

        return self._do("list", listed)

    def put(self, folder: Path, names: Iterable[str]) -> None:
        """Upload files of a local folder, in the given order."""
        for name in names:
            call = functools.partial(self._system.put_file, str(folder / name), f"{self._path}/{name}")
            self._do(f"write {name} to", call)

    def get(self, folder: Path, names: Iterable[str]) -> None:
        """Download files into a local folder, each as a whole or not at all."""
        folder.mkdir(parents=True, exist_ok=True)
        for name in names:
            partial = folder / f".{name}.{os.getpid()}-{secrets.token_hex(4)}.partial"
            try:
                call = functools.partial(self._system.get_file, f"{self._path}/{name}", str(partial))
                self._do(f"read {name} from", call)
                partial.replace(folder / name)
            finally:
                partial.unlink(missing_ok=True)

    def delete(self, names: Iterable[str]) -> None:
        """Delete files."""
        for name in names:
            self._do(f"delete {name} of", functools.partial(self._system.rm_file, f"{self._path}/{name}"))

    def _do(self, what: str, call: Callable[[], Result]) -> Result:
        try:
            return call()
        except FileNotFoundError as error:
            raise FileNotFoundError(f"cannot {what} {self.url}: {error} is missing") from error
        except Exception as error:  # drivers raise errors of many types
            raise OSError(f"cannot {what} {self.url}: {error}. {_remedy(error)}.") from error


def _remedy(error: Exception) -> str:
    if isinstance(error, ImportError):
        return "Install the driver"
    if isinstance(error, ValueError):
        return "Check the URL"
    return f"{remedy(error)} and the connection"


def local_or_remote(target: str | os.PathLike[str]) -> Path | Remote:
    """The local folder of a path or of a URL `file://`, or the folder behind another URL."""
    text = os.fspath(target)
    if "://" not in text:
        return Path(text)
    protocol, _, rest = text.partition("://")
    return Path(rest) if protocol in ("file", "local") else Remote(text)


def local_copy(remote: Remote) -> Path:
    """Download a finished dataset into the cache, and return its local folder. Files that are there already stay."""
    folder = cache_folder() / "datasets" / digest(remote.url)[:16]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(
            f"cannot keep a copy of {remote.url} in {folder} ({error}): set XDG_CACHE_HOME to a folder with room for it"
        ) from error
    names = remote.names()
    if MANIFEST not in names:
        what = "the collection is not finished" if "collection.json" in names else "it is not a collected dataset"
        raise FileNotFoundError(f"{remote.url}/{MANIFEST} is missing: {what}.")
    advice = f"delete {folder}, and load {remote.url} again"
    before = read_manifest(folder, advice) or Manifest({}, {})
    with tempfile.TemporaryDirectory() as temporary:
        remote.get(Path(temporary), [MANIFEST])
        after = read_manifest(Path(temporary), advice)
    assert after is not None
    for name, checksum in after.files.items():
        path = folder / name  # whole, but in no manifest, if an earlier download was interrupted
        if not path.exists() or (before.files.get(name) != checksum and sha256(path) != checksum):
            remote.get(folder, [name])
    remote.get(folder, [name for name in (CARD, MANIFEST) if name in names])
    return folder
