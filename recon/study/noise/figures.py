"""Figures of the noise study: images of every setting, and CNRs with their uncertainty."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.study.figures import extent, roi_outlines
from recon.study.noise.measure import Measured
from recon.study.paper import facts as paper
from recon.study.paper.tables import published
from torchpcct.metrics.roi import sample_axial
from torchpcct.viz import Panel, panels

__all__ = ["cnr_figure", "images_figure"]


_IMAGES_SCALE = 0.62
"""Noise does not compress: twenty panels stay below 400 kB at this size."""


def images_figure(m: Measured) -> Any:
    """One realisation at the tables' dose: kernels down, voxel sizes across."""
    s, rois = m.settings, m.scanned.rois
    rows = []
    for kernel in s.kernels:
        first = kernel == s.kernels[0]
        row = []
        for voxel, grid in zip(s.voxels_mm, m.scanned.grids, strict=True):
            image = sample_axial(m.images[kernel, voxel], grid, rois.image)[0]
            title, outlines = (f"{voxel:.2f} mm", roi_outlines(rois)) if first else ("", ())
            row.append(Panel(image, extent(rois.image), title, outlines))
        rows.append(row)
    figure = panels(
        rows,
        s.kernels,
        f"FBP of one noise realisation, {s.table_exposure_s:g} s, axial",
        "C150 / W600 HU. ROI outlines (top row): necrotic core (blue), fibrous tissue (red).",
    )
    figure.set_size_inches(_IMAGES_SCALE * figure.get_size_inches())
    return figure


def cnr_figure(m: Measured, rows: list[dict[str, Any]]) -> Any:
    """CNR of every setting: exact, n realisations with interval, range of 10-run experiments, the paper's.

    Args:
        rows: of the report's table at the tables' dose.
    """
    from matplotlib.figure import Figure

    exposure, kernels = m.settings.table_exposure_s, m.settings.kernels
    figure = Figure(figsize=(2.4 * len(kernels) + 1.0, 4.0), dpi=150, layout="constrained")
    axes = figure.subplots(1, len(kernels), squeeze=False, sharey=True)[0]
    x = np.array(m.settings.voxels_mm)
    step = 0.05 if x.size < 2 else float(np.diff(x).min())
    for ax, kernel in zip(axes, kernels, strict=True):
        own = [r for r in rows if r["kernel"] == kernel]
        bands = np.array([r["ten_runs"]["cnr_range"] for r in own])
        ax.fill_between(x, bands[:, 0], bands[:, 1], color="0.85", label="95 % of 10-run experiments", linewidth=0)
        ax.plot(x, [r["exact"]["cnr"] for r in own], color="black", linewidth=1.2, label="exact")
        middle = np.array([r["measured"]["cnr"] for r in own])
        ends = np.array([r["measured"]["cnr_interval"] for r in own])
        ax.errorbar(
            x + 0.12 * step, middle, [middle - ends[:, 0], ends[:, 1] - middle], fmt="o", markersize=3, capsize=2,
            color="tab:blue", linewidth=1, label=f"n = {m.settings.realizations}, 95 %",
        )  # fmt: skip
        entries = [published(paper.CNR, kernel, v, exposure) for v in m.settings.voxels_mm]
        if all(e is not None for e in entries):
            ax.plot(x, entries, "x", color="tab:red", label="paper (n = 10)")
        ax.set_title(kernel, fontsize=10)
        ax.set_xlabel("voxel, mm")
        ax.set_xticks(x)
        ax.tick_params(labelsize=8)
    axes[0].set_ylabel("CNR of the core")
    axes[0].set_ylim(0, None)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    figure.suptitle(f"CNR of the necrotic core by FBP at {exposure:g} s", fontsize=10)
    return figure
