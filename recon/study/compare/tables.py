"""The paper's tables: one per quantity, a row for each voxel size and source, a column for each kernel and method."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from recon.study.paper import facts as paper
from recon.study.paper.plaque_scan import REFERENCE_KERNEL, REFERENCE_VOXEL_MM
from recon.study.paper.tables import published
from recon.study.report import markdown_table

__all__ = ["is_reference", "noise_free_table", "tables"]


def is_reference(entry: dict[str, Any]) -> bool:
    """Whether an entry is that of the noise-free image on which the ROIs were placed."""
    return (entry["kernel"], entry["voxel_mm"]) == (REFERENCE_KERNEL, REFERENCE_VOXEL_MM)


def noise_free_table(data: dict[str, Any]) -> str:
    """ROI means of noise-free FBP."""
    s = data["settings"]
    entries = {(e["kernel"], e["voxel_mm"]): e for e in data["noise_free"]}
    kernels = list(dict.fromkeys([*s["kernels"], REFERENCE_KERNEL]))

    def cell(kernel: str, voxel: float) -> str:
        e = entries.get((kernel, voxel))
        return "–" if e is None else f"{e['foreground_hu']:.1f} / {e['background_hu']:.1f}"

    rows = [[f"{v:.2f} mm", *(cell(k, v) for k in kernels)] for v in (REFERENCE_VOXEL_MM, *s["voxels_mm"])]
    p = paper.NOISE_FREE_ROI_HU
    return (
        f"## Noise-free ROI means\n\nFBP. The paper's {p['foreground']:.1f} / {p['background']:.1f} HU are those of "
        f"the {REFERENCE_KERNEL} kernel on {REFERENCE_VOXEL_MM:.2f} mm.\n\n"
        + markdown_table(["core / fibrous, HU", *kernels], rows)
    )


def tables(data: dict[str, Any], dose: str, exposure: float) -> str:
    """Exact, measured and published moments of both ROIs and the CNR at an exposure."""
    s = data["settings"]
    measured = {(e["kernel"], e["voxel_mm"]): e for e in data["statistics"] if e["exposure_s"] == exposure}
    exact = {(e["kernel"], e["voxel_mm"]): e for e in data["noise_free"] if "covariance_hu2_s" in e}
    voxels = sorted({v for _, v in measured} | set(s["voxels_mm"]))

    def moments(roi: int) -> tuple[Callable[[Any], str], Callable[[Any, Any], str]]:
        name = ("foreground", "background")[roi]
        return (
            lambda e: f"{e[name]['mean_hu']:.1f} ({e[name]['sd_hu']:.1f})",
            lambda means, variances: f"{means[roi]:.1f} ({np.sqrt(variances[roi]):.1f})",
        )

    def table(
        title: str, entries: Any, form: str, runs: Callable[[Any], str], known: Callable[[Any, Any], str]
    ) -> str:  # fmt: skip
        def of_exact(kernel: str, voxel: float) -> str:
            e = exact.get((kernel, voxel))
            if e is None:
                return ""
            return known((e["foreground_hu"], e["background_hu"]), np.diag(e["covariance_hu2_s"]) / exposure)

        def of_runs(kernel: str, voxel: float) -> str:
            e = measured.get((kernel, voxel))
            return "" if e is None else runs(e)

        def of_paper(kernel: str, voxel: float) -> str:
            entry = published(entries, kernel, voxel, exposure)
            return "" if entry is None else form.format(*np.atleast_1d(entry))

        rows = []
        for voxel in voxels:
            for source, cell in (("exact", of_exact), (f"{s['realizations']} runs", of_runs), ("paper", of_paper)):
                cells = [cell(k, voxel) for k in s["kernels"]]
                if any(cells):
                    rows.append([f"{voxel:.2f} mm, {source}", *cells])
        return f"{title}\n\n" + markdown_table(["", *s["kernels"]], rows)

    return "\n\n".join(
        [
            f"## {dose} dose: {exposure:.2f} s",
            table("Core ROI: mean (SD), HU", paper.FOREGROUND, "{:.1f} ({:.1f})", *moments(0)),
            table("Fibrous ROI: mean (SD), HU", paper.BACKGROUND, "{:.1f} ({:.1f})", *moments(1)),
            table(
                "CNR",
                paper.CNR,
                "{:.2f}",
                lambda e: f"{e['cnr']:.2f}",
                lambda means, variances: f"{(means[1] - means[0]) / np.sqrt(variances.sum()):.2f}",
            ),
        ]
    )
