"""One clear error for files that are truncated, damaged or something else, and one for packages that are missing."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = ["MOST_READINGS", "check_size", "needed", "reading"]

MOST_READINGS = 2**36
"""Headers that promise more numbers than this are damaged; nothing is allocated for them."""


def needed(package: str) -> Any:
    """An optional package; ``ImportError`` that says how to install it."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ImportError(f"this format needs {package}: pip install torchpcct[io]") from error


@contextmanager
def reading(path: str | os.PathLike[str], what: str) -> Iterator[None]:
    """For a block that reads ``path`` as ``what``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: anything that the libraries raise at damaged contents; errors of this package pass with the path.
    """
    if not Path(path).exists():
        raise FileNotFoundError(f"no such file: {path}")
    try:
        yield
    except (ImportError, KeyboardInterrupt):
        raise
    except MemoryError as error:
        raise ValueError(f"{path} asks for more memory than there is: is its header damaged? ({error})") from error
    except Exception as error:
        text = str(error).strip().splitlines()
        raise ValueError(f"{path} cannot be read as {what}: {text[0] if text else type(error).__name__}") from error


def check_size(shape: Any, what: str) -> None:
    """Refuse a shape that a damaged header may promise (ValueError)."""
    total = 1
    for n in shape:
        if int(n) < 1:
            raise ValueError(f"{what} has the shape {tuple(shape)}: it holds nothing")
        total *= int(n)
    if total > MOST_READINGS:
        raise ValueError(f"{what} has the shape {tuple(shape)}: too large to be true")
