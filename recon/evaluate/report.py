"""The report of an evaluation: tables, all records as CSV and JSON, pictures, and the whole as one HTML file."""

from __future__ import annotations

import csv
import html
import io
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from recon.evaluate.estimates import Record, pivot
from recon.evaluate.experiment import Evaluation, TaskResult
from torchpcct.files import atomic_write
from torchpcct.viz import base64_text

__all__ = ["page", "plain", "save", "task_sections", "text_of"]

COLUMNS = ("task", "method", "exposure_s", "figure", "where", "value", "low", "high", "unit", "n")
_WINDOW_HU = (-160.0, 240.0)
_STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;color:#222;max-width:75rem;margin:2rem auto;padding:0 1rem}"
    "td{white-space:nowrap}p{max-width:55rem}"
    "table{border-collapse:collapse;margin:1rem 0;font-size:13px;display:block;overflow-x:auto;"
    "font-variant-numeric:tabular-nums}td,th{border:1px solid #ccc;padding:.2rem .5rem;text-align:right}"
    "th{background:#f2f4f6}tr:hover td{background:#f7f9fb}td:first-child,th:first-child{text-align:left}"
    "img{max-width:100%}code{background:#f2f4f6;overflow-wrap:anywhere}"
)
_INTRO = """\
Dose factor: the dose that {reference} needs for the same figure, divided by the dose of the method. Brackets: 95 %
intervals over {n} noise realisations, the same for all methods; figures without brackets are exact. Noise: standard
deviation of a voxel. Error: root mean square near the bodies. Undershoot: lowest error beside them, without noise; far
below 0 means a dark rim. Slope: contrast that the signal adds, over the true one; contrasts are compared at slope 1.
Without signal: contrast that is read where there is none. CNR: contrast-to-noise ratio by the paper's protocol. d′: how
well an observer who knows the place detects the signal. Limit: the best that an unbiased estimate can do."""


def text_of(evaluation: Evaluation) -> str:
    """Markdown."""
    return "\n".join(["# Evaluation\n", *task_sections(evaluation)])


def task_sections(evaluation: Evaluation) -> list[str]:
    """Markdown of each task."""
    n = evaluation.settings["n"]
    return [
        _task_text(seen, [r for r in evaluation.records if r["task"] == seen.task.name], n)
        for seen in evaluation.results
    ]


def plain(records: list[Record]) -> list[Record]:
    """JSON values: None for NaN."""
    return [{k: None if isinstance(v, float) and math.isnan(v) else v for k, v in r.items()} for r in records]


def _task_text(seen: TaskResult, records: list[Record], n: int) -> str:
    task = seen.task
    values = ", ".join(f"{t} {v:.0f}" for t, v in zip(seen.facts.tissues, seen.facts.values_hu, strict=True))
    lines = [
        f"## {task.name}", "", f"{task.title[:1].upper()}{task.title[1:]}." if task.title else "",
        f"HU on this scanner: {values}. Contrast in the ROIs (small, slice, lesion): "
        f"{', '.join(f'{v:.0f}' for v in seen.true_hu.values())} HU.", "",
        _INTRO.format(reference=task.reference, n=n), "",
    ]  # fmt: skip
    exposures = sorted({r["exposure_s"] for r in records})
    tissues = [t for t in seen.task.flat if t in {r["where"] for r in records if r["figure"] == "noise"}]
    columns: list[tuple[str, str, str]] = [
        *((f"noise in {'background' if t == task.background else t}, HU", "noise", t) for t in tissues),
        ("error, HU", "error", "near the bodies"),
        ("error without noise, HU", "error without noise", "near the bodies"),
        ("undershoot, HU", "undershoot without noise", "beside the bodies"),
        *((f"slope, {roi}", "slope", roi) for roi in seen.true_hu),
        ("without signal, lesion, HU", "contrast without signal", "lesion"), ("CNR", "CNR", "small"),
        ("d′, slice", "d'", "axial"), ("d′, volume", "d'", "volume"), ("s", "seconds", "a volume"),
    ]  # fmt: skip
    factors: list[tuple[str, str, str]] = [
        *((f"noise in {'background' if t == task.background else t}", "dose factor: noise", t) for t in tissues),
        ("CNR", "dose factor: CNR", "small"),
        *((f"contrast, {roi}", "dose factor: contrast at slope 1", roi) for roi in seen.true_hu),
        ("d′, slice", "dose factor: d'", "axial"), ("d′, volume", "dose factor: d'", "volume"),
    ]  # fmt: skip
    for exposure in exposures:
        here = [r for r in records if r["exposure_s"] == exposure]
        limit = next(r["value"] for r in here if r["figure"] == "dose factor: limit of the data")
        summary = f"Dose factors (limit of the data over the lesion: {limit:.2f}):"
        tables = (_table(here, factors), "", _table(here, columns))
        lines += [f"### {exposure:g} s", "", summary, "", *tables, "", _best(here, factors), ""]
    return "\n".join(lines)


