"""What every study leaves behind: ``report.json``, ``report.md``, ``report.html`` and figures, each
written whole.

The text is a template (``templates/NAME.md.j2``, in Jinja's language) filled in from the JSON
values, so that it can be rendered from a committed ``report.json``. Templates write Markdown tables
as they come to mind; :func:`aligned` pads them. A word that hinges on a figure is chosen there by
the figure's sign.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from recon.evaluate.report import filled, write_report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from torchpcct.typing import Json, JsonObject


TEMPLATES = Path(__file__).parent / "templates"
"""Of the studies' texts."""


@dataclass(frozen=True)
class Check:
    """One figure that a study must show.

    Args:
        name: what it is, with its unit.
        ours: as measured; NaN where it could not be determined (never inside).
        paper: the published figure as text, or as a number.
        low, high: accepted range, both ends included; infinite where open.
        note: where it is outside: the computed cause.
    """

    name: str
    ours: float
    paper: float | str
    low: float = -math.inf
    high: float = math.inf
    note: str = ""

    @property
    def ok(self) -> bool:
        """Whether the figure lies in the accepted range."""
        return bool(self.low <= self.ours <= self.high)

    def explained(self, cause: str) -> Check:
        """The check with ``cause`` as its note, where it is outside."""
        return self if self.ok or not cause else replace(self, note=cause)

    def as_dict(self) -> dict[str, float | str | bool | None]:
        """JSON values, ``ok`` among them; open ends are None."""
        ends = {
            k: v if math.isfinite(v) else None for k, v in (("low", self.low), ("high", self.high))
        }
        return {**vars(self), **ends, "ours": float(self.ours), "ok": self.ok}


def around(name: str, ours: float, paper: float, tolerance: float, note: str = "") -> Check:
    """A check that accepts ``paper`` ± ``tolerance``."""
    return Check(name, ours, paper, paper - tolerance, paper + tolerance, note)


def render(name: str, data: Mapping[str, object]) -> str:
    """The text of a report, or another text of a study.

    Args:
        name: of the template, without its ending, e.g. ``"phantom"``.
        data: JSON values of the report.

    Returns:
        Markdown without a line break at its end.

    Raises:
        jinja2.UndefinedError: a value that the template asks for is missing.
    """
    text = filled(TEMPLATES / f"{name}.md.j2", data)
    return aligned(re.sub(r"\n{3,}", "\n\n", text).strip())


def aligned(text: str) -> str:
    """Markdown whose tables are padded so that they read well as plain text; columns but the
    first to the right."""
    return re.sub(r"(?:^\|.*\|$\n?){2,}", lambda m: _padded(m[0]), text, flags=re.MULTILINE)


def _padded(table: str) -> str:
    rows = [[c.strip() for c in re.split(r"(?<!\\)\|", line)[1:-1]] for line in table.splitlines()]
    widths = [
        max(map(len, column))
        for column in zip(*(r for k, r in enumerate(rows) if k != 1), strict=True)
    ]
    rule = [
        "|",
        *(
            (":" if i == 0 else "") + "-" * (w + 1) + (":" if i else "") + "|"
            for i, w in enumerate(widths)
        ),
    ]

    def line(row: Sequence[str]) -> str:
        cells = (
            c.ljust(w) if i == 0 else c.rjust(w)
            for i, (c, w) in enumerate(zip(row, widths, strict=True))
        )
        return f"| {' | '.join(cells)} |"

    return "\n".join([line(rows[0]), "".join(rule), *map(line, rows[2:])]) + (
        "\n" if table.endswith("\n") else ""
    )


def _plain(value: object) -> Json:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    return str(value)


@dataclass
class Report:
    """A study's result.

    Args:
        name: of the study, and of its template.
        data: JSON values (NumPy arrays and scalars are converted).
        figures: file name → matplotlib figure.
        screen_template: name of the template of what a terminal shows of it; empty: the text.
    """

    name: str
    data: JsonObject
    figures: dict[str, Figure] = field(default_factory=dict)
    screen_template: str = ""

    @property
    def json(self) -> str:
        """The values as JSON text."""
        return json.dumps(self.data, indent=1, default=_plain)

    @property
    def text(self) -> str:
        """Markdown, of the values alone."""
        return render(self.name, json.loads(self.json))

    @property
    def screen(self) -> str:
        """What a terminal shows."""
        return render(self.screen_template or self.name, json.loads(self.json))

    def save(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write ``report.json``, ``report.md``, the figures and ``report.html`` into ``folder``
        (made if need be).

        Returns:
            The files written.
        """
        return write_report(
            folder, f"torchpcct: {self.name}", f"{self.text}\n", self.json, self.figures
        )
