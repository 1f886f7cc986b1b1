"""Tensors in safetensors files that know their own checksum: shipped weights, training checkpoints.

The header of a file names what it holds, JSON metadata, and the SHA-256 of tensors and metadata.
Nothing in it is executed on loading, and a byte that has changed on the way is found.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpcct.files import atomic_write

if TYPE_CHECKING:
    from torchpcct.typing import JsonObject

_HEADER = {"format", "sha256", "metadata", "sha256_of_metadata"}
"""Keys that every file has."""


class TensorFileError(ValueError):
    """A file is not what it should be: missing, damaged, of another kind, or of another version."""


def digest(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of names, types, shapes and values."""
    total = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name]
        total.update(f"{name} {tensor.dtype} {tuple(tensor.shape)};".encode())
        total.update(
            tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
        )
    return total.hexdigest()


def write_tensors(
    path: Path, kind: str, tensors: Mapping[str, Tensor], metadata: Mapping[str, object]
) -> None:
    """Write a file, whole or not at all.

    Args:
        path: file in an existing folder.
        kind: what it holds; :func:`read_tensors` asks for it.
        tensors: any names and types; copied to the CPU.
        metadata: JSON values, floats exact; no NaN or infinity.
    """
    from safetensors.torch import save  # loads with its first use

    # Copies, as safetensors refuses tensors that share memory.
    plain = {name: t.detach().cpu().contiguous().clone() for name, t in tensors.items()}
    text = json.dumps(dict(metadata), ensure_ascii=False, allow_nan=False)
    header = {
        "format": kind,
        "sha256": digest(plain),
        "metadata": text,
        "sha256_of_metadata": _sha256(text),
    }
    with atomic_write(path) as part:
        # save_file writes a temporary file of its own, and leaves it if killed
        part.write_bytes(save(plain, header))


def read_tensors(path: Path, kind: str) -> tuple[dict[str, Tensor], JsonObject]:
    """Tensors and metadata of a file of :func:`write_tensors`.

    Raises:
        TensorFileError: missing, cut short, altered, or not of this kind.
    """
    from safetensors import SafetensorError, safe_open  # loads with its first use

    if not path.is_file():
        raise TensorFileError(f"{path} does not exist")
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            if header.get("format") != kind:
                raise TensorFileError(
                    f"{path} is not a {kind!r} file (its format is {header.get('format')!r})"
                )
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
        text = header["metadata"]
        metadata = json.loads(text)
    except TensorFileError:
        raise
    except (SafetensorError, KeyError, ValueError, RuntimeError, OSError) as error:
        raise TensorFileError(
            f"{path} is damaged or not a safetensors file: {error}; take another copy of it"
        ) from error
    # Files of the first versions have a checksum of the tensors alone.
    expected = {
        "sha256": digest(tensors),
        "sha256_of_metadata": header.get("sha256_of_metadata") and _sha256(text),
    }
    if not set(header) <= _HEADER or any(
        header.get(name) != value for name, value in expected.items()
    ):
        raise TensorFileError(
            f"{path} is damaged: its content does not have the checksum in its header; take "
            "another copy of it"
        )
    return tensors, metadata


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
