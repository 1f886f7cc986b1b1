"""Figure of the bowtie study: bowties, dose maps and their ratios, noise with and without the ROI bowtie."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.study.bowtie.measure import Measured
from recon.study.bowtie.slices import BOWTIES
from torchpcct.geometry import VolumeGrid

__all__ = ["draw"]

_ROI_RADIUS_MM = 50.0
_COLOURS = dict(zip(BOWTIES, ("tab:blue", "tab:orange"), strict=True))


def _picture(ax: Any, image: Any, grid: VolumeGrid, title: str, cmap: str, low: float, high: float) -> None:
    (y, x), (h, w) = grid.center[-2:], grid.extent[-2:]
    extent = (x - w / 2, x + w / 2, y - h / 2, y + h / 2)
    shown = ax.imshow(image, origin="lower", extent=extent, cmap=cmap, vmin=low, vmax=high, interpolation="nearest")
    phi = np.linspace(0.0, 2.0 * np.pi, 200)
    ax.plot(_ROI_RADIUS_MM * np.cos(phi), _ROI_RADIUS_MM * np.sin(phi), color="tab:orange", linewidth=0.8)
    ax.set_title(title, fontsize=8)
    ax.set_xticks([])
    ax.set_yticks([])
    ax.figure.colorbar(shown, ax=ax, shrink=0.75, pad=0.01).ax.tick_params(labelsize=6)


def _curves(ax: Any, title: str, label: str, x: Any, curves: dict[str, Any]) -> None:
    for bowtie, colour in _COLOURS.items():
        ax.plot(x, curves[bowtie], color=colour, label=bowtie)
    ax.axvline(_ROI_RADIUS_MM, color="grey", linewidth=0.7, linestyle=":")
    ax.set_xlabel(label, fontsize=7)
    ax.set_title(title, fontsize=8)
    ax.legend(fontsize=6)
    ax.tick_params(labelsize=6)


def draw(measured: Measured) -> Any:
    """The figure as ``matplotlib.figure.Figure``."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.5, 9.0), dpi=74, layout="constrained")
    axes = figure.subplots(3, 4)
    through = measured.parts["transmission"]
    offset = through["offset_at_isocentre_mm"]
    label = "distance of the ray from the isocentre, mm"
    _curves(axes[0, 0], "energy let through; dashed: aluminium", label, offset, through)
    twin = axes[0, 0].twinx()
    for bowtie, colour in _COLOURS.items():
        twin.plot(offset, through[f"{bowtie} mm"], color=colour, linestyle="--", linewidth=0.8)
    twin.set_ylabel("mm", fontsize=7)
    twin.tick_params(labelsize=6)
    for row, (name, centre) in enumerate((("ctdi", 0.0), ("thorax", -100.0)), start=1):
        maps, images = measured.maps[name], measured.images[name]
        unscattered = maps.doses["unscattered"]
        body = maps.labels >= 0
        high = float(np.nanpercentile(unscattered[0][body], 95.0))
        dose = np.where(body, unscattered, np.nan)
        for k, bowtie in enumerate(BOWTIES):
            label = f"{name}, {bowtie}: dose, mGy"
            _picture(axes[row, k], dose[k], maps.grid, label, "inferno", 0.0, high)
            label = f"{name}, {bowtie}: image, HU"
            _picture(axes[row, 2 + k], images.noisy[k], images.grid, label, "gray", centre - 250.0, centre + 250.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = unscattered[1] / unscattered[0]
        _picture(axes[0, row], ratio, maps.grid, f"{name}: dose with / without", "viridis", 0.3, 1.05)
    profile = measured.parts["noise"]["ctdi"]["profile"]
    curves = dict(zip(BOWTIES, profile["sd_hu"], strict=True))
    _curves(axes[0, 3], "CTDI phantom: noise against radius", "mm", profile["radius_mm"], curves)
    axes[0, 3].set_ylabel("SD, HU", fontsize=7)
    axes[0, 3].set_ylim(bottom=0.0)
    title = "Dose and noise with and without the ROI bowtie; orange circle: region of interest (unscattered dose)"
    figure.suptitle(title, fontsize=10)
    return figure
