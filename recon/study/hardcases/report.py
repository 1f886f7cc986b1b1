"""Report of the hard cases: one table, and how many errors were silent."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict

from recon.study.hardcases.figures import draw
from recon.study.hardcases.measure import RIGHT_NOISES, WORSE, Measured
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
        [
            "case",
            "method",
            "error, HU",
            "noise, HU",
            "from truth, HU",
            "soft FBP",
            "finite",
            "verdict",
            "what was said",
        ],
        [
            [
                r["title"],
                r["method"],
                "–" if r["error_hu"] is None else f"{r['error_hu']:.1f}",
                f"{r['noise_hu']:.1f}",
                *("–" if r[key] is None else f"{r[key]:.1f}" for key in ("truth_hu", "soft_hu")),
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
        f"{len(s.methods)} methods. Error: rms difference to the volume of the sound scan with the same noise, "
        f"without what a case adds to the scene and the voxels beside it. A result is *right* if that is at most "
        f"{RIGHT_NOISES:g} of the noise (more where quanta are lost) and PWLS and MBIR are no further from the truth "
        f"than soft FBP of the same scan ({WORSE:g} times), *said* if it is wrong but a warning says so, *refused* if "
        f"there is none, and SILENT if it is wrong without a word.\n\n"
        f"**Silent errors: {counts['SILENT']}** of {len(measured.rows)}; right {counts['right']}, said or refused "
        f"{counts['said']}."
    )
    sections = [text, table, time_line(measured.seconds, f"seed {s.seed}")]
    return Report("hardcases", data, "\n\n".join(sections), {"hardcases.png": draw(measured)})
