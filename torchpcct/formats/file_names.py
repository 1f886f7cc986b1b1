"""Files of one scan: which ones a pattern means, and the order that the numbers in their names
give."""

from __future__ import annotations

import glob
import itertools
import re
import unicodedata
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

_WHOLE = re.compile(r"\d+")
"""Whole numbers in a name."""
_DECIMAL = re.compile(r"(?:(?<![0-9A-Za-z])-)?\d+(?:\.\d+)?")
"""Numbers with a sign where it does not join two words, and with a decimal point."""
_CHAIN = re.compile(r"\d+\.\d+\.\d+")
"""Sections, dates or identifiers rather than decimals."""
_SHOWN = 4
"""File names that a message lists at most."""
_FEW = 8
"""Files of which no gap is told: too few to know how they count."""
_LACKING = 0.1
"""Share of the files that may be missing at most: where more are, they were left out on purpose."""
_COUNT = 10
"""Times the number of files that a count of views reaches at most; times of day are larger."""
_ONE_KIND = (("tif", "tiff"), ("yaml", "yml"), ("h5", "hdf5", "hdf"), ("nxs", "nx", "nx5"))
"""Endings in small letters that name one format."""


def matching(pattern: str, folder: Path) -> list[Path]:
    """Files that a name or pattern means, in the order of the numbers in their names.

    A pattern may be an absolute path. Its ending is found in any capitals (``.TIF`` for ``.tif``)
    and, where no file has it, another one of the same format is (``.tiff``), unless it holds
    brackets (``*.ti[f]``). Hidden files (``._1.tif`` of a Mac) are left out, as a shell does. A
    file or folder that is called like a part of the pattern itself is that one (``run [1]``).
    Letters with accents are found in both of their encodings, which look alike.

    Args:
        pattern: ``*``, ``?``, ``[...]`` and ``**`` as in a shell.
        folder: that a relative name starts from.

    Raises:
        FileNotFoundError: no file.
        ValueError: two files that differ in such endings alone, one image twice.
    """
    spellings = dict.fromkeys(
        [pattern, *(unicodedata.normalize(form, pattern) for form in ("NFC", "NFD"))]
    )
    for spelling in spellings:
        if (folder / spelling).exists():
            return [folder / spelling]
    if not glob.has_magic(pattern):
        raise FileNotFoundError(f"no such file: {folder / pattern}{_hint(pattern)}")
    files: list[Path] = []
    for place, part in (_without_folders(folder, spelling) for spelling in spellings):
        for wanted in _with_its_endings(part):
            found = {place / name for name in glob.glob(wanted, root_dir=place, recursive=True)}
            files += sorted(p for p in found if not p.is_dir() or p.suffix.lower() == ".zarr")
            if files:
                break
        if files:
            break
    else:
        raise FileNotFoundError(f"no file matches {folder / pattern}{_hint(pattern)}")
    stems: dict[tuple[Path, tuple[str, ...]], Path] = {}
    for path in files:
        other = stems.setdefault((path.with_suffix(""), _kind(path.suffix[1:])), path)
        if other is not path:
            raise ValueError(
                f"{other} and {path.name} both match {pattern}, one image twice: remove one of "
                f"them, or put a letter of the ending in brackets, as {pattern[:-1]}"
                f"[{pattern[-1]}], to match it alone"
            )
    return in_number_order(files)


def _without_folders(folder: Path, pattern: str) -> tuple[Path, str]:
    """The folder in which the rest of a pattern is looked for: what leads there by its own name
    may hold brackets and other characters of patterns."""
    parts = Path(pattern).parts
    while len(parts) > 1 and (folder / parts[0]).is_dir():
        folder, parts = folder / parts[0], parts[1:]
    return folder, str(Path(*parts))


def _hint(pattern: str) -> str:
    """What may have been meant by a name that no file has."""
    if re.search(r"\{.*\}|%0?\d*d|#", pattern):
        return ": patterns are written with * and ?, as p_*.tif"
    if pattern.startswith("~") or "$" in pattern:
        return ": ~ and $NAME are not replaced here, write the folder out"
    if "[" in pattern:
        return ": [0-9] stands for one of the characters in it, [[] for a bracket itself"
    return ""


