"""Finished pieces of a study on disk: each appears whole or not at all, and is reused by the next run."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchpcct.files import written_whole

__all__ = ["Store"]

log = logging.getLogger(__name__)


_MARK = "\nSHA-256 "
"""Parts the key from the checksum of the arrays. Pieces of earlier versions have none, and are taken as they are."""


def _digest(key: str, arrays: Mapping[str, Any]) -> str:
    total = hashlib.sha256(key.encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        total.update(f"{name} {array.dtype.str} {array.shape};".encode())
        total.update(array.tobytes())
    return total.hexdigest()


class Store:
    """A folder of ``.npz`` files, each with the key (settings, parameters) that it was made with.

    Args:
        folder: made if need be.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def path(self, name: str) -> Path:
        """A file's path; its folder is made if need be."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def piece(self, name: str, key: str, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The arrays of a piece: read if it was finished with the same key, else computed and written.

        Args:
            name: path in the folder, without ending.
            key: everything that the piece depends on.
            compute: gives the arrays.
        """
        path = self.path(name + ".npz")
        if path.exists():
            try:
                with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
                    arrays = {k: file[k] for k in file.files if k != "key"}
                    found, mark, digest = str(file["key"]).partition(_MARK)
                if mark and digest != _digest(found, arrays):
                    raise ValueError("its content does not have its checksum")
                if found == key:
                    return arrays
                log.info("%s was made with other settings: computed again", path)
            except Exception as error:  # a damaged archive can fail in any way
                log.warning("%s cannot be read (%s): computed again", path, error)
        arrays = compute()
        with written_whole(path) as part:
            np.savez(part, key=np.array(key + _MARK + _digest(key, arrays)), **arrays)
        return arrays
