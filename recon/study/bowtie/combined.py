"""MBIR and ROI bowtie together, in one simulation: what the paper multiplies from two studies.

The plaque (42.4 mm off the isocentre, inside the 10 cm that the ROI bowtie spares) is scanned with both bowties, and
MBIR measured against FBP behind each (:mod:`recon.evaluate`). FBP's figures are exact, so the factor of MBIR with the
ROI bowtie against FBP with the large one is the first times the ratio of FBP's two figures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from recon.evaluate.experiment import evaluate
from recon.evaluate.tasks import read_task
from recon.study.bowtie.slices import BOWTIES
from torchpcct.scanner import presets

__all__ = ["FIGURES", "combine"]

FIGURES = {"contrast_variance": "contrast variance", "paper_cnr": "paper's CNR"}
"""What factors are measured by → its name in tables."""

_RECORDS = {"contrast_variance": ("contrast SD at slope 1", -2.0), "paper_cnr": ("CNR", 2.0)}
"""Figure → record, and the power of it that is proportional to dose."""
_FACTORS = {"contrast_variance": "dose factor: contrast at slope 1", "paper_cnr": "dose factor: CNR"}
_KEYS = ("value", "low", "high")


def combine(
    doses: tuple[float, ...], n: int, views: int, seed: int, saved: dict[str, float], folder: Path | None,
    progress: Callable[[str, float], None] | None = None,
) -> list[dict[str, Any]]:  # fmt: skip
    """Scan, reconstruct, measure.

    Args:
        doses: exposures in s.
        n: realisations.
        views: per rotation.
        seed: of the first realisation.
        saved: kind of dose → factor that the ROI bowtie saves at equal exposure.
        folder: keeps what is finished; None: nothing is kept.
        progress: called with a text and the finished fraction of it.

    Returns:
        JSON values of each exposure. Factors ``[value, low, high]`` in the paper's ROIs: of MBIR with either bowtie
        against FBP with the large one at equal exposure, and the second times the dose that the bowtie saves
        (``product_…``); FBP's own ratio, with over without the ROI bowtie; MBIR's contrast slope.
    """
    plain = read_task("plaque")
    tasks = {b: replace(plain, name=f"plaque behind {b}", scanner=presets.pcct(views=views, bowtie=b)) for b in BOWTIES}
    found = evaluate(
        list(tasks.values()), ["fbp:soft", "mbir"], exposures_s=doses, n=n, seed=seed, folder=folder, progress=progress
    )
    large, roi = (tasks[b].name for b in BOWTIES)

    def record(task: str, method: str, dose: float, figure: str) -> Any:
        wanted = {"task": task, "method": method, "exposure_s": dose, "figure": figure, "where": "small"}
        return next((r for r in found.records if wanted.items() <= r.items()), dict.fromkeys(_KEYS, 0.0))

    results: list[dict[str, Any]] = []
    for dose in doses:
        slope = record(large, "mbir", dose, "slope")
        row: dict[str, Any] = {"exposure_s": dose, "mbir_contrast_slope": [slope[k] for k in _KEYS]}
        for figure, (name, power) in _RECORDS.items():
            fbp = (
                record(roi, "fbp:soft", dose, name)["value"] / record(large, "fbp:soft", dose, name)["value"]
            ) ** power
            factors = [
                [by * record(task, "mbir", dose, _FACTORS[figure])[k] for k in _KEYS]
                for task, by in ((large, 1.0), (roi, fbp))
            ]
            row[figure] = {
                "fbp_ratio_roi_to_large": fbp,
                "mbir_factor_large_bowtie": factors[0],
                "mbir_factor_roi_bowtie": factors[1],
                **{f"product_{kind}": [factor * v for v in factors[1]] for kind, factor in saved.items()},
            }
        results.append(row)
    return results