def gap_in_numbers(paths: Sequence[Path]) -> str:
    """Between which two of the files numbers are left out that count up in equal steps else; empty
    where none are, or where the numbers are no count of views (a time of day, several numbers).

    Args:
        paths: of one series, in any order.
    """
    keys = [_parts(str(path.with_suffix("")), _WHOLE) for path in paths]
    if len(paths) < _FEW or len({len(key) for key in keys}) > 1:
        return ""
    changing = [values for values in zip(*keys, strict=True) if len(set(values)) > 1]
    if len(changing) != 1 or not all(isinstance(value, float) for value in changing[0]):
        return ""
    order = sorted(zip(map(float, changing[0]), paths, strict=True))
    steps = [b[0] - a[0] for a, b in itertools.pairwise(order)]
    usual = Counter(steps).most_common(1)[0][0]
    if usual <= 0.0 or any(step % usual for step in steps):
        return ""
    first, last = order[0][0], order[-1][0]
    lacking = (last - first) / usual + 1 - len(paths)
    if not 0 < lacking <= _LACKING * len(paths) or last > _COUNT * len(paths) * usual:
        return ""
    at = next(k for k, step in enumerate(steps) if step > usual)
    return f"{order[at][1].name} and {order[at + 1][1].name}"


def _kind(ending: str) -> tuple[str, ...]:
    """All endings of the format that one names, without the dot."""
    return next((kind for kind in _ONE_KIND if ending.lower() in kind), (ending.lower(),))


def _with_its_endings(pattern: str) -> list[str]:
    """Patterns that find the same names in any capitals, with the own ending first, then with each
    other one of the same format."""
    stem, point, ending = pattern.rpartition(".")
    if not point or not ending or set(ending) & set("[]/\\"):
        return [pattern]
    return [
        f"{stem}." + "".join(f"[{c}{c.upper()}]" if c.isalpha() else c for c in each)
        for each in sorted(_kind(ending), key=ending.lower().__ne__)
    ]


def in_number_order(paths: Sequence[Path]) -> list[Path]:
    """Files in the order of the numbers in their names: ``p_2`` before ``p_10``.

    Numbers are whole, or have signs and decimals, whichever counts up in equal steps. A
    ``UserWarning`` says which one was taken where another order is possible and no steps decide:
    text order where numbers are missing, or decimals against sections (``1.9``, ``1.10``).
    """
    text = sorted(paths)
    if len(text) < 2:
        return text
    names = [str(path.with_suffix("")) for path in text]
    decimals = not any(_CHAIN.search(name) for name in names)
    kinds = (_WHOLE, _DECIMAL) if decimals else (_WHOLE,)
    orders = []
    for kind in kinds:
        keys = [_parts(name, kind) for name in names]
        order = [k for _, _, k in sorted(zip(keys, names, range(len(names)), strict=True))]
        orders.append((order, _counts_up(keys)))
    known = [order for order, even in orders if even]
    taken = known[0] if known else orders[-1][0]
    others = known[1:] if known else [list(range(len(names))), *(order for order, _ in orders)]
    for other in others:
        if other != taken:
            asked, instead = (
                ", ".join(text[k].name for k in order[:_SHOWN]) for order in (taken, other)
            )
            warnings.warn(
                f"the names of {len(text)} files do not determine their order: they are read as "
                f"{asked} (by the numbers), not as {instead}; a list of the names sets it",
                UserWarning,
                stacklevel=2,
            )
            break
    return [text[k] for k in taken]


def _parts(name: str, number: re.Pattern[str]) -> tuple[str | float, ...]:
    """Text and numbers of a name in turn, text first and last."""
    texts, values = number.split(name), number.findall(name)
    return tuple(
        part for pair in zip(texts, [*map(float, values), 0.0], strict=True) for part in pair
    )


def _counts_up(keys: Sequence[tuple[str | float, ...]]) -> bool:
    """Whether names that differ in numbers alone run through all combinations of evenly spaced
    ones, each once."""
    if len({len(key) for key in keys}) > 1 or len(set(keys)) < len(keys):
        return False
    combinations = 1
    for values in map(sorted, map(set, zip(*keys, strict=True))):
        if len(values) > 1 and isinstance(values[0], str):
            return False
        steps = [b - a for a, b in itertools.pairwise(values)]
        if steps and max(steps) - min(steps) > 1e-6 * max(abs(v) for v in values):
            return False
        combinations *= len(values)
    return combinations == len(keys)
