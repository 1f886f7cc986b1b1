"""Report of the hard cases: one table, and how many errors were silent."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict

from recon.study.hardcases.figures import draw
from recon.study.hardcases.measure import RIGHT_NOISES, WORSE, Measured
from recon.study.report import Report, markdown_table
from recon.study.study import environment, time_line

__all__ = ["build_report"]


_UNSEEN = """## What no data can show

A scan that is described wrongly is the scan of another object, described rightly, and no test of the data tells the two
apart, for

* the angle of the first view (the object turned), a displacement of the object, and its height;
* the distance source-axis (sod) alone: an object larger by as much, which attenuates as much less; of parallel rays the
  pitch; of any scan all lengths together;
* direction of rotation and order of the columns both reversed (of parallel rays each alone): the mirrored object;
* the attenuation of water, which turns mm⁻¹ into HU, and the nominal energy;
* an error of gain or exposure that air was measured with, too; and one of all readings alike where no ray misses the
  object;
* what only changes the line integral p into a function of p (pile-up, a wrong water correction, one energy for
  another) in a body that is round, or in an inset whose surround is taken as known: opposite rays, and all views,
  agree; bodies that are not round show it (moments of the views);
* the angles of a scan without opposite rays of an object that is round about the axis."""


def build_report(measured: Measured) -> Report:
    """Table, summary, figure."""
    s = measured.settings
    counts = Counter(r["verdict"] for r in measured.rows)
    data = {
        "study": "hardcases",
        "settings": asdict(s),
        "rows": measured.rows,
        "cases": len(s.cases),
        "verdicts": dict(counts),
        "silent": counts["SILENT"],
        "seconds": measured.seconds,
        "environment": environment(),
    }
    tables = [_table(measured, base) for base in ("plaque", "body")]
    text = (
        "# Hard cases\n\n"
        f"Two scans, the plaque's with {s.views} views at {s.exposure_s:g} s and a thorax in a fan beam, whole field, "
        f"made hard in {len(s.cases)} ways, by {len(s.methods)} methods (tissues: MBIR with them). Error: rms "
        "difference to the volume of the sound scan with the same noise, without what a case adds to the scene and the "
        f"voxels beside it. A result is *right* if that is at most {RIGHT_NOISES:g} of the noise (more where quanta "
        f"are lost) and PWLS and MBIR are no further from the truth than soft FBP of the same scan ({WORSE:g} times), "
        "*warned* if it is wrong but a warning says so, *refused* if there is none, *unseen* if no data can show it "
        "(below), and SILENT if it is wrong without a warning.\n\n"
        f"**Silent errors: {counts['SILENT']}** of {len(measured.rows)}; right {counts['right']}, warned or refused "
        f"{counts['warned']}, unseen {counts['unseen']}."
    )
    sections = [text, *tables, _UNSEEN, time_line(measured.seconds, f"seed {s.seed}")]
    return Report("hardcases", data, "\n\n".join(sections), {"hardcases.png": draw(measured)})


def _table(measured: Measured, base: str) -> str:
    # The scan as it is comes with warnings, too (few views): what a case adds to them is shown.
    rows = [r for r in measured.rows if r["base"] == base]
    if not rows:
        return ""
    usual = {r["method"]: set(r["messages"]) for r in rows if r["case"] in ("sound", "body-sound")}
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
            "warning or refusal",
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
                "; ".join(t for t in r["messages"] if t not in usual.get(r["method"], ()))[:160].replace("|", "/"),
            ]
            for r in rows
        ],
    )
    return f"## {_HEADINGS[base]}\n\n{table}"


_HEADINGS = {"plaque": "The plaque's scan", "body": "A whole body"}