def _table(records: list[Record], columns: list[tuple[str, str, str]]) -> str:
    methods = list(dict.fromkeys(r["method"] for r in records))
    kept = [c for c in columns if any(r["figure"] == c[1] and r["where"] == c[2] for r in records)]
    rows = ["| method | " + " | ".join(label for label, _, _ in kept) + " |", "|---" * (len(kept) + 1) + "|"]
    for method in methods:
        cells = []
        for _, figure, where in kept:
            found = [v for (m, _, w), v in pivot(records, figure).items() if m == method and w == where]
            cells.append(_cell(found[0]) if found else "–")
        rows.append(f"| {method} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def _cell(r: Record) -> str:
    value, low, high = r["value"], r["low"], r["high"]
    digits = max(0, 1 - math.floor(math.log10(abs(value)))) if value else 0
    digits = min(digits + (1 if abs(value) < 10 and r["unit"] == "" else 0), 3)
    if not math.isfinite(low):
        return f"{value:.{digits}f}"
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def _best(records: list[Record], factors: list[tuple[str, str, str]]) -> str:
    """Which method needs least dose, for every figure; those whose intervals reach it are named with it."""
    summary = []
    for label, figure, where in factors:
        found = [r for r in records if r["figure"] == figure and r["where"] == where]
        if len(found) < 2:
            continue
        best = max(found, key=lambda r: r["value"])
        floor = best["low"] if math.isfinite(best["low"]) else best["value"]
        rest = [r["method"] for r in found if r is not best
                and (r["high"] if math.isfinite(r["high"]) else r["value"]) >= floor]  # fmt: skip
        summary.append(f"{label}: {best['method']}" + (f" (not told apart: {', '.join(rest)})" if rest else ""))
    return "Least dose: " + "; ".join(summary) + "." if summary else ""


def save(evaluation: Evaluation, folder: str | os.PathLike[str], command: str = "") -> list[Path]:
    """Write ``report.md``, ``report.json``, ``report.csv``, ``report.html`` and a picture a task; the files written."""
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    text = text_of(evaluation) + (f"\nCommand: `{command}`.\n" if command else "")
    for seen in evaluation.results:
        name = seen.task.name
        text = text.replace(f"## {name}\n", f"## {name}\n\n![{name}]({name}.png)\n")
    table = io.StringIO()
    writer = csv.DictWriter(table, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows([{k: "" if isinstance(v, float) and math.isnan(v) else v for k, v in r.items()}
                      for r in evaluation.records])  # fmt: skip
    data = {"settings": evaluation.settings, "command": command, "records": plain(evaluation.records)}
    pictures = {f"{s.task.name}.png": _picture(s) for s in evaluation.results}
    files: dict[str, bytes] = {
        "report.md": text.encode(), "report.csv": table.getvalue().encode(),
        "report.json": (json.dumps(data, indent=1) + "\n").encode(),
        **pictures,
        "report.html": page("Evaluation", text, pictures).encode(),
    }  # fmt: skip
    for name, content in files.items():
        with atomic_write(out / name) as part:
            part.write_bytes(content)
    return [out / name for name in files]


def _picture(seen: TaskResult) -> bytes:
    """The signal's fullest slice: truth, then every method at every exposure."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    z = int(seen.task.shares["signal"].sum((1, 2)).argmax())
    methods: Any = list(dict.fromkeys(m for m, _ in seen.volumes))
    exposures = sorted({e for _, e in seen.volumes})
    figure = Figure((2.0 * (len(methods) + 1), 2.2 * len(exposures)), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes: Any = figure.subplots(len(exposures), len(methods) + 1, squeeze=False)
    middle = seen.facts.values_hu[1]
    low, high = _WINDOW_HU if abs(middle) < 400 else (middle - 300.0, middle + 300.0)
    for row, exposure in zip(axes, exposures, strict=True):
        shown: list[tuple[str, Any]] = [("truth", seen.truth), *((m, seen.volumes[m, exposure][0]) for m in methods)]
        for ax, (name, volume) in zip(row, shown, strict=True):
            ax.imshow(np.asarray(volume[z], np.float32), cmap="gray", vmin=low, vmax=high, origin="lower")
            ax.set_title(name if name == "truth" else f"{name}, {exposure:g} s", fontsize=6)
            ax.axis("off")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


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
        body = body.replace(f'src="{name}"', f'src="data:image/{kind};base64,{base64_text(content)}"')
    return (
        f'<!doctype html>\n<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style>\n<body>{body}</body></html>\n"
    )
