"""Figure of the dose study: bowties, dose maps and their ratios, noise with and without the ROI bowtie."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from recon.study.bowtie.measure import Measured

__all__ = ["draw"]

_ROI_RADIUS_MM = 50.0


def _extent(grid: Any) -> tuple[float, float, float, float]:
    (y, x), (h, w) = grid.center[-2:], grid.extent[-2:]
    return x - w / 2, x + w / 2, y - h / 2, y + h / 2


def _picture(figure: Any, ax: Any, image: Any, grid: Any, title: str, cmap: str, low: float, high: float) -> None:
    shown = ax.imshow(
        image, origin="lower", extent=_extent(grid), cmap=cmap, vmin=low, vmax=high, interpolation="nearest"
    )
    phi = np.linspace(0.0, 2.0 * np.pi, 200)
    ax.plot(_ROI_RADIUS_MM * np.cos(phi), _ROI_RADIUS_MM * np.sin(phi), color="tab:orange", linewidth=0.8)
    ax.set_title(title, fontsize=8)
    ax.set_xticks([])
    ax.set_yticks([])
    figure.colorbar(shown, ax=ax, shrink=0.75, pad=0.01).ax.tick_params(labelsize=6)


def _bowties(ax: Any, transmission: dict[str, Any]) -> None:
    offset = transmission["offset_at_isocentre_mm"]
    for name, colour in (("large", "tab:blue"), ("large+roi", "tab:orange")):
        ax.plot(offset, transmission[name], color=colour, label=name)
    ax.axvline(_ROI_RADIUS_MM, color="grey", linewidth=0.7, linestyle=":")
    ax.set_xlabel("distance of the ray from the isocentre, mm", fontsize=7)
    ax.set_title("energy let through; dashed: aluminium", fontsize=8)
    ax.legend(fontsize=6)
    ax.tick_params(labelsize=6)
    twin = ax.twinx()
    for name, colour in (("large", "tab:blue"), ("large+roi", "tab:orange")):
        twin.plot(offset, transmission[f"{name} mm"], color=colour, linestyle="--", linewidth=0.8)
    twin.set_ylabel("mm", fontsize=7)
    twin.tick_params(labelsize=6)


def draw(measured: Measured) -> Any:
    """The figure as ``matplotlib.figure.Figure``."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.5, 9.0), dpi=74, layout="constrained")
    axes = figure.subplots(3, 4)
    _bowties(axes[0, 0], measured.transmission)
    for row, name in ((1, "ctdi"), (2, "thorax")):
        maps, images = measured.maps[name], measured.images[name]
        high = float(np.nanpercentile(maps.primary[0][maps.labels >= 0], 95.0))
        dose = np.where(maps.labels >= 0, maps.primary, np.nan)
        for k, bowtie in enumerate(("large", "large+roi")):
            label = f"{name}, {bowtie}: dose, mGy"
            _picture(figure, axes[row, k], dose[k], maps.grid, label, "inferno", 0.0, high)
            centre = 0.0 if name == "ctdi" else -100.0
            place = axes[row, 2] if k == 0 else axes[row, 3]
            _picture(
                figure, place, images.noisy[k], images.grid, f"{name}, {bowtie}: image, HU", "gray", centre - 250.0,
                centre + 250.0,
            )  # fmt: skip
    for column, name in ((1, "ctdi"), (2, "thorax")):
        maps = measured.maps[name]
        _picture(figure, axes[0, column], maps.ratio, maps.grid, f"{name}: dose with / without", "viridis", 0.3, 1.05)
    ax = axes[0, 3]
    profile = measured.noise["ctdi"]["profile"]
    for k, (bowtie, colour) in enumerate((("large", "tab:blue"), ("large+roi", "tab:orange"))):
        ax.plot(profile["radius_mm"], profile["sd_hu"][k], color=colour, label=bowtie)
    ax.axvline(_ROI_RADIUS_MM, color="grey", linewidth=0.7, linestyle=":")
    ax.set_title("CTDI phantom: noise against radius", fontsize=8)
    ax.set_xlabel("mm", fontsize=7)
    ax.set_ylabel("SD, HU", fontsize=7)
    ax.set_ylim(bottom=0.0)
    ax.legend(fontsize=6)
    ax.tick_params(labelsize=6)
    figure.suptitle(
        "Dose and noise with and without the ROI bowtie; orange circle: region of interest (unscattered dose)",
        fontsize=10,
    )
    return figure
