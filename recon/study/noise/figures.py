"""Figures of the noise study: images of every setting, and CNRs with their uncertainty."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.study.noise.few_runs import measured_table
from recon.study.noise.measure import Measured
from recon.study.paper import facts as paper
from recon.study.paper.tables import published
from torchpcct.metrics.cnr import cnr_interval, cnr_range
from torchpcct.metrics.roi import sample_axial
from torchpcct.viz import Panel, panels

__all__ = ["cnr_figure", "images_figure"]


_IMAGES_SCALE = 0.62
"""Noise does not compress: twenty panels stay below 400 kB at this size."""


def images_figure(m: Measured) -> Any:
    """One realisation at the tables' dose: kernels down, voxel sizes across."""
    rois = m.scanned.rois
    half = [rois.image.extent[axis] / 2 for axis in (1, 2)]
    extent = (-half[1], half[1], -half[0], half[0])
    grids = dict(zip(m.settings.voxels_mm, m.scanned.grids, strict=True))
    rows: list[list[Panel]] = []
    for kernel in m.settings.kernels:
        row = []
        for voxel in m.settings.voxels_mm:
            image = sample_axial(m.images[kernel, voxel], grids[voxel], rois.image)[0]
            outlines = ((rois.foreground[0], "deepskyblue"), (rois.background[0], "tomato")) if not rows else ()
            row.append(Panel(image, extent, f"{voxel:.2f} mm" if not rows else "", outlines))
        rows.append(row)
    figure = panels(
        rows,
        m.settings.kernels,
        f"FBP of one noise realisation, {m.settings.table_exposure_s:g} s, axial",
        "C150 / W600 HU. ROI outlines (top row): necrotic core (blue), fibrous tissue (red).",
    )
    figure.set_size_inches(_IMAGES_SCALE * figure.get_size_inches())
    return figure


def cnr_figure(m: Measured) -> Any:
    """CNR of every setting: exact, n realisations with interval, range of 10-run experiments, the paper's."""
    from matplotlib.figure import Figure

    exposure = m.settings.table_exposure_s
    exact, values = m.exact(exposure), m.means[exposure]
    measured = measured_table(values)
    figure = Figure(figsize=(2.4 * len(m.settings.kernels) + 1.0, 4.0), dpi=150, layout="constrained")
    axes = figure.subplots(1, len(m.settings.kernels), squeeze=False, sharey=True)[0]
    x = np.array(m.settings.voxels_mm)
    step = 0.05 if x.size < 2 else float(np.diff(x).min())
    for ax, kernel in zip(axes, m.settings.kernels, strict=True):
        index = [m.axes.index((kernel, v)) for v in m.settings.voxels_mm]
        bands = np.array(
            [cnr_range(exact.mean[i], m.covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] / exposure, 10) for i in index]
        )
        ax.fill_between(x, bands[:, 0], bands[:, 1], color="0.85", label="95 % of 10-run experiments", linewidth=0)
        ax.plot(x, exact.cnr[index], color="black", linewidth=1.2, label="exact")
        ends = np.array([cnr_interval(values[:, i, 0], values[:, i, 1]) for i in index])
        middle = measured.cnr[index]
        ax.errorbar(
            x + 0.12 * step, middle, [middle - ends[:, 0], ends[:, 1] - middle], fmt="o", markersize=3, capsize=2,
            color="tab:blue", linewidth=1, label=f"n = {len(values)}, 95 %",
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
