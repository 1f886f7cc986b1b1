"""The report of an evaluation: tables, all records as CSV and JSON, pictures, and the whole as one
HTML file.

Its text is a template in Jinja's language (``templates/evaluation.md.j2``). :func:`filled` and
:func:`write_report` serve the reports of :mod:`recon.study`, too.
"""

from __future__ import annotations

import csv
import html
import io
import json
import math
import os
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from recon.evaluate.estimates import Record
from recon.evaluate.experiment import Evaluation, TaskResult
from torchpcct.files import write_together
from torchpcct.viz import base64_text

if TYPE_CHECKING:
    from jinja2 import Environment
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from recon.evaluate.without_truth import Comparison

__all__ = ["save", "text_of"]

COLUMNS = ("task", "method", "exposure_s", "figure", "where", "value", "low", "high", "unit", "n")
"""Of the table ``report.csv``."""
_WINDOW_HU = (-160.0, 240.0)
"""Of the pictures: black and white, HU."""
_STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;color:#222;max-width:75rem;margin:2rem "
    "auto;padding:0 1rem}"
    "td{white-space:nowrap}p{max-width:55rem}"
    "table{border-collapse:collapse;margin:1rem 0;font-size:13px;display:block;overflow-x:auto;"
    "font-variant-numeric:tabular-nums}td,th{border:1px solid #ccc;padding:.2rem "
    ".5rem;text-align:right}"
    "th{background:#f2f4f6}tr:hover "
    "td{background:#f7f9fb}td:first-child,th:first-child{text-align:left}"
    "img{max-width:100%}code{background:#f2f4f6;overflow-wrap:anywhere}"
)
"""Of the page."""


def text_of(evaluation: Evaluation) -> str:
    """Markdown."""
    return "\n".join(["# Evaluation\n", *task_sections(evaluation)])


def task_sections(evaluation: Evaluation) -> list[str]:
    """Markdown of each task."""
    sections = []
    for seen in evaluation.results:
        task, ground_truth = seen.task, seen.ground_truth
        records = [r for r in evaluation.records if r["task"] == task.name]
        given = {
            "task": task,
            "values": dict(zip(ground_truth.tissues, ground_truth.values_hu, strict=True)),
            "true_hu": seen.true_hu,
            "found": {(r["method"], r["exposure_s"], r["figure"], r["where"]): r for r in records},
            "n": evaluation.settings["n"],
        }
        sections.append(filled(Path(__file__).parent / "templates" / "evaluation.md.j2", given))
    return sections


def plain(records: Iterable[Mapping[str, object]]) -> list[dict[str, object]]:
    """JSON values: None for NaN."""
    return [
        {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in r.items()}
        for r in records
    ]


def filled(template: Path, data: Mapping[str, object]) -> str:
    """A template's text with the values of ``data``, see :func:`templates`.

    Raises:
        jinja2.UndefinedError: a value that the template asks for is missing.
    """
    text: str = templates(template.parent).get_template(template.name).render(data)
    return text


@cache
def templates(folder: Path) -> Environment:
    """The ``jinja2.Environment`` of a folder's templates, where missing values are errors.

    Filters besides Jinja's: ``f(spec)``, a figure or the value of a record by Python's format, a
    dash where there is none; ``interval(spec)``, a record or ``[value, low, high]`` as ``1.53
    [1.47, 1.59]``, the value alone if it is exact; ``rounded``, the same with as many digits as
    tell something; ``cell``, text for a cell of a table; ``row(key=value, ...)``, the one of a list
    that has these values; ``record(task, method, exposure_s, figure, where)``, a record of a
    report. Test: ``finite``.
    """
    import jinja2

    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {
        "f": _figure,
        "interval": _interval,
        "rounded": _rounded,
        "row": _row,
        "record": lambda report, *key: _row(
            report["records"], **dict(zip(COLUMNS, key, strict=False))
        ),
        "cell": lambda text: str(text).replace("|", "\\|"),
    }
    made.tests["finite"] = math.isfinite
    return made


def _figure(found: float | Mapping[str, float | None] | None, spec: str) -> str:
    value = found["value"] if isinstance(found, Mapping) else found
    return "–" if value is None or math.isnan(value) else format(value, spec)


def _interval(value: Any, spec: str = ".2f") -> str:
    middle, low, high = (
        (value[k] for k in ("value", "low", "high")) if isinstance(value, Mapping) else value
    )
    text = _figure(middle, spec)
    return (
        text if low is None or not math.isfinite(low) else f"{text} [{low:{spec}}, {high:{spec}}]"
    )


def _rounded(r: Record) -> str:
    size = abs(r["value"])
    digits = max(0, 1 - math.floor(math.log10(size))) if size else 0
    return _interval(r, f".{min(digits + (1 if size < 10 and r['unit'] == '' else 0), 3)}f")


def _row(rows: list[Record], **wanted: object) -> Record:
    fits = [r for r in rows if wanted.items() <= r.items()]
    if len(fits) != 1:
        raise ValueError(f"{len(fits)} rows have {wanted}: exactly one must")
    return fits[0]


