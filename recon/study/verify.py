"""Every figure of the README comes from a committed result: which key it is, and whether it still says so.

``notebooks/claims.yaml`` lists the README's sentences that hold figures. Each entry is

* ``text``: the sentence, every figure as ``{name:format}`` (:func:`format`'s language; ``{name:|format}`` for its
  size without the sign), and every word that hinges on a sign as a choice: ``{name?rises|falls}`` by whether the value
  is above 0, ``{a>b?more|less}`` by which of two is larger (b may be a number). :data:`DIRECTIONS` stand nowhere else;
* ``values``: name → ``file: path``, where file lies beside ``claims.yaml`` and path is a chain of keys separated by
  ``/``. Brackets pick the one row of a list that has these values: ``rows[method=mbir,exposure_s=2.0]/slope``.
  ``worst of file: path`` is the largest size among the values of a mapping, ``worst name of file: path`` whose it is,
  ``file: path ÷ file: path`` the ratio of two.

:func:`verify` formats each sentence anew and looks for it in the README; :func:`rewrite` puts the new figures in.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

__all__ = [
    "DIRECTIONS",
    "Claim",
    "Verdict",
    "differences",
    "load_claims",
    "lookup",
    "rewrite",
    "uncovered",
    "unproven",
    "verify",
]

RESULTS = ("The measured dose factor", "The studies")
"""Sections of the README whose figures are results: a claim must cover each."""

PASSING = (
    "seconds",
    "environment",
    "machine",
    "command",
    "speed",
    "rays_per_second",
    "rays_per_core_second",
    "threads",
)
"""Keys of results that tell of the run and not of what was found: they differ from run to run."""

DIRECTIONS = re.compile(
    r"\b(loses|gains|falls?|falling|rises?|raises|lowers|saves|grows|shrinks|reach|(less|larger|smaller|worse|"
    r"noisier|quieter|higher|lower) than|too (large|small|high|low|thick|thin))\b"
)
"""Words that are wrong where a figure has the other sign: a claim with figures chooses them by it."""

_FIELD = re.compile(r"\{(\w+)(?:>([\w.]+))?(?:\?([^|}]*)\|([^|}]*)|:([^}]*))?\}")
"""A figure, or a choice of words: name, what it is compared with, the words if it is larger and if not, format."""

_WORST, _WORST_NAME = "worst of ", "worst name of "
_FIGURE = r"([-+−]?\d+(?:[.,]\d+)*%?|[A-Za-z]\w*(?:\s\w+)?)"
_ROW = re.compile(r"^([^[]*)\[(.+)\]$")


@dataclass(frozen=True)
class Claim:
    """A sentence of the README with the keys of its figures.

    Args:
        text: with a field for every figure, and for every word that hinges on a sign.
        values: name → ``"file: path"``.
    """

    text: str
    values: Mapping[str, str]

    def said(self, folder: Path) -> str:
        """The sentence with the committed figures.

        Raises:
            ValueError: a file, key or figure is missing, or the format does not fit.
        """

        def read(place: str) -> Any:
            file, _, path = place.removeprefix(_WORST).removeprefix(_WORST_NAME).partition(":")
            value = lookup(_read(folder / file.strip()), path.strip())
            if not place.startswith((_WORST, _WORST_NAME)):
                return value
            name = max(value, key=lambda k: abs(value[k]))
            return abs(value[name]) if place.startswith(_WORST) else name.replace("_", " ")

        def value_of(name: str) -> Any:
            if name not in self.values:
                raise ValueError(f"claim {self.text!r} gives no value for {{{name}}}")
            first, _, divisor = self.values[name].partition(" ÷ ")
            value = read(first)
            return value / read(divisor) if divisor else value

        def figure(match: re.Match[str]) -> str:
            name, other, larger, smaller, how = match.groups()
            value = value_of(name)
            try:
                if larger is not None:
                    least = value_of(other) if other in self.values else float(other or 0)
                    return str(larger if value > least else smaller)
                how = how or ""
                return format(abs(value), how[1:]) if how.startswith("|") else format(value, how)
            except (TypeError, ValueError):
                raise ValueError(f"{self.values[name]} is {value!r}, which {match[0]} cannot show") from None

        return _FIELD.sub(figure, self.text)

    def pattern(self) -> re.Pattern[str]:
        """Finds the sentence with any figures, over any line breaks."""
        parts = []
        last = 0
        for match in _FIELD.finditer(self.text):
            words = match[3] is not None
            parts += [
                _loose(self.text[last : match.start()]),
                f"({_loose(match[3])}|{_loose(match[4])})" if words else _FIGURE,
            ]
            last = match.end()
        return re.compile("".join([*parts, _loose(self.text[last:])]))


@dataclass(frozen=True)
class Verdict:
    """What became of a claim: ``said`` by the committed results, ``found`` in the README (None: nowhere)."""

    claim: Claim
    said: str
    found: str | None

    @property
    def ok(self) -> bool:
        """Whether the README says what the results say."""
        return self.found is not None and _words(self.found) == _words(self.said)


def load_claims(path: Path) -> list[Claim]:
    """Claims of a YAML file.

    Raises:
        ValueError: an entry is not a mapping of ``text`` and ``values``.
    """
    entries = yaml.safe_load(path.read_text(encoding="utf-8"))
    claims = []
    for k, entry in enumerate(entries or []):
        if not isinstance(entry, dict) or set(entry) != {"text", "values"}:
            raise ValueError(f"{path}: entry {k} must hold text and values, got {entry!r}")
        claims.append(Claim(str(entry["text"]).strip(), {str(n): str(v) for n, v in entry["values"].items()}))
    return claims


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
                raise ValueError(f"no {walked} in the results: mend the claim, or run the study again") from None
        if wanted is not None:
            fits = [r for r in here if all(_same(r.get(k), v) for k, v in wanted.items())]
            if len(fits) != 1:
                raise ValueError(f"{len(fits)} rows fit {walked}: exactly one must")
            here = fits[0]
    return here


def verify(readme: str, claims: list[Claim], folder: Path) -> list[Verdict]:
    """Look for every claim in the README.

    Args:
        readme: its text.
        claims: of :func:`load_claims`.
        folder: with the files that claims name.

    Raises:
        ValueError: a claim names what the results do not hold.
    """
    verdicts = []
    for claim in claims:
        match = claim.pattern().search(readme)
        verdicts.append(Verdict(claim, claim.said(folder), match[0] if match else None))
    return verdicts


def rewrite(readme: str, claims: list[Claim], folder: Path) -> str:
    """The README with the committed figures in every sentence that a claim finds; line breaks stay."""
    for claim in claims:
        match = claim.pattern().search(readme)
        if match is None:
            continue
        new = iter(claim.pattern().fullmatch(claim.said(folder)).groups())  # type: ignore[union-attr]
        start, text = match.start(), match[0]
        for k in range(len(match.groups()), 0, -1):
            low, high = (p - start for p in match.span(k))
            text = f"{text[:low]}\0{k}\0{text[high:]}"
        for k, figure in enumerate(new, 1):
            text = text.replace(f"\0{k}\0", figure)
        readme = readme[:start] + text + readme[match.end() :]
    return readme


def uncovered(readme: str, claims: list[Claim], sections: tuple[str, ...]) -> Iterator[str]:
    """Lines with figures in the named sections of the README that no claim covers.

    Args:
        readme: its text.
        claims: that cover parts of it.
        sections: headings (without ``#``) whose figures are results.
    """
    covered = [match.span() for claim in claims if (match := claim.pattern().search(readme))]
    place, inside = 0, False
    for line in readme.splitlines(keepends=True):
        if line.startswith("#"):
            inside = line.lstrip("#").strip() in sections
        elif inside and line.strip() and not re.fullmatch(r"[|\s:-]*", line):
            left = "".join(c for k, c in enumerate(line, place) if not any(low <= k < high for low, high in covered))
            plain = re.sub(r"\]\([^)]*\)|`[^`]*`", "", left)
            if re.search(r"\d", plain):
                yield line.rstrip()
        place += len(line)


def unproven(claims: list[Claim]) -> Iterator[str]:
    """Claims with figures that say a direction as a fixed word, which the figures' signs do not choose."""
    for claim in claims:
        if claim.values and (found := DIRECTIONS.search(_FIELD.sub(" ", claim.text))):
            yield f"{found[0]!r} is no choice in {claim.text!r}: write {{name?{found[0]}|…}}"


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


def _read(path: Path) -> Any:
    try:
        return _parsed(path, path.stat().st_mtime_ns)
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}") from None


@lru_cache(maxsize=16)
def _parsed(path: Path, changed_ns: int) -> Any:
    """A report, parsed once for all claims that it answers; ``changed_ns`` tells a new one from the old."""
    return json.loads(path.read_text(encoding="utf-8"))


def _same(value: Any, text: str) -> bool:
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            return float(text) == float(value)
        except ValueError:
            return False
    return str(value) == text


def _loose(text: str) -> str:
    return re.sub(r"(?:\\\s|\s)+", r"\\s+", re.escape(text))


def _words(text: str) -> str:
    return " ".join(text.split())
