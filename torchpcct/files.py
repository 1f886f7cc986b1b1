"""Files that appear whole or not at all, say what wrote them, and are refused when they are damaged or foreign."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = ["VERSION", "read_hdf5", "require_folder", "written_whole"]

VERSION = "0.1.0"
"""Of this software, as in pyproject.toml; files carry it."""


def require_folder(path: str | os.PathLike[str]) -> None:
    """Raise ``FileNotFoundError`` unless the folder that ``path`` would be written to exists."""
    parent = Path(path).parent
    if not parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: the folder {parent} does not exist, create it first")


@contextmanager
def written_whole(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary name beside ``path``; on success flush it to the disk and rename it to ``path``.

    Whoever reads ``path`` at any moment, also after a crash, finds the old content or the new one, whole. On any
    failure the temporary file is removed.

    Raises:
        FileNotFoundError: the folder of ``path`` does not exist.
    """
    target = Path(path)
    require_folder(target)
    # Keep the ending: some writers choose the format by it.
    part = target.with_name(f".{os.getpid()}.part.{target.name}")
    try:
        yield part
        _sync(part)
        os.replace(part, target)
        _sync(target.parent)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def read_hdf5(path: str | os.PathLike[str], kind: str) -> Iterator[Any]:
    """Open an HDF5 file whose attribute ``format`` is ``torchpcct-KIND``, for a block that reads it.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is truncated, of another format, or the block does not find what it looks for.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != f"torchpcct-{kind}":
                raise ValueError(f"{path} is an HDF5 file, but not a torchpcct {kind}")
            yield file
    except FileNotFoundError:
        raise
    except (OSError, KeyError, RuntimeError) as error:
        raise ValueError(f"{path} cannot be read as a torchpcct {kind} (truncated or foreign): {error}") from error


def _sync(path: Path) -> None:
    # A rename can reach the disk before the content does: without this, a power cut may leave an empty file.
    try:
        handle = os.open(path, os.O_RDONLY)
    except OSError:  # folders cannot be opened on some systems, which sync them by themselves
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
