"""The comparison's answer, tables and picture."""

from __future__ import annotations

import resource
import sys
import textwrap
from dataclasses import asdict
from typing import Any

from recon.evaluate.report import plain, task_sections
from recon.study.compare.answer import answer, claim, interval
from recon.study.compare.figures import sections_figure
from recon.study.compare.measure import Measured
from recon.study.report import Report, markdown_table
from recon.study.study import environment, time_line

__all__ = ["build_report"]


def build_report(m: Measured) -> Report:
    """Report of :func:`recon.study.compare.measure.measure`: ``report.json``, ``report.md``, ``compare.png``."""
    records = m.evaluation.records
    data: dict[str, Any] = {
        "study": "compare",
        "settings": asdict(m.settings),
        "claim": claim(records),
        "records": plain(records),
        "seconds": {k: round(v, 2) for k, v in m.seconds.items()},
        "environment": environment(),
    }
    data["answer"] = answer(data)
    tables = task_sections(m.evaluation)
    where = (
        "The paper's CNR tables (kernels × voxel sizes × doses) beside ours: `torchpcct study noise`. Other tasks, "
        "more methods and realisations: `torchpcct evaluate`, `torchpcct dose-factor`."
    )
    peak = time_line(m.seconds, f"peak memory {_peak_memory_gib():.1f} GiB")
    sections = ["# What MBIR saves at the paper's plaque", data["answer"], *tables, where, peak]
    text = "\n\n".join(s for s in sections if s)
    return Report("compare", data, text, {"compare.png": sections_figure(m)}, screen=_screen(m, data["answer"]))


def _screen(m: Measured, sentence: str) -> str:
    """What fits on one: the answer, the dose factors of every method, and where the rest is."""
    found = {(r["method"], r["exposure_s"], r["figure"], r["where"]): r for r in m.evaluation.records}
    measured = {key[2:] for key in found}
    columns = [
        column
        for column in (
            ("CNR", "CNR", "small"), ("contrast, lesion", "contrast at slope 1", "lesion"),
            ("d′, volume", "d'", "volume"), ("noise in fat", "noise", "patient"),
        ) if (f"dose factor: {column[1]}", column[2]) in measured
    ]  # fmt: skip

    def cell(method: str, exposure: float, figure: str, where: str) -> str:
        r = found.get((method, exposure, f"dose factor: {figure}", where))
        return "–" if r is None else interval(r)

    rows = [
        [f"{method}, {exposure:g} s", *(cell(method, exposure, *column[1:]) for column in columns)]
        for exposure in m.settings.exposures_s for method in m.settings.methods
    ]  # fmt: skip
    table = markdown_table(["dose factor", *(label for label, _, _ in columns)], rows)
    reference = m.evaluation.results[0].task.reference
    meaning = (
        f"Dose factor: how many times the dose {reference} needs for the same figure, and its 95 % interval from "
        f"{m.settings.n} noise realisations. Contrasts, errors, resolution, pictures: report.html."
    )
    parts = (textwrap.fill(sentence.strip("*"), 110), table, textwrap.fill(meaning, 110))
    return "\n\n".join(part for part in parts if part)


def _peak_memory_gib() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**30 if sys.platform == "darwin" else peak / 2**20
