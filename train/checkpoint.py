"""Checkpoints: one safetensors file per state, written so that a crash at any moment leaves a whole one.

A file holds tensors, and in its header JSON metadata with a checksum of the tensors; nothing in it is executed on
loading. A new file is written beside its place, flushed to the disk, and renamed over it; the one before stays as
``previous``.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_bytes
from torch import Tensor

__all__ = [
    "CheckpointError",
    "Store",
    "digest",
    "read_tensors",
    "write_atomically",
    "write_tensors",
]

CHECKPOINT_FORMAT = "torchpcct training checkpoint 1"
TEMPORARY = re.compile(r"\.\d+\.tmp$")


class CheckpointError(RuntimeError):
    """A file is not what it should be: damaged, of another kind, or of another version."""


def write_atomically(path: Path, data: bytes) -> None:
    """Replace a file by another content: whoever reads it at any moment finds the old or the new one, whole.

    Args:
        path: in an existing folder.
        data: new content.
    """
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    # A rename is on the disk only after its folder is. Folders cannot be opened on Windows.
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def digest(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of names, types, shapes and values."""
    total = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name]
        total.update(f"{name} {tensor.dtype} {tuple(tensor.shape)};".encode())
        total.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return total.hexdigest()


def write_tensors(path: Path, kind: str, tensors: Mapping[str, Tensor], metadata: Mapping[str, Any]) -> None:
    """Write a safetensors file atomically.

    Args:
        path: file.
        kind: what it holds; :func:`read_tensors` asks for it.
        tensors: any names and types; copied to the CPU.
        metadata: JSON values, floats exact; no NaN or infinity.
    """
    # Copies, as safetensors refuses tensors that share memory.
    plain = {name: t.detach().cpu().contiguous().clone() for name, t in tensors.items()}
    header = {
        "format": kind,
        "sha256": digest(plain),
        "metadata": json.dumps(dict(metadata), ensure_ascii=False, allow_nan=False),
    }
    write_atomically(path, to_bytes(plain, header))


def read_tensors(path: Path, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and metadata of a file of :func:`write_tensors`.

    Raises:
        CheckpointError: missing, cut short, altered, or not of this kind.
    """
    if not path.is_file():
        raise CheckpointError(f"{path} does not exist")
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            if header.get("format") != kind:
                raise CheckpointError(f"{path} is not a {kind!r} file (its format is {header.get('format')!r})")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
        metadata = json.loads(header["metadata"])
    except (SafetensorError, KeyError, ValueError, OSError) as error:
        raise CheckpointError(f"{path} is damaged or not a safetensors file: {error}") from error
    if digest(tensors) != header.get("sha256"):
        raise CheckpointError(f"{path} is damaged: its tensors do not have the checksum in its header")
    return tensors, metadata


class Store:
    """The checkpoint of a run and the one before it.

    Args:
        folder: of the run.
    """

    def __init__(self, folder: Path) -> None:
        self.current = folder / "checkpoint.safetensors"
        self.previous = folder / "checkpoint.previous.safetensors"

    def save(self, tensors: Mapping[str, Tensor], metadata: Mapping[str, Any]) -> None:
        """Write the checkpoint; the one in place becomes the previous one."""
        fresh = self.current.with_name("checkpoint.next.safetensors")
        write_tensors(fresh, CHECKPOINT_FORMAT, tensors, metadata)
        # Killed between the two renames, the run goes on from the previous checkpoint, which is then the newest one
        # that had been completed.
        if self.current.exists():
            os.replace(self.current, self.previous)
        os.replace(fresh, self.current)
        _sync_folder(self.current.parent)

    def load(self) -> tuple[dict[str, Tensor], dict[str, Any], str | None]:
        """Tensors and metadata of the newest whole checkpoint, and a warning if that is not the current one.

        Raises:
            CheckpointError: there is none; the message says why for each file.
        """
        try:
            return (*read_tensors(self.current, CHECKPOINT_FORMAT), None)
        except CheckpointError as error:
            first = error
        try:
            tensors, metadata = read_tensors(self.previous, CHECKPOINT_FORMAT)
        except CheckpointError as second:
            raise CheckpointError(f"no checkpoint to resume from: {first}; {second}") from second
        return tensors, metadata, f"{first}; continuing from the previous checkpoint {self.previous.name}"

    def clean(self) -> None:
        """Remove temporary files that a killed process left behind."""
        for path in self.current.parent.iterdir():
            if TEMPORARY.search(path.name) or path.name == "checkpoint.next.safetensors":
                path.unlink(missing_ok=True)
