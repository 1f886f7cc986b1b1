"""How much of the contrast of small and faint bodies the network that ships recovers: a note for
every volume.

A prior takes small and faint bodies for noise, and the volume does not show that it did. How much
of the contrast of balls is recovered has been measured on the paper's plaque (``torchpcct study
recovery``); the figures lie beside the weights, and hold for these weights alone. In a scan at hand
:func:`recon.evaluate.contrast_recovery` measures it.
"""

from __future__ import annotations

import json
import math
from functools import cache
from importlib import resources
from typing import TypedDict

__all__ = ["RECOVERY", "contrast_note"]

RECOVERY = "recovery.json"
"""File beside the weights: ``weights_sha256`` and ``rows`` (:class:`MeasuredRecovery`)."""
_FARTHEST = 1.5
"""The noise scale of the figures is that of the scan within this factor, or there is no note."""
_LESS = 0.9
"""Balls are named whose contrast recovery is below this fraction of that of soft FBP."""
_NAMED = 2
"""Number of sizes that are named, the smallest."""


class MeasuredRecovery(TypedDict):
    """A row of the file: contrast recovery of a ball at one noise scale and one fidelity."""

    noise_scale_hu: float
    fidelity: float
    diameter_mm: float
    contrast_hu: float
    recovered: float
    soft_fbp: float


@cache
def _measured() -> tuple[str, tuple[MeasuredRecovery, ...]]:
    """Digest of the weights, and the rows."""
    file = resources.files("recon") / "mbir" / "weights" / RECOVERY
    if not file.is_file():
        return "", ()
    found = json.loads(file.read_text(encoding="utf-8"))
    return found["weights_sha256"], tuple(found["rows"])


def contrast_note(weights_sha256: str, noise_scale_hu: float, fidelity: float) -> list[str]:
    """A sentence about the bodies of which MBIR shows less than soft FBP does; empty where nothing
    was measured: other weights, another noise, another fidelity.

    Args:
        weights_sha256: of the weights in use.
        noise_scale_hu: of the scan (:mod:`recon.data_term`).
        fidelity: of the method.
    """
    digest, rows = _measured()
    if digest != weights_sha256 or not rows:
        return []

    def far(row: MeasuredRecovery) -> float:
        return abs(math.log(row["noise_scale_hu"] / noise_scale_hu))

    alike = [r for r in rows if abs(r["fidelity"] - fidelity) < 0.01]
    if not alike or min(map(far, alike)) > math.log(_FARTHEST):
        return []
    scale = min(alike, key=far)["noise_scale_hu"]
    lost = [
        r for r in alike if r["noise_scale_hu"] == scale and r["recovered"] < _LESS * r["soft_fbp"]
    ]
    if not lost:
        return []
    # The ball of each size that loses most.
    lost.sort(key=lambda r: r["recovered"] / r["soft_fbp"], reverse=True)
    worst = {r["diameter_mm"]: r for r in lost}
    balls = " and ".join(
        f"{100 * r['recovered']:.0f} % of a ball of {r['diameter_mm']:g} mm and "
        f"{r['contrast_hu']:+g} HU (soft FBP {100 * r['soft_fbp']:.0f} %)"
        for _, r in sorted(worst.items())[:_NAMED]
    )
    return [
        f"small and faint bodies lose contrast by the prior: at such noise MBIR showed {balls}, "
        "measured on the paper's plaque. In this scan torchpcct recovery measures it "
        "(recon.evaluate.contrast_recovery)"
    ]
