"""Every study of the registry at its smallest scale, and what all of their reports must be."""

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from recon.study import registry
from recon.study.report import Report

TINY: dict[str, dict[str, Any]] = {
    "compare": {
        "n": 8,
        "views": 48,
        "methods": ("fbp:soft", "gaussian@fbp:soft"),
        "exposures_s": (2.0,),
        "energies_views": 0,
    },
    "phantom": {"voxel_mm": 0.05, "sections": 2, "energies_kev": (55.0, 64.0)},
    "detector": {"photons": 4000, "dead_times_ns": (50.0,), "charge_sharing": (0.1,)},
    "bowtie": {
        "views": 96,
        "realisations": 2,
        "map_mm": 12.0,
        "histories": 20_000,
        "plaque_views": 40,
        "plaque_doses": (2.0,),
        "plaque_realisations": 8,
    },
    "hardcases": {
        "views": 120,
        "methods": ("fbp",),
        "cases": (
            "sound",
            "dead-column",
            "centre-2",
            "three-views",
            "metal",
            "body-sod",
            "body-reversed",
            "body-not-square",
        ),
        "anatomies": ("ulcer",),
        "anatomy_methods": ("pwls",),
        "draws": 1,
    },
    "motion": {
        "thinning": 24,
        "fractions": (0.2, 1.0),
        "eid_fractions": (0.2,),
        "errors": (0.2,),
        "voxel_mm": 0.4,
        "realisations": 1,
        "exposure_s": 20.0,
        "methods": ("fbp", "pwls"),
        "estimated_cases": ("along x",),
        "estimated_mm": (1.2,),
        "estimated_exposures_s": (2.0,),
        "estimated_realisations": 1,
    },
    "paths": {
        "kinds": ("at rest", "along a line"),
        "vessels": 1,
        "views": 48,
        "exposures_s": (2.0,),
    },
    "noise": {
        "realisations": 24,
        "views": 48,
        "kernels": ("soft", "bone"),
        "voxels_mm": (0.25, 0.40),
        "doses": {"1x": 0.35, "5.7x": 2.0},
        "reconstructed": 2,
        "experiments": 500,
    },
    "resolution": {"thinning": 32, "sigmas_px": (0.0, 3.75, 10.0)},
    "recovery": {
        "methods": ("fbp:standard", "pwls"),
        "balls": ((1.0, 200.0),),
        "exposures_s": (2.0,),
        "n": 2,
        "places": 2,
        "views": 48,
        "voxel_mm": 0.4,
    },
    "spectral": {
        "views": 60,
        "voxel_mm": 0.4,
        "realisations": 2,
        "mbir_realisations": 1,
        "noise_levels": (0.0, 1.0),
        "calibration_views": 60,
        "transport_photons": 50_000,
    },
}
"""Study → settings."""


INSERT = """
title: an insert of 3 mm
scene:
  kind: bodies
  bodies:
    - {name: patient, shape: cylinder, semi_axes: 100, material: water}
    - {name: insert, shape: ellipsoid, semi_axes: 1.5, position: {x: 30, y: 10, z: 0},
       material: soft_tissue, parent: patient}
signal: insert
scanner: {preset: pcct, views: 90, rows: 24, energy_bin_kev: 4}
tolerance_hu: 1000
inset: {size: [6, 8, 8], voxel_mm: 0.4}
exposures_s: 20
"""
"""A task of the instrument on few views."""


@dataclass
class TinyStudy:
    """A study that ran: what it measured, its report, the folder of both, and the steps that it
    told."""

    name: str
    measured: Any
    report: Report
    folder: Path
    steps: list[tuple[str, float]] = field(default_factory=list)


def run_tiny(name: str, folder: Path) -> TinyStudy:
    """Measure a study at its smallest scale."""
    steps: list[tuple[str, float]] = []
    settings = registry.settings_class(name)(**TINY[name])
    measured = registry.measured(
        name, settings, lambda step, fraction: steps.append((step, fraction)), folder
    )
    return TinyStudy(name, measured, registry.report_of(name, measured), folder, steps)


def assert_report_is_whole(
    tiny: TinyStudy, folder: Path, figures: set[str], sections: tuple[str, ...]
) -> dict:
    """The contract of every report; returns its JSON values as they were written.

    Each study's own test file calls it once.
    """
    files = tiny.report.save(folder / "new")
    assert {f.name for f in files} == {"report.json", "report.md", "report.html", *figures}
    # nothing half written is left
    assert {f.name for f in (folder / "new").iterdir()} == {f.name for f in files}
    assert all((folder / "new" / name).read_bytes().startswith(b"\x89PNG") for name in figures)
    data = json.loads((folder / "new" / "report.json").read_text(encoding="utf-8"))
    assert {"settings", "seconds", "environment"} <= set(data)
    assert data["settings"].items() >= json.loads(json.dumps(TINY[tiny.name])).items()
    assert all(
        {"name", "ours", "paper", "low", "high", "ok"} <= set(c) for c in data.get("checks", ())
    )
    text = (folder / "new" / "report.md").read_text(encoding="utf-8")
    for section in sections:
        assert section in text
    page = (folder / "new" / "report.html").read_text(encoding="utf-8")
    assert page.count('src="data:image/png;base64,') == len(figures)
    assert page.count("<table>") == len(re.findall(r"^\|:?--", text, re.MULTILINE))
    assert "http" not in page
    assert tiny.steps
    assert all(0.0 <= fraction <= 1.0 for _, fraction in tiny.steps)
    return data
