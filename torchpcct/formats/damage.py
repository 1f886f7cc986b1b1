"""One clear error for files that are truncated, damaged or something else, and one for packages
that are missing."""

from __future__ import annotations

import codecs
import importlib
import io
import math
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchpcct.files import require_ordinary
from torchpcct.memory import free_bytes

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from types import ModuleType

    from torchpcct.typing import Array


MOST_READINGS = 2**36
"""Headers that promise more numbers than this are damaged; nothing is allocated for them."""


def needed(package: str) -> ModuleType:
    """An optional package; ``ImportError`` that says how to install it."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ImportError(f"this format needs {package}: pip install torchpcct[io]") from error


_MOST_TEXT = 2**24
"""Characters of a YAML file at most, 16 MiB."""
_LONGEST_TEXT = 2**14
"""Characters of one text or number in it at most."""
_MOST_VALUES = 2**20
"""Values in it at most: a million numbers (twelve of each of 87 000 views)."""
_DEEPEST_YAML = 32
"""Its deepest nesting."""
_LONGEST_TABLE = 2**28
"""Bytes of a text file of numbers."""
_MOST_EXPANSION = 200
"""How many times as small as its content a packed file may be."""
_SMALL = 2**30
"""Bytes up to which that does not matter: no scan or volume of more is packed so much."""
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
"""Byte order marks that a text may begin with, and its encoding."""


@contextmanager
def reading(path: str | os.PathLike[str], what: str) -> Iterator[None]:
    """For a block that reads ``path`` as ``what``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a device or a pipe; anything that the libraries raise at damaged contents;
            errors of this package pass with the path.
    """
    if not Path(path).exists():
        raise FileNotFoundError(f"no such file: {path}")
    require_ordinary(path)
    try:
        yield
    except (ImportError, KeyboardInterrupt):
        raise
    except MemoryError as error:
        raise ValueError(
            f"{path} asks for more memory than there is: is its header damaged? ({error})"
        ) from error
    except Exception as error:
        text = str(error).strip().splitlines()
        raise ValueError(
            f"{path} cannot be read as {what}: {text[0] if text else type(error).__name__}"
        ) from error


def read_yaml(path: str | os.PathLike[str], what: str) -> object:
    """Values of a YAML file of a user, read as ``what`` with :func:`yaml_values`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no YAML, or one that asks for more than its bounds.
    """
    with reading(path, what):
        return yaml_values(_decoded(_beginning(path, _MOST_TEXT + 1)))


def _beginning(path: str | os.PathLike[str], most: int) -> bytes:
    with open(path, "rb") as file:
        return file.read(most)


def _decoded(content: bytes) -> str:
    """Text in UTF-8, or as its byte-order mark says, which editors of Windows set."""
    return content.decode(
        next((name for mark, name in _MARKS if content.startswith(mark)), "utf-8")
    )


def read_text(path: str | os.PathLike[str], what: str, other: str | None = None) -> str:
    """A text file of at most 256 MiB, read as ``what``, with or without a byte-order mark.

    Args:
        path: file.
        what: it is, in messages.
        other: encoding of files that are not UTF-8, where what matters is ASCII; characters that it
            does not know are replaced. None: refused.

    Raises:
        FileNotFoundError: no such file. ValueError: no text, or a longer one.
    """
    with reading(path, what):
        return _text(path, other)


def _text(path: str | os.PathLike[str], other: str | None = None) -> str:
    content = _beginning(path, _LONGEST_TABLE + 1)
    if len(content) > _LONGEST_TABLE:
        raise ValueError(f"it has more than {_LONGEST_TABLE} bytes")
    try:
        return _decoded(content)
    except UnicodeDecodeError:
        if other is None or any(content.startswith(mark) for mark, _ in _MARKS):
            raise
        return content.decode(other, errors="replace")


def read_numbers(path: str | os.PathLike[str], what: str) -> Array:
    """Numbers of a ``.npy`` or text file, in columns as they stand there.

    Raises:
        FileNotFoundError: no such file. ValueError: damaged, or something else than numbers.
    """
    with reading(path, what):
        if Path(path).suffix.lower() == ".npy":
            # A map of the file fails where its header promises more than there is.
            return np.array(np.load(path, mmap_mode="r", allow_pickle=False))
        return _table(_text(path))


def _table(text: str) -> Array:
    """Rows of numbers, ``#`` before a comment.

    Raises:
        ValueError: no numbers, or a word that is none.
    """
    rows = (line.split("#", 1)[0] for line in text.splitlines())
    if not any(row.strip() for row in rows):
        raise ValueError("it holds no numbers")
    try:
        return np.loadtxt(io.StringIO(text), dtype=np.float64)
    except ValueError as error:
        where = _no_number(text)
        if where is None:
            raise
        raise ValueError(
            f"{where} is no number: write numbers with a decimal point, columns apart by blanks, "
            "and # before a comment"
        ) from error


def _no_number(text: str) -> str | None:
    """The first word of a table that is no number, and its line."""
    for number, line in enumerate(text.splitlines(), start=1):
        for word in line.split("#", 1)[0].split():
            try:
                float(word)
            except ValueError:
                return f"{word[:30]!r} in line {number}"
    return None


def yaml_values(text: str) -> object:
    """Values of a YAML text, bounded: a few hundred bytes of aliases to aliases can stand for any
    number of values.

    Raises:
        ValueError: no YAML; a name given twice; deeper, or of more values with its aliases written
            out, than any description is.
    """
    import yaml

    if len(text) > _MOST_TEXT:
        raise ValueError(f"it has more than {_MOST_TEXT} characters: put arrays into .npy files")
    loader: type = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        _check_yaml(yaml.parse(text, Loader=loader))
        return _constructed(loader(text))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f" in line {mark.line + 1}, column {mark.column + 1}"
        raise ValueError(
            f"it is not YAML: {getattr(error, 'problem', None) or error}{where}"
        ) from error


def _constructed(loader: Any) -> object:
    """Values of the one document of a loader, once its nodes are checked."""
    try:
        node = loader.get_single_node()
        _check_nodes(node)
        return None if node is None else loader.construct_document(node)
    finally:
        loader.dispose()


_SIXTIES = re.compile(r"[-+]?[0-9_]+(:[0-9_]+)+(\.[0-9_]*)?")
"""What YAML 1.1 reads to the base of 60."""
_OCTAL = re.compile(r"[-+]?0[0-7_]+")
"""What YAML 1.1 reads to the base of 8."""


def _check_nodes(root: Any) -> None:
    """Refuse what YAML reads otherwise than it looks, without a word: names that a mapping has
    twice, of which it takes the last, and numbers to another base."""
    import yaml

    nodes: list[Any] = [root]
    seen: set[int] = set()
    while nodes:
        node = nodes.pop()
        if isinstance(node, yaml.ScalarNode):
            _check_base(node)
        if not isinstance(node, yaml.CollectionNode) or id(node) in seen:
            continue
        seen.add(id(node))  # aliases are the same node
        if not isinstance(node, yaml.MappingNode):
            nodes.extend(node.value)
            continue
        lines: dict[object, int] = {}
        for key, value in node.value:
            nodes.append(value)
            if isinstance(key, yaml.ScalarNode) and key.value != "<<":
                line = key.start_mark.line + 1
                if key.value in lines:
                    raise ValueError(
                        f"it has {key.value} twice, in line {lines[key.value]} and line {line}: "
                        "leave one out"
                    )
                lines[key.value] = line


def _check_base(node: Any) -> None:
    """Refuse a number that YAML 1.1 reads to the base of 8 or 60."""
    if node.style or not node.tag.endswith((":int", ":float")):
        return
    digits = node.value.replace("_", "")
    octal = _OCTAL.fullmatch(node.value) and int(digits, 8) != int(digits)
    if octal or _SIXTIES.fullmatch(node.value):
        raise ValueError(
            f"its {node.value[:30]} in line {node.start_mark.line + 1} is a number to the base of "
            f"{8 if octal else 60} in YAML: write it without leading zeros and colons, or a text "
            "in quotes"
        )


def _check_yaml(events: Iterable[object]) -> None:
    """Count what a text stands for as it is parsed, before anything is built."""
    import yaml

    counts, names = [0], [None]  # of the open collections, and their anchors
    anchored: dict[object, int] = {}
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
                raise ValueError(
                    f"its alias *{event.anchor} is undefined, or refers to a part that contains it"
                )
            counts[-1] += anchored[event.anchor]
        elif isinstance(event, yaml.ScalarEvent):
            if len(event.value) > _LONGEST_TEXT:
                raise ValueError(
                    f"it holds a text or number of more than {_LONGEST_TEXT} characters"
                )
            counts[-1] += 1
            if event.anchor is not None:
                anchored[event.anchor] = 1
        if counts[-1] > _MOST_VALUES:
            raise ValueError(
                f"it stands for more than {_MOST_VALUES} values: put arrays into .npy files"
            )


def check_size(shape: Sequence[int], what: str) -> None:
    """Refuse a shape that a damaged header may promise (ValueError)."""
    total = 1
    for n in shape:
        if int(n) < 1:
            raise ValueError(f"{what} has the shape {tuple(shape)}: it is empty")
        total *= int(n)
    if total > MOST_READINGS:
        raise ValueError(
            f"{what} has the shape {tuple(shape)}, too large for a scan or volume: its header is "
            "probably damaged"
        )


def check_expansion(
    shape: Sequence[int], what: str, packed: int | Callable[[], int], each: int = 4
) -> None:
    """Refuse numbers that are to be read into memory if they do not fit, or if no file so small can
    hold them.

    Args:
        shape: of the numbers.
        what: they are, for the message.
        packed: bytes that hold them in the file, or a function that counts them.
        each: bytes of a number in memory.

    Raises:
        ValueError: more than the memory that is free; more than 1 GiB, and 200 times what the file
            holds.
    """
    check_size(shape, what)
    size = math.prod(int(n) for n in shape) * each
    if size > _SMALL:
        held = packed() if callable(packed) else packed
        if size > _MOST_EXPANSION * held:
            raise ValueError(
                f"{what} of {size / 2**30:.3g} GiB is compressed to {held / 2**20:.3g} MiB, more "
                f"than {_MOST_EXPANSION} times: the file is damaged, or not a scan or volume"
            )
    free = free_bytes()
    if size > free:
        raise ValueError(
            f"{what} needs {size / 2**30:.3g} GiB, {free / 2**30:.3g} GiB of memory are free"
        )
