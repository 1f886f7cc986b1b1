"""The comparison's answer, tables and picture."""

from __future__ import annotations

import resource
import sys
from dataclasses import asdict
from typing import Any

from recon.evaluate.report import plain, task_sections
from recon.study.compare.answer import answer, claim
from recon.study.compare.figures import sections_figure
from recon.study.compare.measure import Measured
from recon.study.report import Report
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
    return Report("compare", data, text, {"compare.png": sections_figure(m)})


def _peak_memory_gib() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**30 if sys.platform == "darwin" else peak / 2**20
