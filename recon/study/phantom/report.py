"""Report of the phantom study: tables, checks, the picture."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from recon.study.checks import Check, around, checks_section
from recon.study.paper import facts as paper
from recon.study.phantom.figures import draw
from recon.study.phantom.measure import Measured
from recon.study.report import Report, markdown_table
from recon.study.study import environment, time_line

__all__ = ["build_report", "checks_of"]

_LENGTH_MM, _OFFSET_MM = 0.02, 0.1
"""Accepted error of a length, and of the distance from the isocentre."""

_SOFT_HU, _BLOOD_HU, _FAT_HU = 6.0, (400.0, 600.0), (-130.0, -85.0)
"""Accepted CT numbers: of soft tissue about the paper's, of blood and of fat."""

TRANSMITTED, MIDDLE = "100 kVp behind 24 cm fat", "64 keV"
"""Spectra whose CT numbers are checked."""


def build_report(measured: Measured) -> Report:
    """Checks, tables, picture."""
    p, s = measured.parts, measured.settings
    checks = checks_of(p)
    data = {
        "study": "phantom",
        "settings": asdict(s),
        "checks": [c.as_dict() for c in checks],
        **p,
        "seconds": measured.seconds,
        "environment": environment(),
    }
    sections = [
        "# The phantom beside the paper's",
        "The plaque that all studies scan: what it is made of, what it reads, how large it is.",
        checks_section(checks),
        _materials(p["materials"]),
        _hu(p["hu"]),
        _lengths(p, s.voxel_mm),
        time_line(measured.seconds),
    ]
    return Report("phantom", data, "\n\n".join(sections), {"phantom.png": draw(measured)})


def _named(material: str) -> str:
    return material.replace("_", " ")


def checks_of(parts: dict[str, Any]) -> list[Check]:
    """Densities, mass fractions, CT numbers and lengths with what is accepted of them."""
    checks = [
        around(f"{_named(m['material'])}: density, g/cm³", m["density_g_cm3"], m["published_g_cm3"], 5e-4)
        for m in parts["materials"]
    ]
    for m in parts["materials"]:
        name = f"{_named(m['material'])}: largest error of a mass fraction"
        # Blood's table sums to 1.0002: normalising moves oxygen by 1.5e-4.
        checks.append(Check(f"{name}, table", m["fraction_error"], "0, normalised", high=2e-4))
        if m["from_molecules"] is not None:
            checks.append(Check(f"{name}, from molecules", m["from_molecules"], "rounded to 1e-4", high=1e-4))
    readings = (
        f"blood {hu['blood_iodine']:.0f}, fat {hu['pericoronary_fat']:.0f}, core {hu['necrotic_core']:.0f} "
        f"at {spectrum}"
        for spectrum, hu in parts["hu"].items()
        if spectrum.endswith("keV")
    )
    cause = "the energy that gives soft tissue does not give blood and fat: " + "; ".join(readings)
    for spectrum in (s for s in (MIDDLE, TRANSMITTED) if s in parts["hu"]):
        for material, hu in parts["hu"][spectrum].items():
            target = paper.MATERIALS[material][1]
            low, high = {"blood_iodine": _BLOOD_HU, "pericoronary_fat": _FAT_HU}.get(
                material, (target - _SOFT_HU, target + _SOFT_HU)
            )
            check = Check(f"{_named(material)}, HU, {spectrum}", hu, target, low, high)
            checks.append(check.explained(cause))
    for how, lengths in parts["lengths_mm"].items():
        for name, value in lengths.items():
            # Given with one decimal in cm and in mm.
            tolerance = _OFFSET_MM if name in ("distance from the isocentre", "patient diameter") else _LENGTH_MM
            checks.append(around(f"{name}, mm, {how}", value, paper.PHANTOM_MM[name], tolerance))
    return checks


def _materials(materials: list[dict[str, Any]]) -> str:
    elements = ("H", "C", "N", "O", "Na", "P", "S", "Cl", "K", "Ca", "Fe", "I")
    rows = []
    for m in materials:
        published = paper.MATERIALS[m["material"]][2]
        ours = [f"{m['fractions'][e]:.4f}" if e in m["fractions"] else "–" for e in elements]
        theirs = [f"{published[e]:.4f}" if e in published else "–" for e in elements]
        rows.append([_named(m["material"]), f"{m['density_g_cm3']:.3f}", *ours])
        rows.append(["paper", f"{m['published_g_cm3']:.3f}", *theirs])
    derived = [m for m in materials if m["from_molecules"] is not None]
    worst = max(m["from_molecules"] for m in derived)
    blood = next(m for m in materials if m["material"] == "blood_iodine")
    return (
        "## Materials\n\nDensity in g/cm³ and mass fractions. The library holds the paper's table, normalised (blood's "
        f"sums to {blood['published_sum']:.4f}), so that this agreement only says that it was copied rightly. "
        f"{len(derived)} of the tissues follow as well from the molecular formulas and weights in the paper's text: "
        f"within {worst:.1e} of the table, if the abundances of elastin's amino acids are read as weights of residues "
        "and the core's parts, which sum to 126 %, are normalised.\n\n"
        f"{markdown_table(['material', 'density', *elements], rows)}"
    )


def _hu(hu: dict[str, dict[str, float]]) -> str:
    names = list(paper.MATERIALS)
    rows = [[spectrum, *[f"{values[n]:.1f}" for n in names]] for spectrum, values in hu.items()]
    rows.append(["paper, 100 kVp", *[f"{paper.MATERIALS[n][1]:.0f}" for n in names]])
    soft = ("vessel_wall", "fibrous_tissue", "necrotic_core")
    miss = {spectrum: max(abs(values[n] - paper.MATERIALS[n][1]) for n in names) for spectrum, values in hu.items()}
    best = min(miss, key=lambda k: miss[k])
    softest = {s: max(abs(v[n] - paper.MATERIALS[n][1]) for n in soft) for s, v in hu.items()}
    nearest = min(softest, key=lambda k: softest[k])
    return (
        "## CT numbers\n\nHU against water. The paper does not say of which spectrum its CT numbers are.\n\n"
        f"{markdown_table(['spectrum', *map(_named, names)], rows)}\n\n"
        f"The three soft tissues come nearest at {nearest} (within {softest[nearest]:.1f} HU), all five at {best} "
        f"(within {miss[best]:.0f} HU): no single spectrum of these gives all five."
    )


def _lengths(parts: dict[str, Any], voxel_mm: float) -> str:
    lengths = parts["lengths_mm"]
    rows = [
        [name, f"{value:g}", f"{lengths['bodies'][name]:.4f}", f"{lengths['raster'][name]:.3f}"]
        for name, value in paper.PHANTOM_MM.items()
    ]
    assumed = [[name, f"{value:.3f}"] for name, value in parts["assumed_mm"].items()]
    return (
        f"## Geometry\n\nIn mm: of the analytic bodies, and measured on a binary raster of {voxel_mm:g} mm. The scans "
        "use the bodies themselves; the raster is how the paper holds its phantom.\n\n"
        f"{markdown_table(['length', 'paper', 'bodies', 'raster'], rows)}\n\n"
        "Not in the paper, and chosen so that every number above is met (parameters of `Plaque`):\n\n"
        f"{markdown_table(['assumed', 'mm'], assumed)}\n\n![The plaque](phantom.png)"
    )