def save(evaluation: Evaluation, folder: str | os.PathLike[str], command: str = "") -> list[Path]:
    """Write ``report.md``, ``report.json``, ``report.csv``, ``report.html`` and a picture for each
    task.

    Args:
        evaluation: what :func:`recon.evaluate.evaluate` returns.
        folder: it is made if it does not exist; reports in it are replaced.
        command: that repeats the evaluation, for the end of the report; "": none.

    Returns:
        The files written.
    """
    text = text_of(evaluation) + (f"\nCommand: `{command}`.\n" if command else "")
    for seen in evaluation.results:
        name = seen.task.name
        text = text.replace(f"## {name}\n", f"## {name}\n\n![{name}]({name}.png)\n")
    table = io.StringIO()
    writer = csv.DictWriter(table, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(
        [{k: "" if v is None else v for k, v in r.items()} for r in plain(evaluation.records)]
    )
    data = {
        "settings": evaluation.settings,
        "command": command,
        "records": plain(evaluation.records),
    }
    pictures = {f"{s.task.name}.png": _picture(s) for s in evaluation.results}
    more = {"report.csv": table.getvalue().encode()}
    return write_report(folder, "Evaluation", text, json.dumps(data, indent=1), pictures, more)


def measured_text(rows: list[Comparison], unit: str, reference: str) -> str:
    """Markdown of noise at equal resolution.

    Args:
        rows: of :func:`recon.evaluate.without_truth.evaluate_volumes`.
        unit: of the volumes.
        reference: name of the method that the others are compared with.
    """
    given = {"rows": rows, "unit": unit, "reference": reference}
    return filled(Path(__file__).parent / "templates" / "measured.md.j2", given)


def save_measured(
    rows: list[Comparison],
    unit: str,
    reference: str,
    folder: str | os.PathLike[str],
    command: str = "",
) -> list[Path]:
    """Write ``report.md``, ``.json``, ``.csv`` and ``.html`` of :func:`measured_text`; the files
    written."""
    text = measured_text(rows, unit, reference) + (f"\nCommand: `{command}`.\n" if command else "")
    finite = [
        {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in r.items()}
        for r in rows
    ]
    data = {"command": command, "unit": unit, "reference": reference, "records": finite}
    table = io.StringIO()
    writer = csv.DictWriter(table, list(rows[0]) if rows else ["method"], lineterminator="\n")
    writer.writeheader()
    writer.writerows([{k: "" if v is None else v for k, v in r.items()} for r in finite])
    title = "Noise at equal resolution"
    return write_report(
        folder,
        title,
        text,
        json.dumps(data, indent=1),
        {},
        {"report.csv": table.getvalue().encode()},
    )


def write_report(
    folder: str | os.PathLike[str],
    title: str,
    text: str,
    values: str,
    figures: Mapping[str, Figure],
    more: Mapping[str, bytes] | None = None,
) -> list[Path]:
    """Write a report into ``folder`` (made if need be), all files of it or, where one cannot be
    written, none.

    Args:
        folder: for ``report.json``, ``report.md``, the figures and ``report.html``.
        title: of the page.
        text: Markdown.
        values: JSON.
        figures: file name → matplotlib figure.
        more: file name → content.

    Returns:
        The files written.
    """
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    pictures = {}
    for name, figure in figures.items():
        buffer = io.BytesIO()
        figure.savefig(buffer, format=Path(name).suffix[1:])
        pictures[name] = buffer.getvalue()
    contents = {
        "report.json": f"{values}\n".encode(),
        "report.md": text.encode(),
        **(more or {}),
        **pictures,
    }
    contents["report.html"] = page(title, text, pictures).encode()
    return write_together(out, contents)


def _picture(seen: TaskResult) -> Figure:
    """The signal's fullest slice: truth, then every method at every exposure."""
    from matplotlib.figure import Figure

    z = int(seen.task.volume_fractions["signal"].sum((1, 2)).argmax())
    methods = list(dict.fromkeys(m for m, _ in seen.volumes))
    exposures = sorted({e for _, e in seen.volumes})
    figure = Figure((2.0 * (len(methods) + 1), 2.2 * len(exposures)), dpi=120, layout="constrained")
    axes = figure.subplots(len(exposures), len(methods) + 1, squeeze=False)
    middle = seen.ground_truth.values_hu[1]
    low, high = _WINDOW_HU if abs(middle) < 400 else (middle - 300.0, middle + 300.0)
    for row, exposure in zip(axes, exposures, strict=True):
        shown: list[tuple[str, NDArray[np.floating]]] = [
            ("truth", seen.truth),
            *((m, seen.volumes[m, exposure][0]) for m in methods),
        ]
        for ax, (name, volume) in zip(row, shown, strict=True):
            ax.imshow(
                np.asarray(volume[z], np.float32), cmap="gray", vmin=low, vmax=high, origin="lower"
            )
            ax.set_title(name if name == "truth" else f"{name}, {exposure:g} s", fontsize=6)
            ax.axis("off")
    return figure


def page(title: str, text: str, pictures: Mapping[str, bytes]) -> str:
    """A report as one HTML page, without network.

    Args:
        title: of the page.
        text: Markdown; a picture that it names stands there, the others at its end.
        pictures: file name → its content, PNG or SVG.
    """
    from markdown_it import MarkdownIt

    rest = "".join(f"\n\n![{name}]({name})" for name in pictures if f"]({name})" not in text)
    body = MarkdownIt("commonmark", {"html": False}).enable("table").render(text + rest)
    for name, content in pictures.items():
        kind = "svg+xml" if name.endswith(".svg") else "png"
        body = body.replace(
            f'src="{name}"', f'src="data:image/{kind};base64,{base64_text(content)}"'
        )
    return (
        '<!doctype html>\n<html lang="en"><meta charset="utf-8"><meta name="viewport" '
        'content="width=device-width">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style>\n<body>{body}</body></html>\n"
    )
