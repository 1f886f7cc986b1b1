"""What a reconstruction has to beat: filters of a finished volume (:mod:`recon.filters`) with
tuned settings."""

from __future__ import annotations

import json
import math
from functools import cache
from importlib import resources

from recon.filters import (
    FILTERS,
)
from torchpcct.validate import checked, choice, number

__all__ = ["tuned"]


@cache
def _tuning() -> dict[str, dict[str, dict[str, dict[str, float]]]]:
    return json.loads(
        (resources.files("recon") / "evaluate" / "rivals_tuning.json").read_text(encoding="utf-8")
    )


@checked
def tuned(name: str, kernel: str, exposure_s: float) -> dict[str, float]:
    """Settings of a filter after FBP on 0.2 mm voxels that have the least error in vessels of four
    directions.

    Tuned on held-out plaques of the paper's scanner at 0.35, 0.7 and 2 s
    (``tests/bench/rivals.py``); the nearest exposure counts. Thresholds are in units of the noise,
    so they serve other scanners.

    Args:
        name: of :data:`FILTERS`.
        kernel: of FBP.
        exposure_s: of the scan.

    Returns:
        Keyword arguments; empty where this pair was not tuned: then the filter's defaults are its
        best.

    Raises:
        ValueError: an unknown filter, an exposure that is not positive.
    """
    choice("filter", name, FILTERS)
    exposure = number("exposure_s", exposure_s, positive=True, unit="s")
    nearest = min(
        _tuning().items(), key=lambda item: abs(math.log(float(item[0].split()[0]) / exposure))
    )[1]
    found: dict[str, float] = dict(nearest.get(f"{kernel} + {name}", {}).get("settings", {}))
    return found
