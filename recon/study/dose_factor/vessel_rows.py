"""Figures of the vessels of any direction: contrast, false contrast, noise in fat, gain over a linear filter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from recon.study.dose_factor.merit import attempt, joint, json_of, none
from recon.study.dose_factor.seen import Seen
from recon.study.dose_factor.settings import VESSEL_ROIS, VESSELS

__all__ = ["REFERENCE", "vessel_rows"]

REFERENCE = "linear"
"""The method that gains are quoted against."""

Key = tuple[str, str, float]
Pieces = Mapping[Key, dict[str, Any]]


def vessel_rows(found: Pieces, true_contrast_hu: float) -> list[dict[str, Any]]:
    """Every vessel at every dose with every method, for both pairs of ROIs.

    Args:
        found: (method, vessel, dose) → :meth:`recon.study.dose_factor.places.Places.found`.
        true_contrast_hu: fibrous tissue less core.
    """
    rows = []
    for pair in range(len(VESSEL_ROIS)):
        seen = {key: Seen.of(entry, pair) for key, entry in found.items()}
        rows += [_row(seen, key, pair, true_contrast_hu) for key in seen]
    return rows


def _row(seen: Mapping[Key, Seen], key: Key, pair: int, true_contrast_hu: float) -> dict[str, Any]:
    (method, name, dose), own = key, seen[key]

    def log_gain(vessel: str) -> Any:
        """ln of the linear filter's slope-corrected variance over the method's; None: one of them is missing."""
        ends = [seen.get((m, vessel, dose)) for m in (REFERENCE, method)]
        if method == REFERENCE or ends[0] is None or ends[1] is None:
            return None
        return joint(lambda a, b: a - b, *(e.log_corrected(true_contrast_hu) for e in ends if e is not None))

    def gain() -> Any:
        here = log_gain(name)
        return none("nothing to compare with") if here is None else json_of(here, 1.0)

    def kept() -> Any:
        here, straight = (None, None) if name == VESSELS[0] else (log_gain(name), log_gain(VESSELS[0]))
        if here is None or straight is None:
            return none("nothing to compare with")
        return json_of(joint(lambda a, b: a - b, here, straight), 1.0)

    return {
        "roi": VESSEL_ROIS[pair], "vessel": name, "exposure_s": dose, "method": method,
        "realizations": own.realizations, "true_contrast_hu": true_contrast_hu,
        "contrast_hu": json_of(own.contrast), "contrast_sd_hu": json_of(own.log_contrast, 0.5),
        "false_contrast_hu": None if own.absent is None else json_of(own.absent),
        "slope": attempt(lambda: json_of(own.slope(true_contrast_hu))),
        "fat_sd_hu": None if own.log_fat is None else json_of(own.log_fat, 0.5),
        "to_linear": attempt(gain), "kept": attempt(kept),
    }  # fmt: skip
