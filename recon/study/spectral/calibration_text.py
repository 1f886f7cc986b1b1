"""What a wrong calibration costs, as a section of the report."""

from __future__ import annotations

from typing import Any

from recon.study.report import markdown_table
from torchpcct.spectral import MMD_TISSUES

__all__ = ["calibration_section", "contrast_cost"]

_TISSUES = ("blood", "core", "fibrous", "fat", "contrast")


def _contrast(row: dict[str, Any]) -> float:
    return max(abs(cost["contrast"]) for cost in row["cost_hu"].values())


def _level(row: dict[str, Any]) -> float:
    return max(abs(cost[t]) for cost in row["cost_hu"].values() for t in ("core", "fibrous", "fat"))


def contrast_cost(calibration: dict[str, Any]) -> float:
    """Largest cost in HU of the contrast core against fibrous tissue, of all errors."""
    return max(map(_contrast, calibration["cases"]))


def calibration_section(calibration: dict[str, Any]) -> str:
    """Markdown: costs in HU by error and energy, tissue maps, and how exact they are."""
    cases = calibration["cases"]
    energies = [f"{e:g}" for e in calibration["energies_kev"]]
    none, *wrong = cases
    head = ["error", *[f"{t}, {e} keV" for e in energies for t in _TISSUES]]
    rows = [["none, HU", *[f"{none['hu'][e][t]:.1f}" for e in energies for t in _TISSUES]]]
    rows += [[c["name"], *[f"{c['cost_hu'][e][t]:+.1f}" for e in energies for t in _TISSUES]] for c in wrong]
    maps = [[c["name"], *[f"{c['dice'][t]:.3f}" for t in MMD_TISSUES]] for c in cases]
    return (
        "## What a wrong calibration costs\n\n"
        f"Noise-free scans of {calibration['views']} views, each as short as in the whole scan, decomposed with a "
        "model that is not theirs; HU of monochromatic FBP images, below the first line as differences to the right "
        "calibration. *Contrast*: fibrous tissue less core. Thresholds: every comparator stands lower than the "
        "decomposition believes, as when the electronics' gain or offset drifts (the energy axis of a counting "
        "detector, which no air scan shows). Tube voltage: the spectrum is softer than believed. Both with the counts "
        "in air taken over, bin by bin, from an air scan of the true scanner, and without. More counts: since the air "
        "scan. Photons interact repeatedly: the scan's photons are followed through all interactions in silicon and "
        "foils (`TransportedSilicon`), the decomposition believes in one; in the last line it knows the response from "
        f"other photons: what that leaves is the error of the followed photons.\n\n{markdown_table(head, rows)}\n\n"
        f"{_words(wrong)}{_views(calibration)}\n\n"
        "Dice coefficients of the noise-free tissue maps (*nearest*, the right tissues' centres, right noise):\n\n"
        f"{markdown_table(['error', 'blood', 'core', 'fibrous', 'fat'], maps)}"
    )


def _words(wrong: list[dict[str, Any]]) -> str:
    level, contrast = max(wrong, key=_level), max(wrong, key=_contrast)
    core = min(wrong, key=lambda c: c["cost_dice"]["necrotic_core"])
    return (
        f"Soft tissue and fat move by up to {_level(level):.1f} HU ({level['name']}), their contrast by up to "
        f"{_contrast(contrast):.1f} HU ({contrast['name']}). Core's Dice changes by up to "
        f"{core['cost_dice']['necrotic_core']:+.3f} ({core['name']})."
    )


def _views(calibration: dict[str, Any]) -> str:
    if "half_views_hu" not in calibration:
        return ""
    return (
        f" Every other view left out changes the cost of wrong thresholds by at most "
        f"{calibration['half_views_hu']:.2f} HU: these views are enough."
    )
