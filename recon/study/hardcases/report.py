"""Report of the hard cases: one table, and how many errors were silent."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict

from recon.study.hardcases.figures import draw
from recon.study.hardcases.measure import RIGHT_NOISES, Measured
from recon.study.report import Report, markdown_table
from recon.study.study import environment, time_line

__all__ = ["build_report"]


def build_report(measured: Measured) -> Report:
    """Table, summary, figure."""
    s = measured.settings
    counts = Counter(r["verdict"] for r in measured.rows)
    data = {
        "study": "hardcases",
        "settings": asdict(s),
        "rows": measured.rows,
        "verdicts": dict(counts),
        "silent": counts["SILENT"],
        "seconds": measured.seconds,
        "environment": environment(),
    }
    # The scan as it is comes with warnings, too (few views): what a case adds to them is shown.
    usual = {r["method"]: set(r["said"]) for r in measured.rows if r["case"] == "sound"}
    table = markdown_table(
        ["case", "method", "error, HU", "noise, HU", "finite", "verdict", "what was said"],
        [
            [
                r["title"],
                r["method"],
                "–" if r["error_hu"] is None else f"{r['error_hu']:.1f}",
                f"{r['noise_hu']:.1f}",
                "yes" if r["finite"] else "NO",
                ("refused" if r["refused"] else r["verdict"]),
                "; ".join(t for t in r["said"] if t not in usual.get(r["method"], ()))[:160].replace("|", "/"),
            ]
            for r in measured.rows
        ],
    )
    text = (
        "# Hard cases\n\n"
        f"The plaque's scan with {s.views} views at {s.exposure_s:g} s, made hard in {len(s.cases)} ways, by "
        f"{len(s.methods)} methods. Error: rms difference to the volume of the sound scan with the same noise. A "
        f"result is *right* if that is at most {RIGHT_NOISES:g} of the noise (more where quanta are lost), *said* if "
        f"it is wrong but a warning says so, *refused* if there is none, and SILENT if it is wrong without a word.\n\n"
        f"**Silent errors: {counts['SILENT']}** of {len(measured.rows)}; right {counts['right']}, said or refused "
        f"{counts['said']}."
    )
    sections = [text, table, time_line(measured.seconds, f"seed {s.seed}")]
    return Report("hardcases", data, "\n\n".join(sections), {"hardcases.png": draw(measured)})
