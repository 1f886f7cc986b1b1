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

import numpy as np

__all__ = ["RECOVERY", "contrast_note"]

RECOVERY = "recovery.json"
"""File beside the weights: ``weights_sha256`` and ``rows`` (:class:`MeasuredRecovery`)."""
_FARTHEST = 1.5
"""Beyond the lowest and the highest noise scale of the figures there is no note from this factor
on."""
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


def _at(noise_scale_hu: float, rows: list[MeasuredRecovery]) -> MeasuredRecovery | None:
    """The figures of a ball at a noise scale, by its logarithm between those that were measured;
    None too far beyond them."""
    rows = sorted(rows, key=lambda row: row["noise_scale_hu"])
    scales = [row["noise_scale_hu"] for row in rows]
    if not scales[0] / _FARTHEST <= noise_scale_hu <= scales[-1] * _FARTHEST:
        return None
    at, measured = math.log(noise_scale_hu), np.log(scales)
    return {
        **rows[0],
        "noise_scale_hu": noise_scale_hu,
        "recovered": float(np.interp(at, measured, [row["recovered"] for row in rows])),
        "soft_fbp": float(np.interp(at, measured, [row["soft_fbp"] for row in rows])),
    }


def contrast_note(weights_sha256: str, noise_scale_hu: float, fidelity: float) -> list[str]:
    """A sentence about the bodies of which MBIR shows less than soft FBP does; empty where nothing
    was measured: other weights, another noise, another fidelity.

    Args:
        weights_sha256: of the weights in use.
        noise_scale_hu: of the scan (:mod:`recon.data_term`).
        fidelity: of the method.
    """
    digest, rows = _measured()
    if digest != weights_sha256:
        return []
    balls: dict[tuple[float, float], list[MeasuredRecovery]] = {}
    for row in rows:
        if abs(row["fidelity"] - fidelity) < 0.01:
            balls.setdefault((row["diameter_mm"], row["contrast_hu"]), []).append(row)
    shown = [_at(noise_scale_hu, of) for of in balls.values()]
    lost = [r for r in shown if r is not None and r["recovered"] < _LESS * r["soft_fbp"]]
    if not lost:
        return []
    # The ball of each size that loses most.
    lost.sort(key=lambda r: r["recovered"] / r["soft_fbp"], reverse=True)
    worst = {r["diameter_mm"]: r for r in lost}
    named = " and ".join(
        f"{100 * r['recovered']:.0f} % of a ball of {r['diameter_mm']:g} mm and "
        f"{r['contrast_hu']:+g} HU (soft FBP {100 * r['soft_fbp']:.0f} %)"
        for _, r in sorted(worst.items())[:_NAMED]
    )
    return [
        f"small and faint bodies lose contrast by the prior: at such noise MBIR showed {named}, "
        "measured on the paper's plaque. In this scan torchpcct recovery measures it "
        "(recon.evaluate.contrast_recovery)"
    ]
