"""Files that appear whole or not at all, say what wrote them, and are refused when they are damaged or foreign."""

from __future__ import annotations

import glob
import hashlib
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = ["VERSION", "read_hdf5", "require_folder", "require_writable", "seal", "write_hdf5", "written_whole"]

_BLOCK = 512
_ABANDONED_S = 60.0
_MAGIC = b"torchpcct, HDF5 from byte 512, SHA-256 of it: "
_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"

VERSION = "0.1.0"
"""Of this software, as in pyproject.toml; files carry it."""


def require_folder(path: str | os.PathLike[str]) -> None:
    """Raise ``FileNotFoundError`` unless the folder that ``path`` would be written to exists."""
    parent = Path(path).parent
    if not parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: the folder {parent} does not exist, create it first")


def require_writable(folder: str | os.PathLike[str]) -> None:
    """Make a folder, and raise ``OSError`` if it is a file or nothing can be written into it."""
    path = Path(folder)
    if path.exists() and not path.is_dir():
        raise NotADirectoryError(f"{path} is a file: name a folder to write to")
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise type(error)(f"cannot write into {path} ({error.strerror or error}): name another folder") from error


def _sweep(target: Path) -> None:
    """Remove temporary files of ``target`` that processes of this machine left behind when they were killed."""
    for part in target.parent.glob(f".*.part.{glob.escape(target.name)}"):
        owner = part.name[1:].split(".", 1)[0]
        if not owner.isdigit() or time.time() - part.stat().st_mtime < _ABANDONED_S:
            continue
        try:
            os.kill(int(owner), 0)
        except ProcessLookupError:
            part.unlink(missing_ok=True)
        except OSError:  # of another user: alive
            pass


@contextmanager
def written_whole(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary name beside ``path``; on success flush it to the disk and rename it to ``path``.

    Whoever reads ``path`` at any moment, also after a crash, finds the old content or the new one, whole. On any
    failure the temporary file is removed; one that a killed process left is removed by the next write, a minute later.

    Raises:
        FileNotFoundError: the folder of ``path`` does not exist.
    """
    target = Path(path)
    require_folder(target)
    _sweep(target)
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
def write_hdf5(path: str | os.PathLike[str], kind: str) -> Iterator[Any]:
    """Yield a new HDF5 file of the format ``torchpcct-KIND``, written whole or not at all and sealed.

    HDF5 checks neither its data nor its structure, and a damaged structure can make it wait forever. So the first 512
    bytes, which HDF5 leaves to the user, hold the SHA-256 of all the others: :func:`read_hdf5` compares it before HDF5
    sees the file.
    """
    import h5py

    with written_whole(path) as part:
        try:
            with h5py.File(part, "w", userblock_size=_BLOCK) as file:
                file.attrs["format"] = f"torchpcct-{kind}"
                yield file
        except RuntimeError as error:  # what HDF5 makes of a full disk when it closes a file
            raise OSError(f"cannot write {path}: {error}") from error
        seal(part)


def seal(path: str | os.PathLike[str]) -> None:
    """Write the checksum of a file of :func:`write_hdf5`, also after it was changed on purpose."""
    with open(path, "r+b") as file:
        file.seek(_BLOCK)
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        file.seek(0)
        file.write((_MAGIC + digest.encode() + b"\n").ljust(_BLOCK, b"\0"))


def is_sealed(path: str | os.PathLike[str]) -> bool:
    """Whether a file begins with the checksum of :func:`write_hdf5`, right or wrong."""
    with open(path, "rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def _check_seal(path: str | os.PathLike[str], kind: str) -> None:
    with open(path, "rb") as file:
        head = file.read(_BLOCK)
        if head.startswith(_HDF5_SIGNATURE):
            return  # of an earlier version without checksum, or foreign
        if not head.startswith(_MAGIC):
            raise ValueError(f"{path} is no torchpcct {kind}, or its beginning is damaged")
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if head != (_MAGIC + digest.encode() + b"\n").ljust(_BLOCK, b"\0"):
        raise ValueError(
            f"{path} is truncated or damaged: its content does not have the checksum that it was written with; take "
            "another copy of it, or make it again"
        )


@contextmanager
def read_hdf5(path: str | os.PathLike[str], kind: str) -> Iterator[Any]:
    """Open an HDF5 file whose attribute ``format`` is ``torchpcct-KIND``, for a block that reads it.

    The checksum of a file of :func:`write_hdf5` is verified before.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is truncated, altered, of another format, or the block does not find what it looks for.
    """
    import h5py

    try:
        _check_seal(path, kind)
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != f"torchpcct-{kind}":
                raise ValueError(f"{path} is an HDF5 file, but not a torchpcct {kind}")
            yield file
    except FileNotFoundError:
        raise
    except Exception as error:  # a damaged file without checksum can make h5py, or what is built from it, fail anyhow
        if isinstance(error, ValueError) and str(path) in str(error):
            raise
        raise ValueError(
            f"{path} cannot be read as a torchpcct {kind} (truncated, damaged or foreign): {error}"
        ) from error


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
