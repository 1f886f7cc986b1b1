"""One clear error for files that are truncated, damaged or something else, and one for packages that are missing."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = ["MOST_READINGS", "check_size", "needed", "read_yaml", "reading", "yaml_values"]

MOST_READINGS = 2**36
"""Headers that promise more numbers than this are damaged; nothing is allocated for them."""


def needed(package: str) -> Any:
    """An optional package; ``ImportError`` that says how to install it."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ImportError(f"this format needs {package}: pip install torchpcct[io]") from error


_MOST_TEXT, _LONGEST_TEXT, _MOST_VALUES, _DEEPEST_YAML = 2**24, 2**14, 2**20, 32
"""Of a YAML file: 16 MiB, a million numbers (twelve of each of 87 000 views)."""


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


def read_yaml(path: str | os.PathLike[str], what: str) -> Any:
    """Values of a YAML file of a user, read as ``what`` with :func:`yaml_values`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no YAML, or one that asks for more than its bounds.
    """
    with reading(path, what), open(path, "rb") as file:
        return yaml_values(file.read(_MOST_TEXT + 1).decode("utf-8"))


def yaml_values(text: str) -> Any:
    """Values of a YAML text, bounded: a few hundred bytes of aliases to aliases can stand for any number of values.

    Raises:
        ValueError: no YAML; deeper, or of more values with its aliases written out, than any description is.
    """
    import yaml

    if len(text) > _MOST_TEXT:
        raise ValueError(f"it has more than {_MOST_TEXT} characters: put arrays into .npy files")
    loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        _check_yaml(yaml.parse(text, Loader=loader))
        return yaml.load(text, Loader=loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f" in line {mark.line + 1}, column {mark.column + 1}"
        raise ValueError(f"it is no YAML: {getattr(error, 'problem', None) or error}{where}") from error


def _check_yaml(events: Any) -> None:
    """Count what a text stands for as it is parsed, before anything is built."""
    import yaml

    counts, names = [0], [None]  # of the open collections, and their anchors
    anchored: dict[Any, int] = {}
    for event in events:
        if isinstance(event, yaml.CollectionStartEvent):
            if len(counts) > _DEEPEST_YAML:
                raise ValueError(f"it is nested more than {_DEEPEST_YAML} deep")
            counts.append(1)
            names.append(event.anchor)
        elif isinstance(event, yaml.CollectionEndEvent):
            count, name = counts.pop(), names.pop()
            counts[-1] += count
            if name is not None:
                anchored[name] = count
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in anchored:
                raise ValueError(f"its alias *{event.anchor} stands for nothing, or for what it is a part of")
            counts[-1] += anchored[event.anchor]
        elif isinstance(event, yaml.ScalarEvent):
            if len(event.value) > _LONGEST_TEXT:
                raise ValueError(f"it holds a text or number of more than {_LONGEST_TEXT} characters")
            counts[-1] += 1
            if event.anchor is not None:
                anchored[event.anchor] = 1
        if counts[-1] > _MOST_VALUES:
            raise ValueError(f"it stands for more than {_MOST_VALUES} values: put arrays into .npy files")


def check_size(shape: Any, what: str) -> None:
    """Refuse a shape that a damaged header may promise (ValueError)."""
    total = 1
    for n in shape:
        if int(n) < 1:
            raise ValueError(f"{what} has the shape {tuple(shape)}: it holds nothing")
        total *= int(n)
    if total > MOST_READINGS:
        raise ValueError(f"{what} has the shape {tuple(shape)}: too large to be true")
