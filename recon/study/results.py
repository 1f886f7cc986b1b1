"""What the studies found, in sentences whose figures are read from the committed reports.

``notebooks/results.template.md`` is Markdown with fields in double braces; :func:`render` fills them in and gives
``notebooks/RESULTS.md`` and the block of the README between its two marks; the reports of the studies are rendered from
their values, too. So no sentence can disagree with a result:
``torchpcct verify`` renders again and compares. A field is

* ``{{FILE: PATH | FORMAT}}``: FILE lies in ``notebooks``, a name alone means its ``report.json``; PATH is a chain of
  keys separated by ``/``, brackets pick the one row of a list that has these values: ``rows[method=mbir]/slope``;
  FORMAT is Python's, after ``abs`` without the sign, after ``interval`` with that of a record: ``1.53 [1.47, 1.59]``;
* ``{{NAME: TASK, METHOD, EXPOSURE, FIGURE, WHERE | FORMAT}}``: a record of an evaluation (:mod:`recon.evaluate`), its
  value or its interval;
* ``{{FILE: PATH > NUMBER ? words | other words}}``: words that hinge on a figure; without a number it is compared
  with 0.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from recon.study import registry, report

__all__ = ["README_MARKS", "differences", "lookup", "render"]

README_MARKS = ("<!-- results: rendered by torchpcct verify --write -->", "<!-- end of results -->")
"""Between them stands in README.md, and in the template, what both share."""

PASSING = (
    "seconds",
    "environment",
    "machine",
    "command",
    "speed",
    "rays_per_second",
    "rays_per_core_second",
    "threads",
    "peak_memory",
    "tables",
)
"""Keys of results that tell of the run and not of what was found: they differ from run to run. Tables are Markdown of
records that stand beside them, and hold seconds."""

_FIELD = re.compile(r"\{\{([^:{}]+):([^{}]+)\}\}")
_RECORD = ("task", "method", "exposure_s", "figure", "where")
_ROW = re.compile(r"^([^[]*)\[(.+)\]$")


def render(root: Path) -> dict[str, str]:
    """File, relative to the repository ``root``, → its text with the committed figures: RESULTS.md, README.md and the
    ``report.md`` of every study that is committed.

    Raises:
        ValueError: a report, key or figure is missing, a format does not fit, a mark is missing.
    """
    folder = root / "notebooks"
    template = (folder / "results.template.md").read_text(encoding="utf-8")
    text = _FIELD.sub(lambda match: _filled(folder, match), template)
    readme = (root / "README.md").read_text(encoding="utf-8")
    first, last = README_MARKS
    if any(part.count(mark) != 1 for part in (text, readme) for mark in README_MARKS):
        raise ValueError(f"README.md and results.template.md must hold each of {first} and {last} once")
    block = text[text.index(first) : text.index(last)]
    reports = {study: folder / study / "report.json" for study in map(registry.folder, registry.STUDIES)}
    return {
        **{
            f"notebooks/{study}/report.md": report.render(study, _parsed(path, path.stat().st_mtime_ns)) + "\n"
            for study, path in reports.items()
            if path.exists()
        },
        "README.md": readme[: readme.index(first)] + block + readme[readme.index(last) :],
        "notebooks/RESULTS.md": "\n".join(line for line in text.splitlines() if line not in README_MARKS) + "\n",
    }


def _filled(folder: Path, match: re.Match[str]) -> str:
    name, rest = match[1].strip(), match[2].strip()
    path = folder / name if name.endswith(".json") else folder / name / "report.json"
    place, choice, words = rest.partition("?")
    if not choice:
        place, _, how = rest.rpartition("|")
        return _shown(_value(path, place.strip()), how.strip(), match[0])
    place, _, least = place.partition(">")
    value = _value(path, place.strip())
    figure = value["value"] if isinstance(value, dict) else value
    larger, _, smaller = words.partition("|")
    return (larger if figure > float(least or 0) else smaller).strip()


def _value(path: Path, place: str) -> Any:
    """A key's value, or a record of an evaluation."""
    try:
        data = _parsed(path, path.stat().st_mtime_ns)
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}") from None
    parts = [part.strip() for part in place.split(", ")]
    if "/" in place or len(parts) != len(_RECORD):
        return lookup(data, place)
    wanted = ",".join(f"{key}={part}" for key, part in zip(_RECORD, parts, strict=True))
    return lookup(data, f"records[{wanted}]")


def _shown(value: Any, how: str, field: str) -> str:
    kind, _, rest = how.rpartition(" ")
    record = value if isinstance(value, dict) else {"value": value}
    try:
        figure = abs(record["value"]) if kind == "abs" else record["value"]
        text = format(figure, rest)
        if kind == "interval" and record.get("low") is not None:
            text += f" [{format(record['low'], rest)}, {format(record['high'], rest)}]"
    except (KeyError, TypeError, ValueError):
        raise ValueError(f"{value!r} is no figure that {field} can show") from None
    return text


def lookup(data: Any, path: str) -> Any:
    """The value under a path of keys; see the module's docstring.

    Raises:
        ValueError: a key that is not there, a row that is not there or not the only one.
    """
    here, walked = data, ""
    for step in path.split("/"):
        walked += f"/{step}"
        row = _ROW.match(step)
        name, wanted = (row[1], dict(w.split("=", 1) for w in row[2].split(","))) if row else (step, None)
        if name:
            try:
                here = here[int(name)] if isinstance(here, list) else here[name]
            except (KeyError, IndexError, TypeError, ValueError):
                raise ValueError(f"no {walked} in the results: mend the template, or run the study again") from None
        if wanted is not None:
            fits = [r for r in here if all(_same(r.get(k), v) for k, v in wanted.items())]
            if len(fits) != 1:
                raise ValueError(f"{len(fits)} rows fit {walked}: exactly one must")
            here = fits[0]
    return here


def differences(committed: Any, again: Any, tolerance: float = 1e-3, place: str = "") -> Iterator[str]:
    """Where a result that was computed again differs from the committed one.

    Args:
        committed, again: JSON values.
        tolerance: relative, on every figure; other machines round sums otherwise. Figures below 1e-6 count as 0.
        place: path so far, of the messages.

    Yields:
        A line for each difference: its path, then the committed value and the new one.
    """
    if isinstance(committed, dict) and isinstance(again, dict):
        for key in sorted({*committed, *again}):
            if not any(word in key for word in PASSING):
                yield from differences(committed.get(key), again.get(key), tolerance, f"{place}/{key}")
    elif isinstance(committed, list) and isinstance(again, list) and len(committed) == len(again):
        for k, (a, b) in enumerate(zip(committed, again, strict=True)):
            yield from differences(a, b, tolerance, f"{place}/{k}")
    elif isinstance(committed, int | float) and isinstance(again, int | float):
        both_undetermined = math.isnan(committed) and math.isnan(again)
        if not both_undetermined and not math.isclose(committed, again, rel_tol=tolerance, abs_tol=1e-6):
            yield f"{place}: {committed} → {again}"
    elif committed != again:
        yield f"{place}: {committed!r} → {again!r}"


@lru_cache(maxsize=16)
def _parsed(path: Path, changed_ns: int) -> Any:
    """A report, parsed once for all fields that it answers; ``changed_ns`` tells a new one from the old."""
    return json.loads(path.read_text(encoding="utf-8"))


def _same(value: Any, text: str) -> bool:
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            return float(text) == float(value)
        except ValueError:
            return False
    return str(value) == text
