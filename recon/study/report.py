"""What every study leaves behind: ``report.json``, ``report.md``, ``report.html`` and figures, each written whole."""

from __future__ import annotations

import io
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from recon.evaluate.report import page
from torchpcct.files import atomic_write

__all__ = ["Report", "by_sign", "markdown_table", "or_dash", "records_table"]


def or_dash(value: float, digits: int) -> str:
    """A table's cell: the value, or a dash for NaN."""
    return "–" if math.isnan(value) else f"{value:.{digits}f}"


def by_sign(value: float, above: str, below: str, zero: float = 0.0) -> str:
    """The word for a figure above ``zero`` (1 of a ratio), or for one that is not: directions are not fixed."""
    return above if value > zero else below


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table, first column left, the others right aligned, padded so that it reads well as plain text."""
    cells = [list(header), *[list(map(str, r)) for r in rows]]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]

    def line(row: Sequence[str]) -> str:
        padded = [c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))]
        return "| " + " | ".join(padded) + " |"

    rule = "|" + "|".join((":" if i == 0 else "") + "-" * (w + 1) + (":" if i else "") for i, w in enumerate(widths))
    return "\n".join([line(cells[0]), rule + "|", *map(line, cells[1:])])


def records_table(records: Iterable[Mapping[str, Any]], columns: Mapping[str, str]) -> str:
    """A table of records; ``columns``: heading → format of the cell, e.g. ``"{dqe:.3f} ± {dqe_error:.3f}"``."""
    return markdown_table(list(columns), [[cell.format(**record) for cell in columns.values()] for record in records])


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if hasattr(value, "_asdict"):
        return value._asdict()
    return str(value)


@dataclass
class Report:
    """A study's result.

    Args:
        name: of the study.
        data: JSON values (NumPy arrays and scalars are converted).
        text: Markdown.
        figures: file name → matplotlib figure.
        screen: what a terminal shows of it; empty: the text.
    """

    name: str
    data: dict[str, Any]
    text: str
    figures: dict[str, Any] = field(default_factory=dict)
    screen: str = ""

    def made_by(self, command: str) -> None:
        """Add the command that repeats the study to values and text."""
        self.data["command"] = command
        self.text += f" Command: `{command}`."

    @property
    def json(self) -> str:
        """The values as JSON text."""
        return json.dumps(self.data, indent=1, default=_plain)

    def save(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write ``report.json``, ``report.md``, the figures and ``report.html`` into ``folder`` (made if need be).

        Returns:
            The files written.
        """
        out = Path(folder)
        out.mkdir(parents=True, exist_ok=True)
        contents = {"report.json": f"{self.json}\n".encode(), "report.md": f"{self.text}\n".encode()}
        pictures = {name: _drawn(figure, name) for name, figure in self.figures.items()}
        title = f"torchpcct: {self.name}"
        contents |= {**pictures, "report.html": page(title, self.text, pictures).encode()}
        for name, content in contents.items():
            with atomic_write(out / name) as part:
                part.write_bytes(content)
        return [out / name for name in contents]


def _drawn(figure: Any, name: str) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format=Path(name).suffix[1:])
    return buffer.getvalue()
